"""A lens as files of programs that follow a render: USD, OpenTrackIO, lensfun, OpenCV, nerfstudio and NVIDIA.

All files of a shot describe one pinhole, frame by frame, which the templates of all texts read. Its place is the
entrance pupil. Its focal length is the paraxial size of the picture (for a lens with cylinders that of the y meridian,
and widths are stretched by the squeeze); breathing is a focal length that changes with the focus. Its f-number is this
focal length over the entrance pupil's diameter, which gives discs of the lens's size.
"""

from __future__ import annotations

import json
import math
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field as dataclass_field
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neurolens import __version__
from neurolens.base.files import atomic_write_text
from neurolens.base.html import html
from neurolens.base.report import OPTIONAL, plain
from neurolens.cameras.contract import Camera, FloatArray
from neurolens.cameras.field import (
    Array,
    Complex,
    Field,
    centroids_m,
    diagonal_points,
    lit_points,
    radial_points,
    spectrum_of,
    traced_light,
)
from neurolens.optics.analysis import projections
from neurolens.pictures.render.stmap import Plates, blocks, in_pixels

FAR_M = 1e6  # replaces infinity where a program takes none
LENSFUN_TYPES = {"equidistant": "fisheye"}  # names of lensfun's; other names are ours
MOST_ENTRIES = 9  # of an animation, in lensfun's profile
# Other apertures of the profile: so many stops below the shot's, down to this f-number, and the widest.
_SMALLER, _SMALLEST = (2, 4), 23.0
_ROUNDS = 30  # of Lawson's weights in a fit
MODELS = "Brown-Conrady D-U", "Brown-Conrady U-D"  # names of OpenTrackIO's models
_GOOD_PX = 0.1  # a polynomial that leaves more than this is replaced by a ratio of two
_LEAST = 1e-5  # singular value over the largest: below it coefficients grow until they cancel, and a ratio gets poles
SIDE = 2049  # pixels of NVIDIA's exit picture
_NEAR = 1.0  # how many pictures beyond its edge, so that values read between pixels are right up to the edge
_TRIED = 3  # places are tried in every so many pixels
_HELD_OUT = 50, 34  # points across and down the film to which nothing is fitted
_ALONG = 2049  # points from its centre to its corner
_BESIDE_PX = 2.0  # around the place where a ratio is sharpest
OPENCV = [1, -1, 1]  # signs of x right, y up, z towards the scene in OpenCV's frame
CENTRAL_PX = 0.5  # where one centre leaves more anywhere, the rays of all pixels are written, too
_CELLS, _TABLE_PX = (12, 24, 48), 0.01  # cells along a table's longer side; the error that it may leave
_LIT = 161, 121  # points across and down the film at which the lit part of the picture is looked for
AtStop = Callable[[float | None], Camera]
Report = Callable[[float], None]


@dataclass(frozen=True)
class Pinhole:
    """One frame's pinhole.

    Attributes:
        number: the frame's. name: what file names have for it: ".0001", "" for a still.
        focal_mm: see the module. squeeze: focal length of the y over that of the x meridian.
        pupil_mm: from the film to the entrance pupil. focus_m: from the film to what is in focus, at most `FAR_M`.
        f_stop: see the module. t_stop: None where it is not known.
    """

    number: int
    name: str
    focal_mm: float
    squeeze: float
    pupil_mm: float
    focus_m: float
    f_stop: float
    t_stop: float | None

    @classmethod
    def of(cls, number: str, field: Field, settings: Mapping[str, Any], focus_m: float) -> Pinhole:
        """Make the pinhole of a camera's frame; `number` is as in file names."""
        state, (x, y) = settings["lens_state"], field.frame.reach_mm
        size = y / (state["effective_focal_length_mm"] or y)
        return cls(
            int(number or 1), f".{number}" if number else "", y, float(f"{y / x:.6g}"), field.frame.pupil_mm[1],
            min(focus_m, FAR_M), size * state["f_number"], state["t_stop"],
        )  # fmt: skip


