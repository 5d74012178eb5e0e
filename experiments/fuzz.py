"""Hostile files and command lines, seeded: does each end with one clear line, in bounded time and memory?

A case damages one file (a lens of any format, scene, mesh, picture, spectrum, model, experiment, tile, plate, archive,
list of lights or keys, what an earlier run has kept) or the words of a command line, and runs the command. It passes
when the exit code is 0, or 2 with one line on stderr (warnings aside; 1 where a command judges, as `evaluate`), no
temporary file stays, a refused command has written nothing, and processor time, waiting and memory stay within bounds.

Cases run one after the other in a process that is forked for every two hundred of them; one that dies or hangs costs
its own case. A case with a fault is run again in a process of its own, and the page tells whether it fails there, too.
Case K of seed S is always the same: `--seed S --first K --cases 1 --keep DIR` shows a fault again. A run that is
interrupted goes on, for finished batches are kept.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import platform
import re
import resource
import select
import shutil
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import chdir, redirect_stdout, suppress
from dataclasses import asdict, dataclass
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

from experiments import lab
from experiments.fuzz_kinds import KINDS, SEEDS, build, chosen, make_seeds, plate, shorten
from experiments.lab import cpu_s, resident_kb
from neurolens import __version__, cli
from neurolens.base.files import atomic_write_text, write_json

__all__ = ["KINDS", "SEEDS", "run_cases"]

CPU_S, LONG_CPU_S, WALL_S, MEMORY = 20.0, 60.0, 300.0, 2 << 30
_BATCH = 200
_JUDGES = ("evaluate", "models", "library", "survey", "train")  # their exit code 1 is an answer
_LOADED = (
    *("onnxruntime", "torch", "onnx", "matplotlib.pyplot", "neurolens.readers.any_format"),
    *("neurolens.surrogates.export", "neurolens.render.renderer", "neurolens.render.scene", "neurolens.cameras.build"),
    *("neurolens.cameras.model", "neurolens.render.pictures", "neurolens.setting.check", "neurolens.flare.layers"),
    *("neurolens.cli.render", "neurolens.study.survey", "neurolens.analysis.spots"),
    "neurolens.photographs.rims",
)
OPTIONS = (
    lab.count("cases", 1000, "cases (default 1000)"),
    lab.count("seed", 0, "of the random numbers (default 0)", 0),
    lab.count("first", 0, "number of the first case (default 0)", 0),
    lab.option("--only", metavar="KIND", default="", help="cases of one kind"),
    lab.option("--keep", metavar="DIR", type=Path, help="folder for the files of cases with a fault"),
    lab.option("--restart", old=("--again",), action="store_true", help="do finished batches again"),
    lab.out(),
)


_PROGRESS = re.compile(r": (done in|stopped after|\d+%)")  # of a command whose --quiet was damaged


@dataclass(frozen=True)
class Verdict:
    """The end of a case: number and kind, words of the command, exit code, end of stderr, faults, seconds of processor
    time (its processes included), and the largest memory of it or of one of its processes."""

    case: int
    kind: str
    argv: tuple[str, ...]
    code: int
    said: str
    faults: tuple[str, ...]
    cpu_s: float = 0.0
    memory: int = 0


# ---- A batch: cases one after the other, in a process of its own. ----------------------------------------------------


class Folder:
    """A folder of good files that is made whole again after every case."""

    def __init__(self, good: Path, place: Path) -> None:
        shutil.copytree(good, place, copy_function=shutil.copy, ignore=lambda *_: ["fifo"])
        os.mkfifo(place / "fifo")
        self.place = place
        self.good = {p: p.read_bytes() if p.is_file() else None for p in sorted(place.rglob("*"))}
        self.clean = self.state()

    def state(self) -> dict[Path, tuple[int, int, int]]:
        """The paths in the folder, with numbers that change with their contents."""
        found = {}
        for path in self.place.rglob("*"):
            about = path.lstat()
            found[path] = about.st_ino, about.st_size, 0 if path.is_dir() else about.st_mtime_ns
        return found

    def restore(self) -> None:
        """Write what has changed anew, and remove what is new."""
        now = self.state()
        for path in now:
            if path not in self.good and path.parent in (self.place, *self.good):
                _remove(path)
        for path, data in self.good.items():
            if now.get(path) == self.clean[path]:
                continue
            if data is not None:
                _remove(path)
                path.write_bytes(data)
            elif path.name != "fifo":
                if not path.is_dir() or path.is_symlink():
                    _remove(path)
                path.mkdir(exist_ok=True)
            elif not path.is_fifo():
                _remove(path)
                os.mkfifo(path)
        self.clean = self.state()


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _batch(good: Path, scratch: Path, cases: Sequence[int], seed: int, only: str, answers: int) -> None:
    """Run cases in the new process, and write a line for each of them to a pipe."""
    try:
        os.setsid()
        os.environ["NEUROLENS_TRACEBACK"] = "1"
        for number, name in ((0, os.devnull), (1, os.devnull), (2, str(scratch / "stderr"))):
            os.dup2(os.open(name, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND), number)
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w", errors="backslashreplace")
        resource.setrlimit(resource.RLIMIT_DATA, (2 * MEMORY + 1024 * resident_kb("VmData"),) * 2)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 28,) * 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        parser = build()
        folder = Folder(good, scratch / "work")
        for case in cases:
            chance, kind = chosen(seed, case, only)
            argv = KINDS[kind][1](chance, folder.place)
            os.write(answers, f"{json.dumps([case, kind, argv])}\n".encode())
            verdict = _case(case, kind, argv, folder, lambda: parser)
            os.write(answers, f"{json.dumps(asdict(verdict))}\n".encode())
            if verdict.faults and len(cases) == 1:
                os._exit(0)  # the files stay for whoever asked
            os.chdir(scratch)
            folder.restore()
    except BaseException:
        import traceback

        os.write(answers, f"{json.dumps({'broken': traceback.format_exc()})}\n".encode())
    finally:
        os._exit(0)


def _case(case: int, kind: str, argv: list[str], folder: Folder, parser: Callable[[], Any]) -> Verdict:
    """Run one command and judge how it ends."""
    before = folder.state()
    os.chdir(folder.place)
    os.ftruncate(2, 0)
    Path("/proc/self/clear_refs").write_text("5")  # the largest memory counts from here
    spent, children = cpu_s(), resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    signal.setitimer(signal.ITIMER_PROF, CPU_S if kind != "long runs" else LONG_CPU_S)
    try:
        code = cli.main(argv, parser)
    except SystemExit as stopped:
        code = stopped.code if isinstance(stopped.code, int) else 1
    except BaseException:
        import traceback

        traceback.print_exc()
        code = 70
    signal.setitimer(signal.ITIMER_PROF, 0)
    with suppress(OSError, ValueError):
        sys.stdout.flush()
        sys.stderr.flush()
    largest = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    memory = max(resident_kb("VmHWM"), largest if largest > children else 0) << 10
    after = folder.state()
    new = [path for path in after if after[path] != before.get(path)]
    said = (folder.place.parent / "stderr").read_bytes().decode(errors="backslashreplace")
    faults = tuple(_faults(argv, code, said, [p.name for p in new], memory))
    return Verdict(case, kind, tuple(argv), code, said[-2000:], faults, cpu_s() - spent, memory)


def _faults(argv: Sequence[str], code: int, said: str, new: Sequence[str], memory: int) -> Iterator[str]:
    """The faults of how a command ended, by its exit code, its stderr and the names of its new files."""
    lines = [line for line in said.splitlines() if not line.startswith("neurolens: warning: ")]
    if code not in (0, 2) and not (code == 1 and argv[0] in _JUDGES):
        yield f"exit code {code}"
    if any(".neurolens-" in name for name in new):
        yield "a temporary file stayed"
    if code == 2 and new and "--frames" not in argv:  # frames before the one that is refused are finished
        yield f"refused, yet wrote {sorted(new)[:5]}"
    if code == 2 and (len(lines) != 1 or not lines[0].startswith("neurolens")):
        yield "not one line"
    if code < 2 and any(not _PROGRESS.search(line) for line in lines):
        yield "done, yet something on stderr"
    if "Traceback" in said:
        yield "a traceback"
    if any(ord(c) < 32 and c not in "\n\t" for c in said):
        yield "control characters on stderr"
    if len(said) > 20_000:
        yield f"{len(said)} characters on stderr"
    if memory > MEMORY or re.search(r"\bmemory\b", said):
        yield f"memory: {memory >> 20} MB"


# ---- Batches. --------------------------------------------------------------------------------------------------------


def _answers(good: Path, scratch: Path, cases: Sequence[int], seed: int, only: str) -> Iterator[Verdict]:
    """Verdicts of cases in a process of their own; the last may be that of one that died or took too long."""
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    there, here = os.pipe()
    process = os.fork()
    if not process:
        os.close(there)
        _batch(good, scratch, cases, seed, only, here)
    os.close(here)
    begun: list[Any] | None = None
    why = ""
    with os.fdopen(there, "rb") as pipe:
        while True:
            if not select.select([pipe], [], [], WALL_S)[0]:
                why = f"no end within {WALL_S:g} s"
                break
            line = pipe.readline()
            if not line:
                break
            answer = json.loads(line)
            if isinstance(answer, list):
                begun = answer
            elif "broken" in answer:
                raise RuntimeError(answer["broken"])
            else:
                begun = None
                yield Verdict(**{**answer, "argv": tuple(answer["argv"]), "faults": tuple(answer["faults"])})
    with suppress(ProcessLookupError):
        os.killpg(process, signal.SIGKILL)
    _, status, used = os.wait4(process, 0)
    if begun is not None:
        number = os.waitstatus_to_exitcode(status)
        why = why or (f"killed by {signal.Signals(-number).name}" if number < 0 else f"ended with {number}")
        said = (scratch / "stderr").read_bytes()[-2000:].decode(errors="backslashreplace")
        yield Verdict(begun[0], begun[1], tuple(begun[2]), number, said, (why,), 0.0, used.ru_maxrss << 10)


def run_cases(
    good: Path, scratch: Path, cases: Sequence[int], seed: int, only: str = "", keep: Path | None = None
) -> list[Verdict]:
    """Verdicts of cases. One with a fault is run again by itself, and its files are kept in a folder."""
    found: list[Verdict] = []
    while len(found) < len(cases):
        got = list(_answers(good, scratch / "batch", cases[len(found) :], seed, only))
        if not got:
            raise RuntimeError(f"no answer from case {cases[len(found)]} on")
        found += got
    for k, verdict in enumerate(found):
        if verdict.faults:
            (alone,) = _answers(good, scratch / "alone", [verdict.case], seed, only)
            also = (*verdict.faults, "not when it is run by itself") if not alone.faults else verdict.faults
            found[k] = Verdict(**{**asdict(verdict), "faults": also})
            if keep is not None:
                _keep(scratch / "alone" / "work", keep / f"{seed}-{verdict.case}", found[k])
    return found


def _keep(work: Path, place: Path, verdict: Verdict) -> None:
    (work / "fifo").unlink(missing_ok=True)
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(work, place, symlinks=True, ignore=lambda f, names: [n for n in names if (Path(f) / n).is_fifo()])
    write_json(place / "verdict.json", asdict(verdict))


def _single(folder: Path, argv: list[str]) -> tuple[int, str]:
    """Exit code and stderr of a command on good files, in a process of its own."""
    process = os.fork()
    if not process:
        code = 70
        try:
            os.chdir(folder)
            for number, name in ((1, os.devnull), (2, "../said")):
                os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
            sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
            code = cli.main(argv, build)
            sys.stderr.flush()
        finally:
            os._exit(code)
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    return code, (folder.parent / "said").read_text()


def _warm(good: Path, place: Path) -> None:
    """Do here, once, what every batch would do for good files: imports, and the field of the plates' lens."""
    shutil.copytree(good, place, ignore=lambda *_: ["fifo"])
    with chdir(place), redirect_stdout(io.StringIO()):
        if code := cli.main(plate("plate.exr"), build):
            raise RuntimeError(f"exit code {code} of a good plate")


