"""Rays and lenses at the ends of what optics allows, for the table of `extremes`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from experiments import lab
from neurolens.base import status as st
from neurolens.optics.lens import glass
from neurolens.optics.lens.figures import Cylinder, Figure
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.rays import Rays, Towards, trace

INF = math.inf
DOUBLE_GAUSS, FISHEYE = "laikin_double_gauss_50", "shimizu_fisheye_220"


@dataclass(frozen=True)
class Case:
    """A bundle of rays through one lens.

    Attributes:
        group, name: row of the table.
        rays: float64, lens frame, mm, unit directions.
    """

    group: str
    name: str
    lens: Lens
    rays: Rays
    wavelength_nm: float
    towards: Towards


def all_cases(count: int) -> Iterator[Case]:
    """Every case, `count` rays each (some have a few less)."""
    bent = (apertures, wide_fields, radii, grazing, total_reflection, near_equal_indices)
    for kind in (*bent, wavelengths, object_distances, shapes, library):
        yield from kind(count)


def apertures(count: int) -> Iterator[Case]:
    """f/0.6 to f/45: a ball and a hyperbolic lens wide open, and a double Gauss stopped down."""
    ball = _lens(
        "ball", Surface(10.0, 20.0, 19.999, 1.71), Surface(-10.0, 5.0, 19.999), Surface(INF, 2.0, 30, stop=True)
    )
    hyperbola = _lens(
        "plano-hyperbolic",
        Surface(INF, 12.0, 40.0, 1.71, stop=True),
        Surface(-0.71 * 24.0, 20.0, 40.0, figure=Figure(conic=-(1.71**2))),
    )
    g = generator()
    for lens in (ball, hyperbola):
        f_number = abs(first_order(lens).efl_mm) / lens.surfaces[0].diameter_mm
        yield _case("f-number", f"{lens.name} f/{f_number:.2g}", lens, from_scene(lens, count, g, slope=0.05), "film")
    whole = read_lens(lab.LENSES / f"{DOUBLE_GAUSS}.toml")
    for number in (1.8, 5.6, 16, 45):
        lens = set_lens(whole, f_number=number)
        rays = from_film(lens, count, g, share=1.1 * lens.stop_radius_mm / whole.stop_radius_mm)
        yield _case("f-number", f"double Gauss f/{number:g}", lens, rays, "scene")


def wide_fields(count: int) -> Iterator[Case]:
    """A fisheye of 220 degrees, from the film to beyond its edge, and back from the scene."""
    lens = lab.lens_of(FISHEYE)
    rays = from_film(lens, 4 * count, generator(), film=1.3)
    yield _case("field", "fisheye of 220 degrees, to the scene", lens, rays, "scene")
    yield _case("field", "fisheye of 220 degrees, to the film", lens, returning(lens, rays, count), "film")


def radii(count: int) -> Iterator[Case]:
    """One lens of semi-diameter 10 mm whose radii go from just above that to a plane."""
    for ratio in (1 + 1e-9, 1 + 1e-6, 1 + 1e-3, 1.1, 1e2, 1e4, 1e6, 1e8, INF):
        for sign in (1, -1):
            r = sign * 10.0 * ratio
            sag = 0.0 if math.isinf(r) else abs(r) - math.sqrt(r * r - 100)
            lens = _lens("singlet", Surface(r, 2 + 2 * sag, 20.0, 1.5), Surface(-r, 1.0 + sag, 20.0), _stop(30.0))
            rays = from_scene(lens, count, generator(), slope=0.3, wide=1.01)
            yield _case("radius", f"biconvex {r:.10g} mm" if sign > 0 else f"biconcave {r:.10g} mm", lens, rays, "film")


def grazing(count: int) -> Iterator[Case]:
    """Rays at up to 89.9999 degrees from the normal of a plane, and at a sphere's vertex, into glass."""
    for degrees in (89.9, 89.99, 89.999, 89.9999):
        for name, radius in (("plane", INF), ("sphere of 100 mm", 100.0), ("sphere of -100 mm", -100.0)):
            # All glass behind: on leaving a plate such rays would graze once more.
            lens = _lens("block", Surface(radius, 30.0, 40.0, 1.5), Surface(INF, 1.0, 400.0, 1.5, stop=True))
            g = generator()
            near = uniform(g, count, 1e-3 if math.isfinite(radius) else 15.0)
            angle = math.radians(degrees)
            d = [torch.full((count,), c, dtype=torch.float64) for c in (math.sin(angle), 0.0, math.cos(angle))]
            start = Rays(near[0], near[1], sag(radius, near), *d)
            reach = 0.01 * torch.rand(count, generator=g, dtype=torch.float64)
            yield _case("grazing", f"{name}, {degrees} degrees", lens, moved(start, -reach), "film")


