"""One plan for the frames of an animation, whose focus, stop, zoom or place move: cameras that serve many of them.

Frames that show the extremes, and some between, are probed. A camera that needs no fit (ideal, exact, shipped) serves a
frame as in a plan of one. Models fitted for the shot serve stretches of focus: the domain of each is all that its
frames ask for, so that a stretch within another asks for less, and the fewest stretches are those which, from the
nearest focus on, reach as far as the largest model keeps the budget. Each has the smallest model that does.
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.base.errors import InputError
from neurolens.base.progress import Report
from neurolens.lens.paraxial import first_order
from neurolens.lens.prescription import Lens
from neurolens.lens.shot import Dispersion
from neurolens.plan import footprints as prints
from neurolens.plan.candidates import (
    FITTED,
    IDEAL,
    Choice,
    Target,
    candidates,
    model_choice,
    shot_domain,
    shot_fits,
    shot_terms,
)
from neurolens.plan.costs import UNIT, Work
from neurolens.plan.plan import best_of, exact_suffices, work_for
from neurolens.plan.probe import COUNTED, Effect, Probe, effects_of, probe
from neurolens.render.scene import Scene
from neurolens.setting.states import set_lens

_MOST = 5  # frames that are probed, but for more extremes


@dataclass(frozen=True)
class Frame:
    """A frame: its number, the scene with the camera as it is there, and the zoom (None: as the lens's file has it)."""

    number: int
    scene: Scene
    zoom: float | None = None

    @property
    def state(self) -> tuple[float, float, float]:
        """Zoom, inverse focus and f-number: what a lens moves."""
        shot = self.scene.settings.camera
        return self.zoom or 0.0, 1 / shot.focus_m, shot.f_number or 0.0

    def same(self, other: Frame) -> bool:
        """Whether both show the same."""
        return self.scene.settings.camera == other.scene.settings.camera and self.zoom == other.zoom


@dataclass(frozen=True)
class Run:
    """Frames in a row that one camera serves; `choice` None where none is within the budget."""

    first: int
    last: int
    choice: Choice | None


@dataclass(frozen=True)
class FramesPlan:
    """The cameras of an animation.

    Attributes:
        probed: frames that were looked at. effects: the dearest of them, with breathing. runs: in order of frames.
        fits: models fitted that are used, the fewest that keep the budget where they cost least.
        cost: of the camera on a path times noise, mean over frames, in `unit`; None where a frame has no camera.
    """

    budget_px: float
    target: Target
    unit: str
    probed: tuple[int, ...]
    effects: tuple[Effect, ...]
    runs: tuple[Run, ...]
    fits: int
    cost: float | None

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return asdict(self)


def plan_frames(
    frames: Sequence[Frame], lens: Lens, budget_px: float, *, target: Target = "render", models: Sequence[Path] = (),
    folder: Path | None = None, afterwards: Collection[str] = (), denoised: bool = False, report: Report | None = None,
    dispersion: Dispersion = "full",
) -> FramesPlan:  # fmt: skip
    """The cheapest cameras for the frames of an animation; arguments as of `plan.plan`.

    Args:
        lens: as its file has it, of a zoom too.

    Raises:
        InputError: no frame; as `plan`.
    """
    if not frames or not budget_px >= 0:
        raise InputError("plan", "frames", len(frames), "one or more, and a budget of 0 or more pixels")
    say = report or (lambda done, left=None: None)
    chosen = representatives(frames)
    probes: list[Probe] = []
    for frame in chosen:
        zoomed = set_lens(lens, zoom=frame.zoom)
        probes.append(probe(frame.scene, zoomed, afterwards=afterwards, denoised=denoised, dispersion=dispersion))
        say(0.4 * len(probes) / len(chosen))
    best: list[Choice | None] = []
    work = work_for(chosen[0].scene, probes[0], target)
    for probed in probes:
        tried = candidates(probed, (budget_px,), target, models=models, work=work)
        best.append(best_of([c for c in tried if c.meets(budget_px)], work, denoised))
        say(0.4 + 0.3 * len(best) / len(probes))
    fits = 0
    if folder is not None and not exact_suffices(probes[0], work):
        # Frames without a camera, or with one that costs more than a small model may.
        asks = [k for k, c in enumerate(best) if c is None or not c.name.startswith(IDEAL)]
        for rows, choice in _stretches([probes[k] for k in asks], target, budget_px, folder, work):
            against = [[choice, *filter(None, [best[asks[k]]])] for k in rows]
            cheaper = [asks[k] for k, two in zip(rows, against, strict=True) if best_of(two, work, denoised) is choice]
            fits += bool(cheaper)
            for k in cheaper:
                best[k] = choice
            say(0.7 + 0.3 * (1 + max(rows)) / len(asks))
    say(1.0)
    served = [best[_nearest(frame, chosen)] for frame in frames]
    mean = float(np.mean([c.cost if c else math.nan for c in served]))
    return FramesPlan(
        budget_px, target, UNIT[target], tuple(f.number for f in chosen), _effects(probes, budget_px),
        tuple(_runs(frames, served)), fits, mean if math.isfinite(mean) else None,
    )  # fmt: skip


def representatives(frames: Sequence[Frame]) -> list[Frame]:
    """The first and the last frame, those at the extremes of zoom, focus and stop, and some between; of frames that are
    all alike one."""
    frames = [f for k, f in enumerate(frames) if k == 0 or not f.same(frames[k - 1])]
    extremes = {0, len(frames) - 1}
    for axis in range(3):
        values = [f.state[axis] for f in frames]
        extremes |= {int(np.argmin(values)), int(np.argmax(values))}
    between = [int(k) for k in np.linspace(0, len(frames) - 1, _MOST)]
    kept = dict.fromkeys([*sorted(extremes), *between])
    return [frames[k] for k in sorted(list(kept)[: max(_MOST, len(extremes))])]


def _nearest(frame: Frame, chosen: Sequence[Frame]) -> int:
    """The probed frame whose state is most like that of a frame; of several the one with the nearest number."""
    return min(
        range(len(chosen)),
        key=lambda k: (math.dist(chosen[k].state, frame.state), abs(chosen[k].number - frame.number)),
    )


def _runs(frames: Sequence[Frame], served: Sequence[Choice | None]) -> Iterator[Run]:
    rows = zip(frames, served, strict=True)
    for _, group in itertools.groupby(rows, lambda row: row[1] and (row[1].name, row[1].camera)):
        some, choices = zip(*group, strict=True)
        yield Run(some[0].number, some[-1].number, max(filter(None, choices), key=lambda c: c.error_px, default=None))


def _stretches(
    probes: Sequence[Probe], target: Target, budget_px: float, folder: Path, work: Work
) -> Iterator[tuple[list[int], Choice]]:
    """Rows of `probes` that one model serves, and the model; rows that none serves are left out."""
    order = sorted(range(len(probes)), key=lambda k: (_zoom(probes[k]), probes[k].asked.shot.focus_m))
    sizes, done = shot_terms(probes[0]) if probes else [], 0
    asked = target, budget_px, folder, work
    while done < len(order):
        fit_of = cache(lambda n, at=done: _stretch([probes[k] for k in order[at : at + n]], *asked))
        # From here on to as far as the largest model reaches: halves, for less is easier.
        same = sum(_zoom(probes[k]) == _zoom(probes[order[done]]) for k in order[done:])
        count = bisect.bisect_left(range(1, same + 1), True, key=lambda n: fit_of(n)(sizes[-1], False) is None)
        if count:
            fit = fit_of(count)
            least = bisect.bisect_left(sizes[:-1], True, key=lambda terms: fit(terms, False) is not None)
            choice = fit(sizes[least], True)
            assert choice is not None
            yield order[done : done + count], choice
        done += max(count, 1)


def _zoom(probed: Probe) -> float:
    """Frames of one lens state, but for its film and stop, can share a model."""
    return round(first_order(probed.lens).efl_mm, 6)


def _stretch(
    probes: Sequence[Probe], target: Target, budget_px: float, folder: Path, work: Work
) -> Callable[[int, bool], Choice | None]:
    """A function that fits a model of a size over the domain that holds the domains of all frames.

    Arguments are the size and whether the cost is asked for. It returns the model with its largest error over the
    frames, or None where one is beyond the budget.
    """
    near, far = (f(p.asked.shot.focus_m for p in probes) for f in (min, max))
    name = f"shot-{near:.4g}-{far:.4g}m" if near < far else f"shot-{near:.4g}m"
    ends = [focus for p in probes for focus in shot_domain(p).focus_m or ()]
    widest = min(probes, key=lambda p: p.asked.f_number)
    radius = max(p.domain.film_radius_mm for p in probes)
    domain = replace(shot_domain(widest), film_radius_mm=radius, focus_m=(max(ends), min(ends)))
    fit = cache(shot_fits(widest, folder, domain, name))

    def choice(terms: int, costed: bool) -> Choice | None:
        file, settings = fit(terms)
        choices: list[Choice] = []
        for probed in probes:
            made = model_choice(probed, target, file, FITTED, costed and not choices, work)
            if made is None or not made.meets(budget_px):
                return None
            choices.append(made)
        worst = max(choices, key=lambda c: c.error_px)
        light = max(c.light_error for c in choices)
        return replace(worst, cost=choices[0].cost, noise=choices[0].noise, light_error=light, settings=settings)

    return choice


def _effects(probes: Sequence[Probe], budget_px: float) -> tuple[Effect, ...]:
    """The largest of each effect over the frames, and breathing; stray light is that of the first frame."""
    every: dict[str, Effect] = {}
    for k, probed in enumerate(probes):
        for effect in effects_of(probed, budget_px, stray=k == 0):
            every[effect.name] = max(every.get(effect.name, effect), effect, key=lambda e: e.worth)
    if (worth := breathing_px(probes)) is not None:
        needed = worth[0] > budget_px
        every["breathing"] = Effect("breathing", *worth, "px", needed, "" if needed else "left out")
    return tuple(sorted(every.values(), key=lambda e: (e.unit, -e.worth)))


def breathing_px(probes: Sequence[Probe]) -> tuple[float, float, float] | None:
    """The movement in pixels of the picture of things that stay in place, while the focus moves between its extremes.

    The bound that 95% of the picture keeps, the median, and the share beyond a pixel; None without a movement of focus.
    """
    near, far = (f(probes, key=lambda p: p.asked.shot.focus_m) for f in (min, max))
    if near.asked.shot.focus_m == far.asked.shot.focus_m or _zoom(near) != _zoom(far):
        return None
    moved = prints.footprints(near.exact, far.places)
    share = far.places.share
    lit = moved.light > 0
    shift = np.hypot(*(prints.centroids(moved, share)[0] - prints.centroids(far.seen, share)[0]))[lit]
    if not shift.size:
        return None
    shift = shift / far.asked.pixel_mm
    return float(np.percentile(shift, COUNTED)), float(np.median(shift)), float((shift > 1).mean())
