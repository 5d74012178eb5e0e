"""Radiance pictures against OpenCV's reader and by hand; stray values; an environment of 8192 by 4096 pixels."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.pictures.render import images, pictures
from neurolens.pictures.render.images import read_radiance

HEADER = b"#?RADIANCE\n# a comment\nFORMAT=32-bit_rle_rgbe\n\n"


def read(data: bytes) -> np.ndarray:
    return read_radiance(data, lambda width, height: None)[0]


def plain(size: bytes, *pixels: tuple[int, int, int, int]) -> bytes:
    return HEADER + size + b"\n" + bytes(v for pixel in pixels for v in pixel)


@pytest.mark.parametrize("shape", [(5, 300), (3, 7), (2, 40000)])  # rows with runs, too short and too long for them
def test_pictures_are_those_that_opencv_reads(shape: tuple[int, int], tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    wanted = 10 ** rng.uniform(-6, 6, (*shape, 3)).astype(np.float32)
    wanted[:, shape[1] // 2 :] = wanted[:, :1]  # long runs
    wanted[0, 0] = 0
    cv2.imwrite(str(tmp_path / "a.hdr"), wanted[..., ::-1])
    found = images.read_picture(tmp_path, "file", tmp_path / "a.hdr", most=1 << 16)
    assert np.array_equal(found, cv2.imread(str(tmp_path / "a.hdr"), cv2.IMREAD_UNCHANGED)[..., ::-1])
    assert np.all(np.abs(found - wanted) <= wanted.max(axis=-1, keepdims=True) / 127)  # of a shared exponent


def test_axes_turn_the_picture() -> None:
    first, second = (128, 64, 0, 129), (255, 1, 1, 120)
    colours = np.array([[1.0, 0.5, 0.0], np.array([255, 1, 1]) * 2.0**-16], np.float32)
    four = [first, second, (0, 0, 0, 0), (9, 9, 9, 0)]
    upright = read(plain(b"-Y 2 +X 2", *four))
    assert np.array_equal(upright, [colours, np.zeros((2, 3))])  # an exponent of 0 is black
    assert np.array_equal(read(plain(b"+Y 2 +X 2", *four)), upright[::-1])
    assert np.array_equal(read(plain(b"-Y 2 -X 2", *four)), upright[:, ::-1])


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"P6 2 2", "begin with"),
        (HEADER, "no line with its size"),
        (HEADER + b"-Y 0 +X 4\n", "no line with its size"),
        (HEADER + b"+X 2 -Y 2\n" + bytes(16), "no line with its size"),
        (HEADER.replace(b"rgbe", b"xyze") + b"-Y 1 +X 1\n" + bytes(4), "xyze"),
        (HEADER + b"-Y 1 +X 9000\n" + bytes(36000), "at most 8192 pixels per side"),
        (HEADER + b"-Y 8192 +X 8192\n", "cut short"),
        (HEADER + b"-Y 1 +X 9\n\2\2\0\x08" + bytes(36), "another width"),
        (HEADER + b"-Y 1 +X 9\n\2\2\0\x09\0", "damaged"),
        (HEADER + b"-Y 1 +X 9\n\2\2\0\x09" + b"\xff\1" * 4, "longer than its row"),
        (plain(b"-Y 1 +X 4", *[(9, 9, 9, 9), (1, 1, 1, 3)] * 2), "runs of whole pixels"),
    ],
)
def test_damaged_pictures_are_named(data: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.hdr").write_bytes(data)
    with pytest.raises(InputError, match=f"environment.file.*a.hdr.*{message}"):
        images.read_environment(tmp_path / "s.toml", "environment.file", tmp_path / "a.hdr")


def test_no_mutation_of_a_picture_raises_anything_else(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    cv2.imwrite(str(tmp_path / "a.hdr"), rng.random((4, 16, 3), np.float32))
    whole = (tmp_path / "a.hdr").read_bytes()
    kept = 0

    def check(width: int, height: int) -> None:
        pictures.check_size("", "", "", (width, height), 64, 4096)

    for _ in range(3000):
        data = bytearray(whole[: rng.integers(1, len(whole) + 1)] if rng.random() < 0.3 else whole)
        for place in rng.integers(0, len(data), rng.integers(1, 4)):
            data[place] = rng.choice([0, 1, 2, 127, 128, 129, 255, rng.integers(256)])
        try:
            read_radiance(bytes(data), lambda width, height: pictures.check_size("", "", "", (width, height), 64, 4096))
            kept += 1
        except ValueError:  # InputError is one
            pass
    assert 0 < kept < 3000


def test_what_a_header_asks_for_and_is_not_done_is_said(tmp_path: Path) -> None:
    (tmp_path / "a.hdr").write_bytes(
        plain(b"-Y 1 +X 2", *[(64, 64, 64, 129)] * 2).replace(b"# a", b"EXPOSURE=2.0\n# a")
    )
    with pytest.warns(NeurolensWarning, match=r"textures.*a\.hdr.*without EXPOSURE=2\.0"):
        found = images.read_pictures(tmp_path / "s.toml", {"textures.a.file": tmp_path / "a.hdr"})
    assert np.array_equal(found["textures.a.file"], np.full((1, 2, 3), 0.5))


@pytest.mark.parametrize("stray", [np.inf, -np.inf, -3.0, np.nan])
def test_stray_pixels_are_clamped_counted_and_placed(stray: float, tmp_path: Path) -> None:
    """An infinite pixel stands for a light that 16-bit floats do not hold: it becomes the brightest finite one."""
    pixels = np.full((4, 8, 3), 0.25, np.float32)
    pixels[3, 1, 0] = 7.0  # of a texture, more light than falls on it
    pixels[1, 6, 2] = pixels[2, 7, 0] = stray
    pictures.write_channels(tmp_path / "a.exr", {n: pixels[..., k].copy() for k, n in enumerate("RGB")}, pictures.SRGB)
    for most, bad in ((7.0, 2), (1.0, 3)):
        with pytest.warns(NeurolensWarning) as said:
            if most == 7:
                found = images.read_environment(tmp_path / "s.toml", "environment.file", tmp_path / "a.exr")
            else:
                found = images.read_pictures(tmp_path / "s.toml", {"textures.t.file": tmp_path / "a.exr"})
                found = found["textures.t.file"]
        assert f"a.exr: {bad} of 32 pixels" in str(said[0].message)
        assert "first in row 2 from the top, column 7" in str(said[0].message)
        wanted = np.where(pixels == stray, most if stray == np.inf else 0, np.minimum(pixels, most))
        wanted[np.isnan(pixels)] = 0
        assert np.array_equal(found, wanted)
