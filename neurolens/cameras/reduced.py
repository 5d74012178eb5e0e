"""Cameras made of others: without a part of what their lens does, or an ideal one whose picture is warped afterwards.

A lens that disperses moves its picture with the wavelength (lateral colour), and blurs it in another way at each
(longitudinal colour, and the colours of other aberrations). `ReducedDispersion` follows the rays of one wavelength.
With "lateral", polynomials in film point and wavelength still move the picture of every other one, as an ST map for
each wavelength would.

`Vignetted`: the film value of white surroundings is V(f) at a film point f, and 1 on the axis. It is the product of two
factors, each taken over its value on the axis:

- natural, N(f) = <T cos^4> / <T>: cos^4 of the film-side angle to the axis, as a mean over the light that passes, which
  tends to the chief ray's as the stop closes; a fisheye projection has its own law instead;
- optical, O(f) = <T> A: the effective aperture, which is the area through which light passes, times its transmittance.

Four white cards show the parts (Steinert 2009, 5.2). For each, all rays of a film point are weighed by the same factor,
so that blur keeps its shape:

    both: 1     natural: N / V     optical: O / V     none: 1 / V

White surroundings then show V, N, O, or 1 wherever any light arrives. The means, over the wavelengths too, are tabled
on rings about the axis, which are closer to each other towards the end of the light.
"""

import math
from dataclasses import replace
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.base.settings import LIGHT_NM
from neurolens.cameras.contract import RAYS_A_CALL, Camera, CameraRays, FilmPoints, FloatArray, SpectralRays
from neurolens.cameras.field import (
    BEYOND,
    RECTILINEAR,
    WIDEST_DEG,
    Complex,
    end_of_light,
    film_edge,
    frame_of,
    on_axis,
    on_rings,
    spectrum_of,
    traced_light,
    turns,
)
from neurolens.cameras.sampling import axis_mm, common_light, is_light, stratified
from neurolens.optics.lens.prescription import LINE_D_NM
from neurolens.optics.lens.shot import Dispersion, Vignetting

Array = NDArray[np.float64]

_FARTHEST_M = 1e4
_FEW = 4096  # rays for which a compiler takes longer than they do
_DEGREE, _ORDERS = 7, 3  # degrees of the shift's polynomial, in the film point and in the wavelength
_POINTS, _SIDE, _WAVES = 192, 8, 7  # what the fit uses: film points, pupil samples a side, wavelengths
_TINTS = 61  # wavelengths of the tint: 5 nm over 400-700 nm, as coated old glass falls steeply below 420 nm
_BEYOND = 1.5  # how far beyond the fitted points' shifts the farthest companion may lie
_STEP = 1e-3  # share of the film's width: a step of the film point that tells how what it shows moves
_SIDE_OF_AXIS = 64  # pupil samples a side, for the light on the axis


def film_shift(
    camera: Camera,
    film_mm: Array,
    square: Array,
    wavelength_nm: float,
    reference_nm: float,
    step_mm: tuple[float, float],
) -> Array:
    """Return the way [2, F] in mm from film points to those that show the same at another wavelength; NaN if none do.

    What a film point shows is the mean of where its rays meet the object in focus, over the rays that pass.

    Args:
        film_mm: [2, F].
        square: [2, F, P], pupil samples.
        wavelength_nm, reference_nm: the other wavelength, and that of the film points.
        step_mm: steps of film points along x and y, which tell how far the place that they show moves with them. They
            lead towards the middle, so that no point leaves the film.
    """
    count, pupils = square.shape[1:]
    focus = camera.settings.get("focus_m")
    reach = min(_FARTHEST_M if focus is None else float(focus), _FARTHEST_M)
    sample = getattr(camera, "sample_few", camera.sample) if count * pupils <= _FEW else camera.sample

    def found(nm: float, at: Array) -> tuple[Array, NDArray[np.bool_]]:
        film = np.repeat(at, pupils, axis=1).astype(np.float32)
        rays = sample(film, square.reshape(2, -1).astype(np.float32), np.full(film.shape[1], nm, np.float32))
        point = rays.origin_m.astype(np.float64) + rays.direction.astype(np.float64) * reach
        return point, (rays.status == 0) & np.isfinite(point).all(axis=0)

    here, passed = found(reference_nm, film_mm)
    there, also = found(wavelength_nm, film_mm)
    passed &= also
    moved = []
    for axis in (0, 1):
        way = np.where(film_mm[axis] > 0, -step_mm[axis], step_mm[axis])
        point, also = found(reference_nm, film_mm + np.eye(2)[:, axis, None] * way)
        passed &= also
        moved.append((point - here) / np.repeat(way, pupils))
    rows = passed.reshape(count, pupils)
    shift, lit = np.full((2, count), np.nan), rows.any(axis=1)

    def mean(values: Array) -> Array:
        return np.where(passed, values, 0).reshape(3, count, pupils)[:, lit].sum(axis=2) / rows[lit].sum(axis=1)

    slopes = np.stack([mean(part) for part in moved], axis=-1).transpose(1, 0, 2)  # [F, 3, 2] per mm
    shift[:, lit] = -(np.linalg.pinv(slopes) @ mean(there - here).T[..., None])[..., 0].T
    return shift


