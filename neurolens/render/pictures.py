"""Pictures in and out: OpenEXR, the PNG preview, textures, environments, and the masks of apertures.

The OpenEXR library writes garbage for arrays that are not contiguous, changes the header it is given, and refuses
float64 and int32; `write_exr` takes care of all three. What a scene names is bounded before it is decoded.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from neurolens.apertures import MAX_MASK, THRESHOLD, Aperture
from neurolens.base.errors import InputError
from neurolens.base.files import atomic_path
from neurolens.cameras.contract import FloatArray
from neurolens.render.colour import SRGB, ColourSpace, conversion, linear_to_srgb, srgb_to_linear
from neurolens.render.scenetables import BRIGHTEST

METADATA_KEY = "neurolens"
_HALF_MAX = 65504.0
_COLOURS = "RGB"
_DEPTH = "Z"  # the name that other programs know


def write_exr(
    path: str | Path,
    rgb: ArrayLike,
    *,
    half: bool = False,
    metadata: dict[str, Any] | None = None,
    space: ColourSpace = SRGB,
    layers: Mapping[str, ArrayLike] | None = None,
) -> None:
    """Write a picture as OpenEXR: channels R, G and B, then layers, ZIP compression, whole or not at all.

    The attributes chromaticities, adoptedNeutral and colorInteropID say which colour space it is.

    Args:
        path: where to; the folder exists.
        rgb: [H, W, 3] linear sRGB, any real type and memory layout; stored as float32.
        half: store as float16, where values beyond 65504 become 65504.
        metadata: JSON-able settings, kept as one JSON text in the attribute "neurolens".
        space: colour space to store.
        layers: [H, W] more channels by name, always float32, inf allowed; "depth" becomes the channel Z.

    Raises:
        InputError: another shape, no pixels, complex or text, not finite, a layer with NaN or of a colour's name,
            metadata that is not JSON, no such folder, a place that cannot be written.
    """
    path = Path(path)
    picture = np.asarray(rgb)
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.size == 0:
        raise InputError(path, "rgb shape", picture.shape, "[height, width, 3]")
    if picture.dtype.kind not in "fiub":
        raise InputError(path, "rgb type", str(picture.dtype), "real numbers")
    with np.errstate(over="ignore"):
        picture = picture.astype(np.float32, copy=False) if space is SRGB else _in_space(picture, space)
    if not np.all(np.isfinite(picture)):
        raise InputError(
            path, "rgb", f"({int(np.sum(~np.isfinite(picture)))} values not finite)", "finite float32 values"
        )
    try:
        text = json.dumps(metadata or {}, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InputError(path, "metadata", f"({error})", "values that JSON can hold") from None
    if not path.parent.is_dir():
        raise InputError(path, "folder", str(path.parent), "a folder that exists")
    stored = np.clip(picture, -_HALF_MAX, _HALF_MAX).astype(np.float16) if half else picture
    channels = {name: np.ascontiguousarray(stored[..., k]) for k, name in enumerate(_COLOURS)}
    channels |= _layer_channels(path, layers or {}, picture.shape[:2])
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "chromaticities": space.chromaticities,
        "adoptedNeutral": np.array(space.white, np.float32),
        "colorInteropID": space.interop_id,
        METADATA_KEY: text,
    }
    with atomic_path(path) as temporary:
        try:
            OpenEXR.File([OpenEXR.Part(header, channels)]).write(str(temporary))
        except RuntimeError as error:  # the library's only kind; it names the temporary file
            said = str(error).replace(str(temporary), path.name)
            raise InputError(path, "file", f"({said})", "a place that can be written") from None


def _layer_channels(path: Path, layers: Mapping[str, ArrayLike], shape: tuple[int, ...]) -> dict[str, FloatArray]:
    channels = {}
    for name, values in layers.items():
        plane = np.ascontiguousarray(values, np.float32)
        if plane.shape != shape:
            raise InputError(path, f"layer {name}, shape", plane.shape, f"{shape}, the picture's")
        if name in (*_COLOURS, _DEPTH) or np.isnan(plane).any():
            raise InputError(path, f"layer {name}", "(a colour's name, or NaN)", "another name, and numbers")
        channels[_DEPTH if name == "depth" else name] = plane
    return channels


def _in_space(picture: NDArray[Any], space: ColourSpace) -> FloatArray:
    """Linear sRGB [H, W, 3] in another space."""
    with np.errstate(invalid="ignore"):
        return (picture @ conversion(SRGB, space).T).astype(np.float32)


def read_exr(path: str | Path) -> tuple[FloatArray, dict[str, Any]]:
    """A picture [H, W, 3] float32, in the colour space that it was written in, and its metadata, {} without ours.

    Raises:
        InputError: missing, no OpenEXR file, truncated, or without channels R, G and B.
    """
    planes, text = _read_channels(Path(path))
    missing = [name for name in _COLOURS if name not in planes]
    if missing:
        raise InputError(path, "channels", sorted(planes), "R, G and B")
    try:
        metadata = json.loads(text)
    except ValueError:
        raise InputError(path, METADATA_KEY, text, "JSON text") from None
    return np.stack([planes[name] for name in _COLOURS], axis=-1), metadata


def read_layers(path: str | Path) -> dict[str, FloatArray]:
    """The channels [H, W] float32 besides R, G and B by name; Z is called depth.

    Raises:
        InputError: missing, no OpenEXR file, or truncated.
    """
    planes, _ = _read_channels(Path(path))
    return {"depth" if name == _DEPTH else name: plane for name, plane in planes.items() if name not in _COLOURS}


def _read_channels(path: Path) -> tuple[dict[str, FloatArray], str]:
    """All channels as float32, and the text of our metadata."""
    if not path.is_file():
        raise InputError(path, "file", "(missing)", "an OpenEXR file")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            part = file.parts[0]
            planes = {name: np.array(channel.pixels, np.float32) for name, channel in part.channels.items()}
            return planes, part.header.get(METADATA_KEY, "{}")
    except Exception as error:  # the library raises bare RuntimeError, ValueError and its own
        raise InputError(path, "file", f"({error})", "a whole OpenEXR file") from None


def write_png(path: str | Path, rgb: ArrayLike, exposure: float = 0.0) -> None:
    """Write an 8-bit sRGB preview of a linear picture [H, W, 3], brighter by `exposure` stops, whole or not at all.

    Raises:
        InputError: another shape.
    """
    picture = np.asarray(rgb, np.float32)
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.size == 0:
        raise InputError(path, "rgb shape", picture.shape, "[height, width, 3]")
    encoded = np.rint(255 * linear_to_srgb(picture * np.float32(2.0**exposure))).astype(np.uint8)
    with atomic_path(path) as temporary:
        Image.fromarray(encoded).save(temporary)


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
