"""The tracer under what should not happen; gradients, and the graph's ray differentials against finite differences."""

import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from shipped import tabled
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.cameras.cameragraph import D_FILM
from neurolens.cameras.exact import ExactCamera
from neurolens.graph.interpret import evaluate
from neurolens.graph.loworder import with_film_derivatives
from neurolens.optics.lens.figures import Figure
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.lens.shot import Shot
from neurolens.optics.setting.pupils import camera_rays
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.rays import Rays, trace
from neurolens.optics.trace.tracegraph import exact_graph

with warnings.catch_warnings():
    warnings.simplefilter("ignore", NeurolensWarning)  # glasses of unknown dispersion
    DOUBLE_GAUSS = set_lens(tabled("laikin_double_gauss_50"))
    FISHEYE = set_lens(tabled("muller_fisheye_100"))
STOP = Surface(math.inf, 1, 10, stop=True)
PLATE = Lens("plate", "", (Surface(math.inf, 5, 20, 1.5), Surface(math.inf, 5, 20), STOP), 2.0)
BALL = Lens("ball", "", (Surface(10.0, 20, 19.9, 1.5), Surface(-10.0, 5, 19.9), STOP), 2.0)
TABLES = {"double gauss": DOUBLE_GAUSS, "fisheye": FISHEYE, "plate": PLATE, "ball": BALL}
WILD = (math.nan, math.inf, -math.inf, 1e-310, 1e-42, 1e20, 1e39, 1e300, -1e300, 0.0)


def rays(rows: list[list[float]], dtype: torch.dtype = torch.float64) -> Rays:
    return Rays(*torch.tensor(rows, dtype=torch.float64).to(dtype).T.contiguous())


def start_z(table: Lens, towards: str) -> float:
    return -30.0 if towards == "film" else float(table.vertices_mm[-1])


def good(table: Lens, towards: str) -> list[float]:
    return [0.1, 0.2, start_z(table, towards), 0.0, 0.0, 1.0 if towards == "film" else -1.0]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("towards", ["film", "scene"])
@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("record", [(), (0, 1, 2)])
def test_wild_numbers_end_a_ray_and_never_leave_as_one(
    name: str, towards: str, dtype: torch.dtype, record: tuple[int, ...]
) -> None:
    table = TABLES[name]
    rows = [good(table, towards) for _ in range(6 * len(WILD))]
    for i, row in enumerate(rows):
        row[i % 6] = WILD[i // 6]
    rows += [[0.0] * 6, [1.0, 1.0, 1.0, 1e-320, 0, -1e-320], [0.1, 0.2, 0.3, 0, 0, 2.0], good(table, towards)]
    start = rays(rows, dtype)
    out = trace(table, start, 500.0, towards=towards, transmittance=True, record=record)  # type: ignore[arg-type]
    for c in (*out.rays, out.transmittance):
        assert torch.isfinite(c).all()
    sound = torch.stack([torch.isfinite(c) for c in start]).all(0)
    unit = (start.dx**2 + start.dy**2 + start.dz**2 - 1).abs() < 1e-3
    assert (out.status[~(sound & unit)] != 0).all()
    assert out.status[-1] == 0


@pytest.mark.parametrize("wavelength", [math.nan, -500.0, 0.0, math.inf])
def test_a_wavelength_that_is_none(wavelength: float) -> None:
    start = rays([good(DOUBLE_GAUSS, "scene")] * 2)
    with pytest.raises(InputError, match="wavelength_nm"):
        trace(DOUBLE_GAUSS, start, wavelength)
    if wavelength == math.inf:
        return  # Cauchy's limit is finite
    out = trace(DOUBLE_GAUSS, start, torch.tensor([500.0, wavelength], dtype=torch.float64))
    assert (out.status != 0).tolist() == [False, True]
    assert all(torch.isfinite(c).all() for c in out.rays)


def test_the_rays_decide_the_precision() -> None:
    """A float64 wavelength beside float32 rays leaves float32."""
    start = rays([good(DOUBLE_GAUSS, "scene")] * 2, torch.float32)
    for wavelength in (torch.tensor([500.0, 600.0], dtype=torch.float64), torch.tensor([500, 600])):
        out = trace(DOUBLE_GAUSS, start, wavelength, transmittance=True, record=[3])
        assert {c.dtype for c in (*out.rays, out.transmittance, *out.crossings[3])} == {torch.float32}  # type: ignore[union-attr]


def fields(**changes: Tensor) -> Rays:
    return rays([good(PLATE, "film")] * 3)._replace(**changes)


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda: trace(PLATE, fields(y=torch.zeros(2).double())), "rays.y"),
        (lambda: trace(PLATE, fields(dz=torch.ones(3))), "rays.dz"),
        (lambda: trace(PLATE, Rays(*torch.zeros((6, 3, 1)))), "rays.x"),
        (lambda: trace(PLATE, Rays(*torch.zeros(6))), "rays.x"),
        (lambda: trace(PLATE, Rays(*torch.zeros((6, 3), dtype=torch.int64))), "int64"),
        (lambda: trace(PLATE, Rays(*torch.zeros((6, 3), dtype=torch.float16))), "float16"),
        (lambda: trace(PLATE, fields(), torch.full((2,), 500.0)), "wavelength_nm"),
        (lambda: trace(PLATE, fields(), torch.full((3, 1), 500.0)), "wavelength_nm"),
        (lambda: trace(PLATE, fields(), towards="sky"), "towards"),  # type: ignore[arg-type]
        (lambda: trace(PLATE, fields(), record=[3]), "record"),
        (lambda: trace(PLATE, fields(), record=[-1]), "record"),
    ],
)
def test_bad_arguments_name_themselves(call: Callable[[], object], named: str) -> None:
    with pytest.raises(InputError, match=named):
        call()


