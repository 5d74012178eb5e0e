"""Shapes in the graph of a lens against the tracer: one surface, rays from the film, those that miss among them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from neurolens.base import status as st
from neurolens.graph.program import FILM_Z, RAY, SCENE_RAY, STATUS, STOP_RADIUS, TRANSMITTANCE, WAVELENGTH
from neurolens.graph.scalars import lower
from neurolens.optics.prescription import Lens, Surface
from neurolens.optics.trace import Rays, trace
from neurolens.optics.tracegraph import exact_graph

FILM_MM = 60.0
SHAPES: dict[str, tuple[float, dict[str, Any]]] = {
    "ellipsoid": (14.0, {"conic": -0.4}),
    "paraboloid": (-11.0, {"conic": -1.0}),
    "hyperboloid": (9.0, {"conic": -2.3}),
    "oblate, nearly hemispherical": (10.4, {"conic": 0.05}),
    "cylinder x": (-13.0, {"cylinder": "x"}),
    "cylinder y": (13.0, {"cylinder": "y"}),
    "conic cylinder": (15.0, {"cylinder": "y", "conic": -1.4}),
    "asphere": (18.0, {"conic": -0.7, "asphere": ((4, 2e-5), (6, -3e-7), (10, 4e-12))}),
    "asphere on a plane": (math.inf, {"asphere": ((2, 0.02), (4, -4e-5))}),
    "odd asphere": (-25.0, {"asphere": ((3, -2e-4), (4, 1e-5), (5, 2e-7))}),
    "asphere on a cylinder": (22.0, {"cylinder": "x", "asphere": ((4, 3e-5),)}),
    "strong asphere": (12.0, {"conic": -3.0, "asphere": ((4, 1.5e-4), (8, -6e-9))}),
    "bent back": (-12.0, {"asphere": ((4, 3e-5), (6, 1e-7))}),
}


def lens_of(radius_mm: float, shape: dict[str, Any]) -> Lens:
    """A plane stop, a plane into glass, and the surface, as light comes from the film; the rim at 10 mm."""
    front = Surface(radius_mm, 9.0, 20.0, 1.6, 40.0, **shape)
    return Lens("one", "", (front, Surface(math.inf, 3.0, 40.0), Surface(math.inf, 30.0, 30.0, stop=True)), 2.0)


@pytest.mark.parametrize("name", SHAPES)
def test_graph_and_tracer_agree(name: str) -> None:
    lens, count = lens_of(*SHAPES[name]), 20_000
    rng = np.random.default_rng(len(name))
    film, pupil = rng.uniform(-25, 25, (2, count)), rng.uniform(-14, 14, (2, count))
    film[:, :3], pupil[:, :3] = 0, [[0, 1e-6, 9.0], [0, 0, 0]]
    points, wavelength = np.concatenate([film, pupil]).astype(np.float32), rng.uniform(400, 700, count)
    given = dict(zip(RAY, points, strict=True)) | {WAVELENGTH: wavelength.astype(np.float32)}
    given |= {FILM_Z: np.float32(FILM_MM), STOP_RADIUS: np.float32(lens.stop_radius_mm)}
    found = lower(exact_graph(lens, 12.0, (400.0, 700.0))).evaluate(given)

    x, y, px, py = (torch.from_numpy(v).double() for v in points)
    way = torch.stack([px - x, py - y, torch.full_like(x, 12.0 - FILM_MM)])
    way /= way.norm(dim=0)
    rays = Rays(x, y, torch.full_like(x, FILM_MM), *way)
    exact = trace(lens, rays, torch.from_numpy(given[WAVELENGTH]).double(), transmittance=True)
    status = exact.status.numpy()
    assert np.mean(found[STATUS] != status) < 5e-4
    passed = (status == st.PASSED) & (found[STATUS] == st.PASSED)
    assert 0.1 < passed.mean() < 0.95 and len(np.unique(status)) > 1
    scale = 1 + np.abs(np.stack([c.numpy() for c in exact.rays])[3:]).max()
    for output, column in zip(SCENE_RAY, exact.rays, strict=True):
        error = np.abs(found[output] - column.numpy())[passed]
        assert np.quantile(error, 0.999) < 1e-5 * scale and error.max() < 2e-3, output
    assert np.quantile(np.abs(found[TRANSMITTANCE] - exact.transmittance.numpy())[passed], 0.999) < 1e-4


def test_rays_that_are_none_do_not_pass() -> None:
    lens = lens_of(*SHAPES["asphere"])
    strange = np.float32([math.nan, math.inf, -math.inf, 3e38, 1e-40])
    given = {name: np.zeros(5, np.float32) for name in RAY} | {RAY[0]: strange, WAVELENGTH: np.full(5, 550, np.float32)}
    given |= {FILM_Z: np.float32(FILM_MM), STOP_RADIUS: np.float32(lens.stop_radius_mm)}
    found = lower(exact_graph(lens, 12.0, (400.0, 700.0))).evaluate(given)
    assert (found[STATUS][:4] != st.PASSED).all() and found[STATUS][4] == st.PASSED
