"""Fits near grazing, and with a network on top; what each part of a fit is worth; bad settings."""

import math
from dataclasses import replace
from functools import cache
from typing import Any

import lens_models
import numpy as np
import pytest
import torch
from lens_models import LENSES, prepared

from neurolens.base.errors import InputError
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph
from neurolens.models import targets
from neurolens.models.assemble import refracted, tilt_series
from neurolens.models.cores import Refracted, Residual
from neurolens.models.fit import ModelSettings, Prepared, fit_model, prepare
from neurolens.models.model import LensModel
from neurolens.models.pairs import PairSettings, domain_of, make_pairs
from neurolens.models.targets import film_equivalent, targets_of
from neurolens.optics.lens.figures import Cylinder, Figure, Qcon
from neurolens.optics.lens.glass import index_of
from neurolens.optics.lens.prescription import Surface
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.trace.shapes import sag_and_derivatives
from neurolens.optics.trace.surfaces import entered


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("degree", v) for v in (-1, 17, 10**9)),
        *(("terms", v) for v in (0, -3, 2001)),
        *(("units", v) for v in (0, 513)),
        *(("layers", v) for v in (0, 9)),
        *(("steps", v) for v in (0, 10**9)),
    ],
)
def test_numbers_without_bounds_are_refused(field: str, value: Any) -> None:
    with pytest.raises(InputError, match=field):
        ModelSettings(**{field: value})


# ---- what each part of a fit is worth ----


@cache
def _infinity(stem: str) -> Prepared:
    lens = read_lens(LENSES / f"{stem}.toml")
    return prepare(make_pairs(lens, domain_of(lens), PairSettings(3000, 3000, 3000)))


def test_transmittance_terms_follow_absorption() -> None:
    """Glasses absorb the blue: high powers of the wavelength hold it."""
    stem = "laikin_double_gauss_127"
    off = []
    for most in (4, 48):
        model = fit_model(_infinity(stem), ModelSettings(terms=30, growth=1, planes=False, transmittance_terms=most))
        truth = _infinity(stem).pairs.held_out
        off.append(float((model.predict(truth.inputs).transmittance - truth.transmittance).square().mean().sqrt()))
    assert off[1] < 5e-4 < 1e-3 < off[0]


SETTINGS = ModelSettings("ols+mlp", terms=12, degree=5, planes=False, units=8, layers=1, steps=60)


@pytest.fixture(scope="module")
def model() -> LensModel:
    return fit_model(prepared(), SETTINGS)


def _rms_um(model: LensModel) -> float:
    pairs = prepared().pairs
    targets = targets_of(pairs.lens, model.encoding, pairs.held_out)
    off = film_equivalent(pairs.lens, pairs.domain, model.core(targets.field)[0] - targets.vectors)
    return float((off**2).sum(1).mean().sqrt())


def test_the_network_takes_most_of_what_the_polynomial_leaves(model: LensModel) -> None:
    assert isinstance(model.core, Residual)
    assert _rms_um(model) < 0.3 * _rms_um(replace(model, core=model.core.parts[0]))


# ---- rays that leave the front surface at grazing angles ----


FRONTS = {
    "sphere": Surface(60.0, 2.0, 70.0, 1.6, 50.0),
    "concave": Surface(-80.0, 2.0, 60.0, 1.8, 30.0),
    "plane": Surface(math.inf, 2.0, 40.0, 1.5, 60.0),
    "asphere": Surface(50.0, 2.0, 60.0, 1.7, 40.0, figure=Figure(conic=-0.6, asphere=((4, 2e-6), (6, -1e-10)))),
    "Qcon": Surface(50.0, 2.0, 60.0, 1.7, 40.0, figure=Qcon(qcon=(0.5, -0.1, 0.02), norm_mm=30.0)),
}


