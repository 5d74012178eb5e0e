"""Experiments on many states of a lens: what they ask for, their record, and a second run that fits nothing again."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import lens_models
import pytest

from experiments.zoom import CASES, page
from neurolens.base.errors import InputError
from neurolens.cameras.onnxlens import load_model
from neurolens.evaluate.experiment import default_experiment
from neurolens.evaluate.train_states import fit_and_measure_states, state_settings
from neurolens.surrogates.fit import ModelSettings
from neurolens.surrogates.states.fit import StateSettings

ZOOM = lens_models.LENSES / "nikon_zoom_70_200.toml"


def test_experiments_ask_for_states() -> None:
    both = default_experiment(ZOOM, ['lens.zoom="range"', 'lens.focusing="internal"'])
    assert both.lens.many_states and [a.name for a in both.states().axes] == ["zoom", "focus"]
    zoom = default_experiment(ZOOM, ['lens.zoom="range"']).states()
    assert [a.name for a in zoom.axes] == ["zoom"]
    wide = zoom.domain_at((zoom.axes[0].range[0],))
    assert math.isinf(wide.focus_m[0]) and wide.film_z_mm[0] < wide.film_z_mm[1] and wide.film_radius_mm == 21.6
    inside = default_experiment(ZOOM, ['lens.focusing="internal"', 'lens.configuration="135mm"']).states()
    near = inside.axes[0].range[1]
    assert inside.lens_at((near,)).film_z_mm == pytest.approx(inside.domain_at((near,)).film_z_mm[0])
    assert not default_experiment(ZOOM).lens.many_states


@pytest.mark.parametrize(
    ("overrides", "field"),
    [(['lens.zoom="range"', "lens.efl_mm=50"], "lens.efl_mm"),
     (['lens.zoom="range"', 'lens.configuration="135mm"'], "lens.configuration")],
)  # fmt: skip
def test_states_that_cannot_be_asked_for(overrides: list[str], field: str) -> None:
    with pytest.raises(InputError, match=field):
        default_experiment(ZOOM, overrides).states()


def test_lens_files_without_states_are_refused() -> None:
    fixed = lens_models.LENSES / "laikin_double_gauss_50.toml"
    for override, field in (('lens.zoom="range"', "zoom"), ('lens.focusing="internal"', "focus")):
        with pytest.raises(InputError, match=field):
            default_experiment(fixed, [override]).states()


@pytest.mark.parametrize(
    "settings", [ModelSettings("mlp"), ModelSettings("ols", basis="raw"), ModelSettings("ols", partitions=2)]
)
def test_models_that_know_no_states(settings: ModelSettings) -> None:
    with pytest.raises(InputError, match="many states"):
        state_settings(settings, 1000, 1)


def test_a_second_run_takes_the_model_that_is_there(tmp_path: Path) -> None:
    space = default_experiment(lens_models.LENSES / "nikon_zoom_80_200.toml", ['lens.zoom="range"']).states()
    space = replace(space, axes=(replace(space.axes[0], degree=1),), focus_m=(math.inf, math.inf))
    settings = StateSettings(terms=8, degree=2, rays=800, name="tiny")
    first = fit_and_measure_states(space, settings, tmp_path, states=2)
    card = load_model(tmp_path / "tiny.onnx").card
    assert card["errors"]["rms_um"] == first["rms_um"] == max(r["rms_um"] for r in first["states"])
    assert len(card["states"]["nodes"]) == first["nodes"] == 2
    written = (tmp_path / "tiny.onnx").stat().st_mtime_ns
    assert fit_and_measure_states(space, settings, tmp_path, states=2) == first
    assert (tmp_path / "tiny.onnx").stat().st_mtime_ns == written
    text = page([{"case": CASES[0].name, "axes": [a.to_dict() for a in space.axes], "fixed": [], **first}])
    assert CASES[0].name in text and "80.09" in text
