"""The camera for a scene by a budget of error, time or visible difference; and the trade of error against time.

A camera's error is the distance of its footprints from the exact lens's in pixels, and of its light, at the places of a
scene that a `probe` finds; both count where they are largest but for 5% of the picture. Its cost is the time of a path
in the target named, times the noise of its picture: see `costs`. In C and onnxruntime it is measured here, with one
thread; for shaders it is counted. The cheapest camera within the budget is chosen; those that take about as long are
alike, and the exact lens is taken where it is one of them.

Seconds are of one thread and of the whole picture at the scene's own size, to the noise that the exact lens has with
the scene's samples. What a path takes besides its camera, and how dispersion adds to noise, is measured by strips of
the picture in our renderer; in other targets the camera alone counts, in Cycles under a white sky. There cameras count
as alike up to `pages.SAVING`, for what else a path takes is not known.
"""

from __future__ import annotations

import bisect
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.analysis.plots import INK, drawing, plain_log_ticks
from neurolens.base.errors import InputError
from neurolens.base.lensname import split_kind
from neurolens.base.progress import Report
from neurolens.base.records import pareto_front
from neurolens.base.settings import to_toml
from neurolens.base.tomlfile import format_toml
from neurolens.cameras.build import as_c, ideal_as, with_dispersion
from neurolens.cameras.contract import Camera, FloatArray
from neurolens.lens.prescription import Lens
from neurolens.plan.candidates import EXACT, PAIRS, Choice, Target, camera_of, candidates, shot_domain
from neurolens.plan.costs import ALONE, UNIT, Work, noise, ns_a_ray, small, strips_of, work_of
from neurolens.plan.probe import LIGHT, Effect, Probe, SceneNeeds, effects_of, probe
from neurolens.render.renderer import render
from neurolens.render.scene import Scene
from neurolens.study.experiment import DomainChoice, EvaluationChoice, Experiment, LensChoice
from neurolens.study.pages import SAVING, recommended
from neurolens.study.plots import CHOSEN, error_scale, family_colour, log_norm, noisy_lines, place_labels
from neurolens.study.scenes import Image, flip_map

_SHOT_KEYS = "film_mm", "focus_m", "f_number", "wavelength_nm"  # settings of the shot in `Plan.to_dict`
_ACROSS, _SAMPLES = 240, 16  # of pictures
_STRIP_ROWS, _STRIP_PATHS = 16, 2_000_000  # of strips of a picture: least rows, paths of all
_SHOWN = 8  # most of them, beside the exact lens
ALIKE = 1.2  # times the least cost of a whole picture: costs are no more accurate
_BUDGETS = (1.0, 0.25, 0.05)  # that polynomials are fitted for, besides the one asked for


