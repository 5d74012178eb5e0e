"""The disc that a camera draws of a point of light: what a photographer calls bokeh.

For each point of a grid over the pupil, the film point is sought whose ray meets the light: the light's rays, traced
backwards, without noise. The same code for the exact lens, a surrogate and the thin lens.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from experiments.pictures.gallery.cameras import View, pupil_rays
from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.contract import Camera
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.model import OnnxCamera
from neurolens.optics.lens.glass import LINE_D_NM

Array = NDArray[np.float64]

_STEP_MM = 0.02  # of the finite differences: float32 rays resolve a thousandth of it
_STEPS = 4  # of Newton's method, which stops moving after three
_FOUND_MM = 2e-3  # a film point that the last step moved by less
_FAR_MM = 100.0  # no step is longer: rays that are lost must not carry the film point to infinity
_COARSE = 24  # film points per side of the search for a start
_FEW = 7  # of the pupil's points one in so many finds the disc
_R2 = (0.7548776662466927, 0.5698402909980532)  # 1 / g and 1 / g^2 with g^3 = g + 1
_MARGIN = 1.1  # of the pupil's box, for rims that cut it differently across the disc


@dataclass(frozen=True)
class LightDisc:
    """A point of light as it lies on the film.

    Attributes:
        film_mm: [2, N] where its rays arrive, lens frame.
        flux: [N] what each carries, above 0, in the camera's own scale (its exposure on the axis).
    """

    film_mm: Array
    flux: Array

    @property
    def total(self) -> float:
        """Flux of all rays: compare it within one camera only."""
        return float(self.flux.sum())

    @property
    def centre_mm(self) -> Array:
        """Centroid [2]."""
        return np.asarray(self.film_mm @ self.flux / self.total)

    @property
    def axes_mm(self) -> tuple[float, float]:
        """Longer and shorter diameter of the evenly lit ellipse of the same second moments: four standard deviations.

        Of an evenly lit disc they are its diameter.
        """
        short, long = np.sqrt(np.maximum(np.linalg.eigvalsh(self._covariance()), 0))
        return 4 * float(long), 4 * float(short)

    @property
    def widths_mm(self) -> tuple[float, float]:
        """Four standard deviations along x and along y."""
        x, y = 4 * np.sqrt(np.diag(self._covariance()))
        return float(x), float(y)

    @property
    def area_mm2(self) -> float:
        """Area of the ellipse of `axes_mm`."""
        long, short = self.axes_mm
        return float(np.pi / 4 * long * short)

    @property
    def long_axis_deg(self) -> float:
        """Direction of the longer axis, from x towards y, in [0, 180)."""
        vector = np.linalg.eigh(self._covariance())[1][:, 1]
        return float(np.degrees(np.arctan2(vector[1], vector[0])) % 180)

    def outline_mm(self, bins: int = 120) -> Array:
        """Largest distance from the centroid in each of `bins` equal angles from x towards y, [bins]."""
        x, y = self.film_mm - self.centre_mm[:, None]
        angle = np.floor((np.arctan2(y, x) / (2 * np.pi) % 1) * bins).astype(np.intp) % bins
        outline = np.zeros(bins)
        np.maximum.at(outline, angle, np.hypot(x, y))
        return outline

    def _covariance(self) -> Array:
        off = self.film_mm - self.centre_mm[:, None]
        return np.asarray((off * self.flux) @ off.T / self.total)


def light_disc(
    camera: Camera, light_m: tuple[float, float, float], *, count: int = 6000, wavelength_nm: float = 550.0
) -> LightDisc:
    """The disc of a point of light.

    Args:
        light_m: where it is, camera frame: film centre at the origin, looking along -z, y up.
        count: of pupil points, the additive recurrence R2 (Roberts 2018), whose edges no grid lines up with.

    The flux through a pupil point is the ray's weight over |d miss / d film|, miss being by how much the ray of a film
    point passes the light: a point of light is a delta function of it.

    Raises:
        InputError: no ray of the camera's film reaches the light.
    """
    target = np.asarray(light_m, np.float64)
    across = _across(target)
    square = ((0.5 + np.outer(_R2, np.arange(count))) % 1).astype(np.float32)
    films = np.repeat(_nearest(camera, target, across, wavelength_nm)[:, None], square.shape[1], axis=1)
    miss_of = partial(_miss, target, across)
    if isinstance(camera, ExactCamera | OnnxCamera):
        # A few rays find the disc, so that all others are sent through the pupil that all of the disc sees.
        few = count // _FEW
        found, _ = _aim(_held_pupil(camera, films[:, :few], square[:, :few], wavelength_nm), films[:, :few], miss_of)
        films = found[:, np.arange(count) % found.shape[1]] if found.size else films
    found, flux = _aim(_held_pupil(camera, films, square, wavelength_nm), films, miss_of)
    if not found.size:
        raise InputError("light_disc", "light_m", light_m, "a light that the camera's film sees")
    return LightDisc(found, flux)


class _HeldPupil:
    """Rays from film points through pupil points that stay where they are when the film point moves."""

    def __init__(self, camera: Camera, square: NDArray[np.float32], wavelength_nm: float) -> None:
        self.camera, self.pupil = camera, square
        self.wavelength = np.full(square.shape[1], wavelength_nm, np.float32)

    def __call__(self, film: Array) -> tuple[Array, Array, Array]:
        """Origins [3, N] in metres and directions [3, N], camera frame; weights [N], 0 where the ray is stopped."""
        rays = self.camera.sample(np.ascontiguousarray(film, np.float32), self.pupil, self.wavelength)
        weight = np.where(rays.status == st.PASSED, rays.weight, 0) / self.pupil.shape[1]
        return rays.origin_m.astype(np.float64), rays.direction.astype(np.float64), weight.astype(np.float64)


class _LensPupil(_HeldPupil):
    """The same of a lens or model, whose `sample` turns the pupil with the film point: pupil points in mm."""

    camera: ExactCamera | OnnxCamera

    def __init__(
        self, camera: ExactCamera | OnnxCamera, square: NDArray[np.float32], wavelength_nm: float, films: Array
    ) -> None:
        super().__init__(camera, square, wavelength_nm)
        seen, area = camera.film.outline.sample(films.astype(np.float32), square, self.wavelength)
        low, high = (np.asarray(f(seen[:, area > 0], axis=1), np.float64) for f in (np.min, np.max))
        centre, size = (low + high) / 2, (high - low) * _MARGIN
        self.area = float(np.prod(size))
        self.pupil = (centre[:, None] + size[:, None] * (square - 0.5)).astype(np.float32)

    def __call__(self, film: Array) -> tuple[Array, Array, Array]:
        lens = self.camera.film
        points = np.ascontiguousarray(film, np.float32)
        rays = lens.scene(points, self.pupil, self.wavelength)
        slope2 = ((self.pupil - points).astype(np.float64) ** 2).sum(axis=0) / lens.distance_mm**2
        weight = rays.transmittance * self.area / (1 + slope2) ** 2 / (lens.distance_mm**2 * lens.exposure)
        weight = np.where(rays.status == st.PASSED, weight, 0) / self.pupil.shape[1]
        origin = rays.scene_ray[:3].astype(np.float64)
        origin[2] -= lens.film_z_mm
        return 1e-3 * origin, rays.scene_ray[3:].astype(np.float64), weight


def _held_pupil(camera: Camera, films: Array, square: NDArray[np.float32], wavelength_nm: float) -> _HeldPupil:
    if isinstance(camera, ExactCamera | OnnxCamera):
        return _LensPupil(camera, square, wavelength_nm, films)
    return _HeldPupil(camera, square, wavelength_nm)


def _aim(rays: _HeldPupil, film: Array, miss_of: partial[Array]) -> tuple[Array, Array]:
    """Film points [2, M] whose rays meet the light, and their flux [M], by Newton's method from `film` [2, N]."""
    for _ in range(_STEPS):
        *ray, weight = rays(film)
        miss = miss_of(*ray)
        (a, c), (b, d) = ((miss_of(*rays(film + move)[:2]) - miss) / _STEP_MM for move in _MOVES)
        density = a * d - b * c  # 0 where the film point left what the lens lights
        step = np.stack([d * miss[0] - b * miss[1], a * miss[1] - c * miss[0]])
        step = np.divide(step, density, out=np.zeros_like(step), where=density != 0)
        film = film - np.clip(step, -_FAR_MM, _FAR_MM)
    good = (weight > 0) & (density != 0) & (np.hypot(*step) < _FOUND_MM)
    return film[:, good], weight[good] / np.abs(density[good])


