"""Rays of `neurolens rays`: the frames of the hosts by their own pinholes, weights, samples, files, and mistakes."""

import errno
import math
import os
import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import failure, run_json

import neurolens
from neurolens.base.errors import InputError
from neurolens.cameras.build import make_camera
from neurolens.cameras.contract import Camera
from neurolens.graph.compiler import has_compiler
from neurolens.optics.lens.shot import Shot
from neurolens.pictures.render.film import PixelGrid
from neurolens.programs.hosts import HOSTS, RayJob, RaySettings, from_compact, resampled

ROOT = Path(__file__).parents[2]
MODEL = ROOT / "models" / "laikin_double_gauss_50.ols-60.onnx"
FILM, SIZE = (36.0, 24.0), (24, 16)
FOCAL_PX = 50.0 / FILM[0] * SIZE[0]
POSE: dict[str, Any] = {"position_m": (1.0, 2.0, 3.0), "look_at_m": (1.5, 1.0, -1.0)}


def picture(camera: str | Path = "pinhole", **settings: Any) -> dict[str, Any]:
    return neurolens.rays(camera, FILM, width=SIZE[0], **{"samples": 16, "focus_m": 1.5} | settings)


@cache
def model(f_number: float | None = 1.8, focus_m: float = 1.5) -> Camera:
    return make_camera(f"fused:{MODEL}" if has_compiler() else MODEL, Shot(FILM, focus_m, f_number))


def job(f_number: float | None = 1.8, focus_m: float = 1.5, **settings: Any) -> RayJob:
    """The rays of the model that `picture(MODEL, ...)` has, with a camera that tests share."""
    return RayJob(model(f_number, focus_m), PixelGrid(*SIZE, FILM), RaySettings(**{"samples": 16} | settings), focus_m)


def lens(**settings: Any) -> dict[str, Any]:
    return job(**settings).arrays()


def ray_of(host: str, arrays: dict[str, Any]) -> tuple[Any, Any]:
    """Origins and directions [H, W, S, 3], as the arrays of a host are laid out in its own source."""
    if host == "newton":  # camera_rays[y, x, sample, 0 or 1]
        return arrays["camera_rays"][..., 0, :], arrays["camera_rays"][..., 1, :]
    if host == "gsplat":  # rays[camera, y, x]: ox oy oz dx dy dz
        rays = np.moveaxis(arrays["rays"], 0, 2)
        return rays[..., :3], rays[..., 3:]
    if host == "3dgrut":  # [batch, y, x, 3]
        return np.moveaxis(arrays["rays_ori"], 0, 2), np.moveaxis(arrays["rays_dir"], 0, 2)
    return arrays["origin"], arrays["direction"]


def pixel_of(host: str, d: Any) -> tuple[Any, Any]:
    """Where the host's own pinhole of this focal length has directions in its camera's frame, in pixels."""
    x, y, z = np.moveaxis(d, -1, 0)
    if host in ("newton", "opengl"):  # u 2 h aspect, -v 2 h, -1 (and nerfstudio: x, -y, -1)
        x, y = x / -z, y / z
    elif host == "mitsuba":  # +x is to the left of the picture, +y up, +z ahead
        x, y = -x / z, -y / z
    else:  # (px + 0.5 - cx) / fx, (py + 0.5 - cy) / fy, 1
        x, y = x / z, y / z
    return FOCAL_PX * x + SIZE[0] / 2, FOCAL_PX * y + SIZE[1] / 2


@pytest.mark.parametrize("host", HOSTS)
def test_the_pinhole_of_each_host_sees_every_ray_in_its_own_pixel(host: str) -> None:
    found = picture(to=host, origin="pupil", **POSE)
    origin, direction = ray_of(host, found)
    turn, place = found["to_world"][:3, :3], found["to_world"][:3, 3]
    if host == "gsplat":  # the world; its cameras stand at to_world
        origin, direction = (origin - place) @ turn, direction @ turn
    np.testing.assert_allclose(np.abs(origin).max(), 0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=-1), 1, atol=1e-6)
    x, y = pixel_of(host, direction)
    rows, columns = np.mgrid[: SIZE[1], : SIZE[0]]
    for found_px, pixel in ((x, columns), (y, rows)):
        inside = found_px - pixel[..., None]
        assert inside.min() > -1e-4 and inside.max() < 1 + 1e-4
        # Stratified: each quarter of a pixel's width holds a quarter of its samples.
        counts = np.sort(np.floor(4 * np.clip(inside, 0.001, 0.999)).astype(int), axis=-1)
        assert (counts == np.repeat(np.arange(4), 4)).mean() > 0.99


