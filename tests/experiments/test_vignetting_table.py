"""Vignetting of fitted models against the exact lens, and random numbers through an exported one."""

import json
from pathlib import Path

import lens_models
import numpy as np
import pytest
import torch
from vignetting_oracle import vignetting_errors

from experiments import outside, vignetting
from experiments.__main__ import main
from experiments.vignetting import DOMAINS, OPENINGS, opening_errors, passing
from neurolens.base import status as st
from neurolens.cameras.onnxlens import load_model
from neurolens.study.experiment import LensChoice
from neurolens.study.rays import relative_illumination
from neurolens.surrogates.domain import FilmRays
from neurolens.surrogates.fit import ModelSettings, fit_model, prepare
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.pairs import PairSettings, make_pairs

LENSES = Path(__file__).parents[2] / "lenses"


# A command of its own; stops of one fit are held against the lens in surrogates/test_polynomial.py.
pytestmark = pytest.mark.whole


@pytest.fixture(scope="module")
def fisheye() -> LensModel:
    """A circular fisheye, whose film is dark beyond a circle."""
    lens = LensChoice(LENSES / "shimizu_fisheye_220.toml").read()
    pairs = make_pairs(lens, DOMAINS["infinity"].of(lens), PairSettings(train=8000, held_out=10, rim=12000))
    return fit_model(prepare(pairs), ModelSettings("ols", terms=50, planes=False))


def test_every_opening_with_one_fit(fisheye: LensModel) -> None:
    found = opening_errors(fisheye.lens, fisheye, 60_000)
    for name in OPENINGS:
        false_pass, false_block = found[name]["false_pass"], found[name]["false_block"]
        assert false_pass is not None and false_pass < 0.001
        assert false_block is not None and false_block < 0.001
    # The exact lens stopped down, traced so, passes what crosses within.
    radius = fisheye.domain.stop_radius_mm / 2
    same = vignetting_errors(fisheye.lens, fisheye.domain, fisheye.predict, stop_radius_mm=radius, count=60_000)
    assert same["passing_share"] == found["2 stops"]["passing"] / 60_000
    assert (same["false_pass"], same["false_block"]) == (
        found["2 stops"]["false_pass"],
        found["2 stops"]["false_block"],
    )


def test_a_fisheye_darkens_as_the_exact_lens_does(fisheye: LensModel) -> None:
    found = relative_illumination(fisheye.lens, fisheye.domain, fisheye.predict, points=4096, rows=9)
    assert found.max_difference < 0.003
    assert found.exact[-1] < 0.9 * found.exact[0]


@pytest.mark.parametrize("share", [0.0, 0.7, 1.0])
def test_cats_eyes_have_the_same_shape(fisheye: LensModel, share: float) -> None:
    """Pupils as seen from one film point, over a grid of the pupil plane."""
    d = fisheye.domain
    grid = torch.linspace(-d.pupil_radius_mm, d.pupil_radius_mm, 250, dtype=torch.float64)
    u, v = (t.reshape(-1) for t in torch.meshgrid(grid, grid, indexing="xy"))
    place = (share * d.film_radius_mm, 0.0, d.film_z_mm[0])
    x, y, z, wave = (torch.full_like(u, value) for value in (*place, sum(d.wavelength_nm) / 2))
    for exact, said in passing(fisheye.lens, fisheye, FilmRays(x, y, z, u, v, wave)).values():
        assert exact.sum() > 50
        assert (exact ^ said).sum() <= 0.0045 * exact.sum() + 2


def test_rows_of_lenses_that_are_not_chosen_stay(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    openings = {name: {"false_pass": 0.001, "false_block": None} for name in OPENINGS}
    good = {"passing_share": 0.5, "gates": 3, "monomials": 24, "seconds": 1.0, "openings": openings}
    good["illumination"] = {"max_difference": 0.0125}
    monkeypatch.setattr(vignetting, "measure", lambda file, domain, _: good | {"lens": file.stem, "domain": domain})
    (tmp_path / "vignetting.json").write_text('[{"lens": "other", "domain": "infinity", "failed": "not round"}]')
    command = ["vignetting", "--only", "petzval", "--domain", "infinity", "--quiet", "--output", str(tmp_path)]
    assert main(command) == 0
    rows = json.loads((tmp_path / "vignetting.json").read_text())
    assert [r["lens"] for r in rows] == ["other", "petzval_portrait_100"]
    page = (tmp_path / "vignetting.md").read_text()
    assert "other: not round" in page and page.strip() == capsys.readouterr().out.strip()
    assert "| petzval_portrait_100 | 0.100 / - | " in page and "| 1.250 | 50% | 3 | 24 | 1.0 |" in page


def test_broken_promises_are_counted() -> None:
    """Any bits, NaN, rays just outside: a model keeps its promises; one that passes everything is caught at each."""
    model = load_model(lens_models.exported("invariants"))
    found = outside.send(model, 200_000, seed=7)
    assert found.broken == dict.fromkeys(found.broken, 0) and found.inside > 10_000 and found.passed > 3000
    honest = model.rays

    def liar(*arguments: object) -> object:
        out = honest(*arguments)  # type: ignore[arg-type]
        return out._replace(status=np.full_like(out.status, st.PASSED))

    model.rays = liar  # type: ignore[method-assign, assignment]
    found = outside.send(model, 40_000, seed=7)
    assert found.broken[outside.PASSES_OUTSIDE] > 10_000 and found.broken[outside.NOT_FINITE] > 1000
    assert found.passed == 40_000
