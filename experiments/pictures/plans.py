"""Prove plans: whether the camera chosen keeps its budget against the exact lens, and what the cheapest such one costs.

Every case is a lens and a scene at 1920 pixels across a film that the lens lights. The picture is planned first, as
`neurolens plan` does. Then the camera alone counts, which is harder on the choice: for budgets of 1, 0.25 and 0.05
pixels a plan is made for C and for onnxruntime, and all cameras are tried: all that plans know, and polynomials of more
sizes than theirs. Each is measured at places, pupil samples and wavelengths that no plan saw, and those chosen once
more in renders (`plan_errors`). A minute of a core for each case; those that are in the table are kept. Writes
plans.md, plans.json.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments import lab
from experiments.pictures import plan_errors
from neurolens.base.progress import Report
from neurolens.cameras.build import ideal_as, make_camera
from neurolens.cameras.contract import Camera
from neurolens.cameras.field import Field, field_of
from neurolens.cameras.model import OnnxCamera, load_model
from neurolens.cameras.reduced import Warped
from neurolens.models.terms import pinned_threads
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.pupils import image_radius_mm
from neurolens.optics.setting.states import set_lens
from neurolens.pictures.render.scene import Scene, load_scene
from neurolens.studies.experiment import near_limit_m
from neurolens.studies.plan import candidates as choices, footprints as prints, plan as plans
from neurolens.studies.plan.probe import COUNTED, LIGHT, Probe, effects_of

LENSES = (
    "laikin_double_gauss_50", "ogawa_zoom_70_200@135mm", "horimoto_fisheye_16", "phone_lens_6", "cooke_anamorphic_42",
    "canon_aspheric_50",
)  # fmt: skip
SCENES = ("distant", "garden", "room", "lights")  # stopped down and grey, to wide open among coloured lights
BUDGETS = (1.0, 0.25, 0.05)
TARGETS: tuple[choices.Target, ...] = ("c", "onnx")
BUDGET = 0.25  # of the plan of the whole picture
MORE_TERMS = (10, 19)  # besides those of plans
_WIDTH = 1920
_LIT = 0.95  # of the image circle that the film's corners reach
_LARGEST_MM = 36.0
_PIECE_PX, _SAMPLES, _SEEDS = 40, 24, 4
_TRIED_PX = 1.5  # error in the plan's places up to which a camera may hold at others, and is timed
_UNSURE, _FEWEST = 0.5, 3  # noise over the budget beyond which a piece tells nothing; pieces that decide
_TURNS = 3  # in which two cameras are timed again
_COST = 1.25  # times that of the cheapest camera that holds, which the one chosen may cost
_EFFECT = 0.2, 0.02  # relative, or in pixels: what the probe's effects may be wrong by


@dataclass(frozen=True)
class Case:
    """A lens, after "@" its zoom state, and a scene."""

    lens: str
    scene: str

    @property
    def name(self) -> str:
        """For files and --only."""
        return f"{self.lens}-{self.scene}"

    @property
    def state(self) -> str | None:
        """The state of the zoom."""
        return self.lens.partition("@")[2] or None

    @property
    def file(self) -> Path:
        """The file of the lens."""
        return lab.LENSES / f"{self.lens.partition('@')[0]}.toml"

    def load(self) -> tuple[Lens, Scene]:
        """The lens in its state, and the scene on a film that suits it."""
        lens = set_lens(read_lens(self.file), zoom=self.state)
        return lens, suited(load_scene(lab.SCENES / f"{self.scene}.toml"), lens)

    def shipped(self) -> list[Path]:
        """Models of this state."""
        stem = f"{self.file.stem}-{self.state}" if self.state else self.file.stem
        return sorted(lab.MODELS.glob(f"{stem}.*.onnx"))


CASES = tuple(Case(lens, scene) for lens in LENSES for scene in SCENES)


def suited(scene: Scene, lens: Lens, f_number: float | None = None, focus_m: float | None = None) -> Scene:
    """A scene at 1920 x 1080 pixels on a film that the lens lights, as far away as it has to be in focus.

    Args:
        f_number: as far as the lens opens; else as the scene asks, and of "lights", at night and near, wide open.
        focus_m: distance of what is in focus; else that of the scene, but no nearer than the lens focuses.
    """
    shot = scene.settings.camera
    across = min(2 * _LIT * image_radius_mm(lens)[0] * 16 / math.hypot(16, 9), _LARGEST_MM)
    focus = max(shot.focus_m, near_limit_m(lens)) if focus_m is None else focus_m
    eye, target = np.array(shot.position_m), np.array(shot.look_at_m)
    x, y, z = (float(v) for v in eye - (focus - shot.focus_m) * (target - eye) / np.linalg.norm(target - eye))
    widest = first_order(lens).f_number
    asked = f_number or (0.0 if scene.name == "lights" else shot.f_number or widest)
    camera = replace(
        shot, position_m=(x, y, z), focus_m=focus, f_number=max(asked, widest), film_mm=(across, across * 9 / 16),
        width=_WIDTH, height=_WIDTH * 9 // 16,
    )  # fmt: skip
    return replace(scene, settings=replace(scene.settings, camera=camera))


# ---- One case. -------------------------------------------------------------------------------------------------------


def measure_case(case: Case, folder: Path, report: Report) -> dict[str, Any]:
    """Plan, try all, measure; see the module."""
    lens, scene = case.load()
    began, clock = os.times(), time.perf_counter()
    whole = plans.plan(scene, lens, BUDGET, models=case.shipped(), folder=folder / "whole")
    took = {"plan_s": sum(os.times()[:4]) - sum(began[:4]), "plan_clock_s": time.perf_counter() - clock}
    probed = whole.probed
    asked, own = probed.asked, probed.shot
    shot = Shot(own.film_mm, own.focus_m, asked.f_number, zoom=case.state, wavelength_nm=own.wavelength_nm)
    exact = make_camera(lens.path, shot)  # as in a render: a plan's own has another outline of pupils
    places = plan_errors.fresh_places(scene, exact, probed.small.mean((0, 1)))
    fresh = Fresh(exact, places, plan_errors.fresh_prints(exact, places))
    report(0.1)
    rows: dict[str, dict[str, Any]] = {}
    chosen: dict[str, choices.Choice] = {}
    decisions: list[dict[str, Any]] = []
    sizes, fitted = list[Path](), list[Path]()
    for number, target in enumerate(TARGETS):
        picks = dict[float, tuple[choices.Choice, ...]]()
        for budget in sorted(BUDGETS):  # what was fitted for the least budget serves all, and all targets
            known, place = ([*case.shipped(), *fitted], None) if fitted else (case.shipped(), folder)
            picks[budget] = choices.candidates(probed, budget, target, models=known, folder=place)
            fitted += [folder / f"{c.name}.onnx" for c in picks[budget] if c.how == choices.FITTED]
        # of a camera that was tried for several budgets, what is timed
        every = {c.name: c for c in sorted(sum(picks.values(), ()), key=lambda c: -c.ns)}
        report(0.2 + 0.3 * number)
        every |= {c.name: c for c in _more(probed, target, folder, every, sizes, case.shipped())}
        report(0.3 + 0.3 * number)
        for choice in every.values():
            row = rows.setdefault(choice.name, {"plan_px": choice.error_px, "plan_light": choice.light_error})
            row[f"cost_{target}"] = _cost(choice) if math.isfinite(choice.ns) else None
            if "px" not in row and row["plan_px"] <= _TRIED_PX:
                camera = _held(choice, probed, case.state, exact)
                apart, light = plan_errors.by_rays(camera, exact, places, fresh.seen, asked.pixel_mm, BUDGETS)
                if isinstance(camera, OnnxCamera):
                    light = light + prints.light_beside(camera, places) / np.maximum(fresh.seen.light, 1e-30)
                row |= {"px": _counted(apart), "light": _counted(light)}
        for budget in BUDGETS:
            best = min((c for c in picks[budget] if c.meets(budget)), key=_cost, default=None)
            decisions.append(_decision(target, budget, best, list(every.values()), rows, probed))
            if best is not None and best.name != "exact":
                chosen.setdefault(best.name, best)
    report(0.7)
    changes = _by_renders(case, scene, probed, fresh, list(chosen.values()))
    for decision in decisions:
        decision["render"] = _seen_in(changes.get(decision["chosen"]), decision["budget_px"])
    dense = replace(probed, places=places, seen=fresh.seen, thin_seen=plan_errors.fresh_prints(_thin(probed), places))
    facts = {"lens": case.lens, "scene": case.scene, "f_number": probed.asked.f_number}
    facts |= {"pixel_um": 1e3 * probed.asked.pixel_mm, "nearest_m": probed.asked.nearest_m}
    assert whole.best is not None
    held = whole.best.name == choices.EXACT or _holds(rows, whole.best.name, BUDGET)
    facts["whole"] = took | {"chosen": whole.best.name, "holds": held, "picture_s": whole.best.seconds}
    return facts | {"effects": _effects(probed, dense), "cameras": rows, "decisions": decisions}


def _cost(choice: choices.Choice) -> float:
    """What the camera alone takes to equal noise."""
    return choice.ns * choice.noise


def _holds(rows: Mapping[str, Any], name: str, budget_px: float) -> bool:
    """Whether a camera keeps a budget at fresh places."""
    return bool(rows[name].get("px", math.inf) <= budget_px and rows[name]["light"] <= LIGHT)


def _more(
    probed: Probe,
    target: choices.Target,
    folder: Path,
    tried: Mapping[str, choices.Choice],
    made: list[Path],
    shipped: Sequence[Path],
) -> Iterator[choices.Choice]:
    """Models that ship and polynomials of the shot of all sizes that the plan tried without their cost, or not at all,
    made as it does.

    No polynomials are larger than what has half of the least budget: they cost more. `made` keeps files for the next
    target.
    """

    def costed(file: Path) -> choices.Choice | None:
        choice = tried.get(file.stem)
        if choice is not None and (math.isfinite(choice.ns) or not choice.meets(_TRIED_PX)):
            return choice
        judged = choices.model_judged(probed, file, target)
        return choices.timed(judged, probed) if judged and judged.meets(_TRIED_PX) else judged

    yield from (c for c in map(costed, shipped) if c is not None)
    fit: Any = None
    for terms in sorted({*choices.TERMS, *MORE_TERMS}):
        file = folder / f"{Path(probed.lens.path).stem}.shot-ols-{terms}.onnx"
        if file.stem not in tried and file not in made:
            fit = fit or choices.shot_fits(probed, folder)
            made.append(fit(terms))
        choice = costed(file)
        if choice is not None:
            yield choice
            if choice.error_px < min(BUDGETS) / 2:
                return


def _held(choice: choices.Choice, probed: Probe, state: str | None, exact: Any) -> Camera:
    """The camera of a plan; of a model within the outline of the exact lens's pupil, see `candidates.model_judged`."""
    if not choice.camera.endswith(".onnx"):
        return camera_of(choice, probed, state)
    return OnnxCamera(
        load_model(choice.camera), replace(probed.shot, runtime="onnxruntime"), outline=exact.film.outline
    )


