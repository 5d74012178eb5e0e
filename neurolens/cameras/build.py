"""A camera from what a command line names: `neurolens.base.lensname` lists the kinds.

Only a lens file needs torch, which is imported when one is asked for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from neurolens.base.bounds import F_NUMBER, said, within
from neurolens.base.errors import InputError
from neurolens.base.lensname import FISHEYES, FUSED, IDEAL_OF, is_model, resolve
from neurolens.base.progress import Progress
from neurolens.cameras.contract import Camera
from neurolens.cameras.ideal import ThickLens, ThinLens
from neurolens.cameras.pinhole import PROJECTIONS, Fisheye, Pinhole, check_field
from neurolens.cameras.vignetting import Vignetted
from neurolens.lens.apertures import Aperture

if TYPE_CHECKING:
    from neurolens.lens.prescription import Lens

_BEYOND = 1.02  # diagonal of the film over the image circle: 36x24 over 43.2 mm is as lenses are engraved
_EFL_MM, _FISHEYE_EFL_MM, _THIN_F_NUMBER, _PINHOLE_F_NUMBER = 50.0, 14.0, 4.0, 8.0


@dataclass(frozen=True)
class Shot:
    """What a photographer sets.

    Attributes:
        film_mm: width and height of the film.
        focus_m: distance from the film to the object in focus, inf allowed.
        f_number: None: the widest stop of a lens or model; f/4 for the thin lens, nominally f/8 for a point.
        efl_mm: None: a lens file as tabled; 50 mm for thin lens and pinhole, 14 mm for a fisheye projection unless
            `field_deg` rules it. A model has its own.
        zoom: state of a lens file by name, or a focal length in mm between its states; also of a model of a whole zoom.
        field_deg: full field of view that the film's image circle shall see; sets the size of a lens file. Of a fisheye
            projection, what the circle within the film shall see: sets its focal length, and what lies beyond is dark.
        focus: how a lens is focused: "best", "paraxial" or "internal"; see `ExactCamera` and `OnnxCamera`.
        aperture: shape of the stop's opening; None is that of the lens file, else round.
        film_offset_mm: moves the film away from the lens after focusing; not of a pinhole.
        clamp_f_number: an f-number wider than the lens opens becomes its widest; else it is an error of a model, and
            opens the stop of a lens file as far as the rims let light through.
        wavelength_nm: shortest and longest wavelength of the light.
        vignetting: what is left of it, "both", "natural", "optical" or "none"; see `neurolens.cameras.vignetting`.

    Raises:
        InputError: an f-number that no lens has.
    """

    film_mm: tuple[float, float]
    focus_m: float
    f_number: float | None = None
    efl_mm: float | None = None
    zoom: str | float | None = None
    field_deg: float | None = None
    focus: Literal["best", "paraxial", "internal"] = "best"
    aperture: Aperture | None = None
    wavelength_nm: tuple[float, float] = (400.0, 700.0)
    film_offset_mm: float = 0.0
    clamp_f_number: bool = False
    vignetting: str = "both"

    def __post_init__(self) -> None:
        if self.f_number is not None and not within(F_NUMBER, self.f_number):
            raise InputError("camera", "f_number", self.f_number, f"a number {said(F_NUMBER)}")

    def f_number_for(self, widest: float) -> float | None:
        """The f-number of a lens that opens to `widest`; None stands for its widest."""
        too_wide = self.clamp_f_number and self.f_number is not None and self.f_number < widest
        return None if too_wide else self.f_number


def make_camera(spec: str | Path, shot: Shot, progress: Progress | None = None) -> Camera:
    """The camera that `spec` names, set for a shot.

    Args:
        spec: as `resolve` takes it.
        progress: shows what takes long, see `ExactCamera`.

    Raises:
        InputError: an unknown kind of camera, a missing file, a setting that this kind does not have or cannot reach.
        ModelError: a model that cannot be trusted.
        ModuleNotFoundError: a lens file without torch.
    """
    camera = _camera(str(spec), shot, progress)
    return camera if shot.vignetting == "both" else Vignetted(camera, shot.vignetting, shot.wavelength_nm)


def _camera(spec: str, shot: Shot, progress: Progress | None) -> Camera:
    kind, path = resolve(spec)
    if path is None:
        return _ideal(kind, shot)
    if kind in IDEAL_OF:
        return _ideal_of(kind, path, shot)
    if is_model(path):
        return _model(path, shot, kind == FUSED)
    return _exact(path, shot, kind == FUSED, progress)


def _ideal(kind: str, shot: Shot) -> Camera:
    fisheye, point = kind in FISHEYES, kind != "thin"
    _refuse(kind, "zoom", shot.zoom, "left out: only a lens file has zoom states")
    _refuse(kind, "focus", "internal" if shot.focus == "internal" else None, "left out: only lens files have groups")
    _refuse(kind, "field_deg", None if fisheye else shot.field_deg, "left out: set efl_mm")
    if not point:
        focal, f_number = _EFL_MM if shot.efl_mm is None else shot.efl_mm, shot.f_number or _THIN_F_NUMBER
        moved = shot.film_offset_mm
        return ThinLens(focal, f_number, shot.focus_m, shot.film_mm, aperture=shot.aperture, film_offset_mm=moved)
    _refuse(kind, "film_offset_mm", shot.film_offset_mm or None, "left out: set efl_mm")
    _refuse(kind, "aperture", shot.aperture and shot.aperture.settings(), "left out: this camera is a point")
    f_number = shot.f_number or _PINHOLE_F_NUMBER
    if not fisheye:
        return Pinhole(_EFL_MM if shot.efl_mm is None else shot.efl_mm, shot.film_mm, f_number)
    projection = kind.removeprefix("fisheye-")
    focal = _FISHEYE_EFL_MM if shot.efl_mm is None else shot.efl_mm
    if shot.field_deg is not None:
        _refuse(kind, "efl_mm", shot.efl_mm, "left out: the field sets it")
        edge = float(PROJECTIONS[projection].radius(np.array(check_field(projection, shot.field_deg))))
        focal = min(shot.film_mm) / 2 / edge
    return Fisheye(projection, focal, shot.film_mm, field_deg=shot.field_deg, f_number=f_number)


def _ideal_of(kind: str, path: Path, shot: Shot) -> Camera:
    from neurolens.readers.any_format import read_any

    if kind != "thin:":
        _refuse(f"{kind}{path}", "film_offset_mm", shot.film_offset_mm or None, "left out: set focus_m")
    lens = _placed(read_any(path), shot)
    camera = ideal_as(kind, lens, shot)
    camera.settings |= {"lens": lens.identity, "zoom": shot.zoom, "focusing": shot.focus, "derived": lens.derived}
    return camera


def _placed(lens: Lens, shot: Shot) -> Lens:
    """The lens as a shot asks for it."""
    from neurolens.lens.paraxial import first_order
    from neurolens.setting.focusing import best_focused
    from neurolens.setting.states import set_lens

    lens = set_lens(lens, focal_length_mm=shot.efl_mm, field_deg=shot.field_deg, zoom=shot.zoom)
    f_number = shot.f_number_for(first_order(lens).f_number)
    light = shot.wavelength_nm
    lens = set_lens(lens, f_number=f_number, focus_m=shot.focus_m, focus=shot.focus, wavelength_nm=light)
    return best_focused(lens, shot.focus_m, light) if shot.focus == "internal" else lens


def ideal_as(kind: str, lens: Lens, shot: Shot) -> Camera:
    """One of `IDEAL_OF`, framed as a lens that stands ready for the shot, with its entrance pupil.

    Chief rays of a film point meet the plane in focus where the lens's do, to first order. A film in best focus is not
    in the paraxial image: then the ideal lenses' focal lengths differ from the lens's by a few thousandths. Of
    a lens with cylinders, thin lens and hole are those of the y-z plane.

    Raises:
        InputError: a thick lens of one with cylinders, which has two focal lengths; as the cameras.
    """
    from neurolens.lens.paraxial import first_order, framing_mm

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


def _exact(path: Path, shot: Shot, fused: bool, progress: Progress | None) -> Camera:
    from neurolens.cameras.exact import ExactCamera
    from neurolens.lens.paraxial import first_order
    from neurolens.readers.any_format import read_any
    from neurolens.setting.check import check_lens, doubts
    from neurolens.setting.states import set_lens

    tabled = read_any(path)
    lens = set_lens(tabled, focal_length_mm=shot.efl_mm, field_deg=shot.field_deg, zoom=shot.zoom)
    if shot.aperture is not None:
        lens = lens.with_aperture(shot.aperture)
    f_number = shot.f_number_for(first_order(lens).f_number)
    camera = ExactCamera(
        lens,
        film_mm=shot.film_mm,
        focus_m=shot.focus_m,
        f_number=f_number,
        wavelength_nm=shot.wavelength_nm,
        focus=shot.focus,
        film_offset_mm=shot.film_offset_mm,
        progress=progress,
        runtime="c" if fused else "trace",
    )
    camera.settings |= {"zoom": shot.zoom, "notes": [*doubts(check_lens(tabled)), *_film_notes(lens, shot.film_mm)]}
    return camera


def _film_notes(lens: Lens, film_mm: tuple[float, float]) -> list[str]:
    """A sentence on a film that is larger than the picture of the lens, where the size of that is known."""
    from neurolens.setting.pupils import image_radius_mm

    if lens.image_radius_mm is None and (lens.half_field_deg is None or lens.half_field_deg >= 60):
        return []  # only a long search would tell
    return _beyond_circle(film_mm, image_radius_mm(lens)[0], "the image circle", "may stay dark")


def _beyond_circle(film_mm: tuple[float, float], radius_mm: float, what: str, then: str) -> list[str]:
    circle, diagonal = 2 * radius_mm, math.hypot(*film_mm)
    if diagonal <= _BEYOND * circle:
        return []
    told = f"the film's diagonal of {diagonal:.3g} mm is {diagonal / circle:.3g} times {what} of {circle:.3g} mm"
    return [f"{told}: its corners {then}"]


def _model(path: Path, shot: Shot, fused: bool) -> Camera:
    from neurolens.cameras.model import OnnxCamera, load_model
    from neurolens.surrogates.cardstates import state_for

    for field, value in {"efl_mm": shot.efl_mm, "field_deg": shot.field_deg}.items():
        _refuse(str(path), field, value, "left out: a model is of one size of its lens")
    model = load_model(path)
    axes = [a.name for a in model.axes]
    if "zoom" not in axes:
        _refuse(str(path), "zoom", shot.zoom, "left out: the model is of one zoom position")
    if "focus" not in axes and shot.focus == "internal":
        _refuse(str(path), "focus", shot.focus, "left out: the model knows no moving groups")
    if model.axes:
        model = model.at(*state_for(path, model.axes, model.state, shot.zoom, shot.focus_m))
    lens, domain = model.card["lens"], model.card["domain"]
    widest = float(lens["f_number"] * lens["stop_radius_mm"] / domain["stop_radius_mm"])
    camera = OnnxCamera(
        model,
        film_mm=shot.film_mm,
        focus_m=shot.focus_m,
        f_number=shot.f_number_for(widest),
        aperture=shot.aperture,
        wavelength_nm=shot.wavelength_nm,
        focus=shot.focus,
        film_offset_mm=shot.film_offset_mm,
        runtime="c" if fused else "onnxruntime",
    )
    notes = _beyond_circle(shot.film_mm, domain["film_radius_mm"], "the model's picture", "stay dark")
    poor = ", ".join(model.card["errors"].get("poor") or ())
    camera.settings["notes"] = [*([f"the model is poor, as its card says: {poor}"] if poor else []), *notes]
    return camera


def _refuse(camera: str, field: str, value: object, expected: str) -> None:
    if value is not None:
        raise InputError(f"camera {camera}", field, value, expected)