def places(direction: Any) -> Any:
    """Where a pinhole picture has the directions of 3DGRUT's camera frame, in pixels: tensors [..., 2]."""
    torch = pytest.importorskip("torch")
    return FOCAL_PX * direction[..., :2] / direction[..., 2:] + torch.tensor(SIZE) / 2


def test_the_pinhole_of_3dgrut_itself_makes_our_rays() -> None:
    utils = pytest.importorskip("threedgrut.datasets.utils", reason="needs 3DGRUT's sources")
    found = picture(to="3dgrut", origin="pupil", device="cpu")
    rows, columns = np.mgrid[: SIZE[1], : SIZE[0]]
    pixels = np.broadcast_to(np.stack([columns, rows], -1), found["rays_dir"][..., :2].shape).reshape(-1, 2)
    inside = places(found["rays_dir"]).reshape(-1, 2) - pixels
    origin, along = utils.pinhole_camera_rays(*pixels.T, FOCAL_PX, FOCAL_PX, *SIZE, ray_jitter=lambda _: inside)
    np.testing.assert_allclose(origin, found["rays_ori"].reshape(-1, 3), atol=1e-6)
    np.testing.assert_allclose(along, found["rays_dir"].reshape(-1, 3), atol=1e-6)


def test_the_pinhole_of_gsplat_itself_makes_our_rays() -> None:
    cameras = pytest.importorskip("gsplat.cuda._torch_cameras", reason="needs gsplat from 1.6.0 on")
    torch = pytest.importorskip("torch")
    found, frame = (picture(to=to, origin="pupil", device="cpu", **POSE) for to in ("gsplat", "3dgrut"))
    sizes = {"principal_points": torch.tensor([SIZE]) / 2, "focal_lengths": torch.full((1, 2), FOCAL_PX)}
    pose = cameras._viewmat_to_pose(torch.linalg.inv(found["to_world"].float())[None])
    camera = cameras._BaseCameraModel.create(*SIZE, "pinhole", **sizes)
    at = places(frame["rays_dir"]).reshape(1, -1, 2)
    origin, along, _ = camera.image_point_to_world_ray_shutter_pose(at, pose, pose)
    np.testing.assert_allclose(origin[0], found["rays"][..., :3].reshape(-1, 3), atol=1e-6)
    np.testing.assert_allclose(along[0], found["rays"][..., 3:].reshape(-1, 3), atol=1e-6)


def test_the_pinhole_of_nerfstudio_itself_makes_our_rays() -> None:
    """In the world, and the areas of pixels that the how-to has."""
    cameras = pytest.importorskip("nerfstudio.cameras.cameras", reason="needs nerfstudio")
    found, frame = (picture(to=to, origin="pupil", device="cpu", **POSE) for to in ("opengl", "3dgrut"))
    turn, place = found["to_world"][:3, :3].float(), found["to_world"][:3, 3].float()
    camera = cameras.Cameras(found["to_world"][None, :3].float(), FOCAL_PX, FOCAL_PX, SIZE[0] / 2, SIZE[1] / 2, *SIZE)
    for s, at in enumerate(places(frame["rays_dir"])):
        rays = camera.generate_rays(0, coords=at.flip(-1))
        np.testing.assert_allclose(rays.origins, found["origin"][:, :, s] @ turn.T + place, atol=1e-6)
        np.testing.assert_allclose(rays.directions, found["direction"][:, :, s] @ turn.T, atol=1e-6)
        area = found["direction"][:, :, s, 2:].abs() ** 3 / FOCAL_PX**2  # theirs is that of a pixel to the right
        np.testing.assert_allclose(rays.pixel_area, area, rtol=0.03)


