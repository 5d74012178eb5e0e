"""Float32 beside float64: shipped lenses whose polynomials cancel, Forbes's aspheres, all languages, ghosts."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from shipped import PATHS

from experiments import lab
from experiments.__main__ import main
from experiments.accuracy import precision
from neurolens.base.errors import InputError
from neurolens.graph.program import FILM_Z, RAY, SCENE_RAY, STATUS, STOP_RADIUS, WAVELENGTH
from neurolens.graph.scalars import lower
from neurolens.optics.lens.figures import Figure, Qcon
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.rims import check_figures
from neurolens.optics.trace import shapes
from neurolens.optics.trace.arithmetic import NUMPY
from neurolens.optics.trace.rays import Rays, trace
from neurolens.optics.trace.tensors import Tensors
from neurolens.optics.trace.tracegraph import exact_graph

LENSES = Path(__file__).parents[2] / "lenses"
WORST = "fujifilm_fujinon_xf_35mm_f1_4_r"
RIM, REACH = 8.0, 50.0
FLAT = [3e-4] * 20  # coefficients that do not fall: beyond powers in float64, and about the middle in float32


def forbes(count: int, seed: int = 1) -> list[float]:
    rng = np.random.default_rng(seed)
    return (0.05 * 0.5 ** np.arange(count) * rng.choice([-1, 1], count)).tolist()


def graph_errors(lens: Lens, pupil_z: float, film_z: float, points: Any) -> tuple[Any, Any]:
    """Which rays [4, N] pass as a graph in float32, and how far the directions of these are from the tracer's."""
    given = dict(zip(RAY, points, strict=True)) | {WAVELENGTH: np.full(points.shape[1], 550, np.float32)}
    given |= {FILM_Z: np.float32(film_z), STOP_RADIUS: np.float32(lens.stop_radius_mm)}
    found = lower(exact_graph(lens, pupil_z, (400.0, 700.0))).evaluate(given)
    x, y, px, py = (torch.from_numpy(v).double() for v in points)
    way = torch.stack([px - x, py - y, torch.full_like(x, pupil_z - film_z)])
    exact = trace(lens, Rays(x, y, torch.full_like(x, film_z), *(way / way.norm(dim=0))), 550.0)
    passed = (found[STATUS] == 0) & (exact.status.numpy() == 0)
    assert np.mean(found[STATUS] != exact.status.numpy()) < 1e-3
    off = [np.abs(found[name] - c.numpy())[passed] for name, c in zip(SCENE_RAY, exact.rays, strict=True)]
    return passed, np.hypot(off[3], off[4])


def surface_of(a: list[float]) -> Surface:
    return Surface(40.0, 3.0, 2 * RIM, 1.5, figure=Qcon(qcon=tuple(a), norm_mm=RIM))


@pytest.mark.parametrize("name", [WORST, "fujifilm_fujinon_xf_14mm_f2_8_r", "fujifilm_fujinon_xf_56mm_f1_2_r"])
def test_lenses_of_eighteen_terms_keep_float32_on_the_film(name: str) -> None:
    row = precision.measure(LENSES / f"{name}.toml", 4000)
    assert row["rays"] > 800 and row["status_differs"] < 1e-3
    assert row["p99_um"] < 0.05 and row["worst_um"] < 0.2
    assert row["powers_um"] > 10 * row["p99_um"], "the powers of this lens cancel: what is tested here"


@pytest.mark.parametrize("name", ["canon_ef_600mm_f4l_is_usm", "nikon_af_s_nikkor_800mm_f5_6e_fl_ed_vr"])
def test_telephotos_keep_float32_on_the_film(name: str) -> None:
    """The tracer, and the graph that C, shaders and ONNX are written from, on float32 beside the tracer in float64."""
    row = precision.measure(LENSES / f"{name}.toml", 4000)
    assert row["rays"] > 2000 and row["status_differs"] < 1e-3
    assert row["p99_um"] < 0.1 and row["worst_um"] < 0.2
    lens = lab.lens_of(LENSES / f"{name}.toml", focus_m=math.inf)
    data, rng = first_order(lens), np.random.default_rng(0)
    reach = np.array([[15.0], [15.0], [0.35 * data.exit_pupil_diameter_mm], [0.35 * data.exit_pupil_diameter_mm]])
    points = (rng.uniform(-1, 1, (4, 4000)) * reach).astype(np.float32)
    passed, error = graph_errors(lens, float(data.exit_pupil_z_mm), float(np.float32(lens.film_z_mm)), points)
    error *= 1e3 * float(data.efl_mm)
    assert passed.mean() > 0.8 and np.quantile(error, 0.99) < 0.1 and error.max() < 0.2


def test_the_command_writes_its_table(tmp_path: Path) -> None:
    command = ["precision", "--only", "canon_aspheric_50", "--rays", "500", "--output", str(tmp_path), "--quiet"]
    assert main(command) == 0
    (row,) = json.loads((tmp_path / "precision.json").read_text())
    assert row["aspheres"] > 0 and row["centred"] == 0 and row["powers_um"] is None


@pytest.mark.parametrize("a", [*(forbes(n, seed) for n in (4, 8, 12, 16, 20) for seed in range(3)), FLAT], ids=len)
def test_rays_through_a_forbes_asphere(a: list[float]) -> None:
    lens = Lens("", "", (surface_of(a), Surface(math.inf, REACH, 1e4, stop=True)), 2.0)
    h = torch.linspace(-7.9, 7.9, 2001)
    zero, film = torch.zeros_like(h), []
    for dtype in (torch.float32, torch.float64):
        rays = Rays(*(c.to(dtype) for c in (zero, h, zero - 5, zero, zero, zero + 1)))
        out = trace(replace(lens, film_z_mm=60.0), rays, towards="film")
        assert (out.status == 0).all()
        film.append((out.rays.y + REACH * out.rays.dy / out.rays.dz).double().numpy())
    error = 1e3 * np.abs(film[0] - film[1])
    assert np.quantile(error, 0.99) < 0.05 and error.max() < 0.2


