"""Plans the camera for a scene by a budget of error or time, and shows the trade of error against time.

A camera's error is how far its footprints are from the exact lens's in pixels, and how far its light is, at the places
of a scene that a `probe` finds; both are counted at the 95th percentile over the picture. Its cost is the time of a
path in the target, times the noise of its picture: see `costs`. In C and onnxruntime it is measured here, on one
thread; for shaders it is counted. The cheapest camera within the budget is chosen. Those that take about as long are
alike, and the exact lens is taken where it is one of them.

Seconds are those of one thread's processor, for the whole picture at the scene's own size, to the noise that the exact
lens has with the scene's samples. What a path takes besides its camera, and how dispersion adds to noise, is measured
on strips of the picture in our renderer. In other targets the camera alone counts, in Cycles under a white sky; there
cameras are alike up to `pages.SAVING`, because what else a path takes is not known.

A plan should take at most a tenth of its picture's time. So it renders strips in proportion to the picture, tries no
model where none could save enough, and looks for the light that the lens adds, which takes seconds, only where a tenth
of the picture's time has room for that.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
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
from neurolens.cameras.build import as_c, ideal_as, with_dispersion
from neurolens.cameras.contract import FloatArray
from neurolens.optics.analysis.plots import INK, drawing, plain_log_ticks
from neurolens.optics.lens.prescription import Lens
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.scene import Scene
from neurolens.studies.experiment import DomainChoice, EvaluationChoice, Experiment, LensChoice
from neurolens.studies.pages import SAVING, recommended
from neurolens.studies.plan.candidates import EXACT, PAIRS, Choice, Target, camera_of, candidates, shot_domain
from neurolens.studies.plan.costs import ALONE, UNIT, Work, noise, ns_a_ray, small, work_of
from neurolens.studies.plan.probe import LIGHT, Effect, Probe, SceneNeeds, effects_of, probe
from neurolens.studies.plots import CHOSEN, error_scale, family_colour, log_norm, noisy_lines, place_labels
from neurolens.studies.scenes import Image, flip_map

_SHOT_KEYS = "film_mm", "focus_m", "f_number", "wavelength_nm"  # settings of the shot in `Plan.to_dict`
_ACROSS, _SAMPLES = 240, 16  # width and samples of pictures
_SHOWN = 8  # the most pictures, besides the exact lens's
ALIKE = 1.2  # whose pictures take up to so many times the least: costs are no more accurate
_BUDGETS = (1.0, 0.25, 0.05)  # for which polynomials are fitted where every camera is asked for
SHARE = 0.1  # the most that a plan should take of its picture's time
_WHOLE_S = 20.0  # the most CPU seconds of a plan with the light that the lens adds, whatever the picture


@dataclass(frozen=True)
class Plan:
    """A scene's needs, its effects by falling worth, every camera tried by rising cost, and the one to use.

    Attributes:
        budget_s: the seconds the picture may take, or None where an error was asked for. Where given, `budget_px` is
            the error of the best camera that keeps to them.
        unit: of costs: "ns" or, where no time is known, "operations". domain: of models that are fitted.
        work: what a path takes besides its camera, in the same unit; none where the camera alone counts.
        alike: names of the cameras within the budget that take about as long as the cheapest; the best is one of them.
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
    work: Work = ALONE
    alike: tuple[str, ...] = ()

    @property
    def what(self) -> str:
        """What the seconds of its cameras are for, in words: the whole picture, or the camera alone."""
        return "whole picture" if any(self.work.rest) else "camera"

    @property
    def front(self) -> list[Choice]:
        """The cameras that no other betters, see `front`."""
        return front(self.choices)

    @property
    def half(self) -> Choice | None:
        """The best camera for half of the seconds that the chosen one's picture takes."""
        return None if self.best is None else best_within(self.choices, self.best.seconds / 2)

    @property
    def unit_s(self) -> str:
        """The unit of `Choice.seconds`."""
        return "s" if self.unit == "ns" else "10^9 operations"

    def to_dict(self) -> dict[str, Any]:
        """Return all fields but `probed` as JSON holds them."""
        fields = asdict(replace(self, probed=None))  # type: ignore[arg-type]
        del fields["probed"]
        shot = fields["asked"].pop("shot")
        fields["asked"] = {name: shot[name] for name in _SHOT_KEYS} | fields["asked"]
        return fields

    def to_toml(self, lens: Lens, folder: Path) -> str:
        """The text of a file in a folder, from which other commands go on; paths in it are relative to the folder.

        `render` and `export` take it for the best camera. `train` takes it as the experiment that fits that camera,
        where this is a model of the shot.
        """
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
    scene: Scene, lens: Lens, budget_px: float = 0.25, *, budget_s: float | None = None, target: Target = "render",
    models: Sequence[Path] = (), folder: Path | None = None, explain: bool = False, report: Report | None = None,
    **look: Any,
) -> Plan:  # fmt: skip
    """Find the cheapest camera for a scene within a budget of error, or the most faithful one for a time.

    Where the cheapest camera saves too little to tell, it is the exact lens. In our renderer the whole picture counts.

    Args:
        lens: as its file has it. budget_px: error of place and blur in pixels of the scene's picture.
        budget_s: seconds of one thread that the picture may take, in place of an error; every camera is timed.
        target: what runs the camera: our renderer with all it has, compiled C, onnxruntime, Blender's Cycles (osl), or
            a renderer in GLSL.
        models: exported models of this lens to try. folder: where models fitted for the shot go; None fits none.
        explain: whether cameras beyond the budget are compiled and timed, too (else their cost is infinite), and the
            light that the lens adds is looked for, however long that takes.
        look: further arguments of `probe`: zoom, dispersion, and what happens to the picture later.

    Raises:
        InputError: a budget is negative or no number; seconds for a target whose time is not known; part of the
            dispersion for a target other than our renderer; as `probe`.
    """
    if not budget_px >= 0:
        raise InputError("plan", "budget_px", budget_px, "0 or more pixels")
    if budget_s is not None and not (budget_s > 0 and UNIT[target] == "ns"):
        told = f"({budget_s:g} s for {target})"
        raise InputError("plan", "budget_s", told, "above 0, and a target whose time is known")
    probed = probe(scene, lens, **look)
    work = work_for(scene, probed, target)
    every = explain or budget_s is not None
    if not every and exact_suffices(probed, work):
        models, folder = (), None
    budgets = (*_BUDGETS, 0.0 if budget_s is not None else budget_px) if every else (budget_px,)
    tried = candidates(probed, budgets, target, models=models, folder=folder, explain=every, report=report, work=work)
    return decided(probed, tried, budget_px, target, work, budget_s, explain)


