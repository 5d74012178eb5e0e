"""Pictures that a scene names: textures and environments, bounded before they are decoded."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from neurolens.base.errors import InputError
from neurolens.cameras.contract import FloatArray
from neurolens.render.checks import BRIGHTEST
from neurolens.render.spectrum import srgb_to_linear

LARGEST_PICTURE, LARGEST_ENVIRONMENT = 8192, 4096  # pixels a side


def read_picture(scene: Path, field: str, path: Path, most: int = LARGEST_PICTURE) -> FloatArray:
    """Linear RGB [H, W, 3] of an sRGB picture.

    Raises:
        InputError: names scene file, field and picture, which is missing, too large or broken.
    """
    try:
        with Image.open(path) as picture:
            if max(picture.size) > most:
                raise InputError(scene, field, str(path), f"a picture of at most {most} pixels a side")
            return srgb_to_linear(_encoded(scene, field, path, picture))
    except FileNotFoundError:
        raise InputError(scene, field, str(path), "a picture that exists") from None
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(scene, field, str(path), f"a readable picture ({error})") from None


def _encoded(scene: Path, field: str, path: Path, picture: Image.Image) -> FloatArray:
    """Values [H, W, 3] from 0 to 1 of an 8-bit picture, or a grey one of 16 bits, which Pillow would clip to 8."""
    if picture.mode.startswith("I;16"):
        grey: FloatArray = np.asarray(picture, np.float32) / np.float32(65535)
        return np.stack([grey] * 3, axis=-1)
    if picture.mode in ("I", "F"):
        raise InputError(scene, field, str(path), "a picture of 8 or 16 bits a channel")
    colours: FloatArray = np.asarray(picture.convert("RGB"), np.float32) / np.float32(255)
    return colours


def read_environment(scene: Path, field: str, path: Path, scale: float = 1.0) -> FloatArray:
    """Linear sRGB [H, W, 3] of an equirectangular picture, OpenEXR or whatever Pillow reads; not yet times `scale`.

    Raises:
        InputError: as `read_picture`; also a picture that is not twice as wide as high, values that are negative or not
            finite or brighter than an emission may be, and black all over.
    """
    exr = path.suffix.lower() == ".exr"
    picture = _read_exr(scene, field, path) if exr else read_picture(scene, field, path, LARGEST_ENVIRONMENT)
    height, width = picture.shape[:2]
    if width != 2 * height:
        raise InputError(scene, field, f"({width} x {height} pixels)", "an equirectangular picture, 2 : 1")
    if not np.all((picture >= 0) & np.isfinite(picture)):
        raise InputError(scene, field, str(path), "a picture of finite values, 0 or more")
    if float(picture.max()) * scale > BRIGHTEST:
        expected = f"a picture whose values times scale are at most {BRIGHTEST:g}"
        raise InputError(scene, field, f"({float(picture.max()):g} times {scale:g})", expected)
    if not picture.any():
        raise InputError(scene, field, str(path), "a picture that is not black all over")
    return picture


def _read_exr(scene: Path, field: str, path: Path) -> FloatArray:
    import OpenEXR

    try:
        if not path.is_file():
            raise InputError(scene, field, str(path), "a picture that exists")
        with OpenEXR.File(str(path), header_only=True) as file:
            low, high = file.header()["dataWindow"]
        if max(high[k] - low[k] + 1 for k in range(2)) > LARGEST_ENVIRONMENT:
            raise InputError(scene, field, str(path), f"a picture of at most {LARGEST_ENVIRONMENT} pixels a side")
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.asarray(channel.pixels, np.float32) for name, channel in file.channels().items()}
    except InputError:
        raise
    except Exception as error:  # the binding raises RuntimeError and others
        raise InputError(scene, field, str(path), f"a readable OpenEXR file ({error})") from None
    if not {"R", "G", "B"} <= channels.keys():
        raise InputError(scene, field, f"(channels {', '.join(channels)})", "channels R, G and B")
    return np.stack([channels[name] for name in "RGB"], axis=-1)
