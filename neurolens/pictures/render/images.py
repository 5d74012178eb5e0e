"""The pictures that scenes read: textures, environments, masks of apertures. Radiance's format is read here.

Their sizes are checked before they are decoded. Radiance (.hdr) has three mantissas and a shared exponent a pixel: a
text header, an empty line, a line with the size, then rows of pixels, each row in one of two forms (Greg Ward, "Real
Pixels", Graphics Gems II, 1991; the Radiance reference manual, "Picture file format"):

- plain: 4 bytes a pixel (runs of whole pixels, which programs wrote before 1991, are refused);
- runs: 2, 2, width in two bytes, then the row of each of the four bytes by itself, as runs: n > 128 repeats the next
  byte n - 128 times, any other n is followed by n bytes.

A mantissa m with the exponent e is m * 2^(e - 136), as Blender, OpenImageIO and OpenCV read it; e = 0 is black.
"""

import io
import logging
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from neurolens.base.errors import InputError, warn
from neurolens.base.files import read_bytes
from neurolens.cameras.contract import FloatArray
from neurolens.optics.lens.apertures import MAX_MASK, THRESHOLD, Aperture
from neurolens.optics.lens.shot import StopShape
from neurolens.pictures.render.colour import srgb_to_linear
from neurolens.pictures.render.pictures import COLOURS, check_size, colours_of, decoded_channels
from neurolens.pictures.render.scenetables import BRIGHTEST

LARGEST_PICTURE = 8192  # pixels per side
MOST_PIXELS = 1 << 26  # of all textures of a scene: 0.8 GB
_LARGEST_FILE = 1 << 28  # bytes of a picture's file; OpenEXR has its own bound
_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "TGA", "WEBP")  # for other formats of Pillow's it would ask other programs
_MAGIC = (b"#?RADIANCE", b"#?RGBE")
_RGBE = "32-bit_rle_rgbe"
_SIZE = re.compile(rb"([-+])Y (\d{1,9}) ([-+])X (\d{1,9})")
_LONGEST_LINE, _MOST_LINES = 4096, 1000  # of Radiance's header
_NEW = range(8, 1 << 15)  # widths that rows with runs may have
Bytes = NDArray[np.uint8]

logging.getLogger("PIL").addHandler(logging.NullHandler())  # Pillow also logs what our errors say of damaged files


@contextmanager
def _opened(file: str | Path, field: str, path: Path, most: int, pixels: int = MOST_PIXELS) -> Iterator[Image.Image]:
    """Open a picture of at most `most` pixels per side and `pixels` in all; an InputError names file and field."""
    with _decoded(file, field, path) as data, warnings.catch_warnings(action="ignore"):  # Pillow warns of damaged files
        with Image.open(io.BytesIO(data), formats=_FORMATS) as picture:
            check_size(file, field, str(path), picture.size, most, pixels)
            if picture.format == "PNG":  # decoding does not compare the checksums of PNG
                with Image.open(io.BytesIO(data)) as copy:
                    copy.verify()
            yield picture


@contextmanager
def _decoded(file: str | Path, field: str, path: Path) -> Iterator[bytes]:
    """Give the content of a picture's file to the block, in which errors of decoding become InputError."""
    try:
        yield read_bytes(path, _LARGEST_FILE, "a picture", (file, field))
    except (InputError, MemoryError):
        raise
    except Exception as error:  # decoders of damaged files raise errors of many types
        kinds = ", ".join((*_FORMATS, "Radiance (.hdr)", "OpenEXR"))
        # these errors name an object, not a cause
        why = "" if isinstance(error, UnidentifiedImageError) else f" ({error})"
        raise InputError(file, field, str(path), f"a readable picture, one of {kinds}{why}") from None