def work_for(scene: Scene, probed: Probe, target: Target) -> Work:
    """Measure the work of a path: in our renderer on strips of the picture; in other targets the camera alone counts.

    Raises:
        InputError: part of the dispersion for another target.
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
    """Return whether even a model that costs nothing would save too little, so that nothing needs to be fitted."""
    rest = work.rest[probed.exact.dispersive]
    exact = ns_a_ray(probed.exact, probed.places)["min"] if rest else math.inf
    return recommended((0.0,), float, exact, rest, ALIKE) == exact


def _alike(work: Work) -> float:
    """Return the factor up to which costs count as the same."""
    return ALIKE if any(work.rest) else SAVING


def decided(
    probed: Probe, tried: Sequence[Choice], budget_px: float, target: Target, work: Work | None = None,
    budget_s: float | None = None, explain: bool = True,
) -> Plan:  # fmt: skip
    """Decide the plan for a budget, from candidates that serve it.

    Args:
        work: that of a path; with None the cheapest camera is chosen, whatever it saves. explain: see `plan`.
    """
    known, ranked = work or ALONE, in_seconds(probed, tried, work or ALONE)
    alike: tuple[str, ...] = ()
    if budget_s is not None:
        ranked = [replace(c, within=c.seconds <= budget_s and c.light_error <= LIGHT) for c in ranked]
        best = best_within(ranked, budget_s)
        budget_px = math.inf if best is None else best.error_px
    else:
        ranked = [replace(c, within=c.meets(budget_px)) for c in ranked]
        held = [c for c in ranked if c.within]
        exact = next((c for c in held if c.name == EXACT and math.isfinite(c.cost)), None) if work else None
        best = recommended(held, lambda c: c.seconds, exact, saving=_alike(known))
        alike = tuple(c.name for c in held if c.seconds <= _alike(known) * held[0].seconds)
    room = explain or best is None or not any(known.rest) or SHARE * best.seconds > _WHOLE_S
    return Plan(
        probed.asked, budget_px, budget_s, target, UNIT[target], shot_domain(probed),
        effects_of(probed, budget_px, stray=room), tuple(ranked), best, probed, known, alike,
    )  # fmt: skip


def in_seconds(probed: Probe, tried: Sequence[Choice], work: Work) -> list[Choice]:
    """Return cameras by rising seconds, to the noise that the exact lens has with the scene's samples."""
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
    """A camera's small picture [H, W, 3], linear, and its FLIP from the exact lens's with the same random numbers."""

    choice: Choice
    rgb: FloatArray
    difference: Image

    @property
    def flip(self) -> float:
        """The mean of the differences."""
        return float(self.difference.mean())


