"""Wild numbers: a status that is wrong, one at an edge, NaN and light that is lost are told apart and counted."""

import lens_models
import numpy as np

from experiments import lab
from experiments.hostile.wild import TRACER, Form, Row, by_numpy, coated_surfaces, judge, tracer, wild
from neurolens.base import status as st
from neurolens.base.settings import LIGHT_NM
from neurolens.cameras.shaders.lens_source import lens_program, pupil_planes_mm
from neurolens.graph.program import RAY
from neurolens.models.source import fused_program

COUNT = 3000


def form() -> Form:
    model = lens_models.model("invariants")
    d = model.domain
    reach = dict(zip(RAY, (d.film_radius_mm, d.film_radius_mm, d.pupil_radius_mm, d.pupil_radius_mm), strict=True))
    ends = {name: (-r, r) for name, r in reach.items()}
    ends |= {"wavelength_nm": d.wavelength_nm, "film_z_mm": d.film_z_mm, "stop_radius_mm": (0.0, d.stop_radius_mm)}
    return Form(fused_program([model]), ends, ("film_z_mm", "stop_radius_mm"))


def test_results_of_numpy_are_right_and_changed_ones_are_counted() -> None:
    tried, rng = form(), np.random.default_rng(3)
    rays = wild(tried, COUNT, rng)
    rays |= {"film_z_mm": np.float32(np.mean(tried.ends["film_z_mm"])), "stop_radius_mm": np.float32(5)}
    assert all(np.isnan(rays[name]).any() and np.isinf(rays[name]).any() for name in RAY)
    found = {name: np.array(np.broadcast_to(v, COUNT)) for name, v in by_numpy(tried, rays, False).items()}
    found["weight"] = (found["status"] == st.PASSED).astype(np.float32)
    wanted = found["status"].astype(np.int64)
    row = Row("model", "numpy")
    judge(row, tried, rays, found, by_numpy(tried, rays, False), False)
    assert (row.rays, row.edge, row.wrong, row.not_finite, row.lit) == (COUNT, 0, 0, 0, 0) and row.passed > 100

    # A stop through a passing ray: that ray may be blocked, one well inside may not.
    away = np.hypot(found["stop_x_mm"], found["stop_y_mm"])
    order = [int(i) for i in np.argsort(away) if wanted[i] == st.PASSED]
    inside, edge = order[0], order[len(order) // 2]
    rays["stop_radius_mm"] = np.float32(away[edge] * (1 + 1e-6))
    found = {name: np.array(np.broadcast_to(v, COUNT)) for name, v in by_numpy(tried, rays, False).items()}
    wanted, numpys = found["status"].astype(np.int64), by_numpy(tried, rays, False)
    assert wanted[inside] == wanted[edge] == st.PASSED
    found["status"][[inside, edge]] = st.blocked(lens_models.lens().stop_index, st.RIM)
    found["x_mm"][order[1]] = np.nan
    found["weight"] = np.ones(COUNT, np.float32)
    row = Row("model", "broken")
    judge(row, tried, rays, found, numpys, False)
    assert (row.edge, row.wrong, row.not_finite) == (1, 1, 1) and row.lit == (found["status"] != st.PASSED).sum()


def test_the_graph_of_the_exact_lens_is_the_tracer_for_wild_numbers() -> None:
    """Every ray has one answer, whatever its wavelength and the call's film and stop; one that moves is counted."""
    lens = lab.lens_of("canon_aspheric_50")
    planes = pupil_planes_mm([lens], ())
    film, rear, stop = float(lens.film_z_mm), lens.surfaces[-1].semi_diameter_mm, float(lens.stop_radius_mm)
    ends = dict(zip(RAY, [(-20.0, 20.0)] * 2 + [(-rear, rear)] * 2, strict=True)) | {"wavelength_nm": LIGHT_NM}
    ends |= {"film_z_mm": (film, film + 1), "stop_radius_mm": (0.0, stop)}
    tried = Form(lens_program([lens], (), planes), ends, ("film_z_mm", "stop_radius_mm"), coated=coated_surfaces(lens))
    traced, row, rng = tracer(lens, planes[0]), Row("exact lens", TRACER), np.random.default_rng(5)
    for call in ({}, {}, {"stop_radius_mm": -stop}, {"stop_radius_mm": np.nan}, {"film_z_mm": np.inf}):
        rays = wild(tried, 4 * COUNT, rng) | {name: np.float32(value) for name, value in call.items()}
        before = row.passed
        judge(row, tried, rays, traced(rays), by_numpy(tried, rays, False), False)
        assert (row.passed > before) == (not call)
    assert (row.wrong, row.elsewhere, row.not_finite) == (0, 0, 0)

    rays = wild(tried, COUNT, rng) | {"film_z_mm": np.float32(film), "stop_radius_mm": np.float32(stop)}
    found, moved = traced(rays), Row("exact lens", TRACER)
    some = np.flatnonzero(found["status"] == st.PASSED)[[0, 40, 80]]
    found["x_mm"][some] += 0.01
    judge(moved, tried, rays, found, by_numpy(tried, rays, False), False)
    assert moved.elsewhere == len(some)