def read_pictures(scene: Path, files: Mapping[str, Path]) -> dict[str, FloatArray]:
    """Read the pictures of a scene by their fields, as `read_picture` does; all together have at most `MOST_PIXELS`.

    The values are reflectances: those beyond 0 to 1 are clamped, with a warning.
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
    """Read a picture as linear sRGB [H, W, 3].

    OpenEXR and Radiance are taken as they are stored. Other pictures are decoded from sRGB: those of 8 bits a channel,
    and grey of 16 bits, which Pillow would clip to 8.

    Raises:
        InputError: the picture is missing, too large or broken; the error names scene file, field and picture.
    """
    kind = path.suffix.lower()
    if kind == ".exr":
        return colours_of(decoded_channels(path, scene, field, COLOURS, most, pixels)[0], scene, field)
    if kind == ".hdr":
        with _decoded(scene, field, path) as data:
            radiance, ignored = read_radiance(
                data, lambda *size: check_size(scene, field, str(path), size, most, pixels)
            )
        if ignored:
            unused = ", ".join(ignored)
            warn(f"{scene}: {field}: {path.name}: its pixels are taken as they are stored, without {unused}")
        return radiance
    with _opened(scene, field, path, most, pixels) as picture:
        if picture.mode.startswith("I;16"):
            return np.stack([srgb_to_linear(np.asarray(picture, np.float32) / np.float32(65535))] * 3, axis=-1)
        if picture.mode in ("I", "F"):
            raise InputError(scene, field, str(path), "a picture of 8 or 16 bits a channel")
        # By a table: a picture takes 12 bytes a pixel, without temporary ones of 36 more.
        return srgb_to_linear(np.arange(256, dtype=np.float32) / np.float32(255))[np.asarray(picture.convert("RGB"))]


def _clamped(scene: Path, field: str, path: Path, picture: FloatArray, most: float | None = None) -> FloatArray:
    """Replace values that are no light in place, and warn of how many and where.

    Values that are negative or not a number become 0. Values above `most` become `most`; where it is None, infinite
    values become the largest finite value, for a map of 16-bit floats holds the sun as infinite.
    """
    if most is None:
        most = float(picture.max(where=np.isfinite(picture), initial=0))
    bad = ~((picture >= 0) & (picture <= most)).all(axis=-1)  # so that NaN is bad
    if bad.any():
        row, column = divmod(int(bad.argmax()), bad.shape[1])
        count, place = f"{int(bad.sum())} of {bad.size} pixels", f"row {row + 1} from the top, column {column + 1}"
        said = f"{count} have values that are negative, not a number or above {most:g}, the first in {place}"
        warn(f"{scene}: {field}: {path.name}: {said}: they are clamped")
        np.nan_to_num(picture, copy=False, nan=0.0, posinf=most, neginf=0.0)
        np.clip(picture, 0, most, out=picture)
    return picture


def read_environment(scene: Path, field: str, path: Path, scale: float = 1.0) -> FloatArray:
    """Read an equirectangular picture by `read_picture`: linear sRGB [H, W, 3], not yet times `scale`.

    Values that are negative, infinite or not a number are clamped, with a warning.

    Raises:
        InputError: as `read_picture`; also where the picture is not twice as wide as high, is brighter than an emission
            may be, or is black all over.
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


def make_aperture(shape: StopShape) -> Aperture | None:
    """Make the stop's opening that a command line or a scene describes; None if it gives no shape.

    Raises:
        InputError: blades and a mask together, a rotation or curvature without blades, a picture that cannot be read.
    """
    blades, rotation_deg, curvature = shape.blades, shape.blade_rotation_deg, shape.blade_curvature
    if blades is None and shape.aperture_mask is None:
        if rotation_deg is None and curvature is None:
            return None
        raise InputError("aperture", "blades", "(missing)", "a number of blades, or a mask, with the other options")
    if blades is not None and shape.aperture_mask is not None:
        raise InputError("aperture", "mask", str(shape.aperture_mask), "blades or a mask, not both")
    if shape.aperture_mask is not None and curvature is not None:
        raise InputError("aperture", "curvature", curvature, "left out: a mask has no blades")
    opening = None if shape.aperture_mask is None else read_mask(shape.aperture_mask)
    return Aperture(blades, rotation_deg or 0.0, curvature or 0.0, opening)