def front(choices: Sequence[Choice]) -> list[Choice]:
    """Return the cameras with the right light that no other betters in error and seconds."""
    bright = [c for c in choices if c.light_error <= LIGHT and math.isfinite(c.seconds)]
    return [bright[i] for i in pareto_front([(c.seconds, c.error_px) for c in bright])]


def best_within(choices: Sequence[Choice], seconds: float) -> Choice | None:
    """Return the most faithful camera whose picture takes no longer than `seconds`."""
    affordable = (c for c in front(choices) if c.seconds <= seconds)
    return min(affordable, key=lambda c: (c.error_px, c.seconds), default=None)


def pictures(plan: Plan, samples: int, report: Report) -> tuple[FloatArray, list[CameraPicture]]:
    """Render the exact lens's small picture, and those of cameras that no other betters, also the chosen one's.

    All have equal samples and the same random numbers.
    """
    scene, some = plan.probed.scene, spread(plan.front, plan.best)
    film = replace(scene.settings.film, wavelengths="one")  # so that all cameras share their random numbers
    width, height = small(scene, _ACROSS)
    drawn = partial(render, scene, width=width, height=height, samples=samples, film=film)
    exact = drawn(plan.probed.exact).rgb
    shown = []
    for k, choice in enumerate(some):
        report((k + 1) / (len(some) + 1))
        same = choice.error_px == 0
        rgb = exact if same else drawn(camera_of(plan.probed, choice)).rgb
        shown.append(CameraPicture(choice, rgb, np.zeros(rgb.shape[:2]) if same else flip_map(rgb, exact)))
    return exact, shown


def spread(choices: Sequence[Choice], chosen: Choice | None, most: int = _SHOWN) -> list[Choice]:
    """Choose at most `most` of a front, evenly, and the chosen camera with them, even where it is not on the front."""
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
# Light that an effect takes is drawn dark, light that it adds orange, and none white.
_SIGNED = ("#10183a", "#4d6796", "#c9d1de", "#ffffff", "#f6cfae", "#e58a45", CHOSEN)
# By unit of effects: a factor on values, the sign after them, and the labels of bars and of maps.
_DRAWN = {
    "px": (1.0, " px", "worth (pixels); grey: left out", "pixels"),
    "relative": (100.0, "%", "worth (% of the light); grey: left out", "% of the light\n(dark: taken)"),
}


def plot_effects(plan: Plan, path: Path, title: str) -> None:
    """Draw effects as bars beside the budget, and maps of those that a camera needs, on one scale for each unit."""
    asked, shown = plan.asked, [e for e in plan.effects if math.isfinite(e.worth)]
    needed = [e.name for e in shown if e.needed]
    known = plan.probed.camera_maps
    maps = {name: (known if name in known else plan.probed.maps)[name] for name in needed}
    below = 1.5 * -(-len(maps) // _MAPS_A_ROW)
    subtitle = f"f/{asked.f_number:.3g}, focus {asked.shot.focus_m:g} m; 95% of the picture keeps these figures"
    with drawing(path, 9.5, 3.6 + below, title, subtitle) as figure:
        above, *rest = figure.subfigures(2, 1, height_ratios=(3.6, below)) if maps else [figure]
        for axes, unit, budget in zip(above.subplots(1, 2), _DRAWN, (plan.budget_px, LIGHT), strict=True):
            _bars(axes, [e for e in shown if e.unit == unit][::-1], unit, budget)
        for part in rest:
            _maps(part, maps, asked.shot.film_mm)


def _bars(axes: Any, effects: Sequence[Effect], unit: str, budget: float) -> None:
    factor, sign, label, _ = _DRAWN[unit]
    worths = [factor * e.worth for e in effects]
    least = max(min((w for w in worths if w > 0), default=1e-3) / 3, 1e-4)
    colours = [family_colour("ols") if e.needed else "#b8b8b8" for e in effects]
    axes.barh([e.name for e in effects], [max(w, least) for w in worths], color=colours, left=0)
    axes.set(xscale="log", xlabel=label)
    axes.set_xlim(left=least)
    if 0 < budget < math.inf:
        axes.axvline(factor * budget, color=CHOSEN, lw=1.2, label=f"budget {factor * budget:g}{sign}")
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), frameon=False)
    plain_log_ticks(axes.xaxis)


