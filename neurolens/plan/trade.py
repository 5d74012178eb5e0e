"""What a scene's error costs: every camera by its error and by the seconds to equal noise, and what half of them buys.

Seconds are of one thread, for the scene's own size and samples, and what a camera adds to those of one that costs
nothing and whose rays all weigh the same: what its own rays take, and what the scene takes for the further rays that
its noise asks for (see `costs`). What a ray takes in the scene is measured by a small picture, in our renderer; in
other targets the camera alone counts, in Cycles under a white sky.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.base.errors import InputError
from neurolens.base.progress import Report
from neurolens.base.records import pareto_front
from neurolens.cameras.contract import Camera, FloatArray
from neurolens.lens.prescription import Lens
from neurolens.plan.costs import UNIT, small
from neurolens.plan.plan import Choice, Plan, Target, camera_of, candidates, decided, rest_of
from neurolens.plan.probe import LIGHT, Probed, effects_of, probe
from neurolens.render.renderer import render
from neurolens.render.scene import Scene
from neurolens.study.image import Image, flip_map

_ACROSS, _SAMPLES = 240, 16  # of pictures
_STRIPS, _STRIP_ROWS, _STRIP_PATHS = 3, 16, 2_000_000  # of a picture: their number, least rows, paths of all
_SHOWN = 8  # most of them, beside the exact lens
_BUDGETS = (1.0, 0.25, 0.05)  # that polynomials are fitted for, besides the one asked for


@dataclass(frozen=True)
class Offer:
    """A camera for so many seconds more (10^9 operations, where no time is known) of one thread, by the least of its
    timed calls; by their median it takes `more` than that."""

    choice: Choice
    seconds: float
    more: float = 0.0


@dataclass(frozen=True)
class Shown:
    """A camera's small picture [H, W, 3], linear, and its FLIP from the exact lens's of the same random numbers."""

    offer: Offer
    rgb: FloatArray
    difference: Image

    @property
    def flip(self) -> float:
        """The mean."""
        return float(self.difference.mean())


@dataclass(frozen=True)
class Trade:
    """Every camera that was priced, by rising seconds; the plan for the budget; and pictures of those to look at.

    Attributes:
        base: what the scene takes by itself. unit: of it and of `Offer.seconds`. samples: a pixel of the pictures.
        exact: the lens's picture.
    """

    plan: Plan
    offered: tuple[Offer, ...]
    base: float
    unit: str
    samples: int
    exact: FloatArray
    shown: tuple[Shown, ...]

    @property
    def front(self) -> list[Offer]:
        """See `front`."""
        return front(self.offered)

    @property
    def chosen(self) -> Offer | None:
        """The plan's."""
        return next((o for o in self.offered if self.plan.best is not None and o.choice == self.plan.best), None)

    @property
    def half(self) -> Offer | None:
        """What half of what the chosen one adds buys."""
        return None if self.chosen is None else best_within(self.offered, self.chosen.seconds / 2)


def trade(
    scene: Scene, lens: Lens, budget_px: float, *, target: Target = "render", models: Sequence[Path] = (),
    folder: Path | None = None, samples: int = _SAMPLES, report: Report | None = None, **look: Any,
) -> Trade:  # fmt: skip
    """Every camera for a scene with its error and its seconds, and pictures of those that no other betters.

    Arguments and errors as of `plan`.
    """
    say = report or (lambda done, left=None: None)
    if not budget_px >= 0:
        raise InputError("trade", "budget_px", budget_px, "0 or more pixels")
    found = probe(scene, lens, **look)
    plan, rest = _priced(scene, found, budget_px, target, models, folder, lambda done, left=None: say(0.5 * done))
    offered = offers(scene, plan.probed, plan.choices, rest)
    some = spread(front(offered), next((o for o in offered if o.choice == plan.best), None))
    exact, pictures = _pictures(scene, plan.probed, some, samples, lambda done, left=None: say(0.5 + 0.5 * done))
    unit = "s" if plan.unit == "ns" else "10^9 operations"
    return Trade(plan, tuple(offered), 1e-9 * paths(scene) * rest, unit, samples, exact, tuple(pictures))


def plan_within(
    scene: Scene, lens: Lens, seconds: float, *, target: Target = "render", models: Sequence[Path] = (),
    folder: Path | None = None, report: Report | None = None, **look: Any,
) -> Plan:  # fmt: skip
    """The plan with the most faithful camera that takes no longer than so many seconds of one thread.

    Arguments and errors as of `plan`; InputError, too, for seconds that are none and a target without time.
    """
    if not seconds > 0 or UNIT[target] != "ns":
        raise InputError("plan", "budget", f"({seconds:g} s for {target})", "above 0, and a target whose time is known")
    found = probe(scene, lens, **look)
    plan, rest = _priced(scene, found, 0.0, target, models, folder, report)
    offered = offers(scene, plan.probed, plan.choices, rest)
    added = seconds - 1e-9 * paths(scene) * rest
    offer = best_within(offered, added)
    fits = {id(o.choice) for o in offered if o.seconds <= added and o.choice.light_error <= LIGHT}
    choices = tuple(replace(c, within=id(c) in fits) for c in plan.choices)
    best = None if offer is None else replace(offer.choice, within=True)
    error = math.inf if best is None else best.error_px
    return replace(
        plan, budget_px=error, budget_s=seconds, effects=effects_of(plan.probed, error), choices=choices, best=best
    )