def camera_of(choice: choices.Choice, probed: Probe, state: str | None, smooth: bool = False) -> Camera:
    """The camera that a plan names, as a render makes it; with `smooth`, a warped picture by tables of the field."""
    own = probed.shot
    shot = Shot(own.film_mm, own.focus_m, probed.asked.f_number, wavelength_nm=own.wavelength_nm)
    if choice.camera.endswith(".onnx"):
        return make_camera(choice.camera, shot)
    if "ST map" not in choice.name:
        return make_camera(choice.camera, replace(shot, zoom=state))
    flat = ideal_as(f"{choice.name.partition(' ')[0]}:", probed.exact.lens, Shot(own.film_mm, own.focus_m))
    return (WarpedByTables if smooth else Warped)(flat, probed.exact, own.focus_m)


class WarpedByTables(Warped):
    """A warped camera with tables of both fields, which take seconds and then serve the points of a whole picture."""

    def __init__(self, flat: Camera, camera: Camera, focus_m: float) -> None:
        self._fields: dict[int, Field] = {}
        super().__init__(flat, camera, focus_m)
        wide = copy(flat)
        width, height = self.sides * self.film_mm
        wide.film_mm = float(width), float(height)
        self._fields = {id(camera): field_of(camera, focus_m), id(flat): field_of(wide, focus_m)}

    def _place_and_light(self, camera: Camera, point: Any) -> tuple[Any, Any]:
        if field := self._fields.get(id(camera)):
            return field.ideal(point), field.relative_light(point)
        return super()._place_and_light(camera, point)