@dataclass(frozen=True)
class Handed:
    """A shot that is handed over.

    Attributes:
        attributes: the first camera's, see `pictures.render.pictures.standard_attributes`; its texts may come from
            strangers.
        rate: frames a second, as numerator and denominator. colours: names of the colours that have maps of their own.
        coatings: of the lens, as `Lens.coatings`; "" of cameras that have none.
    """

    attributes: Mapping[str, Any]
    version: str
    rate: tuple[int, int]
    frames: tuple[Pinhole, ...]
    plates: Plates
    colours: tuple[str, ...]
    coatings: str = ""

    @property
    def lens(self) -> str:
        """The lens's name, never empty."""
        return str(self.attributes.get("lensModel") or self.attributes["cameraModel"])

    @property
    def about(self) -> str:
        """The lens by its name and the hash of its prescription; the path of its file means nothing elsewhere."""
        sha256 = self.attributes.get("lensSerialNumber")
        return f"{self.lens} (sha256 {sha256[:16]})" if sha256 else self.lens

    @property
    def pixel_aspect(self) -> float:
        """The width over the height of what a pixel shows."""
        return float(f"{self.frames[0].squeeze * self.plates.pixel_mm[0] / self.plates.pixel_mm[1]:.6g}")

    def film_mm(self, size: tuple[int, int], squeezed: bool = False) -> tuple[float, float]:
        """The film (mm) of a picture of `size` pixels: as it is if `squeezed`, else with both focal lengths equal."""
        stretch = 1.0 if squeezed else self.frames[0].squeeze
        return size[0] * self.plates.pixel_mm[0] * stretch, size[1] * self.plates.pixel_mm[1]


def falloff(light: Array, radius: Array) -> tuple[tuple[float, ...], float]:
    """Fit light, relative to the axis, by r^2, r^4, r^6 (least squares): coefficients and their largest error."""
    lit = light > 0
    powers = np.stack([radius[lit] ** k for k in (2, 4, 6)], 1)
    scale = powers.max(0)
    found = np.linalg.lstsq(powers / scale, light[lit] - 1, rcond=None)[0] / scale
    return tuple(found.tolist()), float(np.abs(powers @ found + 1 - light[lit]).max())


# The two lookup pictures of NVIDIA's schema OmniLensDistortionLutAPI, by which a USD camera gets a lens's projection.
#
# `enter` has the picture's size. Its R, G and B are the direction that a pixel sees (x right, y up, -z forward);
# where no light arrives they are 0, 0, 1, which is behind the camera. `exit` is a square. Its R and G say where the
# picture shows a direction, from 0 to 1 from its upper left corner; -1 where it does not show it. Directions are folded
# onto the square as onto an octahedron, with forward in its middle; x grows to the right, and y, which is up, from the
# first row to the last. The side is odd, so that the folds run through centres of pixels, where pictures that are read
# between pixels are exact. NVIDIA's renderer traces rays by the first; the second serves what it projects, such as
# motion vectors.


def enter_map(field: Field, plates: Plates, report: Report = lambda share: None) -> dict[str, FloatArray]:
    """Return the channels of NVIDIA's map from pixels to directions."""
    planes = {name: np.empty(plates.picture[::-1], np.float32) for name in "RGB"}
    for rows, point in blocks(plates.picture, plates.pixel_mm, report):
        point = np.broadcast_to(point, (point.shape[0], plates.picture[0]))
        way = field.directions(point.reshape(-1)) * np.array([1.0, 1.0, -1.0])[:, None]
        way = np.where(field.lit(point.reshape(-1)) & np.isfinite(way).all(0), way, [[0.0], [0.0], [1.0]])
        for plane, values in zip(planes.values(), way, strict=True):
            plane[rows] = values.reshape(point.shape)
    return planes


def exit_map(field: Field, plates: Plates, report: Report = lambda share: None) -> dict[str, FloatArray]:
    """Return the channels of NVIDIA's map from directions, on a folded square, to places in the picture."""
    planes = {name: np.zeros((SIDE, SIDE), np.float32) for name in "RGB"}
    across = np.asarray((np.arange(SIDE) + 0.5) * (2 / SIDE) - 1, np.float64)
    for row, down in enumerate(across):
        planes["R"][row], planes["G"][row] = place_of(field, plates, folded(across, np.full(SIDE, down)))
        report((row + 1) / SIDE)
    return planes


def folded(u: Array, v: Array) -> Array:
    """Return directions [3, N], not of unit length, at points of the square from -1 to 1."""
    z = 1 - np.abs(u) - np.abs(v)
    out = z < 0
    x = np.where(out, (1 - np.abs(v)) * np.where(u < 0, -1, 1), u)
    y = np.where(out, (1 - np.abs(u)) * np.where(v < 0, -1, 1), v)
    return np.stack([x, y, -z])


