"""The camera for a scene by a budget of error, time or visible difference; and the trade of error against time.

A camera's error is the distance of its footprints from the exact lens's in pixels, and of its light, at the places of a
scene that a `probe` finds; both count where they are largest but for 5% of the picture. Its cost is the time of a ray
in the target named, times the noise of its weights: see `costs`. In C and onnxruntime it is measured here, with one
thread; for shaders it is counted. The exact lens is chosen where the cheapest camera saves too little.

Seconds are of one thread, for the scene's own size and samples. They are those that a camera adds to a camera that
costs nothing and whose rays all weigh the same: the time of its own rays, and the scene's time for the further rays
that its noise asks for. The scene's time for a ray is measured by a small picture in our renderer; in other targets the
camera alone counts, in Cycles under a white sky.
"""

from __future__ import annotations

import bisect
import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.base.errors import InputError
from neurolens.base.lensname import split_kind
from neurolens.base.progress import Report
from neurolens.base.records import pareto_front
from neurolens.base.settings import to_toml
from neurolens.base.tomlfile import format_toml
from neurolens.cameras.contract import Camera, FloatArray
from neurolens.lens.prescription import Lens
from neurolens.plan.candidates import EXACT, PAIRS, Choice, Target, camera_of, candidates, shot_domain
from neurolens.plan.costs import UNIT, ns_a_ray, rest_ns, small
from neurolens.plan.probe import LIGHT, Effect, Probe, SceneNeeds, effects_of, probe
from neurolens.render.renderer import render
from neurolens.render.scene import Scene
from neurolens.study.advice import recommended
from neurolens.study.experiment import DomainChoice, EvaluationChoice, Experiment, LensChoice
from neurolens.study.image import Image, flip_map

_SHOT_KEYS = "film_mm", "focus_m", "f_number", "wavelength_nm"  # settings of the shot in `Plan.to_dict`
_ACROSS, _SAMPLES = 240, 16  # of pictures
_STRIPS, _STRIP_ROWS, _STRIP_PATHS = 3, 16, 2_000_000  # of a picture: their number, least rows, paths of all
_SHOWN = 8  # most of them, beside the exact lens
_BUDGETS = (1.0, 0.25, 0.05)  # that polynomials are fitted for, besides the one asked for


@dataclass(frozen=True)
class Plan:
    """A scene's needs, the effects in falling order of worth, every camera tried by rising cost, the one to use.

    Attributes:
        budget_s, budget_flip: seconds, or FLIP difference, of a plan for those, whose `budget_px` is then the error of
            the best camera.
        unit: of costs: "ns" or, where no time is known, "operations". domain: of models that are fitted.
        rest: cost of a path besides its camera, in the same unit; 0 where the camera alone counts.
    """

    asked: SceneNeeds
    budget_px: float
    budget_s: float | None
    target: Target
    unit: str
    domain: DomainChoice
    effects: tuple[Effect, ...]
    choices: tuple[Choice, ...]
    best: Choice | None
    probed: Probe
    budget_flip: float | None = None
    rest: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """JSON-able: all fields but `probed`."""
        fields = asdict(replace(self, probed=None))  # type: ignore[arg-type]
        del fields["probed"]
        shot = fields["asked"].pop("shot")
        fields["asked"] = {name: shot[name] for name in _SHOT_KEYS} | fields["asked"]
        return fields

    def to_toml(self, lens: Lens, folder: Path) -> str:
        """The text of a file in a folder that `render` and `export` take for the best camera, and `train` as the
        experiment that fits it, where it is a model of the shot. Paths in it are relative to the folder."""
        best = self.best
        assert best is not None
        kind, path = split_kind(best.camera)
        camera, title = f"{kind}{os.path.relpath(path, folder)}", f"{lens.name}: {best.name}"
        if best.settings is None:
            return format_toml({"title": title, "camera": camera})
        file, asked = Path(os.path.relpath(lens.path, folder)), self.asked
        choice = LensChoice(file, zoom=asked.zoom, f_number=asked.f_number)
        checks = EvaluationChoice(vignetting_rays=50_000, rounds=0, compile_exact=False)
        return to_toml(Experiment(title, choice, (best.settings,), self.domain, PAIRS, checks, camera=camera))


