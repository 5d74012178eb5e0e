"""Files written whole or not at all, and read only where they are regular and not too large; caches and saved work.

Saved arrays are an uncompressed zip (an .npz) of numpy arrays and of `about.json`, which says what they belong to. Each
array must have the size and the header that its reader expects before a byte reaches memory, and zip's checksums find
damaged data. Whether `about.json` describes the same work is for the reader to check.
"""

from __future__ import annotations

import csv
import errno
import hashlib
import io
import json
import os
import re
import secrets
import shutil
import site
import stat
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import cache
from io import BufferedReader
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens.base.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

try:
    import fcntl
except ModuleNotFoundError:  # Windows
    fcntl = None  # type: ignore[assignment]

_LARGEST_LIST, _CHECKSUM = 1 << 24, "checksum"
_LEFT_OVER = re.compile(r"\.neurolens-[0-9a-f]{16}\.tmp(\.\w{1,16})?")  # a temporary file of ours
_ABANDONED_S = 24 * 3600.0  # no write takes so long
_cleaned = set[Path]()  # each once a process, for a folder may hold thousands of files
_FOLDER, _LOCK = "neurolens-", ".neurolens-lock"  # names of temporary folders, and of the lock in each
_DIGEST = 32  # bytes of SHA-256
# O_NONBLOCK: the opening of a FIFO does not wait for its writer. A system that lacks a flag does not need it.
_READ = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)

CHUNK_BYTES = 16 << 20  # of a saved array, copied at a time
_ABOUT, _LARGEST_ABOUT = "about.json", 8 << 20
# RuntimeError: deep JSON; ArithmeticError: an integer beyond floats.
_UNREADABLE = (zipfile.BadZipFile, KeyError, TypeError, AttributeError, EOFError, RuntimeError, ArithmeticError)
_noted: ContextVar[set[Path] | None] = ContextVar("_noted", default=None)


@contextmanager
def noted_files() -> Iterator[set[Path]]:
    """Collect the absolute paths of files opened for reading inside the block, except those of caches."""
    found: set[Path] = set()
    before = _noted.set(found)
    try:
        yield found
    finally:
        _noted.reset(before)
        cached = cache_folder()
        found -= {path for path in found if path.is_relative_to(cached)}


