"""`neurolens train`: from a lens file to measured models, renders and a report, in one run folder."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neurolens import __version__
from neurolens.base.cluster import Dask
from neurolens.base.errors import InputError, NeurolensError, one_line
from neurolens.base.files import fingerprint_of, sha256_of
from neurolens.base.lensname import lens_id_of
from neurolens.base.progress import Progress
from neurolens.base.records import NOISY, noisy
from neurolens.base.travel import run_remotely
from neurolens.cli.arguments import (
    add_dask,
    add_glass,
    add_json,
    add_lens,
    add_output,
    add_within,
    check_ids,
    check_run_folder,
    more_glasses,
    whole,
)
from neurolens.cli.output import answer, number, table
from neurolens.study.advice import advice, said_ns

_MARK = "task.sha256"  # in a run folder that came from a cluster
_DESCRIPTION = """\
Run an experiment: trace ray pairs of the lens, fit the surrogates, export them as ONNX,
measure errors and speed against the exact tracer, render the scenes, and write one report.
Needs the extra "train" (torch).

Without an experiment file, --lens fits a polynomial and a network to that lens in its default state:
full aperture, its whole lit film, all wavelengths from 380 to 780 nm (less where its glasses are stated
for less; one where no dispersion is known), focus from infinity to 14 focal lengths (further where the
lens is too long for that). It takes a minute; --within asks for an error instead. A file of another
program (Zemax, CODE V, ...) is read as "neurolens convert" reads it; where that lacks something, convert
first, with its options.