def test_camera_rays_that_start_away_from_the_lens_are_lost() -> None:
    for table in TABLES.values():
        row = good(table, "scene")
        row[5] = 1.0
        last = len(table.surfaces) - 1
        assert trace(table, rays([row])).status.tolist() == [st.blocked(last, st.MISSED)]


# ---- gradients ----


def with_parameters(values: Tensor) -> Lens:
    """A doublet with radius, thickness and index of its first element, conic and terms behind it, from a tensor [6]."""
    figure = Figure(values[3], ((4, 1e-5 * values[4]), (6, 1e-8 * values[5])))
    first = (
        Surface(values[0], values[1], 22, values[2], V_d=60.0),
        Surface(-45.0, 2.0, 22, 1.65, V_d=35.0, figure=figure),
    )
    return Lens("doublet", "", (*first, Surface(-200.0, 3.0, 22), Surface(math.inf, 50.0, 14, stop=True)), 4.0)


VALUES = torch.tensor([40.0, 5.0, 1.55, -0.4, -2.0, 1.0], dtype=torch.float64)
# The last five are lost: outside the rim, beyond the sphere, past every surface, backwards, NaN.
BUNDLE = [[x, y, -20.0, 0.02, 0.05, math.sqrt(1 - 0.0029)] for x in (-4.0, 0.0, 3.0) for y in (-5.0, 0.0, 2.0)] + [
    [10.0, 0.0, -20.0, 0.0, 0.0, 1.0],
    [100.0, 0.0, -20.0, 0.0, 0.0, 1.0],
    [0.0, 0.0, -20.0, 0.0, 0.8, 0.6],
    [0.0, 0.0, -20.0, 0.0, 0.0, -1.0],
    [math.nan, 0.0, -20.0, 0.0, 0.0, 1.0],
]


def moments(values: Tensor, start: Rays, wavelength: Tensor) -> Tensor:
    """A number that every output of the passing rays enters."""
    out = trace(with_parameters(values), start, wavelength, towards="film", transmittance=True)
    passed = out.status == 0
    assert 5 <= passed.sum() < len(start.x)
    terms = [
        (torch.cos(0.3 * (k + 1) * c) * (k + 1))[passed].sum() for k, c in enumerate((*out.rays, out.transmittance))
    ]
    return torch.stack(terms).sum()


