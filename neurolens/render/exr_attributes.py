"""Camera and lens in the attributes that OpenEXR defines (3.2 and later), for programs that do not know our JSON.

Lengths of lens and film in mm, pixels in um, the focus in m; definitions: OpenEXR, Standard Attributes. The squeeze of
an anamorphic lens is the pixel's aspect ratio, by which viewers stretch the picture to what was seen. What a camera
does not know is left out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from neurolens import __version__

_LEAST_ASPECT = 1e-5  # of a pixel: the library refuses some less
_SQUARE = 1e-6  # relative, of pixels
_TEXTS = ("camera", "lensMake", "lensModel", "lensSerial", "lensFirmware")  # what the names of texts begin with
_STATE = {
    "nominalFocalLength": "nominal_focal_length_mm",
    "effectiveFocalLength": "effective_focal_length_mm",
    "pinholeFocalLength": "pinhole_focal_length_mm",
    "entrancePupilOffset": "entrance_pupil_offset_mm",
    "aperture": "f_number",
    "tStop": "t_stop",
}


def standard_attributes(
    settings: Mapping[str, Any], width: int | None = None, height: int | None = None, frame: int | None = None
) -> dict[str, Any]:
    """Header values of a picture, of the types that the OpenEXR library wants.

    Args:
        settings: of the camera, as `Camera.settings` has them.
        width, height: of the picture, in pixels; None where pixels are no part of the film, as in maps.
        frame: number of the picture in a sequence.

    Raises:
        KeyError, IndexError, TypeError, ValueError, AttributeError, ArithmeticError: settings of no camera.
    """
    found: dict[str, Any] = {
        "cameraMake": "neurolens",
        "cameraModel": settings.get("camera"),
        "cameraFirmwareVersion": __version__,
        "imageCounter": None if frame is None else int(np.int32(frame)),
        **_lens(settings),
        **({} if width is None or height is None else _film(settings, width, height)),
    }
    typed = {name: _typed(name, value) for name, value in found.items() if value is not None}
    return {name: value for name, value in typed.items() if not _empty(value)}


def _typed(name: str, value: Any) -> Any:
    """A header value of the type of its attribute."""
    if name.startswith(_TEXTS):
        if not isinstance(value, str):
            raise TypeError(f"{name}: {value!r} is no text")
        return value
    return float(value) if name in ("focus", *_STATE) else value


def _lens(settings: Mapping[str, Any]) -> dict[str, Any]:
    card = settings.get("card") or {}
    lens = settings.get("lens") or card.get("lens") or {}
    state = settings.get("lens_state") or {}
    found: dict[str, Any] = {name: state.get(key) for name, key in _STATE.items()}
    # The makers of a published prescription are those who designed it, or who published it.
    found |= {"lensMake": lens.get("designer") or lens.get("source"), "lensModel": lens.get("name")}
    found |= {"lensSerialNumber": lens.get("sha256"), "lensFirmwareVersion": card.get("fit", {}).get("method")}
    if "focus_m" in settings and not _a_point(settings):
        found["focus"] = math.inf if settings["focus_m"] is None else float(settings["focus_m"])
    return found


def _film(settings: Mapping[str, Any], width: int, height: int) -> dict[str, Any]:
    if "film_mm" not in settings:
        return {}
    with np.errstate(over="raise"):
        size = np.array(settings["film_mm"], np.float32)
    across, down = float(size[0]) / width, float(size[1]) / height
    squeeze = (settings.get("lens_state") or {}).get("squeeze") or 1.0
    aspect = across / down
    if not (across > 0 and down > 0 and _LEAST_ASPECT < abs(squeeze * aspect) < 1 / _LEAST_ASPECT):
        raise ValueError(f"a film of {settings['film_mm']} mm, squeezed {squeeze}")
    return {
        "sensorOverallDimensions": size,
        "sensorCenterOffset": np.zeros(2, np.float32),
        "sensorAcquisitionRectangle": (np.zeros(2, np.int32), np.array([width - 1, height - 1], np.int32)),
        "sensorPhotositePitch": 1e3 * across if abs(aspect - 1) < _SQUARE else None,
        "pixelAspectRatio": squeeze if abs(aspect - 1) < _SQUARE else squeeze * aspect,
    }


def _a_point(settings: Mapping[str, Any]) -> bool:
    """Whether everything is in focus."""
    kind = str(settings.get("camera"))
    return kind == "pinhole" or kind.startswith("fisheye-")


def _empty(value: Any) -> bool:
    """A text without letters, a number that is none: the standard wants neither."""
    return value == "" if isinstance(value, str) else isinstance(value, float) and math.isnan(value)
