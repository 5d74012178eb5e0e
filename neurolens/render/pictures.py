"""Pictures in and out: OpenEXR, the PNG preview, textures, environments, and the masks of apertures.

The OpenEXR library writes wrong data for arrays that are not contiguous, changes the header it is given, and refuses
float64 and int32; `write_exr` handles all three. The size of pictures named by a scene is checked before decoding.
"""

from __future__ import annotations

import io
import json
import logging
import math
import os
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import ArrayLike, NDArray
from PIL import Image, UnidentifiedImageError

from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.base.files import atomic_path, open_regular, read_bytes
from neurolens.base.tomlfile import parse_json
from neurolens.cameras.contract import FloatArray
from neurolens.lens.apertures import MAX_MASK, THRESHOLD, Aperture
from neurolens.render.colour import (
    COLOUR_SPACES,
    SRGB,
    ColourSpace,
    conversion,
    converted,
    linear_to_srgb,
    srgb_to_linear,
)
from neurolens.render.radiance import read_radiance
from neurolens.render.scenetables import BRIGHTEST

logging.getLogger("PIL").addHandler(logging.NullHandler())  # Pillow logs what our errors say of damaged files
METADATA_KEY = "neurolens"
_HALF_MAX = 65504.0
_BAND = 1 << 17  # pixels of a preview that are encoded at a time
_COLOURS = "RGB"
LARGEST_PICTURE, LARGEST_FILM = 8192, 1 << 16  # pixels per side
MOST_PIXELS = 1 << 26  # of all textures of a scene: 0.8 GB
_MOST_VALUES = 1 << 27  # of an OpenEXR file, at 8 bytes each while it is read
_LARGEST_FILE = 1 << 28  # bytes of any other
FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "TGA", "WEBP")  # of Pillow's, which would ask other programs for some
_ROUNDED = 2e-4  # how far the chromaticities of one space may lie apart in files
_TYPES = (np.uint32, np.float16, np.float32)  # by the numbers of pixel types in OpenEXR files
_DEPTH = "Z"  # the name of depth in other programs