_MOVES = np.eye(2)[:, :, None] * _STEP_MM


def _miss(target: Array, across: Array, origin: Array, direction: Array) -> Array:
    """The distances by which rays miss a point, [2, N] metres along the two directions `across` [2, 3]."""
    gap = origin - target[:, None]
    return np.asarray(across @ (gap - np.einsum("in,in->n", gap, direction) * direction))


def _nearest(camera: Camera, target: Array, across: Array, wavelength_nm: float) -> Array:
    """The film point [2] of a coarse grid whose middle ray passes nearest to the light."""
    places = (np.arange(_COARSE) + 0.5) / _COARSE - 0.5
    film = np.stack([a.ravel() for a in np.meshgrid(places * camera.film_mm[0], places * camera.film_mm[1])])
    origin, direction, weight = _HeldPupil(camera, np.full(film.shape, 0.5, np.float32), wavelength_nm)(film)
    ahead = (weight > 0) & (np.einsum("in,in->n", target[:, None] - origin, direction) > 0)
    if not ahead.any():
        raise InputError("light_disc", "light_m", tuple(target.tolist()), "a light that the camera's film sees")
    miss = np.hypot(*_miss(target, across, origin, direction))
    return np.asarray(film[:, np.argmin(np.where(ahead, miss, np.inf))])


