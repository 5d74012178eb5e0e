"""What the benches on the clock prepare and compute of known times; no clock is judged."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import lens_models
import numpy as np
import pytest
import torch

from experiments.fused_speed import ray_candidate
from experiments.mitsuba_speed import Row, Settings, film_mm, record
from experiments.trace_speed import (
    ASPHERIC_SURFACES,
    MAIN,
    film_rays,
    launched,
    lens_of,
    with_aspheres,
)
from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.model import load_model
from neurolens.evaluate.candidates import CompiledSource, fused_candidate
from neurolens.evaluate.speed import Unavailable, race
from neurolens.graph.compiler import find_compiler
from neurolens.graph.program import SCENE_RAY
from neurolens.graph.scalars import lower
from neurolens.optics.trace import trace
from neurolens.optics.tracegraph import exact_graph
from neurolens.surrogates.assemble import RAY_ONLY
from neurolens.surrogates.domain import sample_domain

SETTINGS = Settings(size=100, samples=4, threads=2, repeats=3)


def row(seconds: list[float], pictures: list[FloatArray]) -> Row:
    return Row(
        "name", "RGB", "pinhole", lambda seed: pictures[0], np.ones((1, 1, 1), np.float32), 9.0, seconds, pictures
    )


def test_figures_of_known_times_and_pictures() -> None:
    base = row([0.4, 0.2, 0.3], [np.full((2, 2, 3), v, np.float32) for v in (1, 2, 3)])
    found = record(row([0.5, 0.6, 0.7], base.pictures), SETTINGS, base)
    assert found["mpaths_per_s"] == pytest.approx(40_000 / 0.5 * 1e-6)
    assert found["mpaths_per_s_median"] == pytest.approx(40_000 / 0.6 * 1e-6)
    assert found["time_over_ours"] == pytest.approx(0.6 / 0.3)
    assert found["mean_rgb"] == pytest.approx([2, 2, 2])
    assert found["noise"] == pytest.approx(1 / np.mean([1, 4, 9]))  # variance 1 over the mean square
    # Twice the time: the variance decides the rest.
    noisy = record(row([0.5, 0.6, 0.7], [2 * p - 2 for p in base.pictures]), SETTINGS, base)
    assert noisy["equal_noise"] == pytest.approx(2 * noisy["noise"] / found["noise"])


def test_the_film_sees_what_a_field_of_90_degrees_does() -> None:
    assert film_mm({"sensor": {"fov": 90}}) == pytest.approx((100, 100))  # 50 mm behind the hole


def test_two_aspheres_change_the_rays_and_little_else() -> None:
    plain = lens_of(MAIN)
    aspheric = with_aspheres(plain)
    changed = [k for k, s in enumerate(aspheric.surfaces) if s.asphere]
    assert changed == list(ASPHERIC_SURFACES)
    assert [p for p, _ in aspheric.surfaces[changed[0]].asphere] == [4, 6, 8, 10]
    rays = launched(plain, film_rays(plain, 4096), torch.float64)
    a, b = trace(plain, *rays), trace(aspheric, *rays)
    both = (a.status == 0) & (b.status == 0)
    assert both.sum() > 0.7 * (a.status == 0).sum() > 100
    assert 1e-2 < (a.rays.x - b.rays.x)[both].abs().max() < 3.0


def test_the_exact_graph_of_rays_alone_gives_the_rays_of_the_whole() -> None:
    """The whole against the tracer: tests/optics/test_tracegraph.py."""
    lens, domain = lens_models.lens(), lens_models.domain()
    s = sample_domain(domain, 20_000, 3)
    inputs = {f"{k}_mm": getattr(s, k).numpy() for k in ("film_x", "film_y", "pupil_x", "pupil_y")}
    inputs |= {"wavelength_nm": s.wavelength_nm.numpy(), "film_z_mm": domain.film_z_mm[0]}
    inputs |= {"stop_radius_mm": lens.stop_radius_mm}
    found, alone = (
        lower(exact_graph(lens, domain.pupil_z_mm, domain.wavelength_nm, whole=whole)).evaluate(inputs)
        for whole in (True, False)
    )
    passed = found["status"] == st.PASSED
    assert passed.mean() > 0.1 and len(np.unique(found["status"])) > 3 and "transmittance" not in alone
    assert all(np.array_equal(alone[name][passed], found[name][passed]) for name in SCENE_RAY)


def test_candidates_time_models_and_files() -> None:
    try:
        find_compiler()
    except InputError as reason:
        pytest.skip(f"the C form is not timed here: {reason}")
    model = lens_models.model("invariants")
    candidate = fused_candidate("fused", model, model.domain, parts=RAY_ONLY)
    assert candidate is not None
    timing = race([candidate], model.domain, rounds=1).timing("fused")
    assert timing is not None and 0 < timing["min"] < 1e4
    for kind in ("invariants", "rtf", "ray-lut"):
        assert fused_candidate("x", lens_models.exported(kind), model.domain) is not None


def test_the_part_of_a_graph_that_gives_rays_gives_the_same() -> None:
    file, domain = lens_models.exported("invariants"), lens_models.domain()
    rays = sample_domain(domain, 500, 3)
    rays = replace(rays, film_z=torch.full_like(rays.film_z, domain.film_z_mm[0]))
    (found,) = ray_candidate("ray", file).prepare(rays)()  # type: ignore[misc]
    columns = [c.numpy().astype(np.float32) for c in rays.columns()]
    whole = load_model(file).rays(np.stack(columns[0:2]), np.stack(columns[3:5]), columns[5], float(columns[2][0]))
    assert (whole.status == st.PASSED).sum() > 100 and np.abs(found - whole.scene_ray).max() < 1e-5


def test_without_a_compiler_or_coefficients_there_is_no_candidate(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    model = lens_models.model("invariants")
    assert fused_candidate("x", tmp_path / "no.onnx", model.domain) is None
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("CC", "")
    assert fused_candidate("x", model, model.domain) is None
    with pytest.raises(Unavailable, match="a C compiler"):
        CompiledSource(lower(exact_graph(lens_models.lens(), 0.0, (400.0, 700.0))))