def write_exr(
    path: str | Path,
    rgb: ArrayLike,
    *,
    half: bool = False,
    metadata: dict[str, Any] | None = None,
    space: ColourSpace = SRGB,
    layers: Mapping[str, ArrayLike] | None = None,
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """Write a picture as OpenEXR: channels R, G and B, then layers, ZIP compression, atomically.

    The attributes chromaticities, adoptedNeutral and colorInteropID say which colour space it is.

    Args:
        path: where to; the folder exists.
        rgb: [H, W, 3] linear sRGB, any real type and memory layout; stored as float32.
        half: store as float16, where values beyond 65504 become 65504.
        metadata: JSON-able settings, kept as one JSON text in the attribute "neurolens".
        space: colour space to store.
        layers: [H, W] more channels by name, always float32, inf allowed; "depth" becomes the channel Z.
        attributes: more of the header, see `exr_attributes`.

    Raises:
        InputError: another shape, no pixels, complex or text, not finite, a layer with NaN or of a colour's name,
            metadata that is not JSON, no such folder, a file that the library cannot write.
        OSError: a place that cannot be written; it names `path`.
    """
    path = Path(path)
    picture = _shaped(path, np.asarray(rgb))
    if picture.dtype.kind not in "fiub":
        raise InputError(path, "rgb type", str(picture.dtype), "real numbers")
    with np.errstate(over="ignore", invalid="ignore"):
        picture = (picture if space is SRGB else converted(picture, conversion(SRGB, space))).astype(
            np.float32, copy=False
        )
    if bad := int(np.sum(~np.isfinite(picture))):
        raise InputError(path, "rgb", f"({bad} values not finite)", "finite float32 values")
    stored = np.clip(picture, -_HALF_MAX, _HALF_MAX).astype(np.float16) if half else picture
    channels = {name: np.ascontiguousarray(stored[..., k]) for k, name in enumerate(_COLOURS)}
    channels |= _layer_channels(path, layers or {}, picture.shape[:2])
    write_stored(path, channels, space, metadata, attributes)


def write_stored(
    path: Path,
    channels: Mapping[str, NDArray[Any]],
    space: ColourSpace,
    metadata: Mapping[str, Any] | None = None,
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """Write a picture's channels [H, W], contiguous, as they are to be stored; the rest as in `write_exr`."""
    try:
        text = json.dumps(metadata or {}, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InputError(path, "metadata", f"({error})", "values that JSON can hold") from None
    if not path.parent.is_dir():
        raise InputError(path, "folder", str(path.parent), "a folder that exists")
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "chromaticities": space.chromaticities,
        "adoptedNeutral": np.array(space.white, np.float32),
        "colorInteropID": space.interop_id,
        METADATA_KEY: text,
        **(attributes or {}),
    }
    _write_part(path, header, dict(channels))


def write_data_exr(
    path: Path,
    channels: Mapping[str, FloatArray],
    metadata: Mapping[str, Any],
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """Write channels [H, W] float32 that are no colours, atomically; `metadata` and `attributes` as in `write_exr`.

    Raises:
        InputError, OSError: as `write_exr`.
    """
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "colorInteropID": "data",
        METADATA_KEY: json.dumps(metadata, allow_nan=False),
        **(attributes or {}),
    }
    _write_part(path, header, {name: np.ascontiguousarray(plane) for name, plane in channels.items()})


def _write_part(path: Path, header: dict[str, Any], channels: dict[str, Any]) -> None:
    with atomic_path(path) as temporary:
        try:
            OpenEXR.File([OpenEXR.Part(header, channels)]).write(str(temporary))
        except RuntimeError as error:  # the library's only kind; it names the temporary file
            said = str(error).replace(str(temporary), path.name)
            raise InputError(path, "file", f"({said})", "a writable path") from None


def _shaped(path: str | Path, picture: NDArray[Any]) -> NDArray[Any]:
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.size == 0:
        raise InputError(path, "rgb shape", picture.shape, "[height, width, 3]")
    return picture


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


def read_exr(path: str | Path) -> tuple[FloatArray, dict[str, Any]]:
    """A picture [H, W, 3] float32, in the colour space that it was written in, and its metadata, {} without ours.

    Raises:
        InputError: missing, no OpenEXR file, truncated, or without channels R, G and B.
    """
    planes, told = read_channels(path, _COLOURS)
    return _colours(planes, path, "channels"), told


def read_channels(path: str | Path, wanted: Sequence[str] = ()) -> tuple[dict[str, FloatArray], dict[str, Any]]:
    """The channels [H, W] float32 of a picture by name, or those wanted where it has them, and its metadata.

    Raises:
        InputError: missing, no OpenEXR file, truncated, metadata that are no JSON object.
    """
    planes, text = _read_channels(Path(path), wanted=wanted)
    return planes, _metadata(path, text)


def read_metadata(path: str | Path) -> dict[str, Any]:
    """The metadata of a picture alone, {} without ours; raises InputError as `read_channels`."""
    return _metadata(path, _header(path).get(METADATA_KEY, "{}"))


def read_colour_space(path: str | Path) -> ColourSpace | None:
    """The colour space whose chromaticities a picture states; None where it states none.

    Warns:
        NeurolensWarning: chromaticities of another space, in whose place sRGB is assumed.

    Raises:
        InputError: as `read_channels`.
    """
    stated = _header(path).get("chromaticities")
    if not isinstance(stated, tuple) or len(stated) != len(SRGB.chromaticities):
        return None
    for space in COLOUR_SPACES.values():
        if np.allclose(stated, space.chromaticities, rtol=0, atol=_ROUNDED):
            return space
    names = " nor ".join(COLOUR_SPACES)
    text = f"{path}: its chromaticities are those of neither {names}; its colours are read as sRGB"
    warnings.warn(text, NeurolensWarning, stacklevel=2)
    return SRGB


def _header(path: str | Path) -> dict[str, Any]:
    with _whole(path, "file", "(missing)", named=False), _silent():
        open_regular(path).close()
        with OpenEXR.File(str(path), header_only=True) as header:
            return dict(header.parts[0].header)


def _metadata(path: str | Path, text: Any) -> dict[str, Any]:
    """The settings in our attribute, whose type in a stranger's file may be any that OpenEXR has."""
    with suppress(ValueError, RecursionError, InputError):
        if isinstance(text, str) and isinstance(told := parse_json(text, path), dict):
            return told
    raise InputError(path, METADATA_KEY, text, "JSON text, an object")


def read_layers(path: str | Path) -> dict[str, FloatArray]:
    """The channels [H, W] float32 besides R, G and B by name, Z as depth; errors as of `read_exr`."""
    planes, _ = _read_channels(Path(path))
    return {"depth" if name == _DEPTH else name: plane for name, plane in planes.items() if name not in _COLOURS}


def _colours(planes: Mapping[str, FloatArray], file: str | Path, field: str) -> FloatArray:
    if not planes.keys() >= set(_COLOURS):
        raise InputError(file, field, f"(channels {', '.join(sorted(planes))})", "channels R, G and B")
    return np.stack([planes[name] for name in _COLOURS], axis=-1)


def _read_channels(
    path: Path,
    place: tuple[str | Path, str] | None = None,
    most: int = LARGEST_FILM,
    wanted: Sequence[str] = (),
    pixels: int = _MOST_VALUES,
) -> tuple[dict[str, FloatArray], Any]:
    """Channels as float32, and the text of our metadata.

    The values of all that are read are bounded together.

    Args:
        place: file and field that name the picture, if there are others than the picture itself. most: pixels per side.
        wanted: the channels, where the file has these; else all. pixels: the most in all.
    """
    file, field = place or (path, "file")
    name = str(path) if place else "(missing)"
    with _whole(file, field, name, named=place is not None):
        open_regular(path).close()
        with _silent(), OpenEXR.File(str(path), header_only=True) as header:
            parts = [dict(part.header) for part in header.parts]
            sizes = [[int(v) + 1 - int(u) for u, v in zip(*part["dataWindow"], strict=True)] for part in parts]
        for size in sizes:
            _check_size(file, field, name, size, most, pixels)
        kept = {c.name for c in parts[0]["channels"] if (c.xSampling, c.ySampling) == (1, 1)}.issuperset(wanted)
        some = bool(wanted) and kept and len(parts[0]["channels"]) > len(wanted)
        values = sum(w * h * len(part["channels"]) for (w, h), part in zip(sizes, parts, strict=True))
        if some:
            values = math.prod(sizes[0]) * len(wanted)
        if values > _MOST_VALUES:
            raise InputError(file, field, f"({values} values in its channels)", f"at most {_MOST_VALUES}")
        if some:
            return _some_channels(path, wanted, sizes[0]), parts[0].get(METADATA_KEY, "{}")
        with _silent(), OpenEXR.File(str(path), separate_channels=True) as whole:
            part = whole.parts[0]
            planes = {name: np.array(channel.pixels, np.float32) for name, channel in part.channels.items()}
            return planes, part.header.get(METADATA_KEY, "{}")


@contextmanager
def _whole(file: str | Path, field: str, name: str, named: bool) -> Iterator[None]:
    """Turn errors of reading an OpenEXR file inside the block into InputError; `named`: the value found is `name`."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except OSError as error:
        raise InputError(file, field, name, f"an OpenEXR file that exists ({error.strerror})") from None
    except Exception as error:  # the library raises bare RuntimeError, ValueError and its own
        raise InputError(file, field, name if named else f"({error})", f"a whole OpenEXR file ({error})") from None


def _some_channels(path: Path, names: Sequence[str], size: Sequence[int]) -> dict[str, FloatArray]:
    """Some channels of the first part, of width and height: `OpenEXR.File` would read all."""
    with _silent():
        found = OpenEXR.InputFile(str(path))
        try:
            types = [_TYPES[found.header()["channels"][name].type.v] for name in names]
            planes = found.channels(names)
        finally:
            found.close()
    shaped = (np.frombuffer(p, t).reshape(size[::-1]) for p, t in zip(planes, types, strict=True))
    return {name: np.array(plane, np.float32) for name, plane in zip(names, shaped, strict=True)}


@contextmanager
def _silent() -> Iterator[None]:
    """Without stderr and Python's stdout, on which the library prints what it also raises."""
    sys.stderr.flush()
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        with redirect_stdout(io.StringIO()):
            yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def write_png(path: str | Path, rgb: ArrayLike, exposure: float = 0.0) -> None:
    """Write an 8-bit sRGB preview of a linear picture [H, W, 3], brighter by `exposure` stops, atomically.

    InputError: another shape.
    """
    picture = _shaped(path, np.asarray(rgb, np.float32))
    encoded = np.empty(picture.shape, np.uint8)
    rows = max(1, _BAND // picture.shape[1])
    for first in range(0, len(picture), rows):  # of a whole large picture every step takes pages of memory anew
        band = picture[first : first + rows] * np.float32(2.0**exposure)
        encoded[first : first + rows] = np.rint(255 * linear_to_srgb(band))
    with atomic_path(path) as temporary:
        Image.fromarray(encoded).save(temporary)


def _check_size(file: str | Path, field: str, name: str, size: Sequence[int], most: int, pixels: int) -> None:
    if max(size) > most:
        raise InputError(file, field, name, f"a picture of at most {most} pixels per side")
    if math.prod(size) > pixels:
        raise InputError(file, field, name, f"{MOST_PIXELS} pixels at most in all pictures of a scene")


@contextmanager
def _opened(file: str | Path, field: str, path: Path, most: int, pixels: int = MOST_PIXELS) -> Iterator[Image.Image]:
    """A picture of at most `most` pixels per side, and of at most `pixels`; mistakes name file and field."""
    with _decoded(file, field, path) as data, warnings.catch_warnings(action="ignore"):  # Pillow's, of damaged files
        with Image.open(io.BytesIO(data), formats=FORMATS) as picture:
            _check_size(file, field, str(path), picture.size, most, pixels)
            yield picture


@contextmanager
def _decoded(file: str | Path, field: str, path: Path) -> Iterator[bytes]:
    """The content of a picture's file; errors of decoding it inside the block become InputError."""
    try:
        yield read_bytes(path, _LARGEST_FILE, "a picture", (file, field))
    except (InputError, MemoryError):
        raise
    except Exception as error:  # decoders of damaged files raise errors of many types
        kinds = ", ".join((*FORMATS, "Radiance (.hdr)", "OpenEXR"))
        why = "" if isinstance(error, UnidentifiedImageError) else f" ({error})"  # its words name an object
        raise InputError(file, field, str(path), f"a readable picture, one of {kinds}{why}") from None


def read_pictures(scene: Path, files: Mapping[str, Path]) -> dict[str, FloatArray]:
    """The pictures of a scene by their fields, as `read_picture` reads them; together of at most `MOST_PIXELS`.

    Their values are reflectances: those beyond 0 to 1 are clamped, with a warning.
    """
    found: dict[str, FloatArray] = {}
    left = MOST_PIXELS
    for field, path in files.items():
        found[field] = _clamped(scene, field, path, read_picture(scene, field, path, pixels=left), 1.0)
        left -= found[field][..., 0].size
    return found


def read_picture(
    scene: Path, field: str, path: Path, most: int = LARGEST_PICTURE, pixels: int = MOST_PIXELS
) -> FloatArray:
    """Linear sRGB [H, W, 3] of a picture: of OpenEXR and Radiance as stored; else of one that is encoded as sRGB is, of
    8 bits, or grey of 16 bits, which Pillow would clip to 8.

    Raises:
        InputError: names scene file, field and picture, which is missing, too large or broken.
    """
    kind = path.suffix.lower()
    if kind == ".exr":
        return _colours(_read_channels(path, (scene, field), most, _COLOURS, pixels)[0], scene, field)
    if kind == ".hdr":
        with _decoded(scene, field, path) as data:
            radiance, ignored = read_radiance(
                data, lambda *size: _check_size(scene, field, str(path), size, most, pixels)
            )
        if ignored:
            _warn(scene, field, f"{path.name}: its pixels are taken as they are stored, without {', '.join(ignored)}")
        return radiance
    with _opened(scene, field, path, most, pixels) as picture:
        if picture.mode.startswith("I;16"):
            grey = srgb_to_linear(np.asarray(picture, np.float32) / np.float32(65535))
            return np.stack([grey] * 3, axis=-1)
        if picture.mode in ("I", "F"):
            raise InputError(scene, field, str(path), "a picture of 8 or 16 bits a channel")
        # By a table: a picture takes 12 bytes a pixel, without temporary ones of 36 more.
        return srgb_to_linear(np.arange(256, dtype=np.float32) / np.float32(255))[np.asarray(picture.convert("RGB"))]


def _clamped(scene: Path, field: str, path: Path, picture: FloatArray, most: float | None = None) -> FloatArray:
    """The picture with values that are no light replaced in place, and a warning that says how many and where.

    Values that are negative or not a number become 0. Values above `most` become `most`; where it is None, infinite
    values become the largest finite value, for a map of 16-bit floats holds the sun as infinite.
    """
    if most is None:
        most = float(picture.max(where=np.isfinite(picture), initial=0))
    bad = ~((picture >= 0) & (picture <= most)).all(axis=-1)  # so that NaN is bad
    if bad.any():
        row, column = divmod(int(bad.argmax()), bad.shape[1])
        _warn(
            scene, field,
            f"{path.name}: {int(bad.sum())} of {bad.size} pixels have values that are negative, not a number or "
            f"above {most:g}, the first in row {row + 1} from the top, column {column + 1}: they are clamped",
        )  # fmt: skip
        np.nan_to_num(picture, copy=False, nan=0.0, posinf=most, neginf=0.0)
        np.clip(picture, 0, most, out=picture)
    return picture


def _warn(scene: Path, field: str, said: str) -> None:
    warnings.warn(f"{scene}: {field}: {said}", NeurolensWarning, stacklevel=3)


def read_environment(scene: Path, field: str, path: Path, scale: float = 1.0) -> FloatArray:
    """Linear sRGB [H, W, 3] of an equirectangular picture as of `read_picture`; not yet times `scale`.

    Values that are negative, infinite or not a number are clamped, with a warning.

    Raises:
        InputError: as `read_picture`; also a picture that is not twice as wide as high, values brighter than an
            emission may be, and black all over.
    """
    picture = _clamped(scene, field, path, read_picture(scene, field, path))
    height, width = picture.shape[:2]
    if width != 2 * height:
        raise InputError(scene, field, f"({width} x {height} pixels)", "an equirectangular picture, 2 : 1")
    if float(picture.max()) * scale > BRIGHTEST:
        expected = f"a picture whose values times scale are at most {BRIGHTEST:g}"
        raise InputError(scene, field, f"({float(picture.max()):g} times {scale:g})", expected)
    if not picture.any():
        raise InputError(scene, field, str(path), "a picture that is not black all over")
    return picture


def make_aperture(
    blades: int | None = None,
    rotation_deg: float | None = None,
    curvature: float | None = None,
    mask: str | Path | None = None,
) -> Aperture | None:
    """The stop's shape of a command line or a scene; None if not given.

    Raises:
        InputError: blades and a mask together, a rotation or curvature of nothing, a picture that cannot be read.
    """
    if blades is None and mask is None:
        if rotation_deg is None and curvature is None:
            return None
        raise InputError("aperture", "blades", "(missing)", "a number of blades, or a mask, with the other options")
    if blades is not None and mask is not None:
        raise InputError("aperture", "mask", str(mask), "blades or a mask, not both")
    if mask is not None and curvature is not None:
        raise InputError("aperture", "curvature", curvature, "left out: a mask has no blades")
    opening = None if mask is None else read_mask(mask)
    return Aperture(blades, rotation_deg or 0.0, curvature or 0.0, opening)


def read_mask(path: str | Path) -> NDArray[np.bool_]:
    """The opening that a picture shows, [H, W] bool: light passes where it is brighter than half, and opaque.

    There is no partial transmission: a ray passes or it does not. The longer side of the picture spans the stop.

    Raises:
        InputError: a picture that is missing, cannot be read, is too large, or dark all over.
    """
    with _opened("aperture", "mask", Path(path), MAX_MASK) as picture:
        grey = np.asarray(picture.convert("LA"), np.float32) / 255
    opening = grey[..., 0] * grey[..., 1] >= THRESHOLD
    if not opening.any():
        raise InputError(path, "mask", "(dark everywhere)", "an opening brighter than half")
    return np.asarray(opening)