def _thin(probed: Probe) -> Camera:
    return ideal_as("thin:", probed.exact.lens, Shot(probed.shot.film_mm, probed.shot.focus_m))


def _counted(value: Any) -> float:
    return float(np.percentile(value, COUNTED))


def _decision(
    target: str,
    budget: float,
    best: choices.Choice | None,
    every: Sequence[choices.Choice],
    rows: Mapping[str, Any],
    probed: Probe,
) -> dict[str, Any]:
    """The chosen camera, whether it holds at fresh places, and the cheapest camera that does."""
    costs = {c.name: _cost(c) for c in every}
    good = [c for c in every if math.isfinite(_cost(c)) and _holds(rows, c.name, budget)]
    least = min(good, key=_cost, default=None)
    cheapest = least and least.name
    made: dict[str, Any] = {"target": target, "budget_px": budget, "chosen": best and best.name, "cheapest": cheapest}
    if best is None:
        return made | {"holds": cheapest is None, "px": None, "ratio": None}
    ratio = costs[best.name] / costs[cheapest] if cheapest else None
    if least is not None and cheapest != best.name:  # timed again by turns, for other work may have slowed either
        turns = [[_cost(choices.timed(c, probed)) for c in (best, least)] for _ in range(_TURNS)]
        ratio = float(np.divide(*np.min(turns, axis=0)))
    found = {"px": rows[best.name]["px"], "light": rows[best.name]["light"]}
    return made | {"holds": _holds(rows, best.name, budget), "ratio": ratio, **found}


