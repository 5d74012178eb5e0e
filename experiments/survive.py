"""Commands that are killed, or meet a full disk, a second run, a clock that went back, a place that cannot be written.

Each case runs a small command once, undisturbed, and then again and again, disturbed: killed by SIGKILL at random
moments of its time and started again, until it is done. What it writes must be the same bytes (of pictures: pixels and
previews; of results: all but times), no file under its final name may be half-written at any moment, and what does not
work must be one line. Commands run in processes forked from this one, so that killing is not spent on imports.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import random
import resource
import shutil
import signal
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from experiments import lab
from neurolens.base.errors import InputError
from neurolens.base.files import atomic_write_text
from neurolens.cli import main
from neurolens.render.pictures import read_channels

OPTIONS = [
    lab.count("kills", 100, "random moments, over all cases (default 100)"),
    lab.option("--only", metavar="COMMAND", nargs="+", default=[], help="some of render, merge, train, survey"),
    lab.count("seed", 0, "of the moments (default 0)", least=0),
    lab.out(),
]
_TILES = 3
_FULL_BYTES = 4096  # of a file on the disk that is full
_MOST_RUNS = 200


@dataclass(frozen=True)
class Case:
    """A command: its arguments in a folder, made by `prepare`, and the files that it shall write."""

    name: str
    argv: tuple[str, ...]
    prepare: Callable[[Path], object]
    share: float  # of the kills


def _scene(folder: Path) -> None:
    shutil.copy(lab.SCENES / "lights.toml", folder / "scene.toml")


def _tiles(folder: Path) -> None:
    _scene(folder)
    for k in range(1, _TILES + 1):
        assert _run(folder, (*_RENDER, "--tile", f"{k}/{_TILES}")) == (0, "")
    for preview in folder.glob("*.png"):
        preview.unlink()


def _lenses(folder: Path) -> None:
    (folder / "lenses").mkdir()
    for name in ("cooke_triplet_50", "brendel_tessar_100"):
        shutil.copy(lab.LENSES / f"{name}.toml", folder / "lenses")


def _experiment(folder: Path) -> None:
    shutil.copy(lab.LENSES / "cooke_triplet_50.toml", folder / "lens.toml")
    (folder / "train.toml").write_text(_TRAIN)


_RENDER = (
    *("render", "scene.toml", "--camera", "pinhole", "-o", "out.exr", "--width", "96", "--samples", "64"),
    *("--threads", "2", "--checkpoint-every", "0.02", "--quiet"),
)
_MERGE = ("merge", *(f"out.tile-{k}-of-3.exr" for k in (1, 2, 3)), "-o", "out.exr")
_SURVEY = ("survey", "lenses", "--rays", "1000", "--terms", "16", "-o", "run", "--jobs", "1", "--quiet")
_TRAIN = """title = "survive"
lens = { file = "lens.toml" }
domain = { focus_m = [inf, inf], wavelength_nm = [400, 700] }
pairs = { train = 1000, held_out = 500, rim = 1000 }
model = [{ method = "ols", terms = 12 }, { method = "mlp", units = 4, layers = 1, steps = 40 }]
evaluation = { vignetting_rays = 2000, rounds = 0 }
"""
CASES = [
    Case("render", _RENDER, _scene, 0.35),
    Case("merge", _MERGE, _tiles, 0.25),
    Case("train", ("train", "train.toml", "-o", "run", "--quiet"), _experiment, 0.25),
    Case("survey", _SURVEY, _lenses, 0.15),
]
_TIMES = ("started", "seconds", "wall_s", "fit_s", "load_s", "bytes")  # of results and cards


def run(args: argparse.Namespace) -> None:
    """Disturb every case, and write the table."""
    import torch  # noqa: F401  before forks: kills shall meet the work

    chance = random.Random(args.seed)
    rows = [
        _case(case, max(1, round(case.share * args.kills)), chance, Path(place))
        for case in CASES
        if not args.only or case.name in args.only
        for place in [tempfile.mkdtemp(prefix="survive-")]
    ]
    header = ["command", "kills", "starts until done, median", "same bytes", "half-written", "full disk"]
    header += ["two runs at once", "clock back a year", "no place to write"]
    table = "\n".join(lab.markdown_table(header, rows))
    page = f"# Runs that are disturbed\n\n{' '.join((__doc__ or '').split())}\n\n{table}\n"
    args.out.mkdir(parents=True, exist_ok=True)
    atomic_write_text(args.out / "survive.md", page)
    print(page)


def _case(case: Case, kills: int, chance: random.Random, place: Path) -> tuple[str, ...]:
    fresh = place / "fresh"
    fresh.mkdir()
    case.prepare(fresh)
    wanted, spent = _undisturbed(case, fresh, place / "whole")
    same = broken = done = starts = 0
    counts = []
    while done < kills:
        folder = _copy(fresh, place / "killed")
        starts = 1
        while done < kills and starts < _MOST_RUNS and not _killed(folder, case.argv, chance.random() * spent):
            done, starts = done + 1, starts + 1
            broken += not _whole(folder)
        same += _ended(folder, case, wanted)
        counts.append(starts)
    told = (_full(case, fresh, place, wanted), _two(case, fresh, place, wanted), _back(case, fresh, place, wanted))
    shutil.rmtree(place)
    middle, agree = sorted(counts)[len(counts) // 2], f"{same} of {len(counts)}"
    return case.name, str(done), str(middle), agree, str(broken), *told, _nowhere(case)


def _undisturbed(case: Case, fresh: Path, folder: Path) -> tuple[dict[str, str], float]:
    """The digests of what the command writes, and the seconds that it takes."""
    _copy(fresh, folder)
    began = time.perf_counter()
    code, said = _run(folder, case.argv)
    assert code == 0, said
    return _written(folder), time.perf_counter() - began


def _copy(fresh: Path, folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(fresh, folder)
    return folder


def _ended(folder: Path, case: Case, wanted: dict[str, str]) -> bool:
    """Whether the same command, undisturbed, ends with the same result."""
    return _run(folder, case.argv) == (0, "") and _written(folder) == wanted


def _full(case: Case, fresh: Path, place: Path, wanted: dict[str, str]) -> str:
    """A disk that takes files of a few thousand bytes only, and then has room."""
    folder = _copy(fresh, place / "full")
    code, said = _run(folder, case.argv, _FULL_BYTES)
    lines = said.strip().count("\n") + 1 if said.strip() else 0
    whole = _whole(folder)
    end = _ended(folder, case, wanted)
    return f"exit {code}, {lines} line{'s' * (lines != 1)}, {'same' if end and whole else 'OTHER'} after"


def _two(case: Case, fresh: Path, place: Path, wanted: dict[str, str]) -> str:
    folder = _copy(fresh, place / "two")
    children = [_start(folder, case.argv) for _ in range(2)]
    codes = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child, _ in children]
    good = _written(folder) == wanted and _whole(folder)
    return f"exit {codes[0]} and {codes[1]}, {'same' if good else 'OTHER'}"


def _back(case: Case, fresh: Path, place: Path, wanted: dict[str, str]) -> str:
    """Started, killed, and started again with all files a year in the future, as after a clock that was wrong."""
    folder = _copy(fresh, place / "back")
    _killed(folder, case.argv, 0.05)
    later = time.time() + 365 * 86400
    for file in folder.rglob("*"):
        os.utime(file, (later, later))
    return "same" if _ended(folder, case, wanted) else "OTHER"


def _nowhere(case: Case) -> str:
    """A folder where nobody can write, the superuser included."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        case.prepare(folder)
        argv = [{"out.exr": "/proc/out.exr", "run": "/proc/run"}.get(word, word) for word in case.argv]
        code, said = _run(folder, argv)
    lines = len(said.strip().splitlines())
    return f"exit {code}, {lines} line{'s' * (lines != 1)}"