def test_gradients_of_the_prescription_and_of_rays() -> None:
    """Against central differences; lost rays beside the others leave no NaN."""
    values, start = VALUES.clone().requires_grad_(), Rays(*(c.requires_grad_() for c in rays(BUNDLE)))
    wavelength = torch.linspace(420, 680, len(BUNDLE), dtype=torch.float64).requires_grad_()
    inputs = [values, *start, wavelength]
    grads = torch.autograd.grad(moments(values, start, wavelength), inputs)
    assert all(torch.isfinite(g[:9]).all() for g in grads)
    assert torch.isfinite(grads[0]).all()
    for which, (tensor, grad) in enumerate(zip(inputs, grads, strict=True)):
        for i in range(len(tensor) if which == 0 else 9):
            step = 1e-5 * max(1.0, abs(float(tensor.detach()[i])))
            ends = []
            for sign in (1, -1):
                moved = [t.detach().clone() for t in inputs]
                moved[which][i] += sign * step
                ends.append(float(moments(moved[0], Rays(*moved[1:7]), moved[7])))
            slope = (ends[0] - ends[1]) / (2 * step)
            assert float(grad.detach()[i]) == pytest.approx(slope, rel=2e-6, abs=2e-7), (which, i)


@pytest.mark.parametrize("towards", ["film", "scene"])
def test_no_nan_gradient_where_most_rays_are_lost(towards: str) -> None:
    """Misses, rims and total reflection in one batch, as the fisheye has them all."""
    g = torch.Generator().manual_seed(3)
    d = torch.randn((3, 2000), generator=g, dtype=torch.float64)
    d[2] = d[2].abs() * (1 if towards == "film" else -1)
    p = torch.randn((3, 2000), generator=g, dtype=torch.float64) * 60
    p[2] = start_z(FISHEYE, towards) + 0.1 * p[2]
    start = Rays(*(c.clone().requires_grad_() for c in (*p, *(d / d.norm(dim=0)))))
    first = replace(FISHEYE.surfaces[0], radius_mm=torch.tensor(float(FISHEYE.surfaces[0].radius_mm)).double())
    first.radius_mm.requires_grad_()
    table = replace(FISHEYE, surfaces=(first, *FISHEYE.surfaces[1:]))
    out = trace(table, start, 550.0, towards=towards, transmittance=True)  # type: ignore[arg-type]
    assert {st.MISSED, st.RIM} <= {int(s) % 4 for s in out.status if s >= 4}
    total = sum(c.sum() for c in out.rays) + out.transmittance.sum()
    assert isinstance(total, Tensor)
    for grad in torch.autograd.grad(total, [first.radius_mm, *start]):
        assert torch.isfinite(grad).all()


@pytest.mark.parametrize(
    "shape", [{}, {"radius_mm": math.inf}, {"figure": Figure(-0.4)}, {"figure": Figure(-0.4, ((4, -2e-5), (6, 1e-8)))}]
)
def test_a_ray_that_runs_backwards_spoils_no_gradient(shape: dict[str, Any]) -> None:
    """At the first surface its cosine of incidence is below 0, for which Fresnel's shares are 0 / 0 on the axis."""
    values, gradients = VALUES[:3].clone().requires_grad_(), []
    front = replace(Surface(values[0], values[1], 22, values[2], V_d=60.0), **shape)
    lens = Lens("singlet", "", (front, Surface(-45.0, 50.0, 22, stop=True)), 4.0)
    for bundle in (BUNDLE[:4], [*BUNDLE[:4], [0.0, 0.0, -20.0, 0.0, 0.0, -1.0]]):
        start = Rays(*(c.requires_grad_() for c in rays(bundle)))
        out = trace(lens, start, 550.0, towards="film", transmittance=True)
        assert out.transmittance is not None and (out.status[:4] == 0).all() and (out.status[4:] != 0).all()
        total = out.transmittance[:4].sum() + sum(c[:4].sum() for c in out.rays)
        gradients.append(torch.autograd.grad(total, [values, *start], allow_unused=True, materialize_grads=True))
    for alone, beside in zip(*gradients, strict=True):
        torch.testing.assert_close(beside[:4], alone)


