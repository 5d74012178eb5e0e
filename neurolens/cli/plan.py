"""`neurolens plan SCENE --lens LENS`: what a scene asks of a lens, and the cheapest camera that meets it."""

from __future__ import annotations

import argparse
import json
import re
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens.base.errors import InputError
from neurolens.base.files import atomic_path, atomic_write_text
from neurolens.base.progress import Progress
from neurolens.base.records import NOISY, plain, program
from neurolens.cli.arguments import add_glass, add_json, add_lens, add_output, check_run_folder, whole
from neurolens.cli.output import answer, number, table
from neurolens.cli.plan_frames import run_plan_frames
from neurolens.cli.render_frames import add_frames
from neurolens.cli.trade import look_of, run_trade, shipped_models

if TYPE_CHECKING:
    from neurolens.plan.plan import Choice, Plan

# Repeated here, so that help imports no torch; a test compares with `plan.plan`.
TARGETS = ("render", "c", "onnx", "osl", "glsl")
_DESCRIPTION = """\
Look through the exact lens at a scene, say what each of its effects is worth there in pixels, and choose
the cheapest camera whose error stays within the budget: a pinhole, with or without its picture warped
afterwards, a thin or thick lens, a model that ships, a polynomial fitted for this shot alone, or the
exact lens. Needs the extra "train" (torch).

Errors are distances between footprints, the picture of a point by a camera and by the exact lens: the
least RMS way on which light moves to turn one into the other, in pixels of the scene's picture (place,
size and shape of the blur, each wavelength by itself), and the relative error of light, of which 1% is
allowed. Both are those that 95% of the picture keep. The cost of a ray, times the noise of its weights,
is proportional to the time to equal error: measured here, on one thread; of Cycles counted and turned
into its nanoseconds, measured once; of GLSL in operations. The exact lens is chosen where the cheapest
camera would not make the whole work 1.5 times as fast; for our renderer the rest of a picture counts,
too."""
_EPILOG = """\
examples:
  neurolens plan experiments/scenes/garden.toml --lens laikin_double_gauss_50 --budget 0.25px
  neurolens plan scene.toml --lens my_lens.toml --budget 1px --for onnx --explain -o runs/plan
  neurolens plan scene.toml --lens my_lens.toml --frames 1:48 --key focus=1:0.8,48:3
  neurolens plan experiments/scenes/garden.toml --lens laikin_double_gauss_50 --trade

-o leaves plan.json (all of it), effects.png (effects, and where in the picture those are that a camera needs),
models/ with what was fitted, and plan.toml: 'render' and 'export' take it for the camera, and 'train' fits a
model of the shot from it, from scratch.

--trade draws what the scene's error costs, marks the cameras that no other betters and the choice for the budget,
and says what half of its time would buy. Seconds are of one thread, for the scene's own size and samples, and what
a camera adds to them: its rays, and what the scene takes for the further rays that its noise asks for. What the
scene takes by itself stands beside them; a small picture in our renderer measures it. Of other targets the camera
alone counts, in Cycles under a white sky; of GLSL its operations. -o (default: runs/trade-SCENE-LENS) leaves
trade.html (one page that needs no other file: small pictures side by side, their difference from the exact lens's,
the table), trade.png, trade.json and models/ with what was fitted."""


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "plan", help="what a scene asks of a lens, and the camera to use", description=_DESCRIPTION,
        epilog=_EPILOG,
    )  # fmt: skip
    parser.add_argument("scene", metavar="SCENE", type=Path, help="scene file (.toml)")
    add_lens(parser, "--lens", required=True)
    parser.add_argument(
        "--budget", metavar="BUDGET", type=_budget, default=0.25,
        help="error allowed, as 0.25px (default); or as 0.02flip: mean FLIP of strips of the picture, at its own "
        "pixels; or time, as 20s: of one thread, for the scene's size and samples, for which the most faithful camera "
        "is chosen",
    )  # fmt: skip
    parser.add_argument(
        "--for", dest="target", choices=TARGETS, default="render",
        help="what runs the camera: our renderer, compiled C, onnxruntime, Blender's Cycles (osl), or a renderer in "
        "GLSL (default: render)",
    )  # fmt: skip
    _add_look(parser)
    parser.add_argument("--explain", action="store_true", help="time and list every camera tried")
    parser.add_argument(
        "--trade", action="store_true",
        help="draw every camera by its error in pixels and by its seconds to equal noise on one page, with pictures",
    )  # fmt: skip
    parser.add_argument(
        "--samples", metavar="N", type=whole(1, 4096), help="per pixel, of the pictures of --trade (default: 16)"
    )
    parser.add_argument(
        "--sample-map", action="store_true",
        help="write samples.exr, too, of the scene's size: the diameter of each pixel's blur in pixels (layer blur, "
        "and R, G and B) and its depth in m (Z), for samplers that give more samples where blur is wide",
    )  # fmt: skip
    parser.add_argument("--no-fit", action="store_true", help="fit nothing for the shot")
    add_output(parser, "FOLDER", "for the plan (default: runs/plan-SCENE-LENS)")
    add_frames(parser, "one plan for these frames, whose models are reused: the fewest that keep the budget")
    add_glass(parser)
    add_json(parser, quiet=True)
    parser.set_defaults(run=run, kept="models fitted so far are kept, the plan is not written")