def plan(
    scene: Scene, lens: Lens, budget_px: float, *, target: Target = "render", models: Sequence[Path] = (),
    folder: Path | None = None, explain: bool = False, report: Report | None = None, **look: Any,
) -> Plan:  # fmt: skip
    """The cheapest camera for a scene whose error stays within a budget, or the exact lens where that one saves too
    little (`advice.recommended`). In our renderer the rest of the picture counts, too.

    Args:
        lens: as its file has it. budget_px: error of place and blur in pixels of the scene's picture.
        target: what runs the camera: our renderer with all it has, compiled C, onnxruntime, Blender's Cycles (osl), or
            a renderer in GLSL.
        models: exported models of this lens to try. folder: where models fitted for the shot go; None fits none.
        explain: whether cameras beyond the budget are compiled and timed, too; else their cost is infinite.
        look: further arguments of `probe`: zoom, and what is made of the picture later.

    Raises:
        InputError: a budget that is negative or no number; as `probe`.
    """
    if not budget_px >= 0:
        raise InputError("plan", "budget_px", budget_px, "0 or more pixels")
    probed = probe(scene, lens, **look)
    rest = rest_of(scene, probed, target)
    folder = folder if explain or not exact_suffices(probed, rest) else None
    tried = candidates(probed, (budget_px,), target, models=models, folder=folder, explain=explain, report=report)
    return decided(probed, tried, budget_px, target, rest)


def rest_of(scene: Scene, probed: Probe, target: Target) -> float:
    """Cost of a path besides its camera: in our renderer by a small picture, in other targets 0."""
    return rest_ns(scene, probed.exact) if target == "render" else 0.0


def exact_suffices(probed: Probe, rest: float) -> bool:
    """Whether not even a camera that costs nothing would save enough, so that nothing needs to be fitted."""
    exact = ns_a_ray(probed.exact, probed.places)["min"] if rest else math.inf
    return recommended((0.0,), float, exact, rest) == exact


def best_of(within: Sequence[Choice], rest: float | None) -> Choice | None:
    """The camera to use of those within a budget; `rest` as for `decided`."""
    exact = next((c for c in within if c.name == EXACT and math.isfinite(c.cost)), None)
    return recommended(within, lambda c: c.cost, None if rest is None else exact, rest or 0.0)


def decided(
    probed: Probe, tried: Sequence[Choice], budget_px: float, target: Target, rest: float | None = None
) -> Plan:
    """The plan for a budget, from candidates that serve it.

    Args:
        rest: cost of a path besides its camera; None chooses the cheapest camera, whatever it saves.
    """
    ranked = tuple(replace(c, within=c.meets(budget_px)) for c in sorted(tried, key=lambda c: c.cost))
    best = best_of([c for c in ranked if c.within], rest)
    effects = effects_of(probed, budget_px)
    return Plan(
        probed.asked, budget_px, None, target, UNIT[target], shot_domain(probed), effects, ranked, best, probed,
        rest=rest or 0.0,
    )  # fmt: skip


@dataclass(frozen=True)
class Offer:
    """A camera with the seconds of one thread that it adds (10^9 operations, where no time is known), by the least of
    its timed calls; by their median it takes `more` than that."""

    choice: Choice
    seconds: float
    more: float = 0.0


@dataclass(frozen=True)
class CameraPicture:
    """A camera's small picture [H, W, 3], linear, and its FLIP from the exact lens's of the same random numbers."""

    offer: Offer
    rgb: FloatArray
    difference: Image

    @property
    def flip(self) -> float:
        """The mean of the differences."""
        return float(self.difference.mean())


@dataclass(frozen=True)
class Trade:
    """Every camera that was priced, by rising seconds; the plan for the budget; and pictures of those to look at.

    Attributes:
        base: time of the scene itself. unit: of it and of `Offer.seconds`. samples: a pixel of the pictures.
        exact: the lens's picture.
    """

    plan: Plan
    offered: tuple[Offer, ...]
    base: float
    unit: str
    samples: int
    exact: FloatArray
    shown: tuple[CameraPicture, ...]

    @property
    def front(self) -> list[Offer]:
        """The cameras that no other betters, see `front`."""
        return front(self.offered)

    @property
    def chosen(self) -> Offer | None:
        """The plan's camera."""
        return next((o for o in self.offered if self.plan.best is not None and o.choice == self.plan.best), None)

    @property
    def half(self) -> Offer | None:
        """The best camera for half of the seconds that the chosen one adds."""
        return None if self.chosen is None else best_within(self.offered, self.chosen.seconds / 2)


