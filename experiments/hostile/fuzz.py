"""Hostile files and command lines, seeded: does each end with one clear line, in bounded time and memory?

A case damages one file (a lens of any format, scene, mesh, picture, spectrum, model, experiment, tile, plate, archive,
list of lights or keys, what an earlier run has kept) or the words of a command line, and runs the command. It passes
when the exit code is 0, or 2 with one line on stderr (warnings aside; 1 where a command judges, as `evaluate`), no
temporary file stays, a refused command has written nothing, a file that was cut or lost bytes (kinds "cut ...") is
refused or gives the pixels of the good one, and processor time, waiting and memory stay within bounds.

Cases run one after the other in a process that has all modules loaded, which is what makes them cheap; what a case
changes in its folder is made good again. A case with a fault runs again in a process of its own, and the page says
where only others before it bring the fault about; one that ends the process, or hangs, costs itself alone.
Case K of seed S is always the same: `--seed S --first K --cases 1 --keep DIR` shows a fault again. A run that is
interrupted goes on, for finished batches are kept.
"""

from __future__ import annotations

import argparse
import gc
import io
import json
import os
import platform
import re
import resource
import shutil
import signal
import stat
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import chdir, redirect_stdout, suppress
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from importlib.metadata import version
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from pkgutil import walk_packages

import numpy as np

import neurolens
from experiments import lab
from experiments.hostile.fuzz_good import make_seeds
from experiments.hostile.fuzz_kinds import KINDS, RIGHT, SEEDS, build, chosen, plate, shorten
from experiments.lab import cpu_s, resident_kb
from neurolens import __version__, cli
from neurolens.base.files import atomic_write_text, write_json
from neurolens.cli.arguments import Parser

__all__ = ["KINDS", "SEEDS"]

CPU_S, LONG_CPU_S, WALL_S, MEMORY = 20.0, 60.0, 300.0, 2 << 30
_BATCH = 500
_UNFINISHED = "unfinished"
_JUDGES = ("evaluate", "models", "library", "survey", "train")  # their exit code 1 is an answer
OPTIONS = (
    lab.count("cases", 1000, "cases (default 1000)"),
    lab.count("seed", 0, "of the random numbers (default 0)", 0),
    lab.count("first", 0, "number of the first case (default 0)", 0),
    lab.option("--only", metavar="KIND", default="", help="cases of one kind"),
    lab.option("--keep", metavar="DIR", type=Path, help="folder for the files of cases with a fault"),
    lab.option("--restart", old=("--again",), action="store_true", help="do finished batches again"),
    lab.out(),
)


# of a command whose --quiet was damaged: what it did, assumed and compiled
_PROGRESS = re.compile(r": +(done in|stopped after|\d+%|assumed: |compiled )")
_TOLD = re.compile(r"neurolens: (warning: |'.*' is )")  # a warning, or which lens some words mean


@dataclass(frozen=True)
class Verdict:
    """The end of a case: number and kind, words of the command, exit code, end of stderr, faults, seconds of processor
    time (its processes included), and the largest memory of it or of one of its processes."""

    case: int
    kind: str
    argv: list[str]
    code: int
    said: str
    faults: list[str]
    cpu_s: float = 0.0
    memory: int = 0


# ---- Cases, one after the other in a process of their own. ----------------------------------------------------------


def run_cases(
    good: Path, scratch: Path, cases: Sequence[int], seed: int, only: str, keep: Path | None
) -> list[Verdict]:
    """Run cases on a copy of good files; the files of one that has a fault are kept in a folder by its number."""
    verdicts = list[Verdict]()
    while rest := cases[len(verdicts) :]:
        for verdict in _process(good, scratch, rest, seed, only):
            if verdict.faults and len(rest) > 1:
                (alone,) = run_cases(good, scratch, [verdict.case], seed, only, keep)
                verdict = alone if alone.faults else replace(verdict, faults=[*verdict.faults, "only after others"])
            elif verdict.faults and keep is not None:
                _keep(scratch / "work", keep / f"{seed}-{verdict.case}", verdict)
            verdicts.append(verdict)
    return verdicts


