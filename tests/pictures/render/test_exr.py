"""Pictures survive the disk; what they say of their own pixels: sample count, variance, depth, blocked rays."""

from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from PIL import Image
from render_helpers import FILM, SIZE, WHITE, diffuse, files_of_at_most, lit_scene, scene

from neurolens.base.errors import InputError
from neurolens.cameras.contract import CameraRays
from neurolens.cameras.ideal import Pinhole, ThinLens
from neurolens.pictures.render import pictures
from neurolens.pictures.render.pictures import read_exr, read_layers, write_exr, write_png
from neurolens.pictures.render.renderer import Watch, render
from neurolens.pictures.render.settings import FilmSettings

PICTURE = np.random.default_rng(0).random((5, 7, 3), np.float32) * 10


@pytest.mark.parametrize("parts", [1, 2])
def test_of_many_channels_only_the_colours_are_read(
    parts: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of every type, with a window that does not begin at 0; the bound counts what is read."""
    random, path = np.random.default_rng(2), tmp_path / "a.exr"
    channels = {f"layer{k:03}": np.zeros((6, 9), np.float32) for k in range(150)}
    channels |= {"R": random.random((6, 9), np.float32), "G": random.random((6, 9)).astype(np.float16)}
    channels["B"] = random.integers(0, 9, (6, 9)).astype(np.uint32)
    header = {"type": OpenEXR.scanlineimage, "dataWindow": ((3, 4), (11, 9))}
    OpenEXR.File([OpenEXR.Part(header | {"name": f"part{k}"}, dict(channels)) for k in range(parts)]).write(str(path))
    monkeypatch.setattr(pictures, "_MOST_VALUES", 3 * 6 * 9)
    picture, _ = read_exr(path)
    assert picture.dtype == np.float32
    np.testing.assert_array_equal(picture, np.stack([channels[c].astype(np.float32) for c in "RGB"], -1))
    damaged = path.read_bytes()
    path.write_bytes(damaged[: len(damaged) * 2 // 3])
    with pytest.raises(InputError, match="a whole OpenEXR file"):
        read_exr(path)


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


# One wavelength: the film is grey, and light of radiance 1 gives 1 whatever the sample.
GREY: dict[str, Any] = {"wavelengths_nm": [550, 550], "position_m": [0, 0, 0], "look_at_m": [0, 0, -1]}


class Coin(Pinhole):
    """Weight 2 for half of the pupil and 0 for the other, of which a quarter of all is blocked."""

    def sample(self, film_mm: Any, pupil: Any, wavelength_nm: Any) -> CameraRays:
        rays = super().sample(film_mm, pupil, wavelength_nm)
        weight = np.where(pupil[0] < 0.5, np.float32(2), np.float32(0))
        status = np.where(pupil[0] < 0.75, 0, 6).astype(np.int32)
        return CameraRays(rays.origin_m, rays.direction, weight, status)


@pytest.mark.parametrize("mode", ["one", "hero"])
def test_variance_is_that_of_a_coin(mode: Any) -> None:
    """n tosses of 0 or 2, half of each (Sobol' points see to it): the variance of their mean is 1 / (n - 1)."""
    made, samples = scene(GREY, environment=WHITE), 64
    camera = Coin(4000.0, FILM, 1.0)
    found = render(made, camera, **SIZE, samples=samples, film=FilmSettings(wavelengths=mode))
    scale = float(found.rgb.mean())  # the coin's exposure
    assert found.rgb == pytest.approx(np.full((24, 36, 3), scale), rel=1e-3)
    assert found.layers.variance == pytest.approx(np.full((24, 36), scale**2 / (samples - 1)), rel=2e-2)
    assert np.all(found.layers.samples == samples)


def test_one_sample_has_no_variance_and_every_sample_is_counted() -> None:
    made = scene(GREY, environment=WHITE)
    one = render(made, Pinhole(400.0, FILM), **SIZE, samples=1).layers
    assert np.all(np.isinf(one.variance)) and np.all(one.samples == 1)
    odd = render(made, Pinhole(400.0, FILM), **SIZE, samples=37).layers
    assert np.all(odd.samples == 37) and np.all(odd.variance < 1e-6)


def test_variance_follows_the_noise_of_renders_with_other_seeds() -> None:
    """A rough scene at few samples: Sobol' points do better than independent ones, by less than an order."""
    made = lit_scene(camera=GREY)
    found = [render(made, ThinLens(50.0, 2.0, 3.0, FILM), **SIZE, samples=8, seed=s) for s in range(12)]
    scatter = np.var([f.rgb[..., 1] for f in found], axis=0, ddof=1).mean()
    stated = np.mean([f.layers.variance for f in found])
    assert 0.7 < stated / scatter < 10


@pytest.mark.parametrize("camera", [Pinhole(30.0, FILM), ThinLens(30.0, 1.4, 3.0, FILM)], ids=["pinhole", "thin"])
def test_depth_is_measured_along_the_axis_from_the_film(camera: Any) -> None:
    """A wall across the axis 3 m from the film has depth 3 everywhere, wherever the camera looks."""
    wall = {"point_m": [5.0, 1.0, 0.0], "normal": [1, 0, 0], "material": "m"}
    pose = {"position_m": [2.0, 1.0, 0.0], "look_at_m": [9.0, 1.0, 0.0]}
    made = scene(pose, materials={"m": diffuse(0.5, 0.5, 0.5)}, planes=[wall])
    depth = render(made, camera, **SIZE, samples=4).layers.depth
    assert depth == pytest.approx(np.full((24, 36), 3.0), rel=1e-5)


def test_depth_is_infinite_where_nothing_is_and_the_mean_of_what_is() -> None:
    """A floor below a pinhole: at height y on the film the floor is at height / tan, and above the horizon nothing."""
    floor = {"point_m": [0, -1, 0], "normal": [0, 1, 0], "material": "m"}
    made = scene(GREY, materials={"m": diffuse(0.5, 0.5, 0.5)}, planes=[floor])
    found = render(made, Pinhole(20.0, FILM), **SIZE, samples=256).layers
    assert np.all(np.isinf(found.depth[:12])) and np.all(np.isfinite(found.depth[12:]))
    assert not found.blocked.any()
    # The image distance is the focal length; the pinhole lies that far in front of the film.
    for row in (14, 18, 23):
        low, high = (row - 12) / 20, (row - 11) / 20
        mean = np.log(high / low) / (high - low)
        assert found.depth[row].mean() == pytest.approx(mean, abs=0.025 + 0.01 * mean)


def test_blocked_is_the_share_of_camera_rays_that_do_not_pass() -> None:
    found = render(scene(GREY, environment=WHITE), Coin(400.0, FILM), **SIZE, samples=64).layers
    # Half of the coin weighs 0: nothing passes there either.
    assert found.blocked == pytest.approx(np.full((24, 36), 0.5), abs=1e-6)


def test_previews_come_while_the_render_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """So many samples take longer than the first preview, which is white where there is anything."""
    monkeypatch.setattr("neurolens.pictures.render.film.BATCH", 16 * 100)
    shown: list[Any] = []
    watch = Watch(preview=shown.append, preview_s=0, stop=lambda: len(shown) > 1)
    made = scene(GREY, environment=WHITE)
    found = render(made, Pinhole(4000.0, FILM), **SIZE, samples=100_000, watch=watch)
    assert not found.stats.complete and found.layers.samples.max() < 100_000
    for preview in (*shown, found.rgb):
        lit = preview > 0
        assert lit.any() and preview[lit] == pytest.approx(np.ones(np.count_nonzero(lit)), rel=1e-4)


def test_a_preview_that_cannot_be_written_is_told_once_and_the_render_goes_on(tmp_path: Path) -> None:
    told: list[str] = []

    def fails(_: Any) -> None:
        raise PermissionError(13, "Permission denied", "p.png")

    watch = Watch(preview=fails, preview_s=0, note=told.append)
    made = scene(environment=WHITE)
    found = render(made, Pinhole(50.0, FILM), width=90, height=60, samples=64, threads=1, watch=watch)
    assert found.stats.complete and told == ["preview not written: p.png: Permission denied"]
