"""OpenEXR pictures in and out, with camera and lens in their headers, and the PNG preview.

The OpenEXR library writes wrong data for arrays that are not contiguous, changes the header it is given, and refuses
float64 and int32; `write_exr` handles all three.

Camera and lens are written as the attributes that OpenEXR defines (3.2 and later), for programs that do not know our
JSON: lengths of lens and film in mm, pixels in um, the focus in m. The squeeze of an anamorphic lens is the pixel's
aspect ratio, by which viewers stretch the picture to what was seen. What a camera does not know is left out.
"""

import io
import json
import math
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from neurolens import __version__
from neurolens.base.errors import InputError, warn
from neurolens.base.files import atomic_path, open_regular
from neurolens.base.report import plain
from neurolens.base.tomlfile import parse_json
from neurolens.cameras.contract import FloatArray
from neurolens.pictures.render.colour import (
    COLOUR_SPACES,
    SRGB,
    ColourSpace,
    conversion,
    converted,
    linear_to_srgb,
)

METADATA_KEY = "neurolens"
_HALF_MAX = 65504.0
_BAND = 1 << 17  # pixels of a preview that are encoded at a time
COLOURS = "RGB"
LARGEST_FILM = 1 << 16  # pixels per side
_MOST_VALUES = 1 << 27  # of an OpenEXR file, at 8 bytes each while it is read
_MOST_PARTS = 1 << 28  # values of all parts of a file, at 4 bytes each
_ROUNDED = 2e-4  # how far apart files may write the chromaticities of one space
PIXEL_TYPES = (np.uint32, np.float16, np.float32)  # in the order of the numbers of pixel types in OpenEXR files
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

    The attributes chromaticities, adoptedNeutral and colorInteropID say which colour space the picture is in.

    Args:
        path: where to; the folder exists.
        rgb: [H, W, 3] linear sRGB, any real type and memory layout; stored as float32.
        half: store as float16, where values beyond 65504 become 65504.
        metadata: JSON-able settings, kept as one JSON text in the attribute "neurolens".
        space: colour space to store.
        layers: [H, W] more channels by name, always float32, inf allowed; "depth" becomes the channel Z.
        attributes: more of the header, see `standard_attributes`.

    Raises:
        InputError: the picture has another shape, no pixels, complex numbers or text, or values that are not finite; a
            layer has NaN or a colour's name; the metadata are not JSON; the folder does not exist; the library cannot
            write the file.
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
    channels = {
        **{name: stored[..., k] for k, name in enumerate(COLOURS)},
        **_layer_channels(path, layers or {}, picture.shape[:2]),
    }
    write_channels(path, channels, space, metadata, attributes)


def write_channels(
    path: Path,
    channels: Mapping[str, NDArray[Any]],
    space: ColourSpace | None = None,
    metadata: Mapping[str, Any] | None = None,
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """Write channels [H, W] of any of OpenEXR's types as they are; arguments and errors are those of `write_exr`.

    `space` is None for data that are no colours.
    """
    try:
        json.dumps(metadata or {}, allow_nan=False)  # refuses numbers of which `plain` would make texts
        text = json.dumps(plain(metadata or {}))
    except (TypeError, ValueError) as error:
        raise InputError(path, "metadata", f"({error})", "values that JSON can hold") from None
    if not path.parent.is_dir():
        raise InputError(path, "folder", str(path.parent), "a folder that exists")
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        METADATA_KEY: text,
        "colorInteropID": "data" if space is None else space.interop_id,
    }
    if space is not None:
        header |= {"chromaticities": space.chromaticities, "adoptedNeutral": np.array(space.white, np.float32)}
    planes = {name: np.ascontiguousarray(plane) for name, plane in channels.items()}
    with atomic_path(path) as temporary:
        try:
            OpenEXR.File([OpenEXR.Part(header | dict(attributes or {}), planes)]).write(os.fsencode(temporary))
        # the library raises nothing else; its message names the temporary file
        except (RuntimeError, UnicodeError) as error:
            said = str(error).replace(str(temporary), path.name)
            raise InputError(path, "file", f"({said})", "a writable path") from None