An interrupted run resumes where it stopped: existing models of the same settings are kept."""
_EPILOG = """\
examples:
  neurolens train experiments/quickstart.toml
  neurolens train experiments/quickstart.toml -o runs/try --set render.samples=4 --set pairs.seed=2
  neurolens train --lens lenses/cooke_triplet_50.toml
  neurolens train --lens lenses/cooke_triplet_50.toml --within 0.1px --rounds 0
  neurolens train --lens lenses/*_50.toml -o runs/fifties --dask tcp://cluster:8786
  neurolens train --lens lenses/nikon_zoom_70_200.toml --zoom-range -o runs/zoom
  neurolens train --lens lenses/brendel_tessar_100.toml -o runs/tessar \\
      --set lens.focal_length_mm=50

The folder holds report.html, results.json, config.toml (all settings, defaults written out),
lenses/ (the lens file, for "neurolens evaluate"), models/ and pictures/."""


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "train", help="fit, measure and render the models of an experiment", description=_DESCRIPTION, epilog=_EPILOG
    )
    parser.add_argument("experiment", metavar="EXPERIMENT.toml", nargs="?", type=Path, help="experiment file")
    instead = ", instead of an experiment; of several, each has a run folder in DIR (runs)"
    add_lens(parser, "--lens", instead, nargs="+")
    add_output(parser, "DIR", "run folder, made if needed (default: runs/NAME of the experiment or lens file)")
    parser.add_argument(
        "--set", metavar="KEY=VALUE", dest="overrides", action="append", default=[],
        help="change a setting, for example --set pairs.train=10000; values are TOML, may be repeated",
    )  # fmt: skip
    parser.add_argument(
        "--zoom-range", action="store_true",
        help="of --lens: one model of all focal lengths between the file's zoom states (input \"state\", in mm)",
    )  # fmt: skip
    parser.add_argument(
        "--internal-focus", action="store_true",
        help="of --lens: one model of internal focus, infinity to the near limit (input \"state\", in 1/m)",
    )  # fmt: skip
    add_within(
        parser, "of --lens: the fastest model whose film-equivalent RMS on rays held out is at most this, 2um or "
        "0.1px; models from 12 coefficients to a network of 2 x 32 units are fitted until one is (exit code 1: none)",
    )  # fmt: skip
    parser.add_argument(
        "--pixels-across", metavar="N", type=whole(1, 10**6), default=4000,
        help="of --within in pixels: how many make the width of the 3:2 frame inscribed in the film circle (default: "
        "4000: 9 um each for a radius of 21.6 mm)",
    )  # fmt: skip
    parser.add_argument("--rounds", metavar="N", type=whole(0), help="of the race, 0 for none (default: the setting's)")
    parser.add_argument("--no-race", dest="rounds", action="store_const", const=0, help=argparse.SUPPRESS)
    add_dask(parser)
    add_glass(parser)
    add_json(parser, quiet=True)
    parser.set_defaults(run=run, kept="fitted models are kept in the run folder; the same command resumes")


@dataclass(frozen=True)
class Training:
    """One run of an experiment file, or of a lens file without one; attributes are those of the options.

    Raises:
        InputError: both or neither of experiment and lens, options that take a lens, a run folder that is a file.
    """

    experiment: Path | None
    lens: Path | None
    out: Path
    named: bool  # whether the command line names `out`
    overrides: tuple[str, ...] = ()
    zoom_range: bool = False
    internal_focus: bool = False
    within: tuple[str, float] | None = None
    pixels_across: int = 4000
    rounds: int | None = None
    glass_files: tuple[Path, ...] = ()

    @classmethod
    def of(cls, args: argparse.Namespace, lens: Path | None, out: Path | None) -> Training:
        """The training of a lens, or of the experiment where there is none."""
        file = args.experiment or lens
        if file is None or None not in (args.experiment, lens):
            found = "(neither)" if file is None else "(both)"
            raise InputError("neurolens train", "EXPERIMENT.toml or --lens", found, "one of them")
        folder = out if out is not None else Path("runs") / lens_id_of(file)
        check_run_folder(folder, "neurolens train", "--output")
        made = cls(
            args.experiment, lens, folder, out is not None, tuple(args.overrides), args.zoom_range,
            args.internal_focus, args.within, args.pixels_across, args.rounds, tuple(args.glass_files),
        )  # fmt: skip
        if lens is None and (made.within or made.zoom_range or made.internal_focus):
            option = "--within" if made.within else "--zoom-range, --internal-focus"
            raise InputError("neurolens train", option, "(without --lens)", "--lens FILE")
        return made

    @property
    def settings(self) -> list[str]:
        """The options as changes of the experiment's settings, KEY=VALUE; --set comes last."""
        states = ['lens.zoom="range"'] * self.zoom_range + ['lens.focus_mode="internal"'] * self.internal_focus
        if self.within is not None:
            unit = self.within[0].removeprefix("rms_")
            states.append(f"target.{unit}={self.within[1]!r}")
            states += [f"target.pixels_across={self.pixels_across}"] * (unit == "px")
        rounds = [] if self.rounds is None else [f"evaluation.rounds={self.rounds}"]
        return [*states, *rounds, *self.overrides]

    @property
    def command(self) -> str:
        """The command line that makes this run."""
        parts = ["neurolens", "train"]
        parts += ["--lens", str(self.lens)] if self.lens is not None else [str(self.experiment)]
        parts += ["--output", str(self.out)] if self.named else []
        for setting in self.settings:
            parts += ["--set", setting]
        return shlex.join(parts)

    @property
    def mark(self) -> str:
        """Hash of everything that the models depend on: the lens, catalogues of glass, options, the version."""
        files = [each for each in (self.experiment, self.lens, *self.glass_files) if each is not None]
        return fingerprint_of([__version__, self.settings, *map(sha256_of, files)])

    def run(self, progress: Progress) -> dict[str, Any]:
        """Run the experiment; its results."""
        from neurolens.study.experiment import default_experiment, read_experiment
        from neurolens.study.train import run_experiment

        if self.lens is not None:
            experiment = default_experiment(self.lens, self.settings)
        else:
            assert self.experiment is not None
            experiment = read_experiment(self.experiment, self.settings)
        return run_experiment(experiment, self.out, progress=progress, command=self.command)


def run(args: argparse.Namespace) -> int:
    """Run the experiment, or one a lens, and print a summary."""
    if args.dask is not None or (args.lens is not None and len(args.lens) > 1):
        return _run_many(args)
    training = Training.of(args, None if args.lens is None else args.lens[0], args.out)
    results, folder = training.run(Progress(quiet=args.quiet)), training.out
    data = {"folder": str(folder), "report": str(folder / "report.html"), **results}
    answer(args, data, lambda: _text(results, folder))
    return 0 if (results.get("target") or {"met": True})["met"] else 1


def _run_many(args: argparse.Namespace) -> int:
    """One run a lens, here or on a cluster; a lens that fails is a line, and the exit code is 2 then."""
    if args.lens is None:
        raise InputError("neurolens train", "--dask", args.dask, "--lens FILE ... beside it")
    check_ids(args.lens, "neurolens train", "--lens")
    base = args.out if args.out is not None else Path("runs")
    check_run_folder(base, "neurolens train", "--output")
    progress, failed = Progress(quiet=args.quiet), dict[str, str]()
    each = [Training.of(args, file, base / lens_id_of(file)) for file in args.lens]
    if args.dask is None:
        for training in each:
            try:
                training.run(progress)
            except NeurolensError as error:
                failed[training.out.name] = str(error)
    else:
        failed = _on_dask(args.dask, each, base, progress)
    for name, why in failed.items():
        print(f"neurolens: {one_line(f'{name}: {why}', 3000)}", file=sys.stderr)
    done = [str(training.out) for training in each if training.out.name not in failed]
    answer(args, {"folders": done, "failed": failed}, lambda: "\n".join(done))
    return 2 if failed else 0


def _on_dask(address: str, each: list[Training], base: Path, progress: Progress) -> dict[str, str]:
    """Run on a cluster what is not there yet; the reasons of what failed."""
    missing = {training.out.name: training for training in each if _marked(training.out) != training.mark}
    base.mkdir(parents=True, exist_ok=True)
    with progress.stage(f"train {len(missing)} of {len(each)} lenses") as report:
        if not missing:
            return {}
        files = {file for training in missing.values() for file in (training.lens, *training.glass_files) if file}
        with Dask(address) as executor:
            return run_remotely(executor, train_alone, missing, files, base, report)


def train_alone(training: Training) -> None:
    """One lens, as a task of a cluster; the folder's mark, written last, says that it is whole, and of what."""
    with more_glasses(training):
        training.run(Progress(quiet=True))
    (training.out / _MARK).write_text(training.mark)


def _marked(folder: Path) -> str | None:
    try:
        return (folder / _MARK).read_text()
    except OSError:
        return None


def _text(results: Mapping[str, Any], folder: Path) -> str:
    header = ("model", "rms um", "p99 um", "angle rms deg", "false pass", "false block", "ns/ray", "C ns/ray", "fit s")
    rows = [_row(model) for model in results.get("models", ())]
    parts = [str(results.get("title") or folder.name), table(header, rows)]
    target = results.get("target")
    if target:
        reached = "reached" if target["met"] else "no model tried reaches it, the closest is"
        said = f"Asked for {target['within_um']:.3g} um RMS"
        parts.append(f"{said}: {reached} {target['model']}, {number(target['rms_um'], 3)} um.")
    parts += ["\n  ".join(filter(None, (str(found), found.command))) for found in advice(results, folder)]
    timings = [model.get(key) for model in results["models"] for key in ("ns_per_ray", "fused_ns_per_ray")]
    if any(map(noisy, timings)):
        parts.append(f"~ noisy: the median of the rounds is more than {NOISY:g} times the least, which is shown")
    parts += [f"Warning: {text}" for text in results.get("warnings", ())]
    places = [f"  {folder / 'report.html'}  everything on one page", f"  {folder / 'models'}  the ONNX models"]
    if (folder / "pictures").is_dir():
        places.append(f"  {folder / 'pictures'}  renders, lens layout, plots")
    places.append(f"  {folder / 'results.json'}  all figures")
    return "\n\n".join(parts) + "\n\nLook at\n" + "\n".join(places)


def _row(model: Mapping[str, Any]) -> tuple[str, ...]:
    errors = (number(model.get(key), 3) for key in ("rms_um", "p99_um", "direction_rms_deg"))
    shares = (model.get(key) for key in ("false_pass", "false_block"))
    times = (said_ns(model.get(key) or {}).removesuffix(" ns") for key in ("ns_per_ray", "fused_ns_per_ray"))
    percent = ("-" if share is None else f"{100 * share:.2f}%" for share in shares)
    return (str(model.get("name")), *errors, *percent, *times, number(model.get("fit_s"), 3))