def place_of(field: Field, plates: Plates, way: Array) -> Array:
    """Return where the picture shows directions [3, N] of a USD camera: 0 to 1 from the upper left, -1 where not."""
    point = field.point(way * np.array([1.0, 1.0, -1.0])[:, None])
    film = [n * p for n, p in zip(plates.picture, plates.pixel_mm, strict=True)]
    place = np.stack([point.real / film[0] + 0.5, 0.5 - point.imag / film[1]])
    with np.errstate(invalid="ignore"):
        near = (np.abs(place - 0.5) < 0.5 + _NEAR).all(0) & (np.abs(point) < 2 * field.end_mm)
    return np.where(near, place, -1.0)


def exit_residual_px(field: Field, plates: Plates, planes: Mapping[str, FloatArray]) -> float:
    """Return the worst error, over the picture, of places that are read between four pixels of the exit picture."""
    middle = np.arange(1, SIDE)[::_TRIED] * (2 / SIDE) - 1
    exact = place_of(field, plates, folded(*(c.reshape(-1) for c in np.meshgrid(middle, middle))))
    four = [p[:-1, :-1] + p[1:, :-1] + p[:-1, 1:] + p[1:, 1:] for p in (planes["R"], planes["G"])]
    read = np.stack([f[::_TRIED, ::_TRIED].reshape(-1) / 4 for f in four])
    inside = (np.abs(exact - 0.5) < 0.5).all(0)
    return float(np.hypot(*((read - exact)[:, inside] * np.array(plates.picture)[:, None])).max(initial=0))


# OpenTrackIO 1.0.1: the numbers of OpenLensIO's lens model (SMPTE RiS-OSVP), in mm on the film.
#
# Undistorted places are e (1 + k1 r^2 + k3 r^4 + k5 r^6) / (1 + k2 r^2 + k4 r^4 + k6 r^6), with e the places of the
# lens's picture (the list "radial" of "Brown-Conrady D-U"; "U-D" is the other way), for a pinhole in the entrance
# pupil. Light is 1 - (a1 r^2 + a2 r^4 + a3 r^6). A template has the rest of a sample. Not in it are: where the camera
# stands, which its tracker knows; a focus at infinity; lateral colour; distortion of lenses with cylinders, beyond
# what a plane holds, or on a film that is turned or moved.


def opentrackio_sample(
    field: Field, pinhole: Pinhole, shot: Handed, moved: bool = False
) -> tuple[str, float | None, float]:
    """Return one frame's sample as JSON, and the worst that its formulae leave: pixels (or None), share of light.

    `moved`: whether the film is turned or moved.
    """
    plane = field.field_deg <= projections.WIDEST_DEG and pinhole.squeeze == 1 and not moved
    distortion, left_px = _distortions(field, shot) if plane else ([], None)
    points = lit_points(field, shot.film_mm(shot.plates.picture, squeezed=True))
    light, share = falloff(field.relative_light(points), np.abs(points))
    squeeze = Fraction(pinhole.squeeze).limit_denominator(1000)
    values = {
        "shot": shot,
        "pinhole": pinhole,
        "distortion": distortion,
        "overscan": max(1.0, *shot.plates.overscan),
        "light": [-k for k in light],
        "focus_m": pinhole.focus_m if pinhole.focus_m < FAR_M else None,
        "squeeze": (squeeze.numerator, squeeze.denominator),
        "ids": [uuid.uuid5(uuid.NAMESPACE_URL, f"neurolens {n} {shot}").urn for n in ("source", pinhole)],
    }
    return html("handover.opentrackio.json.jinja", **values), left_px, share