@dataclass(frozen=True)
class Fresh:
    """The exact lens as a render has it, places that no plan saw, and its footprints there."""

    exact: Any
    places: prints.Places
    seen: prints.Footprints

    def blur_px(self, film_mm: Any, pixel_mm: float) -> Any:
        """RMS distance from the centroid of the footprints nearest to film points [2, K]."""
        blur = prints.blur_mm(self.seen, self.places.share) / 2 / pixel_mm
        apart = np.hypot(*(self.places.film_mm[:, :, None] - film_mm[:, None, :]))
        return blur[apart.argmin(0)]


def _by_renders(
    case: Case, scene: Scene, probed: Probe, fresh: Fresh, chosen: Sequence[choices.Choice]
) -> dict[str | None, list[plan_errors.Moved]]:
    """The changes that some cameras make to pieces of the picture."""
    centres = plan_errors.pieces_of(scene, fresh.exact, _PIECE_PX)
    blur = fresh.blur_px(centres, probed.asked.pixel_mm)
    truth = plan_errors.rendered(scene, fresh.exact, centres, _PIECE_PX, _SAMPLES, _SEEDS)
    made: dict[str | None, list[plan_errors.Moved]] = {}
    for choice in chosen:
        camera = camera_of(choice, probed, case.state, smooth=True)
        other = plan_errors.rendered(scene, camera, centres, _PIECE_PX, _SAMPLES, _SEEDS)
        pairs = [(truth[:, k], other[:, k], float(blur[k])) for k in range(len(blur))]
        made[choice.name] = [plan_errors.moved(*pair) for pair in pairs]
    return made