@dataclass(frozen=True)
class Plan:
    """A scene's needs, the effects in falling order of worth, every camera tried by rising cost, the one to use.

    Attributes:
        budget_s, budget_flip: seconds, or FLIP difference, of a plan for those, whose `budget_px` is then the error of
            the best camera.
        unit: of costs: "ns" or, where no time is known, "operations". domain: of models that are fitted.
        work: what a path takes besides its camera, in the same unit; none where the camera alone counts.
        alike: names of the cameras within the budget that take about as long as the cheapest, the best among them.
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
    work: Work = ALONE
    alike: tuple[str, ...] = ()

    @property
    def what(self) -> str:
        """What takes the seconds of its cameras."""
        return "whole picture" if any(self.work.rest) else "camera"

    @property
    def front(self) -> list[Choice]:
        """The cameras that no other betters, see `front`."""
        return front(self.choices)

    @property
    def unit_s(self) -> str:
        """The unit of `Choice.seconds`."""
        return "s" if self.unit == "ns" else "10^9 operations"

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
        checks = EvaluationChoice(vignetting_rays=50_000, rounds=0)
        return to_toml(Experiment(title, choice, (best.settings,), self.domain, PAIRS, checks, camera=camera))


def plan(
    scene: Scene, lens: Lens, budget_px: float, *, target: Target = "render", models: Sequence[Path] = (),
    folder: Path | None = None, explain: bool = False, report: Report | None = None, **look: Any,
) -> Plan:  # fmt: skip
    """The cheapest camera for a scene whose error stays within a budget, or the exact lens where that one saves too
    little to tell. In our renderer the whole picture counts.

    Args:
        lens: as its file has it. budget_px: error of place and blur in pixels of the scene's picture.
        target: what runs the camera: our renderer with all it has, compiled C, onnxruntime, Blender's Cycles (osl), or
            a renderer in GLSL.
        models: exported models of this lens to try. folder: where models fitted for the shot go; None fits none.
        explain: whether cameras beyond the budget are compiled and timed, too; else their cost is infinite.
        look: further arguments of `probe`: zoom, dispersion, and what is made of the picture later.

    Raises:
        InputError: a budget that is negative or no number; a part of the dispersion for a target other than our
            renderer; as `probe`.
    """
    if not budget_px >= 0:
        raise InputError("plan", "budget_px", budget_px, "0 or more pixels")
    probed = probe(scene, lens, **look)
    work = work_for(scene, probed, target)
    folder = folder if explain or not exact_suffices(probed, work) else None
    tried = candidates(
        probed, (budget_px,), target, models=models, folder=folder, explain=explain, report=report, work=work
    )
    return decided(probed, tried, budget_px, target, work)


def work_for(scene: Scene, probed: Probe, target: Target) -> Work:
    """The work of a path: in our renderer by strips of the picture, in other targets that of the camera alone.

    Raises:
        InputError: a part of the dispersion for another target.
    """
    shot = probed.asked.shot
    if target != "render":
        if shot.dispersion != "full":
            expected = f"full for {target}: it is a setting of our renderer"
            raise InputError("plan", "dispersion", shot.dispersion, expected)
        return ALONE
    thin, colours = as_c(ideal_as("thin:", probed.exact.lens, shot)), with_dispersion(probed.exact, shot)
    seen = probed.thin_seen.weight, probed.seen.weight
    return work_of(scene, thin, colours, probed.places, seen)


def exact_suffices(probed: Probe, work: Work) -> bool:
    """Whether not even a model that costs nothing would save enough, so that nothing needs to be fitted."""
    rest = work.rest[probed.exact.dispersive]
    exact = ns_a_ray(probed.exact, probed.places)["min"] if rest else math.inf
    return recommended((0.0,), float, exact, rest, ALIKE) == exact


def _alike(work: Work) -> float:
    """The factor up to which costs count as the same."""
    return ALIKE if any(work.rest) else SAVING


def decided(probed: Probe, tried: Sequence[Choice], budget_px: float, target: Target, work: Work | None = None) -> Plan:
    """The plan for a budget, from candidates that serve it.

    Args:
        work: of a path; None chooses the cheapest camera, whatever it saves.
    """
    known = work or ALONE
    ranked = tuple(replace(c, within=c.meets(budget_px)) for c in in_seconds(probed, tried, known))
    held = [c for c in ranked if c.within]
    exact = next((c for c in held if c.name == EXACT and math.isfinite(c.cost)), None) if work else None
    best = recommended(held, lambda c: c.seconds, exact, saving=_alike(known))
    alike = tuple(c.name for c in held if c.seconds <= _alike(known) * held[0].seconds)
    effects = effects_of(probed, budget_px)
    return Plan(
        probed.asked, budget_px, None, target, UNIT[target], shot_domain(probed), effects, ranked, best, probed,
        work=known, alike=alike,
    )  # fmt: skip


def in_seconds(probed: Probe, tried: Sequence[Choice], work: Work) -> list[Choice]:
    """Cameras by rising seconds, to the noise that the exact lens has with the scene's samples."""
    denoised, shot = probed.asked.denoised, probed.scene.settings.camera
    exact = noise(probed.seen.weight, probed.places.share) * work.noise[probed.exact.dispersive]
    paths = 1e-9 * shot.width * shot.height * shot.samples / (1.0 if denoised else exact)

    def priced(c: Choice) -> Choice:
        camera = paths * c.cost
        more = camera * (c.spread - 1) if math.isfinite(camera) else 0.0
        return replace(c, seconds=paths * c.whole(work, denoised), more=more, camera_seconds=camera)

    return sorted(map(priced, tried), key=lambda c: c.seconds)


@dataclass(frozen=True)
class CameraPicture:
    """A camera's small picture [H, W, 3], linear, and its FLIP from the exact lens's of the same random numbers."""

    choice: Choice
    rgb: FloatArray
    difference: Image

    @property
    def flip(self) -> float:
        """The mean of the differences."""
        return float(self.difference.mean())