def _across(target: Array) -> Array:
    """Two unit vectors [2, 3] across the line of sight from the film's centre."""
    sight = target / np.linalg.norm(target)
    right = np.cross(sight, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(right, sight)])


EDGE = 0.8  # of the way to the film's corner: a disc there still lies on the film as a whole
_CELLS = 24  # a side of the grid on which two discs are laid over each other
_SQUARE = 128  # pupil samples per side of a passage rate


def stop_shape(view: View) -> dict[str, float]:
    """The signs of a stop's shape: passage on the axis, its area, corners, near discs turned, discs cut at the edge.

    Options of the panel: far_m, near_m, the distances of the lights.
    """
    far_m, near_m = view.shot.panel.option("far_m", 12.0), view.shot.panel.option("near_m", 0.62)
    far, near = (light_disc(view.camera, (0.0, 0.0, -d)) for d in (far_m, near_m))
    edge = light_disc(view.camera, light_towards(view.camera, EDGE, far_m))
    shape = view.shot.lens.aperture
    return {
        "passage_percent": 100 * passage(view.camera),
        "area_of_the_shape_percent": 100 * (1.0 if shape is None else shape.area_share),
        "waves_of_the_outline": float(outline_waves(far)[0]),
        "depth_of_those_waves_percent": 100 * outline_waves(far)[1],
        "far_over_near_disc_percent": 100 * overlap(far, near),
        "far_over_turned_near_disc_percent": 100 * overlap(far, near, turned=True),
        "disc_at_the_edge_over_middle_percent": 100 * edge.area_mm2 / far.area_mm2,
    }