def _seen_in(pieces: Sequence[plan_errors.Moved] | None, budget_px: float) -> dict[str, Any] | None:
    """The counted percentile of the pieces whose noise lets a budget be told; None where too few do."""
    sure = [t for t in pieces or () if t.noise_px < _UNSURE * budget_px]
    if len(sure) < _FEWEST:
        return None
    noise = float(np.median([t.noise_px for t in sure]))
    return {"pieces": len(sure), "px": _counted([t.px for t in sure]), "noise_px": noise}


def _effects(probed: Probe, dense: Probe) -> list[dict[str, Any]]:
    """Each effect by the probe and at fresh places."""
    truth = {e.name: e for e in effects_of(dense, 0.0, stray=False)}  # stray light is the same at any places
    return [
        {"name": e.name, "unit": e.unit, "probe": e.worth, "fresh": truth[e.name].worth}
        for e in effects_of(probed, 0.0, stray=False)
        if e.name not in ("diffraction", "flare")
    ]


def effect_holds(effect: Mapping[str, Any]) -> bool:
    """Whether the probe is right about an effect."""
    wrong = abs(effect["probe"] - effect["fresh"])
    return bool(wrong <= max(_EFFECT[0] * effect["fresh"], _EFFECT[1]))


# ---- The page. -------------------------------------------------------------------------------------------------------

_HEAD = """\
# Plans against all cameras tried

{cases} of {all} cases, those measured so far: a lens and a scene ("distant": f/11, one line of light; "lights": wide
open, near, coloured), 1920 pixels across the film. A budget is kept where 95% of the picture keep it, at places, pupil
samples and wavelengths that the plan did not see. Made by `python -m experiments plans`."""
_PICTURES_HEAD = """\
The plan of a picture for our renderer, at 0.25 px, in {whole} of {cases} cases: where it is missing, the rows below
are an earlier version's. Seconds of the picture and of the plan are of one thread's processor, those of the picture to
the noise of the exact lens with the scene's samples. The clock ran while other work did."""
_ALONE_HEAD = """\
The camera alone, which is harder on the choice, in C and in onnxruntime. *px*: error of the camera chosen; *render*:
the same from renders of pieces of the picture, as far as it is above the noise; a dash where too few pieces can tell.
*times*: its time over that of the cheapest camera that holds among all that were tried ({tried}, polynomials of {sizes}
sizes among them)."""
_COLUMNS = lab.columns(
    ("lens", "lens"), ("scene", "scene"), ("f/", "f_number", ".3g"), ("pixel um", "pixel_um", ".3g"), ("for", "target"),
    ("budget px", "budget_px", "g"), ("chosen", lambda r: (r["chosen"] or "none").rpartition(".")[2]),
    ("px", "px", ".2g"), ("light %", "light", ".2g", 100), ("render px", "render.px", ".2g"),
    ("noise", "render.noise_px", ".1g"), ("holds", lambda r: "yes" if r["holds"] else "no"),
    ("cheapest", lambda r: (r["cheapest"] or "none").rpartition(".")[2]), ("times", "ratio", ".2f"),
)  # fmt: skip