def _distortions(field: Field, shot: Handed) -> tuple[list[tuple[str, list[float]]], float]:
    """Fit a lens's distortion both ways: names with coefficients, and the worst that they leave in pixels."""
    points = radial_points(field, shot.film_mm(shot.plates.picture), 257)
    way = field.directions(points)
    both, found, worst = (points, field.frame.reach_mm[0] * (way[0] + 1j * way[1]) / way[2]), [], 0.0
    for model, (start, goal) in zip(MODELS, (both, both[::-1]), strict=True):
        radius, _, along = projections.along_radius(start, goal)
        powers, fits = np.stack([(radius / radius.max()) ** n for n in (2, 4, 6)]), []
        for terms in (radius * powers, np.concatenate([radius * powers, -along * powers])):
            k = np.zeros(6)
            k[: len(terms)] = np.linalg.lstsq(terms.T, along - radius, rcond=_LEAST)[0]
            missed = np.abs((1 + k[:3] @ powers) / (1 + k[3:] @ powers) * start - goal)
            by_mm = k.reshape(2, 3) / radius.max() ** np.array([2, 4, 6])
            # The last place is 1, the widest.
            pole = projections.has_pole(k[3:].tolist(), 1.0)
            fits.append((math.inf if pole else float(missed.max()) / shot.plates.pixel_mm[0], by_mm))
            if fits[-1][0] < _GOOD_PX:
                break
        left, radial = min(fits, key=lambda fit: fit[0])
        found.append((model, radial.T.reshape(-1).tolist()))
        worst = max(worst, left)
    return found, worst


# A lensfun profile: distortion as poly5, lateral colour as poly3, light as pa, by focal length and aperture.
#
# lensfun's formulae (lensfun.github.io/manual/latest/group__Lens.html) take r = 1 at half the short side of a film with
# the profile's aspect ratio and the picture's diagonal, counted between the centres of the outer pixels. The lens's
# picture shows at r (1 + k1 r^2 + k2 r^4) what the corrected one shows at r, and red at v r + c r^2 + b r^3 what the
# mean colour shows at r. Light is 1 + k1 r^2 + k2 r^4 + k3 r^6, with r = 1 in the corner. The size of the corrected
# picture is fitted, too: it is that of a pinhole of another focal length, and leaves a fifth to a thirtieth of the
# distance. lensfun's ptlens has one more coefficient, but version 0.3.4 computes pixels in fours, three of them wrong
# by up to 0.14 pixels. For 20 mm lenses by Canon and Nikon (f/2.8) poly5 leaves 0.67 and 0.56 pixels of 3840, ptlens
# would leave 0.45, and a term r^7 more, as in ACM, which 0.3.4 lacks, 0.43 and 0.28.
#
# Focal lengths are those of the pinhole: lensfun knows no breathing, so that these tell a focus pull, too.


class LensfunEntry(NamedTuple):
    """The profile of a lens at one focal length.

    Attributes:
        focal_mm: the pinhole's. distance_m: the plane that is in place. corrected_mm: the focal length of lensfun's
            corrected picture.
        distortion: k1, k2. red, blue: v, c, b. light: f-number, k1, k2, k3 for each aperture.
        distortion_px, colour_px, light_share: the worst that the formulae leave.
    """

    focal_mm: float
    distance_m: float
    corrected_mm: float
    distortion: tuple[float, float]
    red: tuple[float, ...]
    blue: tuple[float, ...]
    light: tuple[tuple[float, ...], ...]
    distortion_px: float
    colour_px: float
    light_share: float


def lensfun_entry(
    field: Field, camera: Camera, plane_m: float, shot: Handed, red_blue_nm: tuple[float, float], at_stop: AtStop
) -> LensfunEntry:
    """Make the entry of one state of a lens; `at_stop` makes its camera at an f-number (None: the widest)."""
    picture, pixel = shot.plates.picture, shot.plates.pixel_mm[0]
    film_mm = shot.film_mm(picture)
    corner = math.hypot(picture[0] - 1, picture[1] - 1) / 2 * pixel
    unit = corner / math.hypot(1, max(film_mm) / min(film_mm))
    points = radial_points(field, film_mm, 257)
    (size, a, b), left = _minimax(field.ideal(points) / unit, points / unit, (1, 3, 5))
    colours = []
    for nm in red_blue_nm:
        light = traced_light(camera, points, spectrum_of(camera, only_nm=nm), field.frame, field.target, plane_m)
        # From where the mean colour shows what this colour shows.
        colours.append(_minimax(field.picture(light.place) / unit, points / unit, (1, 2, 3)))
    lights, share = _lights(field, camera, plane_m, points[3::4], corner, at_stop)
    focal, px = field.frame.reach_mm[0], unit / pixel
    return LensfunEntry(
        focal, min(plane_m, FAR_M), focal * size, (a / size**3, b / size**5), colours[0][0], colours[1][0], lights,
        left * px, max(missed for _, missed in colours) * px, share,
    )  # fmt: skip


