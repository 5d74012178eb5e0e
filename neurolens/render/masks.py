"""Apertures from what people write: a number of blades, or a picture of the opening."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from neurolens.base.errors import InputError
from neurolens.optics.apertures import MAX_MASK, THRESHOLD, Aperture


def make_aperture(
    blades: int | None = None,
    rotation_deg: float | None = None,
    curvature: float | None = None,
    mask: str | Path | None = None,
) -> Aperture | None:
    """The stop's shape of a command line or a scene; None where nothing is said.

    Raises:
        InputError: blades and a mask together, a rotation or curvature of nothing, a picture that cannot be read.
    """
    if blades is None and mask is None:
        if rotation_deg is None and curvature is None:
            return None
        raise InputError("aperture", "blades", "(missing)", "a number of blades, or a mask, that the others shape")
    if blades is not None and mask is not None:
        raise InputError("aperture", "mask", str(mask), "blades or a mask, not both")
    if mask is not None and curvature is not None:
        raise InputError("aperture", "curvature", curvature, "left out: a mask has no blades")
    opening = None if mask is None else read_mask(mask)
    return Aperture(blades, rotation_deg or 0.0, curvature or 0.0, opening)


def read_mask(path: str | Path) -> NDArray[np.bool_]:
    """The opening that a picture shows, [H, W] bool: light passes where it is brighter than half, and opaque.

    Grey means no half transmission: a ray passes or it does not. The longer side of the picture spans the stop.

    Raises:
        InputError: a picture that is missing, cannot be read, is too large, or dark all over.
    """
    try:
        with Image.open(path) as picture:
            if max(picture.size) > MAX_MASK:
                raise InputError(path, "mask", picture.size, f"a picture of at most {MAX_MASK} pixels a side")
            grey = np.asarray(picture.convert("LA"), np.float32) / 255
    except FileNotFoundError:
        raise InputError(path, "mask", "(missing)", "a picture") from None
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(path, "mask", f"({error})", "a picture that can be read") from None
    opening = grey[..., 0] * grey[..., 1] >= THRESHOLD
    if not opening.any():
        raise InputError(path, "mask", "(dark everywhere)", "an opening brighter than half")
    return np.asarray(opening)
