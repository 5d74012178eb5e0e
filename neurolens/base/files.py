"""Files that are either whole or not there: write to a temporary name, then rename."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; rename it to `path` on success, remove it on any failure.

    The temporary name keeps the suffix, because writers such as OpenEXR and Pillow choose the format by it.

    Raises:
        OSError: it cannot be written; the error names `path`, for nobody knows the temporary name.
    """
    target = Path(path)
    temporary = _temporary(target)
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        # A full disk names no file, others name the temporary one.
        if error.errno is None or error.filename not in (None, str(temporary), temporary):
            raise
        raise OSError(error.errno, error.strerror, str(target)) from None
    finally:
        with suppress(OSError):  # a folder that cannot be written holds nothing to remove
            temporary.unlink()


def check_writable(path: str | Path) -> None:
    """Find out before the work whether `atomic_path` could write here, by making an empty file for a moment.

    Raises:
        OSError: it could not; the error names `path`.
    """
    target = Path(path)
    if target.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(target))
    # Only trying tells: for a superuser every folder looks writable.
    temporary = _temporary(target)
    try:
        temporary.touch()
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(target)) from None
    temporary.unlink()


def _temporary(target: Path) -> Path:
    return target.with_name(f".{target.stem}.{os.getpid()}.tmp{target.suffix}")


def atomic_write_text(path: str | Path, text: str) -> None:
    """Write `text` (UTF-8) to `path` so that a reader never sees half of it."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
