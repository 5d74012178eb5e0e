"""Hostile files and command lines, seeded: does each end with one clear line, in bounded time and memory?

A case damages one file of fuzz_seeds (a lens, scene, mesh, picture, spectrum, model, experiment or checkpoint, or a
file of another program's format) or the words of a command line, and runs the command in a process of its own. It
passes when the exit code is 0, or 2 with one line on stderr (warnings aside), no temporary file stays, a refused
command has written nothing, and processor time, waiting and memory stay within bounds.
Case K of seed S is always the same: `--seed S --first K --cases 1 --keep DIR` shows a fault again.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import zipfile
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from experiments import lab
from neurolens import cli
from neurolens.commands.arguments import Parser

SEEDS = Path(__file__).with_name("fuzz_seeds")
CPU_S, WALL_S, MEMORY = 10.0, 60.0, 1500 << 20
_SPECIAL = ("fifo", "/dev/zero", ".", "missing", "", "a\0b", "\\udc00", "x" * 300, "../" * 2000)
_FLOATS = ("0", "-0.0", "-1", "inf", "-inf", "1e308", "-1e308", "1e-308", "1e-320", "1e15", "1e-15", "1e6", "1e-3", "3")
_NUMBERS = (
    *(*_FLOATS, *_FLOATS, *_FLOATS, "nan"),
    *("1_0", "0x10", "1" * 400, "1" * 5000, "0." + "1" * 20000, "1e999999", "2147483648", "18446744073709551616"),
    *('""', "[]", "{}", "true", "null", "[" * 3000 + "]" * 3000),
)
_WORDS = (*_NUMBERS, *_SPECIAL, "\x1b[31m", "\u00e9", " " * 20000, "-" * 20000, "(" * 5000, "a/" * 5000)
_NUMBER = re.compile(rb"(?<![A-Za-z0-9_.])[-+]?[0-9]+(?:\.[0-9]+)?(?:e[-+]?[0-9]+)?")
_WORD = re.compile(rb"[A-Za-z_][A-Za-z0-9_.-]{0,60}")

_LOADED = (
    *("onnxruntime", "torch", "neurolens.readers.any_format", "neurolens.surrogates.export"),
    *("neurolens.render.renderer", "neurolens.render.scene", "neurolens.cameras.build", "neurolens.cameras.model"),
    *("neurolens.render.pictures", "neurolens.optics.lenscheck", "neurolens.commands.render_files", "onnx"),
)
Chance = random.Random
OPTIONS = (
    lab.count("cases", 1000, "cases (default 1000)"),
    lab.count("seed", 0, "of the random numbers (default 0)", 0),
    lab.count("first", 0, "number of the first case (default 0)", 0),
    lab.option("--only", metavar="KIND", default="", help="cases of one kind"),
    lab.option("--keep", metavar="DIR", type=Path, help="folder for the files of cases with a fault"),
    lab.QUIET,
)


@dataclass(frozen=True)
class Verdict:
    """How a case ended: its number and kind, the command's words, its exit code, what it said, the faults found."""

    case: int
    kind: str
    argv: tuple[str, ...]
    code: int
    said: str
    faults: tuple[str, ...]


# ---- Damage. ---------------------------------------------------------------------------------------------------------


def damage_text(chance: Chance, data: bytes) -> bytes:
    """A text with one to three mistakes: numbers, words, lines, bytes."""
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        kind = chance.choice(("number", "number", "number", "number", "word", "other", "line", "bytes"))
        found = list((_NUMBER if kind == "number" else _WORD).finditer(data))
        if kind in ("number", "word", "other") and found:
            m = chance.choice(found)
            new = chance.choice(_NUMBERS if kind == "number" else _WORDS).encode("utf-8", "surrogatepass")
            data = data[: m.start()] + (chance.choice(found)[0] if kind == "other" else new) + data[m.end() :]
        elif kind == "line":
            lines = data.splitlines(keepends=True) or [b""]
            k = chance.randrange(len(lines))
            lines[k : k + 1] = chance.choice(([], [lines[k]] * 2, [chance.choice(lines)], [lines[k]] * 1000))
            data = b"".join(lines)
        else:
            data = damage_bytes(chance, data)
    return data


def damage_bytes(chance: Chance, data: bytes) -> bytes:
    """Bytes with one to three places changed, cut out, put in or repeated."""
    for _ in range(chance.choice((1, 1, 2, 3))):
        at = chance.randrange(len(data) + 1)
        span = chance.choice((1, 1, 4, 4, 30))
        new = chance.choice(
            (b"", b"\0" * span, b"\xff" * span, b"\xed\xa0\x80", chance.randbytes(span), data[:at][-90:])
        )
        data = data[:at] + new + data[at + chance.choice((0, span, span, 10 * span)) :]
    return data[: chance.randrange(len(data) + 1)] if chance.random() < 0.1 else data


