"""Shared by the measurements: folders, arguments, the machine, tables and goals, atomic files."""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

from neurolens import __version__
from neurolens.base.errors import InputError, NeurolensError, NeurolensWarning
from neurolens.base.files import atomic_write_text
from neurolens.evaluate.pages import markdown_table

ROOT = Path(__file__).parents[1]
LENSES, SCENES, MODELS = ROOT / "lenses", ROOT / "experiments" / "scenes", ROOT / "models"
RESULTS = ROOT / "experiments" / "results"
T = TypeVar("T")


def add_out(parser: argparse.ArgumentParser, out: Path = RESULTS, what: str = "folder for the tables") -> None:
    """Add --out and --quiet."""
    shown = out.relative_to(ROOT)
    parser.add_argument("--out", metavar="DIR", type=Path, default=out, help=f"{what} (default: {shown})")
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")


def add_only(parser: argparse.ArgumentParser) -> None:
    """Add --only."""
    parser.add_argument("--only", metavar="TEXT", default="", help="lens files whose name holds this text")


def quiet_glasses() -> None:
    """Ignore warnings of glasses of unknown dispersion, which do not matter here."""
    warnings.simplefilter("ignore", NeurolensWarning)


def write_results(folder: Path, name: str, page: str, data: Any) -> None:
    """Write NAME.md and NAME.json, each atomically."""
    folder.mkdir(parents=True, exist_ok=True)
    atomic_write_text(folder / f"{name}.md", page)
    atomic_write_text(folder / f"{name}.json", json.dumps(data, indent=1, allow_nan=False) + "\n")


def kept_rows(path: Path, listed: str, named: str, maker: str) -> dict[str, dict[str, Any]]:
    """Rows of an earlier run of a benchmark, by name; none where there is no such file.

    Args:
        listed, named: keys of the list of rows, and of a row's name. maker: the command that writes the file.

    Raises:
        InputError: a file that holds something else.
    """
    if not path.is_file():
        return {}
    try:
        return {str(row[named]): dict(row) for row in json.loads(path.read_text(encoding="utf-8"))[listed]}
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(path, "file", f"({type(error).__name__})", f"records of {maker}") from error


def table(header: str | Sequence[str], rows: Iterable[Sequence[Any]], missing: str = "") -> str:
    """A table in Markdown; a header in one string is cut at "|", `missing` stands for cells that are None."""
    return "\n".join(markdown_table(header.split("|") if isinstance(header, str) else header, rows, missing))


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

    @property
    def bound(self) -> str:
        return "at least" if self.at_least else "at most"

    def to_dict(self) -> dict[str, Any]:
        return asdict(self) | {"verdict": self.verdict}


def goal_table(heading: str, goals: Iterable[Goal]) -> str:
    """Goals as a table, and whether they are reached."""
    measured = ((g, "" if g.measured is None else f"{g.measured:.3g}") for g in goals)
    rows = ([g.text, f"{g.bound} {g.wanted:g}", value, g.verdict] for g, value in measured)
    return table([heading, "wanted", "measured", ""], rows)


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


def machine_line(before_versions: str = "") -> str:
    """Processor, cores and versions in a line."""
    m = machine()
    return f"{m['processor']}, {m['cores']} cores{before_versions}; Python {m['python']}, torch {m['torch']}."


def machine() -> dict[str, Any]:
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


class Unmeasured(NeurolensError):
    """Something cannot be measured here; the message says why."""


def in_child(function: Callable[..., dict[str, Any]], *args: str | float) -> dict[str, Any]:
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
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def memory_growth(work: Callable[[], T]) -> tuple[T, float]:
    """Result of `work`, and by how many bytes the highest resident memory meanwhile exceeds that before.

    Raises:
        OSError: no /proc (other than Linux).
    """

    def kilobytes(field: str) -> int:
        lines = Path("/proc/self/status").read_text().splitlines()
        return int(next(line for line in lines if line.startswith(field)).split()[1])

    Path("/proc/self/clear_refs").write_text("5")  # the highest mark starts from here
    before = kilobytes("VmRSS")
    made = work()
    return made, (kilobytes("VmHWM") - before) * 1024.0
