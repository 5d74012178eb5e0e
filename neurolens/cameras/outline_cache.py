"""Outlines of exact lenses kept between runs: their search takes seconds.

A file holds the arrays of one outline and is named by what the search reads: the prescription in its state, the
settings, the code, and what torch computes with. Of two runs that write at once either one's file stays; both are
right. Damaged files, and those of another user, are made again.
"""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neurolens.base.files import atomic_path, cache_folder, fingerprint_of, keep_newest, seal, sealed_bytes, sha256_of
from neurolens.cameras.pupil_outline import PupilOutline, wavelength_between
from neurolens.lens.glass import index_of
from neurolens.lens.prescription import Lens

_KEPT = 256  # files of 5 to 40 kB
_LARGEST = 1 << 20  # bytes
_DAMAGED = (OSError, ValueError, KeyError, EOFError, struct.error, zipfile.BadZipFile, zlib.error)


def search_key(lens: Lens, wavelength_nm: tuple[float, float], shares: tuple[float, ...], *settings: Any) -> str:
    """A name for all that the search for an outline reads.

    Args:
        lens: focused. wavelength_nm, shares: the range, and the shares of it at which rays are traced.
        settings: whatever else rules the search, as JSON takes it.
    """
    waves = {lens.reference_nm, *wavelength_nm, *(wavelength_between(wavelength_nm, share) for share in shares)}
    rows: list[Any] = [[float(index_of(lens.object_medium, w)) for w in sorted(waves)]]
    for s in lens.surfaces:
        numbers = (s.radius_mm, s.thickness_mm, s.diameter_mm, s.conic, *(index_of(s, w) for w in sorted(waves)))
        more = s.across, s.focal_mm, [(p, float(a)) for p, a in s.asphere]
        rows.append([[float(v) for v in numbers], s.stop, s.cylinder, *more])
    return fingerprint_of([_code(), rows, float(lens.film_z_mm or 0), sorted(waves), *settings])


@cache
def _code() -> list[str]:
    """Hash the modules that trace and search, and torch's arithmetic on this machine."""
    package = Path(__file__).parents[1]
    found = (package.glob(pattern) for pattern in ("lens/*.py", "trace/*.py", "setting/*.py", "cameras/pupil_*.py"))
    files = [f"{file.name} {sha256_of(file)}" for folder in found for file in sorted(folder)]
    return [*files, torch.__version__, torch.backends.cpu.get_cpu_capability()]


def kept_outline(key: str, search: Callable[[], PupilOutline | None]) -> PupilOutline | None:
    """The outline of a key: from the cache, else what `search` finds, which is kept if a file can be written."""
    file = cache_folder() / f"{key[:32]}.npz"
    outline = _read(file, key)
    if outline is not None:
        return outline
    outline = search()
    if outline is not None:
        with suppress(OSError), atomic_path(file) as temporary:
            with temporary.open("wb") as stream:
                arrays: dict[str, Any] = {"key": key} | asdict(outline)
                np.savez(stream, **arrays)
            seal(temporary)
        keep_newest(file, _KEPT)
    return outline


def _read(file: Path, key: str) -> PupilOutline | None:
    data = sealed_bytes(file)
    if data is None or len(data) > _LARGEST:
        return None
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as held:
            found = {name: held[name] for name in held.files}
        if str(found.pop("key")) != key:
            return None
        z, radius, waves = (np.atleast_1d(found.pop(n)) for n in ("pupil_z_mm", "film_radius_mm", "wavelength_nm"))
        centre, x, y = (found.pop(name) for name in ("centre", "x", "y"))
        shape = (len(waves), len(centre), x.shape[-1])
        sizes = len(waves) in (1, 2) and min(shape[1:]) > 1 and x.shape == y.shape == shape and not found
        kinds = {centre.dtype, x.dtype, y.dtype} == {np.dtype(np.float32)} and {z.size, radius.size} == {1}
        if not (sizes and kinds and all(np.isfinite(a).all() for a in (z, radius, waves, centre, x, y))):
            return None
        return PupilOutline(z.item(), radius.item(), tuple(waves.tolist()), centre, x, y)
    except _DAMAGED:
        return None
