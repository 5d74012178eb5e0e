"""OpenTrackIO 1.0.1 samples: the numbers of OpenLensIO's lens model (SMPTE RiS-OSVP), in mm on the film.

Undistorted places are e (1 + k1 r^2 + k3 r^4 + k5 r^6) / (1 + k2 r^2 + k4 r^4 + k6 r^6) of places e of the lens's
picture (the list "radial" of "Brown-Conrady D-U"; "U-D" is the other way), for a pinhole in the entrance pupil. Light
is 1 - (a1 r^2 + a2 r^4 + a3 r^6). A template has the rest of a sample. It leaves out where the camera stands, which its
tracker knows; a focus at infinity; lateral colour; distortion of lenses with cylinders or of more than a plane holds.
"""

from __future__ import annotations

import uuid
from fractions import Fraction
from typing import Any

import numpy as np

from neurolens.analysis import projections
from neurolens.base.html import html
from neurolens.cameras.field import Array, Complex, Field
from neurolens.handover.shot import FAR_M, Handed, Pinhole, falloff

MODELS = "Brown-Conrady D-U", "Brown-Conrady U-D"
_POINTS = (61, 41), (50, 34)  # over the film: fitted, held out
_GOOD_PX = 0.1  # a polynomial that leaves more gives way to a ratio of two, whose terms nearly cancel


def sample(field: Field, pinhole: Pinhole, shot: Handed) -> tuple[str, float | None, float]:
    """The sample of one frame as JSON, and the worst that its formulae leave: pixels, share of light."""
    plane = field.field_deg <= projections.WIDEST_DEG and pinhole.squeeze == 1
    distortion, left_px = _distortions(field, shot) if plane else ([], None)
    points = _lit(field, shot, _POINTS[0])
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
    """Names of both directions with their coefficients, and the worst that they leave in pixels."""
    focal, pixel, pairs = field.frame.reach_mm[0], shot.plates.pixel_mm[0], []
    for counts in _POINTS:
        point = _lit(field, shot, counts)
        way = field.directions(point)
        pairs.append([np.stack([point.real, point.imag], 1), focal * (way[:2] / way[2]).T])
    found, worst = [], 0.0
    for model, order in zip(MODELS, (1, -1), strict=True):
        (source, goal), (tried, meant) = (pair[::order] for pair in pairs)
        size, fits = focal / pixel, []
        for kind in projections.PLANAR:  # the same formulae, of slopes and pixels
            given = _ways(source / focal), goal / pixel - 0.5, (0, 0), (size, size), shot.lens
            fitted = projections.fit(kind, *given, keep_focal=True)
            left = projections.residual(fitted, _ways(tried / focal), meant / pixel - 0.5).worst_px
            fits.append((left, (*fitted.coefficients, 0.0, 0.0, 0.0)[:8]))
            if left < _GOOD_PX:
                break
        left, (k1, k2, _, _, k3, k4, k5, k6) = min(fits)
        found.append((model, [k / focal**n for k, n in ((k1, 2), (k4, 2), (k2, 4), (k5, 4), (k3, 6), (k6, 6))]))
        worst = max(worst, left)
    return found, worst


def _lit(field: Field, shot: Handed, counts: tuple[int, int]) -> Complex:
    """Points of the film that light reaches."""
    film = shot.film_mm(shot.plates.picture, squeezed=True)
    x, y = np.meshgrid(*(np.linspace(-0.5, 0.5, n) * side for n, side in zip(counts, film, strict=True)))
    points = np.asarray(x + 1j * y, np.complex128).reshape(-1)
    return points[field.lit(points)]


def _ways(slope: Array) -> Any:
    return np.concatenate([slope, np.ones_like(slope[:, :1])], 1)