def _maps(figure: Any, maps: Mapping[str, tuple[str, Any]], film_mm: tuple[float, float]) -> None:
    """Draw maps of effects, upright, with a colour bar for each unit."""
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    rows, across = -(-len(maps) // _MAPS_A_ROW), min(len(maps), _MAPS_A_ROW)
    cells = figure.subplots(rows, across, squeeze=False)
    for axes in cells.ravel():
        axes.set_axis_off()
    for unit, (factor, _, _, label) in _DRAWN.items():
        drawn = {name: factor * value for name, (one, value) in maps.items() if one == unit}
        if not drawn:
            continue
        low, high = error_scale([np.abs(value) for value in drawn.values()], 98)
        norm, colours = (log_norm(low, high), "magma") if unit == "px" else (
            Normalize(-high, high), LinearSegmentedColormap.from_list("signed", _SIGNED)
        )  # fmt: skip
        for axes, (name, (one, _)) in zip(cells.ravel(), maps.items(), strict=False):
            if one == unit:
                value = np.maximum(drawn[name], low) if unit == "px" else drawn[name]
                picture = axes.imshow(value, extent=(0, film_mm[0], 0, film_mm[1]), cmap=colours, norm=norm)
                axes.set_title(name, fontsize=8)
        bar = figure.colorbar(picture, ax=cells, extend="both", aspect=12 * rows, pad=0.015)
        bar.ax.tick_params(labelsize=6.5)
        bar.set_label(label, fontsize=7)
        if unit == "px":
            plain_log_ticks(bar.ax.yaxis)


def _cameras(axes: Any, plan: Plan) -> None:
    """Draw errors of cameras over their least time: those within the budget in colour, the chosen one with a ring.

    From a noisy time a line leads to the median of its repeats.
    """
    timed = [c for c in plan.choices if 0 < c.seconds < float("inf") and c.error_px < float("inf")]
    points = [(c.seconds, max(c.error_px, 1e-4)) for c in timed]
    axes.scatter(*np.reshape(points, (-1, 2)).T, c=["#0072b2" if c.within else "#b8b8b8" for c in timed], s=26)
    ring = {"s": 150, "fc": "none", "ec": CHOSEN, "lw": 1.8}
    for point in (p for p, c in zip(points, timed, strict=True) if c == plan.best):
        axes.scatter(*point, **ring)
    noisy_lines(axes, [(y, x, x + c.more) for (x, y), c in zip(points, timed, strict=True) if c.noisy])
    axes.set(xscale="log", yscale="log", ylabel="error (pixels; none is drawn at 0.0001)")
    # models without the name of their lens
    place_labels(axes, points, [c.name.rpartition(".")[2] or c.name for c in timed])
    if plan.budget_px > 0:
        axes.axhline(plan.budget_px, color=CHOSEN, lw=1.2, label=f"budget {plan.budget_px:g} px; ring: chosen")
    if any(axes.get_legend_handles_labels()):
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), frameon=False, ncols=2)
    plain_log_ticks(axes.xaxis, axes.yaxis)


def plot_trade(plan: Plan, path: Path, title: str) -> None:
    """Draw the error of every camera against its seconds, with the front of those that no other betters."""
    best = plan.front
    subtitle = f"--for {plan.target}; 95% of the picture keeps these errors"
    with drawing(path, 8.5, 5.0, title, subtitle) as figure:
        axes = figure.subplots()
        at = [c.seconds for c in best], [max(c.error_px, 1e-4) for c in best]
        axes.step(*at, where="post", color=INK, lw=1.2, alpha=0.7, label="no camera betters both")
        axes.set_xlabel(f"{plan.unit_s} of the {plan.what}, one thread, to equal noise")
        _cameras(axes, plan)
