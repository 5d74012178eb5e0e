"""The answer of `neurolens plan --trade`: the error of every camera for a scene against the time it takes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens.base.files import atomic_write_text, write_json
from neurolens.base.records import plain
from neurolens.cli.arguments import Answering
from neurolens.cli.output import number, table
from neurolens.study import pages

if TYPE_CHECKING:
    from neurolens.plan.plan import Offer, Trade


def answer_trade(command: Answering, result: Trade, folder: Path, title: str, names: Mapping[str, str]) -> int:
    """Draw, write, print; 1 where no camera keeps the budget."""
    from neurolens.plan.plots import plot_trade
    from neurolens.study.plots import side_by_side

    folder.mkdir(parents=True, exist_ok=True)
    plot_trade(result, folder / "trade.png", title)
    chosen = result.chosen
    pictures = {_marked(s.offer, chosen): s for s in result.shown if s.offer.choice.error_px > 0}
    exact = "● exact" if chosen is not None and chosen.choice.error_px == 0 else "exact"
    side_by_side(
        {exact: result.exact, **{k: s.rgb for k, s in pictures.items()}},
        {k: s.difference for k, s in pictures.items()}, folder / "pictures.png",
        {k: f"{_time(result, s.offer)}, {number(s.offer.choice.error_px, 2)} px\nFLIP {number(s.flip, 2)}"
         for k, s in pictures.items()},
    )  # fmt: skip
    atomic_write_text(folder / "trade.html", _page(result, folder, title))
    flips = {s.offer.choice.name: s.flip for s in result.shown}
    rows = [
        {**asdict(o.choice), "seconds": o.seconds, "camera_seconds": o.camera, "flip": flips.get(o.choice.name)}
        for o in result.offered
    ]
    data: dict[str, Any] = {**names, "unit": result.unit, "work": asdict(result.plan.work), "cameras": rows}
    data |= {"alike": result.plan.alike}
    data |= {"front": [o.choice.name for o in result.front], "chosen": chosen and chosen.choice.name}
    data |= {"half": result.half and result.half.choice.name}
    write_json(folder / "trade.json", plain(data))
    return command.answer(data, lambda: _text(result, folder), 0 if chosen else 1)


def _short(offer: Offer) -> str:
    return offer.choice.name.rpartition(".")[2]


def _marked(offer: Offer, chosen: Offer | None) -> str:
    return "● " * (offer == chosen) + _short(offer)


def _seconds(offer: Offer) -> str:
    return "~" * offer.choice.noisy + number(offer.seconds, 3)


def _time(result: Trade, offer: Offer) -> str:
    return f"{_seconds(offer)} {result.unit}"


def _sentences(result: Trade) -> list[str]:
    """The choice for the budget, and what half of its time buys."""
    chosen, half = result.chosen, result.half
    if chosen is None:
        return [f"No camera keeps {result.plan.budget_px:g} px."]
    sentences = [f"For {result.plan.budget_px:g} px: {_short(chosen)}, with which the {result.what} takes "
            f"{_time(result, chosen)}, {number(chosen.choice.error_px, 3)} px"]  # fmt: skip
    if result.what != "camera":
        sentences[0] += f"; the camera takes {number(chosen.camera, 2)} {result.unit} of that"
    if len(result.plan.alike) > 1:
        sentences.append(f"Any of these takes about as long: {', '.join(result.plan.alike)}")
    if half is None:
        least = result.front[0]
        sentences.append(f"Half of that buys no camera: the least is {_time(result, least)}, {_short(least)}, "
                    f"{number(least.choice.error_px, 3)} px")  # fmt: skip
    else:
        sentences.append(f"Half of that buys {_short(half)}: {_time(result, half)}, "
                    f"{number(half.choice.error_px, 3)} px")  # fmt: skip
    if later := " and ".join(result.plan.asked.afterwards):
        sentences.append(
            f"Pixels leave out {later}, which compositing adds; FLIP and the pictures, taken before it, do not"
        )
    return sentences


def _cameras(result: Trade) -> pages.Table:
    """Every camera with its figures: a disc before the choice for the budget, a ring where no other betters it."""
    flips = {s.offer.choice.name: s.flip for s in result.shown}
    records = [
        {**asdict(o.choice), "seconds": {"min": o.seconds, "median": o.seconds + o.more},
         "camera": o.camera, "flip": flips.get(o.choice.name)} for o in result.offered
    ]  # fmt: skip
    of = f"of the {result.what}, one thread, to the exact lens's noise with the scene's samples; ~ noisy"
    columns = (
        pages.Column("error, px", "error_px", about="distance of footprints that 95% of the picture keep"),
        pages.Column("light, %", "light_error", 100, 2, "relative error of light that 95% of the picture keep"),
        pages.Column(result.unit, "seconds.min", about=of),
        pages.Column("in the camera", "camera", digits=2, about=f"{result.unit} of these"),
        pages.Column("noise", "noise", about="times the paths that equal error takes"),
        pages.Column("FLIP", "flip", digits=2, about="of the small pictures, from the exact lens's"),
    )
    front = result.front
    marks = ["● " if o == result.chosen else "○ " if o in front else "" for o in result.offered]
    names = [f"{m}{_short(o)}" for m, o in zip(marks, result.offered, strict=True)]
    return pages.table(names, records, columns)


def _text(result: Trade, folder: Path) -> str:
    names, records, columns = _cameras(result)
    rows = [(name, *(c.cell(r) for c in columns), r["how"]) for name, r in zip(names, records, strict=True)]
    shown = table(("camera", *(c.heading for c in columns), ""), rows)
    legend = ["● for the budget, ○ no other betters it", *(f"{c.heading}: {c.about}" for c in columns)]
    written = f"Written: {folder}/trade.html, trade.png, pictures.png, trade.json"
    return "\n\n".join([shown, "\n".join(legend), "\n".join(_sentences(result)), written])


def _page(result: Trade, folder: Path, title: str) -> str:
    from neurolens.base.html import html

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