def _minimax(start: Complex, goal: Complex, powers: Sequence[int]) -> tuple[tuple[float, ...], float]:
    """Fit a polynomial of the radius with the least worst distance from goals, by Lawson's weights; also return it."""
    radius, turn, along = projections.along_radius(start, goal)
    rows, weight = np.stack([radius**p for p in powers], 1), np.ones(radius.size)
    best, least = tuple[float, ...](), math.inf
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)
        found = np.linalg.lstsq(rows * root[:, None], along * root, rcond=None)[0]
        left = np.abs(rows @ found * turn - goal)
        if left.max() < least:
            best, least = tuple(found.tolist()), float(left.max())
        weight = weight * left + 1e-12
        weight = weight / weight.sum()
    return best, least


def _lights(
    field: Field, camera: Camera, plane_m: float, points: Complex, corner: float, at_stop: AtStop
) -> tuple[tuple[tuple[float, ...], ...], float]:
    """Return the light by aperture, also the shot's own, and the worst share that the formula leaves."""
    own = float(camera.settings["lens_state"]["f_number"])
    further = [f for k in _SMALLER if (f := float(f"{own * 2 ** (k / 2):.3g}")) < _SMALLEST]
    rows, worst, points = {}, 0.0, np.append(0j, points)
    for made in (at_stop(None), *map(at_stop, further), camera):
        light = traced_light(made, points, field.spectrum, field.frame, field.target, plane_m).light
        k, left = falloff(light[1:] / light[0], np.abs(points[1:]) / corner)
        f_number = float(made.settings["lens_state"]["f_number"])
        rows[f"{f_number:.3g}"] = (f_number, *k)
        worst = max(worst, left)
    return tuple(sorted(rows.values())), worst


# Projections of OpenCV, nerfstudio and NVIDIA.


@dataclass(frozen=True)
class Span:
    """What a projection leaves between two field angles; `pupil_before_film_mm` is the entrance pupil of the second."""

    from_deg: float
    to_deg: float
    rms_px: float
    worst_px: float
    pupil_before_film_mm: float | None = dataclass_field(default=None, metadata=OPTIONAL)


@dataclass(frozen=True, kw_only=True)
class FittedProjection:
    """A projection of another program as it fits a camera's field, and what it leaves in pixels.

    Attributes:
        light_at_worst: the light where the fit is worst, over that on the axis.
        turns_back_at_deg: the field angle from which on the projection falls; None where it rises over the picture.
        before_film_mm: the one centre, for the x and the y meridian.
        parallax: by distance, how far things are from where the one centre has them; None where that was not asked for.
        noncentral: the same of the ray of each pixel, where those are written.
    """

    camera: str
    model: str
    size: list[int]
    focal_px: list[float]
    centre_px: list[float]
    coefficients: dict[str, float]
    rms_px: float
    worst_px: float
    worst_at_deg: float
    light_at_worst: float
    field_deg: float
    turns_back_at_deg: float | None
    by_field: list[Span]
    before_film_mm: list[float]
    parallax: list[dict[str, float]] | None = dataclass_field(default=None, metadata=OPTIONAL)
    noncentral: list[dict[str, float]] | None = dataclass_field(default=None, metadata=OPTIONAL)


