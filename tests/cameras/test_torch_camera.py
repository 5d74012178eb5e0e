"""`neurolens.programs.torch.LensCamera`: the rays of numpy's camera; gradients beside differences and closed forms."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.build import make_camera
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.shot import Shot
from neurolens.pictures.render.film import PixelGrid
from neurolens.programs.torch import LensCamera

ROOT = Path(__file__).parents[2]
GAUSS = ROOT / "models" / "laikin_double_gauss_50.ols-60.onnx"
SINGLET = ROOT / "lenses" / "thorlabs_lb1471_biconvex_50.toml"
FILM = (36.0, 24.0)
SHOT = Shot(FILM, 2.0, f_number=4.0)


@cache
def camera_of(file: Path = GAUSS, shot: Shot = SHOT, dtype: torch.dtype = torch.float32) -> LensCamera:
    return LensCamera(file, shot, dtype=dtype)


def inputs(count: int, dtype: torch.dtype = torch.float32, reach: float = 1.0) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(1)
    film, square = torch.rand(count, 2, generator=g, dtype=dtype), torch.rand(count, 2, generator=g, dtype=dtype)
    return reach * (film - 0.5) * torch.tensor(FILM, dtype=dtype), square


@pytest.mark.parametrize("file", [GAUSS, SINGLET])
def test_rays_are_those_of_the_renderers_camera(file: Path) -> None:
    """In float32 by C, and by torch in float64."""
    shot = SHOT if file == GAUSS else Shot((8.0, 8.0), math.inf, f_number=8.0)
    film, square = inputs(4000, reach=0.2 if file == SINGLET else 1.2)  # 1.2: beyond the model's picture, too
    light = torch.linspace(420, 680, 4000)
    other = make_camera(str(file), shot).sample(film.T.numpy(), square.T.numpy(), light.numpy())
    for dtype in (torch.float32, torch.float64):
        rays = camera_of(file, shot, dtype)(film.to(dtype), square.to(dtype), light.to(dtype))
        differ = rays.status.numpy() != other.status
        assert differ.mean() < 1e-3  # within rounding of an edge
        passed = (rays.status.numpy() == st.PASSED) & ~differ
        assert passed.mean() > 0.6
        np.testing.assert_allclose(rays.origin.T.numpy()[:, passed], other.origin_m[:, passed], atol=2e-7)
        np.testing.assert_allclose(rays.direction.T.numpy()[:, passed], other.direction[:, passed], atol=2e-6)
        np.testing.assert_allclose(rays.weight.numpy()[passed], other.weight[passed], rtol=2e-4)
        lost = rays.status != st.PASSED
        assert not rays.weight[lost].any() and bool(torch.isfinite(rays.origin).all())


def test_pixels_are_those_of_pictures() -> None:
    grid = PixelGrid(90, 60, FILM)
    pixel = np.array([0, 89, 4321])
    found = camera_of().film_points(torch.tensor(np.stack([pixel % 90 + 0.25, pixel // 90 + 0.75], 1)), (90, 60))
    np.testing.assert_allclose(found.T, grid.film_points(pixel, np.array([[0.25], [0.75]], np.float32)), atol=1e-5)
    corner = camera_of().film_points(torch.tensor([[0, 0], [90, 60], [45, 30]]), (90, 60))  # whole numbers
    assert corner.tolist() == [[18.0, -12.0], [-18.0, 12.0], [0.0, 0.0]]


def test_gradients_are_differences() -> None:
    """By film points, random numbers, wavelengths and poses, in float64."""
    camera = camera_of(dtype=torch.float64)
    film, square = inputs(600, torch.float64, 0.9)
    light = torch.linspace(450, 650, 600, dtype=torch.float64)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64))[0]
    pose = torch.cat([turn, torch.tensor([[1.0], [2.0], [3.0]], dtype=torch.float64)], 1)
    given = [t.requires_grad_() for t in (film, square, light, pose)]
    factor = torch.randn(600, 7, generator=torch.Generator().manual_seed(3), dtype=torch.float64)

    def value(*given: Tensor) -> Tensor:
        rays = camera(*given[:3], pose=given[3])
        assert bool((rays.status == st.PASSED).all())
        return (torch.cat([rays.origin, 10 * rays.direction, rays.weight[:, None]], 1) * factor).sum(1)

    with torch.no_grad():  # those whose neighbours pass, too
        inside = torch.ones(600, dtype=torch.bool)
        for step in (-1e-3, 1e-3):
            for axis in range(2):
                moved = square.clone()
                moved[:, axis] += step
                inside &= camera(film, moved.clamp(0, 1 - 1e-9), light).status == st.PASSED
    factor, given = factor[inside], [t.detach()[inside].requires_grad_() for t in given[:3]] + [given[3]]
    gradients = torch.autograd.grad(value(*given).sum(), given)
    for k, (gradient, step) in enumerate(zip(gradients, (1e-4, 1e-6, 1e-2, 1e-4), strict=True)):
        for axis in range(gradient.shape[1] if gradient.ndim > 1 else 1):
            way = torch.zeros_like(gradient)
            way[(..., axis) if gradient.ndim > 1 else ...] = step
            with torch.no_grad():
                ends = [value(*(g + s * way if i == k else g for i, g in enumerate(given))) for s in (-1, 1)]
            difference = (ends[1] - ends[0]) / (2 * step)
            found = gradient[..., axis] if gradient.ndim > 1 else gradient
            if k == 3:
                assert float(difference.sum()) == pytest.approx(float(found.sum()), rel=1e-6)
            else:
                off = (difference - found).abs() / found.abs().mean()
                assert float(off.median()) < 1e-6 and float(off.quantile(0.98)) < 1e-3


@pytest.mark.parametrize("file", [GAUSS, SINGLET])
def test_float32_has_the_gradients_of_float64(file: Path) -> None:
    found, shot = [], SHOT if file == GAUSS else Shot((8.0, 8.0), math.inf, f_number=8.0)
    for dtype in (torch.float32, torch.float64):
        film, square = (t.to(dtype).requires_grad_() for t in inputs(2000, reach=0.9 if file == GAUSS else 0.2))
        rays = camera_of(file, shot, dtype)(film, square)
        value = (rays.origin + rays.direction).sum() + rays.weight.sum()
        found.append(torch.autograd.grad(value, [film, square]))
    for single, double in zip(*found, strict=True):
        assert float((single - double).abs().quantile(0.99)) < 3e-4 * float(double.abs().mean()) + 1e-6


def spread(rays: Any) -> Tensor:
    """Root mean square of the rays' distance from their middle, where they start."""
    return (rays.origin - rays.origin.mean(0))[:, :2].square().sum(1).mean().sqrt()