def cats_eye(view: View) -> dict[str, float]:
    """Disc near the film's corner against that in the middle: axis ratio, area, light; is it across the radius?

    Option of the panel: far_m, the distance of the lights.
    """
    far_m = view.shot.panel.option("far_m", 12.0)
    middle = light_disc(view.camera, (0.0, 0.0, -far_m))
    found = {}
    for name, share in (("half way", EDGE / 2), ("near the corner", EDGE)):
        disc = light_disc(view.camera, light_towards(view.camera, share, far_m))
        place = f"_{name}".replace(" ", "_")
        found[f"axis_ratio{place}"] = disc.axes_mm[1] / disc.axes_mm[0]
        found[f"area{place}_percent"] = 100 * disc.area_mm2 / middle.area_mm2
        found[f"light{place}_percent"] = 100 * disc.total / middle.total
    return found


def anamorphic(view: View) -> dict[str, float]:
    """Height over width of a disc in the middle of the film, as it lies there and with the picture stretched again.

    Options of the panel: far_m, the distance of the light; in_focus_m.
    """
    far_m = view.shot.panel.option("far_m", 12.0)
    width, height = light_disc(view.camera, (0.0, 0.0, -far_m)).widths_mm
    squeeze = squeeze_of(view.camera, view.shot.focus_m)
    return {
        "squeeze_of_the_picture": squeeze,
        "disc_height_over_width_on_film": height / width,
        "disc_height_over_width_unsqueezed": height / width / squeeze,
    }


def squeeze_of(camera: Camera, distance_m: float) -> float:
    """Magnification along y over that along x, for lights at a distance, near the axis."""
    step = 0.01 * distance_m
    middle = light_disc(camera, (0.0, 0.0, -distance_m)).centre_mm
    right = light_disc(camera, (step, 0.0, -distance_m)).centre_mm - middle
    up = light_disc(camera, (0.0, step, -distance_m)).centre_mm - middle
    return float(np.hypot(*up) / np.hypot(*right))


def passage(camera: Camera) -> float:
    """Share of the rays sampled from the film's centre that pass the stop's shape."""
    rays = pupil_rays(camera, np.zeros((2, 1)), _SQUARE, LINE_D_NM)
    return float((rays.status == st.PASSED).mean())


def outline_waves(disc: LightDisc) -> tuple[int, float]:
    """The strongest wave of a disc's outline round its centre: how many periods, and its amplitude over the radius.

    A polygon of n corners has n; waves of 1 (off centre) and 2 (oval) are left out.
    """
    outline = disc.outline_mm()
    waves = np.abs(np.fft.rfft(outline)) / len(outline)
    best = 3 + int(np.argmax(waves[3 : len(outline) // 4]))
    return best, float(2 * waves[best] / waves[0])


def overlap(a: LightDisc, b: LightDisc, *, turned: bool = False) -> float:
    """Common area over united area of two discs of the same size, the second turned by 180 degrees or not."""
    first, second = _shape(a, 1), _shape(b, -1 if turned else 1)
    return float((first & second).sum() / (first | second).sum())


def _shape(disc: LightDisc, sign: int) -> NDArray[np.bool_]:
    """The cells of a grid that the disc covers, its size (root mean square radius) and place taken away."""
    off = (disc.film_mm - disc.centre_mm[:, None]) * sign
    off = off / np.sqrt(2 * (off**2 * disc.flux).sum() / disc.total)
    cell = np.floor((off / 3.2 + 0.5) * _CELLS).astype(np.intp)
    inside = ((cell >= 0) & (cell < _CELLS)).all(axis=0)
    count = np.zeros((_CELLS, _CELLS))
    np.add.at(count, tuple(cell[:, inside]), 1)
    return np.asarray(count > 0.25 * count[count > 0].mean())


def light_towards(camera: Camera, share: float, distance_m: float) -> tuple[float, float, float]:
    """A point at a distance whose disc lies about `share` of the way from the film's centre to its corner."""
    efl, focus_m = float(camera.settings["efl_mm"]), camera.settings["focus_m"]
    behind = efl if focus_m is None else efl / (1 - efl / (1e3 * focus_m - efl))  # of the film, to first order
    scale = share * (1e3 * distance_m - behind) / behind / 2 * 1e-3
    return camera.film_mm[0] * scale, camera.film_mm[1] * scale, -distance_m
