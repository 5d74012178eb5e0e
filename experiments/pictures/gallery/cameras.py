"""The lens of a panel, exact and as a surrogate fitted once to all shots of one state; its cameras, and what they see.

One surrogate serves all shots of a state of the lens; a window is a part of a film, a view what a measure is given.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.pictures.gallery.settings import Panel
from neurolens import __version__
from neurolens.base import status as st
from neurolens.base.errors import NeurolensWarning
from neurolens.base.files import fingerprint_of, read_kept
from neurolens.base.progress import Report
from neurolens.cameras import build
from neurolens.cameras.contract import RAYS_A_CALL, Camera, CameraRays, FloatArray
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.model import OnnxCamera, load_model
from neurolens.cameras.reduced import Vignetted
from neurolens.models.fit import ModelSettings, prepare
from neurolens.models.fitted import Domain
from neurolens.models.pairs import PairSettings, domain_of, make_pairs
from neurolens.optics.lens.paraxial import film_z_mm, first_order
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.lens.shot import Shot as CameraShot, StopShape
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.focusing import focused_inside
from neurolens.optics.setting.states import set_lens
from neurolens.pictures.render.images import make_aperture
from neurolens.pictures.render.scene import Scene
from neurolens.studies.measure import fit_and_measure, known_record
from neurolens.studies.scenes import Image

_CLEAR = 0.95  # rims over the radius of curvature, at most
_VIGNETTING_RAYS = 50_000


@dataclass(frozen=True)
class Shot:
    """A panel with its lens and scene.

    Attributes:
        lens: in its state (size, zoom, widened, groups focused), stop at the shot's f-number, film in its place.
        focus_m, f_number, film_mm: as set. offset_mm: of the film from where first order focuses this lens.
    """

    panel: Panel
    scene: Scene
    lens: Lens
    focus_m: float
    f_number: float
    film_mm: tuple[float, float]
    offset_mm: float

    @property
    def wavelength_nm(self) -> tuple[float, float]:
        return self.scene.settings.camera.wavelength_nm


@dataclass(frozen=True)
class Surrogate:
    """An exported model, the domain it was fitted to, and its record (`rms_um`, ...; see `records.Results`)."""

    file: Path
    domain: Domain
    record: dict[str, Any]


def shot_of(panel: Panel, scene: Scene) -> Shot:
    """The lens and the settings of a panel.

    Raises:
        InputError: as `read_lens` and `set_lens`.
    """
    camera = scene.settings.camera
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NeurolensWarning)  # a lens of one wavelength is what the file asks for
        lens = set_lens(
            read_lens(panel.lens), focal_length_mm=panel.focal_length_mm, field_deg=panel.field_deg, zoom=panel.zoom
        )
    lens = widened(lens, panel.widen)
    shape = make_aperture(StopShape(panel.blades, panel.blade_rotation_deg, panel.blade_curvature, panel.aperture_mask))
    lens = lens.with_aperture(shape or scene.aperture or lens.aperture)
    focus_m = camera.focus_m if panel.focus_m is None else panel.focus_m
    f_number = panel.f_number or camera.f_number or float(first_order(lens).f_number)
    lens, inside = set_lens(lens, f_number=f_number), panel.focus_mode == "internal"
    lens = focused_inside(lens, focus_m) if inside else set_lens(lens, focus_m=focus_m, focus_mode=panel.focus_mode)
    assert lens.film_z_mm is not None  # `at` places the film
    film_z = float(lens.film_z_mm) + panel.film_offset_mm
    lens = replace(lens, infinity_mm=())  # groups that have moved to focus stay there
    film_mm = panel.film_mm or camera.film_mm
    placed, offset_mm = replace(lens, film_z_mm=film_z), film_z - film_z_mm(lens, focus_m)
    return Shot(panel, scene, placed, focus_m, f_number, film_mm, offset_mm)


def widened(lens: Lens, factor: float) -> Lens:
    """The lens with all rims but the stop's wider by a factor, none near its surface's radius of curvature."""

    def wider(s: Surface) -> Surface:
        if s.stop or factor == 1:
            return s
        most = 2 * _CLEAR * abs(float(s.radius_mm))
        return replace(s, diameter_mm=max(s.diameter_mm, min(factor * s.diameter_mm, most)))

    return replace(lens, surfaces=tuple(wider(s) for s in lens.surfaces))


def same_state(a: Shot, b: Shot) -> bool:
    """Whether one surrogate serves both: the same glass and fit, whatever the stop and the film's place."""
    same = a.lens.sha256 == b.lens.sha256 and a.panel.fit == b.panel.fit
    return same and a.panel.model == b.panel.model and a.wavelength_nm == b.wavelength_nm