def damage_message(chance: Chance, data: bytes, depth: int = 0) -> bytes:
    """A message of Protocol Buffers with one field, at any depth, left out, repeated, emptied or changed."""
    from neurolens.modelfile.protobuf import message, walk

    try:
        fields = [(n, w, v if isinstance(v, int) else bytes(v)) for n, w, v in walk(memoryview(data))]
    except ValueError:
        fields = []
    if not fields:
        return (damage_text if data.isascii() else damage_bytes)(chance, data)
    k = chance.randrange(len(fields))
    if depth == 0 and chance.random() < 0.9:  # the graph or the metadata, not the version
        k = chance.choice([k for k, field in enumerate(fields) if not isinstance(field[2], int) and len(field[2]) > 99])
    number, wire, value = fields[k]
    if isinstance(value, bytes) and wire == 2 and chance.random() < 0.85:
        new: list[tuple[int, int, Any]] = [(number, wire, damage_message(chance, value, depth + 1))]
    else:
        hostile: tuple[Any, ...] = (0, 1, 2**31, 2**62, 2**64 - 1)
        if isinstance(value, bytes):
            hostile = (b"", b"\0" * len(value), value * 2)
        changed: Any = chance.choice(hostile) if wire in (0, 2) else value
        new = chance.choice(([], [fields[k]] * 2, [chance.choice(fields)], [(number, wire, changed)]))
    return message(iter([*fields[:k], *new, *fields[k + 1 :]]))


# ---- Cases. ----------------------------------------------------------------------------------------------------------


def _damaged(chance: Chance, folder: Path, name: str) -> None:
    file = folder / name
    data = file.read_bytes()
    if name.endswith(".part") and chance.random() < 0.9:
        _damage_archive(chance, file)
    elif name.endswith(".onnx") and chance.random() < 0.9:
        file.write_bytes(damage_message(chance, data))
    else:
        text = b"\0" not in data or chance.random() < 0.2
        file.write_bytes((damage_text if text else damage_bytes)(chance, data))


def _damage_archive(chance: Chance, file: Path) -> None:
    """Damage a member of a zip file, whose checksum then is that of what it has become."""
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = chance.choice(list(members))
    members[name] = damage_text(chance, members[name])
    with zipfile.ZipFile(file, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)


def _render(camera: str = "thin", *more: str) -> list[str]:
    return ["render", "scene.toml", "--camera", camera, "-o", "out.exr", "--threads", "1", "--quiet", *more]


def _of_lens(chance: Chance, folder: Path) -> list[str]:
    _damaged(chance, folder, "lens.toml")
    analyses = (["lens", "lens.toml"], ["analyse", "lens.toml", "seidel"], ["analyse", "lens.toml", "spots"])
    return chance.choice((*3 * (_render("thick:lens.toml"),), *analyses))


def _foreign() -> list[str]:
    """Lens files of other programs."""
    return sorted(file.name for file in SEEDS.iterdir() if file.stem in ("lens", "zoom"))


def _of_format(chance: Chance, folder: Path) -> list[str]:
    name = chance.choice(_foreign())
    _damaged(chance, folder, name)
    return ["convert", name, "-o", "out.toml"]


def _of_scene(chance: Chance, folder: Path) -> list[str]:
    _damaged(chance, folder, "scene.toml")
    return _render()


def _of_asset(chance: Chance, folder: Path) -> list[str]:
    name = chance.choice(("tetra.obj", "tetra.obj", "tetra.ply", "tile.png", "mask.png", "sky.exr", "lamp.csv"))
    if chance.random() < 0.05:
        (folder / name).unlink()
        chance.choice((os.mkfifo, os.mkdir, partial(os.symlink, "/dev/zero")))(folder / name)
    else:
        _damaged(chance, folder, name)
    return _render()


def _of_model(chance: Chance, folder: Path) -> list[str]:
    _damaged(chance, folder, "model.onnx")
    exports = [["export", "model.onnx", "--to", to, "-o", f"out.{to}"] for to in ("c", "glsl", "onnx")]
    return chance.choice((_render("model.onnx"), _render("model.onnx"), *exports))


def _of_experiment(chance: Chance, folder: Path) -> list[str]:
    _damaged(chance, folder, "experiment.toml")
    return ["read", "experiment.toml"]


def _of_checkpoint(chance: Chance, folder: Path) -> list[str]:
    (folder / "kept.part").rename(folder / "out.exr.part")
    _damaged(chance, folder, "out.exr.part")
    return _render("thin", "--samples", "16")


