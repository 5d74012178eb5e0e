"""`neurolens plan SCENE --lens LENS --trade`: the error of every camera for a scene against the time it takes."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens.base.files import atomic_write_text, library
from neurolens.base.progress import Progress
from neurolens.base.records import plain
from neurolens.cli.arguments import check_run_folder
from neurolens.cli.output import answer, number, table

if TYPE_CHECKING:
    from neurolens.lens.prescription import Lens
    from neurolens.plan.trade import Offer, Trade

_SAMPLES = 16  # a pixel of the small pictures


def look_of(args: argparse.Namespace) -> dict[str, Any]:
    """What --comp, --denoise and --zoom say, as arguments of `plan.probe.probe`."""
    return {"afterwards": args.afterwards, "denoised": args.denoise, "zoom": args.zoom}


def shipped_models(lens: Lens, zoom: str | None) -> list[Path]:
    """The models that ship of a lens, or of a state of its zoom, by its id and its figures."""
    from neurolens.setting.states import set_lens
    from neurolens.surrogates.card import read_card

    name = lens.lens_id if zoom is None else f"{lens.lens_id}-{zoom}"
    files = sorted((library() / "models").glob(f"{name}.*.onnx"))
    figures = set_lens(lens, zoom=zoom).sha256 if files else ""
    return [file for file in files if read_card(file)["lens"]["sha256"] == figures]


def run_trade(args: argparse.Namespace) -> int:
    """Price, draw, write, print."""
    from neurolens.plan.plots import plot_trade
    from neurolens.plan.trade import trade
    from neurolens.readers.any_format import read_any
    from neurolens.render.scene import load_scene
    from neurolens.study.figures import side_by_side

    lens, scene = read_any(args.lens), load_scene(args.scene)
    folder = args.out or Path("runs") / f"trade-{scene.name}-{lens.lens_id}"
    check_run_folder(folder, "neurolens plan", "--output")
    with Progress({"trade": 30}, quiet=args.quiet).stage("trade") as report:
        found = trade(
            scene, lens, args.budget, target=args.target, models=shipped_models(lens, args.zoom), report=report,
            samples=args.samples or _SAMPLES, folder=None if args.no_fit else folder / "models", **look_of(args),
        )  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    title = f"{scene.name} through {lens.name}"
    plot_trade(found, folder / "trade.png", title)
    chosen = found.chosen
    pictures = {_marked(s.offer, chosen): s for s in found.shown if s.offer.choice.error_px > 0}
    exact = "● exact" if chosen is not None and chosen.choice.error_px == 0 else "exact"
    side_by_side(
        {exact: found.exact, **{k: s.rgb for k, s in pictures.items()}},
        {k: s.difference for k, s in pictures.items()}, folder / "pictures.png",
        {k: f"{_time(found, s.offer)}, {number(s.offer.choice.error_px, 2)} px\nFLIP {number(s.flip, 2)}"
         for k, s in pictures.items()},
    )  # fmt: skip
    atomic_write_text(folder / "trade.html", _page(found, folder, title))
    flips = {s.offer.choice.name: s.flip for s in found.shown}
    rows = [{**asdict(o.choice), "seconds": o.seconds, "flip": flips.get(o.choice.name)} for o in found.offered]
    data = {"scene": str(args.scene), "lens": str(args.lens), "target": args.target, "unit": found.unit}
    data |= {"base": found.base, "cameras": rows, "front": [o.choice.name for o in found.front]}
    data |= {"chosen": found.chosen and found.chosen.choice.name, "half": found.half and found.half.choice.name}
    atomic_write_text(folder / "trade.json", json.dumps(plain(data), indent=1) + "\n")
    answer(args, data, lambda: _text(found, folder))
    return 0 if found.chosen else 1


def _short(offer: Offer) -> str:
    return offer.choice.name.rpartition(".")[2]


def _marked(offer: Offer, chosen: Offer | None) -> str:
    return "● " * (offer == chosen) + _short(offer)


def _seconds(offer: Offer) -> str:
    return "~" * offer.choice.noisy + number(offer.seconds, 3)


def _time(found: Trade, offer: Offer) -> str:
    return f"{_seconds(offer)} {found.unit}"


def _said(found: Trade) -> list[str]:
    """The choice for the budget, and what half of its time buys."""
    chosen, half = found.chosen, found.half
    if chosen is None:
        return [f"No camera keeps {found.plan.budget_px:g} px."]
    told = [f"For {found.plan.budget_px:g} px: {_short(chosen)}, which adds {_time(found, chosen)}, "
            f"{number(chosen.choice.error_px, 3)} px"]  # fmt: skip
    if found.base:
        told[0] += f"; the scene itself takes {number(found.base, 3)} {found.unit}"
    if half is None:
        least = found.front[0]
        told.append(f"Half of that buys no camera: the least is {_time(found, least)}, {_short(least)}, "
                    f"{number(least.choice.error_px, 3)} px")  # fmt: skip
    else:
        told.append(f"Half of that buys {_short(half)}: {_time(found, half)}, "
                    f"{number(half.choice.error_px, 3)} px")  # fmt: skip
    if later := " and ".join(found.plan.asked.afterwards):
        told.append(f"Pixels leave out {later}, which compositing adds; FLIP and the pictures, taken before it, do not")
    return told


def _text(found: Trade, folder: Path) -> str:
    flips, front = {s.offer.choice.name: s.flip for s in found.shown}, found.front
    rows = [
        ("*" if o == found.chosen else "+" if o in front else "", o.choice.name, number(o.choice.error_px, 3),
         number(o.choice.light_error, 2), _seconds(o), number(flips.get(o.choice.name), 2), o.choice.how)
        for o in found.offered
    ]  # fmt: skip
    shown = table(("", "camera", "px", "light", found.unit, "FLIP", ""), rows, left=2)
    legend = f"* for the budget, + no other betters it; {found.unit}: added, of one thread to equal noise, ~ noisy; "
    legend += f"FLIP at {found.samples} samples a pixel of the same random numbers, with noise where cameras use them "
    legend += "otherwise"
    written = f"Written: {folder}/trade.html, trade.png, pictures.png, trade.json"
    return "\n\n".join([shown, legend, "\n".join(_said(found)), written])


def _page(found: Trade, folder: Path, title: str) -> str:
    from neurolens.base.html import html
    from neurolens.study import pages

    flips = {s.offer.choice.name: s.flip for s in found.shown}
    records = [
        {**asdict(o.choice), "seconds": {"min": o.seconds, "median": o.seconds + o.more},
         "flip": flips.get(o.choice.name)} for o in found.offered
    ]  # fmt: skip
    columns = (
        pages.Column("error, px", "error_px", about="distance of footprints that 95% of the picture keep"),
        pages.Column("light, %", "light_error", 100, 2, "relative error of light that 95% of the picture keep"),
        pages.Column(
            f"{found.unit} added",
            "seconds.min",
            about="one thread, the scene's size and samples, to equal noise; ~ noisy",
        ),
        pages.Column("a ray", "cost", about=f"{found.plan.unit} times the noise"),
        pages.Column("noise", "noise", about="times the rays that equal error takes"),
        pages.Column("FLIP", "flip", digits=2, about="of the small pictures, from the exact lens's"),
    )
    front = found.front
    marks = ["● " if o == found.chosen else "○ " if o in front else "" for o in found.offered]
    names = [f"{m}{_short(o)}" for m, o in zip(marks, found.offered, strict=True)]
    told = f"{found.samples} samples a pixel each, the same random numbers. Below each its FLIP difference from the "
    told += "exact lens's picture: with noise, where a camera makes other rays of the same numbers, as thin lenses do."
    figures = [
        {"file": "trade.png", "title": "Error against time", "caption": "Ring: the choice for the budget."},
        {"file": "pictures.png", "title": "What is seen", "caption": told},
    ]
    shown = pages.figures_of(folder, [{**f, "wide": True} for f in figures], inside=True)
    cameras = pages.table(names, records, columns)
    return html("trade.html", title=title, lead=_said(found), shown=shown, cameras=cameras)