def surrogate_of(shots: Sequence[Shot], cache: Path, report: Report) -> Surrogate:
    """The shipped model that the shots name, or one fitted to all of them, taken from `cache` if it is there.

    Args:
        shots: of one state of the lens (`same_state`).
    """
    named = shots[0].panel.model
    if named is not None:
        card = load_model(named).card
        return Surrogate(named, Domain.from_dict(card["domain"]), dict(card["errors"]))
    lens = min((s.lens for s in shots), key=lambda each: -each.stop_radius_mm).with_aperture(None)
    films = [float(s.lens.film_z_mm or 0) for s in shots]
    asked = {
        "film_radius_mm": max(math.hypot(*s.film_mm) / 2 for s in shots),
        "film_z_mm": (min(films), max(films)),
        "focus_m": (max(s.focus_m for s in shots), min(s.focus_m for s in shots)),
        "wavelength_nm": shots[0].wavelength_nm,
    }
    return fitted(lens, asked, shots[0].panel.fit, cache, report)


def fitted(
    lens: Lens,
    asked: dict[str, Any],
    fit: ModelSettings,
    cache: Path,
    report: Report,
    pairs: PairSettings = PairSettings(),  # noqa: B008  frozen
) -> Surrogate:
    """A surrogate of `lens` over the domain `asked` (arguments of `domain_of`), kept in `cache`."""
    made_of = [__version__, lens.sha256, lens.stop_radius_mm, asked, asdict(fit), asdict(pairs)]
    folder = cache / f"{lens.lens_id}-{fingerprint_of(made_of)[:12]}"
    file = folder / f"{fit.label}.onnx"
    record = known_record(file, (read_kept(file.with_suffix(".json")) or {}).get("fingerprint", "(none)"))
    if record is not None:  # a domain takes seconds, too
        return Surrogate(file, Domain.from_dict(load_model(file).card["domain"]), record)
    folder.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NeurolensWarning)  # its errors stand in the table
        domain = domain_of(lens, **asked)
        prepared = prepare(make_pairs(lens, domain, pairs))
        measured = fit_and_measure(prepared, fit, folder, _VIGNETTING_RAYS, report)
    return Surrogate(measured.file, domain, measured.record)


Array = NDArray[np.float64]

NEAR_CORNER = 0.95  # of the way to the film's corner, where falloff is matched and measured
_SQUARE = 64  # pupil samples per side


def pupil_rays(camera: Camera, film_mm: Array, side: int, wavelength_nm: float = 550.0) -> CameraRays:
    """Rays of film points [2, N] mm through side x side pupil samples each, film point after film point."""
    middle = ((np.arange(side) + 0.5) / side).astype(np.float32)
    square = np.stack([a.ravel() for a in np.meshgrid(middle, middle)])
    films = np.repeat(film_mm, side**2, axis=1).astype(np.float32)
    wavelength = np.full(films.shape[1], wavelength_nm, np.float32)
    return camera.sample(films, np.tile(square, film_mm.shape[1]), wavelength)


def passing_weight(rays: CameraRays, points: int) -> Array:
    """Weights of so many film points' rays, [points, rays each]; 0 where a ray is stopped."""
    return np.where(rays.status == st.PASSED, rays.weight, 0).astype(np.float64).reshape(points, -1)


def outward(radii_mm: Array) -> Array:
    """Film points [2, N] at radii [N] mm, at an angle that is no symmetry of the film."""
    angle = math.radians(33.7)
    return np.array([[math.cos(angle)], [math.sin(angle)]]) * radii_mm


def illumination(camera: Camera, radii_mm: Array) -> Array:
    """Mean weight of the rays of film points [N] mm from the centre at 550 nm: a white card without noise."""
    return passing_weight(pupil_rays(camera, outward(radii_mm), _SQUARE), len(radii_mm)).mean(axis=1)


def post_process(radius_mm: Any, k: float) -> Any:
    """The vignette that editors and shaders draw: the cosine law, (1 + k r^2)^-2 at a film radius r in mm."""
    return (1 + k * radius_mm * radius_mm) ** -2


def strength_for(radius_mm: float, left: float) -> float:
    """k of the post-process that leaves the share `left` of the light at a radius."""
    return float((left**-0.5 - 1) / radius_mm**2)


class PostProcessed:
    """A camera whose picture is even, darkened afterwards by a post-process that meets a lens at one film radius.

    Args:
        plain: the camera that takes the picture. lens: whose light is met at the centre and near the film's corner.
    """

    def __init__(self, plain: Camera, lens: Camera) -> None:
        radius = NEAR_CORNER * math.hypot(*plain.film_mm) / 2
        middle, corner = illumination(lens, np.array([0.0, radius]))
        self.strength = strength_for(radius, corner / middle)
        self._plain = plain
        self.film_mm, self.name, self.achromatic = plain.film_mm, "post-process", getattr(plain, "achromatic", False)
        self.wavelength_nm, self.dispersive = plain.wavelength_nm, plain.dispersive
        self.settings: dict[str, Any] = {**plain.settings, "post_process_k": self.strength}

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """The rays of the camera, each with the weight that the post-process leaves at its film point [2, N]."""
        rays = self._plain.sample(film_mm, pupil, wavelength_nm)
        left = post_process(np.hypot(film_mm[0], film_mm[1]), self.strength).astype(np.float32)
        return replace(rays, weight=np.where(rays.status == st.PASSED, left, np.float32(0)))


