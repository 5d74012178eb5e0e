"""Makes a camera of what a command line names; `neurolens.base.lensname` lists the kinds."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from neurolens.base.errors import InputError
from neurolens.base.lensname import IDEAL_OF, is_model, resolve
from neurolens.base.progress import Progress
from neurolens.cameras.contract import Camera
from neurolens.cameras.ideal import PROJECTIONS, Fisheye, Pinhole, ThickLens, ThinLens, check_field
from neurolens.cameras.reduced import ReducedDispersion, Vignetted
from neurolens.cameras.sampling import beyond_circle
from neurolens.graph.compiler import has_compiler
from neurolens.models.card import read_card
from neurolens.optics.lens.paraxial import first_order, framing_mm
from neurolens.optics.lens.shot import BY_LENSES, Shot, film_size, film_within
from neurolens.optics.setting.focusing import near_limit_m
from neurolens.optics.setting.pupils import image_radius_mm
from neurolens.optics.setting.states import focus_of, set_lens

if TYPE_CHECKING:
    from neurolens.optics.lens.prescription import Lens

_FOCAL_MM, _FISHEYE_MM, _THIN_F_NUMBER, _PINHOLE_F_NUMBER = 50.0, 14.0, 4.0, 8.0


def make_camera(spec: str | Path, shot: Shot, progress: Progress | None = None) -> Camera:
    """Make the camera that `spec` names, set for a shot.

    Args:
        spec: as `resolve` takes it. shot: whole, or in part: defaults are those of `Shot`.
        progress: shows what takes long, see `ExactCamera`.

    Raises:
        InputError: an unknown kind of camera, a missing file, or a setting that this kind does not have or cannot
            reach.
        ModelError: a model that cannot be trusted.
    """
    camera, shot = as_c(_camera(str(spec), shot, progress)), shot.whole()
    camera = camera if shot.dispersion == "full" else ReducedDispersion(camera, shot.dispersion, shot.wavelength_nm)
    return camera if shot.vignetting == "both" else Vignetted(camera, shot.vignetting, shot.wavelength_nm)


def film_of(spec: str | Path, **size: Any) -> tuple[tuple[float, float], str]:
    """Return the film that a camera's lens covers, and its name (`film_within`); full frame for one without a lens.

    `size`: what zooms or scales a lens file, as of `Shot`. Raises InputError as `make_camera`.
    """
    kind, path = resolve(spec)
    if path is None:
        return film_size("fullframe"), "fullframe"
    if is_model(path):
        return film_within(float(read_card(path)["domain"]["film_radius_mm"]))
    return film_within(image_radius_mm(set_lens(_read(path), **size))[0])


def near_of(spec: str | Path, **size: Any) -> float:
    """Return the distance (m) from the film to the nearest object that a camera's lens focuses; arguments as `film_of`.

    A model's card states it. For a lens file or an ideal camera a usual distance is taken, 14 focal lengths or more.
    """
    kind, path = resolve(spec)
    if path is None:
        return 14e-3 * float(size.get("focal_length_mm", _FOCAL_MM))
    if is_model(path):
        return min(map(float, read_card(path)["domain"]["focus_m"]))
    return near_limit_m(set_lens(_read(path), **size))


def _read(path: Path) -> Lens:
    from neurolens.optics.readers.any_format import read_any  # models and ideal cameras start without all the readers

    return read_any(path)


def as_c(camera: Camera) -> Camera:
    """Return an ideal lens run as C where the machine has a compiler, and any other camera as it is."""
    with suppress(InputError):
        return camera.compiled() if isinstance(camera, ThickLens) and has_compiler() else camera
    return camera


def _camera(spec: str, shot: Shot, progress: Progress | None) -> Camera:
    kind, path = resolve(spec)
    if path is None:
        return _ideal(kind, shot.whole())
    if kind in IDEAL_OF:
        return _ideal_of(kind, path, shot)
    if is_model(path):
        from neurolens.cameras.model import OnnxCamera, load_model

        return OnnxCamera(load_model(path), shot.whole(), progress=progress)
    return _exact(path, shot, progress)


def _ideal(kind: str, shot: Shot) -> Camera:
    shot.check_taken(kind, (ThinLens if kind == "thin" else Pinhole if kind == "pinhole" else Fisheye).takes)
    if kind == "thin":
        focal, f_number = shot.focal_length_mm or _FOCAL_MM, shot.f_number or _THIN_F_NUMBER
        moved = shot.film_offset_mm
        return ThinLens(focal, f_number, shot.focus_m, shot.film_mm, aperture=shot.aperture, film_offset_mm=moved)
    f_number = shot.f_number or _PINHOLE_F_NUMBER
    if kind == "pinhole":
        return Pinhole(shot.focal_length_mm or _FOCAL_MM, shot.film_mm, f_number)
    projection = kind.removeprefix("fisheye-")
    focal = shot.focal_length_mm or _FISHEYE_MM
    if shot.field_deg is not None:
        edge = float(PROJECTIONS[projection].radius(np.array(check_field(projection, shot.field_deg))))
        focal = min(shot.film_mm) / 2 / edge
    return Fisheye(projection, focal, shot.film_mm, field_deg=shot.field_deg, f_number=f_number)


def _ideal_of(kind: str, path: Path, shot: Shot) -> Camera:
    given, shot = shot, shot.whole()
    shot.check_taken(f"{kind}{path}", {*BY_LENSES, *(ThinLens.takes if kind == "thin:" else ())})
    lens = set_lens(_read(path), replace(shot, focus_m=given.focus_m, aperture=None, film_offset_mm=0.0))
    shot = replace(shot, focus_m=focus_of(lens, given))
    camera = ideal_as(kind, lens, shot)
    of_lens = {name: value for name, value in shot.record(BY_LENSES).items() if name not in camera.settings}
    camera.settings |= of_lens | {"lens": lens.identity, "derived": lens.derived}
    return camera


def ideal_as(kind: str, lens: Lens, shot: Shot) -> Camera:
    """Return an ideal camera (`IDEAL_OF`) with the framing and the entrance pupil of a lens that is set for the shot.

    Chief rays of a film point meet the plane in focus where the lens's do, to first order. Since a film in best focus
    is not in the paraxial image, the ideal lens's focal length may differ from the lens's by a few thousandths. For a
    lens with cylinders, the thin lens and the hole are those of the y-z plane.

    Raises:
        InputError: a thick lens is asked of a lens with cylinders, which has two focal lengths; and what the cameras
            raise.
    """
    if lens.anamorphic and kind == "thick:":
        raise InputError(
            lens.path, "surfaces", "(cylinders)", "a lens that is round about its axis: it has two focal lengths"
        )
    data, film_z, far = first_order(lens), float(lens.film_z_mm or 0.0), 1000 * shot.focus_m
    thin, thick = framing_mm(lens, shot.focus_m)
    if kind == "pinhole:":
        return Pinhole(thin, shot.film_mm, data.f_number)
    front = data.front_principal_z_mm
    if kind == "thin:":
        focal = thin / (1 + thin / (far - thin))
    else:
        focal = thick / (1 + thick / (front - film_z + far))
    f_number, shape = focal / data.entrance_pupil_diameter_mm, shot.aperture or lens.aperture
    if kind == "thin:":
        offset = shot.film_offset_mm
        return ThinLens(focal, f_number, shot.focus_m, shot.film_mm, aperture=shape, film_offset_mm=offset)
    return ThickLens(
        focal,
        f_number,
        shot.focus_m,
        shot.film_mm,
        principal_z_mm=(front, film_z - thick),
        entrance_pupil_z_mm=data.entrance_pupil_z_mm,
        film_at_mm=film_z,
        aperture=shape,
        name=f"{lens.name}, thick",
    )


def _exact(path: Path, shot: Shot, progress: Progress | None) -> Camera:
    from neurolens.cameras.exact import ExactCamera

    tabled = _read(path)
    camera = ExactCamera(tabled, shot, progress=progress)
    camera.settings["notes"] = [
        *_doubts(tabled),
        *_film_notes(set_lens(camera.lens, focus_m=math.inf), shot.film_mm),
    ]
    return camera


def _doubts(lens: Lens) -> list[str]:
    """Return the doubts of a check of the lens against its source; none without torch, which traces its chief rays."""
    if find_spec("torch") is None:
        return []
    from neurolens.optics.setting.check import check_lens, doubts

    return doubts(check_lens(lens))


def _film_notes(lens: Lens, film_mm: tuple[float, float]) -> list[str]:
    """Return a sentence if the film is larger than the picture of the lens, where the picture's size is known."""
    if lens.image_radius_mm is None and (lens.half_field_deg is None or lens.half_field_deg >= 60):
        return []  # only a long search would tell
    return beyond_circle(film_mm, image_radius_mm(lens)[0], "the image circle", "may stay dark")
