"""Offers, fronts and choices by time against what is known of them, and the page that a trade leaves."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from neurolens.base.errors import InputError
from neurolens.base.tomlfile import format_toml
from neurolens.cli import main
from neurolens.plan import plan as traded
from neurolens.plan.candidates import Choice
from neurolens.plan.costs import Work
from neurolens.plan.plan import Offer, best_within, front, offers, spread
from neurolens.readers.lensfile import read_lens
from neurolens.render.scene import scene_from_tables

LENS = "lenses/cooke_triplet_50.toml"  # of glass that absorbs


def scene(**camera: object) -> dict:
    shot = {"position_m": [0.0, 0.0, 0.0], "look_at_m": [0.0, 0.0, -1.0], "focus_m": 3.0, "width": 320, "height": 180}
    return {
        "camera": {**shot, **camera},
        "environment": {"colour": [1.0, 1.0, 1.0]},
        "materials": {"grey": {"kind": "diffuse", "reflectance": [0.5, 0.5, 0.5]}},
        "planes": [{"point_m": [0.0, 0.0, -4.0], "normal": [0.0, 0.0, 1.0], "material": "grey"}],
    }


def choice(name: str, error: float, cost: float, noise: float = 1.0, light: float = 0.0) -> Choice:
    return Choice(name, "", error, light, cost, noise)


def test_seconds_are_those_of_the_picture_to_the_noise_of_the_exact_lens() -> None:
    plain, coloured = choice("plain", 0.1, 50.0), replace(choice("coloured", 0.0, 30.0, 1.5), disperses=True)
    made, rays = scene_from_tables(scene(samples=100)), 320 * 180 * 100
    work = Work((1000.0, 2000.0), noise=(1.0, 1.5))
    for denoised in (False, True):
        found = SimpleNamespace(
            asked=SimpleNamespace(denoised=denoised), seen=SimpleNamespace(weight=np.ones((2, 1, 8))),
            places=SimpleNamespace(share=np.ones(1)), exact=SimpleNamespace(dispersive=True),
        )  # fmt: skip
        tried = [plain, coloured, choice("untimed", 0, math.inf)]
        offered = {o.choice.name: o for o in offers(made, found, tried, work)}  # type: ignore[arg-type]
        times = 1.0 if denoised else 1.5
        seconds = {"plain": 1050e-9 * rays / times, "coloured": (30 + 2000 * times) * 1e-9 * rays / times}
        assert {name: o.seconds for name, o in offered.items()} == pytest.approx(seconds)
        assert offered["coloured"].camera == pytest.approx(30e-9 * rays / times)


def test_the_front_holds_what_nothing_betters_and_time_buys_the_most_faithful() -> None:
    rows = [("a", 2, 1, 0), ("b", 1, 2, 0), ("dull", 1.5, 3, 0), ("dark", 0.1, 1.5, 0.5), ("c", 0, 9, 0)]
    offered = [Offer(choice(n, e, 0.0, light=dim), s) for n, e, s, dim in rows]
    assert [o.choice.name for o in front(offered)] == ["a", "b", "c"]
    bought = {s: best_within(offered, s) for s in (0.5, 1.0, 5.0, 9.0)}
    assert [o and o.choice.name for o in bought.values()] == [None, "a", "b", "c"]


def test_what_is_shown_holds_the_ends_and_the_chosen_one() -> None:
    many = [Offer(choice(str(k), 1 / (k + 1), 0.0), float(k)) for k in range(30)]
    for chosen in (0, 7, 13, 29):
        names = [o.choice.name for o in spread(many, many[chosen], 6)]
        assert len(names) == 6 and {"0", "29", str(chosen)} <= set(names) and names == sorted(names, key=int)
    assert spread(many[:3], None, 6) == many[:3]
    beside = Offer(choice("beside", 0.5, 0.0), 2.5)  # a choice that another camera betters is shown, too
    assert beside in spread(many, beside, 6) and spread(many[:2], beside) == [*many[:2], beside]


@pytest.mark.whole  # the choice itself is below
def test_a_trade_leaves_one_page_that_needs_nothing_else(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, lens, folder = tmp_path / "scene.toml", tmp_path / "own.toml", tmp_path / "trade"
    film = {"film_width_mm": 18.0, "film_height_mm": 10.125, "samples": 4, "f_number": 5.6}
    file.write_text(format_toml(scene(width=64, height=36, **film)))
    lens.write_bytes(Path(LENS).read_bytes())  # no model of it ships
    asked = ["--lens", str(lens), "--budget", "0.05px", "--no-fit", "--samples", "1", "--quiet"]
    assert main(["plan", str(file), "--trade", *asked, "-o", str(folder)]) == 0
    said, told = capsys.readouterr().out, json.loads((folder / "trade.json").read_text())
    page = (folder / "trade.html").read_text()
    sources = re.findall(r"(?:src|href)=[\"']([^\"']*)", page)
    assert sources and all(source.startswith("data:image/png;base64,") for source in sources)
    assert page.count("<img") == 2 and "http" not in page and "<script" not in page
    cameras = {c["name"]: c for c in told["cameras"]}
    assert told["chosen"] in told["front"] and cameras["exact"]["error_px"] == 0 and cameras["exact"]["flip"] == 0
    seconds, errors = ([cameras[n][k] for n in told["front"]] for k in ("seconds", "error_px"))
    assert seconds == sorted(seconds) and errors == sorted(errors, reverse=True) and cameras["exact"]["seconds"] > 0
    chosen = cameras[told["chosen"]]
    assert re.search(rf"picture takes ~?{chosen['seconds']:.3g} s", said) and "Half of that buys" in said
    assert 0 < chosen["camera_seconds"] < chosen["seconds"] and told["chosen"] in told["alike"]
    (row,) = (line for line in said.splitlines() if line.startswith("*  "))
    assert f"{chosen['seconds']:.3g}" in row.replace("~", " ").split()  # advice, table and plot use one measurement
    held = [c["seconds"] for c in told["cameras"] if c["error_px"] <= 0.05 and c["light_error"] <= 0.01]
    assert chosen["seconds"] <= 1.2 * min(held)  # nothing within the budget is surely faster to equal noise


@pytest.mark.whole  # the choice itself is above
def test_a_plan_for_a_time_takes_the_most_faithful_camera_that_fits(tmp_path: Path) -> None:
    file = tmp_path / "scene.toml"
    file.write_text(format_toml(scene(width=64, height=36, film_width_mm=18.0, film_height_mm=10.125, samples=4)))
    asked = ["plan", str(file), "--lens", LENS, "--no-fit", "--quiet", "-o", str(tmp_path / "plan"), "--budget"]
    assert main([*asked, "1e6s"]) == 0
    told = json.loads((tmp_path / "plan" / "plan.json").read_text())
    assert told["best"]["name"] == "exact" and told["budget_s"] == 1e6 and told["budget_px"] == 0
    assert main([*asked, "20s", "--for", "glsl"]) == 2  # no time is known


def test_a_plan_for_flip_takes_the_cheapest_camera_that_looks_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = scene_from_tables(scene(width=64, height=36, film_width_mm=18.0, film_height_mm=10.125, samples=4))
    seen, priced = {}, traded._priced(shown, read_lens(LENS), 0.0)
    monkeypatch.setattr(traded, "_priced", lambda *args: priced)  # once for all budgets
    for budget in (0.0, 0.05, 1.0):
        seen[budget] = traded.plan_seen(shown, read_lens(LENS), budget).best
        assert seen[budget] is not None and seen[budget].flip <= budget
    right = [c.cost for c in priced[0].choices if c.light_error <= 0.01]
    assert seen[0.0].name == "exact" and seen[1.0].cost == min(right) <= seen[0.05].cost <= seen[0.0].cost
    for wrong in ({"flip_budget": 1.5}, {"flip_budget": 0.1, "afterwards": ("distortion",)}):
        with pytest.raises(InputError):
            traded.plan_seen(shown, read_lens(LENS), **wrong)
