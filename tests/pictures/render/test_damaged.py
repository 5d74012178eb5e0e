"""Damaged pictures: one that is cut, or whose bytes are zeroed, is refused or has the pixels of the whole one.

Bytes that change unseen need a checksum: of the formats read here, PNG and what OpenEXR deflates by itself have one.
"""

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image
from shipped import WHOLE

from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.cameras.field import frame_of
from neurolens.cameras.ideal import ThinLens
from neurolens.pictures.defocus import plate
from neurolens.pictures.defocus.deep import _channels
from neurolens.pictures.defocus.plate import DepthSettings, read_plate
from neurolens.pictures.render import pictures
from neurolens.pictures.render.images import read_picture

SIZE = 48, 32
FILM = (36.0, 24.0)
RNG = np.random.default_rng(5)
COLOURS = {c: RNG.random(SIZE[::-1]).astype(np.float32) for c in "RGB"}
ZIP = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}


def planes(z: float) -> dict[str, np.ndarray]:
    grey = {c: np.round(v, 2) for c, v in COLOURS.items()}  # that deflate makes shorter
    return {**grey, "Z": np.full(SIZE[::-1], z, np.float32)}


def two_parts(path: Path) -> None:
    parts = [OpenEXR.Part(dict(ZIP), planes(z), name=n) for n, z in (("front", 2.0), ("behind", 8.0))]
    OpenEXR.File(parts).write(str(path))


