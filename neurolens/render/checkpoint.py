"""Checkpoint of a render (see `base.kept`): the film's sums, and the identity of the render.

The identity is everything that the picture depends on, as JSON that two renders can compare.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens import __version__
from neurolens.base.errors import InputError
from neurolens.base.files import fingerprint_of
from neurolens.base.kept import read_arrays, write_arrays
from neurolens.cameras.contract import Camera
from neurolens.render.film import RGB, Film, Tiling
from neurolens.render.job import Job
from neurolens.render.mesh import tracer
from neurolens.render.settings import FilmSettings

# Settings of a camera that do not affect its rays: where it was read and notes.
_NO_MATTER = ("model", "notes")
_NOTHING = "(nothing)"  # a place that one of two identities lacks
_PROBES, _DIGITS = 1024, 16
_FORMAT = 3
SPENT = ("seconds", "camera_thread_seconds", "thread_seconds")
_BRIGHTEST = 1e37  # sum of a pixel, which float32 shall hold after the white balance, too
_LONGEST = 80  # characters of a value in a message
_AGAIN = "or --restart to begin again"


def identity(job: Job) -> dict[str, Any]:
    """Everything that the sums of a film depend on, except the number of samples.

    The scene is its tables, textures and meshes; the camera its settings and its results for some rays. The mesh
    tracer is included, so that one picture does not mix two roundings.
    """
    scene, camera = job.scene, job.camera
    # Given separately, may differ from the scene's.
    common = replace(scene.settings.camera, width=1, height=1, samples=1, max_depth=1, focus_m=1.0, f_number=None)
    bare = replace(scene, name="", settings=replace(scene.settings, camera=common, film=FilmSettings()))
    kept = {key: value for key, value in camera.settings.items() if key not in _NO_MATTER}
    identity = {
        "neurolens": __version__,
        "scene": digest(bare),
        "camera": {"name": camera.name, **kept, "rays": _rays(camera)},
        "film_mm": list(job.grid.film_mm),
        **job.asked(),
    }
    if scene.triangles:
        identity["meshes traced by"] = tracer()
    return json.loads(json.dumps(identity, default=str))


def _leaves(tree: Any, place: str = "") -> dict[str, Any]:
    if not isinstance(tree, dict) or not tree:
        return {place: tree}
    found: dict[str, Any] = {}
    for key, value in tree.items():
        found |= _leaves(value, f"{place}.{key}" if place else str(key))
    return found


def difference(there: dict[str, Any], here: dict[str, Any]) -> tuple[str, Any, str] | None:
    """The first place where two identities differ and what each has there, short for a message; None: nowhere."""
    found, wanted = _leaves(there), _leaves(here)
    for place in [*wanted, *found]:
        values = found.get(place, _NOTHING), wanted.get(place, _NOTHING)
        if json.dumps(values[0]) != json.dumps(values[1]):  # as text: NaN equals NaN
            shown = values[0] if len(repr(values[0])) <= _LONGEST else f"({_short(values[0])})"
            return place, shown, _short(values[1])
    return None


def digest(value: Any) -> str:
    """Hexadecimal digest of a value made of dataclasses, mappings, sequences, arrays and plain values."""
    return fingerprint_of([_plain(value)])[:_DIGITS]


def _plain(value: Any) -> Any:
    """The value for JSON, every part with its type, so that different values never give the same text."""
    if isinstance(value, np.ndarray):
        return [value.dtype.str, value.shape, hashlib.sha256(np.ascontiguousarray(value).data).hexdigest()]
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (tuple, list)):
        return [_plain(item) for item in value]
    if is_dataclass(value):
        return [type(value).__name__, {field.name: _plain(getattr(value, field.name)) for field in fields(value)}]
    return f"{type(value).__name__} {value!r}"


def _rays(camera: Camera) -> str:
    """Digest of the rays of a fixed set of samples, which tells cameras apart."""
    random = np.random.default_rng(0)
    film = ((random.random((2, _PROBES)) - 0.5) * np.array(camera.film_mm)[:, None]).astype(np.float32)
    low, high = camera.wavelength_nm or (400.0, 700.0)
    nm = np.linspace(low, high, _PROBES).astype(np.float32)
    rays = camera.sample(film, random.random((2, _PROBES), np.float32), nm)
    passed = rays.status == 0
    return digest([rays.status, *(np.where(passed, p, 0) for p in (rays.origin_m, rays.direction, rays.weight))])


def write_checkpoint(path: Path, film: Film, identity: dict[str, Any], spent: dict[str, float]) -> None:
    """Write the film's present sums and the seconds spent, by the names of `SPENT`; workers may continue meanwhile.

    Raises:
        OSError: it cannot be written; an older checkpoint is still there.
        InputError: an identity that no reader would take.
        NeurolensError: a worker was killed while it wrote to the film.
    """
    tiling, done = film.tiling, list[NDArray[np.int64]]()

    def sums() -> Iterator[NDArray[np.float64]]:
        for first, stop in tiling.chunks():
            part, passes = film.copy(first, stop)
            done.append(passes)
            yield part

    about = {"format": _FORMAT, "samples": tiling.samples, "tile": tiling.tile, "step": tiling.step}
    arrays = {"sums": (film.sums, sums()), "done": (film.done, done)}  # in this order: the passes of the same moment
    write_arrays(path, about | {"render": identity, "spent": spent}, arrays)


def read_checkpoint(path: Path, film: Film, identity: dict[str, Any]) -> dict[str, float]:
    """Resume from a checkpoint: fill an empty film and return the seconds spent.

    More samples than the checkpoint was made for can be added as long as no tile had a shortened last pass: any
    multiple of 16 samples can be raised to any number.

    Raises:
        InputError: missing, incomplete, or of another render; it names what differs.
    """
    try:
        with read_arrays(path, ("sums", "done")) as (about, read):
            if about["format"] != _FORMAT:
                raise InputError(path, "format", about["format"], f"{_FORMAT}, {_AGAIN}")
            if differs := difference(about["render"], identity):
                place, there, here = differs
                raise InputError(path, place, there, f"{here} as asked now, {_AGAIN}")
            _check_tiling(path, about, film.tiling)
            done = read("done", np.empty_like(film.done))
            _check_samples(path, about["samples"], film.tiling, done)
            sums = read("sums", film.sums)
            # No render has others: samples that are not finite are dropped, and emission is bounded.
            for columns, most in (
                (sums[:, RGB], _BRIGHTEST),
                (sums, _BRIGHTEST**2),
            ):  # squares of luminance are largest
                if not (columns.min() >= -most and columns.max() <= most):
                    raise ValueError("impossible sums")
            film.done[:] = done
            return {name: float(value) for name, value in about["spent"].items()}
    except InputError as error:
        if "--restart" in error.expected:
            raise
        raise InputError(path, error.field, error.value, f"{error.expected}, {_AGAIN}") from None
    except FileNotFoundError:
        raise InputError(path, "file", "(missing)", "a checkpoint of this render") from None
    except ValueError as error:
        raise InputError(path, "file", f"({error})", f"a whole checkpoint of a render, {_AGAIN}") from None


def _short(value: Any) -> str:
    text = "nothing" if value == _NOTHING else repr(value)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


def _check_tiling(path: Path, about: dict[str, Any], tiling: Tiling) -> None:
    """Tiles and passes must be the same; only below 16 samples they depend on the number of samples."""
    if not isinstance(about["samples"], int) or not 1 <= about["samples"] < 1 << 31:
        raise ValueError(f"{about['samples']} samples")
    spent = about["spent"]
    if set(spent) != set(SPENT) or not all(0 <= float(value) < math.inf for value in spent.values()):
        raise ValueError("impossible times")
    if (about["tile"], about["step"]) != (tiling.tile, tiling.step):
        expected = f"{tiling.samples} as asked now: below {max(tiling.step, about['step'])} samples none can be added"
        raise InputError(path, "samples", about["samples"], f"{expected}; give the same, {_AGAIN}")


def _check_samples(path: Path, samples: int, tiling: Tiling, done: NDArray[np.int64]) -> None:
    """The passes of every tile must be a part of the requested ones."""
    if done.min() < 0 or done.max() > -(-samples // tiling.step):
        raise ValueError("impossible numbers of passes")
    had, counts = np.minimum(done * tiling.step, samples), tiling.samples_done(done)
    if np.array_equal(had, counts):
        return
    most = int(had.max())
    if most > tiling.samples:
        raise InputError(path, "samples", most, f"{tiling.samples} at most, as asked now: ask for more, {_AGAIN}")
    expected = f"a multiple of {tiling.step}, which alone can be raised to {tiling.samples}; give the same, {_AGAIN}"
    raise InputError(path, "samples", samples, expected)
