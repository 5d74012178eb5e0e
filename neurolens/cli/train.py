"""`neurolens train`: from a lens file to measured models, renders and a report, in one run folder; and `neurolens
survey FOLDER`: every lens file of a folder, read, checked, fitted and measured."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens.base.cluster import Dask
from neurolens.base.errors import NeurolensError, one_line, printable
from neurolens.base.files import read_bytes
from neurolens.base.lensname import lens_id_of, resolve
from neurolens.base.progress import Progress
from neurolens.base.report import PART, Report
from neurolens.base.settings import setting, whole
from neurolens.base.tasks import Processes, cores
from neurolens.cli import arguments as cli
from neurolens.studies.pages import advice, ns_text
from neurolens.studies.records import NOISY, noisy

if TYPE_CHECKING:
    from neurolens.studies.survey import Summary


@dataclass(frozen=True, kw_only=True)
class Train(cli.Reporting):
    """Fit models to a lens (--lens), or run an experiment file: trace pairs of rays, fit the models, write them as
    ONNX, measure their errors and speed against the exact tracer, render scenes, and write one report. Needs the extra
    "train" (torch).

    Without an experiment file, --lens fits a polynomial and a network to that lens in its default state: full aperture,
    its whole lit film, all wavelengths from 380 to 780 nm (less where its glasses are stated for less; one where no
    dispersion is known), focus from infinity to 14 focal lengths (further where the lens is too long for that). It
    takes a minute; --within asks for an error instead.

    An interrupted run resumes where it stopped: existing models of the same settings are kept."""

    epilog = """\
