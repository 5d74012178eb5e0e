"""`neurolens plan SCENE --lens LENS`: what a scene asks of a lens, and the cheapest camera that meets it."""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from neurolens.base.files import atomic_write_text, library, write_json
from neurolens.base.html import html
from neurolens.base.records import NOISY, plain, program
from neurolens.base.settings import setting, setting_of
from neurolens.cli import arguments as cli
from neurolens.optics.lens.shot import Dispersion, Shot
from neurolens.studies import pages

if TYPE_CHECKING:
    from neurolens.cameras.contract import FloatArray
    from neurolens.optics.lens.prescription import Lens
    from neurolens.studies.plan import plan as plans
    from neurolens.studies.plan.candidates import Choice
    from neurolens.studies.plan.probe import SceneNeeds

    Shown = tuple[FloatArray, list[plans.CameraPicture]]

_LEAST_S = 1e-3  # a picture's time is known no finer
_BUDGETS = {"px": "pixels, as 0.25px", "s": "seconds, as 20s"}


def _budget(text: str) -> tuple[str, float]:
    """Read --budget: its unit, which is pixels where none is given, and the number."""
    return cli.amount(f"{text}px" if text[-1:] in set("0123456789.") else text, _BUDGETS)


@dataclass(frozen=True, kw_only=True)
class Plan(cli.Figures):
    """Say how many pixels each effect of a lens is worth in a scene, and choose the cheapest camera whose error stays
    within a budget. The choice is among a pinhole, with or without its picture warped afterwards, a thin or thick lens,
    a model that ships, a polynomial fitted for this shot alone, and the exact lens. Needs the extra "train" (torch).

    Errors are distances between the pictures of a point by a camera and by the exact lens, the least RMS way on which
    light moves, and the relative error of light, of which 1% is allowed; 95% of the picture keep both. The cost of a
    path, measured here on one thread, times the noise of its picture is proportional to the time to equal error; for
    our renderer the whole picture counts. Cameras that take up to 1.2 times the least are alike, and the exact lens is
    chosen where it is one of them. A plan that takes more than a tenth of its picture's time says so first."""

    epilog = """\
examples:
  neurolens plan garden --lens laikin_double_gauss_50 --budget 0.25px
  neurolens plan scene.toml --lens my_lens.toml --budget 1px --for onnx --explain -o runs/plan
  neurolens plan garden --lens laikin_double_gauss_50 --trade

-o leaves plan.json (all of it), effects.png (effects, and where in the picture those are that a camera needs),
models/ with what was fitted, and plan.toml: 'render' and 'export' take it for the camera, and 'train' fits a
model of the shot from it, from scratch. --trade leaves trade.html besides, a page with trade.png and pictures.png."""
    kept = "models fitted so far are kept, the plan is not written"

    scene: Path = setting(
        ..., "scene file (.toml), or its name in experiments/scenes", positional=True, metavar="SCENE",
        kind=cli.scene_file,
    )  # fmt: skip
    lens: Path = cli.lens()
    budget: tuple[str, float] = setting(
        ("px", 0.25), "error allowed, as 0.25px (default); or time, as 20s: of one thread, for the scene's size and "
        "samples, for which the most faithful camera is chosen", kind=_budget, metavar="BUDGET", common=True,
    )  # fmt: skip
    target: Literal["render", "c", "onnx", "osl", "glsl"] = setting(
        "render", "what runs the camera: our renderer, compiled C, onnxruntime, Blender's Cycles (osl), or a renderer "
        "in GLSL (default: render)", option="for",
    )  # fmt: skip
    comp: Collection[str] = setting(
        (), "what compositing makes of the picture later, distortion (with its light, by an ST map), defocus or both "
        "with a comma: the camera is held against the lens without it", metavar="EFFECTS",
        kind=cli.words_of(("distortion", "defocus")),
    )  # fmt: skip
    dispersion: Dispersion = setting_of(Shot, "dispersion")
    denoise: bool = setting(False, "noise is taken out later: charge no camera for it")
    zoom: str | None = setting(
        None, "state of the lens by name, or a focal length in mm between its states", metavar="STATE", common=True
    )
    explain: bool = setting(False, "time and list every camera, and look for flare, however long that takes")
    trade: bool = setting(
        False, "the same, and draw every camera by its error in pixels and by its seconds to equal noise on one page, "
        "with pictures", common=True,
    )  # fmt: skip
    samples: int | None = setting(None, "per pixel, of the pictures of --trade (default: 16)", within=(1, 4096))
    no_fit: bool = setting(False, "fit nothing for the shot")
    out: Path | None = cli.output_path("FOLDER", "for the plan (default: runs/plan-SCENE-LENS)", None)

    def run(self) -> int:
        """Plan, write, print; return 1 where no camera for this target is within the budget."""
        if self.samples is not None and not self.trade:
            self.refuse("--samples", self.samples, "--trade beside it")
        began = os.times()
        from neurolens.optics.readers.any_format import read_any
        from neurolens.pictures.render.scene import load_scene
        from neurolens.studies.plan import plan as plans

        lens, scene = read_any(self.lens), load_scene(self.scene)
        folder = self.out or Path("runs") / f"plan-{scene.name}-{lens.lens_id}"
        cli.check_written(folder, "--output", "FOLDER")
        unit, most = self.budget
        with self.progress({"plan": 10}).stage("plan") as report:
            result = plans.plan(
                scene, lens, **{f"budget_{unit}": most}, target=self.target, models=shipped_models(lens, self.zoom),
                folder=None if self.no_fit else folder / "models", explain=self.explain or self.trade, report=report,
                zoom=self.zoom, afterwards=self.comp, denoised=self.denoise, dispersion=self.dispersion or "full",
            )  # fmt: skip
            shown = plans.pictures(result, self.samples or 16, report) if self.trade else None
        took = sum(os.times()[:4]) - sum(began[:4])  # of the processor, compilers included
        title = f"{scene.name} through {lens.name}"
        data: dict[str, Any] = plain({"scene": str(self.scene), "lens": str(self.lens), **result.to_dict()})
        data |= {"plan_s": took, "front": [c.name for c in result.front], "half": result.half and result.half.name}
        folder.mkdir(parents=True, exist_ok=True)
        written = ["plan.json", "effects.png"]
        if result.best:
            atomic_write_text(folder / "plan.toml", result.to_toml(lens, folder))
            written.append("plan.toml")
        if shown is not None:
            data["flip"] = {picture.choice.name: picture.flip for picture in shown[1]}
            _draw_trade(result, shown, folder, title, self.samples or 16)
            written += ["trade.html", "trade.png", "pictures.png"]
        write_json(folder / "plan.json", data)
        plans.plot_effects(result, folder / "effects.png", title)
        return self.answer(data, lambda: _text(self, result, data, folder, written), 0 if result.best else 1)


