"""The frame of all measurements: folders, options, tables of columns, goals, kept rows, results, the machine.

A measurement is a module whose docstring is its help, with `OPTIONS` and `run(args)`; what it finds is rows
(dataclasses, or tables as of JSON), and its page is some words and tables, each a sequence of `Column`.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import os
import platform
import resource
import subprocess
import sys
import warnings
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from neurolens import __version__
from neurolens.base.errors import InputError, NeurolensError, NeurolensWarning
from neurolens.base.files import atomic_path, atomic_write_text, write_json
from neurolens.base.progress import Progress, Report
from neurolens.cli.arguments import QUIET_HELP, add_option, add_output, whole

ROOT = Path(__file__).parents[1]
LENSES, SCENES, MODELS = ROOT / "lenses", ROOT / "experiments" / "scenes", ROOT / "models"
RESULTS = ROOT / "experiments" / "results"
T = TypeVar("T")
Row = dict[str, Any]


# ---- Options. --------------------------------------------------------------------------------------------------------

Option = Callable[[argparse.ArgumentParser], object]


def option(*names: str, **settings: Any) -> Option:
    """An option as of `add_option`."""
    return lambda parser: add_option(parser, *names, **settings)


def count(name: str, default: int | None, text: str, least: int = 1, most: int | None = None) -> Option:
    """An option that takes a whole number."""
    return option(f"--{name}", metavar="N", type=whole(least, most), default=default, help=text)


def out(folder: Path = RESULTS, what: str = "folder for the tables") -> Option:
    """--output, by default in runs/; --commit, for the folder that is kept in the repository; --quiet."""
    place = ROOT / "runs" / folder.relative_to(ROOT / "experiments") if folder.is_relative_to(RESULTS) else folder

    def add(parser: argparse.ArgumentParser) -> None:
        shown = place.relative_to(ROOT)
        add_output(parser, "DIR", f"{what} (default: {shown})", default=place)
        if place != folder:
            text = f"the folder is {folder.relative_to(ROOT)}, which the README shows"
            parser.add_argument("--commit", dest="out", action="store_const", const=folder, help=text)
        QUIET(parser)

    return add


QUIET = option("--quiet", action="store_true", help=QUIET_HELP)
ONLY = option("--only", metavar="TEXT", default="", help="lens files whose name holds this text")
PICTURE = option("--picture", action="store_true", help="draw the picture alone; the tables stay as they are")
ROUNDS = count("rounds", None, "rounds (default 20; quick 5)")


def rounds_of(args: argparse.Namespace) -> int:
    """Of a race, by --rounds and --quick."""
    return int(args.rounds or (5 if args.quick else 20))


def chosen(items: Sequence[T], name: Callable[[T], str], only: str, what: str) -> list[T]:
    """Those whose name holds the text of --only.

    Raises:
        InputError: none does; `what` names the measurement.
    """
    found = [item for item in items if only in name(item)]
    if not found:
        known = ", ".join(dict.fromkeys(name(item) for item in items))
        raise InputError(f"experiments {what}", "--only", only, f"part of one of: {known}")
    return found


def stages(
    items: Iterable[T], name: Callable[[T], str], quiet: bool, seconds: float = 1.0
) -> Iterator[tuple[T, Report]]:
    """Items one after the other, each with what reports its progress; an equal plan of `seconds` for all."""
    items = list(items)
    progress = Progress({name(item): seconds for item in items}, quiet=quiet)
    for item in items:
        with progress.stage(name(item)) as report:
            yield item, report


def quiet_glasses() -> None:
    """Ignore warnings of glasses of unknown dispersion, which do not matter here."""
    warnings.simplefilter("ignore", NeurolensWarning)


# ---- Pages. ----------------------------------------------------------------------------------------------------------


class Column(NamedTuple):
    """A column: title, what of a row it shows (a key or attribute, with dots into inner ones, or a function), format.

    The value is multiplied by `scale` and written in `form`, as of `format`; None leaves the cell to `missing`.
    """

    title: str
    value: str | Callable[[Any], Any]
    form: str = ""
    scale: float = 1

    def cell(self, row: Any) -> str | None:
        value = self.value(row) if callable(self.value) else look_up(row, self.value)
        return None if value is None else format(value if self.scale == 1 else self.scale * value, self.form)


def look_up(row: Any, path: str) -> Any:
    """What lies at a path of keys or attributes; None where a part of it is missing or None."""
    for part in path.split("."):
        row = row.get(part) if isinstance(row, Mapping) else getattr(row, part, None)
    return row


def columns(*described: tuple[Any, ...]) -> tuple[Column, ...]:
    """Columns from tuples of title, value, form, scale."""
    return tuple(Column(*one) for one in described)


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[Any]], missing: str = "") -> list[str]:
    """Lines of a table in Markdown; `missing` stands for cells that are None."""
    lines = [header, ["---"] * len(header), *([missing if c is None else str(c) for c in row] for row in rows)]
    return [f"| {' | '.join(line)} |" for line in lines]


def table(header: Sequence[Column] | Sequence[str] | str, rows: Iterable[Any], missing: str = "") -> str:
    """A table in Markdown.

    Args:
        header: columns; or titles, also in one string cut at "|", where rows are cells already.
        missing: stands for cells that are None.
    """
    if header and isinstance(header[0], Column):
        made: Sequence[Column] = header  # type: ignore[assignment]
        return table([c.title for c in made], ([c.cell(row) for c in made] for row in rows), missing)
    titles: Any = header.split("|") if isinstance(header, str) else header
    return "\n".join(markdown_table(titles, rows, missing))


def csv_text(header: Sequence[Column], rows: Iterable[Any]) -> str:
    """Rows as comma-separated values, cells that are None empty."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(
        [[c.title for c in header], *([c.cell(r) for c in header] for r in rows)]
    )
    return text.getvalue()