def one_part(path: Path, compression: str = "ZIP", tiles: int = 0) -> None:
    header = {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION"), "type": OpenEXR.scanlineimage}
    if tiles:
        header |= {"type": OpenEXR.tiledimage, "tiles": described(tiles, tiles)}
    OpenEXR.File(header, planes(2.0)).write(str(path))


def described(width: int, height: int) -> OpenEXR.TileDescription:
    tiles = OpenEXR.TileDescription()
    tiles.xSize, tiles.ySize = width, height
    return tiles


def deep(path: Path, compression: str = "ZIPS", tiled: bool = False) -> dict[str, np.ndarray]:
    """A deep file whose pixels have 0 to 11 samples; what it was written from."""
    rng = np.random.default_rng(3)
    counts = rng.integers(0, 12, SIZE[::-1])
    counts[3] = 0
    kinds = {"R": np.float16, "A": np.float16, "G": np.float32, "B": np.float32, "Z": np.float32, "id": np.uint32}
    channels = {name: np.empty(SIZE[::-1], object) for name in kinds}
    for y, x in np.ndindex(counts.shape):
        for name, kind in kinds.items():
            channels[name][y, x] = (1 + np.round(8 * rng.random(counts[y, x]))).astype(kind)
        channels["A"][y, x] /= 9
    header = {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION"), "type": OpenEXR.deepscanline}
    if tiled:
        header |= {"type": OpenEXR.deeptile, "tiles": described(20, 9)}
    window = tuple(np.array(corner, np.int32) for corner in ((-3, 5), (SIZE[0] - 4, SIZE[1] + 4)))
    OpenEXR.File(header | {"dataWindow": window, "displayWindow": window}, dict(channels)).write(str(path))
    return channels


def layers(path: Path) -> list[np.ndarray]:
    return [
        layer.texel
        for layer in read_plate(path, FILM, frame_of(ThinLens(50.0, 1.4, 2.0, FILM)), DepthSettings()).layers
    ]


def picture(path: Path) -> list[np.ndarray]:
    return [read_picture(Path("scene"), "file", path)]


def save(**options: object) -> Callable[[Path], None]:
    shown = (255 * np.stack(list(planes(1.0).values())[:3], axis=2)).astype(np.uint8)
    return lambda path: Image.fromarray(shown).save(path, **options)


def radiance(path: Path) -> None:
    rows = np.full((SIZE[1], 4, SIZE[0]), 128, np.uint8)
    rows[:, :3] = (255 * RNG.random((SIZE[1], 3, SIZE[0]))).astype(np.uint8)
    coded = [b"\2\2" + struct.pack(">H", SIZE[0]) + b"".join(bytes([48]) + p.tobytes() for p in row) for row in rows]
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % SIZE[::-1]
    path.write_bytes(head + b"".join(coded))


FORMATS: dict[str, tuple[str, Callable[[Path], object], Callable[[Path], list[np.ndarray]], bool]] = {
    "two parts": ("exr", two_parts, layers, True),
    "deep": ("exr", deep, layers, True),
    "deep, tiles": ("exr", lambda p: deep(p, tiled=True), layers, True),
    "deep, runs": ("exr", lambda p: deep(p, "RLE"), layers, False),
    "deep, plain": ("exr", lambda p: deep(p, "NO"), layers, False),
    **{
        f"{method}{', tiles' if tiles else ''}": (
            "exr",
            lambda p, m=method, t=tiles: one_part(p, m, t),
            layers,
            method in ("ZIP", "ZIPS") and not tiles,
        )
        for method in ("ZIP", "ZIPS", "NO", "RLE", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB")
        for tiles in (0, 16)
    },
    "texture": ("exr", one_part, picture, True),
    "PNG": ("png", save(), picture, True),
    "JPEG": ("jpg", save(), picture, False),
    "progressive JPEG": ("jpg", save(progressive=True), picture, False),
    "TIFF": ("tif", save(), picture, False),
    "deflated TIFF": ("tif", save(compression="tiff_deflate"), picture, False),
    "BMP": ("bmp", save(), picture, False),
    "TGA": ("tga", save(), picture, False),
    "TGA in runs": ("tga", save(compression="tga_rle"), picture, False),
    "WebP": ("webp", save(), picture, False),
    "lossless WebP": ("webp", save(lossless=True), picture, False),
    "Radiance": ("hdr", radiance, picture, False),
}


@pytest.mark.parametrize("name", FORMATS)
def test_a_damaged_picture_is_refused_or_has_the_same_pixels(tmp_path: Path, name: str) -> None:
    suffix, write, read, checked = FORMATS[name]
    file, hurt = tmp_path / f"good.{suffix}", tmp_path / f"hurt.{suffix}"
    write(file)
    data, good, refused = file.read_bytes(), read(file), 0
    for percent in range(0, 100, 1 if WHOLE else 3):
        at = len(data) * percent // 100
        for damaged in (data[:at], data[:at] + bytes(40) + data[at + 40 :])[: 1 + checked]:
            hurt.unlink(missing_ok=True)  # a file system may wait for the disk where a file is cut and written again
            hurt.write_bytes(damaged)
            try:
                found = read(hurt)
            except InputError:
                refused += 1
            else:
                assert len(found) == len(good), percent
                assert all(np.array_equal(a, b) for a, b in zip(found, good, strict=True)), percent
    assert refused >= (100 if WHOLE else 34)


@pytest.mark.parametrize("tiled", [False, True])
@pytest.mark.parametrize("compression", ["NO", "RLE", "ZIPS"])
def test_layers_of_a_deep_file_are_its_opaque_samples_by_depth(tmp_path: Path, compression: str, tiled: bool) -> None:
    """Against the arrays that the OpenEXR library wrote, of halves, floats and integers."""
    written = deep(tmp_path / "deep.exr", compression, tiled)
    found = plate._layers(tmp_path / "deep.exr", DepthSettings(), several=True)
    deepest = 0
    for y, x in np.ndindex(SIZE[::-1]):
        alpha, z = written["A"][y, x].astype(np.float32), written["Z"][y, x]
        rows = np.flatnonzero(alpha >= 0.5)
        rows = rows[np.argsort(z[rows], kind="stable")][:8]
        deepest = max(deepest, len(rows))
        for k, (rgb, metres) in enumerate(found):
            if k < len(rows):
                wanted = [written[c][y, x][rows[k]].astype(np.float32) / alpha[rows[k]] for c in "RGB"]
                assert metres[y, x] == z[rows[k]] and rgb[y, x] == pytest.approx(wanted)
            else:
                assert metres[y, x] == (-np.inf if k else np.inf)
    assert len(found) == deepest == 8


def test_numbers_of_deep_samples_are_bounded_before_they_are_read(tmp_path: Path) -> None:
    deep(tmp_path / "deep.exr")
    data = bytearray((tmp_path / "deep.exr").read_bytes())
    (first,) = struct.unpack_from("<Q", data, _channels(bytes(data))[1])
    row, _, _, unpacked = struct.unpack_from("<i3Q", data, first)
    assert row == 5 and unpacked % 20 == 0  # two halves and four numbers of 4 bytes a sample
    struct.pack_into("<Q", data, first + 20, 20 << 30)
    (tmp_path / "bomb.exr").write_bytes(data)
    with pytest.raises(InputError, match="samples: got .*, expected at most 134217728 in all"):
        layers(tmp_path / "bomb.exr")


def test_values_of_all_parts_are_bounded_before_they_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    two_parts(tmp_path / "two.exr")
    monkeypatch.setattr(pictures, "_MOST_PARTS", 8 * SIZE[0] * SIZE[1])
    assert len(layers(tmp_path / "two.exr")) == 2
    monkeypatch.setattr(pictures, "_MOST_PARTS", 8 * SIZE[0] * SIZE[1] - 1)
    monkeypatch.setattr(OpenEXR, "File", Headers)
    with pytest.raises(InputError, match="values in its parts"):
        layers(tmp_path / "two.exr")


def test_parts_that_stand_elsewhere_are_left_out_with_a_word(tmp_path: Path) -> None:
    """A part of the first one's size, 9 pixels to the right, and one of another size."""
    shifted = tuple(np.array(corner, np.int32) for corner in ((9, 0), (SIZE[0] + 8, SIZE[1] - 1)))
    small = {name: plane[:8, :8].copy() for name, plane in planes(5.0).items()}
    display = {"displayWindow": tuple(np.array(corner, np.int32) for corner in ((0, 0), (SIZE[0] - 1, SIZE[1] - 1)))}
    parts = [
        OpenEXR.Part(ZIP | display, planes(2.0), name="front"),
        OpenEXR.Part(ZIP | display | {"dataWindow": shifted}, planes(3.0), name="aside"),
        OpenEXR.Part(ZIP | display, small, name="small"),
        OpenEXR.Part(ZIP | display, planes(8.0), name="behind"),
    ]
    OpenEXR.File(parts).write(str(tmp_path / "parts.exr"))
    with pytest.warns(NeurolensWarning, match="other data windows are left out: aside, small"):
        found = layers(tmp_path / "parts.exr")
    assert [layer[5, 5, 3] for layer in found] == pytest.approx([1 / 2, 1 / 8])


class Headers(OpenEXR.File):  # type: ignore[misc]
    """A file whose pixels must not be read."""

    def __init__(self, *args: object, header_only: bool = False, **more: object) -> None:
        assert header_only
        super().__init__(*args, header_only=True, **more)
