"""Vignetting of fitted models against the exact lens, and random numbers through an exported one."""

from pathlib import Path

import lens_models
import numpy as np
import pytest
from vignetting_oracle import vignetting_errors

from experiments.accuracy.vignetting import DOMAINS, OPENINGS, opening_errors
from experiments.hostile import outside
from neurolens.base import status as st
from neurolens.cameras.onnxlens import load_model
from neurolens.models.fit import ModelSettings, fit_model, prepare
from neurolens.models.pairs import PairSettings, make_pairs
from neurolens.studies.experiment import LensChoice

LENSES = Path(__file__).parents[2] / "lenses"
pytestmark = pytest.mark.whole  # a command of its own


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


def test_every_opening_with_one_fit() -> None:
    """A circular fisheye, whose film is dark beyond a circle."""
    lens = LensChoice(LENSES / "shimizu_fisheye_220.toml").read()
    pairs = make_pairs(lens, DOMAINS["infinity"].of(lens), PairSettings(train=8000, held_out=10, rim=12000))
    fisheye = fit_model(prepare(pairs), ModelSettings("ols", terms=50, planes=False))
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
