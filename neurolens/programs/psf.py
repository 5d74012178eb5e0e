"""Point spread of a lens over its film, at several f-numbers and distances: made by any executor, kept, and in a file.

A file holds the arrays

    psf          [N, D, rows, columns, C, side, side] float32: share of the light of each channel C in each pixel
    place_mm     [rows, columns, 2] places in the picture from its middle: right and up
    centre_mm    [N, D, rows, columns, 2] where the middle pixel of each lies: the mean of its rays
    inside       [N, D, rows, columns, C] share of the light that lies in the pixels
    light        [N, D, rows, columns] relative illumination, without losses in glass
    by_rays      [N, D, rows, columns] whether rays were counted (`optics.analysis.diffraction`)
    differs      [N, D, rows, columns] share of the light that rays place in other pixels than diffraction
    f_number     [N], distance_m [D] from the film

for N f-numbers and D distances, and in about.json what they are of. Rows and columns are those of the picture, which is
upright: row 0 is its top.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens import __version__
from neurolens.base.errors import InputError, NeurolensError
from neurolens.base.files import how_to_resume, read_arrays, write_arrays
from neurolens.base.find import read_index
from neurolens.base.progress import Progress
from neurolens.base.report import plain
from neurolens.base.tasks import Failed, run_each
from neurolens.models.model import LensModel
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.setting.focusing import require_film
from neurolens.pictures.defocus.diffraction import Channels, spreads
from neurolens.pictures.render.film import digest

Arrays = dict[str, NDArray[Any]]
_ARRAYS = {  # and their axes: f-numbers N, distances D, rows R, columns K, channels C, the sides S
    "psf": "NDRKCSS", "centre_mm": "NDRK2", "inside": "NDRKC", "light": "NDRK", "by_rays": "NDRK", "differs": "NDRK",
    "place_mm": "RK2", "f_number": "N", "distance_m": "D",
}  # fmt: skip
_NAMES = tuple(_ARRAYS)


@dataclass(frozen=True)
class PsfTask:
    """The point spread of a lens that is set, for objects at one distance from its film.

    Attributes:
        places_mm: (right, up) in the picture, row by row; the axis must come last.
        channels: wavelengths of each channel, of equal weight. side: pixels; None takes what holds the light.
        model: of the lens, with optical path, whose rays are taken; None traces them.

    Raises:
        InputError: the objects are not in front of the lens; as `wavefront.checked_path`.
    """

    lens: Lens
    distance_m: float
    places_mm: tuple[tuple[float, float], ...]
    channels: tuple[tuple[float, ...], ...]
    pixel_mm: float
    side: int | None
    model: LensModel | None = None

    def __post_init__(self) -> None:
        lens, front_m = require_film(self.lens), float(self.lens.film_z_mm or 0) / 1000
        if self.model is not None:
            from neurolens.models.wavefront import checked_path

            checked_path(self.model, lens, [nm for some in self.channels for nm in some])
        if not self.distance_m > front_m:
            raise InputError(lens.path, "distance_m", self.distance_m, f"above {front_m:.4g}, the front of the lens")


def point_spread(task: PsfTask) -> Arrays:
    """Return the arrays of a task as the file holds them, a row for each place off the axis.

    Raises:
        InputError: no light of the axis reaches the film.
    """
    every = spreads(task.lens, task.distance_m, task.places_mm, task.channels, task.pixel_mm, task.side, task.model)
    if not (axis := every[-1].pupil.sum()) > 0:
        raise InputError(task.lens.path, "distance_m", task.distance_m, "one whose light reaches the film")
    whole = {
        "psf": np.array([s.light for s in every], np.float32), "centre_mm": np.array([s.centre_mm for s in every]),
        "inside": np.array([s.inside for s in every]),
        "light": np.array([s.pupil.sum() / axis for s in every]),
        "by_rays": np.array([s.by_rays for s in every]), "differs": np.array([s.differs for s in every]),
    }  # fmt: skip
    return {name: array[:-1] for name, array in whole.items()}


def library_of(
    lenses: Mapping[float, Lens], distances_m: Sequence[float], task: PsfTask, grid: tuple[int, int],
    executor: Executor, folder: Path, progress: Progress,
) -> Arrays:  # fmt: skip
    """Return the arrays of a file for lenses that are set, by f-number. Parts that are done are kept in a folder.

    Raises:
        NeurolensError: a part has failed; the others are kept. Lost: the executor has failed.
    """
    tasks = [replace(task, lens=lens, distance_m=d) for lens in lenses.values() for d in distances_m]
    parts = {id(each): folder / f"{digest([__version__, each])}.npz" for each in tasks}
    found = dict[Path, Arrays]()
    # Damaged parts are made again. Another run into the same file removes all when it ends.
    for part in parts.values():
        with suppress(FileNotFoundError, ValueError), read_arrays(part) as (_, read):
            found[part] = {name: read(name) for name in _NAMES[:6]}
    said = f"{len(tasks)} state{'s' * (len(tasks) != 1)}"
    with progress.stage(f"point spread at {len(task.places_mm) - 1} places, {said}") as report:
        for each, answer in run_each(executor, point_spread, [t for t in tasks if parts[id(t)] not in found]):
            if isinstance(answer, Failed):
                raise NeurolensError(f"point spread at {each.distance_m:g} m: {answer.reason}; {how_to_resume(folder)}")
            folder.mkdir(exist_ok=True)
            write_arrays(parts[id(each)], {}, answer)
            found[parts[id(each)]] = answer
            report(len(found) / len(tasks))
    side = max(made["psf"].shape[-1] for made in found.values())
    for made in found.values():
        room = (side - made["psf"].shape[-1]) // 2
        made["psf"] = np.pad(made["psf"], [(0, 0), (0, 0), (room, room), (room, room)])
    states, (columns, rows) = (len(lenses), len(distances_m)), grid
    arrays = {name: np.array([found[part][name] for part in parts.values()]) for name in _NAMES[:6]}
    return {
        **{name: a.reshape(*states, rows, columns, *a.shape[2:]) for name, a in arrays.items()},
        "place_mm": np.array(task.places_mm[:-1]).reshape(rows, columns, 2),
        "f_number": np.array([*lenses]),
        "distance_m": np.array(distances_m),
    }


def read_psf(path: Path) -> tuple[dict[str, Any], Arrays]:
    """Read a file of point spread: its `about.json`, and its arrays; `psf` stays in the file and is mapped.

    Raises:
        InputError: it is missing or no such file, or `psf` is not finite.
    """
    try:
        with read_arrays(path, _NAMES) as (about, read):
            arrays, about = {name: read(name, mapped=name == "psf") for name in _NAMES}, dict(about)
        sizes = (zip(axes, arrays[name].shape, strict=True) for name, axes in _ARRAYS.items())
        if (
            len(known := {("2", 2), *(one for some in sizes for one in some)}) > len(dict(known))
            or not {"film_mm", "pixel_um"} <= about.keys()
        ):
            raise ValueError("shapes that do not fit each other, or about.json without film_mm and pixel_um")
        return about, arrays
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(path, "file", f"({reason})", "a file of neurolens psf (.npz)") from None


def channels_of_exr(arrays: Arrays, names: Sequence[str]) -> Arrays:
    """Return an atlas [rows side, columns side] of each state and channel, as channels of an EXR."""
    psf, planes = arrays["psf"], Arrays()
    rows, columns, _, side, _ = psf.shape[2:]
    for n, f_number in enumerate(arrays["f_number"]):
        for d, distance in enumerate(arrays["distance_m"]):
            for c, name in enumerate(names):
                layer = f"f{f_number:g}_{distance:g}m".replace(".", "p")
                images = psf[n, d, :, :, c].transpose(0, 2, 1, 3)
                planes[f"{layer}.{name}"] = images.reshape(rows * side, columns * side)
    return planes


def about(lens: Lens, settings: Mapping[str, Any], channels: Channels) -> dict[str, Any]:
    """Return what about.json says: units, channels, the lens and how photographs of the product agree with it."""
    row = read_index().get(f"{lens.lens_id}.toml", {}).get("row", {})
    return dict(plain({
        "neurolens": __version__, "lens": lens.lens_id, "name": lens.name,
        "photographs": {key: row.get(key) for key in ("match", "verdict")},
        "units": "lengths in mm, distances in m; psf: shares of a channel's light by pixel; rows from the top, upright",
        "channels": channels, **settings,
    }))  # fmt: skip