def _priced(
    scene: Scene, lens: Lens, budget_px: float, *, target: Target = "render", models: Sequence[Path] = (),
    folder: Path | None = None, report: Report | None = None, **look: Any,
) -> tuple[Plan, list[Offer]]:  # fmt: skip
    """A plan in which every camera has its cost, and its cameras by rising seconds; arguments as for `plan`."""
    say = report or (lambda done, left=None: None)
    probed = probe(scene, lens, **look)
    tried = candidates(
        probed, (*_BUDGETS, budget_px), target, models=models, folder=folder, explain=True,
        report=lambda done, left=None: say(0.5 * done),
    )  # fmt: skip
    rest = rest_of(scene, probed, target)
    made = decided(probed, tried, budget_px, target, rest)
    return made, offers(scene, probed, made.choices, rest)


def trade(scene: Scene, lens: Lens, budget_px: float, *, samples: int = _SAMPLES, **options: Any) -> Trade:
    """Every camera for a scene with its error and its seconds, and pictures of those that no other betters.

    Other arguments and errors as for `plan`.
    """
    if not budget_px >= 0:
        raise InputError("trade", "budget_px", budget_px, "0 or more pixels")
    say: Report = options.get("report") or (lambda done, left=None: None)
    made, offered = _priced(scene, lens, budget_px, **options)
    some = spread(front(offered), next((o for o in offered if o.choice == made.best), None))
    exact, pictures = _pictures(scene, made.probed, some, samples, lambda done, left=None: say(0.5 + 0.5 * done))
    unit = "s" if made.unit == "ns" else "10^9 operations"
    return Trade(made, tuple(offered), 1e-9 * paths(scene) * made.rest, unit, samples, exact, tuple(pictures))


def plan_within(scene: Scene, lens: Lens, seconds: float, **options: Any) -> Plan:
    """The plan with the most faithful camera that takes no longer than so many seconds of one thread.

    Other arguments and errors as for `plan`; InputError, too, for seconds that are none and a target without time.
    """
    target = options.get("target", "render")
    if not seconds > 0 or UNIT[target] != "ns":
        raise InputError("plan", "budget", f"({seconds:g} s for {target})", "above 0, and a target whose time is known")
    made, offered = _priced(scene, lens, 0.0, **options)
    added = seconds - 1e-9 * paths(scene) * made.rest
    offer = best_within(offered, added)
    fits = {id(o.choice) for o in offered if o.seconds <= added and o.choice.light_error <= LIGHT}
    choices = [replace(c, within=id(c) in fits) for c in made.choices]
    return _rebudgeted(made, choices, None if offer is None else replace(offer.choice, within=True), budget_s=seconds)


def _rebudgeted(made: Plan, choices: Sequence[Choice], best: Choice | None, **budget: Any) -> Plan:
    """The plan with another best camera, whose error is then the budget that effects are held against."""
    error = math.inf if best is None else best.error_px
    effects = effects_of(made.probed, error)
    return replace(made, budget_px=error, effects=effects, choices=tuple(choices), best=best, **budget)


def plan_seen(scene: Scene, lens: Lens, flip_budget: float, **options: Any) -> Plan:
    """The plan with the cheapest camera whose picture differs from the exact lens's by no more than so much FLIP.

    FLIP is measured on strips of the picture at its own pixels (`_strips`), 16 samples, the same random numbers. It
    contains the noise of what samples meet otherwise, so that it is more than that of finished pictures (0.02 for
    0.01 px among many edges). Cameras that no other betters are tried by halves: with less error they are taken to have
    less FLIP. Other arguments and errors as for `plan`; InputError, too, for a budget that is no number from 0 to 1.
    """
    if not 0 <= flip_budget <= 1:
        raise InputError("plan", "budget", f"{flip_budget:g} FLIP", "0 to 1")
    if options.get("afterwards"):
        raise InputError("plan", "afterwards", ", ".join(options["afterwards"]), "nothing with a budget of FLIP")
    say: Report = options.get("report") or (lambda done, left=None: None)
    made, offered = _priced(scene, lens, 0.0, **options)
    by_time = front(offered)
    exact = _strips(scene, made.probed.exact)
    flips: dict[str, float] = {}

    def holds(offer: Offer) -> bool:
        choice = offer.choice
        pairs = zip(_strips(scene, camera_of(made.probed, choice)), exact, strict=True)
        flips[choice.name] = 0.0 if choice.error_px == 0 else float(np.mean([flip_map(*pair) for pair in pairs]))
        say(1 - 0.5 ** (1 + len(flips)))
        return flips[choice.name] <= flip_budget

    def judged(choice: Choice) -> Choice:
        value = flips.get(choice.name)
        return replace(choice, flip=value, within=value is not None and value <= flip_budget)

    first = bisect.bisect_left(by_time, True, key=holds)
    best = judged(by_time[first].choice) if first < len(by_time) else None
    return _rebudgeted(made, [*map(judged, made.choices)], best, budget_flip=flip_budget)