def page(*parts: str) -> str:
    """Paragraphs as a page; empty ones are left out."""
    return "\n\n".join(part.rstrip("\n") for part in parts if part) + "\n"


def best_median(best: float, median: float, form: str = ".2f") -> str:
    """Two figures of a race: "best (median)"."""
    return f"{best:{form}} ({median:{form}})"


@dataclass(frozen=True)
class Goal:
    """A goal for a figure; `worst` names the deciding case, where several are covered."""

    text: str
    wanted: float
    measured: float | None
    at_least: bool = False
    worst: str = ""

    @property
    def verdict(self) -> str:
        if self.measured is None:
            return "not measured"
        reached = self.measured >= self.wanted if self.at_least else self.measured <= self.wanted
        return "reached" if reached else "missed"

    def to_dict(self) -> Row:
        return asdict(self) | {"verdict": self.verdict}


def goal_table(heading: str, goals: Iterable[Goal]) -> str:
    """Goals as a table, and whether they are reached."""
    wanted = Column("wanted", lambda g: f"at {'least' if g.at_least else 'most'} {g.wanted:g}")
    return table([Column(heading, "text"), wanted, *columns(("measured", "measured", ".3g"), ("", "verdict"))], goals)


# ---- Results. --------------------------------------------------------------------------------------------------------


def write_results(folder: Path, name: str, text: str, data: Any) -> str:
    """Write NAME.md and NAME.json, each atomically; returns the page."""
    folder.mkdir(parents=True, exist_ok=True)
    atomic_write_text(folder / f"{name}.md", text)
    write_json(folder / f"{name}.json", data)
    return text


def write_figure(file: Path, figure: Any, dpi: int) -> None:
    """Write a figure (of matplotlib) as PNG of 256 colours, or as JPEG, atomically, and close it."""
    from matplotlib import pyplot as plt
    from PIL import Image

    file.parent.mkdir(parents=True, exist_ok=True)
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=dpi, format="png")
    plt.close(figure)
    picture = Image.open(drawn).convert("RGB")
    with atomic_path(file) as temporary:
        if file.suffix == ".jpg":
            picture.save(temporary, "JPEG", quality=90, subsampling=0)
        else:
            picture.quantize(256, dither=Image.Dither.NONE).save(temporary, "PNG", optimize=True)