@dataclass(frozen=True)
class Trade:
    """A plan in which every camera has its seconds, and pictures of those to look at.

    Attributes:
        samples: a pixel of the pictures. exact: the lens's picture.
    """

    plan: Plan
    samples: int
    exact: FloatArray
    shown: tuple[CameraPicture, ...]

    @property
    def half(self) -> Choice | None:
        """The best camera for half of the seconds that the picture of the chosen one takes."""
        best = self.plan.best
        return None if best is None else best_within(self.plan.choices, best.seconds / 2)


def _priced(
    scene: Scene, lens: Lens, budget_px: float, *, target: Target = "render", models: Sequence[Path] = (),
    folder: Path | None = None, report: Report | None = None, **look: Any,
) -> Plan:  # fmt: skip
    """A plan in which every camera has its seconds; arguments as for `plan`."""
    say = report or (lambda done, left=None: None)
    probed = probe(scene, lens, **look)
    work = work_for(scene, probed, target)
    tried = candidates(
        probed, (*_BUDGETS, budget_px), target, models=models, folder=folder, explain=True,
        report=lambda done, left=None: say(0.5 * done), work=work,
    )  # fmt: skip
    made = decided(probed, tried, budget_px, target, work)
    return replace(made, choices=tuple(c for c in made.choices if math.isfinite(c.seconds)))


def trade(scene: Scene, lens: Lens, budget_px: float, *, samples: int = _SAMPLES, **options: Any) -> Trade:
    """Every camera for a scene with its error and its seconds, and pictures of those that no other betters.

    Other arguments and errors as for `plan`.
    """
    if not budget_px >= 0:
        raise InputError("trade", "budget_px", budget_px, "0 or more pixels")
    say: Report = options.get("report") or (lambda done, left=None: None)
    made = _priced(scene, lens, budget_px, **options)
    some = spread(front(made.choices), made.best)
    exact, pictures = _pictures(scene, made.probed, some, samples, lambda done, left=None: say(0.5 + 0.5 * done))
    return Trade(made, samples, exact, tuple(pictures))


def plan_within(scene: Scene, lens: Lens, seconds: float, **options: Any) -> Plan:
    """The plan with the most faithful camera whose picture takes no longer than so many seconds of one thread.

    Other arguments and errors as for `plan`; InputError, too, for seconds that are none and a target without time.
    """
    target = options.get("target", "render")
    if not seconds > 0 or UNIT[target] != "ns":
        raise InputError("plan", "budget", f"({seconds:g} s for {target})", "above 0, and a target whose time is known")
    made = _priced(scene, lens, 0.0, **options)
    choices = [replace(c, within=c.seconds <= seconds and c.light_error <= LIGHT) for c in made.choices]
    return _rebudgeted(made, choices, best_within(choices, seconds), budget_s=seconds)


def _rebudgeted(made: Plan, choices: Sequence[Choice], best: Choice | None, **budget: Any) -> Plan:
    """The plan with another best camera, whose error is then the budget that effects are held against."""
    error = math.inf if best is None else best.error_px
    effects = effects_of(made.probed, error)
    return replace(made, budget_px=error, effects=effects, choices=tuple(choices), best=best, alike=(), **budget)


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
    made = _priced(scene, lens, 0.0, **options)
    by_time = front(made.choices)
    exact = _strips(scene, made.probed.exact)
    flips: dict[str, float] = {}

    def holds(choice: Choice) -> bool:
        pairs = zip(_strips(scene, camera_of(made.probed, choice)), exact, strict=True)
        flips[choice.name] = 0.0 if choice.error_px == 0 else float(np.mean([flip_map(*pair) for pair in pairs]))
        say(1 - 0.5 ** (1 + len(flips)))
        return flips[choice.name] <= flip_budget

    def judged(choice: Choice) -> Choice:
        value = flips.get(choice.name)
        return replace(choice, flip=value, within=value is not None and value <= flip_budget)

    first = bisect.bisect_left(by_time, True, key=holds)
    best = judged(by_time[first]) if first < len(by_time) else None
    return _rebudgeted(made, [*map(judged, made.choices)], best, budget_flip=flip_budget)