@pytest.mark.parametrize("a", [forbes(8), forbes(16), forbes(20), FLAT], ids=["8", "16", "20", "20 that do not fall"])
def test_sag_and_slope_are_those_of_jacobis_polynomials(a: list[float]) -> None:
    """In 60 digits, from the definition: the coefficients once, what float32 and float64 make of them."""
    mp = pytest.importorskip("mpmath").mp.clone()
    mp.dps = 60
    curve, c = shapes.curve_of(surface_of(a)), mp.mpf(1) / 40
    assert curve.centred is not None and curve.centred.chebyshev == (a is FLAT)

    def sag(h):  # type: ignore[no-untyped-def]
        x = (h / RIM) ** 2
        form = sum(mp.mpf(v) * mp.jacobi(m, 0, 4, 2 * x - 1) for m, v in enumerate(a))
        return c * h * h / (1 + mp.sqrt(1 - (c * h) ** 2)) + x**2 * form

    heights = np.linspace(0.4, RIM, 20).astype(np.float32)
    exact = np.array([[float(sag(mp.mpf(float(h)))), float(mp.diff(sag, mp.mpf(float(h))))] for h in heights]).T
    for dtype, tolerance in ((np.float64, (2e-8, 1e-7)), (np.float32, (3e-7, 2e-6))):
        h = heights.astype(dtype)
        tensor = torch.from_numpy(h)
        for o, h2, at in ((NUMPY, h * h, h), (Tensors(False, tensor.dtype), tensor * tensor, tensor)):
            found = shapes.depth(o, curve, h2, order=0)  # type: ignore[arg-type]
            assert np.abs(np.asarray(found.sag) - exact[0]).max() < tolerance[0]
            assert np.abs(np.asarray(found.slope * at) - exact[1]).max() < tolerance[1]


def test_odd_powers_that_cancel_are_centred_exactly() -> None:
    """A centred polynomial is the same polynomial: in 60 digits its coefficients give back those of the powers."""
    mp = pytest.importorskip("mpmath").mp.clone()
    mp.dps = 60
    for surface in (s for s in read_lens(LENSES / f"{WORST}.toml").surfaces if s.figure.asphere):
        found, powers = shapes.centred(surface), surface.figure.asphere
        assert found is not None and any(p % 2 for p, _ in powers)
        for share in (0.0, 0.3, 0.8, 1.0, 1.2):
            h = mp.mpf(share * surface.semi_diameter_mm)
            t = h * found.scale - 1
            exact = [sum(mp.mpf(w) * a * h ** (p - 2) for p, a, w in rows) for rows in (
                [(p, a, 1) for p, a in powers], [(p, a, p) for p, a in powers])]  # fmt: skip
            for coefficients, wanted in zip(found[1:3], exact, strict=True):
                size = sum(abs(c) * abs(t) ** k for k, c in enumerate(coefficients))
                assert abs(sum(mp.mpf(c) * t**k for k, c in enumerate(coefficients)) - wanted) < 2e-16 * size


def test_the_graph_of_a_lens_in_float32() -> None:
    """What C, shaders and ONNX are written from, run on float32, beside the tracer in float64."""
    stop = Surface(math.inf, 30.0, 10.0, stop=True)
    lens = Lens("", "", (surface_of(forbes(20)), Surface(math.inf, 3.0, 40.0), stop), 2.0)
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-10, 10, (2, 4000)), rng.uniform(-5, 5, (2, 4000))]).astype(np.float32)
    passed, error = graph_errors(lens, 12.0, 60.0, points)
    assert passed.mean() > 0.3 and np.quantile(error, 0.99) < 1e-6


def test_lenses_whose_powers_do_not_cancel_stay_as_they_are() -> None:
    steep = Surface(40.0, 3.0, 2 * RIM, 1.5, figure=Figure(asphere=((4, 1.0), (6, 1.0))))  # far beyond, but of one sign
    assert shapes.centred(steep) is None
    assert all(shapes.centred(s) is None for path in PATHS for s in read_lens(path).surfaces)


def test_sags_that_no_lens_has_are_refused() -> None:
    sound = Surface(40.0, 3.0, 2 * RIM, 1.5, figure=Figure(asphere=((4, 1e-5), (6, -1e-9))))
    check_figures([sound, replace(sound, diameter_mm=math.nan)], "a file")  # a rim that is not yet known is no fault
    check_figures([surface_of(FLAT)], "a file")
    for key, wrong in (
        ("qcon", surface_of([1e5, -1e5] * 10)),
        ("norm_mm", replace(surface_of(FLAT), diameter_mm=40.0)),
    ):
        with pytest.raises(InputError, match=f"surface 0, {key}: "):
            check_figures([wrong], "a file")
    for a in (1e20, 1e200, 1e308):  # no overflow on the way to the refusal
        with pytest.raises(InputError, match="surface 0, asphere"):
            check_figures([replace(sound, figure=replace(sound.figure, asphere=((4, a), (42, -a))))], "a file")
    endless = replace(sound, figure=replace(sound.figure, asphere=((4, 1e308), (6, -1e308))))
    with pytest.raises(InputError, match="surface 0, asphere"):
        check_figures([endless], "a file")
