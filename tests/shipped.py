"""The shipped prescriptions, read once, and rays that tests of several folders turn round or move."""

import math
import os
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from experiments.lab import historical
from neurolens.base.errors import NeurolensWarning
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.rays import Rays

LENSES = Path(__file__).parents[1] / "lenses"
# The lenses by name, from two collections, have tests of their own: test_named_lenses.py.
PATHS = historical()
NAMED = sorted({path.stem for path in LENSES.glob("*.toml")} - {path.stem for path in PATHS})
NAMES = [path.stem for path in PATHS]
# What is tested lens by lens is tested on these, which stand at the ends of the library; on all with NEUROLENS_WHOLE=1.
ENDS = {
    *("thorlabs_lb1471_biconvex_50", "laikin_double_gauss_50"),  # simple and absorbing, the usual one
    *("canon_aspheric_50", "shimizu_fisheye_220"),  # aspheres, rays that graze
    *("cooke_anamorphic_42", "nikon_zoom_70_200"),  # cylinders, states and groups that focus
}
WHOLE = "NEUROLENS_WHOLE" in os.environ
SOME = [name for name in NAMES if WHOLE or name in ENDS]


def whole(*cases: Any) -> list[Any]:
    """Cases of a sweep, each a value or a tuple of values, that run with NEUROLENS_WHOLE=1 alone."""
    return [pytest.param(*(c if isinstance(c, tuple) else (c,)), marks=pytest.mark.whole) for c in cases]


@cache
def tabled(name: str) -> Lens:
    """A lens as its file has it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NeurolensWarning)
        return read_lens(LENSES / f"{name}.toml")


@cache
def focused(name: str) -> Lens:
    """A lens focused at infinity."""
    return set_lens(tabled(name))


def pinhole(film_distance_mm: float, radius_mm: float, *, image_radius_mm: float | None = None) -> Lens:
    """A lens without glass: a round hole in front of the film, whose focal length is its distance from the film."""
    hole = Surface(math.inf, film_distance_mm, 2 * radius_mm, stop=True)
    return Lens("pinhole", "", (hole,), film_distance_mm / (2 * radius_mm), image_radius_mm, path="pinhole")


def before(lens: Lens, *rows: Surface) -> Lens:
    """A lens with rows more in front of it, such as a plate or a hood; z = 0 moves to the first of them."""
    film = lens.film_z_mm and lens.film_z_mm + sum(row.thickness_mm for row in rows)
    return replace(lens, surfaces=(*rows, *lens.surfaces), film_z_mm=film)


def rays(*rows: tuple[float, ...], dtype: torch.dtype = torch.float64) -> Rays:
    """Rays of (x, y, z, dx, dy, dz), directions made unit."""
    t = torch.tensor(rows, dtype=torch.float64)
    t[:, 3:] /= t[:, 3:].norm(dim=1, keepdim=True)
    return Rays(*t.T.to(dtype).contiguous())


def turned(r: Rays, angle: float, mirror: bool = False) -> Rays:
    """The rays turned about the axis by `angle` rad, after x -> -x where asked."""
    c, s, m = math.cos(angle), math.sin(angle), -1 if mirror else 1
    x, dx = m * r.x, m * r.dx
    return Rays(c * x - s * r.y, s * x + c * r.y, r.z, c * dx - s * r.dy, s * dx + c * r.dy, r.dz)


def backwards(r: Rays, travel: float = 0.0) -> Rays:
    """The rays turned round, started `travel` mm farther along."""
    start = [p + travel * d for p, d in zip(r[:3], r[3:], strict=True)]
    return Rays(*start, -r.dx, -r.dy, -r.dz)


def singlet_mm(n: float, radius_mm: float = 50.0, thickness_mm: float = 5.0) -> tuple[float, float]:
    """Focal length and back focus of a biconvex lens of equal radii (the lensmaker's formula)."""
    R, t = radius_mm, thickness_mm
    efl_mm = 1 / ((n - 1) * (2 / R - (n - 1) * t / (n * R * R)))
    return efl_mm, efl_mm * (1 - (n - 1) * t / (n * R))


def disc_irradiance(radius_mm: float, distance_mm: float, height_mm: np.ndarray) -> np.ndarray:
    """Irradiance over radiance (sr) at heights [F] from the axis of a uniform disc parallel to the film.

    The exact integral, for any size of the disc: pi sin^2(theta') on the axis (Foote 1915).
    """
    a2, z2, h2 = radius_mm**2, distance_mm**2, np.asarray(height_mm, np.float64) ** 2
    total = z2 + h2 + a2
    root = np.sqrt(total * total - 4 * a2 * h2)
    x = (total - 2 * a2) / root
    # 1 - x loses digits for a small disc, x near 1: there it is (1 - x^2) / (1 + x).
    small = 4 * a2 * z2 / (root * root) / (1 + np.maximum(x, 0))
    return math.pi / 2 * np.where(x > 0, small, 1 - x)
