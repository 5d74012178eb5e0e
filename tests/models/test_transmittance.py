"""The transmittance of models of coated lenses, held against exact rays, transfer matrices of `tmm`, and the T-stop."""

import math
from dataclasses import replace
from pathlib import Path

import lens_models
import numpy as np
import pytest
import tmm
import torch

from experiments.data.refit import refit_transmittance, refitted
from neurolens.base.errors import InputError
from neurolens.base.settings import LIGHT_NM
from neurolens.cameras.exact import state_of
from neurolens.cameras.model import OnnxCamera, load_model
from neurolens.graph.interpret import evaluate
from neurolens.models.card import read_card
from neurolens.models.cores import InvariantPolynomial, LightField, Residual
from neurolens.models.export import export_onnx
from neurolens.models.file import read_model
from neurolens.models.fitted import FilmRays
from neurolens.models.model import LensModel
from neurolens.models.pairs import passing_rays, sample_domain
from neurolens.optics.lens.glass import absorption_of, index_at, index_of
from neurolens.optics.lens.shot import Shot

KINDS = {"coated": "invariants", "coated network": "residual"}


@pytest.fixture(scope="module", params=KINDS)
def both(request: pytest.FixtureRequest) -> tuple[LensModel, LensModel]:
    """A model of the lens as its file has it, and the same of the lens with chosen coatings."""
    return lens_models.model(KINDS[request.param]), lens_models.model(request.param)


def test_fresh_rays_keep_the_light_of_the_coated_lens(both: tuple[LensModel, LensModel]) -> None:
    for model in both:
        fresh = passing_rays(model.lens, model.domain, 8000, seed=99)
        seen = (fresh.inputs.wavelength_nm >= LIGHT_NM[0]) & (fresh.inputs.wavelength_nm <= LIGHT_NM[1])
        off = (model.predict(fresh.inputs).transmittance - fresh.transmittance).abs()
        assert off.square().mean().sqrt() < 0.001 and off[seen].max() < 0.01
    assert float(fresh.transmittance.mean()) > 0.95  # bare glass keeps half of it


def test_the_axial_ray_keeps_what_transfer_matrices_say(both: tuple[LensModel, LensModel]) -> None:
    """Surface by surface, at normal incidence, and through the glass by Beer and Lambert."""
    _, model = both
    wavelengths, lens = np.linspace(400.0, 700.0, 7), model.lens
    wanted = []
    for nm in wavelengths:
        through, before = 1.0, 1.0
        for s in lens.surfaces:
            after = float(index_of(s, nm))
            films = s.coating.layers if s.coating else ()
            n = [before, *(float(index_at(f[0], f[2], nm)) for f in films), after]
            through *= tmm.coh_tmm("s", n, [np.inf, *(f[1] for f in films), np.inf], 0.0, nm)["T"]
            through *= math.exp(-float(absorption_of(s, nm) or 0.0) * s.thickness_mm) if after > 1.1 else 1.0
            before = after
        wanted.append(through)
    nothing = torch.zeros(len(wavelengths), dtype=torch.float64)
    film_z = torch.full_like(nothing, model.domain.film_z_mm[0])
    rays = FilmRays(nothing, nothing, film_z, nothing, nothing, torch.from_numpy(wavelengths))
    np.testing.assert_allclose(model.predict(rays).transmittance, wanted, atol=0.01)  # the most that any ray may err


def test_nothing_but_the_transmittance_changes(both: tuple[LensModel, LensModel]) -> None:
    before, after = (_others(model) for model in both)
    assert before.keys() == after.keys() and all(np.array_equal(before[k], after[k]) for k in before)
    assert replace(both[1], lens=both[0].lens, core=both[0].core, settings=both[0].settings) == both[0]


def _others(model: LensModel) -> dict[object, np.ndarray]:
    """The coefficients of all outputs but the transmittance, by their terms; of networks by their layers."""
    polynomial = model.core.parts[0] if isinstance(model.core, Residual) else model.core
    assert isinstance(polynomial, InvariantPolynomial)
    rows = np.concatenate([polynomial.ab.reshape(6, -1), polynomial.scalars[1:]])
    terms = zip(polynomial.exponents.tolist(), rows.T, strict=True)
    found: dict[object, np.ndarray] = {tuple(e): row for e, row in terms if row.any()}
    if isinstance(model.core, Residual):
        network = model.core.parts[1]
        for k, (weight, bias) in enumerate((*network.hidden, network.output)):
            found |= {f"weight {k}": weight, f"bias {k}": bias}
    return found


