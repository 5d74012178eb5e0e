"""Bokeh, measured on the discs of single lights: the shape of the stop, cat's eyes, the ovals of anamorphic lenses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.cameras.contract import Camera
from neurolens.evaluate.gallery.measures.lightdiscs import LightDisc, light_disc
from neurolens.evaluate.gallery.measures.view import View

EDGE = 0.8  # of the way to the film's corner: a disc there still lies on the film as a whole
_CELLS = 24  # a side of the grid on which two discs are laid over each other
_SQUARE = 128  # pupil samples a side of a passage rate


def stop_shape(view: View) -> dict[str, float]:
    """How a stop's shape shows: passage on the axis beside its area, corners, near discs turned, discs cut at the edge.

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
    middle = ((np.arange(_SQUARE) + 0.5) / _SQUARE).astype(np.float32)
    square = np.stack([a.ravel() for a in np.meshgrid(middle, middle)])
    rays = camera.sample(np.zeros_like(square), square, np.full(square.shape[1], 587.5618, np.float32))
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
    """Which cells of a grid the disc covers, its size (root mean square radius) and place taken away."""
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
