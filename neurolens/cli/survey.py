"""`neurolens survey FOLDER`: every lens file of a folder, read, checked, fitted and measured."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from neurolens.base.cluster import Dask
from neurolens.base.errors import printable
from neurolens.base.files import read_bytes
from neurolens.base.settings import setting, whole
from neurolens.base.tasks import Processes, cores
from neurolens.cli.arguments import Glasses, Reporting, check_run_folder, dask, output_path


@dataclass(frozen=True, kw_only=True)
class Survey(Glasses, Reporting):
    """Read every lens file of a folder (all formats of `neurolens convert`, and folders inside), check it against its
    own statements, derive rims where it gives none, fit a polynomial by the default settings, and measure it on
    rays that the fit has not seen. Nothing is left out silently: what cannot be read is one line with the reason.

    Every file is a process of its own. A finished file is not done again: the same command goes on."""

    about: ClassVar[str] = "every lens file of a folder: read, checked, fitted, measured"
    epilog: ClassVar[str] = """\
examples:
  neurolens survey lenses/
  neurolens survey my_patents/ -o runs/patents --jobs 8
  neurolens survey my_patents/ --no-fit

DIR holds survey.html (a table with sections of the lenses, to sort and filter), survey.csv, survey.json, records/."""
    kept: ClassVar[str] = "finished files are kept; the same command goes on"

    folder: Path = setting(..., "folder of lens files", positional=True, metavar="FOLDER")
    out: Path = output_path("DIR", "default: runs/survey", Path("runs/survey"))
    no_fit: bool = setting(False, "read and check only")
    verify: bool = setting(False, "hold each lens against photographs (neurolens verify; extra photographs)")
    terms: int = setting(64, "coefficients (default 64)", within=(1, 400))
    rays: int = setting(30_000, "to fit and to measure (default 30000)", within=(1000, 10**6))
    seed: int = setting(1, "of the rays (default 1)", kind=whole(0))
    half_field: float = setting(
        15.0, "assumed where a file gives neither rims nor a field (default 15)", within=(1e-3, 179.0),
        unit="degrees", metavar="DEG",
    )  # fmt: skip
    jobs: int = setting(cores(), "files at a time, about 1 GB of memory each (default: all cores)", within=(1, 256))
    dask: str | None = dask()
    restart: bool = setting(False, "do finished files again", old=("again",))

    def run(self) -> int:
        """Survey a folder; 1 where a file met a fault of neurolens."""
        from neurolens.readers.any_format import collection_of
        from neurolens.readers.source import MAX_BYTES
        from neurolens.study.survey import TIME_LIMIT_S, SurveySettings, summary_lines, summary_of, survey

        check_run_folder(self.out, self.called, "--output")
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
        page = self.out / "survey.html"
        summary = {**summary_of(records), "others": collection.others, "page": str(page)}
        lines = [*summary_lines(records, collection.others), f"Look at {page}"]
        return self.answer(summary, lambda: printable("\n".join(lines)), 1 if summary["fault"] else 0)