def write_small_png(file: Path, pictures: Iterable[Any], most_bytes: int) -> None:
    """Write the first of some pictures (of Pillow) that is small enough for the repository, as PNG.

    Raises:
        InputError: none is.
    """
    write_small(file, ((picture, {"optimize": True}) for picture in pictures), most_bytes)


def write_small(file: Path, forms: Iterable[tuple[Any, dict[str, Any]]], most_bytes: int) -> None:
    """Write the first form of a picture (of Pillow, and settings of its file) that is small enough for the repository.

    Raises:
        InputError: none is.
    """
    for picture, settings in forms:
        packed = io.BytesIO()
        picture.save(packed, {".png": "PNG", ".jpg": "JPEG"}[file.suffix], **settings)
        if packed.tell() <= most_bytes:
            with atomic_path(file) as temporary:
                temporary.write_bytes(packed.getvalue())
            return
    size = f"({packed.tell()} bytes)"
    raise InputError(file, "size", size, f"at most {most_bytes} bytes: smaller or fewer pictures")


def denoised(rgb: Any) -> Any:
    """Linear RGB [H, W, 3] after Open Image Denoise, for pictures that are looked at; figures come of the render.

    Raises:
        InputError: its package is not installed.
    """
    try:
        import pyoidn
    except ImportError:
        raise InputError("pictures", "pyoidn", "(missing)", "pip install -e '.[dev]'") from None
    return pyoidn.denoise(np.ascontiguousarray(rgb, dtype=np.float32), hdr=True)


def kept_rows(path: Path, maker: str, key: Callable[[Row], Hashable], listed: str = "") -> dict[Any, Row]:
    """Rows of an earlier run by their key; none where there is no such file.

    Args:
        maker: the command that writes the file. listed: the key of the list in the file, where it is no bare list.

    Raises:
        InputError: a file that holds something else.
    """
    if not path.is_file():
        return {}
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        return {key(row): dict(row) for row in (data[listed] if listed else data)}
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(path, "file", f"({type(error).__name__})", f"rows of {maker}") from error


# ---- The machine. ----------------------------------------------------------------------------------------------------


def machine_line(before_versions: str = "") -> str:
    """Processor, cores and versions in a line."""
    m = machine()
    return f"{m['processor']}, {m['cores']} cores{before_versions}; Python {m['python']}, torch {m['torch']}."


def machine() -> Row:
    """Processor, cores and versions."""
    import numpy
    import torch

    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": numpy.__version__,
        "neurolens": __version__,
        "vectors": torch.backends.cpu.get_cpu_capability(),
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor() or platform.machine()


def most_load(rows: Iterable[Row]) -> float | None:
    """The highest load average of races, whose rows have it as "load", before and after."""
    return max((load for row in rows for load in row["load"] if load is not None), default=None)


class Unmeasured(NeurolensError):
    """Something cannot be measured here; the message says why."""


def in_child(function: Callable[..., Row], *args: str | float) -> Row:
    """Result of a function of a module of this folder for plain arguments, called in a new process.

    Raises:
        Unmeasured: the process failed.
    """
    module, name = function.__module__, function.__name__
    code = f"import json, sys; from {module} import {name} as f; print(json.dumps(f(*json.loads(sys.argv[1]))))"
    command = [sys.executable, "-W", "ignore", "-c", code, json.dumps(args)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    if done.returncode != 0:
        raise Unmeasured(f"{name}{args} in a child process: {done.stderr.strip().splitlines()[-1:]}")
    found: Row = json.loads(done.stdout)
    return found


def cpu_s() -> float:
    """Processor time of this process and of those that it has waited for, in seconds."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def resident_kb(field: str) -> int:
    """Resident memory in kilobytes: "VmRSS" now, "VmHWM" at its highest. Raises OSError: no /proc."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(field)).split()[1])


def memory_growth(work: Callable[[], T]) -> tuple[T, float]:
    """Result of `work`, and by how many bytes the highest resident memory meanwhile exceeds that before.

    Raises:
        OSError: no /proc (other than Linux).
    """

    Path("/proc/self/clear_refs").write_text("5")  # the highest mark starts from here
    before = resident_kb("VmRSS")
    made = work()
    return made, (resident_kb("VmHWM") - before) * 1024.0