def plan_seen(
    scene: Scene, lens: Lens, flip_budget: float, *, target: Target = "render", models: Sequence[Path] = (),
    folder: Path | None = None, report: Report | None = None, **look: Any,
) -> Plan:  # fmt: skip
    """The plan with the cheapest camera whose picture differs from the exact lens's by no more than so much FLIP.

    Told from strips of the picture at its own pixels (`_strips`), 16 samples, the same random numbers: with the noise
    of what samples meet otherwise, so that it is more than of finished pictures (0.02 for 0.01 px among many edges). Of
    cameras that no other betters, by halves: with less error they are taken to have less FLIP.
    Arguments and errors as of `plan`; InputError, too, for a budget that is no number from 0 to 1.
    """
    if not 0 <= flip_budget <= 1:
        raise InputError("plan", "budget", f"{flip_budget:g} FLIP", "0 to 1")
    if look.get("afterwards"):
        raise InputError("plan", "afterwards", ", ".join(look["afterwards"]), "nothing with a budget of FLIP")
    say = report or (lambda done, left=None: None)
    found = probe(scene, lens, **look)
    plan, rest = _priced(scene, found, 0.0, target, models, folder, lambda done, left=None: say(0.5 * done))
    offered = front(offers(scene, plan.probed, plan.choices, rest))
    exact = _strips(scene, found.exact)
    seen: dict[str, float] = {}
    low, high = 0, len(offered)  # those below `low` do not hold, those from `high` on do
    while low < high:
        middle = (low + high) // 2
        choice = offered[middle].choice
        pairs = zip(_strips(scene, camera_of(found, choice)), exact, strict=True)
        seen[choice.name] = 0.0 if choice.error_px == 0 else float(np.mean([flip_map(*pair) for pair in pairs]))
        low, high = (low, middle) if seen[choice.name] <= flip_budget else (middle + 1, high)
        say(0.5 + 0.5 * (1 - (high - low) / len(offered)))

    def told(choice: Choice) -> Choice:
        value = seen.get(choice.name)
        return replace(choice, flip=value, within=value is not None and value <= flip_budget)

    best = told(offered[high].choice) if high < len(offered) else None
    error = math.inf if best is None else best.error_px
    choices = tuple(map(told, plan.choices))
    effects = effects_of(found, error)
    return replace(plan, budget_px=error, budget_flip=flip_budget, effects=effects, choices=choices, best=best)


def _strips(scene: Scene, camera: Camera) -> list[FloatArray]:
    """Rows of a camera's picture at the scene's own size, in some places."""
    shot = scene.settings.camera
    rows = min(max(_STRIP_PATHS // (_STRIPS * _SAMPLES * shot.width), _STRIP_ROWS), shot.height)
    firsts = np.unique(np.linspace(0, shot.height - rows, _STRIPS + 2).astype(int)[1:-1])
    drawn = partial(render, scene, camera, samples=_SAMPLES, film=replace(scene.settings.film, wavelengths="one"))
    return [drawn(rows=(int(first), int(first) + rows)).rgb for first in firsts]


def _priced(
    scene: Scene, found: Probed, budget_px: float, target: Target, models: Sequence[Path], folder: Path | None,
    report: Report | None,
) -> tuple[Plan, float]:  # fmt: skip
    """A plan in which every camera has its cost, and what a path takes besides."""
    tried = candidates(found, (*_BUDGETS, budget_px), target, models=models, folder=folder, explain=True, report=report)
    rest = rest_of(scene, found, target)
    return decided(found, tried, budget_px, target, rest), rest


def paths(scene: Scene) -> int:
    """The paths of a picture of the scene's own size and samples."""
    shot = scene.settings.camera
    return shot.width * shot.height * shot.samples


def offers(scene: Scene, found: Probed, tried: Sequence[Choice], rest: float) -> list[Offer]:
    """Cameras of known cost by rising seconds; `rest`: nanoseconds of a path in the scene."""
    each = ((c, rest * (0.0 if found.asked.denoised else c.noise - 1) + c.cost) for c in tried)
    count = 1e-9 * paths(scene)
    offered = (Offer(c, count * ns, count * c.cost * (c.spread - 1)) for c, ns in each if math.isfinite(ns))
    return sorted(offered, key=lambda o: o.seconds)


def front(offered: Sequence[Offer]) -> list[Offer]:
    """Those of right light that no other betters in error and seconds."""
    true = [o for o in offered if o.choice.light_error <= LIGHT]
    points = [(o.seconds, o.choice.error_px) for o in true]
    return [true[i] for i in pareto_front(points)]


def best_within(offered: Sequence[Offer], seconds: float) -> Offer | None:
    """The most faithful camera that adds no more."""
    return min(
        (o for o in front(offered) if o.seconds <= seconds), key=lambda o: (o.choice.error_px, o.seconds), default=None
    )


def _pictures(
    scene: Scene, found: Probed, offered: Sequence[Offer], samples: int, report: Report
) -> tuple[FloatArray, list[Shown]]:
    """The exact lens's small picture, and those of cameras: equal samples, the same random numbers."""
    film = replace(scene.settings.film, wavelengths="one")  # for every camera: they share their random numbers
    width, height = small(scene, _ACROSS)
    drawn = partial(render, scene, width=width, height=height, samples=samples, film=film)
    exact = drawn(found.exact).rgb
    pictures = []
    for k, offer in enumerate(offered):
        report((k + 1) / (len(offered) + 1))
        same = offer.choice.error_px == 0
        rgb = exact if same else drawn(camera_of(found, offer.choice)).rgb
        pictures.append(Shown(offer, rgb, np.zeros(rgb.shape[:2]) if same else flip_map(rgb, exact)))
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