def _add_look(parser: argparse.ArgumentParser) -> None:
    """Add --comp, --denoise and --zoom."""
    parser.add_argument(
        "--comp", metavar="EFFECTS", type=_afterwards, default=(), dest="afterwards",
        help="what compositing makes of the picture later, distortion (with its light, by an ST map), defocus or both "
        "with a comma: the camera is held against the lens without it",
    )  # fmt: skip
    parser.add_argument("--denoise", action="store_true", help="noise is taken out later: charge no camera for it")
    parser.add_argument(
        "--zoom", metavar="STATE", help="state of the lens by name, or a focal length in mm between its states"
    )


class Seconds(float):
    """A budget of time."""


class Flip(float):
    """A budget of what is seen."""


def _budget(text: str) -> float:
    if text.endswith("s"):
        return Seconds(_number(text, "s", "seconds, as 20s"))
    if text.endswith("flip"):
        return Flip(_number(text, "flip", "FLIP, as 0.02flip"))
    return _number(text, "px", "pixels, as 0.25px, FLIP, as 0.02flip, or seconds, as 20s")


def _number(text: str, unit: str, expected: str) -> float:
    match = re.fullmatch(rf"([0-9.]{{1,20}}(?:e[+-]?[0-9]{{1,3}})?)({unit})?", text)
    try:
        if match and 0 <= (value := float(match[1])) < 1e12:
            return value
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"got {text!r}, expected {expected}")


def _afterwards(text: str) -> tuple[str, ...]:
    words = tuple(text.split(","))
    if set(words) <= {"distortion", "defocus"}:
        return words
    raise argparse.ArgumentTypeError(f"got {text!r}, expected distortion, defocus or distortion,defocus")


