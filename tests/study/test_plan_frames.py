"""Plans of animations: which frames are probed, breathing, and how many models are fitted."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from neurolens.base.errors import InputError
from neurolens.plan import frames as module
from neurolens.plan.frames import Frame, breathing_px, plan_frames, representatives
from neurolens.plan.probe import probe
from neurolens.readers.lensfile import read_lens
from neurolens.render.scene import Scene, scene_from_tables
from neurolens.setting.states import set_lens

LENS = "lenses/laikin_double_gauss_50.toml"


def frames(focus: list[float], f_number: float = 2.8, film_mm: float = 28.0) -> list[Frame]:
    shot = {"position_m": [0.0, 0.0, 0.0], "look_at_m": [0.0, 0.0, -1.0], "focus_m": 3.0, "f_number": f_number}
    plane = {"point_m": [0.0, 0.0, -4.0], "normal": [0.0, 0.0, 1.0], "material": "grey"}
    tables = {
        "camera": shot | {"width": 160, "height": 90, "film_width_mm": film_mm, "film_height_mm": film_mm * 9 / 16},
        "environment": {"colour": [1.0, 1.0, 1.0]}, "planes": [plane],
        "materials": {"grey": {"kind": "diffuse", "reflectance": [0.5, 0.5, 0.5]}},
    }  # fmt: skip
    scene = scene_from_tables(tables)

    def at(focus_m: float) -> Scene:
        return replace(scene, settings=replace(scene.settings, camera=replace(scene.settings.camera, focus_m=focus_m)))

    return [Frame(k + 1, at(f), None) for k, f in enumerate(focus)]


def test_frames_at_the_extremes_are_probed() -> None:
    focus = [3.0 + 0.01 * k for k in range(40)]
    focus[17], focus[29] = 0.7, 50.0
    numbers = [f.number for f in representatives(frames(focus))]
    assert {1, 18, 30, 40} <= set(numbers) and len(numbers) == 5 and numbers == sorted(numbers)
    assert [f.number for f in representatives(frames([2.0] * 5))] == [1]  # all alike


def test_breathing_is_that_of_the_picture() -> None:
    """A lens focused by its film shows less as that moves away: near the axis, sizes go as the chief ray's reach."""
    lens = set_lens(read_lens(LENS))
    far, near = (probe(f.scene, lens, across=5) for f in frames([1e4, 0.8], 11.0, 8.0))
    found = breathing_px([near, far])
    assert found is not None
    reach = [p.exact.settings["lens_state"]["pinhole_focal_length_mm"] for p in (far, near)]
    height = np.hypot(*far.places.film_mm)
    expected = np.percentile(height * (1 - reach[0] / reach[1]) / far.asked.pixel_mm, 95)
    assert found[0] == pytest.approx(expected, rel=0.03) and found[0] > 1
    assert breathing_px([far, far]) is None


def test_a_rack_takes_as_few_fits_as_hold(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    probed: dict[int, Any] = {}

    def once(scene: Scene, at: Any, **more: Any) -> Any:
        return probed[id(scene)] if id(scene) in probed else probed.setdefault(id(scene), probe(scene, at, across=4))

    monkeypatch.setattr(module, "probe", once)
    monkeypatch.setattr(module, "shot_terms", lambda found: [8, 28])
    lens, rack = set_lens(read_lens(LENS)), frames([0.7, 0.7, 1.2])
    moved = plan_frames(rack, lens, 0.5, folder=tmp_path, target="onnx")
    assert moved.fits == 1 and [(r.first, r.last) for r in moved.runs] == [(1, 3)] and moved.probed == (1, 3)
    assert moved.runs[0].choice is not None and moved.runs[0].choice.error_px <= 0.5
    assert {"breathing", "distortion"} <= {e.name for e in moved.effects}
    drawn = plan_frames(rack, lens, 0.5, folder=tmp_path)  # as C an ideal lens costs less than anything fitted
    assert drawn.fits == 0 and [r.choice and r.choice.name for r in drawn.runs] == ["thick + ST map"]
    free = plan_frames(rack, lens, 0.0)
    assert free.fits == 0 and len(free.runs) == 1 and free.cost is not None
    assert free.runs[0].choice is not None and free.runs[0].choice.name == "exact"


def test_stretches_are_the_fewest(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A model holds a range of 1 / focus of at most 0.5: greedy stretches are as few as can be."""
    near = [0.2, 0.3, 0.65, 0.7, 0.75, 1.3, 1.85]  # 1 / m
    lens = set_lens(read_lens(LENS))
    founds: Any = [SimpleNamespace(lens=lens, asked=SimpleNamespace(shot=SimpleNamespace(focus_m=1 / v))) for v in near]

    def short(some: Any, *_: Any) -> Any:
        reach = [1 / p.asked.shot.focus_m for p in some]
        return lambda terms, costed: terms if max(reach) - min(reach) <= 0.5 + 1e-9 and terms >= 12 else None

    monkeypatch.setattr(module, "_stretch", short)
    found = list(module._stretches(founds, "render", 1.0, tmp_path, module.Work()))
    got = [sorted(near[k] for k in rows) for rows, _ in found]
    assert sorted(v for g in got for v in g) == near and all(max(g) - min(g) <= 0.5 + 1e-9 for g in got)
    assert len(got) == 4  # 1.85, 1.3, and 0.2 to 0.75 is two
    assert {choice for _, choice in found} == {12}  # the smallest that holds


def test_no_frames_are_refused() -> None:
    with pytest.raises(InputError, match="frames"):
        plan_frames([], set_lens(read_lens(LENS)), 1.0)
