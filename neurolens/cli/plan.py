"""`neurolens plan SCENE --lens LENS`: what a scene asks of a lens, and the cheapest camera that meets it."""

from __future__ import annotations

import os
import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from neurolens.base.errors import program
from neurolens.base.files import atomic_write_text, library, write_json
from neurolens.base.report import BULK, PART, Report, plain
from neurolens.base.settings import setting
from neurolens.cli import arguments as cli
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.setting.states import set_lens

if TYPE_CHECKING:
    from neurolens.optics.lens.prescription import Lens
    from neurolens.studies.plan import plan as plans


def _budget(text: str) -> float:
    """Read --budget: a number of pixels, with or without its unit."""
    return cli.amount(f"{text}px" if text[-1:] in set("0123456789.") else text, {"px": "pixels, as 0.25px"})[1]


@dataclass(frozen=True, kw_only=True)
class Plan(cli.Figures):
    """Say how many pixels each effect of a lens is worth in a scene, and choose the cheapest camera whose error stays
    within a budget. The choice is among a pinhole, with or without its picture warped afterwards, a thin or thick lens,
    a model that ships, a polynomial fitted for this shot alone, and the exact lens. Needs the extra "train" (torch).

    The error of a point is the least RMS way that its light must move to become the exact lens's picture of it. Light
    itself may be wrong by 1%. 95% of the picture keep both. The price is the time of the picture to equal noise,
    measured here on one thread. Cameras within 1.2 times the least price count as equal, and the exact lens is chosen
    where it is one of them. A plan that takes more than a tenth of its picture's time says so first."""

    epilog = """\
examples:
  neurolens plan garden --lens laikin_double_gauss_50 --budget 0.25px
  neurolens plan scene.toml --lens my_lens.toml --budget 1px --for onnx --explain -o runs/plan

The folder holds plan.json (all figures), effects.png (where in the picture each effect is), models/ (what was
fitted), and plan.toml, which 'render' and 'export' take for the camera."""
    kept = "models fitted so far are kept, the plan is not written"

    scene: Path = setting(
        ..., "scene file (.toml), or its name in experiments/scenes", positional=True, metavar="SCENE",
        kind=cli.scene_file,
    )  # fmt: skip
    lens: Path = cli.lens(old=("camera",))
    budget: float = setting(
        0.25, "error allowed, as 0.25px (default)", kind=_budget, metavar="BUDGET", common=True,
    )  # fmt: skip
    target: Literal["render", "c", "onnx"] = setting(
        "render", "what runs the camera: our renderer, where the whole picture counts, or compiled C or onnxruntime in "
        "another program, where the camera alone counts (default: render)", option="for",
    )  # fmt: skip
    zoom: str | None = setting(
        None, "state of the lens by name, or a focal length in mm between its states", metavar="STATE", common=True
    )
    explain: bool = setting(False, "time and list every camera, and look for flare, however long that takes")
    no_fit: bool = setting(False, "fit nothing for the shot")
    out: Path | None = cli.output_path("FOLDER", "for the plan (default: runs/plan-SCENE-LENS)", None)

    def run(self) -> int:
        """Plan, write, print; return 1 where no camera for this target is within the budget."""
        began = os.times()
        from neurolens.pictures.render.scene import load_scene
        from neurolens.studies.plan.effects_plot import plot_effects
        from neurolens.studies.plan.plan import plan

        tabled, scene = read_any(self.lens), load_scene(self.scene)
        lens = tabled if self.zoom is None else set_lens(tabled, zoom=self.zoom)
        folder = self.out or Path("runs") / f"plan-{scene.name}-{lens.lens_id}"
        cli.check_written(folder, "--output", "FOLDER")
        with self.progress({"plan": 10}).stage("plan"):
            made = plan(
                scene, lens, self.budget, target=self.target, models=shipped_models(tabled, self.zoom),
                folder=None if self.no_fit else folder / "models", explain=self.explain,
            )  # fmt: skip
        took = sum(os.times()[:4]) - sum(began[:4])  # of the processor, compilers included
        folder.mkdir(parents=True, exist_ok=True)
        if made.best:
            atomic_write_text(folder / "plan.toml", made.to_toml(folder))
        command = _command(self, made, folder)
        answer = Planned(str(self.scene), str(self.lens), made, took, command, self.explain, folder)
        write_json(folder / "plan.json", plain(answer, full=False))
        plot_effects(made, folder / "effects.png", f"{scene.name} through {lens.name}")
        return self.answer(answer, code=0 if made.best else 1)


def shipped_models(lens: Lens, zoom: str | None) -> list[Path]:
    """Return the models that ship for a lens, or for a state of its zoom, by its id and its figures."""
    from neurolens.models.card import read_card

    name = lens.lens_id if zoom is None else f"{lens.lens_id}-{zoom}"
    files = sorted((library() / "models").glob(f"{name}.*.onnx"))
    figures = set_lens(lens, zoom=zoom).sha256 if files else ""
    return [file for file in files if read_card(file)["lens"]["sha256"] == figures]