@pytest.mark.parametrize("host", HOSTS)
def test_one_seed_gives_every_host_the_same_rays_of_the_world(host: str) -> None:
    ours, theirs = (lens(to=name, seed=7, units_per_m=100.0, **POSE) for name in ("opengl", host))
    rays = []
    for name, arrays in (("opengl", ours), (host, theirs)):
        origin, direction = ray_of(name, arrays)
        turn, place = arrays["to_world"][:3, :3], arrays["to_world"][:3, 3]
        np.testing.assert_allclose(place, [100, 200, 300])
        rays.append((origin, direction) if name == "gsplat" else (origin @ turn.T + place, direction @ turn.T))
    passed = ours["weight"] > 0
    for a, b in zip(*rays, strict=True):
        np.testing.assert_allclose(a[passed], b[passed], atol=1e-4)
    if HOSTS[host].samples_first:
        theirs["weight"] = np.moveaxis(theirs["weight"], 0, 2)
    np.testing.assert_array_equal(ours["weight"], theirs["weight"])
    # What is on the axis and in focus lies on the rays of the middle, 1.5 m from the film.
    middle = rays[1][0][7:9, 11:13][passed[7:9, 11:13]], rays[1][1][7:9, 11:13][passed[7:9, 11:13]]
    axis = np.subtract(POSE["look_at_m"], POSE["position_m"])
    target = 100 * (np.array(POSE["position_m"]) + 1.5 * axis / np.linalg.norm(axis))
    along = ((target - middle[0]) * middle[1]).sum(-1, keepdims=True)
    pixel = 150 / FOCAL_PX
    assert np.linalg.norm(middle[0] + along * middle[1] - target, axis=-1).max() < 2 * pixel


def test_weights_of_a_pinhole_are_the_cos4_law() -> None:
    found = picture()
    np.testing.assert_allclose(found["weight"], found["direction"][..., 2] ** 4, rtol=1e-4)
    colours = picture(weights="rgb", samples=256)["weight"]
    even = colours[7:9, 11:13].mean(axis=(0, 1, 2))
    np.testing.assert_allclose(even, (found["direction"][7:9, 11:13, :, 2] ** 4).mean(), rtol=5e-3)