def run(args: argparse.Namespace) -> int:
    """Plan, write, print; 1 where no camera for this target is within the budget."""
    if args.trade:
        return _run_trade(args)
    if args.samples is not None:
        raise InputError("neurolens plan", "--samples", args.samples, "--trade beside it (a map: --sample-map)")
    from neurolens.plan.plan import plan
    from neurolens.plan.plots import plot_effects
    from neurolens.plan.trade import plan_seen, plan_within
    from neurolens.readers.any_format import read_any
    from neurolens.render.scene import load_scene

    lens = read_any(args.lens)
    scene = load_scene(args.scene)
    folder = args.out or Path("runs") / f"plan-{scene.name}-{lens.lens_id}"
    check_run_folder(folder, "neurolens plan", "--output")
    shipped = shipped_models(lens, args.zoom)
    if args.frames is not None:
        if args.zoom is not None or isinstance(args.budget, (Seconds, Flip)):
            expected = "a budget in pixels, and the zoom as a key, with --frames"
            raise InputError("neurolens plan", "--budget, --zoom", f"{args.budget:g}, {args.zoom}", expected)
        return run_plan_frames(args, lens, shipped, folder)
    progress = Progress({"plan": 10} | ({"map of samples": 2} if args.sample_map else {}), quiet=args.quiet)
    with progress.stage("plan") as report:
        look: dict[str, Any] = {**look_of(args), "report": report}
        look |= {"target": args.target, "models": shipped, "folder": None if args.no_fit else folder / "models"}
        if isinstance(args.budget, Seconds):
            found = plan_within(scene, lens, args.budget, **look)
        elif isinstance(args.budget, Flip):
            found = plan_seen(scene, lens, args.budget, **look)
        else:
            found = plan(scene, lens, args.budget, explain=args.explain, **look)
    folder.mkdir(parents=True, exist_ok=True)
    data = plain({"scene": str(args.scene), "lens": str(args.lens), **found.to_dict()})
    with atomic_path(folder / "plan.json") as part:
        part.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    if found.best:
        atomic_write_text(folder / "plan.toml", found.to_toml(lens, folder))
    plot_effects(found, folder / "effects.png", f"{scene.name} through {lens.name}")
    if args.sample_map:
        with progress.stage("map of samples"):
            _write_samples(found, folder / "samples.exr")
    answer(args, data, lambda: _text(args, found, folder))
    return 0 if found.best else 1


def _run_trade(args: argparse.Namespace) -> int:
    others = {"--explain": args.explain, "--sample-map": args.sample_map, "--frames": args.frames, "--key": args.key}
    for option, given in others.items():
        if given:
            raise InputError("neurolens plan", option, "(beside --trade)", "one or the other")
    if isinstance(args.budget, (Seconds, Flip)):
        raise InputError("neurolens plan", "--budget", f"{args.budget:g}", "pixels, as 0.25px, beside --trade")
    return run_trade(args)


def _write_samples(found: Plan, path: Path) -> None:
    from neurolens.plan.samples import blur_map
    from neurolens.render.pictures import standard_attributes, write_exr

    blur, depth = blur_map(found.probed)
    attributes = standard_attributes(found.probed.exact.settings, *blur.shape[::-1])
    meaning = {"blur": "diameter in pixels of the disc whose light is as far from its middle, RMS"}
    rgb = blur[..., None].repeat(3, -1)
    write_exr(path, rgb, metadata={"meaning": meaning}, layers={"blur": blur, "depth": depth}, attributes=attributes)