def _shaped(path: str | Path, picture: NDArray[Any]) -> NDArray[Any]:
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.size == 0:
        raise InputError(path, "rgb shape", picture.shape, "[height, width, 3]")
    return picture


def _layer_channels(path: Path, layers: Mapping[str, ArrayLike], shape: tuple[int, ...]) -> dict[str, FloatArray]:
    channels = {}
    for name, values in layers.items():
        plane = np.asarray(values, np.float32)
        if plane.shape != shape:
            raise InputError(path, f"layer {name}, shape", plane.shape, f"{shape}, the picture's")
        if name in (*COLOURS, _DEPTH) or np.isnan(plane).any():
            raise InputError(path, f"layer {name}", "(a colour's name, or NaN)", "another name, and numbers")
        channels[_DEPTH if name == "depth" else name] = plane
    return channels


def read_exr(path: str | Path) -> tuple[FloatArray, dict[str, Any]]:
    """Read a picture [H, W, 3] float32, in the colour space that it was written in, and its metadata ({} if not ours).

    Raises:
        InputError: missing, no OpenEXR file, truncated, or without channels R, G and B.
    """
    planes, metadata = read_channels(path, COLOURS)
    return colours_of(planes, path, "channels"), metadata


def read_channels(path: str | Path, wanted: Sequence[str] = ()) -> tuple[dict[str, FloatArray], dict[str, Any]]:
    """Read the channels [H, W] float32 of a picture by name, and its metadata.

    Only the `wanted` channels are read where the picture has them all.

    Raises:
        InputError: missing, no OpenEXR file, truncated, metadata that are no JSON object.
    """
    planes, header = decoded_channels(Path(path), path, "file", wanted)
    return planes, metadata_of(path, header)


def read_metadata(path: str | Path) -> dict[str, Any]:
    """Read the metadata of a picture alone, {} if not ours; raises InputError as `read_channels`."""
    return metadata_of(path, header_of(path))


def read_layers(path: str | Path) -> dict[str, FloatArray]:
    """Read the channels [H, W] float32 besides R, G and B by name, Z as depth; raises InputError as `read_exr`."""
    planes, _ = decoded_channels(Path(path), path, "file")
    return {"depth" if name == _DEPTH else name: plane for name, plane in planes.items() if name not in COLOURS}


def read_colour_space(path: str | Path) -> ColourSpace | None:
    """Return the colour space whose chromaticities a picture states; None where it states none.

    Warns:
        NeurolensWarning: chromaticities of another space, in whose place sRGB is assumed.

    Raises:
        InputError: as `read_channels`.
    """
    stated = header_of(path).get("chromaticities")
    if not isinstance(stated, tuple) or len(stated) != len(SRGB.chromaticities):
        return None
    for space in COLOUR_SPACES.values():
        if np.allclose(stated, space.chromaticities, rtol=0, atol=_ROUNDED):
            return space
    names = " nor ".join(COLOUR_SPACES)
    warn(f"{path}: its chromaticities are those of neither {names}; its colours are read as sRGB")
    return SRGB


def metadata_of(path: str | Path, header: Mapping[str, Any]) -> dict[str, Any]:
    """Read the settings in our attribute, which in a stranger's file may have any type of OpenEXR."""
    text = header.get(METADATA_KEY, "{}")
    with suppress(ValueError, RecursionError, InputError):
        if isinstance(text, str) and isinstance(metadata := parse_json(text, path), dict):
            return metadata
    raise InputError(path, METADATA_KEY, text, "JSON text, an object")


def colours_of(planes: Mapping[str, FloatArray], file: str | Path, field: str) -> FloatArray:
    """Return channels R, G and B as [H, W, 3]; InputError where one is missing."""
    if not planes.keys() >= set(COLOURS):
        raise InputError(file, field, f"(channels {', '.join(sorted(planes))})", "channels R, G and B")
    return np.stack([planes[name] for name in COLOURS], axis=-1)


