"""Commands that are killed at random moments: the same command again ends in the same result.

Each case runs a small command once, undisturbed, and then again and again, killed by SIGKILL at random moments of its
time and started again, until it is done. What it writes must be the same bytes (of pictures: pixels and previews; of
results: all but times), and no file under its final name may be half-written at any moment. Commands run in processes
forked from this one, so that killing is not spent on imports.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import random
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
from neurolens.pictures.render.pictures import read_channels

OPTIONS = [
    lab.count("kills", 100, "random moments, over all cases (default 100)"),
    lab.option("--only", metavar="COMMAND", nargs="+", default=[], help="some of render, merge, train, survey"),
    lab.count("seed", 0, "of the moments (default 0)", least=0),
    lab.out(),
]
_TILES = 3
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

    chance, rows = random.Random(args.seed), []
    for case in CASES:
        if not args.only or case.name in args.only:
            with tempfile.TemporaryDirectory(prefix="survive-") as place:
                rows.append(_case(case, max(1, round(case.share * args.kills)), chance, Path(place)))
    header = ["command", "kills", "starts until done, median", "same bytes", "half-written"]
    page = lab.page("# Runs that are killed", " ".join((__doc__ or "").split()), lab.table(header, rows))
    args.out.mkdir(parents=True, exist_ok=True)
    atomic_write_text(args.out / "survive.md", page)
    print(page)


def _case(case: Case, kills: int, chance: random.Random, place: Path) -> tuple[object, ...]:
    fresh = place / "fresh"
    fresh.mkdir()
    case.prepare(fresh)
    wanted, spent = _undisturbed(case, fresh, place / "whole")
    same = broken = done = 0
    counts = []
    while done < kills:
        folder, starts = _copy(fresh, place / "killed"), 1
        while done < kills and starts < _MOST_RUNS and not _killed(folder, case.argv, chance.random() * spent):
            done, starts = done + 1, starts + 1
            broken += not _whole(folder)
        same += _run(folder, case.argv) == (0, "") and _written(folder) == wanted
        counts.append(starts)
    return case.name, done, sorted(counts)[len(counts) // 2], f"{same} of {len(counts)}", broken


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


def _start(folder: Path, argv: Sequence[str]) -> tuple[int, Path]:
    """Begin a command in a process of its own; its number, and the file that will hold what it says on stderr."""
    said = folder.with_name(f"{folder.name}-{random.getrandbits(48):x}.txt")
    child = os.fork()
    if child:
        return child, said
    code = 70
    try:
        os.chdir(folder)
        told = io.StringIO()
        with redirect_stdout(io.StringIO()), redirect_stderr(told):
            code = main(argv)
        said.write_text(told.getvalue())
    finally:
        os._exit(code)


def _run(folder: Path, argv: Sequence[str]) -> tuple[int, str]:
    child, said = _start(folder, argv)
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