def shipped_models(lens: Lens, zoom: str | None) -> list[Path]:
    """Return the models that ship for a lens, or for a state of its zoom, by its id and its figures."""
    from neurolens.models.card import read_card
    from neurolens.optics.setting.states import set_lens

    name = lens.lens_id if zoom is None else f"{lens.lens_id}-{zoom}"
    files = sorted((library() / "models").glob(f"{name}.*.onnx"))
    figures = set_lens(lens, zoom=zoom).sha256 if files else ""
    return [file for file in files if read_card(file)["lens"]["sha256"] == figures]


def _text(command: Plan, result: plans.Plan, data: Mapping[str, Any], folder: Path, written: Sequence[str]) -> str:
    from neurolens.studies.plan.probe import STRAY

    rows = [
        (e.name, cli.number(e.worth, 3), cli.number(e.median, 3), "px" if e.unit == "px" else "of light",
         f"{100 * e.over:.0f}%", e.why) if e.worth < math.inf else (e.name, "?", "", "", "", e.why)
        for e in result.effects
    ]  # fmt: skip
    every = command.explain or command.trade
    parts = [*_dear(result, data["plan_s"], every), _needs(result.asked)]
    parts.append(cli.table(("effect", "worth", "median", "", "beyond", ""), rows))
    if stray := [e.name for e in result.effects if e.name in STRAY.values() and e.needed and e.worth < math.inf]:
        parts.append(f"No camera makes {', '.join(stray)}: a table [flare] in the scene does, or 'neurolens flare'.")
    if every:
        names, records, columns = _cameras(result, data.get("flip", {}))
        cells = [(name, *(c.cell(r) for c in columns), r["how"]) for name, r in zip(names, records, strict=True)]
        legend = ["● to use, ○ no other betters it", *(f"{c.heading}: {c.about}" for c in columns)]
        parts += [cli.table(("camera", *(c.heading for c in columns), ""), cells), "\n".join(legend)]
    commands = _commands(command, result, result.best, folder) if result.best else ()
    parts.append("\n".join([*_sentences(result, command.trade), *commands]))
    return "\n\n".join([*parts, f"Written: {folder}/{', '.join(written)}"])


