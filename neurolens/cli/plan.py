"""`neurolens plan SCENE --lens LENS`: what a scene asks of a lens, and the cheapest camera that meets it."""

from __future__ import annotations

import shlex
import time
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from neurolens.base.files import atomic_write_text, library, write_json
from neurolens.base.html import html
from neurolens.base.records import NOISY, plain, program
from neurolens.base.settings import setting, setting_of
from neurolens.cli import arguments as cli
from neurolens.lens.shot import Dispersion, Shot
from neurolens.study import pages

if TYPE_CHECKING:
    from neurolens.lens.prescription import Lens
    from neurolens.plan import plan as plans
    from neurolens.plan.candidates import Choice
    from neurolens.plan.plan import Trade
    from neurolens.plan.probe import SceneNeeds
    from neurolens.render.scene import Scene


_SHARE = 0.1  # of the time of its picture, which a plan may take without a word
_BUDGETS = {"px": "pixels, as 0.25px", "flip": "FLIP, as 0.02flip", "s": "seconds, as 20s"}


def _budget(text: str) -> tuple[str, float]:
    """Type of --budget: its unit, pixels where it has none, and the number."""
    return cli.amount(f"{text}px" if text[-1:] in set("0123456789.") else text, _BUDGETS)


@dataclass(frozen=True, kw_only=True)
class Plan(cli.Reporting):
    """Look through the exact lens at a scene, say what each of its effects is worth there in pixels, and choose
    the cheapest camera whose error stays within the budget: a pinhole, with or without its picture warped
    afterwards, a thin or thick lens, a model that ships, a polynomial fitted for this shot alone, or the
    exact lens. Needs the extra "train" (torch).

    Errors are distances between the pictures of a point by a camera and by the exact lens, the least RMS way on which
    light moves, and the relative error of light, of which 1% is allowed; 95% of the picture keep both. The cost of a
    path, measured here on one thread, times the noise of its picture is proportional to the time to equal error; for
    our renderer the whole picture counts. Cameras that take up to 1.2 times the least are alike, and the exact lens is
    chosen where it is one of them."""

    epilog = """\
examples:
  neurolens plan experiments/scenes/garden.toml --lens laikin_double_gauss_50 --budget 0.25px
  neurolens plan scene.toml --lens my_lens.toml --budget 1px --for onnx --explain -o runs/plan
  neurolens plan experiments/scenes/garden.toml --lens laikin_double_gauss_50 --trade

-o leaves plan.json (all of it), effects.png (effects, and where in the picture those are that a camera needs),
models/ with what was fitted, and plan.toml: 'render' and 'export' take it for the camera, and 'train' fits a
model of the shot from it, from scratch. --trade leaves trade.html (a page with small pictures side by side),
trade.png and trade.json (default: runs/trade-SCENE-LENS)."""
    kept = "models fitted so far are kept, the plan is not written"

    scene: Path = setting(..., "scene file (.toml)", positional=True, metavar="SCENE")
    lens: Path = cli.lens()
    budget: tuple[str, float] = setting(
        ("px", 0.25), "error allowed, as 0.25px (default); or as 0.02flip: mean FLIP of strips of the picture, at its "
        "own pixels; or time, as 20s: of one thread, for the scene's size and samples, for which the most faithful "
        "camera is chosen", kind=_budget, metavar="BUDGET",
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
        None, "state of the lens by name, or a focal length in mm between its states", metavar="STATE"
    )
    explain: bool = setting(False, "time and list every camera tried")
    trade: bool = setting(
        False, "draw every camera by its error in pixels and by its seconds to equal noise on one page, with pictures"
    )
    samples: int | None = setting(None, "per pixel, of the pictures of --trade (default: 16)", within=(1, 4096))
    no_fit: bool = setting(False, "fit nothing for the shot")
    out: Path | None = cli.output_path("FOLDER", "for the plan (default: runs/plan-SCENE-LENS)", None)

    def run(self) -> int:
        """Plan, write, print; 1 where no camera for this target is within the budget."""
        self._check()
        from neurolens.readers.any_format import read_any
        from neurolens.render.scene import load_scene

        lens, scene = read_any(self.lens), load_scene(self.scene)
        kind = "trade" if self.trade else "plan"
        folder = self.out or Path("runs") / f"{kind}-{scene.name}-{lens.lens_id}"
        cli.check_written(folder, "--output", "FOLDER")
        look: dict[str, Any] = {
            "target": self.target, "models": shipped_models(lens, self.zoom), "afterwards": self.comp,
            "denoised": self.denoise, "dispersion": self.dispersion or "full",
            "folder": None if self.no_fit else folder / "models",
        }  # fmt: skip
        if self.trade:
            from neurolens.plan.plan import trade

            with self.progress({"trade": 30}).stage("trade") as report:
                look |= {"samples": self.samples or 16, "zoom": self.zoom, "report": report}
                traded = trade(scene, lens, self.budget[1], **look)
            return self._trade(traded, folder, f"{scene.name} through {lens.name}")
        return self._plan(scene, lens, folder, look)

    def _check(self) -> None:
        """Refuse options that exclude each other."""
        if self.trade and self.explain:
            self.refuse("--explain", "(beside --trade)", "one or the other")
        if self.trade and self.budget[0] != "px":
            self.refuse("--budget", f"{self.budget[1]:g}{self.budget[0]}", "pixels, as 0.25px, beside --trade")
        if self.samples is not None and not self.trade:
            self.refuse("--samples", self.samples, "--trade beside it")

    def _plan(self, scene: Scene, lens: Lens, folder: Path, look: Mapping[str, Any]) -> int:
        """Plan, write and print."""
        from neurolens.plan.plan import plan, plan_seen, plan_within, plot_effects

        began = time.process_time()
        with self.progress({"plan": 10}).stage("plan") as report:
            more = {**look, "zoom": self.zoom, "report": report}
            unit, most = self.budget
            if unit == "px":
                result = plan(scene, lens, most, explain=self.explain, **more)
            else:
                result = (plan_within if unit == "s" else plan_seen)(scene, lens, most, **more)
        took = time.process_time() - began
        data: dict[str, Any] = plain({"scene": str(self.scene), "lens": str(self.lens), **result.to_dict()})
        write_json(folder / "plan.json", data)
        if result.best:
            atomic_write_text(folder / "plan.toml", result.to_toml(lens, folder))
        plot_effects(result, folder / "effects.png", f"{scene.name} through {lens.name}")
        return self.answer(data, lambda: _text(self, result, folder, took), 0 if result.best else 1)

    def _trade(self, result: Trade, folder: Path, title: str) -> int:
        """Draw, write, print; 1 where no camera keeps the budget."""
        from neurolens.plan.plan import plot_trade
        from neurolens.study.scenes import side_by_side

        folder.mkdir(parents=True, exist_ok=True)
        plot_trade(result.plan, folder / "trade.png", title)
        made, chosen = result.plan, result.plan.best
        pictures = {"● " * (s.choice == chosen) + _short(s.choice): s for s in result.shown if s.choice.error_px > 0}
        exact = "● exact" if chosen is not None and chosen.error_px == 0 else "exact"
        side_by_side(
            {exact: result.exact, **{k: s.rgb for k, s in pictures.items()}},
            {k: s.difference for k, s in pictures.items()}, folder / "pictures.png",
            {k: f"{_time(made, s.choice)}, {cli.number(s.choice.error_px, 2)} px\nFLIP {cli.number(s.flip, 2)}"
             for k, s in pictures.items()},
        )  # fmt: skip
        atomic_write_text(folder / "trade.html", _trade_page(result, folder, title))
        flips = {s.choice.name: s.flip for s in result.shown}
        rows = [{**asdict(c), "flip": flips.get(c.name)} for c in made.choices]
        data: dict[str, Any] = {"scene": str(self.scene), "lens": str(self.lens), "target": self.target}
        data |= {"unit": made.unit_s, "work": asdict(made.work), "cameras": rows, "alike": made.alike}
        data |= {"front": [c.name for c in made.front], "chosen": chosen and chosen.name}
        data |= {"half": result.half and result.half.name}
        write_json(folder / "trade.json", plain(data))
        return self.answer(data, lambda: _trade_text(result, folder), 0 if chosen else 1)