def library() -> Path:
    """Return the folder that has lenses/, models/ and experiments/scenes/, which ship beside the code.

    In a checkout it is the checkout. An installed package has share/neurolens in the environment, in the user's folder,
    or in pip's --target. Where neither is found, it is the working folder.
    """
    code = Path(__file__).parents[2]
    shares = (Path(sys.prefix), Path(site.getuserbase()), code)
    roots = (code, *(share / "share" / "neurolens" for share in shares))
    return next((root for root in roots if (root / "lenses").is_dir()), Path.cwd())


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield the path of a new empty file beside `path`; rename it to `path` on success, remove it on any failure.

    The name is random, so that processes that share a folder never share it; the content is on the disk before the
    file has its final name. It keeps the suffix, because writers such as OpenEXR and Pillow choose the format by it.
    What killed runs have left in the folder is removed after a day.

    Raises:
        OSError: it cannot be written, is a folder, device or pipe, or nothing was written; the error names `path`, not
            the temporary file.
    """
    target = Path(path)
    temporary = _temporary(target)
    try:
        _remove_abandoned(temporary)
        yield temporary
        with temporary.open("rb+") as file:
            if not os.fstat(file.fileno()).st_size:
                raise OSError(errno.ENODATA, "nothing was written", str(temporary))
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except OSError as error:
        # An error of a full disk names no file, other errors name the temporary one.
        if error.errno is None or error.filename not in (None, str(temporary), temporary):
            raise
        raise OSError(error.errno, error.strerror, str(target)) from None
    finally:
        with suppress(OSError):  # a folder that cannot be written holds nothing to remove
            temporary.unlink()


def check_writable(path: str | Path) -> None:
    """Test whether `atomic_path` can write here, by creating and removing an empty file.

    Raises:
        OSError: it cannot; the error names `path`.
    """
    target = Path(path)
    if target.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(target))
    # Permission bits are not enough: for a superuser every folder looks writable.
    _temporary(target).unlink()


def _temporary(target: Path) -> Path:
    """Return a new empty file in the folder of `target`, which only this call has opened."""
    suffix = target.suffix if re.fullmatch(r"\.\w{1,16}", target.suffix) else ""
    temporary = target.with_name(f".neurolens-{secrets.token_hex(8)}.tmp{suffix}")
    try:
        with suppress(FileNotFoundError):
            mode = os.lstat(target).st_mode  # ValueError where no file can have that name
            if not (stat.S_ISREG(mode) or stat.S_ISLNK(mode)):  # a superuser's rename would replace a device
                raise OSError(errno.EINVAL, "not a regular file", str(target))
        os.close(os.open(temporary, _NEW, 0o666))
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(target)) from None
    except ValueError:
        raise OSError(errno.EINVAL, "no name of a file", repr(str(target))) from None
    return temporary


def _remove_abandoned(new: Path) -> None:
    """Remove temporary files in the folder of `new` that are a day older than it, once for each folder in a process."""
    if new.parent in _cleaned:
        return
    _cleaned.add(new.parent)
    with suppress(OSError):
        now = new.stat().st_mtime
        for entry in os.scandir(new.parent):
            if _LEFT_OVER.fullmatch(entry.name) and now - entry.stat(follow_symlinks=False).st_mtime > _ABANDONED_S:
                with suppress(OSError):  # another run was faster, or it is not ours
                    os.unlink(entry.path)


def open_regular(path: str | Path) -> BufferedReader:
    """Open a regular file for reading; a FIFO or a device is refused, not waited for.

    Raises:
        OSError: missing, not regular, not readable, or a name that no file can have.
    """
    try:
        descriptor = os.open(path, _READ)
    except ValueError:  # a zero byte or half a surrogate pair
        raise OSError(errno.EINVAL, "no name of a file", repr(str(path))) from None
    if stat.S_ISREG(os.fstat(descriptor).st_mode):
        if (noted := _noted.get()) is not None:
            noted.add(Path(os.path.abspath(path)))
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    raise OSError(errno.EINVAL, "not a regular file", str(path))


def read_bytes(
    path: str | Path, most: int, expected: str = "a file", place: tuple[str | Path, str] | None = None
) -> bytes:
    """Read a user's file, which must be regular and have at most `most` bytes.

    Args:
        expected: what the file should be, for messages ("a lens file").
        place: the file and the field that messages name, where another file names this one.

    Raises:
        InputError: missing, not regular, unreadable or larger.
    """
    file, field = place or (path, "file")
    found = f"{str(path)!r}: " if place else ""
    try:
        with open_regular(path) as stream:
            data = stream.read(most + 1)
    except FileNotFoundError:
        raise InputError(file, field, f"({found}missing)", f"{expected} that exists") from None
    except OSError as error:
        raise InputError(file, field, f"({found}{error.strerror})", f"{expected} that can be read") from None
    if len(data) > most:
        raise InputError(file, field, f"({found}more than {most} bytes)", f"{expected} of at most {most} bytes")
    return data


def cache_folder(name: str = "") -> Path:
    """Return `neurolens` in $XDG_CACHE_HOME or ~/.cache, or the folder `name` in it.

    A folder to which others can write is replaced by a temporary one of this process, for they could put code there.
    """
    folder = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "neurolens"
    own = _is_own_folder(folder) and _is_own_folder(folder / name)
    return folder / name if own else Path(folder_of_process().name)


def _is_own_folder(folder: Path) -> bool:
    """Make a folder if it is missing; return whether it is this user's and nobody else can write to it."""
    with suppress(OSError):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.lstat()
        return stat.S_ISDIR(found.st_mode) and _mine(found) and os.access(folder, os.W_OK | os.X_OK)
    return False


class TemporaryFolder(tempfile.TemporaryDirectory[str]):
    """A folder of this process, removed with this object, or by a later process of this user if this one is killed.

    The process holds a lock on a file in it, which the system takes away from a process that is killed.
    """

    def __init__(self) -> None:
        _remove_folders_of_killed()
        super().__init__(prefix=_FOLDER)
        self._lock = open(os.path.join(self.name, _LOCK), "wb")  # noqa: SIM115 (held until the folder goes)
        if fcntl is not None:
            fcntl.flock(self._lock, fcntl.LOCK_EX)

    def cleanup(self) -> None:
        """Remove the folder."""
        self._lock.close()
        super().cleanup()