def _dear(result: plans.Plan, took: float, every: bool) -> list[str]:
    """Tell that a plan took more than its share of the time of the picture that it is for, and why.

    Nothing is returned where it did not, or where the picture's time is not known.
    """
    from neurolens.studies.plan.plan import SHARE

    best = result.best
    if best is None or not any(result.work.rest) or took <= SHARE * best.seconds:
        return []
    why = "every camera was timed, as asked" if every else "setting up a lens takes seconds, however small the picture"
    ratio = took / max(best.seconds, _LEAST_S)
    spent, times = (cli.number(float(f"{value:.2g}"), 3) for value in (took, ratio))
    return [f"This plan took {spent} CPU seconds, {times} times its picture: {why}."]


def _needs(asked: SceneNeeds) -> str:
    """Tell what the scene asks of the lens."""
    near, far = asked.nearest_m, asked.farthest_m
    view = "nothing with a distance" if near is None else f"{near:.4g} to {far:.4g} m"
    return (
        f"f/{asked.f_number:.3g}, focus {asked.shot.focus_m:g} m, in view {view}, {100 * asked.distant:.0f}% of the "
        f"picture is distant; a pixel is {1e3 * asked.pixel_mm:.3g} um\n"
        f"light from {asked.light_nm[0]:.0f} to {asked.light_nm[1]:.0f} nm"
    )


def _sentences(result: plans.Plan, half: bool = False) -> list[str]:
    """Tell the camera to use and its price, or that there is none; `half` adds what half of its time buys."""
    best, seconds, unit = result.best, result.budget_s, result.unit_s
    if best is None:
        nearest = min(result.choices, key=lambda c: c.error_px, default=None)
        closest = f"; the closest is {nearest.name} with {cli.number(nearest.error_px, 3)} px" if nearest else ""
        keeps = f"keeps {result.budget_px:g} px{closest}" if seconds is None else f"takes {seconds:g} s"
        return [f"No camera for --for {result.target} {keeps}."]
    allowed = f"of {result.budget_px:g}" if seconds is None else f"within {seconds:g} s"
    lines = [f"Use {_short(best)}{f', {best.how}' * bool(best.how)}: {cli.number(best.error_px, 3)} px {allowed}."]
    if any(result.work.rest):
        lines.append(
            f"The picture takes about {cli.number(best.seconds, 2)} s of one thread to the noise that the scene's "
            f"samples have with the exact lens, the camera {cli.number(best.camera_seconds, 2)} s of that."
        )
    else:
        lines.append(f"The camera takes about {cli.number(best.seconds, 2)} {unit} for all paths of the picture.")
    if len(result.alike) > 1:
        lines.append(f"Any of these takes about as long: {', '.join(result.alike)}.")
    if (times := result.work.noise[best.disperses]) > 1 and not result.asked.denoised:
        more = f"Dispersion takes {cli.number(times, 2)} times the samples"
        lines.append(f"{more}; --dispersion lateral leaves longitudinal colour out.")
    if half:
        bought = result.half or result.front[0]
        buys = "buys" if result.half else "buys no camera; the least is"
        lines.append(
            f"Half of that time {buys} {_short(bought)}: {cli.number(bought.seconds, 2)} {unit}, "
            f"{cli.number(bought.error_px, 3)} px."
        )
        if later := " and ".join(result.asked.afterwards):
            lines.append(f"Pixels leave out {later}, which compositing adds; the pictures and their FLIP do not.")
    return lines