def _whole(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The cases whose picture was planned, which earlier ones were not."""
    return [row for row in rows if "whole" in row]


def _share(row: Mapping[str, Any]) -> float:
    """The time of a plan over that of its picture."""
    return float(row["whole"]["plan_s"] / row["whole"]["picture_s"])


_PICTURES = lab.columns(
    ("lens", "lens"), ("scene", "scene"), ("camera at 0.25 px", "whole.chosen"),
    ("holds", lambda r: "yes" if r["whole"]["holds"] else "no"), ("picture s", "whole.picture_s", ".0f"),
    ("plan s", "whole.plan_s", ".1f"), ("by the clock", "whole.plan_clock_s", ".1f"),
    ("plan over picture", _share, ".3f"),
)  # fmt: skip


def decisions_of(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """All decisions with their case."""
    kept = ("lens", "scene", "f_number", "pixel_um")
    return [{k: r[k] for k in kept} | d for r in rows for d in r["decisions"]]


def render_holds(decision: Mapping[str, Any]) -> bool:
    """Whether renders agree that a budget is kept, within twice their noise."""
    told = decision["render"] or {}
    return "px" not in told or told["px"] <= decision["budget_px"] + 2 * told["noise_px"]


def goals(rows: Sequence[Mapping[str, Any]]) -> list[lab.Goal]:
    """The goals of the page."""
    made = decisions_of(rows)
    if not made:
        return []
    told = [d for d in made if d["render"] and "px" in d["render"]]
    effects = [e for r in rows for e in r["effects"]]
    ratios = [d["ratio"] for d in made if d["ratio"] is not None and d["holds"]]
    share = lambda kept: float(np.mean(list(kept))) if kept else None  # noqa: E731
    return [
        lab.Goal("budgets kept at fresh places, share", 0.95, share([d["holds"] for d in made]), at_least=True),
        lab.Goal("budgets kept in renders, share", 0.95, share([render_holds(d) for d in told]), at_least=True),
        lab.Goal("cost over the cheapest that holds, largest", _COST, max(ratios, default=None)),
        lab.Goal(f"the same, share within {_COST}", 0.95, share([r <= _COST for r in ratios]), at_least=True),
        lab.Goal("effects within 20% or 0.02 px, share", 1.0, share([effect_holds(e) for e in effects]), at_least=True),
        lab.Goal("time of a plan over that of its picture, largest", 0.1, max(map(_share, _whole(rows)), default=None)),
    ]


def page(rows: Sequence[Mapping[str, Any]]) -> str:
    """The tables."""
    cases = [({"lens": r["lens"], "scene": r["scene"]}, e) for r in rows for e in r["effects"]]
    wrong = [case | effect for case, effect in cases if not effect_holds(effect)]
    tried, sizes = [len(r["cameras"]) for r in rows] or [0], len({*choices.TERMS, *MORE_TERMS})
    pictures = _PICTURES_HEAD.format(whole=len(_whole(rows)), cases=len(rows))
    alone = _ALONE_HEAD.format(tried=f"{min(tried)} to {max(tried)}", sizes=sizes)
    named = lab.columns(
        ("lens", "lens"), ("scene", "scene"), ("effect", "name"), ("probe", "probe", ".3g"), ("fresh", "fresh", ".3g"),
        ("", "unit"),
    )  # fmt: skip
    return lab.page(
        _HEAD.format(cases=len(rows), all=len(CASES)), lab.goal_table("goal", goals(rows)),
        pictures, lab.table(_PICTURES, _whole(rows)), alone, lab.table(_COLUMNS, decisions_of(rows), "–"),
        "Effects that the probe has wrong:" if wrong else "", lab.table(named, wrong) if wrong else "",
    )  # fmt: skip


OPTIONS = (
    lab.option("--only", metavar="TEXT", default="", help="cases whose LENS-SCENE holds this text"),
    lab.AGAIN,
    lab.option("--models", metavar="DIR", type=Path, default=Path("runs/plans"), help="for them (default: runs/plans)"),
    lab.out(),
)


def run(args: argparse.Namespace) -> None:
    """Measure what is missing, and write the tables after each case."""
    lab.quiet_glasses()
    cases = {case.name: case for case in lab.chosen(CASES, lambda c: c.name, args.only, "plans")}
    with pinned_threads():
        lab.resume(
            args, "plans", cases, lambda case, report: measure_case(case, args.models / case.name, report),
            lambda r: f"{r['lens']}-{r['scene']}", page, listed="cases", again=args.restart, seconds=90.0,
            order=[case.name for case in CASES],
        )  # fmt: skip
