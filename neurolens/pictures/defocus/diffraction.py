"""Diffraction for pictures that are made of rays: each zone of the field is spread by the waves of its exit pupil.

Rays place light as geometry does, and waves then spread it. The blur of a point is here the blur of its rays convolved
with the point spread that the same pupil (stop, blades, rims) has without aberrations. Far out of focus and near a
perfect focus this is what sums of waves give; between, where aberrations are about a wave, it spreads too much. The
pupil hardly depends on the depth of things, so that one kernel serves all depths of a zone. A zone of a turned film has
the kernel of the upright film where the pupil sees it, as the turned film cuts that light (`_cut`): at 20 degrees the
width is within 1% of that of waves summed on the turned film, for things that are sharp there. Kernels reach out to 118
radii of Airy's disc or 127 pixels, whichever is less, and hold the streaks of blades so far; the light beyond is put
back into them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.base.settings import LIGHT_NM
from neurolens.cameras.contract import Camera, FloatArray
from neurolens.optics.lens.prescription import Lens
from neurolens.pictures.defocus.plate import channel_wavelengths

Array = NDArray[np.float64]
Channels = dict[str, tuple[float, ...]]
Place = tuple[float, float]
MOST_PX = 255  # pixels along a side of the point spread
_COLOURS = 3  # wavelengths in a channel of a sensor
_ZONES = (5, 3)
_STEP_MM = 1e-3  # of differences on the film
_REACH = 72  # wavelengths over the half width of the pupil, in cosines: what the finest grid resolves


def channels_of(kind: str, lens: Lens) -> Channels:
    """Return the wavelengths of channels: R, G and B ("rgb"), or Y, all of these ("mono").

    They share the light of each channel equally, as the film responds to it. A lens that is made for other light has
    the wavelengths of its file in Y.
    """
    if not lens.visible:
        return {"Y": lens.wavelengths_nm}
    found = channel_wavelengths(((np.arange(_COLOURS) + 0.5) / _COLOURS).astype(np.float32), *LIGHT_NM)
    colours = {name: tuple(np.round(nm, 1).tolist()) for name, nm in zip("RGB", found.astype(float), strict=True)}
    return colours if kind == "rgb" else {"Y": tuple(nm for waves in colours.values() for nm in waves)}


def places_of(film_mm: Place, grid: tuple[int, int]) -> tuple[Place, ...]:
    """Return the middles of equal parts of the picture, row by row from the top: right and up, in mm."""
    right, up = (size * ((np.arange(n) + 0.5) / n - 0.5) for size, n in zip(film_mm, grid, strict=True))
    return tuple((x, y) for y in up[::-1].tolist() for x in right.tolist())


def spreads(
    lens: Lens, distance_m: float, places_mm: Sequence[Place], channels: Sequence[Sequence[float]], pixel_mm: float,
    side: int | None = None, model: Any = None, perfect: bool = False,
) -> list[Any]:  # fmt: skip
    """Return the `Spread` of each place of the upright picture, by channel; the middle is (right, up), too.

    Places that are mirror images of each other are computed once, where lens and stop are symmetric.

    Args:
        lens: its film is placed. distance_m: of objects from the film. places_mm: (right, up) in the picture.
        channels: wavelengths of each. side: pixels; None takes what holds the light.
        model: of the lens, with optical path, whose rays are taken. perfect: without the aberrations of the lens.
    """
    from neurolens.optics.analysis.diffraction import pupils_at, reach_of, spread
    from neurolens.optics.analysis.fields import Scene

    film = -np.array(places_mm)  # the picture is upright, the image on the film is not
    symmetric = lens.aperture is None and not lens.decentred
    unique, number = np.unique((np.abs(film) if symmetric else film).round(9), axis=0, return_inverse=True)
    waves = sorted({nm for some in channels for nm in some})
    middle = channels[len(channels) // 2]
    waves.insert(0, waves.pop(waves.index(sorted(middle)[len(middle) // 2])))  # the reference comes first
    weights = np.array([[nm in some for nm in waves] for some in channels], np.float64)
    scene = Scene(lens, distance_m)
    if model is not None:
        from neurolens.models.wavefront import model_pupils

        pupils = model_pupils(model, scene, unique, waves)
    elif lens.round:
        pupils = pupils_at(scene, unique, waves)
    else:
        from neurolens.pictures.flare.exit_pupil import pupils_seen

        pupils = pupils_seen(lens, distance_m, unique, waves)
    if perfect:
        pupils = [[p and p.perfect() for p in some] for some in pupils]
    if side is None:
        reach = max(reach_of(some) for some in pupils)
        if perfect:
            widest = max((float(p.half.max()) for some in pupils for p in some if p), default=1.0)
            reach = max(_REACH * min(waves) * 1e-6 / widest - 1.5 * pixel_mm, 0)
        side = min(2 * math.ceil(reach / pixel_mm) + 1, MOST_PX)
    found = [spread(some, weights, pixel_mm, side) for some in pupils]
    turned = []
    for place, k in zip(film, number.reshape(-1), strict=True):
        x, y = (-1 if a < -1e-9 and symmetric else 1 for a in place)
        light = found[k].light[:, ::y, ::-x]  # columns of the picture run against x
        turned.append(found[k]._replace(light=light, centre_mm=-found[k].centre_mm * (x, y)))
    return turned


@dataclass(frozen=True)
class Diffraction:
    """The diffraction of a picture.

    Attributes:
        kernels: [rows, columns, 3, side, side], each of the sum 1, of equal parts of the picture.
        size: of the picture in pixels. channels: wavelengths of each.
    """

    kernels: Array
    size: tuple[int, int]
    channels: tuple[tuple[float, ...], ...]

    @classmethod
    def of(
        cls, camera: Camera, size: tuple[int, int], wavelengths_nm: tuple[float, float, float] | None = None
    ) -> Diffraction:
        """Return the diffraction of a camera's picture, whose size is width and height in pixels.

        `wavelengths_nm`: one wavelength for red, green and blue each, in place of those that make white light.

        Raises:
            InputError: the camera is no lens.
        """
        lens = lens_of(camera)
        channels = [(nm,) for nm in wavelengths_nm] if wavelengths_nm else list(channels_of("rgb", lens).values())
        low, high = camera.wavelength_nm or (0.0, math.inf)
        channels = [tuple(min(max(nm, low), high) for nm in some) for some in channels]
        focus_m = camera.settings.get("focus_m") or math.inf
        places, pixel_mm = on_upright(camera, places_of(camera.film_mm, _ZONES)), camera.film_mm[0] / size[0]
        made = np.array([s.light for s in spreads(lens, focus_m, places, channels, pixel_mm, perfect=True)])
        if camera.film.pose.turned:  # type: ignore[attr-defined]
            made = np.array([_cut(camera, *each) for each in zip(places_of(camera.film_mm, _ZONES), made, strict=True)])
        made = np.broadcast_to(made, (len(made), 3, *made.shape[2:])).copy()
        dark = made.sum((2, 3)) == 0
        made[dark, made.shape[2] // 2, made.shape[3] // 2] = 1
        made /= made.sum((2, 3), keepdims=True)
        return cls(made.reshape(_ZONES[1], _ZONES[0], *made.shape[1:]), size, tuple(channels))

    @property
    def reach_px(self) -> int:
        """Return how many pixels away a point sends light."""
        return int(self.kernels.shape[-1] // 2)

    def __call__(self, picture: FloatArray, began: int = 0) -> FloatArray:
        """Return a picture [H, W, 3] of linear light after diffraction; beyond its edges it is as at them.

        `began`: its first row in the whole picture.
        """
        r, (height, width) = self.reach_px, picture.shape[:2]
        around = np.pad(picture.astype(np.float64), [(r, r), (r, r), (0, 0)], mode="edge").transpose(2, 0, 1)
        found = np.zeros_like(around)
        columns, rows = (
            list(shares((np.arange(n) + 0.5) / n, (np.arange(first - r, first + count + r) + 0.5) / pixels))
            for n, pixels, first, count in zip(_ZONES, self.size, (0, began), (width, height), strict=True)
        )
        wide = np.pad(found, [(0, 0), (r, r), (r, r)])
        for j, (top, bottom), down in rows:
            for i, (left, right), across in columns:
                part = around[:, top:bottom, left:right] * (down[:, None] * across)
                shape = bottom - top + 2 * r, right - left + 2 * r
                spectrum = np.fft.rfft2(part, shape) * np.fft.rfft2(self.kernels[j, i], shape)
                wide[:, top : bottom + 2 * r, left : right + 2 * r] += np.fft.irfft2(spectrum, shape)
        kept = wide[:, 2 * r : 2 * r + height, 2 * r : 2 * r + width]
        return np.asarray(kept.transpose(1, 2, 0), np.float32)

    def at(self, place_px: Place) -> Array:
        """Return the kernel [3, side, side] of a place of the picture (column, row)."""
        columns, rows = (
            np.array([np.interp(at / pixels, (np.arange(n) + 0.5) / n, unit) for unit in np.eye(n)])
            for n, at, pixels in zip(_ZONES, place_px, self.size, strict=True)
        )
        return np.einsum("j,i,jicyx->cyx", rows, columns, self.kernels)


def on_upright(camera: Any, places_mm: Sequence[Place]) -> list[Place]:
    """Return where places of a picture (right, up) lie on the upright film behind its film, seen from the pupil."""
    pose = camera.film.pose
    x, y, depth = pose.axes[:, :2] @ (-np.array(places_mm) - pose.moved_mm).T
    away = np.maximum(1 + depth / camera.film.distance_mm, 0.1)  # the film of a short lens may reach its pupil
    return list(zip((-x / away).tolist(), (-y / away).tolist(), strict=True))


def _cut(camera: Any, place_mm: Place, kernels: Array) -> Array:
    """Return kernels [C, side, side] of the upright film as the film of a camera cuts their light at a place."""
    from neurolens.optics.analysis.diffraction import stretched

    down, right = np.array([[0, -_STEP_MM], [_STEP_MM, 0]])
    ends = np.array(on_upright(camera, [np.add(place_mm, d) for d in (down, -down, right, -right)]))
    moves = (ends[::2] - ends[1::2])[:, ::-1].T * [[-1], [1]] / (2 * _STEP_MM)  # of row and column by row and column
    return np.asarray(stretched(kernels, moves), np.float64)


def lens_of(camera: Any) -> Lens:
    """Return the lens of a camera as it is set."""
    lens = getattr(camera, "lens", None)
    if lens is None and hasattr(camera, "model") and not any(camera.model.axes):
        film, stop = camera.film.film_z_mm, camera.film.scene.stop_radius_mm
        lens = replace(
            camera.model.fitted.lens.with_stop_radius(stop), film_z_mm=film, aperture=camera.film.scene.aperture
        )
    if lens is None:
        raise InputError(camera.name, "--diffraction", f"({camera.name})", "a lens file or a model of one")
    return lens


def shares(places: Any, at: Any) -> Iterator[tuple[int, tuple[int, int], Any]]:
    """Give, for each place with a share of points: its number, its first point and the one after its last, shares."""
    for k, unit in enumerate(np.eye(len(places))):
        share = np.interp(at, places, unit)
        some = np.nonzero(share)[0]
        if len(some):
            first, last = int(some[0]), int(some[-1]) + 1
            yield k, (first, last), share[first:last]