def test_the_beam_is_as_wide_as_the_stop() -> None:
    """On the axis its width goes with 1 / N."""
    f_number = torch.tensor(4.0, requires_grad=True)
    rays = camera_of()(torch.zeros(4000, 2), inputs(4000)[1], f_number=f_number)
    width = spread(rays)
    width.backward()
    assert float(f_number.grad) == pytest.approx(-float(width.detach()) / 4, rel=0.02)
    wider = spread(camera_of()(torch.zeros(4000, 2), inputs(4000)[1], f_number=3.9))
    assert float(wider / width.detach()) == pytest.approx(4 / 3.9, rel=2e-3)


@pytest.mark.parametrize("clamp", [False, True])
def test_the_widest_stop_closes_only(clamp: bool) -> None:
    camera = camera_of(shot=Shot(FILM, 2.0, clamp_f_number=clamp))
    widest = 1 / camera._start("f_number")
    f_number = torch.nn.Parameter(torch.tensor([widest]))
    width = spread(camera(torch.zeros(4000, 2), inputs(4000)[1], f_number=f_number))
    width.backward()
    assert float(f_number.grad) == pytest.approx(-float(width.detach()) / widest, rel=0.1)  # its edge is curved
    with pytest.raises(InputError, match="a number from 1.8"):
        camera(torch.zeros(4, 2), inputs(4)[1], f_number=0.97 * widest)