def _command(command: Plan, made: plans.Plan, folder: Path) -> str:
    """Return the command that makes the picture or the code with the camera to use; none where nothing needs making."""
    best, asked, shape = made.best, made.asked, made.probed.lens.aperture
    if best is None or made.target == "onnx":
        return ""
    model = best.camera.endswith(".onnx")
    state = ["--zoom", command.zoom] if command.zoom is not None and not model else []
    if made.target == "c":
        if best.camera.startswith(("pinhole:", "thin:", "thick:")):  # which every renderer has
            return ""
        film = "x".join(f"{v:g}" for v in made.probed.shot.film_mm)
        shot = f"--film {film} --focus {asked.focus_m:g} --f-number {asked.f_number:.6g}".split()
        words = ["export", f"{folder}/plan.toml", "--whole-camera", *shot, "--to", "c", *state, "-o", "camera.c"]
    else:
        words = ["render", str(command.scene), "--camera", f"{folder}/plan.toml", *state, "-o", "render.exr"]
        if model and shape is not None and shape.blades:  # models have no blades of their own
            words += ["--blades", f"{shape.blades}", "--blade-rotation", f"{shape.rotation_deg:g}"]
            words += ["--blade-curvature", f"{shape.curvature:g}"]
    return f"{program()} {shlex.join(words)}"


@dataclass(frozen=True)
class Planned(Report):
    """A plan, the processor's seconds that it took, and the command that goes on with it."""

    scene: str
    lens: str
    plan: plans.Plan = field(metadata=PART)
    plan_s: float
    command: str
    every: bool = field(metadata=BULK)
    folder: Path = field(metadata=BULK)

    def text(self) -> str:
        """Return what the scene asks, the worth of each effect, the cameras where all were timed, and the answer."""
        every = [self._cameras()] if self.every else []
        answer = "\n".join([*_sentences(self.plan), *([f"  {self.command}"] if self.command else ())])
        return "\n\n".join([*self.dear(), self._needs(), self._effects(), *every, answer, f"Written: {self.folder}/"])

    def dear(self) -> list[str]:
        """Tell that a plan took more than its share of the time of the picture that it is for.

        Nothing is returned where it did not, or where the picture's time is not known.
        """
        from neurolens.studies.plan.plan import SHARE

        best = self.plan.best
        if best is None or not self.plan.work.whole or self.plan_s <= SHARE * best.seconds:
            return []
        ratio = self.plan_s / max(best.seconds, 1e-3)  # a picture's time is known no finer
        spent, times = (cli.number(float(f"{value:.2g}"), 3) for value in (self.plan_s, ratio))
        return [f"This plan took {spent} CPU seconds, {times} times its picture."]

    def _needs(self) -> str:
        """Tell what the scene asks of the lens."""
        asked = self.plan.asked
        near, far = asked.nearest_m, asked.farthest_m
        view = "nothing with a distance" if near is None else f"{near:.4g} to {far:.4g} m"
        return (
            f"f/{asked.f_number:.3g}, focus {asked.focus_m:g} m, in view {view}, {100 * asked.distant:.0f}% of the "
            f"picture is distant; a pixel is {1e3 * asked.pixel_mm:.3g} um\n"
            f"light from {asked.light_nm[0]:.0f} to {asked.light_nm[1]:.0f} nm"
        )

    def _effects(self) -> str:
        from neurolens.studies.plan.probe import STRAY

        rows = [
            (e.name, cli.number(e.worth, 3), "px" if e.unit == "px" else "of light", f"{100 * e.over:.0f}%",
             "" if e.needed else "left out")
            for e in self.plan.effects
        ]  # fmt: skip
        told = cli.table(("effect", "worth", "", "beyond", ""), rows)
        stray = [e for e in self.plan.effects if e.name in STRAY.values()]
        if not stray:
            hint = "" if self.every else ": --explain looks for it, in about a minute"
            return f"{told}\n\nFlare is not known{hint}."
        needed = ", ".join(e.name for e in stray if e.needed)
        made = f"\n\nNo camera makes {needed}: a table [flare] in the scene does, or 'neurolens flare'."
        return told + made * bool(needed)

    def _cameras(self) -> str:
        """List every camera with its figures."""
        rows = [
            (c.short, cli.number(c.error_px, 3), cli.number(100 * c.light_error, 2), cli.number(c.seconds, 3), c.how)
            for c in self.plan.choices
        ]
        return (
            f"{cli.table(('camera', 'error, px', 'light, %', 's', ''), rows)}\n\n"
            "error, light: distance of footprints, and relative error of light, that 95% of the picture keep\n"
            f"s: of the {'whole picture' if self.plan.work.whole else 'camera'}, one thread, to the exact lens's noise "
            "with the scene's samples"
        )


def _sentences(plan: plans.Plan) -> list[str]:
    """Tell the camera to use and its price, or that there is none."""
    best, seconds = plan.best, (lambda value: cli.number(value, 2))
    if best is None:
        nearest = min(plan.choices, key=lambda c: c.error_px, default=None)
        closest = f"; the closest is {nearest.name} with {cli.number(nearest.error_px, 3)} px" if nearest else ""
        return [f"No camera for --for {plan.target} keeps {plan.budget_px:g} px{closest}."]
    how = f" ({best.how})" * bool(best.how)
    lines = [f"Use {best.short}{how}. Its error is {cli.number(best.error_px, 3)} px of {plan.budget_px:g} allowed."]
    if plan.work.whole:
        noise = "the noise that the scene's samples have with the exact lens"
        lines.append(f"The picture takes about {seconds(best.seconds)} s of one thread to {noise}.")
    else:
        lines.append(f"The camera takes about {seconds(best.seconds)} s for all paths of the picture.")
    if len(plan.alike) > 1:
        lines.append(f"Any of these takes about as long: {', '.join(plan.alike)}.")
    if (times := plan.work.noise[best.disperses]) > 1:
        more = f"Dispersion takes {seconds(times)} times the samples"
        lines.append(f"{more}; 'neurolens render --dispersion lateral' leaves longitudinal colour out.")
    return lines