def _of_words(chance: Chance, folder: Path) -> list[str]:
    fine = (
        _render(), _render("thick:lens.toml"), _render("model.onnx"),
        ["lens", "lens.toml"], ["glass", "N-BK7"], ["convert", "lens.zmx", "-o", "out.toml"],
        ["export", "model.onnx", "--to", "c", "-o", "out.h"], ["analyse", "lens.toml", "seidel"],
    )  # fmt: skip
    words = list(chance.choice(fine))
    options = [
        o for name in _parsers()[words[0]] for o in name if o not in ("--help", "-h", "--samples", "--max-depth")
    ]
    for _ in range(chance.choice((1, 1, 2))):
        if chance.random() < 0.7:
            words += [chance.choice(options), chance.choice((*_WORDS, "0.5", "2", "4", "40", "all", "x.png"))]
        else:
            words[chance.randrange(len(words))] = chance.choice((*_WORDS, *options))
    return [word.replace("\\udc00", "\udc00") for word in words]


def _parsers() -> dict[str, list[list[str]]]:
    """Options of each command."""
    kinds = next(a for a in cli.build_parser()._actions if isinstance(a, argparse._SubParsersAction))
    return {name: [list(a.option_strings) for a in p._actions if a.option_strings] for name, p in kinds.choices.items()}