def read_mask(path: str | Path) -> NDArray[np.bool_]:
    """Read the opening that a picture shows, [H, W] bool: light passes where it is opaque and brighter than half.

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


def read_radiance(data: bytes, check: Callable[[int, int], None]) -> tuple[FloatArray, list[str]]:
    """Read linear RGB [H, W, 3] of a Radiance picture, and what its header asks for that was not applied.

    Args:
        data: the file. check: refuses a width and height, before memory is taken.

    Raises:
        ValueError: it is no such picture, it is damaged, it is in XYZE, or its columns come first.
    """
    (up, right), (width, height), place, ignored = _header(data)
    check(width, height)
    picture = np.empty((height, width, 3), np.float32)
    for row in range(height):
        line, place = _row(data, place, width)
        exponent = line[:, 3:].astype(np.int32)
        picture[row] = np.where(exponent > 0, np.ldexp(line[:, :3].astype(np.float32), exponent - 136), 0)
    return np.ascontiguousarray(picture[:: -1 if up == b"+" else 1, :: -1 if right == b"-" else 1]), ignored


def _header(data: bytes) -> tuple[tuple[bytes, bytes], tuple[int, int], int, list[str]]:
    """Read the signs of the axes y and x, width and height, the place of the first row, and settings not applied."""
    if not data.startswith(_MAGIC):
        raise ValueError("it does not begin with #?RADIANCE")
    place = 0
    ignored: list[str] = []
    for _ in range(_MOST_LINES):
        end = data.find(b"\n", place, place + _LONGEST_LINE)
        if end < 0:
            break
        line, place = data[place:end].strip(), end + 1
        if found := _SIZE.fullmatch(line):
            size = int(found[4]), int(found[2])
            if min(size) < 1:
                break
            return (found[1], found[3]), size, place, ignored
        name, _, value = line.decode("latin-1").partition("=")
        if name == "FORMAT" and value.strip() != _RGBE:
            raise ValueError(f"its format is {value.strip()[:40]!r}, not {_RGBE}")
        if name in ("EXPOSURE", "COLORCORR", "PRIMARIES"):
            ignored.append(f"{name}={value.strip()[:80]}")
    raise ValueError("its header has no line with its size, such as -Y 512 +X 1024")


def _row(data: bytes, place: int, width: int) -> tuple[Bytes, int]:
    """Read a row's bytes [width, 4]; also return the place of the next row."""
    start = data[place : place + 4]
    if width in _NEW and start[:2] == b"\2\2" and start[2:3] < b"\x80":
        if int.from_bytes(start[2:], "big") != width:
            raise ValueError("one of its rows has another width")
        return _new_row(data, place + 4, width)
    row = np.frombuffer(data[place : place + 4 * width], np.uint8)
    if row.size < 4 * width:
        raise ValueError("it is cut short")
    row = row.reshape(width, 4)
    if (row[:, :3] == 1).all(axis=1).any():
        raise ValueError("it has runs of whole pixels, which programs wrote before 1991: write it again")
    return row, place + 4 * width


def _new_row(data: bytes, place: int, width: int) -> tuple[Bytes, int]:
    planes = bytearray()
    for end in range(width, 5 * width, width):
        while len(planes) < end:
            count, value = data[place : place + 1], data[place + 1 : place + 2]
            if not value or count == b"\0":
                raise ValueError("it is cut short or damaged")
            length = count[0]
            if length > 128:
                planes += value * (length - 128)
                place += 2
            else:
                planes += data[place + 1 : place + 1 + length]
                place += 1 + length
        if len(planes) > end:
            raise ValueError("one of its runs is longer than its row")
    return np.frombuffer(planes, np.uint8).reshape(4, width).T, place