@pytest.mark.parametrize(("y_mm", "nm"), [(0.0, math.nan), (0.0, 0.0), (0.0, -500.0), (1e200, 550.0)])
def test_a_bad_wavelength_or_a_coordinate_that_overflows_spoils_no_gradient(y_mm: float, nm: float) -> None:
    radius = torch.tensor(40.0, dtype=torch.float64, requires_grad=True)
    singlet = Lens("s", "", (Surface(radius, 5.0, 20.0, 1.6, 40.0), Surface(math.inf, 30.0, 20.0, stop=True)), 2.0)
    y, keep = torch.linspace(-8, 8, 9, dtype=torch.float64), torch.arange(9) != 4
    zero, gradients = torch.zeros_like(y), []
    for height, wavelength in ((0.0, 550.0), (y_mm, nm)):
        at, light = torch.where(keep, y, height), torch.where(keep, zero + 550.0, wavelength)
        out = trace(singlet, Rays(zero, at, zero - 5, zero, zero, zero + 1), light, towards="film")
        assert (out.status[keep] == 0).all()
        gradients.append(torch.autograd.grad((out.rays.dy[keep] ** 2).sum(), radius)[0])
    assert int(out.status[4]) == (st.OUTSIDE_DOMAIN if nm != 550.0 else st.blocked(0, st.MISSED))
    assert torch.equal(*gradients) and torch.isfinite(gradients[0])


def test_a_plane_given_as_a_tensor_has_a_gradient() -> None:
    radius = torch.tensor(math.inf, dtype=torch.float64, requires_grad=True)
    plate = Lens("p", "", (Surface(radius, 5.0, 20.0, 1.6), Surface(-30.0, 30.0, 20.0, stop=True)), 2.0)
    y = torch.linspace(-8, 8, 9, dtype=torch.float64)
    zero = torch.zeros_like(y)
    out = trace(plate, Rays(zero, y, zero - 5, zero, zero, zero + 1), towards="film")
    (slope,) = torch.autograd.grad(out.rays.dy.square().sum(), radius)
    assert (out.status == 0).all() and torch.isfinite(slope)


def asphere() -> Lens:
    front = Surface(30.0, 6.0, 24.0, 1.6, figure=Figure(conic=-0.6, asphere=((4, -1e-5), (6, 2e-8))))
    return Lens("asphere", "", (front, Surface(-80.0, 2.0, 24.0), Surface(math.inf, 40.0, 16.0, stop=True)), 2.0)


def lenses() -> dict[str, Lens]:
    names = ("laikin_double_gauss_50", "muller_fisheye_100")
    return {name: tabled(name) for name in names} | {"asphere": asphere()}


def film_rays(lens: Lens, fx: Tensor, fy: Tensor, px: Tensor, py: Tensor) -> Rays:
    """Camera rays towards points in the rear vertex plane."""
    film_z, pupil_z = set_lens(lens).film_z_mm, float(lens.vertices_mm[len(lens.surfaces) - 1])
    return camera_rays(fx, fy, film_z, px, py, pupil_z)


def differentials(lens: Lens, points: list[Tensor], kind: type = np.float64) -> tuple[np.ndarray, np.ndarray, list]:
    """Status [N], scene rays [6, N] and their derivatives by x and y of the film point, of the lens's graph."""
    nm, pupil_z = lens.reference_nm, float(lens.vertices_mm[len(lens.surfaces) - 1])
    graph = with_film_derivatives(exact_graph(lens, pupil_z, (nm, nm)))
    given = {"rays": np.stack([*(p.numpy() for p in points), np.full(len(points[0]), nm)])}
    given |= {"film_z_mm": np.array([[set_lens(lens).film_z_mm]]), "stop_radius_mm": np.array([[lens.stop_radius_mm]])}
    with np.errstate(all="ignore"):
        found = evaluate(graph, {name: value.astype(kind) for name, value in given.items()})
    return found["status"][0], found["scene_ray"], [found[name] for name in D_FILM]