def _strips(scene: Scene, camera: Camera) -> list[FloatArray]:
    """Rows of a camera's picture at the scene's own size, in some places."""
    drawn = partial(render, scene, camera, samples=_SAMPLES, film=replace(scene.settings.film, wavelengths="one"))
    return [drawn(rows=rows).rgb for rows in strips_of(scene, _STRIP_PATHS, _SAMPLES, _STRIP_ROWS)]


def front(choices: Sequence[Choice]) -> list[Choice]:
    """The cameras of right light that no other betters in error and seconds."""
    bright = [c for c in choices if c.light_error <= LIGHT]
    return [bright[i] for i in pareto_front([(c.seconds, c.error_px) for c in bright])]


def best_within(choices: Sequence[Choice], seconds: float) -> Choice | None:
    """The most faithful camera whose picture takes no longer."""
    affordable = (c for c in front(choices) if c.seconds <= seconds)
    return min(affordable, key=lambda c: (c.error_px, c.seconds), default=None)


def _pictures(
    scene: Scene, probed: Probe, some: Sequence[Choice], samples: int, report: Report
) -> tuple[FloatArray, list[CameraPicture]]:
    """The exact lens's small picture, and those of cameras: equal samples, the same random numbers."""
    film = replace(scene.settings.film, wavelengths="one")  # for every camera: they share their random numbers
    width, height = small(scene, _ACROSS)
    drawn = partial(render, scene, width=width, height=height, samples=samples, film=film)
    exact = drawn(probed.exact).rgb
    pictures = []
    for k, choice in enumerate(some):
        report((k + 1) / (len(some) + 1))
        same = choice.error_px == 0
        rgb = exact if same else drawn(camera_of(probed, choice)).rgb
        pictures.append(CameraPicture(choice, rgb, np.zeros(rgb.shape[:2]) if same else flip_map(rgb, exact)))
    return exact, pictures


def spread(choices: Sequence[Choice], chosen: Choice | None, most: int = _SHOWN) -> list[Choice]:
    """At most so many of a front, evenly, and the chosen one among them, even where it is not on the front."""
    if chosen is not None and chosen not in choices:
        choices = sorted([*choices, chosen], key=lambda c: c.seconds)
    if len(choices) <= most:
        return list(choices)
    rows = {round(k * (len(choices) - 1) / (most - 1)) for k in range(most)}
    at = [k for k, c in enumerate(choices) if c == chosen]
    if at and not rows & set(at):
        rows = rows - {min(rows, key=lambda k: (abs(k - at[0]), k))} | set(at)
    return [choices[k] for k in sorted(rows)]


_MAPS_A_ROW = 4
# Light that an effect takes is dark, light that it adds is orange; none is white.
_SIGNED = ("#10183a", "#4d6796", "#c9d1de", "#ffffff", "#f6cfae", "#e58a45", CHOSEN)
_TITLES = {"px": "pixels (logarithmic)", "relative": "% of the light\n(dark: taken, orange: added)"}


