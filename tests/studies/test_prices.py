"""Prices of cameras against what is known of them."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from neurolens.pictures.render.scene import scene_from_tables
from neurolens.studies.plan.candidates import Choice
from neurolens.studies.plan.costs import Work
from neurolens.studies.plan.plan import priced


def scene(**camera: object) -> dict:
    shot = {"position_m": [0.0, 0.0, 0.0], "look_at_m": [0.0, 0.0, -1.0], "focus_m": 3.0, "width": 320, "height": 180}
    return {
        "camera": {**shot, **camera},
        "environment": {"colour": [1.0, 1.0, 1.0]},
        "materials": {"grey": {"kind": "diffuse", "reflectance": [0.5, 0.5, 0.5]}},
        "planes": [{"point_m": [0.0, 0.0, -4.0], "normal": [0.0, 0.0, 1.0], "material": "grey"}],
    }


def test_seconds_are_those_of_the_picture_to_the_noise_of_the_exact_lens() -> None:
    plain, coloured = Choice("plain", "", 0.1, 0.0, 1.0, ns=50.0), Choice("coloured", "", 0.0, 0.0, 1.0, True, ns=20.0)
    made, rays = scene_from_tables(scene(samples=100)), 320 * 180 * 100
    work = Work((1000.0, 2000.0), noise=(1.0, 1.5))
    found = SimpleNamespace(
        seen=SimpleNamespace(weight=np.ones((2, 1, 8))), places=SimpleNamespace(share=np.ones(1)),
        exact=SimpleNamespace(dispersive=True), scene=made,
    )  # fmt: skip
    tried = [coloured, plain, Choice("untimed", "", 0.0, 0.0, 1.0)]
    offered = {c.name: c for c in priced(found, tried, work)}  # type: ignore[arg-type]
    # The exact lens has 1.5 times the noise of one that does not disperse: such a camera needs so many times fewer
    # paths, and twice as many where its weights are half as even.
    assert offered["plain"].seconds == pytest.approx(1050e-9 * rays / 1.5)
    assert offered["coloured"].seconds == pytest.approx(2020e-9 * rays)
    assert list(offered) == ["plain", "coloured", "untimed"] and math.isinf(offered["untimed"].seconds)
    (uneven,) = priced(found, [replace(plain, noise=2.0)], work)  # type: ignore[arg-type]
    assert uneven.seconds == pytest.approx(2 * offered["plain"].seconds)
