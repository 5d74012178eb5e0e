"""Pictures survive the disk: layouts, types, metadata, and errors worth reading."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image
from render_helpers import files_of_at_most

from neurolens.base.errors import InputError
from neurolens.render.pictures import read_exr, read_layers, write_exr, write_png

PICTURE = np.random.default_rng(0).random((5, 7, 3), np.float32) * 10


@pytest.mark.parametrize(
    "layout",
    [
        lambda a: a,
        lambda a: np.asfortranarray(a),
        lambda a: np.ascontiguousarray(a[::-1])[::-1],
        lambda a: np.ascontiguousarray(a.transpose(2, 0, 1)).transpose(1, 2, 0),
        lambda a: np.repeat(np.repeat(a, 2, axis=0), 2, axis=1)[::2, ::2],
        lambda a: a.astype(np.float64),
        lambda a: a.astype(">f4"),
    ],
)
def test_float_picture_comes_back_exactly_from_any_layout(layout: Callable, tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    write_exr(path, layout(PICTURE), half=False)
    rgb, metadata = read_exr(path)
    assert rgb.dtype == np.float32 and np.array_equal(rgb, PICTURE) and metadata == {}
    assert list(tmp_path.iterdir()) == [path]
    write_exr(path, layout(PICTURE).astype(np.int32))
    assert np.array_equal(read_exr(path)[0], np.floor(PICTURE))


def test_half_rounds_and_clips(tmp_path: Path) -> None:
    write_exr(tmp_path / "h.exr", PICTURE * 1e4, half=True)
    rgb, _ = read_exr(tmp_path / "h.exr")
    assert np.array_equal(rgb, np.minimum(PICTURE * 1e4, 65504).astype(np.float16).astype(np.float32))


@pytest.mark.parametrize("half", [False, True])
def test_channels_are_named_and_metadata_is_one_json_text(half: bool, tmp_path: Path) -> None:
    path, metadata = tmp_path / "a.exr", {"camera": {"efl_mm": 50.1, "name": "Doppel-Gauß"}, "f": None, "list": [1, 2]}
    kept = deepcopy(metadata)
    write_exr(path, PICTURE, half=half, metadata=metadata)
    assert metadata == kept == read_exr(path)[1]
    file = OpenEXR.File(str(path), separate_channels=True)
    assert sorted(file.channels()) == ["B", "G", "R"]
    assert file.channels()["R"].pixels.dtype == (np.float16 if half else np.float32)
    assert isinstance(file.header()["neurolens"], str)


def test_layers_come_back_exactly_beside_the_picture(tmp_path: Path) -> None:
    path, numbers = tmp_path / "a.exr", np.random.default_rng(2)
    layers = {
        "samples": np.full((5, 7), 100_001),
        "depth": numbers.random((5, 7)),
        "variance": numbers.random((7, 5)).T,
    }
    layers["depth"][2, 3] = np.inf
    write_exr(path, PICTURE, half=True, layers=layers)
    found = read_layers(path)
    assert sorted(found) == ["depth", "samples", "variance"]
    assert all(np.array_equal(found[name], np.float32(layers[name])) for name in layers)
    assert np.array_equal(read_exr(path)[0], PICTURE.astype(np.float16).astype(np.float32))
    file = OpenEXR.File(str(path), separate_channels=True)
    assert sorted(file.channels()) == ["B", "G", "R", "Z", "samples", "variance"]  # Z is what other programs know
    for wrong in ({"depth": np.zeros((7, 5))}, {"R": np.zeros((5, 7))}, {"a": np.full((5, 7), np.nan)}):
        with pytest.raises(InputError, match="layer"):
            write_exr(path, PICTURE, layers=wrong)
    with pytest.raises(InputError, match="missing"):
        read_layers(tmp_path / "none.exr")


@pytest.mark.parametrize(
    ("rgb", "metadata", "field"),
    [
        (np.zeros((4, 4)), {}, "shape"),
        (np.zeros((0, 4, 3)), {}, "shape"),
        (np.full((2, 2, 3), np.nan), {}, "not finite"),
        (np.full((2, 2, 3), 1e300), {}, "not finite"),
        (np.zeros((2, 2, 3), complex), {}, "type"),
        (PICTURE, {"a": {1, 2}}, "metadata"),
        (PICTURE, {"a": float("nan")}, "metadata"),
    ],
)
def test_bad_pictures_are_refused_and_leave_the_old_file(
    rgb: np.ndarray, metadata: dict, field: str, tmp_path: Path
) -> None:
    path = tmp_path / "a.exr"
    write_exr(path, PICTURE)
    with pytest.raises(InputError, match=field):
        write_exr(path, rgb, metadata=metadata)
    assert np.array_equal(read_exr(path)[0], PICTURE) and list(tmp_path.iterdir()) == [path]


def test_a_disk_that_is_too_small_leaves_the_old_pictures(tmp_path: Path) -> None:
    exr, png = tmp_path / "a.exr", tmp_path / "a.png"
    write_exr(exr, PICTURE)
    write_png(png, PICTURE)
    large = np.random.default_rng(3).random((300, 300, 3))
    before = png.read_bytes()
    with files_of_at_most(20_000):
        with pytest.raises(InputError, match=r"a\.exr: file: got \(.*File too large"):
            write_exr(exr, large)
        with pytest.raises(OSError) as failed:
            write_png(png, large)
    assert failed.value.filename == str(png)
    assert np.array_equal(read_exr(exr)[0], PICTURE) and png.read_bytes() == before
    assert sorted(tmp_path.iterdir()) == [exr, png]


def test_bad_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="missing"):
        read_exr(tmp_path / "none.exr")
    with pytest.raises(InputError, match="folder"):
        write_exr(tmp_path / "no" / "a.exr", PICTURE)
    path = tmp_path / "a.exr"
    write_exr(path, np.random.default_rng(1).random((64, 64, 3)))
    whole = path.read_bytes()
    for content in (b"", b"not a picture", whole[: len(whole) // 2]):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"a\.exr"):
            read_exr(path)


def test_preview_is_srgb_at_the_asked_exposure(tmp_path: Path) -> None:
    path = tmp_path / "p.png"
    write_png(path, np.full((2, 3, 3), 0.5), exposure=-1.0)
    # 0.25 linear is 137 in 8-bit sRGB; above 1 clips.
    assert np.all(np.asarray(Image.open(path)) == 137)
    write_png(path, np.full((2, 3, 3), 7.0))
    assert np.all(np.asarray(Image.open(path)) == 255)
    with pytest.raises(InputError, match="shape"):
        write_png(path, np.zeros((2, 3)))