@pytest.mark.parametrize("name", FRONTS)
def test_leaving_the_front_glass_is_snells_law(name: str) -> None:
    """Directions scattered to just short of grazing, entered by Snell's law, come out as they were."""
    surface, rng = FRONTS[name], np.random.default_rng(3)
    h, turn = surface.semi_diameter_mm * np.sqrt(rng.uniform(0, 1, 4000)), rng.uniform(0, 2 * np.pi, 4000)
    x, y = h * np.cos(turn), h * np.sin(turn)
    _, zx, zy = sag_and_derivatives(surface, x, y)
    normal = np.stack([zx, zy, -np.ones(4000)]) / np.sqrt(1 + zx**2 + zy**2)
    way = rng.normal(size=(3, 4000))
    way /= np.linalg.norm(way, axis=0)
    way *= np.sign((way * normal).sum(0))
    inside, wider = entered(surface, x, y, way, np.full(4000, surface.n_d))
    # Snell: n times the part across the normal stays; both rays and the normal lie in one plane.
    across = np.cross(inside, normal, axis=0) * surface.n_d - np.cross(way, normal, axis=0)
    assert np.abs(across).max() < 1e-12 and (np.abs(np.linalg.norm(inside, axis=0) - 1) < 1e-12).all()
    cosines = (way * normal).sum(0), (inside * normal).sum(0)
    np.testing.assert_allclose(wider * cosines[0], surface.n_d**2 * cosines[1], rtol=1e-9)  # étendue
    g = Graph()
    g.outputs["way"] = refracted(g.input("at", 2), g.input("inside", 3), g.constant(surface.n_d), surface)
    found = evaluate(g, {"at": torch.from_numpy(np.stack([x, y])), "inside": torch.from_numpy(inside)})["way"].numpy()
    off = np.linalg.norm(found - way, axis=0) * np.maximum(cosines[0], 1e-3)  # what the normal errs by grows so
    assert off.max() < 1e-6 and np.abs(np.linalg.norm(found, axis=0) - 1).max() < 1e-12


def test_fronts_that_no_series_tells_are_left_alone() -> None:
    sphere = FRONTS["sphere"]
    for other in (
        replace(sphere, figure=Cylinder(cylinder="x")),
        replace(sphere, n_d=1.0, V_d=None),
        replace(sphere, figure=replace(sphere.figure, asphere=((3, 1e-3),))),
    ):
        assert tilt_series(other) is None
    assert tilt_series(sphere) is not None


def fisheye_rms_deg(settings: ModelSettings) -> float:
    data = lens_models.prepared(lens_models.FISHEYE)
    model = fit_model(data, settings)
    truth = data.pairs.train
    out = model.predict(truth.inputs)
    cross = torch.linalg.cross(torch.stack(out.rays[3:]).T, torch.stack(truth.scene[3:]).T).norm(dim=1)
    return math.degrees(float((cross**2).mean().sqrt()))


def test_the_error_of_a_grazing_fisheye_falls_to_half(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = ModelSettings("dense", degree=5)
    refracting = fisheye_rms_deg(settings)
    monkeypatch.setattr(targets, "GRAZING", 0.0)
    assert refracting < 0.5 * fisheye_rms_deg(settings)


def test_networks_of_a_grazing_fisheye_give_the_direction_outside() -> None:
    settings = ModelSettings("ols+mlp", terms=12, degree=5, steps=2, units=4, layers=1, planes=False)
    assert fisheye_rms_deg(settings) < 0.2


def test_fits_see_the_ray_inside_the_glass_and_the_model_its_index() -> None:
    data, model = lens_models.prepared(lens_models.FISHEYE), lens_models.model("fisheye")
    assert isinstance(model.core, Refracted) and not isinstance(lens_models.model("colourless").core, Refracted)
    train = data.pairs.train
    inside = targets.inside_front(model.lens, train)
    # The exact refraction of the front surface stands between both.
    s, n = model.lens.surfaces[0], index_of(model.lens.surfaces[0], train.inputs.wavelength_nm)
    normal = torch.stack([s.curvature * train.scene.x, s.curvature * train.scene.y, s.curvature * train.scene.z - 1])
    sines = [torch.linalg.cross(torch.stack(d[3:]).T, normal.T).norm(dim=1) for d in (inside.scene, train.scene)]
    torch.testing.assert_close(n * sines[0], sines[1], rtol=0, atol=1e-9)
    w = model.encoding(train.inputs).w
    found = np.polynomial.Polynomial(model.core.index)(w.numpy())
    assert np.abs(found - n.numpy()).max() < 4e-8
    # Directions have unit length, beyond the domain too, where no ray of the lens leaves the front.
    wide = replace(train.inputs, film_x=1.3 * train.inputs.film_x, film_y=1.3 * train.inputs.film_y)
    out = model.predict(wide)
    length = torch.stack(out.rays[3:]).norm(dim=0)
    assert float((length - 1).abs().max()) < 1e-9
