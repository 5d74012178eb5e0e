"""OpenTrackIO 1.0.1 samples, with the lens model of OpenLensIO (SMPTE RiS-OSVP).

The model, in mm on the film about its centre, y down: undistorted places are e (1 + k1 r^2 + k3 r^4 + k5 r^6) / (1 + k2
r^2 + k4 r^4 + k6 r^6) of places e of the lens's picture (the list "radial" of "Brown-Conrady D-U"; "U-D" is the other
way), for a pinhole of the focal length F in the entrance pupil. Light is 1 - (a1 r^2 + a2 r^4 + a3 r^6).

What is not said: where the camera stands, which its tracker knows; a focus at infinity; distortion of lenses with
cylinders, or seen beyond a plane; lateral colour.
"""

from __future__ import annotations

import math
import uuid
from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import numpy as np

from neurolens.analysis import projections
from neurolens.cameras.field import Field
from neurolens.handover.shot import FAR_M, Handed, Pinhole, falloff, film_radii

MODELS = "Brown-Conrady D-U", "Brown-Conrady U-D"
_GOOD_PX = 0.1  # a polynomial that leaves more gives way to a ratio of two, whose terms nearly cancel
_POINTS = (61, 41), (50, 34)  # over the film: fitted, held out


def distortions(field: Field, pinhole: Pinhole, handed: Handed) -> tuple[list[dict[str, Any]], float]:
    """Both directions of the distortion, and the worst that they leave in pixels; none of what no plane holds."""
    if field.field_deg > projections.WIDEST_DEG or pinhole.squeeze != 1:
        return [], 0.0
    focal, pixel = field.frame.reach_mm[0], handed.plates.pixel_mm[0]
    film = [n * pixel for n in handed.plates.picture]
    found, worst = [], 0.0
    overscan = max(1.0, *handed.plates.overscan)
    pairs = []
    for across, up in _POINTS:
        x, y = np.meshgrid(np.linspace(-0.5, 0.5, across) * film[0], np.linspace(-0.5, 0.5, up) * film[1])
        point = (x + 1j * y).reshape(-1)
        point = point[field.lit(point)]
        way = field.directions(point)
        pairs.append((point, (way[0] + 1j * way[1]) / way[2] * focal))
    for model, order in zip(MODELS, (1, -1), strict=True):
        (source, goal), (tried, meant) = (pair[::order] for pair in pairs)
        slope, wanted, tries, means = (np.stack([v.real, v.imag], 1) for v in (source, goal, tried, meant))
        size, fits = focal / pixel, []
        for kind in projections.PLANAR:  # the same formulae, of slopes and pixels
            fitted = projections.fit(
                kind, _ways(slope / focal), wanted / pixel - 0.5, (0, 0), (size, size), handed.lens, keep_focal=True
            )
            left = projections.residual(fitted, _ways(tries / focal), means / pixel - 0.5).worst_px
            fits.append((left, (*fitted.coefficients, 0.0, 0.0, 0.0)[:8]))
            if left < _GOOD_PX:
                break
        left, (k1, k2, _, _, k3, k4, k5, k6) = min(fits)
        worst = max(worst, left)
        radial = [k / focal**n for k, n in ((k1, 2), (k4, 2), (k2, 4), (k5, 4), (k3, 6), (k6, 6))]
        found.append({"model": model, "radial": radial, "overscan": overscan})
    return found, worst


def _ways(slope: Any) -> Any:
    return np.concatenate([slope, np.ones_like(slope[:, :1])], 1)


def sample(
    field: Field, pinhole: Pinhole, handed: Handed, attributes: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, float]]:
    """The sample of one frame, and the worst that its formulae leave: pixels, share of light.

    Args:
        attributes: of the camera, see `render.pictures.standard_attributes`.
    """
    film = [n * p for n, p in zip(handed.plates.picture, handed.plates.pixel_mm, strict=True)]
    distortion, distortion_px = distortions(field, pinhole, handed)
    radius = film_radii(field, (film[0], film[1]))
    (a1, a2, a3), share = falloff(field.relative_light(radius + 0j), radius)
    lens: dict[str, Any] = {
        "distortion": distortion or None,
        "entrancePupilOffset": pinhole.pupil_mm / 1000,
        "exposureFalloff": {"a1": -a1, "a2": -a2, "a3": -a3},
        "fStop": attributes.get("aperture"),
        "tStop": pinhole.t_stop,
        "pinholeFocalLength": pinhole.focal_mm,
        "focusDistance": pinhole.focus_m if pinhole.focus_m < FAR_M else None,
    }
    history = f"neurolens {handed.version}: traced prescription, {handed.lens}"
    static_lens = {
        "distortionOverscanMax": max(1.0, *handed.plates.overscan),
        "make": handed.designer,
        "model": handed.lens,
        "serialNumber": attributes.get("lensSerialNumber"),
        "nominalFocalLength": attributes.get("nominalFocalLength"),
        "calibrationHistory": [history[:1023]],
    }
    camera = {
        "activeSensorPhysicalDimensions": {"width": film[0], "height": film[1]},
        "activeSensorResolution": dict(zip(("width", "height"), handed.plates.picture, strict=True)),
        "anamorphicSqueeze": _rational(pinhole.squeeze),
    }
    rate = dict(zip(("num", "denom"), handed.rate, strict=True))
    told = {
        "static": {"camera": _known(camera), "lens": _known(static_lens)},
        "timing": {"mode": "external", "sampleRate": rate, "sequenceNumber": pinhole.number},
        "lens": _known(lens),
        "protocol": {"name": "OpenTrackIO", "version": [1, 0, 1]},
        "sourceId": _urn(history),
        "sourceNumber": 1,
    }
    told["sampleId"] = _urn(f"{told}")
    return told, {"distortion_px": distortion_px, "light_share": share}


def _rational(value: float) -> dict[str, int]:
    found = Fraction(value).limit_denominator(1000)
    return {"num": max(1, found.numerator), "denom": found.denominator}


def _known(values: Mapping[str, Any]) -> dict[str, Any]:
    """Without what is not known; texts not blank and not longer than the standard takes."""
    found = {k: v[:1023] if isinstance(v, str) else v for k, v in values.items() if v not in (None, "")}
    return {k: v for k, v in found.items() if not (isinstance(v, float) and not math.isfinite(v))}


def _urn(text: str) -> str:
    return uuid.uuid5(uuid.NAMESPACE_URL, f"neurolens:{text}").urn
