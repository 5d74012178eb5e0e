"""Commands as tasks of an engine: with the files that they read, to the files that they write.

The files are those that reading the command's inputs opened here; on the worker they lie in a folder of the same
shape, below one of its own, so that scenes find their pictures.
"""

from __future__ import annotations

import argparse
import io
import os
import warnings
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any

from neurolens.base.engine import Failed, on_dask
from neurolens.base.errors import NeurolensError
from neurolens.base.files import TemporaryFolder, atomic_path, place_inside
from neurolens.base.lensname import IDEAL, split_kind
from neurolens.commands.arguments import more_glasses

DASK_HELP = (
    "run on a Dask cluster: the address of its scheduler (tcp://HOST:8786), or local (processes of this machine), or "
    "local:N, which no other user can reach. What a task reads travels with it: workers need neurolens alone, and no "
    "folder in common. Whoever reaches a scheduler at tcp:// can run programs as you; tls:// takes keys"
)
_THEN = (1980, 1, 1, 0, 0, 0)  # the same files are the same bytes


def add_dask(parser: argparse._ActionsContainer) -> None:
    """Add --dask."""
    parser.add_argument("--dask", metavar="ADDRESS", help=DASK_HELP)


_TEXTS = (".json", ".toml", ".html", ".md", ".csv")
Work = Callable[[argparse.Namespace], object]


@dataclass(frozen=True)
class Task:
    """A command on a worker.

    Attributes:
        name: of what is made, for messages.
        work: module and function, which take the command's arguments and write below the folder `args.out`.
        args: the arguments; every path, also the camera's, is that of a packed file, or `out`, a name.
        place: the folder here in which `out` will be.
    """

    name: str
    work: tuple[str, str]
    args: dict[str, Any]
    place: str

    @classmethod
    def of(cls, name: str, work: Work, args: argparse.Namespace, out: Path) -> Task:
        """A task of a function of a module, with arguments whose paths are those here."""
        plain = {key: _placed(key, value) for key, value in vars(args).items() if key not in ("run", "out")}
        return cls(name, (work.__module__, work.__name__), plain | {"out": out.name}, os.path.abspath(out.parent))


def files_of(args: argparse.Namespace) -> set[Path]:
    """The files that arguments name themselves; what these name, `files.noted_files` finds."""
    named = [each for value in vars(args).values() for each in (value if isinstance(value, list) else [value])]
    return {Path(os.path.abspath(each)) for each in named if isinstance(each, Path) and each.is_file()}


def packed(files: Mapping[str, Path] | Iterable[Path]) -> bytes:
    """Files as bytes, by name, or by their absolute path."""
    named = files if isinstance(files, Mapping) else {os.path.abspath(path): path for path in files}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted(named):
            archive.writestr(zipfile.ZipInfo(name.lstrip("/"), _THEN), named[name].read_bytes())
    return buffer.getvalue()


def unpack(data: bytes, folder: Path) -> list[Path]:
    """Write packed files below a folder, each whole or not at all; their paths."""
    found = []
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        for name in archive.namelist():
            try:
                path = place_inside(folder, name)
            except ValueError as error:
                raise NeurolensError(f"an answer with a file outside its folder: {error}") from None
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(path) as temporary:
                temporary.write_bytes(archive.read(name))
            found.append(path)
    return found


def run_task(files: bytes, task: Task) -> bytes:
    """Run a task on a worker; the files that it wrote, packed."""
    root = Path(_unpacked(files).name)
    function: Work = getattr(import_module(task.work[0]), task.work[1])
    place = root / task.place.lstrip("/")  # relative paths from there to the inputs are those of the asker
    place.mkdir(parents=True, exist_ok=True)
    args = argparse.Namespace(**{key: _placed(key, value, root) for key, value in task.args.items()})
    args.out = place / task.args["out"]
    before = set(place.rglob("*"))
    try:
        with warnings.catch_warnings(), redirect_stdout(io.StringIO()), more_glasses(args):
            warnings.simplefilter("ignore")
            function(args)
        made = [path for path in sorted(place.rglob("*")) if path.is_file() and path not in before]
        for path in made:
            if path.suffix in _TEXTS:
                path.write_bytes(path.read_bytes().replace(f"{root}/".encode(), b"/"))
        return packed({str(path.relative_to(place)): path for path in made})
    except NeurolensError as error:
        raise NeurolensError(str(error).replace(str(root), "")) from None
    finally:
        for path in sorted(set(place.rglob("*")) - before, reverse=True):
            path.rmdir() if path.is_dir() else path.unlink()


def spread(
    address: str, tasks: Sequence[Task], common: Iterable[Path], folder: Path, report: Callable[[float], object]
) -> dict[str, str]:
    """Run tasks on a cluster and write their files below a folder as they come; the reasons of those that failed."""
    failed: dict[str, str] = {}
    engine = on_dask(address, run_task, packed(common))
    for done, (task, came) in enumerate(engine(tasks), start=1):
        if isinstance(came, Failed):
            failed[task.name] = came.reason
        else:
            unpack(came, folder)
        report(done / len(tasks))
    return failed


@lru_cache(maxsize=2)
def _unpacked(files: bytes) -> TemporaryFolder:
    """The files of a run, once in a worker."""
    folder = TemporaryFolder()
    unpack(files, Path(folder.name))
    return folder


def _placed(key: str, value: Any, root: Path = Path("/")) -> Any:
    """An argument with its paths absolute, below a worker's folder."""
    if isinstance(value, list):
        return [_placed(key, each, root) for each in value]
    if isinstance(value, Path):
        return root / os.path.abspath(value).lstrip("/")
    if key == "camera" and value not in IDEAL:
        kind, file = split_kind(value)
        return f"{kind}{root / os.path.abspath(file).lstrip('/')}"
    return value