def decoded_channels(
    path: Path,
    file: str | Path,
    field: str,
    wanted: Sequence[str] = (),
    most: int = LARGEST_FILM,
    pixels: int = _MOST_VALUES,
) -> tuple[dict[str, FloatArray], dict[str, Any]]:
    """Read the channels [H, W] of the first part as float32, the wanted ones where it has them all, and its header.

    Args:
        file, field: what names the picture in messages: the file itself, or a scene and its key.
        most: the most pixels a side. pixels: the most in all.
    """
    header = _headers(file, field, path)[0][1]
    with whole_file(file, field, path):
        size = [int(last) + 1 - int(first) for first, last in zip(*header["dataWindow"], strict=True)]
        check_size(file, field, str(path), size, most, pixels)
        names = [c.name for c in header["channels"] if (c.xSampling, c.ySampling) == (1, 1)]
        if wanted and set(names).issuperset(wanted):
            names = list(wanted)
        if (values := math.prod(size) * len(names)) > _MOST_VALUES:
            raise InputError(file, field, f"({values} values in its channels)", f"at most {_MOST_VALUES}")
        with _silent():
            picture = OpenEXR.InputFile(os.fsencode(path))  # `OpenEXR.File` would read all channels
            try:
                types = [PIXEL_TYPES[picture.header()["channels"][name].type.v] for name in names]
                planes = picture.channels(names)
            finally:
                picture.close()
        shaped = (np.frombuffer(p, t).reshape(size[::-1]) for p, t in zip(planes, types, strict=True))
        return {name: np.array(plane, np.float32) for name, plane in zip(names, shaped, strict=True)}, header


def check_size(file: str | Path, field: str, name: str, size: Sequence[int], most: int, pixels: int) -> None:
    """Refuse (InputError) a picture of more than `most` pixels a side, or of more than `pixels`."""
    if max(size) > most:
        raise InputError(file, field, name, f"a picture of at most {most} pixels per side")
    if math.prod(size) > pixels:
        raise InputError(file, field, name, f"at most {pixels} pixels: all pictures of a scene share a limit")


def decoded_later_parts(path: Path) -> list[tuple[str, dict[str, NDArray[Any]]]]:
    """Read names and channels, as stored, of the parts after the first that cover the same pixels as the first.

    The library reads all parts at once, and leaves out parts that it cannot read.

    Warns:
        NeurolensWarning: parts are left out, because their data windows differ.
    """
    if len(parts := _headers(path, "file", path)) < 2:
        return []
    known, full, left_out, values = list[tuple[str, set[str]]](), dict[str, set[str]](), list[str](), 0
    for name, header in parts:
        if header["type"] not in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
            raise InputError(path, "file", f"(part {name!r} is deep)", "flat parts, or a deep file by itself")
        across, down = (int(b) - int(a) + 1 for a, b in zip(*header["dataWindow"], strict=True))
        if min(across, down) < 1:
            raise InputError(path, "file", f"(part {name!r} of {across}x{down} pixels)", "parts of at least a pixel")
        known.append((name, {c.name for c in header["channels"]}))
        values += across * down * len(header["channels"])
        if np.array_equal(header["dataWindow"], parts[0][1]["dataWindow"]):
            full[name] = {c.name for c in header["channels"] if (c.xSampling, c.ySampling) == (1, 1)}
        else:
            left_out.append(name)
    if values > _MOST_PARTS:
        raise InputError(path, "file", f"({values} values in its parts)", f"at most {_MOST_PARTS}")
    with whole_file(path, "file", path), _silent():
        with OpenEXR.File(os.fsencode(path), separate_channels=True) as file:
            found = [(part.name(), {name: c.pixels for name, c in part.channels.items()}) for part in file.parts]
        if [(name, set(planes)) for name, planes in found] != known:
            raise ValueError(f"of {len(known)} parts {len(found)} can be read")
    if left_out:
        warn(f"{path}: parts with other data windows are left out: {', '.join(left_out)}")
    return [(name, {n: p for n, p in planes.items() if n in full[name]}) for name, planes in found[1:] if name in full]


def header_of(path: str | Path) -> dict[str, Any]:
    """Read the header of a file's first part; raises InputError as `read_channels`."""
    return _headers(path, "file", Path(path))[0][1]


def _headers(file: str | Path, field: str, path: Path) -> list[tuple[str, dict[str, Any]]]:
    """Read names and headers of all parts; `file` and `field` name the picture in messages."""
    with whole_file(file, field, path), _silent():
        open_regular(path).close()
        with OpenEXR.File(os.fsencode(path), header_only=True) as opened:
            return [(part.name(), dict(part.header)) for part in opened.parts]


