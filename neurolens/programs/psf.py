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
_NAMES = ("psf", "centre_mm", "inside", "light", "by_rays", "differs", "place_mm", "f_number", "distance_m")


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
    parts = [folder / f"{digest([__version__, each])}.npz" for each in tasks]
    named = dict(zip(map(id, tasks), parts, strict=True))
    missing = [each for each in tasks if not named[id(each)].is_file()]
    folder.mkdir(exist_ok=True)
    with progress.stage(f"point spread at {len(task.places_mm) - 1} places, {len(tasks)} states") as report:
        for done, (each, answer) in enumerate(run_each(executor, point_spread, missing), 1):
            if isinstance(answer, Failed):
                raise NeurolensError(f"point spread at {each.distance_m:g} m: {answer.reason}; {how_to_resume(folder)}")
            write_arrays(named[id(each)], {}, answer)
            report((len(tasks) - len(missing) + done) / len(tasks))
    found = []
    for part in parts:
        with read_arrays(part) as (_, read):
            found.append({name: read(name) for name in _NAMES[:6]})
    side = max(made["psf"].shape[-1] for made in found)
    for made in found:
        room = (side - made["psf"].shape[-1]) // 2
        made["psf"] = np.pad(made["psf"], [(0, 0), (0, 0), (room, room), (room, room)])
    states, (columns, rows) = (len(lenses), len(distances_m)), grid
    arrays = {name: np.array([made[name] for made in found]) for name in found[0]}
    return {
        **{name: a.reshape(*states, rows, columns, *a.shape[2:]) for name, a in arrays.items()},
        "place_mm": np.array(task.places_mm[:-1]).reshape(rows, columns, 2),
        "f_number": np.array([*lenses]),
        "distance_m": np.array(distances_m),
    }


def read_psf(path: Path) -> tuple[dict[str, Any], Arrays]:
    """Read a file of point spread: its `about.json`, and its arrays.

    Raises:
        InputError: it is no such file.
    """
    try:
        with read_arrays(path, _NAMES) as (about, read):
            return dict(about), {name: read(name) for name in _NAMES}
    except ValueError as error:
        raise InputError(path, "file", f"({error})", "a file of neurolens psf (.npz)") from None


def channels_of_exr(arrays: Arrays, names: Sequence[str]) -> Arrays:
    """Return an atlas [rows side, columns side] of each state and channel, as channels of an EXR."""
    psf, planes = arrays["psf"], Arrays()
    rows, columns, _, side, _ = psf.shape[2:]
    for n, f_number in enumerate(arrays["f_number"]):
        for d, distance in enumerate(arrays["distance_m"]):
            for c, name in enumerate(names):
                layer = f"f{f_number:g}_{distance:g}m".replace(".", "p")
                atlas = psf[n, d, :, :, c].transpose(0, 2, 1, 3).reshape(rows * side, columns * side)
                planes[f"{layer}.{name}"] = atlas
    return planes


def about(lens: Lens, settings: Mapping[str, Any], channels: Channels) -> dict[str, Any]:
    """Return what about.json says: units, channels, the lens and how photographs of the product agree with it."""
    row = read_index().get(f"{lens.lens_id}.toml", {}).get("row", {})
    checked = {key: row.get(key) for key in ("match", "verdict")}
    units = "lengths in mm, distances in m; psf: shares of a channel's light by pixel; rows from the top, upright"
    return dict(plain({
        "neurolens": __version__, "lens": lens.lens_id, "name": lens.name, "photographs": checked, "units": units,
        "channels": channels, **settings,
    }))  # fmt: skip