def test_files_are_fitted_again_with_their_cards(tmp_path: Path) -> None:
    """Twice the same fit writes the same card, and the T-stop of the file is that of the tracer."""
    lens, file = lens_models.coated(), tmp_path / "model.onnx"
    errors = refit_transmittance(lens_models.exported("invariants"), lens, file)
    card, bare = read_card(file), read_card(lens_models.exported("invariants"))
    assert card["lens"]["sha256"] == lens.sha256 != bare["lens"]["sha256"]
    assert (card["lens"]["coatings"], bare["lens"]["coatings"]) == ("multi-layer", lens_models.lens().coatings)
    assert card["errors"] == {"rms_um": 1.0} | {k: errors[k] for k in ("transmittance_rms", "transmittance_max")}
    assert {k: card[k] for k in ("domain", "gates", "units")} == {k: bare[k] for k in ("domain", "gates", "units")}
    assert read_model(file).nodes[0].lens.surfaces == lens.surfaces
    refit_transmittance(file, lens)
    assert read_card(file)["reference"] == card["reference"]
    found = OnnxCamera(load_model(file), Shot((36.0, 24.0), math.inf)).settings["lens_state"]["t_stop"]
    wanted = state_of(lens, LIGHT_NM, None)["t_stop"]
    assert found == pytest.approx(wanted, rel=2e-3) and 1.0 < wanted / lens.f_number < 1.02


@pytest.mark.parametrize("name", ["samyang_135mm_f2_0_ed_umc.ols-64", "canon_rf_85mm_f1_2_l_usm_ds.mlp-16x2"])
def test_float32_carries_the_light_at_the_ends_of_the_spectrum(name: str) -> None:
    """Powers of w to 20, whose coefficients reach 16,000, would lose 2e-3 of it at 380 nm."""
    model = load_model(lens_models.LENSES.parent / "models" / f"{name}.onnx")
    rays = sample_domain(model.fitted.domain, 4000, seed=3)
    columns = torch.stack([rays.film_x, rays.film_y, rays.pupil_x, rays.pupil_y, rays.wavelength_nm]).numpy()
    columns[4, ::2] = 380.0 + 40.0 * np.arange(2000) / 2000
    call = {"film_z_mm": float(rays.film_z[0]), "stop_radius_mm": float(model.fitted.lens.stop_radius_mm)}
    single, double = (
        evaluate(
            model.graph(),
            {"rays": columns.astype(kind)} | {key: np.full((1, 1), value, kind) for key, value in call.items()},
        )
        for kind in (np.float32, np.float64)
    )
    passed = (single["status"][0] == 0) & (double["status"][0] == 0)
    assert passed.sum() > 500
    off = np.abs(single["transmittance"] - double["transmittance"])[0, passed]
    assert off.max() < 6e-6


@pytest.mark.parametrize("degree", [1, 3, 4, 20])
def test_cubics_and_chebyshev_polynomials_have_the_same_sum_as_powers(degree: int) -> None:
    exponents = np.array([[0, 0, 0, k] for k in range(degree + 1)] + [[1, 0, 0, degree]])
    rng = np.random.default_rng(degree)
    scalars, w = rng.normal(size=(1, len(exponents))), np.linspace(-1, 1, 50)
    core = InvariantPolynomial(exponents, np.zeros((3, 2, len(exponents))), scalars)
    p, u = torch.from_numpy(rng.normal(size=(2, 2, 50)))
    found = core(LightField(p, u, torch.from_numpy(w)))[1][0].numpy()
    rho = (p**2).sum(0).numpy()
    wanted = np.polynomial.polynomial.polyval(w, scalars[0, :-1]) + scalars[0, -1] * rho * w**degree
    np.testing.assert_allclose(found, wanted, rtol=1e-11, atol=1e-11)


def test_a_model_whose_powers_of_the_wavelength_cancel_is_read_again(tmp_path: Path) -> None:
    """Float32 rounds such powers off by more than rays of the card may err: the card's rays are of what is stored."""
    model = lens_models.model("invariants")
    core, series = model.core, 0.01 * np.polynomial.chebyshev.cheb2poly(np.eye(21)[20])
    assert isinstance(core, InvariantPolynomial) and np.abs(series - series.astype(np.float32)).max() > 1e-4
    exponents = np.concatenate([core.exponents, [[0, 0, 0, k] for k in range(2, 21, 2)]])
    scalars = np.pad(core.scalars, [(0, 0), (0, 10)])
    scalars[0, -10:] = series[2::2]
    ab = np.pad(core.ab, [(0, 0), (0, 0), (0, 10)])
    file = export_onnx(
        replace(model, core=replace(core, exponents=exponents, ab=ab, scalars=scalars)), tmp_path / "m.onnx"
    )
    assert np.array_equal(read_model(file).nodes[0].core.scalars, scalars.astype(np.float32))


def test_another_lens_is_refused() -> None:
    other = lens_models.lens().with_gaps({0: 9.0})
    with pytest.raises(InputError, match="coatings and absorption"):
        refitted([lens_models.model("invariants")], [other], 8)