def total_reflection(count: int) -> Iterator[Case]:
    """From glass to air on both sides of the critical angle, 1e-1 to 1e-9 rad away from it."""
    n = 1.6
    critical = math.asin(1 / n)
    lens = _lens("block", Surface(-50.0, 50.0, 99.9, n), Surface(INF, 0.0, 1e6), _stop(1e6))
    for step in (1e-1, 1e-3, 1e-5, 1e-7, 1e-9):
        share = torch.rand(count, generator=generator(), dtype=torch.float64)
        angle = critical + step * torch.where(torch.arange(count) % 2 == 0, 1.0, -1.0) * (1 + share)
        azimuth = 2 * math.pi * share
        # Through the centre of the first sphere, so that only the plane bends.
        zero = torch.zeros_like(angle)
        d = (torch.sin(angle) * torch.cos(azimuth), torch.sin(angle) * torch.sin(azimuth), torch.cos(angle))
        start = Rays(zero, zero, zero - 50.0, *d)
        yield _case("total reflection", f"{step:g} rad from the critical angle", lens, start, "film")


def near_equal_indices(count: int) -> Iterator[Case]:
    """A strongly curved cemented surface between glasses that hardly differ."""
    for step in (1e-2, 1e-4, 1e-6, 1e-8, 0.0):
        lens = _lens(
            "doublet",
            Surface(30.0, 8.0, 20.0, 1.6),
            Surface(-10.5, 3.0, 20.0, 1.6 + step, V_d=None),
            Surface(-40.0, 5.0, 20.0),
            _stop(30.0),
        )
        rays = from_scene(lens, count, generator(), slope=0.3)
        yield _case("cement", f"index step {step:g}", lens, rays, "film")


def wavelengths(count: int) -> Iterator[Case]:
    """The ends of the visible."""
    lens = lab.lens_of(DOUBLE_GAUSS)
    for wavelength in (380.0, 780.0):
        rays = from_film(lens, count, generator())
        case = _case("wavelength", f"double Gauss, {wavelength:g} nm", lens, rays, "scene")
        yield replace(case, wavelength_nm=wavelength)


def object_distances(count: int) -> Iterator[Case]:
    """Light from points 1e-6 mm to 1e6 m away, along the ray, from where it enters the front surface."""
    lens = lab.lens_of(DOUBLE_GAUSS)
    for distance_mm in (1e-6, 1e-3, 1.0, 1e3, 1e6, 1e9):
        g = generator()
        x, y = disc(g, count, lens.surfaces[0].semi_diameter_mm)
        sx, sy = disc(g, count, 0.3)
        surface = Rays(x, y, sag(float(lens.surfaces[0].radius_mm), (x, y)), *unit(sx, sy, torch.ones_like(sx)))
        yield _case("object", f"at {distance_mm:g} mm, double Gauss", lens, moved(surface, -distance_mm), "film")


def shapes(count: int) -> Iterator[Case]:
    """Steep conics, aspheres of even and odd powers, and crossed cylinders."""
    plano = Surface(INF, 5.0, 24.0, 1.6)
    steep = {
        "ellipsoid, K = -0.5": Surface(-11.0, 1.0, 20.0, figure=Figure(conic=-0.5)),
        "paraboloid, K = -1": Surface(-8.0, 1.0, 20.0, figure=Figure(conic=-1.0)),
        "hyperboloid, K = -50": Surface(-8.0, 1.0, 20.0, figure=Figure(conic=-50.0)),
        "oblate, K = 2": Surface(-25.0, 1.0, 20.0, figure=Figure(conic=2.0)),
        "even asphere": Surface(
            -20.0, 1.0, 20.0, figure=Figure(asphere=((4, 2e-5), (6, -3e-7), (8, 4e-9), (10, -1e-11)))
        ),
        "odd asphere with r^2": Surface(
            INF, 1.0, 20.0, figure=Figure(asphere=((2, -0.01), (3, -4e-4), (4, 2e-5), (5, 1e-6)))
        ),
        "asphere that turns back": Surface(
            -30.0, 1.0, 20.0, figure=Figure(conic=-1.0, asphere=((4, 1e-4), (6, -8e-7)))
        ),
        "cylinder": Surface(-11.0, 1.0, 20.0, figure=Cylinder(cylinder="y")),
        "acylinder": Surface(-20.0, 1.0, 20.0, figure=Cylinder(conic=-1.0, cylinder="x", asphere=((4, 2e-5),))),
    }
    for name, surface in steep.items():
        lens = _lens("singlet", plano, surface, _stop(60.0))
        yield _case("shape", name, lens, from_scene(lens, count, generator(), slope=0.3), "film")


def library(count: int) -> Iterator[Case]:
    """Every historical lens file in every state, both ways."""
    for path in lab.historical():
        table = read_lens(path)
        for name in (None, *(c.name for c in table.configurations)):
            lens = set_lens(table, zoom=name)
            title = path.stem + ("" if name is None else f" {name}")
            rays = from_film(lens, count, generator())
            yield _case("library", f"{title}, to the scene", lens, rays, "scene")
            yield _case("library", f"{title}, to the film", lens, returning(lens, rays, count), "film")


