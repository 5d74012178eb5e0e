"""Toroids, biconics and ideal thin lenses: closed forms, 50 digits, point images, first-order data, what is refused."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from mpmath import mp, mpf, polyroots
from torch import Tensor

from neurolens.base.errors import InputError
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph
from neurolens.models.assemble import Form, sag
from neurolens.optics.analysis.field_curves import seidel
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.analysis.psf import psf
from neurolens.optics.lens.figures import Biconic, Cylinder, Figure, Ideal, Qcon, Toroid, figure_of
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.readers.lensfile import read_lens, write_lens
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.rays import Rays, trace
from neurolens.optics.trace.shapes import sag_and_derivatives, sag_mm
from neurolens.optics.trace.surfaces import meet_front
from neurolens.pictures.flare.ghosts import GhostTracer

GLASS = 1.6
TOROID: dict[str, Any] = {"cylinder": "y", "across": (34.0, None)}
BICONIC: dict[str, Any] = {"cylinder": "x", "conic": -0.7, "across": (34.0, 0.6)}


def singlet(radius_mm: float, **shape: Any) -> Lens:
    """One curved surface, a plane back and a stop behind, too wide to clip."""
    front = Surface(radius_mm, 6.0, 24.0, GLASS, figure=figure_of(shape))
    return Lens("one", "", (front, Surface(math.inf, 1.0, 60.0), Surface(math.inf, 40.0, 60.0, stop=True)), 2.0)


def random_rays(count: int, dtype: torch.dtype = torch.float64) -> Rays:
    """From 20 mm before the vertex, up to 40 degrees from the axis."""
    g = torch.Generator().manual_seed(3)
    x, y, u, v = (torch.rand(4, count, generator=g, dtype=torch.float64) - 0.5) * 24
    u, v = u / 16, v / 16
    norm = (1 + u * u + v * v).sqrt()
    points = x - 20 * u, y - 20 * v, torch.full_like(x, -20.0)
    return Rays(*(c.to(dtype) for c in (*points, u / norm, v / norm, 1 / norm)))


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize(("conic", "other"), [(0.0, None), (-1.3, -1.3), (0.4, 0.4)])
def test_equal_sections_are_a_surface_of_revolution(axis: str, conic: float, other: float | None) -> None:
    rays = random_rays(4000)
    one = trace(singlet(21.0, conic=conic, cylinder=axis, across=(21.0, other)), rays, towards="film")
    two = trace(singlet(21.0, conic=conic), rays, towards="film")
    assert torch.equal(one.status, two.status) and (one.status == 0).sum() > 1000
    torch.testing.assert_close(torch.stack(one.rays), torch.stack(two.rays), rtol=0, atol=1e-12)


def test_sections_have_their_closed_forms() -> None:
    h = np.linspace(-11, 11, 23)
    curve: dict[str, Any] = {"conic": -0.8, "asphere": ((2, 1e-3), (4, 3e-5), (5, 1e-7))}
    toroid = Surface(-19.0, 1.0, 24.0, figure=Toroid(cylinder="x", across_mm=34.0, **curve))
    own = Surface(-19.0, 1.0, 24.0, figure=Figure(**curve))
    assert np.allclose(sag_mm(toroid, h, 0 * h), sag_mm(own, h, 0 * h), rtol=0, atol=1e-15)
    assert np.allclose(sag_mm(toroid, 0 * h, h), 34 - np.sqrt(34**2 - h * h), rtol=0, atol=1e-14)
    biconic = Surface(25.0, 1.0, 24.0, figure=figure_of(BICONIC))
    for x, y, radius, conic in ((h, 0 * h, 25.0, -0.7), (0 * h, h, 34.0, 0.6)):
        wanted = h * h / radius / (1 + np.sqrt(1 - (1 + conic) * (h / radius) ** 2))
        assert np.allclose(sag_mm(biconic, x, y), wanted, rtol=0, atol=1e-15)


def torus(at: tuple[Any, ...], radius: Any, turned: Any) -> Any:
    """Of degree four in coordinates (x, y, z) of any arithmetic, 0 on the torus of a circle along y."""
    (x, y, z), arm = at, turned - radius
    s = x * x + y * y + (z - turned) * (z - turned) + arm * arm - radius * radius
    return s * s - 4 * arm * arm * (x * x + (z - turned) * (z - turned))


def test_a_torus_is_met_where_its_quartic_ends_and_bends_rays_by_its_normal() -> None:
    """Roots of the quartic and normals by differences of it, both with 50 digits."""
    radius, turned = -22.0, 34.0
    rays = random_rays(60)
    out = trace(singlet(radius, **TOROID), rays, towards="film", path=True)
    passed = torch.nonzero(out.status == 0)[:, 0].tolist()
    assert len(passed) > 25
    with mp.workdps(50):
        r, big, step = mpf(radius), mpf(turned), mpf(10) ** -15
        for k in passed:
            p, d = ([mpf(float(c[k])) for c in part] for part in (rays[:3], rays[3:]))
            values = [torus(tuple(a + t * b for a, b in zip(p, d, strict=True)), r, big) for t in range(5)]
            roots = polyroots(_quartic(values), maxsteps=200, extraprec=200)
            way = min((t.real for t in roots if abs(t.imag) < mpf(10) ** -20), key=lambda t: abs(p[2] + t * d[2]))
            hit = [a + way * b for a, b in zip(p, d, strict=True)]
            found = [float(c[k]) for c in out.path[0]]
            assert max(abs(a - b) for a, b in zip(hit, found[:3], strict=True)) < 1e-13
            slope = [_difference(hit, axis, step, r, big) for axis in range(3)]
            length = mp.sqrt(sum(v * v for v in slope))
            n = [v / length * mp.sign(slope[2]) for v in slope]
            cos = sum(a * b for a, b in zip(n, d, strict=True))
            bend = mp.sqrt(1 - (1 - cos * cos) / mpf(GLASS) ** 2) - cos / mpf(GLASS)
            wanted = [a / mpf(GLASS) + bend * b for a, b in zip(d, n, strict=True)]
            assert max(abs(a - b) for a, b in zip(wanted, found[3:], strict=True)) < 1e-14


def _quartic(values: list[Any]) -> list[Any]:
    """Coefficients, highest first, of the polynomial of degree four through values at 0, 1, 2, 3, 4."""
    matrix = mp.matrix(5, 5)
    for row in range(5):
        for k in range(5):
            matrix[row, k] = mpf(row) ** (4 - k)
    return list(mp.lu_solve(matrix, mp.matrix(values)))


def _difference(at: list[Any], axis: int, step: Any, radius: Any, turned: Any) -> Any:
    ends = [tuple(v + sign * step * (k == axis) for k, v in enumerate(at)) for sign in (1, -1)]
    return (torus(ends[0], radius, turned) - torus(ends[1], radius, turned)) / (2 * step)


@pytest.mark.parametrize("shape", [TOROID, BICONIC, TOROID | {"conic": -1.0, "asphere": ((4, 2e-5),)}])
def test_the_front_of_a_model_is_the_surface_that_is_traced(shape: dict[str, Any]) -> None:
    lens = singlet(-25.0, **shape)
    x, y = (0.6 * c for c in random_rays(200)[:2])
    g = Graph()
    g.outputs["z"] = sag(g.input("xy", 2), lens.surfaces[0], Form())
    z = sag_mm(lens.surfaces[0], x.numpy(), y.numpy())
    assert np.allclose(evaluate(g, {"xy": np.stack([x, y])})["z"], z, rtol=0, atol=1e-13)
    out = trace(lens, random_rays(200), towards="film", path=True)
    met = (out.status == 0).numpy()
    back = [c.numpy() for c in random_rays(200)]
    found = meet_front(lens.surfaces[0], Rays(*back[:3], *(-c for c in back[3:])))
    assert np.allclose(np.stack(found)[:, met], torch.stack(out.path[0][:2]).numpy()[:, met], rtol=0, atol=1e-10)
    _, zx, zy = sag_and_derivatives(lens.surfaces[0], x.numpy(), y.numpy())
    step = 1e-5
    for slope, dx, dy in ((zx, step, 0.0), (zy, 0.0, step)):
        ends = (sag_mm(lens.surfaces[0], x.numpy() + s * dx, y.numpy() + s * dy) for s in (1, -1))
        assert np.allclose(slope, np.subtract(*ends) / (2 * step), rtol=0, atol=1e-9)


@pytest.mark.parametrize(("axis", "other"), [("x", "y"), ("y", "x")])
@pytest.mark.parametrize("conic", [None, -1.0])
def test_each_section_has_its_focal_length(axis: Any, other: Any, conic: float | None) -> None:
    lens = singlet(25.0, cylinder=axis, across=(-34.0, conic))
    assert first_order(lens, meridian=axis).efl_mm == pytest.approx(25 / (GLASS - 1), rel=1e-14)
    assert first_order(lens, meridian=other).efl_mm == pytest.approx(-34 / (GLASS - 1), rel=1e-14)
    twice = lens.scaled(2.0)
    assert first_order(twice, meridian=other).efl_mm == pytest.approx(-68 / (GLASS - 1), rel=1e-14)
    assert lens.anamorphic and lens.sha256 != singlet(25.0, cylinder=axis).sha256


FOCAL = 50.0


def ideal(focal_mm: float = FOCAL) -> Lens:
    return Lens("ideal", "", (Surface(math.inf, 70.0, 40.0, stop=True, figure=Ideal(focal_mm=focal_mm)),), 2.0)


def cone(point: Tensor, dtype: torch.dtype) -> Rays:
    """Rays from a point to all places of the lens."""
    g = torch.Generator().manual_seed(1)
    xy = (torch.rand(2, 500, generator=g, dtype=torch.float64) - 0.5) * 28
    d = torch.stack([*xy, torch.zeros(500, dtype=torch.float64)]) - point[:, None]
    d = d / d.norm(dim=0) * torch.sign(-point[2])
    return Rays(*(c.to(dtype) for c in (*point[:, None].expand(3, 500), *d)))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@pytest.mark.parametrize("focal_mm", [FOCAL, -30.0])
@pytest.mark.parametrize("point", [(0.0, 0.0, -80.0), (60.0, -45.0, -120.0), (-400.0, 90.0, -200.0), (20.0, 9.0, 25.0)])
def test_an_ideal_lens_images_every_point_to_a_point(
    focal_mm: float, point: tuple[float, float, float], dtype: torch.dtype
) -> None:
    at = torch.tensor(point, dtype=torch.float64)  # the last is virtual: rays go towards it
    out = trace(ideal(focal_mm), cone(at, dtype), towards="film").rays
    far = 1 / (1 / focal_mm + 1 / point[2])  # 1 / s + 1 / s' = 1 / f, s = -z
    x, y = (a + far * d / out.dz for a, d in ((out.x, out.dx), (out.y, out.dy)))
    error = torch.hypot(x - point[0] * far / point[2], y - point[1] * far / point[2]).max()
    assert error < (1e-12 if dtype == torch.float64 else 4e-6) * max(abs(far), 100.0) * 3


def test_an_ideal_lens_is_reversible_and_keeps_areas_of_height_and_slope() -> None:
    rays = cone(torch.tensor([9.0, -30.0, -75.0], dtype=torch.float64), torch.float64)
    there = trace(ideal(), rays, towards="film").rays
    back = trace(ideal(), Rays(*there[:3], *(-c for c in there[3:])), towards="scene").rays
    torch.testing.assert_close(torch.stack(back[3:]), -torch.stack(rays[3:]), rtol=0, atol=1e-15)
    # (height, slope) before to (height, slope) behind: a shear, whose determinant is 1, at any field.
    given = torch.tensor([7.0, 0.4], dtype=torch.float64)

    def pass_lens(v: Tensor) -> Tensor:
        norm = (1 + v[1] ** 2).sqrt()
        zero = torch.zeros(1, dtype=torch.float64)
        out = trace(ideal(), Rays(v[:1], zero, zero, v[1:] / norm, zero, zero + 1 / norm), towards="film").rays
        return torch.cat([out.x, out.dx / out.dz])

    matrix = torch.autograd.functional.jacobian(pass_lens, given)
    assert torch.linalg.det(matrix).item() == pytest.approx(1.0, abs=1e-14)
    assert matrix[1, 0].item() == pytest.approx(-1 / FOCAL, rel=1e-14)


def test_ideal_lenses_add_up_to_first_order() -> None:
    first = Surface(math.inf, 20.0, 30.0, figure=Ideal(focal_mm=80.0))
    pair = Lens("two", "", (first, Surface(math.inf, 40.0, 30.0, stop=True, figure=Ideal(focal_mm=-120.0))), 4.0)
    data = first_order(pair)
    assert 1 / data.efl_mm == pytest.approx(1 / 80 - 1 / 120 + 20 / (80 * 120), rel=1e-14)
    assert data.back_focus_mm == pytest.approx(data.efl_mm * (1 - 20 / 80), rel=1e-14)
    far = set_lens(pair, focus_m=math.inf)
    assert far.film_z_mm == pytest.approx(20 + data.back_focus_mm)
    assert trace(far, random_rays(50), towards="film", transmittance=True).transmittance.max() == 1  # type: ignore[union-attr]


def test_what_an_ideal_lens_has_not_is_refused_by_name() -> None:
    lens = set_lens(replace(ideal(), half_field_deg=10.0), focus_m=math.inf)
    with pytest.raises(InputError, match=r"surface 0, focal_mm: got 50.0, expected surfaces of glass.*reflections"):
        GhostTracer(lens)
    with pytest.raises(InputError, match="no optical path"):
        psf(Scene(lens), [0.0])
    with pytest.raises(InputError, match="no Seidel sums"):
        seidel(Scene(lens))


@pytest.mark.parametrize("qcon", [(0.1, -0.02), (1e-3,) * 20])
def test_a_front_of_forbes_in_a_model(qcon: tuple[float, ...]) -> None:
    front = Surface(-25.0, 6.0, 24.0, GLASS, figure=Qcon(qcon=qcon, norm_mm=12.0))
    h = np.linspace(-12, 12, 97)
    wanted = sag_mm(front, 0.6 * h, 0.8 * h)
    for form, tolerance in ((Form(sag_terms=0), 1e-13), (Form(), 2e-6)):
        g = Graph()
        g.outputs["z"] = sag(g.input("xy", 2), front, form)
        found = evaluate(g, {"xy": torch.from_numpy(np.stack([0.6 * h, 0.8 * h]))})["z"]
        assert np.abs(found.numpy() - wanted).max() < tolerance


ROWS = {
    "toroid": 'cylinder = "y", across_mm = 40.0, conic = -1.0, asphere = { 4 = 1e-6 }, n_d = 1.6',
    "biconic": 'cylinder = "x", across_mm = -40.0, across_conic = 0.5, n_d = 1.6',
    "ideal": "focal_mm = 60.0",
    "Qcon": "conic = -0.5, qcon = [0.06, -0.02, 4e-3], norm_mm = 9.0, n_d = 1.6",
}
FILE = """schema = 1
name = "one"
source = "made up"
f_number = 4.0
efl_mm = 80.0
image_radius_mm = 10.0
rims = "source"
surfaces = [
  {{ radius_mm = {radius}, thickness_mm = 4.0, diameter_mm = 20.0, {row} }},
  {{ radius_mm = inf, thickness_mm = 70.0, diameter_mm = 18.0, stop = true }},
]
"""


def lens_file(folder: Path, row: str, radius: str = "50.0") -> Path:
    file = folder / "one.toml"
    file.write_text(FILE.format(radius="inf" if "focal" in row else radius, row=row))
    return file


@pytest.mark.parametrize("name", ROWS)
def test_lens_files_hold_them(name: str, tmp_path: Path) -> None:
    lens = read_lens(lens_file(tmp_path, ROWS[name]))
    again = tmp_path / "again.toml"
    write_lens(lens, again)
    assert read_lens(again).surfaces == lens.surfaces
    wanted = {
        "toroid": Toroid(-1.0, ((4, 1e-6),), cylinder="y", across_mm=40.0),
        "biconic": Biconic(cylinder="x", across_mm=-40.0, across_conic=0.5),
        "ideal": Ideal(focal_mm=60.0),
        "Qcon": Qcon(-0.5, qcon=(0.06, -0.02, 4e-3), norm_mm=9.0),
    }
    assert lens.surfaces[0].figure == wanted[name] and read_lens(again).sha256 == lens.sha256
    assert lens.ideal == ([0] if name == "ideal" else [])


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("across_mm = 40.0", r"surface 0, cylinder: got \(missing\), expected the axis of the curve that across_mm"),
        ('cylinder = "x", across_mm = 0.0', "across_mm: got 0.0, expected a radius of curvature other than 0"),
        ('cylinder = "x", across_conic = 1.0', r"across_mm: got \(missing\), expected the radius that across_conic"),
        ('cylinder = "x", across_mm = 9, across_conic = 0, asphere = { 4 = 1e-6 }', "a biconic has no polynomial"),
        ('cylinder = "x", across_mm = 9', "diameter_mm: got 20.0, expected at most 18 mm"),
        ("focal_mm = 0.0", "focal_mm: got 0.0, expected a focal length other than 0"),
        ("focal_mm = 60.0, n_d = 1.5", "focal_mm: got 60.0, expected air on both sides of an ideal lens"),
        ("focal_mm = 60.0, conic = 1.0", "conic: got 1.0, expected a plane in air"),
        ("qcon = 3, norm_mm = 9", "qcon: got 3, expected 1 to 20 coefficients"),
        (f"qcon = {[1e-9] * 21}, norm_mm = 9", "qcon: got .*, expected 1 to 20 coefficients"),
        ("qcon = [1e-3]", r"norm_mm: got \(missing\), expected a finite number above 0.001 in mm"),
        ("qcon = [1e-3, true], norm_mm = 9", r"qcon\[1\]: got True, expected a finite number"),
        ("qcon = [1e-3], norm_mm = 9, asphere = { 4 = 1e-6 }", "asphere: got .*, expected none beside qcon"),
        ('qcon = [1e-3], norm_mm = 9, cylinder = "x"', "cylinder: got 'x', expected none beside qcon"),
        (
            "qcon = [1e-3], norm_mm = 4",
            "norm_mm: got 4.0, expected a size from 5 to 1e.09 mm, at least half of the rim's radius",
        ),
        ("norm_mm = 4", "norm_mm: got 4, expected qcon beside it"),
    ],
)
def test_bad_rows_are_named(row: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        read_lens(lens_file(tmp_path, row))


def test_an_infinite_radius_across_leaves_a_cylinder(tmp_path: Path) -> None:
    lens = read_lens(lens_file(tmp_path, 'cylinder = "x", across_mm = inf, across_conic = 2.0'))
    assert lens.surfaces[0] == Surface(50.0, 4.0, 20.0, figure=Cylinder(cylinder="x"))
