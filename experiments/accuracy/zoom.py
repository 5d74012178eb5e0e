"""Fit one model for the whole range of each zoom of the library, for internal focus, and for both.

Each is measured at random states against the exact lens, beside models fitted to one state each. A minute or two for
each of the eight, ten for the last; those that are in the table are kept. Writes zoom.md, zoom.json and zoom.png.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median_high

from experiments import lab
from experiments.lab import Row
from neurolens import __version__
from neurolens.base.errors import InputError
from neurolens.base.progress import Report
from neurolens.models.axes import Axis
from neurolens.models.fit import ModelSettings, StateSettings, StateSpace, axes_of, fit_model, prepare
from neurolens.models.pairs import PairSettings, make_pairs
from neurolens.models.terms import pinned_threads
from neurolens.optics.analysis.plots import FIELD_COLOURS, INK, drawing
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.focusing import near_limit_m
from neurolens.studies.experiment import wavelengths_nm
from neurolens.studies.plots import AXIS_LABELS, error_axes, error_line
from neurolens.studies.rays import ray_errors
from neurolens.studies.train import fit_and_measure_states

# Coefficients per vector, rays of a node, rays of a single fit's test.
TERMS, RAYS, TESTS = 64, 15_000, 8_000
# Places in the range, of the first axis, at which models are fitted to one state.
FIXED = (0.0, 0.15, 0.4, 0.7, 1.0)


@dataclass(frozen=True)
class Case:
    """A lens and the states that one model is of; `position` is the zoom position where zoom is no axis."""

    lens: str
    zoom: bool = True
    internal: bool = False
    position: str | None = None

    @property
    def name(self) -> str:
        """For files and commands: "nikon_zoom_70_200", "nikon_zoom_70_200-focus-71mm"."""
        focus = "-focus" if self.internal else ""
        return f"{self.lens}{focus}{'' if self.position is None else '-' + self.position}"

    def space(self) -> StateSpace:
        """The states, with the domain that `neurolens train` takes where nothing is stated."""
        lens = read_lens(lab.LENSES / f"{self.lens}.toml").with_aperture(None)
        return StateSpace(
            lens,
            axes_of(lens, zoom=self.zoom, internal=self.internal, state=self.position),
            zoom=self.position,
            focus_m=lambda state: (math.inf, near_limit_m(state)),
            wavelength_nm=wavelengths_nm(lens),
        )


CASES = (
    Case("nikon_zoom_70_200"),
    Case("ogawa_zoom_70_200"),
    Case("nikon_zoom_80_200"),
    Case("nikon_zoom_14_24"),
    Case("itoh_zoom_100_146"),
    Case("nikon_zoom_70_200", zoom=False, internal=True, position="71mm"),
    Case("nikon_zoom_70_200", zoom=False, internal=True, position="196mm"),
    Case("nikon_zoom_70_200", internal=True),
)


def measure_case(case: Case, folder: Path, states: int, report: Report) -> Row:
    """Fit one case, whose model is kept in a folder, and measure it at `states` random states."""
    space = case.space()
    settings = StateSettings(terms=TERMS, rays=RAYS, name=case.name)
    record = fit_and_measure_states(space, settings, folder, states=states, report=lambda done: report(0.8 * done))
    fixed = []
    for place in FIXED if len(space.axes) == 1 else ():
        fixed.append(_fixed(space, place))
        report(0.8 + 0.2 * len(fixed) / len(FIXED))
    about = {"case": case.name, "lens": space.lens.name, "version": __version__}
    return about | {"axes": [a.to_dict() for a in space.axes], "fixed": fixed} | record


def _fixed(space: StateSpace, place: float) -> dict[str, float]:
    """Errors of a model with as many coefficients, fitted to one state."""
    axis = space.axes[0]
    value = axis.range[0] + (axis.range[1] - axis.range[0]) * place
    lens, domain = space.lens_at((value,)), space.domain_at((value,))
    pairs = make_pairs(lens, domain, PairSettings(RAYS, TESTS, RAYS))
    model = fit_model(prepare(pairs), ModelSettings("ols", terms=TERMS))
    errors = ray_errors(lens, domain, pairs.held_out, model.predict)
    return {axis.name: value, "rms_um": errors.rms_um, "direction_rms_deg": errors.direction_rms_deg}


_HEAD = """\
# Models of many states