def shipped_models(lens: Lens, zoom: str | None) -> list[Path]:
    """The models that ship of a lens, or of a state of its zoom, by its id and its figures."""
    from neurolens.setting.states import set_lens
    from neurolens.surrogates.card import read_card

    name = lens.lens_id if zoom is None else f"{lens.lens_id}-{zoom}"
    files = sorted((library() / "models").glob(f"{name}.*.onnx"))
    figures = set_lens(lens, zoom=zoom).sha256 if files else ""
    return [file for file in files if read_card(file)["lens"]["sha256"] == figures]


def _text(command: Plan, result: plans.Plan, folder: Path, took: float) -> str:
    from neurolens.plan.probe import STRAY

    rows = [
        (e.name, cli.number(e.worth, 3), cli.number(e.median, 3), "px" if e.unit == "px" else "of light",
         f"{100 * e.over:.0f}%", e.why)
        for e in result.effects
    ]  # fmt: skip
    parts = [_needs(result.asked), cli.table(("effect", "worth", "median", "", "beyond", ""), rows)]
    if stray := [e.name for e in result.effects if e.name in STRAY.values() and e.needed]:
        parts.append(f"No camera makes {', '.join(stray)}: a table [flare] in the scene does, or 'neurolens flare'.")
    if command.explain:
        header = ("", "camera", "px", "light", result.unit, "noise", "")
        parts.append(cli.table(header, [
            ("*" if c == result.best else "+" if c.within else "", c.name, cli.number(c.error_px, 3),
             cli.number(c.light_error, 2), "~" * c.noisy + cli.number(c.cost, 3), cli.number(c.noise, 3), c.how)
            for c in result.choices
        ], left=2))  # fmt: skip
        parts.append(
            "* to use, + within the budget; px, light: errors that 95% of the picture keep; "
            f"{result.unit} of the camera on a path times noise, the paths it takes for equal error; ~ noisy: the "
            f"median of its calls took more than {NOISY:g} times the least, which is shown"
        )
    parts.append(
        "\n".join([_use(result, took), *(_commands(command, result, result.best, folder) if result.best else ())])
    )
    written = ["plan.json", "effects.png", *["plan.toml"] * bool(result.best)]
    return "\n\n".join([*parts, f"Written: {folder}/{', '.join(written)}"])


