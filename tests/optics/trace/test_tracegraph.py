"""The exact lens as a graph against the tracer: transmittance of coated and absorbing lenses, skew rays, the corner."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from shipped import whole

from neurolens.base import status as st
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import pruned, same_structure
from neurolens.graph.program import RAY, WAVELENGTH
from neurolens.graph.scalars import lower
from neurolens.optics.lens.paraxial import film_z_mm
from neurolens.optics.lens.prescription import Coating, Configuration, Lens, Surface
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.pupils import camera_rays, image_radius_mm, pupil_plane_z_mm
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.rays import trace
from neurolens.optics.trace.tracegraph import exact_graph

LENSES = Path(__file__).parents[3] / "lenses"
LIGHT_NM = (380.0, 780.0)
# One to four layers: a quarter wave, half waves, films of several waves, one that is evanescent in dense glass.
STACKS: tuple[tuple[tuple[float, ...], ...], ...] = (
    ((1.38, 100.0),),
    ((1.38, 95.0), (2.1, 130.0, 30.0)),
    ((1.46, 2000.0), (2.35, 60.0), (1.38, 10.0, 70.0)),
    ((1.38, 90.0), (2.05, 20.0), (1.0, 60.0), (2.4, 700.0, 25.0)),
)


def with_losses(lens: Lens, coat: bool, absorb: bool) -> Lens:
    """Films on every surface between media, stacks in turn; catalogue glass that absorbs, or a grey one."""
    surfaces = []
    for k, s in enumerate(lens.surfaces):
        films = Coating(f"stack {k}", STACKS[k % 4]) if coat and lens.media[k].n_d != s.n_d else None
        grey = 0.004 if absorb and s.n_d != 1 and k % 3 == 0 else 0.0
        glass = "N-SF6" if absorb and s.n_d != 1 and k % 3 == 1 and s.V_d is not None and s.V_d < 30 else s.glass
        surfaces.append(replace(s, coating=films, absorption_per_mm=grey, glass=glass))
    return replace(lens, surfaces=tuple(surfaces))


def corner_rays(lens: Lens, wavelength_nm: float, count: int = 3000) -> tuple[dict[str, NDArray[np.float64]], float]:
    """Rays from the film's corner and from inside it through a wide disc of the pupil's plane; and that plane."""
    rng, plane, radius = np.random.default_rng(7), pupil_plane_z_mm(lens), image_radius_mm(lens)[0]
    film = radius * np.where(np.arange(count) % 2, 0.98, rng.random(count)) * np.array([[0.8], [0.6]])
    pupil = lens.surfaces[-1].semi_diameter_mm * (2 * rng.random((2, count)) - 1)
    rows = np.stack([*film, *pupil, np.full(count, wavelength_nm)])
    numbers = {"film_z_mm": film_z_mm(lens, math.inf), "stop_radius_mm": float(lens.stop_radius_mm)}
    return {"rays": rows} | {name: np.array([[float(v)]]) for name, v in numbers.items()}, plane


@pytest.mark.parametrize("wavelength_nm", LIGHT_NM)
@pytest.mark.parametrize("coat, absorb", [(True, True), *whole((False, False))])
@pytest.mark.parametrize("name", ["shimizu_fisheye_220", *whole("laikin_double_gauss_50", "canon_aspheric_50")])
def test_transmittance_is_that_of_the_tracer(name: str, coat: bool, absorb: bool, wavelength_nm: float) -> None:
    lens = with_losses(set_lens(read_lens(LENSES / f"{name}.toml")), coat, absorb)
    inputs, plane = corner_rays(lens, wavelength_nm)
    fx, fy, px, py, nm = (torch.from_numpy(row) for row in inputs["rays"])
    film_z, graph = float(inputs["film_z_mm"][0, 0]), exact_graph(lens, plane, LIGHT_NM, double=coat)
    rays = camera_rays(fx, fy, film_z, px, py, plane)
    wanted = trace(lens, rays, nm, transmittance=True)
    found = evaluate(graph, inputs)
    assert wanted.transmittance is not None
    passed, power = (wanted.status == st.PASSED).numpy(), wanted.transmittance.numpy()
    np.testing.assert_array_equal(found["status"][0] == st.PASSED, passed)
    assert passed.sum() > 100 and passed[1::2].any()
    if absorb:
        clear = trace(with_losses(lens, coat, False), rays, nm, transmittance=True)
        assert (power[passed] < 0.97 * clear.transmittance.numpy()[passed]).all()  # type: ignore[union-attr]
    # The indices are series, good to 3e-8, and grazing rays feel them.
    np.testing.assert_allclose(found["transmittance"][0][passed], power[passed], rtol=0, atol=1e-6)
    written = lower(graph)
    rows = dict(zip((*RAY, WAVELENGTH), inputs["rays"], strict=True))
    single = written.evaluate(rows | {k: np.float32(v[0, 0]) for k, v in inputs.items() if k != "rays"})
    both = passed & (single["status"] == st.PASSED)
    off = np.abs(single["transmittance"] - power)[both]
    assert both.sum() > 0.99 * passed.sum() and np.quantile(off, 0.99) < 1e-5


def test_states_have_one_structure_where_a_gap_equals_another_figure_in_one_of_them() -> None:
    """The gap that moves is 2 mm in the first state, as wide as another, and so are films and glasses 2 mm thick."""
    rows = (
        Surface(40.0, 2.0, 10.0, n_d=1.5, V_d=60.0),
        Surface(-60.0, 2.0, 10.0),
        Surface(math.inf, 3.0, 6.0, stop=True),
        Surface(50.0, 2.0, 10.0, n_d=1.6, V_d=40.0),
        Surface(-50.0, 20.0, 10.0),
    )
    states = (Configuration("near", 30.0, ((1, 2.0),)), Configuration("far", 32.0, ((1, 4.5),)))
    lens = Lens("zoom", "made up", rows, 4.0, configurations=states)
    graphs = [exact_graph(set_lens(lens, zoom=name), 0.0, LIGHT_NM) for name in ("near", "far")]
    assert same_structure([pruned(g) for g in graphs])
    assert lower(graphs).tables == 2
