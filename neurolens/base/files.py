"""Atomic writing of files (to a temporary name, then renamed), and hashes of files and settings."""

from __future__ import annotations

import errno
import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; rename it to `path` on success, remove it on any failure.

    The temporary name keeps the suffix, because writers such as OpenEXR and Pillow choose the format by it.

    Raises:
        OSError: it cannot be written; the error names `path`, not the temporary file.
    """
    target = Path(path)
    temporary = _temporary(target)
    try:
        yield temporary
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
    temporary = _temporary(target)
    try:
        temporary.touch()
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(target)) from None
    temporary.unlink()


def _temporary(target: Path) -> Path:
    return target.with_name(f".{target.stem}.{os.getpid()}.tmp{target.suffix}")


def sha256_of(path: str | Path) -> str:
    """Hexadecimal SHA-256 of a file."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def fingerprint_of(values: Sequence[Any]) -> str:
    """Hexadecimal SHA-256 of values as JSON with sorted keys."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def atomic_write_text(path: str | Path, text: str) -> None:
    """Write `text` (UTF-8) to `path` atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