def _needs(asked: SceneNeeds) -> str:
    """What the scene asks of the lens."""
    near, far = asked.nearest_m, asked.farthest_m
    view = "nothing with a distance" if near is None else f"{near:.4g} to {far:.4g} m"
    contrast = ""
    if asked.edge_contrast is not None:
        at_edges, elsewhere = cli.number(asked.edge_contrast, 2), cli.number(asked.contrast, 2)
        contrast = f", of contrast {at_edges} there (elsewhere {elsewhere})"
    return (
        f"f/{asked.f_number:.3g}, focus {asked.shot.focus_m:g} m, in view {view}, {100 * asked.distant:.0f}% of the "
        f"picture is distant; a pixel is {1e3 * asked.pixel_mm:.3g} um\n"
        f"light from {asked.light_nm[0]:.0f} to {asked.light_nm[1]:.0f} nm; blur differs between neighbours over "
        f"{100 * asked.edges:.0f}% of the picture{contrast}"
    )


def _use(result: plans.Plan, took: float) -> str:
    """The camera to use and its price, or that there is none; `took`: CPU seconds of the plan."""
    best, seconds, flip = result.best, result.budget_s, result.budget_flip
    if best is None:
        nearest = min(result.choices, key=lambda c: c.error_px, default=None)
        closest = f"; the closest is {nearest.name} with {cli.number(nearest.error_px, 3)} px" if nearest else ""
        keeps = f"keeps a FLIP of {flip:g}" if flip is not None else f"keeps {result.budget_px:g} px{closest}"
        return f"No camera for --for {result.target} {keeps if seconds is None else f'takes {seconds:g} s'}."
    allowed = f"of {result.budget_px:g}" if flip is None else f"FLIP {cli.number(best.flip, 2)} of {flip:g}"
    allowed = allowed if seconds is None else f"within {seconds:g} s"
    lines = [f"Use {best.name}: {cli.number(best.error_px, 3)} px {allowed}"]
    if result.work.rest[best.disperses]:
        price, took = (float(f"{value:.2g}") for value in (best.seconds, took))
        lines.append(
            f"The picture takes about {cli.number(price)} s of one thread to the noise that the scene's samples "
            f"have with the exact lens, the camera {cli.number(best.camera_seconds, 2)} s of that"
        )
        if took > _SHARE * price:
            lines.append(
                f"This plan took {cli.number(took)} CPU seconds, {cli.number(took / price, 2)} times as long: it is "
                "worth them for many frames or more samples"
            )
    else:
        lines[0] += f", {cli.number(best.cost, 3)} {result.unit} a path times noise"
    if len(result.alike) > 1:
        lines.append(f"Any of these takes about as long: {', '.join(result.alike)}")
    if (times := result.work.noise[best.disperses]) > 1 and not result.asked.denoised:
        more = f"Dispersion takes {cli.number(times, 2)} times the samples"
        lines.append(f"{more}; --dispersion lateral leaves longitudinal colour out")
    return ".\n".join(lines) + (f", {best.how}" if best.how else "")


def _commands(command: Plan, result: plans.Plan, best: Choice, folder: Path) -> list[str]:
    """The command that makes the camera for the target; none for ideal cameras, which every renderer has."""
    ideal = best.camera.startswith(("pinhole:", "thin:", "thick:"))
    lens = result.probed.lens
    model, shape = best.camera.endswith(".onnx"), lens.aperture
    state = ["--zoom", command.zoom] if command.zoom is not None and not model else []
    state += ["--dispersion", command.dispersion] if command.dispersion not in (None, "full") else []
    words = ["render", str(command.scene), "--camera", f"{folder}/plan.toml", *state, "-o", "render.exr"]
    if model and shape is not None and shape.blades:  # models have none of their own
        words += ["--blades", f"{shape.blades}", "--blade-rotation", f"{shape.rotation_deg:g}"]
        words += ["--blade-curvature", f"{shape.curvature:g}"]
    if result.target != "render":
        if ideal or result.target == "onnx":
            return []
        language, request = result.target, result.asked
        words = ["export", f"{folder}/plan.toml", "--to", language, *state, "-o", f"camera.{language}"]
        if language != "osl":  # whose inputs they are
            film, focus = "x".join(f"{v:g}" for v in request.shot.film_mm), f"{request.shot.focus_m:g}"
            words[2:2] = f"--whole-camera --film {film} --focus {focus} --f-number {request.f_number:.6g}".split()
    return [f"  {program()} {shlex.join(words)}"]