def fitted_projection(
    kind: str | None, field: Field, size: tuple[int, int], film_mm: tuple[float, float], source: str,
    axis_mm: complex = 0j,
) -> tuple[projections.Projection, projections.Residual, FittedProjection]:  # fmt: skip
    """Fit a projection, of a `kind` as in `projections.fit`, to a field; return it, what it leaves, both as figures.

    `axis_mm`: the picture point on the axis.

    Raises:
        InputError: as `projections.fit`.
    """
    step = [side / count for side, count in zip(film_mm, size, strict=True)]
    focal = (field.frame.reach_mm[0] / step[0], field.frame.reach_mm[1] / step[1])
    if math.isclose(*field.frame.reach_mm, rel_tol=1e-9) and math.isclose(*step, rel_tol=1e-9):
        focal = focal[0], focal[0]
    seen = lit_points(field, film_mm)
    shown, light = _shown(field, size, film_mm, seen), field.relative_light(seen)
    off = axis_mm.real / step[0], -axis_mm.imag / step[1]
    fitted = projections.fit(kind, *shown, size, focal, source, light, off)
    ring = fitted.sharp_rad[:, None] + _BESIDE_PX / fitted.focal_px[0] * np.linspace(-1, 1, 33)
    ring = ring[(ring > 0) & (ring < fitted.widest_rad)]
    beside = field.point(np.stack([np.sin(ring), 0 * ring, np.cos(ring)]))
    points = np.concatenate([lit_points(field, film_mm, _HELD_OUT), diagonal_points(field, film_mm, _ALONG), beside])
    points = points[field.bright(points)]
    left = projections.residual(fitted, *_shown(field, size, film_mm, points))
    told = FittedProjection(
        camera=source,
        model=fitted.kind,
        size=list(fitted.size),
        focal_px=list(fitted.focal_px),
        centre_px=list(fitted.centre_px),
        coefficients=fitted.named,
        rms_px=left.rms_px,
        worst_px=left.worst_px,
        worst_at_deg=left.worst_at_deg,
        light_at_worst=float(field.relative_light(points)[left.worst]),
        field_deg=left.field_deg,
        turns_back_at_deg=None if left.sound else left.fold_deg,
        by_field=[Span(*row) for row in left.by_field],
        before_film_mm=list(field.frame.pupil_mm),
    )
    return fitted, left, told


def _shown(field: Field, size: tuple[int, int], film_mm: tuple[float, float], point: Complex) -> tuple[Any, Any]:
    """Return unit directions [N, 3] and pixels [N, 2], in OpenCV's frame, of points of the picture."""
    return field.directions(point).T * OPENCV, _pixels(point, size, film_mm)


def _pixels(point: Complex, size: tuple[int, int], film_mm: tuple[float, float]) -> Array:
    """Return the pixels of `_shown`."""
    return np.stack([(point.real / film_mm[0] + 0.5) * size[0], (0.5 - point.imag / film_mm[1]) * size[1]], 1) - 0.5


def write_projection(out: Path, fitted: projections.Projection, told: FittedProjection) -> list[str]:
    """Write the files of a projection, and return their names."""
    files = {}
    if fitted.kind in ("opencv", "opencv-rational", "kannala-brandt"):
        files[out.with_name(f"{out.name}.yaml")] = html("handover.opencv.yaml.jinja", lens=fitted, rms_px=told.rms_px)
    block = _block(fitted) | {"neurolens": {"version": __version__, **plain(told)}}
    files[out.with_name(f"{out.name}.json")] = json.dumps(plain(block), indent=1, allow_nan=False) + "\n"
    for path, text in files.items():
        atomic_write_text(path, text)
    return [str(path) for path in files]


def _block(fitted: projections.Projection) -> dict[str, Any]:
    """Return the camera as nerfstudio, NVIDIA's f-theta or OpenCV writes it."""
    size = {"w": fitted.size[0], "h": fitted.size[1]}
    if fitted.kind in ("opencv", "kannala-brandt"):
        cx, cy = (c + 0.5 for c in fitted.centre_px)
        name = "OPENCV" if fitted.kind == "opencv" else "OPENCV_FISHEYE"
        focal = {"fl_x": fitted.focal_px[0], "fl_y": fitted.focal_px[1], "cx": cx, "cy": cy}
        return {"camera_model": name, **size, **focal, **fitted.named, "frames": []}
    if fitted.kind == "f-theta":
        return {
            "resolution": list(fitted.size),
            "shutter_type": "GLOBAL",
            "principal_point": list(fitted.centre_px),
            "reference_poly": "ANGLE_TO_PIXELDIST",
            "angle_to_pixeldist_poly": [0.0, *fitted.coefficients],
            "pixeldist_to_angle_poly": [0.0, *projections.inverse_polynomial(fitted)],
            "max_angle": fitted.widest_rad,
            "linear_cde": [fitted.focal_px[0], 0.0, 0.0],
        }
    return {"camera_model": fitted.kind, **size, "focal_px": list(fitted.focal_px), **fitted.named}


# Rays of pixels, for programs that take a camera without a centre.


def sight(camera: Camera, field: Field, point: Complex, near_m: float) -> Array:
    """Return lines of sight [N, 6] of picture points, in OpenCV's frame about the entrance pupil on the axis.

    A line of sight leads through the centroids of the light at infinity and near. It is given by its point that is
    nearest to the origin (m), and by a unit direction; both are NaN where the picture is dark.
    """
    way, at = (centroids_m(camera, field, point, d) for d in (math.inf, near_m))
    return np.concatenate([at - (at * way).sum(0) * way, way]).T * (OPENCV * 2)


