"""Fused models on the clock: the exact trace as a graph, candidates, goals that cannot be missed unseen."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import lens_models
import numpy as np
import pytest
import torch

from experiments.fused_speed import Row, earlier, goals, ray_candidate, write
from neurolens.base import status as st
from neurolens.cameras.model import load_model
from neurolens.evaluate.candidates import CompiledSource, find_compiler, fused_candidate
from neurolens.evaluate.speed import Unavailable, race
from neurolens.graph.program import SCENE_RAY
from neurolens.graph.scalars import lower
from neurolens.optics.pupils import camera_rays
from neurolens.optics.trace import trace
from neurolens.optics.tracegraph import exact_graph
from neurolens.surrogates.assemble import RAY_ONLY
from neurolens.surrogates.domain import sample_domain


def test_the_exact_graph_is_the_exact_trace() -> None:
    lens, domain = lens_models.lens(), lens_models.domain()
    s = sample_domain(domain, 20_000, 3)
    s = replace(s, film_z=torch.full_like(s.film_z, domain.film_z_mm[0]))
    rays = camera_rays(s.film_x, s.film_y, s.film_z, s.pupil_x, s.pupil_y, domain.pupil_z_mm)
    exact = trace(lens, rays, s.wavelength_nm, transmittance=True)
    columns = {"film_x_mm": s.film_x, "film_y_mm": s.film_y, "pupil_x_mm": s.pupil_x, "pupil_y_mm": s.pupil_y}
    inputs = {k: v.numpy() for k, v in columns.items()} | {"wavelength_nm": s.wavelength_nm.numpy()}
    inputs |= {"film_z_mm": domain.film_z_mm[0], "stop_radius_mm": lens.stop_radius_mm}
    found = lower(exact_graph(lens, domain.pupil_z_mm, domain.wavelength_nm)).evaluate(inputs)
    status = exact.status.numpy()
    assert np.mean(found["status"] != status) < 1e-4 and len(np.unique(status)) > 3
    passed = (status == st.PASSED) & (found["status"] == st.PASSED)
    for name, column in zip(SCENE_RAY, exact.rays, strict=True):
        assert np.abs(found[name] - column.numpy())[passed].max() < 1e-4
    assert exact.transmittance is not None
    assert np.abs(found["transmittance"] - exact.transmittance.numpy())[passed].max() < 1e-5
    alone = lower(exact_graph(lens, domain.pupil_z_mm, domain.wavelength_nm, whole=False)).evaluate(inputs)
    assert np.array_equal(alone["dx"][passed], found["dx"][passed]) and "transmittance" not in alone


def test_candidates_time_models_and_files() -> None:
    try:
        find_compiler()
    except Unavailable as reason:
        pytest.skip(f"the C form is not timed here: {reason}")
    model = lens_models.model("invariants")
    candidate = fused_candidate("fused", model, model.domain, parts=RAY_ONLY)
    assert candidate is not None
    timing = race([candidate], model.domain, rounds=1).timing("fused")
    assert timing is not None and 0 < timing["min"] < 1e4
    assert fused_candidate("x", lens_models.exported("invariants"), model.domain) is not None


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
    with pytest.raises(Unavailable, match="no C compiler"):
        CompiledSource(lower(exact_graph(lens_models.lens(), 0.0, (400.0, 700.0))))


def test_goals_and_kept_rows(tmp_path: Path) -> None:
    def row(name: str, work: str, ns: float, ratio: float, rms_um: float = 0.9) -> Row:
        times = {"min": ns, "median": ns, "threads": 1, "batch": 4096, "repeats": 5}
        return Row("gauss", 12, name, work, rms_um=rms_um, operations=100, roots=2, bytes=52, ns=times,
                   speedup={"exact C": ratio})  # fmt: skip

    rows = [row("a, C", "ray", 5.0, 6.0), row("b, C", "ray", 1.0, 99.0, rms_um=1.1), row("a, C", "whole", 13.0, 2.0)]
    verdicts = {g.text: (g.measured, g.verdict) for g in goals(rows)}
    assert verdicts["ns per ray, 12 refractions, fused, ray"] == (5.0, "reached")  # the faster one is not within 1 um
    assert verdicts["ns per ray, 12 refractions, fused, whole"] == (13.0, "missed")
    assert verdicts["times as fast as exact C, 12 refractions, fused, whole"] == (2.0, "missed")
    assert verdicts["times as fast as exact C, 33 refractions, fused, ray"] == (None, "not measured")
    write(rows, tmp_path, 5)
    assert earlier(tmp_path, []) == rows and earlier(tmp_path, ["gauss"]) == []
