"""Tasks that read and write files, run where these files are not: they travel to the task, and its files come back.

A task is a dataclass. Its paths lie below a folder of the worker in the shape that they have here, so that scenes find
their pictures. A task has the attribute `out`, the file or folder that it writes; what it writes beside `out` comes
back, too.
"""

from __future__ import annotations

import io
import os
import warnings
import zipfile
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from contextlib import redirect_stdout
from dataclasses import fields, is_dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from neurolens.base.errors import NeurolensError
from neurolens.base.files import TemporaryFolder, atomic_path, place_inside
from neurolens.base.tasks import Failed, Shared, run_each

T = TypeVar("T")
_TEXTS = (".json", ".toml", ".html", ".md", ".csv")
_THEN = (1980, 1, 1, 0, 0, 0)  # the same files are the same bytes


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
    written = []
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        for name in archive.namelist():
            try:
                path = place_inside(folder, name)
            except ValueError as error:
                raise NeurolensError(f"an answer with a file outside its folder: {error}") from None
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(path) as temporary:
                temporary.write_bytes(archive.read(name))
            written.append(path)
    return written


def with_paths(value: T, move: Callable[[Path], Path]) -> T:
    """A value of dataclasses and tuples with every path in it moved."""
    if isinstance(value, Path):
        return move(value)  # type: ignore[return-value]
    if isinstance(value, tuple):
        parts = [with_paths(each, move) for each in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)  # type: ignore[return-value]
    if is_dataclass(value) and not isinstance(value, type):
        changes = {field.name: with_paths(getattr(value, field.name), move) for field in fields(value)}
        return replace(value, **changes)
    return value


def absolute(task: T) -> T:
    """A task as it travels: with absolute paths."""
    return with_paths(task, lambda path: Path(os.path.abspath(path)))


def run_with_files(work: Callable[[Any], object], files: Shared, task: Any) -> bytes:
    """Run `work(task)` beside files that were packed by their absolute paths; the files that it wrote, packed.

    Progress and warnings go nowhere. Paths in text files, and in the message of a NeurolensError, are those of the
    machine that asked.
    """
    root = Path(_unpacked(files.data).name)
    task = with_paths(task, lambda path: root / str(path).lstrip("/"))
    folder = task.out.parent  # relative paths from there to the inputs are those of the machine that asked
    folder.mkdir(parents=True, exist_ok=True)
    before = set(folder.rglob("*"))
    try:
        with warnings.catch_warnings(), redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            work(task)
        made = [path for path in sorted(folder.rglob("*")) if path.is_file() and path not in before]
        for path in made:
            if path.suffix in _TEXTS:
                path.write_bytes(path.read_bytes().replace(f"{root}/".encode(), b"/"))
        return packed({str(path.relative_to(folder)): path for path in made})
    except NeurolensError as error:
        raise NeurolensError(str(error).replace(str(root), "")) from None
    finally:
        for path in sorted(set(folder.rglob("*")) - before, reverse=True):
            path.rmdir() if path.is_dir() else path.unlink()


@lru_cache(maxsize=2)
def _unpacked(files: bytes) -> TemporaryFolder:
    """The files of a run, unpacked once in a worker."""
    folder = TemporaryFolder()
    unpack(files, Path(folder.name))
    return folder


def run_remotely(
    executor: Executor, work: Callable[[Any], object], tasks: Mapping[str, Any], common: Iterable[Path], folder: Path,
    report: Callable[[float], object],
) -> dict[str, str]:  # fmt: skip
    """Run `work` for tasks by name, and write what they made below a folder; the reasons of those that failed.

    Args:
        tasks: each writes another `out`. common: files that they read. report: called with the fraction that is done.
    """
    failed: dict[str, str] = {}
    travelling = {name: absolute(task) for name, task in tasks.items()}
    names = {task.out: name for name, task in travelling.items()}
    done = run_each(executor, run_with_files, travelling.values(), work, Shared(packed(common)))
    for count, (task, answer) in enumerate(done, start=1):
        if isinstance(answer, Failed):
            failed[names[task.out]] = answer.reason
        else:
            unpack(answer, folder)
        report(count / len(tasks))
    return failed