def pupil_mm(camera: Camera, field: Field, near_m: float, angle_deg: Array) -> Array:
    """Return the distances [N] before the film at which rays of a round lens meet the axis, by their angle to it."""
    angle = np.radians(angle_deg)
    point = field.point(np.stack([np.sin(angle), 0 * angle, np.cos(angle)]))
    x, _, z, dx, _, dz = sight(camera, field, point, near_m).T
    return np.asarray(np.mean(field.frame.pupil_mm) + 1e3 * (z - x * dz / dx))


def ray_table(
    camera: Camera, field: Field, size: tuple[int, int], film_mm: tuple[float, float], focus_m: float, near_m: float
) -> tuple[projections.RayTable, list[dict[str, float]]]:
    """Tabulate the lines of sight of a picture; also return, by distance, the error at points that were not fitted.

    Cells are halved until the table leaves at most `_TABLE_PX` at infinity, in focus and near, or until the longer side
    has the most of `_CELLS`.
    """
    pixel_mm = film_mm[0] / size[0], film_mm[1] / size[1]

    tried = np.concatenate([lit_points(field, film_mm, _HELD_OUT), diagonal_points(field, film_mm, _HELD_OUT[0])])
    tried = tried[field.bright(tried)]
    seen = {d: centroids_m(camera, field, tried, d) for d in dict.fromkeys((math.inf, focus_m, near_m))}
    pixel = _pixels(lit_points(field, film_mm, _LIT), size, film_mm)
    first = np.maximum(np.floor(pixel.min(0) - np.array(size) / _LIT), 0).astype(int)
    last = np.minimum(np.ceil(pixel.max(0) + np.array(size) / _LIT), np.array(size) - 1).astype(int)
    for cells in _CELLS:
        counts = np.ceil(cells * (last - first + 1) / (last - first + 1).max()).astype(int)
        shape = counts[1] + 3, counts[0] + 3, 6
        table = projections.RayTable(size, tuple(first.tolist()), tuple(last.tolist()), np.zeros(shape))
        sides = (np.linspace(a - 0.5, b + 0.5, 2 * n + 1) for a, b, n in zip(first, last, counts, strict=True))
        pixel = np.stack([c.reshape(-1) for c in np.meshgrid(*sides)], 1)
        x, y = ((pixel + 0.5) / size - 0.5).T * np.array(film_mm)[:, None]
        lit = field.bright(point := x - 1j * y)
        rays = sight(camera, field, point[lit], near_m)
        table = table.fitted(pixel[lit], rays, field.relative_light(point[lit]))
        at, way = (c.T for c in np.split(table(_pixels(tried, size, film_mm)) * (OPENCV * 2), 2, axis=1))
        left = []
        for distance_m, place in seen.items():
            # Where the ray meets the sphere of the centroids; the ray's own point is at right angles to its direction.
            reach = np.sqrt((place**2).sum(0) - (at**2).sum(0))
            told = way if math.isinf(distance_m) else at + reach * way
            left.append({"distance_m": distance_m, **in_pixels(field.point(place) - field.point(told), pixel_mm)})
        if max(row["worst_px"] for row in left) <= _TABLE_PX:
            break
    return table, left


def noncentral_pays(parallax: Sequence[Mapping[str, float]]) -> bool:
    """Return whether one centre leaves more than `CENTRAL_PX` at one of these distances."""
    return any(row["worst_px"] > CENTRAL_PX for row in parallax)


def ray_table_path(out: Path) -> Path:
    """Return the path NAME.noncentral.yaml."""
    return out.with_name(f"{out.name}.noncentral.yaml")


def write_ray_table(
    out: Path, table: projections.RayTable, left: list[dict[str, float]], about: str, field: Field
) -> str:
    """Write NAME.noncentral.yaml, and return its name."""
    path = ray_table_path(out)
    values = {"table": table, "left": left, "before_film_mm": float(np.mean(field.frame.pupil_mm))}
    atomic_write_text(path, html("handover.noncentral.yaml.jinja", about=f"{about}, neurolens {__version__}", **values))
    return str(path)