def run(args: argparse.Namespace) -> int:
    """Run the cases, print the faults, write the page, and end with code 1 if there are any faults."""
    folder = args.out / "fuzz"
    folder.mkdir(parents=True, exist_ok=True)
    wanted = range(args.first, args.first + args.cases)
    kinds = {chosen(args.seed, case, args.only)[1] for case in wanted}
    verdicts = list[Verdict]()
    for module in _LOADED:  # once, not in every process
        import_module(module)
    shorten()
    with tempfile.TemporaryDirectory(prefix="neurolens-fuzz-", dir=_disk()) as scratch:
        good = Path(scratch) / "good"
        make_seeds(good, kinds, _single)
        _warm(good, Path(scratch) / "warm")
        for first in range(args.first, wanted.stop, _BATCH):
            cases = range(first, min(first + _BATCH, wanted.stop))
            kept = folder / f"{args.seed}-{first}-{len(cases)}{args.only and '-'}{args.only}.json"
            if args.restart or not kept.exists():
                made = run_cases(good, Path(scratch), cases, args.seed, args.only, args.keep)
                write_json(kept, [asdict(v) for v in made])
            verdicts += [Verdict(**row) for row in json.loads(kept.read_text())]
            bad = [v for v in verdicts if v.faults]
            if not args.quiet:
                print(f"{len(verdicts)} cases, {len(bad)} with faults", file=sys.stderr, flush=True)
    for v in bad:
        words = " ".join(word if len(word) < 60 else f"{word[:40]}...({len(word)})" for word in v.argv)
        print(f"case {v.case}, {v.kind}: {'; '.join(v.faults)}\n  {words!r}\n  {v.said.strip()[-300:]!r}")
    text = _page(args, verdicts)
    atomic_write_text(args.out / "fuzz.md", text)
    print(text)
    return int(bool(bad))


