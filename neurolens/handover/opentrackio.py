"""OpenTrackIO 1.0.1 samples: the numbers of OpenLensIO's lens model (SMPTE RiS-OSVP), in mm on the film.

Undistorted places are e (1 + k1 r^2 + k3 r^4 + k5 r^6) / (1 + k2 r^2 + k4 r^4 + k6 r^6) of places e of the lens's
picture (the list "radial" of "Brown-Conrady D-U"; "U-D" is the other way), for a pinhole in the entrance pupil. Light
is 1 - (a1 r^2 + a2 r^4 + a3 r^6). A template has the rest of a sample. It leaves out where the camera stands, which its
tracker knows; a focus at infinity; lateral colour; distortion of lenses with cylinders or of more than a plane holds.
"""

from __future__ import annotations

import uuid
from fractions import Fraction

import numpy as np

from neurolens.analysis import projections
from neurolens.base.html import html
from neurolens.cameras.field import Complex, Field
from neurolens.handover.shot import FAR_M, Handed, Pinhole, falloff, film_points

MODELS = "Brown-Conrady D-U", "Brown-Conrady U-D"
_POINTS = 61, 41  # over the film, of light
_GOOD_PX = 0.1  # a polynomial that leaves more gives way to a ratio of two
_LEAST = 1e-5  # singular value over the largest: below it coefficients grow until they cancel, and the ratio has poles


def sample(field: Field, pinhole: Pinhole, shot: Handed) -> tuple[str, float | None, float]:
    """The sample of one frame as JSON, and the worst that its formulae leave: pixels, share of light."""
    plane = field.field_deg <= projections.WIDEST_DEG and pinhole.squeeze == 1
    distortion, left_px = _distortions(field, shot) if plane else ([], None)
    points = _lit(field, shot)
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
    """Names of both directions with their coefficients, and the worst that they leave in pixels; of a round lens."""
    points = film_points(field, shot.film_mm(shot.plates.picture), 257)
    way = field.directions(points)
    both, found, worst = (points.real, field.frame.reach_mm[0] * way[0] / way[2]), [], 0.0
    for model, (start, goal) in zip(MODELS, (both, both[::-1]), strict=True):
        powers = np.stack([(start / start[-1]) ** n for n in (2, 4, 6)])
        ratio, fits = goal / start, []
        for terms in (powers, np.concatenate([powers, -ratio * powers])):
            k = np.zeros(6)
            k[: len(terms)] = np.linalg.lstsq((start * terms).T, goal - start, rcond=_LEAST)[0]
            missed = np.abs((1 + k[:3] @ powers) / (1 + k[3:] @ powers) - ratio) * start
            by_mm = k.reshape(2, 3) / start[-1] ** np.array([2, 4, 6])
            fits.append((float(missed.max()) / shot.plates.pixel_mm[0], by_mm))
            if fits[-1][0] < _GOOD_PX:
                break
        left, radial = min(fits, key=lambda fit: fit[0])
        found.append((model, radial.T.reshape(-1).tolist()))
        worst = max(worst, left)
    return found, worst


def _lit(field: Field, shot: Handed) -> Complex:
    """Points of the film that light reaches."""
    film = shot.film_mm(shot.plates.picture, squeezed=True)
    x, y = np.meshgrid(*(np.linspace(-0.5, 0.5, n) * side for n, side in zip(_POINTS, film, strict=True)))
    points = np.asarray(x + 1j * y, np.complex128).reshape(-1)
    return points[field.lit(points)]