def test_samples_drawn_again_come_as_often_as_their_weights_ask() -> None:
    weight = np.random.default_rng(3).random((500, 16), np.float32) ** 4
    weight[:, ::3] = 0
    weight[7] = 0
    chosen = resampled(weight, np.random.default_rng(4).random(500, np.float32)).reshape(500, 16)
    assert (chosen // 16 == np.arange(500)[:, None]).all()  # also of a row without light
    counts = np.stack([np.bincount(row % 16, minlength=16) for row in chosen])
    lit = np.arange(500) != 7
    expected = 16 * weight[lit].astype(float) / weight[lit].astype(float).sum(1, keepdims=True)
    assert (np.abs(counts[lit] - expected) < 1).all()  # systematic: never a whole sample off
    assert not counts[lit][weight[lit] == 0].any()


def test_the_plain_mean_of_rays_by_importance_is_the_weighted_mean() -> None:
    """For a value that changes over the pupil, over many seeds; and the rays are among those with weights."""
    difference = []
    for seed in range(24):
        kept, drawn = (lens(samples=8, seed=seed, weights=w, f_number=None) for w in ("kept", "importance"))
        value = [1e3 * a["origin"][..., 0] + 2 for a in (kept, drawn)]
        np.testing.assert_allclose(drawn["weight"], kept["weight"].mean(-1), rtol=1e-6)
        difference.append(drawn["weight"] * value[1].mean(-1) - (kept["weight"] * value[0]).mean(-1))
        same = (drawn["direction"][..., :, None, :] == kept["direction"][..., None, :, :]).all(-1)
        assert same.any(-1).all()
    each = np.mean(difference, axis=(1, 2))  # of a seed
    assert np.std(each) < 0.1 and abs(each.mean()) < 4 * np.std(each, ddof=1) / math.sqrt(len(each))


def test_wavelengths_are_shared_evenly_and_the_light_is_that_of_film() -> None:
    named = lens(wavelengths=(611.0, 549.0, 464.0))["wavelength_nm"]
    assert all((np.abs((named == nm).sum(-1) - 16 / 3) < 1.4).all() for nm in (611, 549, 464))
    light = picture(samples=64)["wavelength_nm"]
    assert 400 <= light.min() < 410 and 690 < light.max() <= 700
    assert (np.abs(light - 550) < 75).mean() > 0.6  # half of the range


def test_newton_sees_black_where_the_lens_stops_a_ray() -> None:
    found = lens(to="newton", f_number=None)
    lost = found["weight"] == 0
    assert 0 < lost.mean() < 0.05
    length = np.linalg.norm(found["camera_rays"][..., 1, :], axis=-1)
    np.testing.assert_allclose(length, np.where(lost, 0, 1), atol=1e-6)


# ---- Rays in 16 bytes. -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("host", [name for name in HOSTS if name != "gsplat"])
def test_rays_in_16_bytes_are_those_in_32_within_what_they_say(host: str) -> None:
    made = job(samples=4, to=host, compact=True, units_per_m=10.0)
    packed, whole = made.arrays(), lens(samples=4, to=host, units_per_m=10.0)
    a_ray = sum(v.nbytes for v in packed.values() if v.ndim > 2) / packed["weight"].size
    assert a_ray == 16 and 0 < made.compact_px < 0.01
    shift = HOSTS[host].samples_first
    origin, direction = (np.moveaxis(v, 0, 2) if shift else v for v in from_compact(packed))
    weight = np.moveaxis(packed["weight"], 0, 2) if shift else packed["weight"]
    there, along = ray_of(host, whole)
    passed = weight > 0
    origin, direction, there, along = (v[passed] for v in (origin, direction, there, along))
    np.testing.assert_allclose(direction, along, atol=1e-6)
    # In the plane in focus, 1.5 m from the film, in pixels as it shows them.
    far = 15 * np.sign(along[0, 2])
    a, b = ((o + d * (far - o[:, 2:]) / d[:, 2:])[:, :2] for o, d in ((origin, direction), (there, along)))
    pixel = 15 / FOCAL_PX
    off = np.hypot(*(a - b).T) / pixel
    assert off.max() < 1.2 * made.compact_px + 2e-4  # a pixel of the lens is not quite that of the pinhole; float32


def test_rays_in_16_bytes_are_refused_where_they_would_be_off() -> None:
    with pytest.raises(InputError, match="off by at most 0.01 pixels, not 0.0"):
        RayJob(model(focus_m=0.7), PixelGrid(16384, 10923, FILM), RaySettings(compact=True), 0.7)
    with pytest.raises(InputError, match="within 80 degrees"):
        neurolens.rays("fisheye-equidistant", FILM, width=24, compact=True, focal_length_mm=10.0)
    with pytest.raises(InputError, match="in the camera's frame"):
        picture(to="gsplat", compact=True)


# ---- The command. ----------------------------------------------------------------------------------------------------

LINE = ("rays", "thin", "--width", SIZE[0], "--film", "36x24", "--focus", 1.5, "--f-number", 1.8, "--quiet")


def thin(**settings: Any) -> dict[str, Any]:
    return picture("thin", f_number=1.8, **settings)


def test_the_command_writes_what_the_function_returns(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    said = run_json(capsys, *LINE, "--to", "3dgrut", "--seed", 5, "--samples", 4, "-o", tmp_path / "rays.npz")
    asked = thin(to="3dgrut", seed=5, samples=4)
    with np.load(tmp_path / "rays.npz", allow_pickle=False) as file:
        for name, array in asked.items():
            np.testing.assert_array_equal(file[name], array)
    assert said["frames"][0]["arrays"]["rays_dir"] == [4, SIZE[1], SIZE[0], 3]
    assert list(tmp_path.iterdir()) == [tmp_path / "rays.npz"]
    torch = pytest.importorskip("torch")
    tensors = picture(to="3dgrut", device="cpu")
    assert torch.equal(tensors["rays_dir"], torch.from_numpy(picture(to="3dgrut")["rays_dir"]))


def test_frames_move_the_focus_and_the_camera(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    keys = ("--key", "focus=1:1,3:2", "--key", "position=1:0/0/0,3:0/2/0", "--samples", 1)
    line = [word for word in LINE if word not in ("--focus", 1.5)]
    run_json(capsys, *line, "--frames", "1:3", *keys, "-o", tmp_path / "pull.npz")
    files = [np.load(tmp_path / f"pull.{k:04d}.npz") for k in (1, 2, 3)]
    np.testing.assert_allclose([f["to_world"][1, 3] for f in files], [0, 1, 2])
    for file, focus in zip(files, (1.0, 4 / 3, 2.0), strict=True):  # linear in 1/m
        np.testing.assert_allclose(file["direction"], thin(samples=1, focus_m=focus)["direction"], atol=1e-6)


def test_an_exr_has_a_layer_a_sample(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    from neurolens.pictures.render.pictures import read_channels

    for samples, first in ((1, ""), (2, "s1.")):
        run_json(capsys, *LINE, "--samples", samples, "--to", "gsplat", "-o", tmp_path / "rays.exr")
        planes, about = read_channels(tmp_path / "rays.exr")
        rays = thin(to="gsplat", samples=samples)
        np.testing.assert_array_equal(planes[f"{first}direction.Z"], rays["rays"][-1, ..., 5])
        np.testing.assert_array_equal(planes[f"{first}weight"], rays["weight"][-1])
        assert about["to"] == "gsplat" and len(planes) == 8 * samples


def test_safetensors_hold_the_same(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    numpy = pytest.importorskip("safetensors.numpy", reason='needs the extra "rays"')
    run_json(capsys, *LINE, "--samples", 2, "--compact", "-o", tmp_path / "rays.safetensors")
    found, wanted = numpy.load_file(tmp_path / "rays.safetensors"), thin(samples=2, compact=True)
    assert set(found) == set(wanted)
    for name, array in wanted.items():
        np.testing.assert_array_equal(found[name], array)


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="files cannot be given their room here")
def test_a_full_disk_is_named_with_what_it_lacks(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def full(file: int, start: int, size: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    said = failure(capsys, *LINE, "-o", tmp_path / "rays.npz")
    assert re.search(rf"{tmp_path}/rays\.npz: No space left on device, for \d\S* GB", said)
    assert not list(tmp_path.iterdir())


def test_mistakes_are_one_line_and_leave_nothing(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "rays.npz"
    for words, said in (
        (("-o", tmp_path / "rays.pt"), "one of .npz, .safetensors, .exr"),
        (("-o", tmp_path / "rays.exr", "--compact"), f"got '{tmp_path / 'rays.exr'}', expected no --compact"),
        (("-o", out, "--seed", 1 << 63), f"an integer from 0 to {(1 << 63) - 1}"),
        (("-o", out, "--samples", 0), "from 1 to 65536"),
        (("-o", out, "--position", "1,2"), "X,Y,Z"),
        (("-o", out, "--position", "0,0,0", "--look-at", "0,0,0"), "look_at_m"),
        (("-o", out, "--wavelengths", "550,x"), "wavelengths in nm"),
        (("-o", out, "--wavelengths", "550", "--weights", "rgb"), "left out"),
        (("-o", out, "--frames", "1:2", "--key", "focus=1:2"), "--key focus sets it"),
        (("-o", out, "--compact", "--to", "gsplat"), "camera's frame"),
    ):
        assert said in failure(capsys, *LINE, *words)
    assert not list(tmp_path.iterdir())
    for settings, said in (
        ({"focus": 2.0}, "rays: focus: got 2.0, expected one of: .*focus_m"),
        ({"to": "unity"}, "to: got 'unity', expected one of: opengl"),
        ({"device": "nowhere"}, "device: got 'nowhere', expected a device that torch has here"),
        ({"samples": 1 << 16, "width": 16384, "height": 10923}, "of .* GB"),
        ({"width": 4.5}, "width: got 4.5, expected an integer"),
        ({"samples": 1.5}, "samples: got 1.5, expected an integer"),
        ({"seed": -1}, "seed: got -1, expected an integer from 0"),
        ({"film": (36, 0)}, "film: .* a width and a height"),
        ({"film": 36}, "film: got 36, expected a width and a height"),
        ({"camera": "no_such_lens", "film": None}, r"no_such_lens: camera: got \(missing\)"),
        ({"position_m": (0, 0)}, "position_m: .* three numbers"),
        ({"up": (0, math.nan, 0)}, "up: .* three numbers"),
        ({"wavelengths": []}, "wavelengths: .* one or more in nm"),
        ({"wavelengths": 550}, "wavelengths: got 550, expected one or more in nm"),
        ({"camera": MODEL, "wavelengths": [550, 850]}, "wavelengths: .* from 400 to 700 nm"),
    ):
        with pytest.raises(InputError, match=said):
            neurolens.rays(**{"camera": "pinhole", "film": FILM, "width": 24} | settings)
    assert picture(wavelengths=[850.0], samples=np.int64(1))["wavelength_nm"].max() == 850  # it has no dispersion
