"""One plan for the frames of an animation, whose focus, stop, zoom or place move: cameras that serve many of them.

Frames that show the extremes, and some between, are probed. A camera that is there anyhow (ideal, exact, shipped)
serves a frame as in a plan of one. Models fitted for the shot serve stretches of focus: the domain of each is all that
its frames ask for, so that a stretch within another asks for less, and the fewest stretches are those which, from the
nearest focus on, reach as far as the largest model keeps the budget. Each has the smallest model that does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.base.errors import InputError
from neurolens.base.progress import Report
from neurolens.lens.paraxial import first_order
from neurolens.lens.prescription import Lens
from neurolens.plan import footprints as prints
from neurolens.plan.plan import (
    UNIT,
    Choice,
    Target,
    best_of,
    candidates,
    exact_suffices,
    model_choice,
    rest_of,
)  # fmt: skip
from neurolens.plan.probe import COUNTED, Effect, Probed, effects_of, probe
from neurolens.plan.shot_fits import shot_domain, shot_fits, shot_terms
from neurolens.render.scene import Scene
from neurolens.setting.states import set_lens
from neurolens.surrogates.targets import ModelSettings

_MOST = 5  # frames that are probed, but for more extremes
_HOW = "fitted for this shot"


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
    """What an animation needs.

    Attributes:
        probed: frames that were looked at. effects: the dearest of them, with breathing. runs: in order of frames.
        fits: models fitted that are used, the fewest that keep the budget where they cost least.
        cost: of a ray times noise, mean over frames, in `unit`; None where a frame has no camera.
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
    founds: list[Probed] = []
    for frame in chosen:
        founds.append(probe(frame.scene, set_lens(lens, zoom=frame.zoom), afterwards=afterwards, denoised=denoised))
        say(0.4 * len(founds) / len(chosen))
    best: list[Choice | None] = []
    rest = rest_of(chosen[0].scene, founds[0], target)
    for found in founds:
        tried = candidates(found, (budget_px,), target, models=models)
        best.append(best_of([c for c in tried if c.meets(budget_px)], rest))
        say(0.4 + 0.3 * len(best) / len(founds))
    fits = 0
    if folder is not None and not exact_suffices(founds[0], rest):
        # What has no camera, or one that costs more than a small model may.
        asks = [k for k, c in enumerate(best) if c is None or not c.name.startswith(("pinhole", "thin"))]
        for rows, choice in _stretches([founds[k] for k in asks], target, budget_px, folder):
            cheaper = [asks[k] for k in rows if best_of([choice, *filter(None, [best[asks[k]]])], rest) is choice]
            fits += bool(cheaper)
            for k in cheaper:
                best[k] = choice
            say(0.7 + 0.3 * (1 + max(rows)) / len(asks))
    say(1.0)
    served = [best[_nearest(frame, chosen)] for frame in frames]
    costs = [c.cost if c else math.nan for c in served]
    mean = float(np.mean(costs))
    return FramesPlan(
        budget_px, target, UNIT[target], tuple(f.number for f in chosen), _effects(founds, budget_px),
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


def _runs(frames: Sequence[Frame], served: Sequence[Choice | None]) -> Iterable[Run]:
    start = 0
    for k in range(1, len(frames) + 1):
        if k == len(frames) or _camera(served[k]) != _camera(served[start]):
            part = [c for c in served[start:k] if c is not None]
            yield Run(frames[start].number, frames[k - 1].number, max(part, key=lambda c: c.error_px, default=None))
            start = k


def _camera(choice: Choice | None) -> tuple[str, str] | None:
    return None if choice is None else (choice.name, choice.camera)


def _stretches(
    founds: Sequence[Probed], target: Target, budget_px: float, folder: Path
) -> Iterable[tuple[list[int], Choice]]:
    """Rows of `founds` that one model serves, and the model; what none serves is left out."""
    order = sorted(range(len(founds)), key=lambda k: (_zoom(founds[k]), founds[k].asked.shot.focus_m))
    sizes, done = shot_terms(founds[0]) if founds else [], 0
    while done < len(order):
        # From here on to as far as the largest model reaches: halves, for less is easier.
        same = sum(_zoom(founds[k]) == _zoom(founds[order[done]]) for k in order[done:])
        low, high, fit = 0, same, None
        while low < high:
            count = (low + high + 1) // 2
            trial = _Stretch([founds[k] for k in order[done : done + count]], target, budget_px, folder)
            if trial.choice(sizes[-1]) is not None:
                low, fit = count, trial
            else:
                high = count - 1
        if fit is None:
            done += 1
            continue
        small, large = 0, len(sizes) - 1  # the least that holds
        while small < large:
            middle = (small + large) // 2
            small, large = (small, middle) if fit.choice(sizes[middle]) is not None else (middle + 1, large)
        choice = fit.choice(sizes[small], costed=True)
        assert choice is not None
        yield order[done : done + low], choice
        done += low


def _zoom(found: Probed) -> float:
    """Frames of one lens state, but for its film and stop, can share a model."""
    return round(first_order(found.lens).efl_mm, 6)


class _Stretch:
    """Models for all that some frames ask of a lens."""

    def __init__(self, founds: Sequence[Probed], target: Target, budget_px: float, folder: Path) -> None:
        self.founds, self.target, self.budget_px, self.folder = founds, target, budget_px, folder
        near, far = (f(p.asked.shot.focus_m for p in founds) for f in (min, max))
        self.name = f"shot-{near:.4g}-{far:.4g}m" if near < far else f"shot-{near:.4g}m"
        self._files: dict[int, tuple[Path, ModelSettings]] = {}

    @cached_property
    def fit(self) -> Callable[[int], tuple[Path, ModelSettings]]:
        """Fit a model over the domain that holds the domains of all frames."""
        ends = [focus for p in self.founds for focus in shot_domain(p).focus_m or ()]
        widest = min(self.founds, key=lambda p: p.asked.f_number)
        radius = max(p.domain.film_radius_mm for p in self.founds)
        choice = replace(shot_domain(widest), film_radius_mm=radius, focus_m=(max(ends), min(ends)))
        return shot_fits(widest, self.folder, choice, self.name)

    def choice(self, terms: int, costed: bool = False) -> Choice | None:
        """The model of a size, with its largest error over the frames; None where one is beyond the budget."""
        if terms not in self._files:
            self._files[terms] = self.fit(terms)
        file, settings = self._files[terms]
        found: list[Choice] = []
        for probed in self.founds:
            made = model_choice(probed, self.target, file, _HOW, costed and not found)
            if made is None or not made.meets(self.budget_px):
                return None
            found.append(made)
        worst = max(found, key=lambda c: c.error_px)
        light = max(c.light_error for c in found)
        return replace(worst, cost=found[0].cost, noise=found[0].noise, light_error=light, settings=settings)


def _effects(founds: Sequence[Probed], budget_px: float) -> tuple[Effect, ...]:
    """Collect the largest of each effect over the frames, and breathing; stray light is that of the first frame."""
    every: dict[str, Effect] = {}
    for k, found in enumerate(founds):
        for effect in effects_of(found, budget_px, stray=k == 0):
            if effect.name not in every or effect.worth > every[effect.name].worth:
                every[effect.name] = effect
    if (worth := breathing_px(founds)) is not None:
        needed = worth[0] > budget_px
        every["breathing"] = Effect("breathing", *worth, "px", needed, "" if needed else "left out")
    return tuple(sorted(every.values(), key=lambda e: (e.unit, -e.worth)))


def breathing_px(founds: Sequence[Probed]) -> tuple[float, float, float] | None:
    """By how much the picture of what stays in its place moves while the focus does, between its extremes, in pixels:
    what 95% of the picture keeps, the median, and the share beyond a pixel; None without a movement of focus."""
    near, far = (f(founds, key=lambda p: p.asked.shot.focus_m) for f in (min, max))
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
