"""The common parts of all measurements: folders, options, tables of columns, goals, kept rows, results, the machine.

A measurement is a module with `OPTIONS` and `run(args)`, and its docstring is its help. Its results are rows
(dataclasses or dictionaries); its page is some words and tables, and each table is a sequence of `Column`.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import os
import platform
import resource
import time
import warnings
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import numpy as np

from neurolens import __version__
from neurolens.base.errors import InputError, NeurolensError, NeurolensWarning
from neurolens.base.files import atomic_path, atomic_write_text, write_json
from neurolens.base.progress import Progress, Report
from neurolens.base.report import plain
from neurolens.base.settings import LARGEST_SEED, whole
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens

ROOT = Path(__file__).parents[1]
LENSES, SCENES, MODELS = ROOT / "lenses", ROOT / "experiments" / "scenes", ROOT / "models"
RESULTS = ROOT / "experiments" / "results"
T = TypeVar("T")
Row = dict[str, Any]


def lens_of(name: str | Path, **state: Any) -> Lens:
    """A lens file, or a lens of lenses/ by the stem of its file, in a state as `set_lens` takes it."""
    return set_lens(read_lens(name if isinstance(name, Path) else LENSES / f"{name}.toml"), **state)


COLLECTIONS = ("OpticsDatabase", "LensVisualizer")  # `named_lenses` and `patent_lenses` make lenses by name from them


def of_collection(file: Path) -> str:
    """The collection that a lens by name was made from; "" for the historical lenses, whose figures we typed."""
    text = file.read_text(encoding="utf-8")
    return next((name for name in COLLECTIONS if name in text), "")


def historical() -> list[Path]:
    """The lens files over which tables range: those of lenses/ but the lenses by name."""
    return [file for file in sorted(LENSES.glob("*.toml")) if not of_collection(file)]


# ---- Options. --------------------------------------------------------------------------------------------------------

Option = Callable[[argparse.ArgumentParser], object]


def option(*names: str, old: Sequence[str] = (), **settings: Any) -> Option:
    """An option with the arguments of `add_argument`; `old` spellings still work, and the help does not show them."""

    def add(parser: argparse.ArgumentParser) -> None:
        action = parser.add_argument(*names, **settings)
        parser._option_string_actions.update(dict.fromkeys(old, action))

    return add


def count(name: str, default: int | None, text: str, least: int = 1, most: int = LARGEST_SEED) -> Option:
    """An option that takes a whole number."""
    return option(f"--{name}", metavar="N", type=whole(least, most), default=default, help=text)


def out(folder: Path = RESULTS, what: str = "folder for the tables") -> Option:
    """--output, by default in runs/; --commit, for the folder in the repository; --quiet."""
    place = ROOT / "runs" / folder.relative_to(ROOT / "experiments") if folder.is_relative_to(RESULTS) else folder

    def add(parser: argparse.ArgumentParser) -> None:
        shown = place.relative_to(ROOT)
        option(
            "-o", "--output", old=("--out",), dest="out", metavar="DIR", type=Path, default=place,
            help=f"{what} (default: {shown})",
        )(parser)  # fmt: skip
        if place != folder:
            text = f"the folder is {folder.relative_to(ROOT)}, which the README shows"
            parser.add_argument("--commit", dest="out", action="store_const", const=folder, help=text)
        QUIET(parser)

    return add


QUIET = option("--quiet", action="store_true", help="neither progress nor warnings on stderr")
ONLY = option("--only", metavar="TEXT", default="", help="lens files whose name holds this text")
AGAIN = option("--restart", old=("--again",), action="store_true", help="measure what is chosen again")
ROUNDS = count("rounds", None, "rounds (default 20; quick 5)")


def chosen(items: Sequence[T], name: Callable[[T], str], only: str, what: str) -> list[T]:
    """The items whose name holds the text of --only; `what` names the measurement.

    Raises:
        InputError: there are none.
    """
    matching = [item for item in items if only in name(item)]
    if not matching:
        known = ", ".join(dict.fromkeys(name(item) for item in items))
        raise InputError(f"experiments {what}", "--only", only, f"part of one of: {known}")
    return matching


def stages(
    items: Iterable[T], name: Callable[[T], str], quiet: bool, seconds: float = 1.0
) -> Iterator[tuple[T, Report]]:
    """Each item as a stage of the progress, with the function that reports it; `seconds` are expected for each."""
    items = list(items)
    progress = Progress({name(item): seconds for item in items}, quiet=quiet)
    for item in items:
        with progress.stage(name(item)) as report:
            yield item, report


def counted(items: Iterable[T], stage: str, quiet: bool) -> Iterator[T]:
    """The items in one stage of the progress, which counts them."""
    items = list(items)
    with Progress(quiet=quiet).stage(stage) as report:
        for k, item in enumerate(items):
            yield item
            report((k + 1) / len(items))


def part_of(report: Report, k: int, count: int) -> Report:
    """The report of part `k` of `count` equal parts of a whole."""
    return lambda fraction, seconds_left=None: report((k + fraction) / count)


def quiet_glasses() -> None:
    """Ignore the warnings that the dispersion of a glass is unknown: it does not matter here."""
    warnings.simplefilter("ignore", NeurolensWarning)


# ---- Pages. ----------------------------------------------------------------------------------------------------------


class Column(NamedTuple):
    """A column: its title, its value in a row (a key or attribute, dots into inner ones, or a function), its format.

    The value is multiplied by `scale` and written with the format `form`; a cell whose value is None shows `missing`.
    """

    title: str
    value: str | Callable[[Any], Any]
    form: str = ""
    scale: float = 1

    def cell(self, row: Any) -> str | None:
        value = self.value(row) if callable(self.value) else look_up(row, self.value)
        return None if value is None else format(value if self.scale == 1 else self.scale * value, self.form)


def look_up(row: Any, path: str) -> Any:
    """The value at a path of keys or attributes; None where a part of it is missing."""
    for part in path.split("."):
        row = row.get(part) if isinstance(row, Mapping) else getattr(row, part, None)
    return row


def columns(*described: tuple[Any, ...]) -> tuple[Column, ...]:
    """Columns from tuples of title, value, format and scale."""
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


def best_median(best: float, median: float, *, form: str = ".2f") -> str:
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


def write_results(folder: Path, name: str, text: str, data: Any, data_name: str = "") -> str:
    """Write NAME.md and NAME.json (or another name), each atomically; `data` may hold dataclasses. Returns the page."""
    folder.mkdir(parents=True, exist_ok=True)
    atomic_write_text(folder / f"{name}.md", text)
    write_json(folder / f"{data_name or name}.json", plain(_as_tables(data)))
    return text


def _as_tables(value: Any) -> Any:
    """The value with its dataclasses as dictionaries."""
    if isinstance(value, Goal):
        return value.to_dict()
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    if isinstance(value, Mapping):
        return {key: _as_tables(item) for key, item in value.items()}
    return [_as_tables(item) for item in value] if isinstance(value, list | tuple) else value


def resume(
    args: argparse.Namespace,
    name: str,
    items: Mapping[Any, T],
    measure: Callable[[T, Report], Row | list[Row]],
    key: Callable[[Row], Hashable],
    page: Callable[[list[Row]], str],
    *,
    listed: str = "rows",
    facts: Row | None = None,
    about: Callable[[list[Row]], Row] = lambda rows: {},
    again: bool = False,
    maker: str = "",
    seconds: float = 20.0,
    order: Sequence[Any] = (),
) -> None:
    """Measure the items that NAME.json lacks, write page and rows after each, and print the page.

    Args:
        items: what to measure, by the key of its rows; `measure` returns one or several. again: measure all of them.
        listed: the key of the list of rows in the file; "" where the file is a bare list.
        facts: stand in the file, by default the machine; given here, rows of other facts are not kept. about: more for
            the file.
        maker: the command, if it is not `experiments NAME`. seconds: expected for an item.
        order: of the keys of the rows; they are sorted without it.
    """
    file, rows = args.out / f"{name}.json", dict[Any, list[Row]]()
    for row in kept_rows(file, maker or f"experiments {name}", listed, facts or {}):
        rows.setdefault(key(row), []).append(row)

    def ordered() -> list[Row]:
        return [row for k in (order or sorted(rows)) for row in rows.get(k, ())]

    missing = [k for k in items if again or k not in rows]
    for k, report in stages(missing, lambda k: k if isinstance(k, str) else " ".join(k), args.quiet, seconds):
        made = measure(items[k], report)
        rows[k] = made if isinstance(made, list) else [made]
        done = ordered()
        data = (facts or {"machine": machine()}) | about(done) | {listed: done} if listed else done
        write_results(args.out, name, page(done), data)
    print(page(ordered()))


def kept_rows(path: Path, maker: str, listed: str = "", facts: Mapping[str, Any] = MappingProxyType({})) -> list[Row]:
    """The rows of an earlier run; none where there is no such file, or one that states other facts.

    Args:
        maker: the command that writes the file. listed: the key of the list in the file, where it is no bare list.

    Raises:
        InputError: the file holds something else.
    """
    if not path.is_file():
        return []
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        same = all(data.get(key) == value for key, value in plain(dict(facts)).items())
        return [dict(row) for row in (data[listed] if listed else data)] if same else []
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(path, "file", f"({type(error).__name__})", f"rows of {maker}") from error


def write_small(file: Path, forms: Iterable[tuple[Any, dict[str, Any]]], most_bytes: int) -> None:
    """Write the first form, a picture of Pillow and the settings of its file, that is small enough for the repository.

    Raises:
        InputError: no form is small enough.
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