def _process(good: Path, scratch: Path, cases: Sequence[int], seed: int, only: str) -> list[Verdict]:
    """Verdicts of the cases that one process runs: all, or those up to the one that ends it."""
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    answers, answer = Pipe(duplex=False)
    process = os.fork()
    if not process:
        try:
            answers.close()
            _work(good, scratch, cases, seed, only, answer)
        finally:
            os._exit(0)
    answer.close()
    verdicts = dict[int, Verdict]()
    try:
        while answers.poll(WALL_S):
            verdict = Verdict(**json.loads(answers.recv_bytes()))
            verdicts[verdict.case] = verdict
    except EOFError:
        pass
    finally:  # where this process is interrupted, too
        with suppress(ProcessLookupError):
            os.killpg(process, signal.SIGKILL)  # what hangs, and what the cases left behind
        os.kill(process, signal.SIGKILL)
    _, status, used = os.wait4(process, 0)
    if not verdicts:
        raise RuntimeError((scratch / "stderr").read_text())
    if verdict.faults == [_UNFINISHED]:
        code, said = os.waitstatus_to_exitcode(status), (scratch / "stderr").read_bytes()[-2000:]
        why = f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended with {code}"
        text, memory = said.decode(errors="backslashreplace"), used.ru_maxrss << 10
        verdicts[verdict.case] = replace(verdict, code=code, said=text, faults=[why], memory=memory)
    return list(verdicts.values())


def _work(good: Path, scratch: Path, cases: Sequence[int], seed: int, only: str, answer: Connection) -> None:
    """Run cases in the new process: before each, tell that it begins; after it, the verdict."""
    os.setsid()
    os.environ["NEUROLENS_TRACEBACK"] = "1"
    for number, name in ((0, os.devnull), (1, os.devnull), (2, str(scratch / "stderr"))):
        os.dup2(os.open(name, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND), number)
    sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w", errors="backslashreplace")
    resource.setrlimit(resource.RLIMIT_DATA, (2 * MEMORY + 1024 * resident_kb("VmData"),) * 2)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 28,) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    parser, place, clean = build(), scratch / "work", dict[str, tuple[int, ...]]()
    place.mkdir()
    for case in cases:
        clean = _restore(good, place, clean)
        chance, kind = chosen(seed, case, only)
        verdict = Verdict(case, kind, KINDS[kind][1](chance, place), 0, "", [_UNFINISHED])
        answer.send_bytes(json.dumps(asdict(verdict)).encode())
        answer.send_bytes(json.dumps(asdict(_judged(verdict, place, lambda: parser))).encode())


def _judged(begun: Verdict, place: Path, parser: Callable[[], Parser]) -> Verdict:
    """Run the command of a case within bounds, and judge how it ends."""
    before, spent, of_children = _state(place), cpu_s(), resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    os.chdir(place)
    os.ftruncate(2, 0)
    Path("/proc/self/clear_refs").write_text("5")  # the largest memory counts from here
    signal.setitimer(signal.ITIMER_PROF, CPU_S if begun.kind != "long runs" else LONG_CPU_S)
    try:
        code = cli.main(begun.argv, parser)
    except SystemExit as stopped:
        code = stopped.code if isinstance(stopped.code, int) else 1
    except BaseException:
        traceback.print_exc()
        code = 70
    signal.setitimer(signal.ITIMER_PROF, 0)
    with suppress(OSError, ValueError):
        sys.stdout.flush()
        sys.stderr.flush()
    memory, children = resident_kb("VmHWM"), resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    memory = max(memory, children if children > of_children else 0) << 10
    after = _state(place)
    new = [os.path.basename(path) for path in after if after[path] != before.get(path)]
    said = (place.parent / "stderr").read_bytes().decode(errors="backslashreplace")
    faults = [*_faults(begun.argv, code, said, new, memory), *(_other_pixels(place) if code == 0 else ())]
    with suppress(ChildProcessError):
        if os.waitpid(-1, os.WNOHANG) == (0, 0):
            faults.append("a process stayed")
    return replace(begun, code=code, said=said[-2000:], faults=faults, cpu_s=cpu_s() - spent, memory=memory)


