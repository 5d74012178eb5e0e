"""`neurolens evaluate MODEL`: a model against the promises of its card."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from neurolens.base.settings import setting, whole
from neurolens.cli.arguments import Glasses, Reporting, lens
from neurolens.cli.output import number, table

if TYPE_CHECKING:
    from neurolens.study.check import Promise

# Shown of a card without promises.
_UNPROMISED = ("rms_um", "p99_um", "max_um", "direction_rms_deg", "transmittance_rms", "false_pass", "false_block")


@dataclass(frozen=True, kw_only=True)
class Evaluate(Glasses, Reporting):
    """Measure an exported model on fresh rays of its card's domain, traced through the exact lens in
    float64 and through the ONNX model in onnxruntime. Prints each figure beside the card's promise and
    exits with code 1 if one does not hold. Needs the extra "train" (torch).

    Micrometres are film-equivalent: the distance between the exact and the predicted ray on the plane in
    focus, taken back to the film, for rays within 60 degrees of the axis (rms_infinity_um: on the plane at
    infinity). False passes and blocks are shares of all rays that the model, or the lens, passes.

    Promises are over the whole film, stopped down with the same fit ("2_stops.false_pass") and of the
    film's centre, mid and edge, its thirds by radius ("full.edge.rms_um").

    A model of many states (zoom, internal focus) is measured at six random states; its figures are the
    worst of them, and hold while they are at most 25% above the promise.

    As the rays differ from the card's, an error holds while it is above the promise by at most 4 standard
    deviations of its estimate from so many rays, at least 10% and at most 50%; a share by at most 4
    standard deviations of the root of its count. A largest error is only shown."""

    about: ClassVar[str] = "measure a model against the promises of its card"
    epilog: ClassVar[str] = """\
examples:
  neurolens evaluate models/NAME.onnx
  neurolens evaluate runs/quickstart/models/ols-60.onnx --rays 100000 --seed 5
  neurolens evaluate my.onnx --lens my_lens.toml --json

The lens file is looked for by the card's lens id: lenses/ beside the model and its folder, where a run
keeps its own; ./lenses; the project's."""

    model: Path = setting(..., "exported model (.onnx)", positional=True, metavar="MODEL")
    lens: Path | None = lens(None, " (default: found by the card's lens id)")
    rays: int = setting(
        30_000, "rays that the lens passes, eight times as many if a few bad ones dominate an error; "
        "four times as many test the vignetting (default: 30000)", within=(1000, 1_000_000),
    )  # fmt: skip
    seed: int | None = setting(
        None, "of the rays (default: one that differs from the fit's)", kind=whole(0), metavar="N"
    )

    def run(self) -> int:
        """Measure, compare, time; 1 where a promise does not hold."""
        from neurolens.cameras.model import load_model
        from neurolens.study.check import check_model, check_states, lens_of_card, space_of_card
        from neurolens.study.speed import time_model

        model = load_model(self.model)
        space = space_of_card(model.card, model.axes, self.lens, self.model) if model.axes else None
        lens = space.lens if space else lens_of_card(model.card, self.lens, self.model)
        progress = self.progress({"measure": 10, "time": 2})
        with progress.stage("measure"):
            if space is not None:
                figures, promises = check_states(model, space, rays=self.rays, seed=self.seed)
            else:
                figures, promises = check_model(model, lens, rays=self.rays, seed=self.seed)
        with progress.stage("time"):
            timing = time_model(model, self.model.stem, rounds=10)
        holds = all(p.holds for p in promises)
        data = {
            "model": str(self.model),
            "lens": {"id": model.card["lens"]["id"], "name": lens.name, "file": lens.path},
            "method": model.card["fit"]["method"],
            **figures,
            "ns_per_ray": timing,
            "promises": [{**asdict(p), "holds": p.holds} for p in promises],
            "holds": holds,
            "poor": model.card["errors"].get("poor") or [],
        }
        return self.answer(data, lambda: _text(data, promises), 0 if holds else 1)


def _text(data: dict[str, Any], promises: list[Promise]) -> str:
    header: tuple[str, ...] = ("figure", "promised", "measured", "allowed", "")
    rows: list[tuple[str, ...]] = [
        (p.key, number(p.promised), number(p.measured), number(p.allowed), "" if p.holds else "does not hold")
        for p in promises
    ]
    if not rows:
        header, rows = ("figure", "measured"), [(key, number(data[key])) for key in _UNPROMISED]
    timing = data["ns_per_ray"]
    broken = [p.key for p in promises if not p.holds]
    verdict = "The card has no promises." if not promises else "All promises hold."
    if broken:
        verdict = f"Does not hold: {', '.join(broken)}."
    lens = data["lens"]
    parts = [
        f"{data['model']}: {data['method']} of {lens['name']} ({lens['file']})\n"
        f"{data['rays']} fresh rays, seed {data['seed']}",
        table(header, rows),
        f"{timing['min']:.1f} ns per ray (median {timing['median']:.1f}) on one thread, batches of {timing['batch']}",
    ]
    parts += [f"Poor, as the card says: {', '.join(data['poor'])}."] if data["poor"] else []
    return "\n\n".join([*parts, verdict])