def _disk() -> str | None:
    """A disk in memory, where there is one: each case writes, and flushes what it writes."""
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


# ---- The page. -------------------------------------------------------------------------------------------------------


def _page(args: argparse.Namespace, verdicts: Sequence[Verdict]) -> str:
    """The table of exit codes, times and memory by kind, and the command that shows it again."""
    codes = sorted({v.code for v in verdicts})
    header = ["damaged", "cases", *(f"exit {code}" for code in codes), "faults", "slowest, CPU s", "largest memory, MB"]
    rows = []
    for name in KINDS:
        if mine := [v for v in verdicts if v.kind == name]:
            counter, slowest = Counter(v.code for v in mine), max(v.cpu_s for v in mine)
            counts = [len(mine), *(counter[code] for code in codes), sum(bool(v.faults) for v in mine)]
            rows.append([name, *counts, f"{slowest:.1f}", f"{max(v.memory for v in mine) / 2**20:.0f}"])
    command = f"python -m experiments fuzz --cases {args.cases} --seed {args.seed}"
    command += (f" --first {args.first}" if args.first else "") + (f" --only {args.only}" if args.only else "")
    versions = ", ".join(f"{name} {version(name)}" for name in ("torch", "numpy", "onnxruntime", "OpenEXR", "pillow"))
    bad, minutes = sum(bool(v.faults) for v in verdicts), sum(v.cpu_s for v in verdicts) / 60
    made = f"`{command}`: {len(verdicts)} cases, {bad} with faults, {minutes:.0f} CPU minutes."
    made += f" neurolens {__version__}, Python {platform.python_version()}, {versions}."
    known = "Memory includes the 0.4 GB of the libraries that each process has loaded. Exit code 2 refuses in one line."
    return lab.page("# Hostile input", " ".join((__doc__ or "").split()), lab.table(header, rows), f"{made} {known}")