def plot_effects(plan: Plan, path: Path, title: str) -> None:
    """Draw effects as bars with the budget, the error of every timed camera against its time, and maps of the effects
    that a camera needs: those in pixels, then those of light, each with one scale."""
    asked = plan.asked
    shown = [e for e in plan.effects if e.needed and e.name in plan.probed.maps]
    groups = {unit: [e.name for e in shown if e.unit == unit] for unit in _TITLES}
    groups = {unit: names for unit, names in groups.items() if names}
    heights = [4.2, *(1.6 * -(-len(names) // _MAPS_A_ROW) + 0.15 for names in groups.values())]
    subtitle = f"f/{asked.f_number:.3g}, focus {asked.shot.focus_m:g} m; 95% of the picture keeps these figures"
    with drawing(path, 9.5, sum(heights), title, subtitle) as figure:
        if not groups:
            _bars_and_trade(plan, figure)
            return
        above, *below = figure.subfigures(len(heights), 1, height_ratios=heights)
        _bars_and_trade(plan, above)
        for part, (unit, names) in zip(below, groups.items(), strict=True):
            _maps(part, {name: plan.probed.maps[name][1] for name in names}, unit, asked.shot.film_mm)


def _maps(figure: Any, maps: Mapping[str, Any], unit: str, film_mm: tuple[float, float]) -> None:
    """Maps of effects of one unit, upright, in one scale of colours with its bar."""
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    colours: Any = "magma"
    if unit == "px":
        low, high = error_scale(maps.values(), 98)
        norm = log_norm(low, high)
        maps = {name: np.maximum(value, low) for name, value in maps.items()}
    else:
        maps = {name: 100 * value for name, value in maps.items()}
        high = error_scale([np.abs(value) for value in maps.values()], 98)[1]
        norm, colours = Normalize(-high, high), LinearSegmentedColormap.from_list("signed", _SIGNED)
    cells = figure.subplots(-(-len(maps) // _MAPS_A_ROW), _MAPS_A_ROW, squeeze=False)
    for axes, (name, value) in zip(cells.ravel(), maps.items(), strict=False):
        extent = (0, film_mm[0], 0, film_mm[1])
        picture = axes.imshow(value, extent=extent, cmap=colours, norm=norm, interpolation="nearest")
        axes.set_title(name, fontsize=8)
        axes.set(xticks=[], yticks=[])
    for axes in cells.ravel()[len(maps) :]:
        axes.set_axis_off()
    bar = figure.colorbar(picture, ax=cells, extend="both", aspect=12 * len(cells), pad=0.015)
    bar.ax.tick_params(labelsize=6.5)
    bar.set_label(_TITLES[unit], fontsize=7)
    if unit == "px":
        plain_log_ticks(bar.ax.yaxis)


def _bars_and_trade(plan: Plan, figure: Any) -> None:
    wide = [e for e in plan.effects if e.unit == "px"][::-1]
    bars, trade = figure.subplots(1, 2, width_ratios=(1.0, 1.1))
    least = max(min((e.worth for e in wide if e.worth > 0), default=1e-3) / 3, 1e-4)
    colours = [family_colour("ols") if e.needed else "#b8b8b8" for e in wide]
    bars.barh([e.name for e in wide], [max(e.worth, least) for e in wide], color=colours, left=0)
    bars.set_xscale("log")
    bars.set_xlim(left=least)
    bars.set_xlabel("worth (pixels), grey: left out")
    _cameras(trade, plan)
    trade.set_xlabel(f"{plan.unit_s} of the {plan.what}, --for {plan.target}")
    if plan.budget_px > 0:
        bars.axvline(plan.budget_px, color=CHOSEN, lw=1.2)
    plain_log_ticks(bars.xaxis)


def _cameras(axes: Any, plan: Plan) -> None:
    """Errors of cameras over their least time, with their median: within the budget in colour, the chosen one with a
    ring. From a noisy time a line leads to the median of its repeats."""
    timed = [c for c in plan.choices if 0 < c.seconds < float("inf") and c.error_px < float("inf")]
    points = [(c.seconds, max(c.error_px, 1e-4)) for c in timed]
    axes.scatter(*np.reshape(points, (-1, 2)).T, c=["#0072b2" if c.within else "#b8b8b8" for c in timed], s=26)
    ring = {"s": 150, "fc": "none", "ec": CHOSEN, "lw": 1.8}
    for point in (p for p, c in zip(points, timed, strict=True) if c == plan.best):
        axes.scatter(*point, **ring)
    noisy_lines(axes, [(y, x, x + c.more) for (x, y), c in zip(points, timed, strict=True) if c.noisy])
    axes.set(xscale="log", yscale="log", ylabel="error (pixels; none is drawn at 0.0001)")
    place_labels(axes, points, [c.name.rpartition(".")[2] or c.name for c in timed])  # a model without its lens
    if plan.budget_px > 0:
        axes.axhline(plan.budget_px, color=CHOSEN, lw=1.2, label=f"budget {plan.budget_px:g} px; ring: chosen")
    if any(axes.get_legend_handles_labels()):
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), frameon=False, ncols=2)
    plain_log_ticks(axes.xaxis, axes.yaxis)


def plot_trade(plan: Plan, path: Path, title: str) -> None:
    """Error of every camera against its seconds, with the front of those that no other betters."""
    best = plan.front
    subtitle = f"--for {plan.target}; 95% of the picture keeps these errors"
    with drawing(path, 8.5, 5.0, title, subtitle) as figure:
        axes = figure.subplots()
        at = [c.seconds for c in best], [max(c.error_px, 1e-4) for c in best]
        axes.step(*at, where="post", color=INK, lw=1.2, alpha=0.7, label="no camera betters both")
        axes.set_xlabel(f"{plan.unit_s} of the {plan.what}, one thread, to equal noise")
        _cameras(axes, plan)