One ONNX model over the whole range of a zoom, or over internal focus, or both; the state is one more input (focal
length in mm, 1 / distance in 1/m). {terms} coefficients per vector at every node; the full lit film, full aperture,
and where the film focuses, focus from infinity to the near limit (14 focal lengths or more) in every state. Worst and
median of {states} random states, rays that no fit saw, micrometres on the film; the goal is 3 um RMS anywhere.
*One state*: median of models of as many coefficients that were each fitted to one state.
Made by `python -m experiments zoom`."""
_COLUMNS = lab.columns(
    ("model", "case"),
    ("state", lambda r: ", ".join("{name} {range[0]:.4g}–{range[1]:.4g} {unit}".format(**axis) for axis in r["axes"])),
    ("nodes", "nodes"),
    ("RMS um, median", "median.rms_um", ".2g"),
    ("worst", "rms_um", ".2g"),
    ("at 21.6 mm", "rms_um_at_21_6", ".2g"),
    ("p99 worst", "p99_um", ".2g"),
    ("direction deg, worst", "direction_rms_deg", ".2g"),
    ("position um, worst", "position_rms_um", ".2g"),
    ("transmittance, worst", "transmittance_rms", ".2g"),
    ("false pass %, worst", "false_pass", ".2g", 100),
    ("false block %, worst", "false_block", ".2g", 100),
    ("one state, RMS um", lambda r: median_high(f["rms_um"] for f in r["fixed"]) if r["fixed"] else None, ".2g"),
    ("kB", "bytes", ".0f", 1e-3),
    ("fit s", "fit_s", ".0f"),
)


def page(rows: Sequence[Row]) -> str:
    """The table."""
    head = _HEAD.format(terms=TERMS, states=max((len(r["states"]) for r in rows), default=0))
    return lab.page(head, lab.table(_COLUMNS, rows, "–"), "![error over the state](zoom.png)")


def draw(rows: Sequence[Row], path: Path) -> None:
    """A panel for each model: its error over the first state axis, and those of models fitted to one state each."""
    columns = 2 if len(rows) > 1 else 1
    lines = -(-len(rows) // columns)
    with drawing(path, 5.2 * columns, 3.0 * lines) as figure:
        panels = figure.subplots(lines, columns, squeeze=False).ravel()
        for panel, row in zip(panels, rows, strict=False):
            axis, states, fixed = Axis.from_dict(row["axes"][0]), row["states"], row["fixed"]
            error_line(panel, axis, states, FIELD_COLOURS[0], "one model of all states")
            if fixed:
                x = [r[axis.name] for r in fixed]
                panel.plot(x, [r["rms_um"] for r in fixed], "s", ms=5, mfc="none", color=INK, label="one state each")
            error_axes(panel, axis, [r["rms_um"] for r in (*states, *fixed)])
            panel.set_title(row["case"], loc="left", fontsize="medium")
            panel.set(xlabel=AXIS_LABELS.get(axis.name, f"{axis.name} ({axis.unit})"), ylabel="RMS (um)")
            panel.legend(loc="best", fontsize="small")
        for panel in panels[len(rows) :]:
            panel.set_visible(False)


OPTIONS = (
    lab.option("cases", metavar="CASE", nargs="*", help="cases by name, as in the table (default: all)"),
    lab.count("states", 25, "random states (default: 25)", 2, 1000),
    lab.AGAIN,
    lab.option("--models", metavar="DIR", type=Path, default=Path("runs/zoom"), help="for them (default: runs/zoom)"),
    lab.out(),
)


def run(args: argparse.Namespace) -> None:
    """Measure what is missing, and write table and picture after each case."""
    known = {c.name: c for c in CASES}
    unknown = [name for name in args.cases if name not in known]
    if unknown:
        raise InputError("experiments zoom", "CASE", unknown[0], f"one of: {', '.join(known)}")

    def measured(case: Case, report: Report) -> Row:
        args.models.mkdir(parents=True, exist_ok=True)
        with pinned_threads():
            return measure_case(case, args.models, args.states, report)

    def drawn(rows: list[Row]) -> str:
        if args.out.is_dir():
            draw(rows, args.out / "zoom.png")
        return page(rows)

    chosen = {name: known[name] for name in args.cases or known}
    lab.resume(
        args, "zoom", chosen, measured, lambda row: row["case"], drawn,
        listed="cases", again=args.restart, seconds=60.0, order=list(known),
    )  # fmt: skip