def _start(folder: Path, argv: Sequence[str], most_bytes: int | None = None) -> tuple[int, Path]:
    """Begin a command in a process of its own; its number, and the file that will hold what it says on stderr."""
    said = folder.with_name(f"{folder.name}-{random.getrandbits(48):x}.txt")
    child = os.fork()
    if child:
        return child, said
    code = 70
    try:
        os.chdir(folder)
        if most_bytes is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))
        told = io.StringIO()
        with redirect_stdout(io.StringIO()), redirect_stderr(told):
            code = main(argv)
        resource.setrlimit(resource.RLIMIT_FSIZE, resource.getrlimit(resource.RLIMIT_FSIZE))
        said.write_text(told.getvalue()[:_FULL_BYTES])
    finally:
        os._exit(code)


def _run(folder: Path, argv: Sequence[str], most_bytes: int | None = None) -> tuple[int, str]:
    child, said = _start(folder, argv, most_bytes)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    text = said.read_text() if said.exists() else ""
    said.unlink(missing_ok=True)
    return code, text


def _killed(folder: Path, argv: Sequence[str], after_s: float) -> bool:
    """Kill a command after some seconds; True if it was done before."""
    child, said = _start(folder, argv)
    time.sleep(after_s)
    os.kill(child, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    said.unlink(missing_ok=True)
    return code == 0


def _written(folder: Path) -> dict[str, str]:
    """The results in a folder, as digests: of pictures their pixels, of others all bytes."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_dir() or path.name.startswith(".neurolens-") or name in ("scene.toml", "run/report.html"):
            continue
        if path.suffix == ".exr":
            planes, _ = read_channels(path)
            data = b"".join(planes[key].tobytes() for key in sorted(planes))
        elif path.suffix == ".onnx":
            data = _model(path)
        elif path.suffix == ".json":
            told = json.loads(path.read_text())
            told.pop("sha256", None)  # of a model file with its times
            data = _timeless(told)
        else:
            data = path.read_bytes()
        found[name] = sha256(data).hexdigest()
    return found


def _model(path: Path) -> bytes:
    """A model file without the seconds that its card tells."""
    import onnx

    model = onnx.load(path)
    told = {p.key: p.value for p in model.metadata_props}
    del model.metadata_props[:]
    cards = [_timeless(json.loads(text)) if text.startswith("{") else text.encode() for text in told.values()]
    return b"".join([model.SerializeToString(deterministic=True), *cards])


def _timeless(told: Any) -> bytes:
    """Results as JSON without times, and sizes that follow from their digits."""

    def without(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: without(v) for key, v in value.items() if key not in _TIMES}
        return [without(v) for v in value] if isinstance(value, list) else value

    return json.dumps(without(told), sort_keys=True).encode()


def _whole(folder: Path) -> bool:
    """Whether every picture, model and record under its final name can be read."""
    from PIL import Image

    try:
        for path in folder.rglob("*"):
            if path.name.startswith(".neurolens-"):
                continue
            if path.suffix == ".exr":
                read_channels(path)
            elif path.suffix == ".png":
                Image.open(path).load()
            elif path.suffix == ".onnx":
                _model(path)
            elif path.suffix == ".json":
                json.loads(path.read_text())
    except (InputError, OSError, ValueError):
        return False
    return True