def _text(args: argparse.Namespace, found: Plan, folder: Path) -> str:
    from neurolens.plan.light import STRAY

    asked = found.asked
    view = "nothing with a distance" if asked.nearest_m is None else (
        f"{asked.nearest_m:.4g} to {asked.farthest_m:.4g} m"
    )  # fmt: skip
    facts = f"f/{asked.f_number:.3g}, focus {asked.shot.focus_m:g} m, in view {view}"
    facts += f", {100 * asked.distant:.0f}% of the picture is distant; a pixel is {1e3 * asked.pixel_mm:.3g} um"
    facts += (
        f"\nlight from {asked.light_nm[0]:.0f} to {asked.light_nm[1]:.0f} nm; blur differs between neighbours over "
    )
    facts += f"{100 * asked.edges:.0f}% of the picture"
    if asked.edge_contrast is not None:
        facts += f", of contrast {number(asked.edge_contrast, 2)} there (elsewhere {number(asked.contrast, 2)})"
    rows = [
        (e.name, number(e.worth, 3), number(e.median, 3), "px" if e.unit == "px" else "of light",
         f"{100 * e.over:.0f}%", e.why)
        for e in found.effects
    ]  # fmt: skip
    parts = [facts, table(("effect", "worth", "median", "", "beyond", ""), rows)]
    if stray := [e.name for e in found.effects if e.name in STRAY.values() and e.needed]:
        parts.append(f"No camera makes {', '.join(stray)}: a table [flare] in the scene does, or 'neurolens flare'.")
    if args.explain:
        header = ("", "camera", "px", "light", found.unit, "noise", "")
        parts.append(table(header, [
            ("*" if c == found.best else "+" if c.within else "", c.name, number(c.error_px, 3),
             number(c.light_error, 2), "~" * c.noisy + number(c.cost, 3), number(c.noise, 3), c.how)
            for c in found.choices
        ], left=2))  # fmt: skip
        parts.append(
            "* to use, + within the budget; px, light: errors that 95% of the picture keep; "
            f"{found.unit} a ray times noise, the rays it takes for equal error; ~ noisy: the median of its calls took "
            f"more than {NOISY:g} times the least, which is shown"
        )
    best = found.best
    if best is None and found.budget_s is not None:
        parts.append(f"No camera for --for {found.target} takes {found.budget_s:g} s.")
    elif best is None and found.budget_flip is not None:
        parts.append(f"No camera for --for {found.target} keeps a FLIP of {found.budget_flip:g}.")
    elif best is None:
        nearest = min(found.choices, key=lambda c: c.error_px, default=None)
        closest = f"; the closest is {nearest.name} with {number(nearest.error_px, 3)} px" if nearest else ""
        parts.append(f"No camera for --for {found.target} keeps {found.budget_px:g} px{closest}.")
    else:
        allowed = f"within {found.budget_s:g} s" if found.budget_s is not None else f"of {found.budget_px:g}"
        if found.budget_flip is not None:
            allowed = f"FLIP {number(best.flip, 2)} of {found.budget_flip:g}"
        told = f"Use {best.name}: {number(best.error_px, 3)} px {allowed}, {number(best.cost, 3)} "
        told += f"{found.unit} a ray times noise"
        if best.error_px == 0 and found.rest:
            told += f"; a path takes {number(found.rest, 3)} besides, and no camera with an error saves enough of that"
        parts.append("\n".join([f"{told}{', ' + best.how if best.how else ''}", *_commands(args, found, best, folder)]))
    written = ["plan.json", "effects.png", *["plan.toml"] * bool(best), *["samples.exr"] * args.sample_map]
    return "\n\n".join([*parts, f"Written: {folder}/{', '.join(written)}"])


def _commands(args: argparse.Namespace, found: Plan, best: Choice, folder: Path) -> list[str]:
    """How the camera is made where the target runs it; ideal cameras are everybody's own."""
    ideal = best.camera.startswith(("pinhole:", "thin:", "thick:"))
    lens = found.probed.lens
    model, shape = best.camera.endswith(".onnx"), lens.aperture
    state = ["--zoom", args.zoom] if args.zoom is not None and not model else []
    words = ["render", str(args.scene), "--camera", f"{folder}/plan.toml", *state, "-o", "render.exr"]
    if model and shape is not None and shape.blades:  # models have none of their own
        words += ["--blades", f"{shape.blades}", "--blade-rotation", f"{shape.rotation_deg:g}"]
        words += ["--blade-curvature", f"{shape.curvature:g}"]
    if found.target != "render":
        if ideal or found.target == "onnx":
            return []
        language, asked = found.target, found.asked
        words = ["export", f"{folder}/plan.toml", "--to", language, *state, "-o", f"camera.{language}"]
        if language != "osl":  # whose inputs they are
            film, focus = "x".join(f"{v:g}" for v in asked.shot.film_mm), f"{asked.shot.focus_m:g}"
            words[2:2] = [
                "--whole-camera",
                "--film",
                film,
                "--focus",
                focus,
                "--f-number",
                f"{asked.f_number:.6g}",
            ]
    return [f"  {program()} {shlex.join(words)}"]
