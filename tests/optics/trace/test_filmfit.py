"""Films as polynomials: their shares of light against the package tmm, lenses against the tracer's matrices."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import tmm
from numpy.polynomial.polynomial import polyval2d

from neurolens.base import status as st
from neurolens.base.settings import LIGHT_NM
from neurolens.graph.interpret import evaluate
from neurolens.models.pairs import domain_of, sample_domain
from neurolens.optics.lens.designs import design
from neurolens.optics.lens.glass import index_at
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.pupils import camera_rays
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.filmfit import FIT, FilmFit, Rows, fitted, inverse_um_at
from neurolens.optics.trace.rays import trace
from neurolens.optics.trace.tracegraph import exact_graph

LENSES = Path(__file__).parents[3] / "lenses"
ENDS = 1000 / LIGHT_NM[1], 1000 / LIGHT_NM[0]


def fit_of(name: str, media: tuple[float, float], V_d: float = 40.0) -> FilmFit:
    """The fit of a design between air and a glass that disperses, in this order."""
    at = [tuple(1.0 if n == 1 else float(index_at(n, V_d, 1000 / u)) for u in inverse_um_at(ENDS)) for n in media]
    found = fitted(design(name, *media).layers, *at, ENDS)
    assert found is not None
    return found


def value(rows: Rows, x: float, y: float) -> float:
    table = np.zeros((len(rows), max(map(len, rows))))
    for row, numbers in zip(table, rows, strict=True):
        row[: len(numbers)] = numbers
    return float(polyval2d(x, y, table))


@pytest.mark.parametrize("name", ["single-layer", "three-layer", "multi-layer", "v-coat"])
@pytest.mark.parametrize("media", [(1.0, 1.45), (1.0, 1.62), (1.9, 1.0)])
def test_shares_of_light_are_those_of_tmm(name: str, media: tuple[float, float]) -> None:
    """Between the nodes of the fit, from the axis to grazing light, where no light passes."""
    fit, layers, rng = fit_of(name, media), design(name, *media).layers, np.random.default_rng(2)
    for square, nm in zip(np.append(rng.random(60), 1.0), rng.uniform(*LIGHT_NM, 61), strict=True):
        n1, n2 = (1.0 if n == 1 else float(index_at(n, 40.0, nm)) for n in media)
        indices = [n1, *(float(index_at(n, v[0] if v else None, nm)) for n, _, *v in layers), n2]
        sizes = [math.inf, *(layer[1] for layer in layers), math.inf]
        angle = math.asin(math.sqrt(square) / n1)
        wanted = [tmm.coh_tmm(pol, indices, sizes, angle, nm)["T"] for pol in "sp"] if square < 1 else [0.0, 0.0]
        x, y = 2 * square / fit.most - 1, (2000 / nm - sum(ENDS)) / (ENDS[1] - ENDS[0])
        flux = 2 * math.sqrt(max(n1 * n1 - square, 0) * max(n2 * n2 - square, 0))
        both, split = value(fit.both, x, y) + 2 * flux, value(fit.split, x, y)
        shares = 4 * flux / (both - split), 4 * flux / (both + split)
        assert sum(shares) / 2 == pytest.approx(sum(wanted) / 2, abs=1.1 * FIT)
        assert shares == pytest.approx(wanted, abs=20 * FIT)


def test_films_of_many_waves_have_no_fit() -> None:
    air, glass = (1.0,) * 27, (1.5,) * 27
    assert fitted(((1.46, 5000.0), (2.1, 3.0)), air, glass, ENDS) is None
    assert fitted(((2.3, 60.0), (1.46, 94.0)) * 6, air, glass, ENDS) is None


def test_light_of_one_wavelength_needs_no_series_in_it() -> None:
    one = (1000 / 550.0,) * 2
    fit = fitted(design("multi-layer", 1.0, 1.6).layers, (1.0,) * 27, (1.6,) * 27, one)
    assert fit is not None and len(fit.both) < 9
    assert value(fit.both, -1.0, 0.0) == pytest.approx(value(fit.both, -1.0, 1.0), abs=1e-9)


@pytest.mark.parametrize("name", ["laikin_double_gauss_50", "shimizu_fisheye_220"])
def test_the_graph_of_a_coated_lens_transmits_what_the_tracer_does(name: str) -> None:
    """Polarised, over the whole film; each coated surface may add its error. Double precision keeps the matrices."""
    lens = set_lens(read_lens(LENSES / f"{name}.toml"), coating="multi-layer")
    domain = domain_of(lens, focus_m=(math.inf, math.inf))
    rays, film_z = sample_domain(domain, 3000, seed=3), float(domain.film_z_mm[0])
    columns = rays.film_x, rays.film_y, rays.pupil_x, rays.pupil_y, rays.wavelength_nm
    start = camera_rays(rays.film_x, rays.film_y, film_z, rays.pupil_x, rays.pupil_y, domain.pupil_z_mm)
    wanted = trace(lens, start, rays.wavelength_nm, transmittance=True)
    passed = (wanted.status == st.PASSED).numpy()
    call = {"film_z_mm": np.array([[film_z]]), "stop_radius_mm": np.array([[float(lens.stop_radius_mm)]])}
    assert wanted.transmittance is not None and passed.sum() > 500
    coated = sum(s.coating is not None for s in lens.surfaces)
    for double, most in ((False, coated * FIT), (True, 1e-6)):
        graph = exact_graph(lens, domain.pupil_z_mm, domain.wavelength_nm, double=double)
        found = evaluate(graph, {"rays": np.stack([np.asarray(c) for c in columns])} | call)
        off = np.abs(found["transmittance"][0] - wanted.transmittance.numpy())[passed]
        assert off.max() < most and np.isfinite(found["transmittance"]).all()