folder_of_process = cache(TemporaryFolder)


@cache
def _remove_folders_of_killed() -> None:
    """Remove temporary folders of this user's processes that have ended without removing them, once a process."""
    if fcntl is None:
        return
    with suppress(OSError):
        for entry in os.scandir(tempfile.gettempdir()):
            if entry.name.startswith(_FOLDER) and entry.stat(follow_symlinks=False).st_uid == os.getuid():
                # No lock file: another program's, or one that a process is about to lock.
                with suppress(OSError), os.fdopen(os.open(Path(entry.path, _LOCK), _READ), "rb") as lock:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    shutil.rmtree(entry.path, ignore_errors=True)


def _mine(found: os.stat_result) -> bool:
    """True for a file or folder of this user that nobody else can write to, so that nobody else can put code there."""
    return hasattr(os, "getuid") and found.st_uid == os.getuid() and not found.st_mode & 0o022


def seal(temporary: Path, mode: int = 0o600) -> None:
    """Append the SHA-256 of a cache's file to its content, before the file gets its final name (`atomic_path`)."""
    data = temporary.read_bytes()
    with temporary.open("ab") as file:
        file.write(hashlib.sha256(data).digest())
    temporary.chmod(mode)


def sealed_bytes(path: Path) -> bytes | None:
    """Return the content of a cache's file; None where it is missing, damaged, or open to others' writing."""
    try:
        if not _mine(path.lstat()):  # a link is refused, too: everybody could write to it
            return None
        with open_regular(path) as file:
            data = file.read()
    except OSError:
        return None
    content, digest = data[:-_DIGEST], data[-_DIGEST:]
    return content if hashlib.sha256(content).digest() == digest else None


def keep_newest(new: Path, most: int) -> None:
    """Keep `new` and the files written nearest before it, and remove the other files of its suffix from a cache.

    Files dated in the future, which a clock that went back leaves, count as the oldest.
    """
    with suppress(OSError):
        now = new.stat().st_mtime
        others = [(abs(now - file.stat().st_mtime), file) for file in new.parent.glob(f"*{new.suffix}") if file != new]
        for _, file in sorted(others)[most - 1 :]:
            file.unlink()


def how_to_resume(folder: Path) -> str:
    """Say in a sentence how to resume work whose finished parts are in a folder."""
    return f"what is done is kept in {folder}: the same command goes on"


def forget_parts(folder: Path, pattern: str) -> None:
    """Remove the parts of finished work, which the pattern names, and their folder if it holds nothing else."""
    with suppress(OSError):
        for part in folder.glob(pattern):
            part.unlink()
        folder.rmdir()


def safe_name(text: str) -> str:
    """Return a name of a file, or of an archive's entry, for `text`, wherever that comes from.

    It has letters, digits and "._+-" of ASCII, no dot at its beginning, and at most 100 characters. A text that has to
    change for this gets digits of its SHA-256 as well, so that the names of two texts differ.
    """
    name = re.sub(r"[^A-Za-z0-9._+-]+", "_", text).lstrip(".")
    if name == text and 0 < len(name) <= 100:
        return name
    return f"{name[:80]}-{hashlib.sha256(text.encode(errors='surrogateescape')).hexdigest()[:16]}"


def place_inside(folder: Path, entry: str) -> Path:
    """Return the path of an archive's entry inside a folder.

    Raises:
        ValueError: the name leads out of the folder, or no file can have it.
    """
    root = folder.resolve()
    if not (path := (root / entry).resolve()).is_relative_to(root) or path == root or "\\" in entry:
        raise ValueError(f"{entry[:80]!r} leads out of its folder")
    return folder / entry


def sha256_of(path: str | Path) -> str:
    """Return the hexadecimal SHA-256 of a file."""
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def fingerprint_of(values: Sequence[Any]) -> str:
    """Return the hexadecimal SHA-256 of values, written as JSON with sorted keys."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def atomic_write_text(path: str | Path, text: str) -> None:
    """Write `text` (UTF-8) to `path` atomically.

    Bytes of file names that are no UTF-8 are written as \\u and digits. TOML could not read these again, so that
    `tomlfile.format_value` refuses such names.
    """
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def write_json(path: str | Path, data: Any) -> None:
    """Write JSON atomically and make its folder. Raises ValueError where a number is not finite."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    atomic_write_text(path, json.dumps(data, indent=1, allow_nan=False) + "\n")