def _state(place: Path) -> dict[str, tuple[int, ...]]:
    """The paths in a folder, with numbers that change with their contents."""
    found = dict[str, tuple[int, ...]]()
    for folder, folders, names in os.walk(place):
        for path in (os.path.join(folder, name) for name in (*folders, *names)):
            about = os.lstat(path)
            changing = () if stat.S_ISDIR(about.st_mode) else (about.st_size, about.st_ctime_ns)
            found[path] = (about.st_ino, about.st_mode, *changing)
    return found


def _restore(good: Path, place: Path, clean: dict[str, tuple[int, ...]]) -> dict[str, tuple[int, ...]]:
    """Make the folder of cases equal to that of good files again; `clean` and the result are its states when it is."""
    for path, about in sorted(_state(place).items(), reverse=True):  # what is in a folder before the folder
        if about != clean.get(path):
            shutil.rmtree(path) if stat.S_ISDIR(about[1]) else os.unlink(path)
    for path in clean or map(str, sorted(place / source.relative_to(good) for source in good.rglob("*"))):
        if not os.path.lexists(path):
            source = good / os.path.relpath(path, place)
            if source.is_dir():
                os.mkdir(path)
            elif source.is_file():
                shutil.copy(source, path)
            else:
                os.mkfifo(path)
    return _state(place)


def _keep(place: Path, keep: Path, verdict: Verdict) -> None:
    """Keep the files of a case, and its verdict."""
    shutil.rmtree(keep, ignore_errors=True)
    fifos = [path for path in place.rglob("*") if path.is_fifo()]
    shutil.copytree(place, keep, symlinks=True, ignore=lambda f, names: [n for n in names if Path(f, n) in fifos])
    write_json(keep / "verdict.json", asdict(verdict))


def _faults(argv: Sequence[str], code: int, said: str, new: Sequence[str], memory: int) -> Iterator[str]:
    """The faults of how a command ended, by its exit code, its stderr and the names of its new files."""
    lines = [line for line in said.splitlines() if not _TOLD.match(line)]
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


def _other_pixels(place: Path) -> Iterator[str]:
    """The fault of a damaged file that was accepted: its pixels are not those of the good one (`fuzz_kinds.RIGHT`)."""
    if (told := place / RIGHT).exists():
        from neurolens.pictures.render.pictures import read_channels

        (right, _), (found, _) = (read_channels(place / name) for name in told.read_text().split())
        if right.keys() != found.keys() or any(not np.array_equal(right[n], found[n]) for n in right):
            yield "accepted, with other pixels"


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
    for module in walk_packages(neurolens.__path__, "neurolens."):  # once, not in every process
        with suppress(ImportError):  # of an extra, or of Blender
            module.name.endswith("__main__") or import_module(module.name)
    import_module("torch").set_num_threads(1)  # a fork has none of the threads that a library counts on
    shorten()
    with tempfile.TemporaryDirectory(prefix="neurolens-fuzz-", dir=_disk()) as scratch:
        good = Path(scratch) / "good"
        make_seeds(good, kinds, _single)
        _warm(good, Path(scratch) / "warm")
        gc.collect()
        gc.freeze()
        for first in range(args.first, wanted.stop, _BATCH):
            cases = range(first, min(first + _BATCH, wanted.stop))
            kept = folder / f"{args.seed}-{first}-{len(cases)}{args.only and '-'}{args.only}.json"
            if args.restart or not kept.exists():
                made = run_cases(good, Path(scratch) / "case", cases, args.seed, args.only, args.keep)
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