@pytest.mark.parametrize("name", ["laikin_double_gauss_50", "muller_fisheye_100", "asphere"])
def test_equal_to_central_differences(name: str) -> None:
    lens = lenses()[name]
    g = torch.Generator().manual_seed(1)
    rear, f = lens.surfaces[-1].semi_diameter_mm, abs(first_order(lens).efl_mm)
    fx, fy, px, py = (torch.rand(400, generator=g, dtype=torch.float64) * 2 - 1 for _ in range(4))
    fx, fy, px, py = 0.3 * f * fx, 0.3 * f * fy, 0.5 * rear * px, 0.5 * rear * py
    status, _, moves = differentials(lens, [fx, fy, px, py])
    passed = status == 0
    assert passed.sum() > 100
    h = 1e-4
    for found, (ex, ey) in zip(moves, [(h, 0.0), (0.0, h)], strict=True):
        ahead, behind = (trace(lens, film_rays(lens, fx + s * ex, fy + s * ey, px, py)) for s in (1, -1))
        ok = passed & (ahead.status == 0).numpy() & (behind.status == 0).numpy()
        for one, a, b in zip(found, ahead.rays, behind.rays, strict=True):
            wanted = ((a - b) / (2 * h)).numpy()
            assert np.abs(one - wanted)[ok].max() < 1e-7 * (1 + np.abs(wanted[ok]).max())


def test_lost_rays_have_no_derivative() -> None:
    """Those of a camera that traces a steep asphere, from a film that is wider than its picture."""
    rng = np.random.default_rng(4)
    camera = ExactCamera(asphere(), Shot((90.0, 90.0), math.inf))
    film, square = (90 * (rng.random((2, 4000)) - 0.5)).astype(np.float32), rng.random((2, 4000), np.float32)
    rays = camera.sample_differentials(film, square, np.full(4000, 587.56, np.float32))
    lost = rays.status != 0
    assert lost.any() and not lost.all() and rays.differentials is not None
    for slope in (rays.differentials.origin_m, rays.differentials.direction):
        assert np.isfinite(slope).all() and (slope[..., lost] == 0).all()
    assert (rays.differentials.direction[..., ~lost] != 0).any((0, 1)).all()


def test_float32_gives_the_same_to_rounding() -> None:
    lens = set_lens(tabled("laikin_double_gauss_50"))
    points = [torch.linspace(-9, 9, 50, dtype=torch.float64) * k for k in (1.0, 0.5, 0.3, -0.4)]
    exact, rounded = (differentials(lens, points, kind) for kind in (np.float64, np.float32))
    ok = (exact[0] == 0) & (rounded[0] == 0)
    assert ok.sum() > 20
    for a, b in zip(np.concatenate(exact[2]), np.concatenate(rounded[2]), strict=True):
        assert np.abs(a - b)[ok].max() < 2e-5 * (1 + np.abs(a[ok]).max())


def test_one_wavelength_may_be_a_tensor_without_rows() -> None:
    """It is the number that it holds; one that is none loses every ray."""
    start = rays([good(DOUBLE_GAUSS, "scene")] * 2)
    number, tensor = trace(DOUBLE_GAUSS, start, 550.0), trace(DOUBLE_GAUSS, start, torch.tensor(550.0))
    assert torch.allclose(torch.stack(number.rays), torch.stack(tensor.rays)) and tensor.status.tolist() == [0, 0]
    assert trace(DOUBLE_GAUSS, start, torch.tensor(-550.0)).status.tolist() == [st.OUTSIDE_DOMAIN] * 2