def _of_large(chance: Chance, folder: Path) -> list[str]:
    """A text file grown to 1 MB by one thing repeated."""
    commands = {
        "lens.toml": _render("thick:lens.toml"),
        "scene.toml": _render(), "tetra.obj": _render(), "lamp.csv": _render(),
        "experiment.toml": ["read", "experiment.toml"],
        **{name: ["convert", name, "-o", "out.toml"] for name in _foreign()},
    }  # fmt: skip
    name = chance.choice(list(commands))
    data = (folder / name).read_bytes()
    m = chance.choice(list(re.finditer(rb"[\w.+-]+|[\s\"'=,{}\[\]/:]", data)))
    lines = data.splitlines(keepends=True)
    unit = chance.choice(
        (
            m[0],
            b" ",
            b"1",
            b"a",
            b"\n",
            b".",
            b"a.",
            b"[",
            b"(",
            b'"',
            b"'",
            b"\\",
            b",",
            b"0 ",
            b"1e",
            chance.choice(lines),
        )
    )
    at = chance.choice((m.start(), m.end(), data.find(b"\n", m.end()) + 1))
    (folder / name).write_bytes(data[:at] + unit * (960_000 // len(unit)) + data[at:])
    return commands[name]


KINDS: dict[str, Callable[[Chance, Path], list[str]]] = {
    "lens": _of_lens,
    "format": _of_format,
    "scene": _of_scene,
    "asset": _of_asset,
    "model": _of_model,
    "experiment": _of_experiment,
    "checkpoint": _of_checkpoint,
    "words": _of_words,
    "large": _of_large,
}


def _build() -> Parser:
    """The command line, and `read EXPERIMENT`: an experiment with its lens, domain and scenes; nothing runs."""
    from neurolens.evaluate.experiment import read_experiment
    from neurolens.render.scene import load_scene

    def read(args: argparse.Namespace) -> int:
        experiment = read_experiment(args.file)
        experiment.domain.of(experiment.lens.read())
        for scene in experiment.render.scenes:
            load_scene(scene)
        return 0

    parser = cli.build_parser()
    kinds = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    reader = kinds.add_parser("read")
    reader.add_argument("file", type=Path)
    reader.set_defaults(run=read, kept="nothing")
    return parser


# ---- Running. --------------------------------------------------------------------------------------------------------


def seeds(folder: Path) -> Path:
    """A folder with one good file of each kind; RuntimeError where one is refused."""
    shutil.copytree(SEEDS, folder)
    shutil.copy(lab.LENSES / "cooke_triplet_50.toml", folder / "lens.toml")
    shutil.copy(lab.MODELS / "cooke_triplet_50.ols-64.onnx", folder / "model.onnx")
    os.mkfifo(folder / "fifo")
    for argv in (["read", "experiment.toml"], _render("thin", "--keep-checkpoint", "--samples", "16")):
        code, said, _ = _run(folder, argv)
        if code:  # then every case would be refused
            raise RuntimeError(said)
    for made in ("out.exr", "out.png"):
        (folder / made).unlink()
    (folder / "out.exr.part").rename(folder / "kept.part")
    return folder


def run_case(good: Path, folder: Path, seed: int, case: int, only: str = "") -> Verdict:
    """Make a case in a new folder from good files, and run it."""
    chance = Chance(f"{seed}/{case}")
    kind = chance.choice([k for k in KINDS if only in k])
    shutil.copytree(good, folder, copy_function=shutil.copy, ignore=lambda *_: ["fifo"])
    os.mkfifo(folder / "fifo")
    argv = KINDS[kind](chance, folder)
    before = {path: path.lstat().st_mtime_ns for path in folder.rglob("*")}
    code, said, faults = _run(folder, argv)
    after = {path for path in folder.rglob("*") if path.lstat().st_mtime_ns != before.get(path)}
    after -= {folder / "stderr"}
    if any(".neurolens-" in path.name for path in after):
        faults.append("a temporary file stayed")
    if code == 2 and after:
        faults.append(f"refused, yet wrote {sorted(p.name for p in after)}")
    lines = [line for line in said.splitlines() if not line.startswith("neurolens: warning: ")]
    if code == 2 and (len(lines) != 1 or not lines[0].startswith("neurolens")):
        faults.append("not one line")
    if code == 0 and lines and argv[0] != "render":
        faults.append("done, yet something on stderr")
    if any(ord(c) < 32 and c not in "\n\t" for c in said):
        faults.append("control characters on stderr")
    if len(said) > 20_000:
        faults.append(f"{len(said)} characters on stderr")
    return Verdict(case, kind, tuple(argv), code, said, tuple(faults))


def _run(folder: Path, argv: Sequence[str]) -> tuple[int, str, list[str]]:
    """Exit code, stderr and faults of a command in a process of its own, within bounds."""
    here = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    process = os.fork()
    if not process:
        _command(folder, argv)
    _, status, used = os.wait4(process, 0)
    code, faults = os.waitstatus_to_exitcode(status), []
    with suppress(ProcessLookupError):
        os.killpg(process, signal.SIGKILL)
        faults.append("left a process behind")
    said = (folder / "stderr").read_bytes().decode(errors="backslashreplace")
    if code < 0:
        faults.append(f"killed by {signal.Signals(-code).name}")
    elif code not in (0, 2):
        faults.append(f"exit code {code}")
    if (grown := (used.ru_maxrss - here) << 10) > MEMORY or "memory" in said:
        faults.append(f"memory: {grown >> 20} MB more")
    return code, said, faults


def _command(folder: Path, argv: Sequence[str]) -> None:
    """In the new process: run the command and end."""
    code = 70
    try:
        os.setsid()
        os.chdir(folder)
        for number, name in ((0, os.devnull), (1, os.devnull), (2, "stderr")):
            os.dup2(os.open(name, os.O_RDWR | os.O_CREAT | os.O_TRUNC), number)
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w", errors="backslashreplace")
        os.environ["NEUROLENS_TRACEBACK"] = "1"
        resource.setrlimit(resource.RLIMIT_DATA, (2 * MEMORY + _data_bytes(),) * 2)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 28,) * 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        signal.setitimer(signal.ITIMER_PROF, CPU_S)
        signal.setitimer(signal.ITIMER_REAL, WALL_S)
        code = cli.main(argv, _build)
    except SystemExit as stopped:
        code = stopped.code if isinstance(stopped.code, int) else 1
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        with suppress(OSError, ValueError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def _data_bytes() -> int:
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmData"))
    return int(line.split()[1]) << 10


def run_cases(first: int, cases: int, seed: int, only: str = "", keep: Path | None = None) -> list[Verdict]:
    """Verdicts of cases in a row; the files of those with faults are kept in a folder."""
    for module in _LOADED:  # once, not in every process
        import_module(module)
    _build()
    found = []
    with tempfile.TemporaryDirectory(prefix="neurolens-fuzz-") as scratch:
        good = seeds(Path(scratch) / "good")
        for case in range(first, first + cases):
            folder = Path(scratch) / str(case)
            found.append(run_case(good, folder, seed, case, only))
            if found[-1].faults and keep is not None:
                (folder / "fifo").unlink(missing_ok=True)
                shutil.copytree(folder, keep / f"{seed}-{case}", symlinks=True, dirs_exist_ok=True)
            shutil.rmtree(folder)
    return found


def run(args: argparse.Namespace) -> int:
    """Run the cases, print the faults, and end with code 1 if there are any."""
    if args.keep:
        args.keep.mkdir(parents=True, exist_ok=True)
    bad = 0
    counts: Counter[str] = Counter()
    for first in range(args.first, args.first + args.cases, 100):
        batch = run_cases(first, min(100, args.first + args.cases - first), args.seed, args.only, args.keep)
        for v in batch:
            counts[f"{v.kind}: exit {v.code}"] += 1
            if v.faults:
                bad += 1
                words = " ".join(word if len(word) < 60 else f"{word[:40]}...({len(word)})" for word in v.argv)
                last = v.said.strip()[-300:]
                print(f"case {v.case}, {v.kind}: {'; '.join(v.faults)}\n  {words!r}\n  {last!r}", flush=True)
        if not args.quiet:
            print(f"{first + len(batch) - args.first} cases, {bad} with faults", file=sys.stderr, flush=True)
    print(", ".join(f"{name} {count}" for name, count in sorted(counts.items())))
    print(f"{args.cases} cases of seed {args.seed}: {bad} with faults")
    return int(bad > 0)