def _commands(command: Plan, result: plans.Plan, best: Choice, folder: Path) -> list[str]:
    """Return the command that makes the camera for the target; none for ideal cameras, which every renderer has."""
    ideal = best.camera.startswith(("pinhole:", "thin:", "thick:"))
    lens = result.probed.lens
    model, shape = best.camera.endswith(".onnx"), lens.aperture
    state = ["--zoom", command.zoom] if command.zoom is not None and not model else []
    state += ["--dispersion", command.dispersion] if command.dispersion not in (None, "full") else []
    words = ["render", str(command.scene), "--camera", f"{folder}/plan.toml", *state, "-o", "render.exr"]
    if model and shape is not None and shape.blades:  # models have no blades of their own
        words += ["--blades", f"{shape.blades}", "--blade-rotation", f"{shape.rotation_deg:g}"]
        words += ["--blade-curvature", f"{shape.curvature:g}"]
    if result.target != "render":
        if ideal or result.target == "onnx":
            return []
        language, request = result.target, result.asked
        words = ["export", f"{folder}/plan.toml", "--to", language, *state, "-o", f"camera.{language}"]
        if language != "osl":  # in OSL they are inputs
            film, focus = "x".join(f"{v:g}" for v in request.shot.film_mm), f"{request.shot.focus_m:g}"
            words[2:2] = f"--whole-camera --film {film} --focus {focus} --f-number {request.f_number:.6g}".split()
    return [f"  {program()} {shlex.join(words)}"]


def _short(choice: Choice) -> str:
    return choice.name.rpartition(".")[2]


def _cameras(result: plans.Plan, flips: Mapping[str, float]) -> pages.Table:
    """List every camera with its figures: a disc marks the choice for the budget, a ring one that no other betters."""
    front = result.front
    records = [
        {**asdict(c), "seconds": {"min": c.seconds, "median": c.seconds + c.more}, "flip": flips.get(c.name)}
        for c in result.choices
    ]
    of = f"of the {result.what}, one thread, to the exact lens's noise with the scene's samples; ~ noisy: the median "
    of += f"of some calls took more than {NOISY:g} times the least, which is shown"
    columns = (
        pages.Column("error, px", "error_px", about="distance of footprints that 95% of the picture keep"),
        pages.Column("light, %", "light_error", 100, 2, "relative error of light that 95% of the picture keep"),
        pages.Column(result.unit_s, "seconds.min", about=of),
        pages.Column("in the camera", "camera_seconds", digits=2, about=f"{result.unit_s} of these"),
        pages.Column("noise", "noise", about="times the paths that equal error takes"),
        pages.Column("FLIP", "flip", digits=2, about="of the small pictures, from the exact lens's"),
    )
    marks = ["● " if c == result.best else "○ " if c in front else "" for c in result.choices]
    return pages.table([f"{m}{_short(c)}" for m, c in zip(marks, result.choices, strict=True)], records, columns)


def _draw_trade(result: plans.Plan, shown: Shown, folder: Path, title: str, samples: int) -> None:
    """Write the page of a trade and its two figures."""
    from neurolens.studies.plan.plan import plot_trade
    from neurolens.studies.scenes import side_by_side

    plot_trade(result, folder / "trade.png", title)
    exact, some = shown
    pictures = {"● " * (s.choice == result.best) + _short(s.choice): s for s in some if s.choice.error_px > 0}
    named = "● exact" if result.best is not None and result.best.error_px == 0 else "exact"
    side_by_side(
        {named: exact, **{k: s.rgb for k, s in pictures.items()}}, {k: s.difference for k, s in pictures.items()},
        folder / "pictures.png",
        {k: f"{cli.number(s.choice.seconds, 2)} {result.unit_s}, {cli.number(s.choice.error_px, 2)} px\n"
            f"FLIP {cli.number(s.flip, 2)}" for k, s in pictures.items()},
    )  # fmt: skip
    caption = (
        f"{samples} samples a pixel each, the same random numbers. Below each its FLIP difference from the "
        "exact lens's picture: with noise, where a camera makes other rays of the same numbers, as thin lenses do."
    )
    figures = [
        {"file": "trade.png", "title": "Error against time", "caption": "Ring: the choice for the budget."},
        {"file": "pictures.png", "title": "What is seen", "caption": caption},
    ]
    parts = pages.figures_of(folder, [{**f, "wide": True} for f in figures], inside=True)
    table = _cameras(result, {s.choice.name: s.flip for s in some})
    page = html("trade.html", title=title, lead=_sentences(result, half=True), shown=parts, cameras=table)
    atomic_write_text(folder / "trade.html", page)
