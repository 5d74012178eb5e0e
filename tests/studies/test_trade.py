"""Offers, fronts and choices by time against what is known of them."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from neurolens.pictures.render.scene import scene_from_tables
from neurolens.studies.plan.candidates import Choice
from neurolens.studies.plan.costs import Work
from neurolens.studies.plan.plan import best_within, front, in_seconds, spread


def scene(**camera: object) -> dict:
    shot = {"position_m": [0.0, 0.0, 0.0], "look_at_m": [0.0, 0.0, -1.0], "focus_m": 3.0, "width": 320, "height": 180}
    return {
        "camera": {**shot, **camera},
        "environment": {"colour": [1.0, 1.0, 1.0]},
        "materials": {"grey": {"kind": "diffuse", "reflectance": [0.5, 0.5, 0.5]}},
        "planes": [{"point_m": [0.0, 0.0, -4.0], "normal": [0.0, 0.0, 1.0], "material": "grey"}],
    }


def choice(name: str, error: float, cost: float, noise: float = 1.0, light: float = 0.0, s: float = math.inf) -> Choice:
    return Choice(name, "", error, light, cost, noise, seconds=s)


def test_seconds_are_those_of_the_picture_to_the_noise_of_the_exact_lens() -> None:
    plain, coloured = choice("plain", 0.1, 50.0), replace(choice("coloured", 0.0, 30.0, 1.5), disperses=True)
    made, rays = scene_from_tables(scene(samples=100)), 320 * 180 * 100
    work = Work((1000.0, 2000.0), noise=(1.0, 1.5))
    for denoised in (False, True):
        found = SimpleNamespace(
            asked=SimpleNamespace(denoised=denoised), seen=SimpleNamespace(weight=np.ones((2, 1, 8))),
            places=SimpleNamespace(share=np.ones(1)), exact=SimpleNamespace(dispersive=True), scene=made,
        )  # fmt: skip
        tried = [plain, coloured, choice("untimed", 0, math.inf)]
        offered = {c.name: c for c in in_seconds(found, tried, work) if c.seconds < math.inf}  # type: ignore[arg-type]
        times = 1.0 if denoised else 1.5
        seconds = {"plain": 1050e-9 * rays / times, "coloured": (30 + 2000 * times) * 1e-9 * rays / times}
        assert {name: o.seconds for name, o in offered.items()} == pytest.approx(seconds)
        assert offered["coloured"].camera_seconds == pytest.approx(30e-9 * rays / times)


def test_the_front_holds_what_nothing_betters_and_time_buys_the_most_faithful() -> None:
    rows = [("a", 2, 1, 0), ("b", 1, 2, 0), ("dull", 1.5, 3, 0), ("dark", 0.1, 1.5, 0.5), ("c", 0, 9, 0)]
    offered = [choice(n, e, 0.0, light=dim, s=s) for n, e, s, dim in rows]
    assert [c.name for c in front(offered)] == ["a", "b", "c"]
    bought = {s: best_within(offered, s) for s in (0.5, 1.0, 5.0, 9.0)}
    assert [c and c.name for c in bought.values()] == [None, "a", "b", "c"]


def test_what_is_shown_holds_the_ends_and_the_chosen_one() -> None:
    many = [choice(str(k), 1 / (k + 1), 0.0, s=float(k)) for k in range(30)]
    for chosen in (0, 7, 13, 29):
        names = [c.name for c in spread(many, many[chosen], 6)]
        assert len(names) == 6 and {"0", "29", str(chosen)} <= set(names) and names == sorted(names, key=int)
    assert spread(many[:3], None, 6) == many[:3]
    beside = choice("beside", 0.5, 0.0, s=2.5)  # a choice that another camera betters is shown, too
    assert beside in spread(many, beside, 6) and spread(many[:2], beside) == [*many[:2], beside]