def _short(choice: Choice) -> str:
    return choice.name.rpartition(".")[2]


def _time(made: plans.Plan, choice: Choice) -> str:
    return f"{'~' * choice.noisy}{cli.number(choice.seconds, 3)} {made.unit_s}"


def _sentences(result: Trade) -> list[str]:
    """The choice for the budget, and what half of its time buys."""
    made, chosen, half = result.plan, result.plan.best, result.half
    if chosen is None:
        return [f"No camera keeps {made.budget_px:g} px."]
    sentences = [f"For {made.budget_px:g} px: {_short(chosen)}, with which the {made.what} takes "
            f"{_time(made, chosen)}, {cli.number(chosen.error_px, 3)} px"]  # fmt: skip
    if made.what != "camera":
        sentences[0] += f"; the camera takes {cli.number(chosen.camera_seconds, 2)} {made.unit_s} of that"
    if len(made.alike) > 1:
        sentences.append(f"Any of these takes about as long: {', '.join(made.alike)}")
    other = half or made.front[0]
    buys = (
        f"Half of that buys {_short(other)}:" if half else f"Half of that buys no camera: the least is {_short(other)},"
    )
    sentences.append(f"{buys} {_time(made, other)}, {cli.number(other.error_px, 3)} px")
    if later := " and ".join(made.asked.afterwards):
        sentences.append(
            f"Pixels leave out {later}, which compositing adds; FLIP and the pictures, taken before it, do not"
        )
    return sentences


def _cameras(result: Trade) -> pages.Table:
    """Every camera with its figures: a disc before the choice for the budget, a ring where no other betters it."""
    made, flips = result.plan, {s.choice.name: s.flip for s in result.shown}
    records = [
        {**asdict(c), "seconds": {"min": c.seconds, "median": c.seconds + c.more}, "flip": flips.get(c.name)}
        for c in made.choices
    ]
    of = f"of the {made.what}, one thread, to the exact lens's noise with the scene's samples; ~ noisy"
    columns = (
        pages.Column("error, px", "error_px", about="distance of footprints that 95% of the picture keep"),
        pages.Column("light, %", "light_error", 100, 2, "relative error of light that 95% of the picture keep"),
        pages.Column(made.unit_s, "seconds.min", about=of),
        pages.Column("in the camera", "camera_seconds", digits=2, about=f"{made.unit_s} of these"),
        pages.Column("noise", "noise", about="times the paths that equal error takes"),
        pages.Column("FLIP", "flip", digits=2, about="of the small pictures, from the exact lens's"),
    )
    front = made.front
    marks = ["● " if c == made.best else "○ " if c in front else "" for c in made.choices]
    names = [f"{m}{_short(c)}" for m, c in zip(marks, made.choices, strict=True)]
    return pages.table(names, records, columns)


def _trade_text(result: Trade, folder: Path) -> str:
    names, records, columns = _cameras(result)
    rows = [(name, *(c.cell(r) for c in columns), r["how"]) for name, r in zip(names, records, strict=True)]
    shown = cli.table(("camera", *(c.heading for c in columns), ""), rows)
    legend = ["● for the budget, ○ no other betters it", *(f"{c.heading}: {c.about}" for c in columns)]
    written = f"Written: {folder}/trade.html, trade.png, pictures.png, trade.json"
    return "\n\n".join([shown, "\n".join(legend), "\n".join(_sentences(result)), written])


def _trade_page(result: Trade, folder: Path, title: str) -> str:
    caption = (
        f"{result.samples} samples a pixel each, the same random numbers. Below each its FLIP difference from the "
        "exact lens's picture: with noise, where a camera makes other rays of the same numbers, as thin lenses do."
    )
    figures = [
        {"file": "trade.png", "title": "Error against time", "caption": "Ring: the choice for the budget."},
        {"file": "pictures.png", "title": "What is seen", "caption": caption},
    ]
    shown = pages.figures_of(folder, [{**f, "wide": True} for f in figures], inside=True)
    return html("trade.html", title=title, lead=_sentences(result), shown=shown, cameras=_cameras(result))