@contextmanager
def whole_file(file: str | Path, field: str, path: Path) -> Iterator[None]:
    """Turn errors of reading an OpenEXR file inside the block into InputError."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as error:  # the library raises bare RuntimeError, ValueError, OSError and its own
        missing = error.strerror if isinstance(error, OSError) else None
        expected = f"an OpenEXR file that exists ({missing})" if missing else "a whole OpenEXR file"
        found = "(missing)" if missing else f"({error})"
        raise InputError(file, field, found if str(file) == str(path) else f"{path} {found}", expected) from None


@contextmanager
def _silent() -> Iterator[None]:
    """Close stderr and Python's stdout inside the block: the library prints there what it also raises."""
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

    Raises:
        InputError: the picture has another shape.
    """
    picture = _shaped(path, np.asarray(rgb, np.float32))
    encoded = np.empty(picture.shape, np.uint8)
    rows = max(1, _BAND // picture.shape[1])
    # in bands: on a whole large picture every step would get its pages of memory anew
    for first in range(0, len(picture), rows):
        band = picture[first : first + rows] * np.float32(2.0**exposure)
        encoded[first : first + rows] = np.rint(255 * linear_to_srgb(band))
    with atomic_path(path) as temporary:
        Image.fromarray(encoded).save(temporary)


_LEAST_ASPECT = 1e-5  # of a pixel: the library refuses some smaller ones
_SQUARE = 1e-6  # pixels whose sides differ by less, relatively, are square
# how the names of attributes that are texts begin
_TEXTS = ("camera", "lensMake", "lensModel", "lensSerial", "lensFirmware")
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
    """Return the header values of a picture, in the types that the OpenEXR library wants.

    Args:
        settings: the camera's, as in `Camera.settings`.
        width, height: of the picture, in pixels; None where pixels are no part of the film, as in maps.
        frame: the picture's number in a sequence.

    Raises:
        KeyError, IndexError, TypeError, ValueError, AttributeError, ArithmeticError: these are no camera's settings.
    """
    found: dict[str, Any] = {
        "cameraMake": "neurolens",
        "cameraModel": settings.get("camera"),
        "cameraFirmwareVersion": __version__,
        "imageCounter": None if frame is None else int(np.int32(frame)),
        **_lens(settings),
        **({} if width is None or height is None else _film(settings, width, height)),
    }
    typed: dict[str, Any] = {}
    for name, value in found.items():
        if name.startswith(_TEXTS) and not isinstance(value, str | None):
            raise TypeError(f"{name}: {value!r} is no text")
        if value is not None and not (isinstance(value, str) and not value):  # the standard wants no empty text ...
            typed[name] = (
                float(value) if name in ("focus", *_STATE) else plain(value) if isinstance(value, str) else value
            )
    # ... nor a number that is none.
    return {name: value for name, value in typed.items() if not (isinstance(value, float) and math.isnan(value))}


def _lens(settings: Mapping[str, Any]) -> dict[str, Any]:
    card = settings.get("card") or {}
    lens = settings.get("lens") or card.get("lens") or {}
    state = settings.get("lens_state") or {}
    # The designer of a published prescription counts as its maker, else who published it.
    found: dict[str, Any] = {
        **{name: state.get(key) for name, key in _STATE.items()},
        "lensMake": lens.get("designer") or lens.get("source"),
        "lensModel": lens.get("name"),
        "lensSerialNumber": lens.get("sha256"),
        "lensFirmwareVersion": card.get("fit", {}).get("method"),
    }
    point = str(settings.get("camera")).startswith(("pinhole", "fisheye-"))  # everything is in focus
    if "focus_m" in settings and not point:
        found["focus"] = math.inf if settings["focus_m"] is None else float(settings["focus_m"])
    return found


def _film(settings: Mapping[str, Any], width: int, height: int) -> dict[str, Any]:
    if "film_mm" not in settings:
        return {}
    with np.errstate(over="raise"):
        size = np.array(settings["film_mm"], np.float32)
    if size.shape != (2,):
        raise ValueError(f"a film of {size.size} numbers")
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
