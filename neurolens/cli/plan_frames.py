"""`neurolens plan --frames`: one plan for the frames of an animation."""

from __future__ import annotations

import argparse
import json
import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens.base.errors import InputError
from neurolens.base.files import atomic_path
from neurolens.base.progress import Progress
from neurolens.base.records import plain, program
from neurolens.cli.output import answer, number, table
from neurolens.cli.render_frames import frames_of

if TYPE_CHECKING:
    from neurolens.lens.prescription import Lens
    from neurolens.plan.frames import FramesPlan


def run_plan_frames(args: argparse.Namespace, lens: Lens, models: list[Path], folder: Path) -> int:
    """Plan, write, print; 1 where a frame has no camera within the budget."""
    from neurolens.plan.frames import Frame, plan_frames
    from neurolens.render.scene import load_scene, seen_from

    if args.sample_map or args.explain:
        raise InputError(
            "neurolens plan", "--frames", "(with --sample-map or --explain)", "plans of one frame for these"
        )
    scene, frames = load_scene(args.scene), []
    for frame, _, at in frames_of(args, "neurolens plan"):
        there = seen_from(scene, args.scene, at.get("position_m"), at.get("look_at_m"))
        moved: dict[str, Any] = {k: at[k] for k in ("f_number", "focus_m") if k in at}
        camera = replace(there.settings.camera, **moved)
        frames.append(Frame(frame, replace(there, settings=replace(there.settings, camera=camera)), at.get("zoom")))
    progress = Progress({"plan": 10}, quiet=args.quiet)
    with progress.stage("plan") as report:
        found = plan_frames(
            frames, lens, args.budget, target=args.target, models=models, report=report,
            folder=None if args.no_fit else folder / "models", afterwards=args.afterwards, denoised=args.denoise,
        )  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    data = plain({"scene": str(args.scene), "lens": str(args.lens), **found.to_dict()})
    with atomic_path(folder / "plan.json") as part:
        part.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    answer(args, data, lambda: _text(args, found, folder))
    return 0 if found.cost is not None else 1


def _text(args: argparse.Namespace, found: FramesPlan, folder: Path) -> str:
    effects = [
        (e.name, number(e.worth, 3), "px" if e.unit == "px" else "of light", f"{100 * e.over:.0f}%", e.why)
        for e in found.effects
    ]
    runs = [
        (f"{r.first}-{r.last}", *(("no camera", "", "", "") if (c := r.choice) is None else
         (c.name, number(c.error_px, 3), number(c.cost, 3), c.how)))
        for r in found.runs
    ]  # fmt: skip
    models = "no model is" if not found.fits else "1 model is" if found.fits == 1 else f"{found.fits} models are"
    told = f"{models} fitted; probed: frames {', '.join(map(str, found.probed))}"
    if found.cost is not None:
        told += f"; {number(found.cost, 3)} {found.unit} a ray times noise, the mean of all frames"
    parts = [
        table(("effect", "worth", "", "beyond", ""), effects),
        table(("frames", "camera", "px", found.unit, ""), runs, left=2),
        told,
    ]
    if found.target == "render":
        keys = [word for key in args.key for word in ("--key", key)]
        for r in found.runs:
            if r.choice is not None:
                words = ["render", str(args.scene), "--camera", r.choice.camera, *keys]
                parts.append(
                    f"  {program()} {shlex.join([*words, '--frames', f'{r.first}:{r.last}', '-o', 'render.exr'])}"
                )
    return "\n\n".join([*parts, f"Written: {folder}/plan.json"])