examples:
  neurolens train --lens cooke_triplet_50 --within 5um
  neurolens train --lens cooke_triplet_50 --set 'model=[{method="ols",terms=40}]'
  neurolens train experiments/quickstart.toml
  neurolens train experiments/quickstart.toml -o runs/try --set render.samples=4 --set pairs.seed=2
  neurolens train --lens cooke_triplet_50 --within 0.1px --rounds 0
  neurolens train --lens lenses/*_50.toml -o runs/fifties
  neurolens train --lens nikon_zoom_70_200 --zoom-range -o runs/zoom

The folder holds report.html, results.json, config.toml (all settings, defaults written out),
lenses/ (the lens file, for "neurolens evaluate"), models/ and pictures/."""
    kept = "fitted models are kept in the run folder; the same command resumes"

    experiment: Path | None = setting(
        None, "experiment file, or the name of a lens, as --lens", positional=True, metavar="EXPERIMENT.toml", nargs="?"
    )
    lens: tuple[Path, ...] | None = cli.lens(
        None, ", instead of an experiment; of several, each has a run folder in DIR (runs)", nargs="+"
    )
    out: Path | None = cli.output_path(
        "DIR", "run folder, made if needed (default: runs/NAME of the experiment or lens file)", None
    )
    set: tuple[str, ...] = setting(
        (), "change a setting of the experiment file, as --set pairs.train=10000; values are TOML; repeatable",
        metavar="KEY=VALUE", common=True,
    )  # fmt: skip
    zoom_range: bool = setting(
        False,
        'fit one model of all focal lengths between the zoom states of --lens (input "state", in mm)',
        common=True,
    )
    internal_focus: bool = setting(
        False, 'fit one model of the internal focus of --lens, from infinity to the near limit (input "state", in 1/m)'
    )
    within: tuple[str, float] | None = cli.within(
        "find the fastest model of --lens whose film-equivalent RMS error on fresh rays is at most this, as "
        "2um or 0.1px; models from 12 coefficients to a network of 2 x 32 units are fitted until one is (exit"
        " code 1 if none is)",
        common=True,
    )
    phase: bool = setting(False, "models have the optical path, too, for point spread by diffraction (neurolens psf)")
    pixels_across: int = setting(
        4000, "pixels of --within that make the width of the 3:2 frame inscribed in the film circle (default: 4000,"
        " of 9 um each for a radius of 21.6 mm)", within=(1, 10**6),
    )  # fmt: skip
    rounds: int | None = setting(
        None,
        "rounds in which models race the exact lens, 0 for no times (default: the setting's)",
        kind=whole(0),
        metavar="N",
        old={"no-race": 0},
        common=True,
    )

    def run(self) -> int:
        """Run the experiment, or one for each lens, and print a summary."""
        lenses = self.lens or ()
        if not lenses and self.experiment and self.experiment.suffix.lower() != ".toml":
            named = resolve(self.experiment, models=False, cameras=False).file
            assert named is not None  # only cameras without a lens lack it
            return replace(self, experiment=None, lens=(named,)).run()
        if (self.experiment is None) == (not lenses):
            self.refuse("EXPERIMENT.toml or --lens", "(both)" if lenses else "(neither)", "one of them")
        if not lenses and (self.within or self.zoom_range or self.internal_focus):
            option = "--within" if self.within else "--zoom-range, --internal-focus"
            self.refuse(option, "(without --lens)", "--lens FILE")
        if len(lenses) > 1:
            return self._run_many(lenses)
        folder, results = self._train(self.experiment or lenses[0], self.out, self.progress())
        met = (results.get("target") or {"met": True})["met"]
        return self.answer(Trained(folder, folder / "report.html", results), 0 if met else 1)

    def _train(self, file: Path, out: Path | None, progress: Progress) -> tuple[Path, dict[str, Any]]:
        """Run one experiment, or that of a lens file, in a folder; return the folder and the results."""
        from neurolens.studies.experiment import default_experiment, read_experiment
        from neurolens.studies.train import run_experiment

        folder = Path("runs") / lens_id_of(file) if out is None else out
        cli.check_written(folder, "--output", "DIR")
        changes = self._changes()
        experiment = (read_experiment if self.experiment else default_experiment)(file, changes)
        words = ["neurolens", "train", *["--lens"] * (self.experiment is None), str(file)]
        words += [] if out is None else ["--output", str(out)]
        command = shlex.join([*words, *(word for change in changes for word in ("--set", change))])
        renders = None
        if experiment.render.scenes:
            from neurolens.studies import scenes

            renders = scenes.renders
        return folder, run_experiment(experiment, folder, progress=progress, command=command, renders=renders)

    def _changes(self) -> list[str]:
        """Return the settings that change in the experiment, KEY=VALUE: by options, then by --set, then by --phase."""
        changes = ['lens.zoom="range"'] * self.zoom_range + ['lens.focus_mode="internal"'] * self.internal_focus
        if self.within is not None:
            unit = self.within[0].removeprefix("rms_")
            changes.append(f"target.{unit}={self.within[1]!r}")
            changes += [f"target.pixels_across={self.pixels_across}"] * (unit == "px")
        changes += [] if self.rounds is None else [f"evaluation.rounds={self.rounds}"]
        return [*changes, *self.set, *["model.phase=true"] * self.phase]

    def _run_many(self, lenses: Sequence[Path]) -> int:
        """Run one experiment for each lens; a lens that fails becomes a line, and the exit code is then 2."""
        cli.check_ids(lenses, self.called, "--lens")
        base, progress, failed, done = self.out or Path("runs"), self.progress(), dict[str, str](), list[str]()
        for file in lenses:
            lens_id = lens_id_of(file)
            try:
                done.append(str(self._train(file, base / lens_id, progress)[0]))
            except NeurolensError as error:
                failed[lens_id] = str(error)
                print(f"neurolens: {one_line(f'{lens_id}: {error}', 3000)}", file=sys.stderr)
        return self.answer(TrainedEach(done, failed), 2 if failed else 0)


@dataclass(frozen=True)
class Trained(Report):
    """A finished run, with the `records.Results` of its results.json."""

    folder: Path
    report: Path
    results: Mapping[str, Any] = field(metadata=PART)

    def text(self) -> str:
        """Return the models, and where the run lies."""
        return _text(self.results, self.folder)


@dataclass(frozen=True)
class TrainedEach(Report):
    """The folders of runs, one for each lens; what failed, by lens."""

    folders: Sequence[str]
    failed: Mapping[str, str]

    def text(self) -> str:
        """Return the folders."""
        return "\n".join(self.folders)


def _text(results: Mapping[str, Any], folder: Path) -> str:
    header = ("model", "rms um", "p99 um", "angle rms deg", "false pass", "false block", "ns/ray", "C ns/ray", "fit s")
    rows = [_row(model) for model in results.get("models", ())]
    parts = [
        str(results.get("title") or folder.name),
        cli.table(header, rows),
        *(
            f"Optical path of {m['name']}: {cli.number(m['phase_rms_waves'], 2)} waves RMS, "
            f"{cli.number(m['phase_max_waves'], 2)} at worst"
            for m in results.get("models", ())
            if "phase_rms_waves" in m
        ),
    ]
    target = results.get("target")
    if target:
        reached = "reached" if target["met"] else "no model tried reaches it, the closest is"
        said = f"Asked for {target['within_um']:.3g} um RMS"
        parts.append(f"{said}: {reached} {target['model']}, {cli.number(target['rms_um'], 3)} um.")
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
    errors = (cli.number(model.get(key), 3) for key in ("rms_um", "p99_um", "direction_rms_deg"))
    shares = (model.get(key) for key in ("false_pass", "false_block"))
    times = (ns_text(model.get(key) or {}).removesuffix(" ns") for key in ("ns_per_ray", "fused_ns_per_ray"))
    percent = ("-" if share is None else f"{100 * share:.2f}%" for share in shares)
    return (str(model.get("name")), *errors, *percent, *times, cli.number(model.get("fit_s"), 3))


@dataclass(frozen=True, kw_only=True)
class Survey(cli.Reporting):
    """Read every lens file of a folder and of the folders inside it, check it, fit a polynomial to it, and measure the
    polynomial on rays that the fit has not seen.

    All formats of `neurolens convert` are read. A file is checked against its own statements, and gets rims where it
    gives none. Nothing is left out silently: what cannot be read is one line with the reason. Every file is a process
    of its own. A finished file is not done again: the same command goes on."""

    epilog = """\
examples:
  neurolens survey experiments/fuzz_seeds --no-fit
  neurolens survey lenses/
  neurolens survey my_patents/ -o runs/patents --jobs 8
  neurolens survey my_patents/ --no-fit

DIR holds survey.html (a table with sections of the lenses, to sort and filter), survey.csv, survey.json, records/."""
    kept = "finished files are kept; the same command goes on"

    folder: Path = setting(..., "folder of lens files", positional=True, metavar="FOLDER")
    out: Path = cli.output_path("DIR", "folder of the results (default: runs/survey)", Path("runs/survey"))
    no_fit: bool = setting(False, "read and check only", common=True)
    verify: bool = setting(
        False, "hold each lens against photographs (neurolens verify; extra photographs)", common=True
    )
    terms: int = setting(64, "coefficients (default 64)", within=(1, 400))
    rays: int = setting(30_000, "to fit and to measure (default 30000)", within=(1000, 10**6))
    seed: int = setting(1, "seed of the rays (default: 1)", kind=whole(0))
    half_field: float = setting(
        15.0, "half field that is assumed where a file gives neither rims nor a field (default: 15)",
        within=(1e-3, 179.0), unit="degrees", metavar="DEG",
    )  # fmt: skip
    jobs: int = setting(
        cores(), "files at a time, about 1 GB of memory each (default: all cores)", within=(1, 256), common=True
    )
    dask: str | None = cli.dask()
    restart: bool = setting(False, "do finished files again", old=("again",), common=True)

    def run(self) -> int:
        """Survey a folder; return 1 where a file met a fault of neurolens."""
        from neurolens.optics.readers.any_format import collection_of
        from neurolens.optics.readers.source import MAX_BYTES
        from neurolens.studies.survey import TIME_LIMIT_S, SurveySettings, summary_of, survey

        if self.out.resolve() == self.folder.resolve():
            self.refuse("--output", str(self.out), "a folder other than that of the lenses")
        collection = collection_of(self.folder)
        settings = SurveySettings(not self.no_fit, self.terms, self.rays, self.seed, self.half_field, self.verify)
        glasses = [(file.name, read_bytes(file, MAX_BYTES, "a glass catalogue")) for file in self.glass]
        limit_s = TIME_LIMIT_S
        with Processes(self.jobs, limit_s) if self.dask is None else Dask(self.dask, limit_s) as executor:
            records = survey(
                collection, self.out, settings, executor, self.progress(), glasses=glasses, again=self.restart
            )
        found = Surveyed(summary_of(records), dict(collection.others), self.out / "survey.html")
        return self.answer(found, code=1 if found.found.fault else 0)


@dataclass(frozen=True)
class Surveyed(Report):
    """The counts of a survey, the other files of its folder by their suffix, and its page."""

    found: Summary = field(metadata=PART)
    others: dict[str, int]
    page: Path

    def text(self) -> str:
        """Return the counts in sentences, and where the page is."""
        return printable("\n".join([*self.found.lines(self.others), f"Look at {self.page}"]))