def _strips(scene: Scene, camera: Camera) -> list[FloatArray]:
    """Rows of a camera's picture at the scene's own size, in some places."""
    shot = scene.settings.camera
    rows = min(max(_STRIP_PATHS // (_STRIPS * _SAMPLES * shot.width), _STRIP_ROWS), shot.height)
    firsts = np.unique(np.linspace(0, shot.height - rows, _STRIPS + 2).astype(int)[1:-1])
    drawn = partial(render, scene, camera, samples=_SAMPLES, film=replace(scene.settings.film, wavelengths="one"))
    return [drawn(rows=(int(first), int(first) + rows)).rgb for first in firsts]


def paths(scene: Scene) -> int:
    """The paths of a picture of the scene's own size and samples."""
    shot = scene.settings.camera
    return shot.width * shot.height * shot.samples


def offers(scene: Scene, probed: Probe, tried: Sequence[Choice], rest: float) -> list[Offer]:
    """Cameras of known cost by rising seconds; `rest`: nanoseconds of a path in the scene."""
    each = ((c, rest * (0.0 if probed.asked.denoised else c.noise - 1) + c.cost) for c in tried)
    count = 1e-9 * paths(scene)
    offered = (Offer(c, count * ns, count * c.cost * (c.spread - 1)) for c, ns in each if math.isfinite(ns))
    return sorted(offered, key=lambda o: o.seconds)


def front(offered: Sequence[Offer]) -> list[Offer]:
    """The cameras of right light that no other betters in error and seconds."""
    bright = [o for o in offered if o.choice.light_error <= LIGHT]
    return [bright[i] for i in pareto_front([(o.seconds, o.choice.error_px) for o in bright])]


def best_within(offered: Sequence[Offer], seconds: float) -> Offer | None:
    """The most faithful camera that adds no more."""
    affordable = (o for o in front(offered) if o.seconds <= seconds)
    return min(affordable, key=lambda o: (o.choice.error_px, o.seconds), default=None)


def _pictures(
    scene: Scene, probed: Probe, offered: Sequence[Offer], samples: int, report: Report
) -> tuple[FloatArray, list[CameraPicture]]:
    """The exact lens's small picture, and those of cameras: equal samples, the same random numbers."""
    film = replace(scene.settings.film, wavelengths="one")  # for every camera: they share their random numbers
    width, height = small(scene, _ACROSS)
    drawn = partial(render, scene, width=width, height=height, samples=samples, film=film)
    exact = drawn(probed.exact).rgb
    pictures = []
    for k, offer in enumerate(offered):
        report((k + 1) / (len(offered) + 1))
        same = offer.choice.error_px == 0
        rgb = exact if same else drawn(camera_of(probed, offer.choice)).rgb
        pictures.append(CameraPicture(offer, rgb, np.zeros(rgb.shape[:2]) if same else flip_map(rgb, exact)))
    return exact, pictures


def spread(offered: Sequence[Offer], chosen: Offer | None, most: int = _SHOWN) -> list[Offer]:
    """At most so many of a front, evenly, and the chosen one among them, even where it is not on the front."""
    if chosen is not None and chosen not in offered:
        offered = sorted([*offered, chosen], key=lambda o: o.seconds)
    if len(offered) <= most:
        return list(offered)
    rows = {round(k * (len(offered) - 1) / (most - 1)) for k in range(most)}
    at = [k for k, o in enumerate(offered) if o == chosen]
    if at and not rows & set(at):
        rows = rows - {min(rows, key=lambda k: (abs(k - at[0]), k))} | set(at)
    return [offered[k] for k in sorted(rows)]