class ReducedDispersion:
    """A camera without longitudinal colour ("lateral"), or without dispersion ("off"); see the module.

    White surroundings keep the colour that the lens gives them on the axis. Differentials are those of the one
    wavelength.

    Args:
        camera: any that keeps the contract.
        dispersion: "lateral" or "off".
        wavelength_nm: range of the light; the rays are those of the d line, or of the wavelength in the range nearest
            to it.

    Attributes:
        lateral: whether the picture moves with the wavelength. Companions may then be shared between pixels, as in an
            ST map that is read between pixels.

    Raises:
        InputError: "lateral" is asked of a camera that shows nothing.
    """

    def __init__(self, camera: Any, dispersion: Dispersion, wavelength_nm: tuple[float, float] = LIGHT_NM) -> None:
        self.camera, self.name, self.film_mm = camera, camera.name, camera.film_mm
        self.wavelength_nm, self.rays_a_call = camera.wavelength_nm, getattr(camera, "rays_a_call", RAYS_A_CALL)
        light = common_light(camera.wavelength_nm or wavelength_nm, wavelength_nm)
        self._nm = min(max(LINE_D_NM, light[0]), light[1])
        self.lateral = self.dispersive = dispersion == "lateral" and camera.dispersive and light[0] < light[1]
        self.settings: dict[str, Any] = {**camera.settings, "dispersion": dispersion}
        self._axis, self._reach = (part[:, None].astype(np.float32) for part in axis_mm(camera))
        self._lit_nm = np.linspace(*light, _TINTS)
        lit = np.array([self._exposure(nm) for nm in (self._nm, *self._lit_nm)])
        self._tint = lit[1:] / lit[0] if lit[0] > 0 else np.ones(_TINTS)
        self.achromatic = not self.lateral and bool(np.ptp(self._tint) == 0)
        self.companion_reach_mm: tuple[float, float] | None = None
        if self.lateral:
            self._fit(light)

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Return rays of the reference wavelength.

        They start at the film points that show, at that wavelength, what the given points show at theirs.
        """
        base = self._base(film_mm, wavelength_nm)
        return self._tinted(self.camera.sample(base, pupil, self._reference(film_mm)), wavelength_nm)

    def sample_differentials(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Sample rays as `sample` does, and give their differentials too."""
        base = self._base(film_mm, wavelength_nm)
        return self._tinted(self.camera.sample_differentials(base, pupil, self._reference(film_mm)), wavelength_nm)

    def sample_spectrum(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> SpectralRays:
        """Sample rays as `sample` does, for wavelengths [W, N] in nm; the first is the hero's (see the contract)."""
        base = self._base(film_mm, wavelength_nm[0])
        plain = self.camera.sample(base, pupil, self._reference(film_mm))
        rays = self._tinted(plain, wavelength_nm[0])
        places = np.concatenate([film_mm[None], base + self._shifts(film_mm, wavelength_nm[1:])])
        passed = (np.abs(places) < np.array(self.film_mm, np.float32)[:, None] / 2).all(axis=1) & (rays.weight > 0)
        passed[0] = rays.weight > 0
        share = plain.weight * self.tints(wavelength_nm) / np.maximum(passed.sum(axis=0), 1)
        places = np.where(passed[:, None], places, film_mm).astype(np.float32)
        return SpectralRays(rays, np.where(passed, share, 0).astype(np.float32), places)

    def natural(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> FloatArray:
        """Return the part of the weights that is the camera's own natural fall-off."""
        return np.asarray(self.camera.natural(self._base(film_mm, wavelength_nm), pupil, self._reference(film_mm)))

    def to_film(self, point_m: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> FilmPoints:
        """Return film points of the reference wavelength, moved to where the given wavelengths are shown."""
        found = self._tinted(self.camera.to_film(point_m, pupil, self._reference(point_m)), wavelength_nm)
        shift = self._shifts(found.film_mm, wavelength_nm[None])[0]
        return replace(found, film_mm=found.film_mm + shift * (found.weight > 0))

    def _reference(self, rays: FloatArray) -> FloatArray:
        """Return the reference wavelength for every ray [R, N]."""
        return np.full(rays.shape[1], self._nm, np.float32)

    def _exposure(self, nm: float) -> float:
        """Return the mean weight, at a wavelength, of the rays of the film point on the axis."""
        square, _ = stratified(_SIDE_OF_AXIS, (nm, nm))
        film, light = np.zeros_like(square) + self._axis, np.full(square.shape[1], nm, np.float32)
        return float(self.camera.sample(film, square, light).weight.mean(dtype=np.float64))

    def tints(self, wavelength_nm: FloatArray) -> FloatArray:
        """Return the light [N] on the axis at wavelengths [N] (nm), over that at the reference wavelength."""
        return np.interp(np.nan_to_num(wavelength_nm), self._lit_nm, self._tint).astype(np.float32)

    def _tinted(self, rays: Any, wavelength_nm: FloatArray) -> Any:
        light = is_light(wavelength_nm)  # else a ray would hide that its wavelength is none
        status = np.where(light, rays.status, np.int32(st.OUTSIDE_DOMAIN))
        return replace(rays, weight=rays.weight * self.tints(wavelength_nm) * light, status=status)

    def _base(self, film_mm: FloatArray, wavelength_nm: FloatArray) -> FloatArray:
        """Return the film points that show, at the reference wavelength, what the given points show at theirs."""
        # Over its own length the shift changes by a thousandth of itself, so it is not evaluated again at the other
        # end.
        return film_mm - self._shifts(film_mm, wavelength_nm[None])[0] if self.lateral else film_mm

    def _shifts(self, film_mm: FloatArray, wavelength_nm: FloatArray) -> FloatArray:
        """Return the shift [W, 2, N] from film points of the reference wavelength to those of others [W, N]."""
        shift = np.zeros((len(wavelength_nm), *film_mm.shape), np.float32)
        if not self.lateral:
            return shift
        # From the axis, about which a lens is symmetric; beyond the film the polynomials mean nothing.
        at = np.clip((film_mm - self._axis) / (2 * self._reach), -1, 1)
        parts = (self._terms @ _monomials(at)).reshape(2, _ORDERS, -1) * at[:, None]
        wave = self._wave(wavelength_nm)[:, None]
        for order in range(_ORDERS)[::-1]:
            shift += parts[:, order]
            shift *= wave
        return shift

    def _wave(self, wavelength_nm: Any) -> Any:
        """Return the variable that stands for wavelengths; it is 0 at the wavelength of the rays."""
        with np.errstate(divide="ignore"):  # what is no light has no rays
            wave = np.square(1000 / wavelength_nm) - (1000 / self._nm) ** 2
        return np.clip(np.nan_to_num(wave), -10, 10).astype(np.float32)

    def _fit(self, light_nm: tuple[float, float]) -> None:
        """Fit the shift to that of rays at film points all over the film; every second point measures the error."""
        random = np.random.default_rng(0)
        film = (random.random((2, _POINTS)) - 0.5) * np.array(self.film_mm)[:, None]
        square = np.repeat(stratified(_SIDE, light_nm)[0].astype(np.float64)[:, None], _POINTS, axis=1)
        step = _STEP * self.film_mm[0], _STEP * self.film_mm[1]
        waves = np.linspace(*light_nm, _WAVES)
        found = np.stack([film_shift(self.camera, film, square, float(nm), self._nm, step) for nm in waves])
        lit = np.isfinite(found).all(axis=(0, 1))
        if not lit.any():
            raise InputError(self.name, "dispersion", "lateral", "a camera that light can pass")
        shift, at = found[..., lit], ((film - self._axis) / (2 * self._reach))[:, lit]
        train = np.arange(at.shape[1]) % 2 == 0
        powers = self._wave(waves)[:, None] ** np.arange(1, _ORDERS + 1)
        products = np.einsum("wo,mn->womn", powers, _monomials(at))
        terms, left = [], np.empty_like(shift)
        for row in (0, 1):  # odd along the shift, even across it
            part = (products * at[row]).reshape(_WAVES, -1, at.shape[1])
            flat = part[..., train].transpose(0, 2, 1).reshape(-1, part.shape[1])
            terms.append(np.linalg.lstsq(flat, shift[:, row, train].reshape(-1), rcond=1e-10)[0])
            left[:, row] = shift[:, row] - np.einsum("wtn,t->wn", part, terms[row])
        self._terms = np.concatenate(terms).reshape(2 * _ORDERS, -1).astype(np.float32)
        self.settings["lateral_error_mm"] = float(np.sqrt(np.mean(np.sum(left[..., ~train] ** 2, axis=1))))
        reach = _BEYOND * np.ptp(shift, axis=0).max(axis=1) + 1e-6
        self.companion_reach_mm = float(reach[0]), float(reach[1])


def _monomials(at: Array) -> Array:
    """Return the products [M, N] of even powers of x and of y, for points [2, N]."""
    half = _DEGREE // 2 + 1
    square = at * at
    powers = np.cumprod([np.ones_like(square), *[square] * (half - 1)], axis=0)
    return np.stack([powers[a][0] * powers[b][1] for a in range(half) for b in range(half - a)])


VIGNETTINGS: tuple[str, ...] = get_args(Vignetting)

# Rings, azimuths, and samples a side of the tables, for round cameras and for others.
_ROUND, _OTHER = (129, 1, 64), (33, 36, 24)
# Where roundness is tried: radii, and azimuths of which none is another's mirror image; and how far values of a round
# camera may differ, as a share of the largest.
_TRIED, _AROUND, _UNEVEN = (0.5, 0.8, 0.95), np.exp(0.83j * np.arange(7)), 0.01
_BATCH = 1 << 17


class Vignetted:
    """A camera with its vignetting switched off, in part or as a whole; see the module.

    Args:
        camera: one with `natural`, as all of this package have.
        vignetting: the part that is kept.
        wavelength_nm: range of the light, over which the means are taken.

    Raises:
        InputError: an unknown kind of vignetting.
    """

    def __init__(self, camera: Any, vignetting: str = "none", wavelength_nm: tuple[float, float] = LIGHT_NM) -> None:
        if vignetting not in VIGNETTINGS:
            raise InputError("camera", "vignetting", vignetting, f"one of: {', '.join(VIGNETTINGS)}")
        self.camera, self.vignetting = camera, vignetting
        self.name, self.film_mm, self.wavelength_nm = camera.name, camera.film_mm, camera.wavelength_nm
        self.dispersive, self.achromatic = camera.dispersive, getattr(camera, "achromatic", False)
        self.lateral = getattr(camera, "lateral", False)
        self.rays_a_call = getattr(camera, "rays_a_call", RAYS_A_CALL)
        self.settings: dict[str, Any] = {**camera.settings, "vignetting": vignetting}
        light = common_light(camera.wavelength_nm or wavelength_nm, wavelength_nm)
        axis, reach = axis_mm(camera)
        self._axis, corner = complex(*axis), 1.0001 * math.hypot(*reach)

        def means(from_axis: Complex, side: int) -> tuple[Array, Array]:
            return _means(camera, light, self._axis + from_axis.reshape(-1), side)

        self._end = end_of_light(lambda r: bool((means(r * _AROUND, 16)[0] > 0).any()), corner)
        tried = means(self._end * np.array(_TRIED)[:, None] * _AROUND, _OTHER[2])[0]
        uneven = np.ptp(tried.reshape(len(_TRIED), -1), axis=1) > _UNEVEN * tried.max()
        rings, azimuths, side = _OTHER if uneven.any() else _ROUND
        radius = self._end * (1 - (1 - np.arange(rings) / (rings - 1)) ** 2)
        found = means(radius[:, None] * turns(azimuths), side)
        value, optical = (m.reshape(rings, azimuths) for m in found)
        optical /= optical[0].mean()
        natural = np.where(optical > 0, value / np.where(optical > 0, optical, 1) / value[0].mean(), np.nan)
        for row in range(1, rings):  # where it is dark, the value is that where light was last
            natural[row] = np.where(np.isnan(natural[row]), natural[row - 1], natural[row])
        self._cards = {"natural": natural, "optical": optical, "none": np.ones_like(value), "both": value}

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Return the camera's rays, with weights that have only the vignetting that is kept."""
        return self._weighed(self.camera.sample(film_mm, pupil, wavelength_nm), film_mm)

    def sample_differentials(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Sample rays as `sample` does, and give their differentials too."""
        return self._weighed(self.camera.sample_differentials(film_mm, pupil, wavelength_nm), film_mm)

    def sample_spectrum(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> SpectralRays:
        """Return the camera's rays of several wavelengths; the weight of each has only the vignetting that is kept."""
        found = self.camera.sample_spectrum(film_mm, pupil, wavelength_nm)
        passed = found.weight > 0
        factor = np.stack([self._factors(p, film) for p, film in zip(passed, found.film_mm, strict=True)])
        # Wavelengths share a ray in proportion to their factors, as if those were the densities with which they would
        # draw it. In equal shares, a companion at the end of the light would have an unbounded weight.
        share = passed.sum(axis=0) * factor[0] / np.maximum(factor.sum(axis=0), 1e-30)
        return replace(found, weight=(found.weight * factor * share).astype(np.float32))

    @property
    def companion_reach_mm(self) -> tuple[float, float] | None:
        """Return the `companion_reach_mm` of the camera inside; None if that camera cannot place companions."""
        return getattr(self.camera, "companion_reach_mm", None)

    def to_film(self, point_m: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> FilmPoints:
        """Return the camera's film points, with weights that have only the vignetting that is kept."""
        return self._weighed(found := self.camera.to_film(point_m, pupil, wavelength_nm), found.film_mm)

    def _weighed(self, rays: Any, film_mm: FloatArray) -> Any:
        return replace(rays, weight=(rays.weight * self._factors(rays.weight > 0, film_mm)).astype(np.float32))

    def _factors(self, passed: NDArray[np.bool_], film_mm: FloatArray) -> Array:
        """Return the factors of the weights of rays; 0 where none passes or the table is dark."""
        x, y = np.nan_to_num(film_mm.astype(np.float64), posinf=1e9, neginf=-1e9)
        off = x + 1j * y - self._axis
        radius = np.abs(off)
        place = 1 - np.sqrt(1 - np.minimum(radius / self._end, 1))  # rings are equal steps of it
        point = off / np.where(radius > 0, radius, 1) * place
        value, wanted = (on_rings(table, 1.0, point) for table in (self._cards["both"], self._cards[self.vignetting]))
        lit = (value > 0) & passed
        return np.where(lit, np.maximum(wanted, 0) / np.where(lit, value, 1), 0)


def _means(camera: Any, light_nm: tuple[float, float], point: Complex, side: int) -> tuple[Array, Array]:
    """Return V and <T> A at film points [M], with one wavelength for each sample."""
    square, wavelength = stratified(side, light_nm)
    count, film = square.shape[1], np.stack([point.real, point.imag]).astype(np.float32)
    value, optical = np.zeros(point.size), np.zeros(point.size)
    step = max(1, _BATCH // count)
    for start in range(0, point.size, step):
        part = film[:, start : start + step]
        rays = np.repeat(part, count, axis=1), np.tile(square, part.shape[1]), np.tile(wavelength, part.shape[1])
        weight, natural = camera.sample(*rays).weight, camera.natural(*rays)
        area = np.where(weight > 0, weight / np.where(natural > 0, natural, 1), 0)
        for means, values in ((value, weight), (optical, area)):
            means[start : start + step] = values.reshape(part.shape[1], count).mean(1, dtype=np.float64)
    return value, optical


class Warped:
    """An ideal camera whose picture is warped by ST maps of a lens's plane field, and has the lens's light.

    Args:
        flat: pinhole, thin or thick lens, with the same film.
        camera: the one to be shown.
        focus_m: from the film to the plane that the maps are of.

    Attributes:
        sides: width and height of the picture before it is warped, over those of the film. area: of that picture, over
            the film's.

    Raises:
        InputError: a camera that sees some of the film's edge beyond `WIDEST_DEG`, or not at all.
    """

    def __init__(self, flat: Camera, camera: Camera, focus_m: float) -> None:
        self.name, self.film_mm, self.settings = f"{flat.name}, warped", flat.film_mm, flat.settings
        self.wavelength_nm, self.dispersive = flat.wavelength_nm, flat.dispersive
        self.achromatic = getattr(flat, "achromatic", False)
        self._flat, self._focus_m = flat, focus_m
        self._frames = {id(c): frame_of(c) for c in (flat, camera)}
        self._shown = camera
        self._axis = {id(c): self._traced(c, on_axis(c))[1][0] for c in (flat, camera)}
        near, own, frame = 1e-3 / focus_m, self._frames[id(flat)], self._frames[id(camera)]
        # Sizes of things in focus, of the one over the other: 1, except in the second meridian of a lens with
        # cylinders.
        self._size = [
            (1 - near * before) / reach * own_reach / (1 - near * own_before)
            for before, reach, own_before, own_reach in zip(
                frame.pupil_mm, frame.reach_mm, own.pupil_mm, own.reach_mm, strict=True
            )
        ]
        ideal, light = self._traced(camera, film_edge(self.film_mm) / BEYOND)
        if not ((light > 0) & (np.abs(ideal) < math.tan(math.radians(WIDEST_DEG)) * max(frame.reach_mm))).all():
            expected = "a film within the image circle, and a narrower field"
            raise InputError(camera.name, "film_mm", self.film_mm, expected)
        before = self._before(ideal)
        # The picture reaches beyond the film's edge, too, which distortion moves farther out than points within it.
        self.sides = 2 * BEYOND**2 * np.array([np.abs(before.real).max(), np.abs(before.imag).max()]) / self.film_mm
        self.area = float(np.maximum(self.sides, 1.0).prod())

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Return rays for film points [2, N] in mm, as the ideal camera has them."""
        each, back = np.unique(-(film_mm[0] + 1j * film_mm[1]).astype(np.complex128), return_inverse=True)
        ideal, light = self._place_and_light(self._shown, each)
        place = self._before(ideal)
        flat = self._place_and_light(self._flat, place)[1]
        light = np.where(flat > 0, light / np.where(flat > 0, flat, 1), 0)  # dark where the flat picture ends
        film = -np.stack([place.real, place.imag])[:, back].astype(np.float32)
        rays = self._flat.sample(np.ascontiguousarray(film), pupil, wavelength_nm)
        return replace(rays, weight=rays.weight * light[back].astype(np.float32))

    def _place_and_light(self, camera: Camera, point: Complex) -> tuple[Complex, Array]:
        """Return the undistorted places of picture points, and their light over that on the axis."""
        ideal, light = self._traced(camera, point)
        return ideal, light / self._axis[id(camera)]

    def _traced(self, camera: Camera, point: Complex) -> tuple[Complex, Array]:
        frame = self._frames[id(camera)]
        traced = traced_light(camera, point, spectrum_of(camera), frame, RECTILINEAR, self._focus_m)
        return traced.place, traced.light

    def _before(self, ideal: Complex) -> Complex:
        """Return places in the ideal camera's picture, mm."""
        return np.asarray(self._size[0] * ideal.real + 1j * (self._size[1] * ideal.imag))