def labelled(picture: Any, text: str) -> Any:
    """A picture of Pillow with its title in the upper left corner."""
    from matplotlib import font_manager
    from PIL import ImageDraw, ImageFont

    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), 18)
    ImageDraw.Draw(picture).text((12, 8), text, "white", font, stroke_width=2, stroke_fill="black")
    return picture


def sheet(pictures: Sequence[Any], columns: int, gap: int, background: str = "white") -> Any:
    """Pictures of Pillow, all as large as the first, in rows of `columns`."""
    from PIL import Image

    (width, height), rows = pictures[0].size, -(-len(pictures) // columns)
    size = (columns * (width + gap) - gap, rows * (height + gap) - gap)
    whole = Image.new("RGB", size, background)
    for k, picture in enumerate(pictures):
        whole.paste(picture, (k % columns * (width + gap), k // columns * (height + gap)))
    return whole


def denoised(rgb: Any) -> Any:
    """Linear RGB [H, W, 3] after Open Image Denoise, for pictures to look at; figures are measured before.

    Raises:
        InputError: the package is not installed.
    """
    try:
        import pyoidn
    except ImportError:
        raise InputError("pictures", "pyoidn", "(missing)", "pip install -e '.[dev]'") from None
    return pyoidn.denoise(np.ascontiguousarray(rgb, dtype=np.float32), hdr=True)


# ---- The machine. ----------------------------------------------------------------------------------------------------


def machine_line(before_versions: str = "") -> str:
    """A line about the machine: processor, cores and versions."""
    m = machine()
    return f"{m['processor']}, {m['cores']} cores{before_versions}; Python {m['python']}, torch {m['torch']}."


def machine() -> Row:
    """Processor, cores and versions."""
    import torch

    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
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


def cpu_ns(calls: Mapping[str, Callable[[], int]], rounds: int, report: Report | None = None) -> dict[str, list[float]]:
    """Processor time of calls that take turns, in ns for each of the rays that a call returns, round by round.

    A first round, which compiles and fills caches, is not counted.
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    for k in range(rounds + 1):
        for name, call in calls.items():
            began = time.process_time()
            rays = call()
            if k:
                times[name].append(1e9 * (time.process_time() - began) / rays)
        if report:
            report(k / rounds)
    return times


def race_rows(
    rows: Mapping[str, Row], field: Sequence[Any], domain: Any, rounds: int, over: Callable[[str], Row], report: Report
) -> list[Row]:
    """Race candidates (`neurolens.studies.speed`) named as the rows are, and give each row its times and its ratios.

    Args:
        over: for the name of a row, the candidates that its least time is compared with, by the words of the row for
            them: `speedup` then holds how many times as fast it is.
    """
    from neurolens.studies.speed import race

    timed = race(field, domain, rounds=rounds, report=report)
    for name, row in rows.items():
        timing, ratios = timed.timing(name), {k: timed.speedup(name, base) for k, base in over(name).items()}
        row |= {"ns": timing and dict(timing), "reason": timed.unavailable.get(name), "load": timed.load}
        row["speedup"] = {k: ratio["min"] for k, ratio in ratios.items() if ratio}
    return list(rows.values())


def operations_of(program: Any) -> Row:
    """Floating-point operations of a ray by a program (a fused multiply-add is one), and its roots and divisions."""
    kinds = program.count()
    return {"operations": sum(kinds.values()), "roots": kinds.get("div", 0) + kinds.get("sqrt", 0)}


def times_of(row: Row) -> str:
    """Least and median nanoseconds of a row of a race, or why there are none."""
    if not (ns := row["ns"]):
        return f"not run: {row['reason']}"
    return best_median(ns["min"], ns["median"], form=".2g" if ns["min"] < 1 else ".2f" if ns["min"] < 100 else ",.0f")


def load_line(rows: Iterable[Row]) -> str:
    """The machine, and its load while the rows were measured."""
    return f"{machine_line()} Load average up to {max((row['load'] or 0.0 for row in rows), default=0.0):.1f}."


class Unmeasured(NeurolensError):
    """Something cannot be measured on this machine; the message says why."""


def cpu_s() -> float:
    """Seconds of processor time of this process and of those that it has waited for."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def resident_kb(field: str) -> int:
    """Kilobytes of memory, from /proc: "VmRSS" is the resident memory now, "VmHWM" its highest, "VmData" the data."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(field)).split()[1])
