"""Forms of lenses for Blender kept between runs: an interrupted `neurolens blender build` goes on where it was.

A file holds one form, or a lens's field, and is named by what it is made of: the model or lens file, the zoom's state,
and the code. Damaged files, and those of another user, are made again.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

import neurolens
from neurolens.base.files import atomic_path, cache_folder, fingerprint_of, keep_newest, seal, sealed_bytes, sha256_of
from neurolens.blender.pack import Form

_KEPT = 512  # files of some 100 kB


def kept_form(file: Path, *given: str | None, make: Callable[[], Form]) -> Form:
    """The form of a file, and of what else is given: from the cache, else what `make` gives, kept if it can be."""
    return Form(**kept(file, *given, make=lambda: asdict(make())))


def kept(file: Path, *given: str | None, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """As `kept_form`, of any table that JSON holds."""
    key = fingerprint_of([_code(), file.name, sha256_of(file), *given])
    place = cache_folder() / f"{key[:32]}.form"
    data = sealed_bytes(place)
    if data is not None:
        with suppress(ValueError, TypeError, KeyError):
            held: dict[str, Any] = json.loads(data)
            if held.pop("key") == key:
                return held
    made = make()
    with suppress(OSError), atomic_path(place) as temporary:
        temporary.write_text(json.dumps({"key": key} | made), encoding="utf-8")
        seal(temporary)
    keep_newest(place, _KEPT)
    return made


@cache
def _code() -> list[str]:
    """Of all files of the package, and of what changes shaders beside them."""
    root = Path(neurolens.__file__).parent
    files = [f for f in sorted(root.rglob("*")) if f.is_file() and f.suffix != ".pyc"]
    return [*(f"{f.relative_to(root)} {sha256_of(f)}" for f in files), np.__version__, str(find_spec("torch") is None)]