def _case(group: str, name: str, lens: Lens, rays: Rays, towards: Towards) -> Case:
    return Case(group, name, lens, rays, glass.LINE_D_NM, towards)


def _lens(name: str, *surfaces: Surface) -> Lens:
    if not any(s.stop for s in surfaces):
        surfaces = (*surfaces[:-1], replace(surfaces[-1], stop=True))
    return Lens(name, "", surfaces, 1.0)


def _stop(diameter_mm: float) -> Surface:
    return Surface(INF, 1.0, diameter_mm, stop=True)


def from_film(lens: Lens, count: int, g: torch.Generator, *, share: float = 1.02, film: float = 1.0) -> Rays:
    """Camera rays from the film, half of them to the rear rim, half to the paraxial exit pupil, both `share` as wide.

    Film points lie within `film` times the image radius, where that is unknown the rear rim's.
    """
    rear = lens.surfaces[-1].semi_diameter_mm
    z = float(lens.film_z_mm if lens.film_z_mm is not None else lens.vertices_mm[-1])
    rear_z = float(lens.vertices_mm[len(lens.surfaces) - 1])
    data = first_order(lens)
    pupil_z, pupil = data.exit_pupil_z_mm, abs(data.exit_pupil_diameter_mm) / 2
    if not (math.isfinite(pupil_z) and math.isfinite(pupil) and pupil_z < z - 1):
        pupil_z, pupil = rear_z, rear
    fx, fy = disc(g, count, film * (lens.image_radius_mm or rear))
    px, py = disc(g, count, share)
    to_rear = torch.arange(count) % 2 == 0
    radius = torch.where(to_rear, rear, 1.2 * pupil).double()
    depth = torch.where(to_rear, rear_z, pupil_z).double() - z
    return Rays(fx, fy, torch.full_like(fx, z), *unit(px * radius - fx, py * radius - fy, depth))


def from_scene(lens: Lens, count: int, g: torch.Generator, *, slope: float, wide: float = 1.0) -> Rays:
    """Light from in front of the lens to `wide` times its front rim, at slopes up to `slope`."""
    x, y = disc(g, count, wide * lens.surfaces[0].semi_diameter_mm)
    sx, sy = disc(g, count, slope)
    d = unit(sx, sy, torch.ones_like(sx))
    first, radius = lens.surfaces[0], float(lens.surfaces[0].radius_mm)
    rim = torch.tensor([min(first.semi_diameter_mm, abs(radius)), 0.0], dtype=torch.float64)
    front = torch.full_like(x, min(0.0, float(sag(radius, rim))) - 1.0)
    return Rays(x - sx, y - sy, front, *d)


def returning(lens: Lens, rays: Rays, count: int) -> Rays:
    """The passing of some camera rays turned round, every other one pushed aside by a hundredth of a radian."""
    out = trace(lens, rays)
    passed = torch.nonzero(out.status == st.PASSED)[:count, 0]
    r = Rays(*(c[passed] for c in out.rays))
    push = 0.01 * torch.randn((2, len(passed)), generator=generator(), dtype=torch.float64)
    push[:, ::2] = 0
    turned = Rays(*r[:3], *unit(push[0] - r.dx, push[1] - r.dy, -r.dz))
    return moved(turned, -0.5 * lens.surfaces[0].semi_diameter_mm)


def generator() -> torch.Generator:
    """Always the same one."""
    return torch.Generator().manual_seed(11)


def uniform(g: torch.Generator, count: int, half: float) -> Tensor:
    """[2, count] numbers within `half` of 0."""
    return (2 * torch.rand((2, count), generator=g, dtype=torch.float64) - 1) * half


def disc(g: torch.Generator, count: int, radius: float) -> tuple[Tensor, Tensor]:
    """Points uniform over a disc."""
    u = torch.rand((2, count), generator=g, dtype=torch.float64)
    r = radius * torch.sqrt(u[0])
    return r * torch.cos(2 * math.pi * u[1]), r * torch.sin(2 * math.pi * u[1])


def unit(x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The same directions with length 1."""
    length = torch.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


def moved(r: Rays, travel: Tensor | float) -> Rays:
    """The rays started `travel` mm farther along."""
    return Rays(r.x + travel * r.dx, r.y + travel * r.dy, r.z + travel * r.dz, *r[3:])


def sag(radius: float, at: Sequence[Tensor] | Tensor) -> Tensor:
    """Depth of a sphere behind its vertex at points x, y."""
    ratio2 = (at[0] ** 2 + at[1] ** 2) / radius
    return ratio2 / (1 + torch.sqrt((1 - ratio2 / radius).clamp_min(0)))