def write_kept(path: Path, data: Mapping[str, Any]) -> None:
    """Write results that a later run may reuse, as JSON with a checksum, atomically."""
    write_json(path, {**data, _CHECKSUM: fingerprint_of([data])})


def read_kept(path: Path) -> dict[str, Any] | None:
    """Return the data that `write_kept` wrote, or None where the file is missing or damaged."""
    try:
        data = json.loads(read_bytes(path, _LARGEST_LIST))
        return data if data.pop(_CHECKSUM) == fingerprint_of([data]) else None
    except (InputError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None


def kept_in_cache(name: str, most: int, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return the data that the cache has under this name; else make them, and keep them where that is possible.

    The cache keeps the newest `most` files of this suffix.
    """
    place = cache_folder() / name
    if (data := read_kept(place)) is None:
        data = make()
        with suppress(OSError, ValueError):  # ValueError: a number is not finite
            write_kept(place, data)
        keep_newest(place, most)
    return data


def read_rows(path: Path, what: str) -> list[Mapping[str, Any]]:
    """Read a small table: CSV with a header, or JSON (.json) with a list of objects. `what` names the rows in messages.

    Raises:
        InputError: the file is missing, too large or no such table. Cells without a column stand under "(one more)".
    """
    data = read_bytes(path, _LARGEST_LIST, what)
    try:
        text = data.decode("utf-8-sig")
        table = csv.DictReader(text.splitlines(), restkey="(one more)")
        rows = json.loads(text) if path.suffix.lower() == ".json" else list(table)
    except (ValueError, RecursionError, csv.Error) as error:
        raise InputError(path, "file", f"({error})", f"{what} as CSV or JSON") from None
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise InputError(path, "file", "(no list of objects)", f"{what}, each an object")
    return rows


def write_arrays(
    path: Path, about: Mapping[str, Any], arrays: Mapping[str, NDArray[Any] | tuple[NDArray[Any], Iterable[Any]]]
) -> None:
    """Write named arrays and `about` to a file.

    An array is given whole, or as a pair: any array of its shape and type, and its parts along the first axis.

    Raises:
        OSError: the file cannot be written; an older one stays. InputError: `about` is longer than readers accept.
    """
    import numpy as np  # imported late, for the help of the command line does without it

    text = json.dumps(about)
    _check_length(path, len(text))
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            whole, parts = array if isinstance(array, tuple) else (array, [array])
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                member.write(_header(whole))
                for part in parts:
                    member.write(np.ascontiguousarray(part).data)
        archive.writestr(_ABOUT, text)


@contextmanager
def read_arrays(path: Path, names: Iterable[str] = ()) -> Iterator[tuple[Any, Callable[..., NDArray[Any]]]]:
    """Open a file of saved arrays: yield its `about`, and a function that reads an array by its name.

    With `into` the function reads only an array of that shape and type; it fills that array and returns it. With
    `mapped` it returns an array as np.memmap, which reads from the file what is used. It has read the array once, part
    by part, for its checksum and to find numbers that are not finite.

    Args:
        names: the arrays that the file must hold; none accepts any.

    Raises:
        OSError: the file cannot be opened. ValueError: it is damaged or incomplete, or the block found a mistake in its
            content. InputError: its `about` is too long.
    """
    try:
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            members = {info.filename: info for info in archive.infolist()}
            stored = all(i.compress_type == zipfile.ZIP_STORED and not i.flag_bits & 1 for i in members.values())
            if not stored or (names and sorted(members) != sorted([_ABOUT, *(f"{name}.npy" for name in names)])):
                raise ValueError("other contents")
            _check_length(path, members[_ABOUT].file_size)
            yield (
                json.loads(archive.read(_ABOUT)),
                lambda name, into=None, mapped=False: _read(
                    archive, members[f"{name}.npy"], into, file if mapped else None
                ),
            )
    except OSError as error:
        if error.filename is not None:
            raise
        # A damaged directory leads to a place before the file's beginning.
        raise ValueError(f"damaged: {error.strerror}") from None
    except _UNREADABLE as error:
        raise ValueError(str(error) or type(error).__name__) from None


class Kept:
    """Keeps the state of long work in a file every few seconds, for a later run of the very same work.

    Args:
        path: the file; None keeps nothing. key: a hash of everything that decides the work. every_s: seconds between
            two saved states.
    """

    def __init__(self, path: Path | None, key: str, every_s: float) -> None:
        self._path, self._key, self._every_s = path, key, every_s
        self._spent_s, self._began = 0.0, time.monotonic()
        self._written = self._began

    def load(self) -> tuple[dict[str, Any], list[NDArray[Any]]] | None:
        """Return the saved state and arrays, or None where the file is missing, damaged or of other work."""
        with suppress(OSError, ValueError):
            if self._path is not None:
                with read_arrays(self._path) as (about, read):
                    if about["key"] == self._key:
                        arrays = [read(f"a{k}") for k in range(about["arrays"])]
                        state, self._spent_s = dict(about["state"]), float(about["spent_s"])
                        return state, arrays
        return None

    def save(self, state: Mapping[str, Any], arrays: Sequence[NDArray[Any]], *, now: bool = False) -> None:
        """Write a state and arrays, if the last write was at least `every_s` ago or `now` asks for it.

        The state is a mapping as JSON holds it.
        """
        if self._path is not None and (now or time.monotonic() - self._written >= self._every_s):
            spent_s = self._spent_s + time.monotonic() - self._began  # by earlier runs, too
            about = {"key": self._key, "state": state, "spent_s": spent_s, "arrays": len(arrays)}
            write_arrays(self._path, about, {f"a{k}": array for k, array in enumerate(arrays)})
            self._written = time.monotonic()


def _check_length(path: Path, length: int) -> None:
    if length > _LARGEST_ABOUT:
        raise InputError(path, "settings", f"({length} characters)", f"at most {_LARGEST_ABOUT}")


def _header(array: NDArray[Any]) -> bytes:
    from numpy.lib import format as numpy_format

    out = io.BytesIO()
    # Written row by row, in whatever order the array lies in memory.
    numpy_format.write_array_header_1_0(out, numpy_format.header_data_from_array_1_0(array) | {"fortran_order": False})
    return out.getvalue()


def _read(
    archive: zipfile.ZipFile, info: zipfile.ZipInfo, into: NDArray[Any] | None, mapped: BufferedReader | None
) -> NDArray[Any]:
    if into is None:
        import numpy as np

        with archive.open(info) as member:
            if mapped is None:
                return np.lib.format.read_array(member, allow_pickle=False)
            # Before a member's content come 30 bytes, whose last four are the lengths of its name and of more fields,
            # and then these.
            start = mapped.seek(info.header_offset + 26) + 4 + sum(np.frombuffer(mapped.read(4), "<u2").tolist())
            np.lib.format.read_magic(member)
            (shape, by_columns, kind), head = np.lib.format.read_array_header_1_0(member), member.tell()
            array = np.memmap(mapped, kind, "r", start + head, shape, "CF"[by_columns])  # type: ignore[call-overload]
            parts = iter(lambda: member.read(CHUNK_BYTES), b"")  # the last compares the checksum
            if (
                not all(np.isfinite(np.frombuffer(part, kind)).all() for part in parts)
                or member.tell() != head + array.nbytes
            ):
                raise ValueError(f"{info.filename} has numbers that are not finite, or not as many as its header says")
            return array
    header = _header(into)
    if info.file_size != len(header) + into.nbytes:
        raise ValueError(f"{info.filename} of {info.file_size} bytes")
    with archive.open(info) as member:
        if member.read(len(header)) != header:
            raise ValueError(f"{info.filename} of another shape or type")
        memory = into.reshape(-1).data.cast("B")
        for start in range(0, len(memory), CHUNK_BYTES):
            part = memory[start : start + CHUNK_BYTES]
            if member.readinto(part) != len(part):  # type: ignore[attr-defined]
                raise EOFError("it ends too early")
        if member.read(1):  # also compares the checksum
            raise ValueError(f"{info.filename} too long")
    return into
