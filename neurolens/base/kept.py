"""Saved work: arrays, and what they are of, in a file from which a later run goes on.

The file is a zip of numpy arrays (an .npz), stored as they are, and of `about.json`. It is written whole or not at all.
Each array must have the size and the header that its reader expects before a byte reaches memory, and zip's checksums
find damaged data. Whether `about.json` is that of the same work is the reader's to check.
"""

from __future__ import annotations

import io
import json
import time
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.base.files import atomic_path, open_regular

CHUNK_BYTES = 16 << 20  # that are copied at a time
_ABOUT, _LARGEST_ABOUT = "about.json", 8 << 20
_UNREADABLE = (zipfile.BadZipFile, KeyError, TypeError, AttributeError, EOFError, RuntimeError)  # the last: deep JSON


class Reader(Protocol):
    """Reads an array by its name; with `into`, only one of that shape and type, which it fills and returns."""

    def __call__(self, name: str, into: NDArray[Any] | None = None) -> NDArray[Any]: ...


def write_arrays(
    path: Path, about: Mapping[str, Any], arrays: Mapping[str, NDArray[Any] | tuple[NDArray[Any], Iterable[Any]]]
) -> None:
    """Write arrays by name, each given as it is, or as one of its shape and type with its parts along the first axis.

    Raises:
        OSError: it cannot be written; an older file is still there. InputError: an `about` that no reader takes.
    """
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
def read_arrays(path: Path, names: Iterable[str] = ()) -> Iterator[tuple[Any, Reader]]:
    """Yield `about`, and what reads the arrays, of a file that has arrays of these names, or of any.

    Raises:
        OSError: it cannot be opened. ValueError: damaged, incomplete, or a mistake that the block meets in its content.
        InputError: an `about` that is too long.
    """
    try:
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            members = {info.filename: info for info in archive.infolist()}
            stored = all(i.compress_type == zipfile.ZIP_STORED and not i.flag_bits & 1 for i in members.values())
            if not stored or (names and sorted(members) != sorted([_ABOUT, *(f"{name}.npy" for name in names)])):
                raise ValueError("other contents")
            _check_length(path, members[_ABOUT].file_size)
            yield json.loads(archive.read(_ABOUT)), lambda name, into=None: _read(archive, members[f"{name}.npy"], into)
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
        path: the file; None keeps nothing. key: hash of everything that decides the work. every_s: seconds between two
            states.
    """

    def __init__(self, path: Path | None, key: str, every_s: float) -> None:
        self._path, self._key, self._every_s = path, key, every_s
        self._spent_s, self._began = 0.0, time.monotonic()
        self._written = self._began

    def load(self) -> tuple[dict[str, Any], list[NDArray[Any]]] | None:
        """State and arrays as saved, or None where there is no file, or a damaged one, or one of other work."""
        with suppress(OSError, ValueError):
            if self._path is not None:
                with read_arrays(self._path) as (about, read):
                    if about["key"] == self._key:
                        arrays = [read(f"a{k}") for k in range(about["arrays"])]
                        state, self._spent_s = dict(about["state"]), float(about["spent_s"])
                        return state, arrays
        return None

    def save(self, state: Mapping[str, Any], arrays: Sequence[NDArray[Any]], *, now: bool = False) -> None:
        """Write a state (JSON-able) and arrays, if the last write is some seconds ago or `now` asks for it."""
        if self._path is not None and (now or time.monotonic() - self._written >= self._every_s):
            spent_s = self._spent_s + time.monotonic() - self._began  # by earlier runs, too
            about = {"key": self._key, "state": state, "spent_s": spent_s, "arrays": len(arrays)}
            write_arrays(self._path, about, {f"a{k}": array for k, array in enumerate(arrays)})
            self._written = time.monotonic()


def _check_length(path: Path, length: int) -> None:
    if length > _LARGEST_ABOUT:
        raise InputError(path, "settings", f"({length} characters)", f"at most {_LARGEST_ABOUT}")


def _header(array: NDArray[Any]) -> bytes:
    out = io.BytesIO()
    np.lib.format.write_array_header_1_0(out, np.lib.format.header_data_from_array_1_0(array))
    return out.getvalue()


def _read(archive: zipfile.ZipFile, info: zipfile.ZipInfo, into: NDArray[Any] | None) -> NDArray[Any]:
    if into is None:
        with archive.open(info) as member:
            return np.lib.format.read_array(member, allow_pickle=False)
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