class Window:
    """A part of a camera's film, as a camera: film points are counted from the window's centre.

    Args:
        camera: of the whole film.
        window_mm: centre x and y as printed (x right, y up: the lens frame turned by 180 degrees), width and height.
    """

    def __init__(self, camera: Camera, window_mm: tuple[float, float, float, float]) -> None:
        x, y, width, height = window_mm
        self._camera = camera
        self._centre = np.array([[-x], [-y]], np.float32)
        self.film_mm = (width, height)
        self.name, self.wavelength_nm, self.dispersive = camera.name, camera.wavelength_nm, camera.dispersive
        self.achromatic = getattr(camera, "achromatic", False)
        self.rays_a_call = getattr(camera, "rays_a_call", RAYS_A_CALL)
        self.settings: dict[str, Any] = {**camera.settings, "window_mm": list(window_mm)}

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """The rays of film points [2, N] in mm, counted from the window's centre."""
        return self._camera.sample(film_mm + self._centre, pupil, wavelength_nm)


def exact_camera(shot: Shot, surrogate: Surrogate | None) -> Camera:
    """The prescription itself, sampled over the surrogate's pupil: the same rays for the same random numbers."""
    bounds = None if surrogate is None else surrogate.domain.bounds
    return ExactCamera(replace(shot.lens, film_z_mm=None), _settings(shot), bounds=bounds)


def surrogate_camera(shot: Shot, surrogate: Surrogate | None) -> Camera:
    """The exported model."""
    assert surrogate is not None
    stop = {"f_number": float(first_order(shot.lens).f_number), "aperture": shot.lens.aperture}
    return OnnxCamera(load_model(surrogate.file), _settings(shot, **stop))


def _settings(shot: Shot, **more: Any) -> CameraShot:
    """The settings that the exact lens and the model share, and more."""
    return CameraShot(
        shot.film_mm, shot.focus_m, film_offset_mm=shot.offset_mm, wavelength_nm=shot.wavelength_nm,
        focus_mode="paraxial", film_tilt_deg=shot.panel.film_tilt_deg, **more,
    )  # fmt: skip


def ideal_camera(kind: str, shot: Shot, surrogate: Surrogate | None) -> Camera:
    """A thin lens ("thin:") or a hole ("pinhole:") that shows the plane in focus at the lens's size.

    As `thin:LENS.toml` of `render`; the film of the thin lens is moved as the panel asks.
    """
    offset = shot.panel.film_offset_mm
    lens = replace(shot.lens, film_z_mm=float(shot.lens.film_z_mm or 0) - offset)
    return build.ideal_as(kind, lens, CameraShot(shot.film_mm, shot.focus_m, film_offset_mm=offset))


thin_camera = partial(ideal_camera, "thin:")


# Columns that an effect may ask for. A camera is made of the shot and of the surrogate, None where no column needs one.
CAMERAS: dict[str, Callable[[Shot, Surrogate | None], Camera]] = {
    "exact": exact_camera,
    "surrogate": surrogate_camera,
    "thin": thin_camera,
    "pinhole": partial(ideal_camera, "pinhole:"),
    "post": lambda shot, surrogate: PostProcessed(thin_camera(shot, surrogate), exact_camera(shot, surrogate)),
}
TITLES = {"exact": "exact lens", "surrogate": "model", "thin": "thin lens", "post": "post-process"}


def camera_of(column: str, shot: Shot, surrogate: Surrogate | None) -> Camera:
    """The camera of a column, with what the panel leaves of its vignetting."""
    camera = CAMERAS[column](shot, surrogate)
    left = shot.panel.vignetting
    return camera if left == "both" else Vignetted(camera, left, shot.wavelength_nm)


@dataclass(frozen=True)
class View:
    """One camera's share of a panel.

    Attributes:
        shot: panel, scene and lens. camera: of the whole film, in millimetres of the lens frame.
        column: its name. rgb: [H, W, 3] linear sRGB of the part that is drawn, before any exposure.
    """

    shot: Shot
    camera: Camera
    column: str
    rgb: FloatArray

    @property
    def window_mm(self) -> tuple[float, float, float, float]:
        """Centre x and y as printed, width and height of the picture."""
        return self.shot.panel.window_mm or (0.0, 0.0, *self.shot.film_mm)

    @property
    def grey(self) -> Image:
        """[H, W] luminance (Rec. 709)."""
        return luminance(self.rgb)

    def places_mm(self) -> tuple[Image, Image]:
        """Film x and y [H, W] of the pixels' middles, as printed: x right, y up."""
        height, width = self.rgb.shape[:2]
        x, y, wide, tall = self.window_mm
        across = x + wide * ((np.arange(width) + 0.5) / width - 0.5)
        up = y + tall * (0.5 - (np.arange(height) + 0.5) / height)
        x_mm, y_mm = np.meshgrid(across, up)
        return x_mm, y_mm


def luminance(rgb: FloatArray) -> Image:
    """Rec. 709 luminance of linear RGB [..., 3]."""
    grey: Image = np.asarray(rgb, np.float64) @ np.array([0.2126, 0.7152, 0.0722])
    return grey