def test_a_mask_in_the_stop_is_tested() -> None:
    """Half of the opening: half of the rays; by torch as by C."""
    mask = Aperture(mask=np.tile(np.arange(64) < 32, (64, 1)))
    shot, square = Shot(FILM, 2.0, f_number=4.0, aperture=mask), inputs(4000)[1]
    single, double = (
        LensCamera(GAUSS, shot, dtype=t)(torch.zeros(4000, 2, dtype=t), square.to(t))
        for t in (torch.float32, torch.float64)
    )
    passed = single.status == st.PASSED
    assert float(passed.float().mean()) == pytest.approx(0.5, abs=0.03)
    assert float(((double.status == st.PASSED) != passed).float().mean()) < 2e-3


def test_rays_meet_where_the_lens_is_focused() -> None:
    """Rays of the film's centre: the distance at which they are nearest to the axis is the focus."""
    focus = torch.tensor(2.0, requires_grad=True)
    rays = camera_of()(torch.zeros(4000, 2), inputs(4000)[1], focus_m=focus)
    slope = rays.direction[:, :2] / rays.direction[:, 2:]
    start = rays.origin[:, :2] - slope * rays.origin[:, 2:]
    distance = (start * slope).sum() / slope.square().sum()
    assert float(distance.detach()) == pytest.approx(2.0, rel=0.01)  # spherical aberration
    distance.backward()
    assert float(focus.grad) == pytest.approx(1.0, rel=0.05)


def test_lost_rays_have_no_gradient_and_a_batch_may_be_empty() -> None:
    film = torch.tensor([[0.0, 0.0], [500.0, 0.0], [math.nan, 0.0]], requires_grad=True)
    square = torch.full((3, 2), 0.4, requires_grad=True)
    focus = torch.tensor(2.0, requires_grad=True)
    rays = camera_of()(film, square, focus_m=focus)
    assert (rays.status == st.PASSED).tolist() == [True, False, False]
    assert not rays.weight[1:].any()
    ((rays.origin + rays.direction).sum(1) / rays.weight).sum().backward()  # of lost rays NaN and infinite
    for tensor in (film, square):
        assert tensor.grad is not None and tensor.grad[0].any() and not tensor.grad[1:].any()
    assert focus.grad is not None and math.isfinite(float(focus.grad))
    empty = camera_of()(torch.zeros(0, 2, requires_grad=True), torch.zeros(0, 2))
    assert empty.origin.shape == (0, 3) and empty.weight.shape == (0,)
    empty.origin.sum().backward()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: LensCamera("pinhole", SHOT), "a lens file or a model"),
        (lambda: camera_of()(torch.zeros(3, 3), torch.zeros(3, 2)), r"film_mm.*shape \(3, 2\)"),
        (lambda: camera_of()(torch.zeros(3, 2), torch.zeros(2, 2)), r"square.*shape \(3, 2\)"),
        (lambda: camera_of()(torch.zeros(3, 2), torch.zeros(3, 2), torch.zeros(2)), r"wavelength_nm.*\(\) or \(3,\)"),
        (lambda: camera_of()(torch.zeros(3, 2), torch.zeros(3, 2), pose=torch.eye(3)), r"pose.*\(3, 4\) or \(4, 4\)"),
        (lambda: camera_of()(torch.zeros(3, 2), torch.zeros(3, 2), focus_m=torch.ones(2)), "one number"),
        (lambda: camera_of()(torch.zeros(3, 2), torch.zeros(3, 2), focus_m=-2.0), "a number from 1.8"),
        (lambda: camera_of()(torch.zeros(3, 2), torch.zeros(3, 2), aperture=2.0), "one of focus_m, f_number, zoom"),
        (lambda: camera_of()(torch.zeros(3, 2), torch.zeros(3, 2), f_number=8.0), "a number from 3.77.* to 4.25"),
        (lambda: camera_of()(torch.zeros(3, 2), torch.zeros(3, 2), focus_m=math.nan), "a number from 1.8"),
        (lambda: camera_of()(torch.zeros(3, 2), torch.zeros(3, 2), zoom=50.0), "a shot whose zoom is a focal length"),
    ],
)
def test_what_it_cannot_do_is_one_line(call: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        call()
