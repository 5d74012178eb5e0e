"""Cameras as C against the same in onnxruntime: same random numbers, same rays."""

import math
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import lens_models
import numpy as np
import pytest
from shipped import whole

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras import lenscamera
from neurolens.cameras.build import make_camera
from neurolens.cameras.contract import CameraRays
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.model import OnnxCamera, OnnxLens, load_model
from neurolens.graph import compiler
from neurolens.graph.ir import Graph
from neurolens.graph.loworder import WORST, with_low_order_derivatives
from neurolens.models.export import export_onnx
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.designs import coated
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.lens.shot import Runtime, Shot
from neurolens.optics.readers.lensfile import read_lens

FILM = (36.0, 24.0)
BAND = np.abs(np.add.outer(np.arange(64), -np.arange(64))) < 16  # about half of the stop
Numbers = tuple[np.ndarray, np.ndarray, np.ndarray]
RUNTIMES: tuple[Runtime, ...] = ("onnxruntime", "c")


@pytest.fixture(scope="module", autouse=True)
def quick(tmp_path_factory: pytest.TempPathFactory) -> object:
    """Compiled into a folder of the tests."""
    try:
        compiler.find_compiler()
    except InputError as reason:
        pytest.skip(f"nothing is compiled here: {reason}")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@cache
def model_file() -> Path:
    """A polynomial, exported with derivatives."""
    file = lens_models.exported("invariants")
    return export_onnx(lens_models.model("invariants"), file.with_name("moves.onnx"), derivatives=True)


@cache
def pair(f_number: float | None = None, aperture: Aperture | None = None) -> tuple[OnnxCamera, OnnxCamera]:
    """The same model in onnxruntime and as C."""
    model = load_model(model_file())
    plain, fused = (
        OnnxCamera(model, Shot(FILM, 2.0, f_number, aperture=aperture, runtime=runtime)) for runtime in RUNTIMES
    )
    return plain, fused


def numbers(count: int, seed: int = 0, film: tuple[float, float] = FILM) -> Numbers:
    """Points beyond the film too, the whole square, wavelengths beyond the model's."""
    rng = np.random.default_rng(seed)
    points = (rng.random((2, count)) - 0.5) * 1.4 * np.array(film)[:, None]
    square, wavelength = rng.random((2, count), np.float32), rng.uniform(360, 800, count)
    return points.astype(np.float32), square, wavelength.astype(np.float32)


def agree(found: CameraRays, wanted: CameraRays, differ: float = 0.0, metres: float = 1e-7, unit: float = 1e-6) -> None:
    """Equal to rounding where both pass; statuses may differ for a share of rays, at an edge."""
    same = found.status == wanted.status
    assert np.count_nonzero(~same) <= differ * same.size
    assert found.status.dtype == np.int32 and found.weight.dtype == found.origin_m.dtype == np.float32
    ok = same & (wanted.status == st.PASSED)
    np.testing.assert_allclose(found.origin_m[:, ok], wanted.origin_m[:, ok], rtol=0, atol=metres)
    np.testing.assert_allclose(found.direction[:, ok], wanted.direction[:, ok], rtol=0, atol=unit)
    np.testing.assert_allclose(found.weight[same], wanted.weight[same], rtol=5e-6, atol=1e-6)


def test_a_model_gives_the_rays_of_onnxruntime() -> None:
    plain, fused = pair()
    given = numbers(20_000)
    wanted = plain.sample(*given)
    agree(fused.sample(*given), wanted, differ=2e-4)
    assert 0.3 < (wanted.status == st.PASSED).mean() < 0.9 and (wanted.status == st.OUTSIDE_DOMAIN).any()


def test_extremes_of_film_square_and_wavelength() -> None:
    plain, fused = pair()
    below = np.nextafter(np.float32(1), np.float32(0))
    square = np.array([[0.0, 0.5, below, 0.0, 0.5, 1e-30, below], [0.0, 0.5, below, below, 0.0, 0.5, 0.5]], np.float32)
    strange = np.float32([0.0, math.nan, math.inf, -math.inf, 1e-40, 3e38, 21.0, -17.9])
    x, y, k = (a.ravel() for a in np.meshgrid(strange, strange, np.arange(square.shape[1])))
    for wavelength in (550.0, 400.0, 380.0, 0.0, math.nan, math.inf, -550.0):
        given = np.stack([x, y]), square[:, k], np.full(x.size, wavelength, np.float32)
        with np.errstate(all="ignore"):
            wanted, found = plain.sample(*given), fused.sample(*given)
        assert np.array_equal(found.status, wanted.status), wavelength
        assert np.isfinite(found.weight).all() and (found.weight[found.status != st.PASSED] == 0).all()
        agree(found, wanted)
        dark = ~np.isfinite(x) | ~np.isfinite(y) | (x > 1e3) | (y > 1e3)
        assert (found.direction[:, dark].T == (0, 0, -1)).all() and not found.weight[dark].any()


@pytest.mark.parametrize("count", [0, 1, 255, 257])
def test_batches_of_any_size(count: int) -> None:
    plain, fused = pair()
    given = numbers(count)
    agree(fused.sample(*given), plain.sample(*given))
    moves = fused.sample_differentials(*given).differentials
    assert moves is not None and moves.origin_m.shape == moves.direction.shape == (3, 2, count)


def test_arrays_of_other_layouts_and_shapes() -> None:
    _, fused = pair()
    film, square, wavelength = numbers(300)
    wide = np.repeat(film, 2, axis=1)[:, ::2].astype(np.float64)
    assert np.array_equal(fused.sample(wide, square, wavelength).weight, fused.sample(film, square, wavelength).weight)
    for bad in ((film[:1], square, wavelength), (film, square[:, :9], wavelength), (film, square, wavelength[:9])):
        with pytest.raises(ValueError):
            fused.sample(*bad)


@pytest.mark.parametrize("aperture", [Aperture(mask=BAND), *whole(Aperture(blades=5, rotation_deg=20))])
def test_blades_and_masks(aperture: Aperture) -> None:
    plain, fused = pair(5.6, aperture)
    given = numbers(20_000, seed=3)
    wanted = plain.sample(*given)
    agree(fused.sample(*given), wanted, differ=2e-3)
    stopped = wanted.status == st.blocked(lens_models.lens().stop_index, st.RIM)
    assert stopped.mean() > 0.1 and (wanted.status == st.PASSED).mean() > 0.1


def test_differentials_of_a_model_come_as_near_to_those_of_its_graph_as_the_camera_says() -> None:
    plain, fused = pair()
    film, square, wavelength = numbers(20_000, seed=5)
    given = film / np.float32(1.4), square, np.clip(wavelength, 400, 700)
    wanted, found = plain.sample_differentials(*given), fused.sample_differentials(*given)
    agree(found, wanted, differ=2e-4)
    ok = (found.status == st.PASSED) & (wanted.status == st.PASSED)
    assert found.differentials is not None and wanted.differentials is not None and ok.mean() > 0.3
    worst = 0.0
    for name in ("origin_m", "direction"):
        a, b = (getattr(d, name)[..., ok].astype(float) for d in (found.differentials, wanted.differentials))
        share = np.sqrt(np.square(a - b).sum(axis=(0, 1)) / np.square(b).sum(axis=(0, 1)))
        worst = max(worst, float(np.sqrt(np.mean(share**2))))
    assert fused.differentials_error is not None
    assert 0.001 < fused.differentials_error < WORST and worst < 1.2 * fused.differentials_error
    dark = found.status != st.PASSED
    assert dark.any() and not found.differentials.direction[..., dark].any()


def test_differentials_that_no_low_order_meets_are_those_of_the_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lenscamera, "with_low_order_derivatives", partial(with_low_order_derivatives, worst=0.0))
    plain, _ = pair()
    fused = OnnxCamera(load_model(model_file()), Shot(FILM, 2.0, runtime="c"))
    given = numbers(5000, seed=5)
    wanted, found = plain.sample_differentials(*given), fused.sample_differentials(*given)
    ok = (found.status == st.PASSED) & (wanted.status == st.PASSED)
    assert fused.differentials_error is None and found.differentials is not None and wanted.differentials is not None
    for name in ("origin_m", "direction"):
        a, b = (getattr(d, name)[..., ok] for d in (found.differentials, wanted.differentials))
        np.testing.assert_allclose(a, b, rtol=0, atol=2e-5 * np.abs(b).max())


def absorbing(design: str = "") -> Lens:
    """A singlet of glass that absorbs, with six blades; bare, or with films that disperse."""
    lens = read_lens(lens_models.LENSES / "thorlabs_lb1471_biconvex_50.toml").with_aperture(Aperture(blades=6))
    lens = replace(lens, surfaces=tuple(replace(s, absorption_per_mm=0.02 * (s.n_d != 1)) for s in lens.surfaces))
    return coated(lens, design) if design else lens


@pytest.mark.parametrize(
    ("lens", "film_mm"),
    [
        pytest.param(absorbing(), FILM, marks=pytest.mark.whole),
        (absorbing("three-layer"), FILM),
        pytest.param(lens_models.lens("canon_aspheric_50"), (20.0, 14.0), marks=pytest.mark.whole),
        pytest.param(lens_models.lens("schneider_anamorphic_31"), (20.0, 14.0), marks=pytest.mark.whole),
    ],
    ids=["bare", "coated", "aspheres", "cylinders"],
)
def test_the_exact_lens(lens: Lens, film_mm: tuple[float, float]) -> None:
    """At the rims rounding decides who passes. (Both are held against the tracer in test_exact.)"""
    plain, other = (ExactCamera(lens, Shot(film_mm, 3.0, runtime=kind)) for kind in RUNTIMES)
    film, square, _ = numbers(4000, 7, film_mm)
    given = film, square, np.linspace(400, 700, 4000, dtype=np.float32)
    wanted, found = plain.sample(*given), other.sample(*given)
    agree(found, wanted, differ=1e-3, metres=5e-7, unit=1e-5)
    ok = (found.status == st.PASSED) & (wanted.status == st.PASSED)
    assert ok.mean() > 0.3
    if film_mm == FILM:  # compiled lenses of aspheres or cylinders fit their differentials
        moves = [camera.sample_differentials(*given).differentials for camera in (other, plain)]
        a, b = (move.direction[..., ok] for move in moves if move is not None)
        np.testing.assert_allclose(a, b, rtol=0, atol=2e-5 * np.abs(b).max())


def test_rays_that_are_lost_on_their_way_stay_finite() -> None:
    fused = ExactCamera(absorbing(), Shot(FILM, 3.0, runtime="c"))
    given = np.zeros((2, 3), np.float32), np.full((2, 3), 0.3, np.float32), np.float32([math.nan, 0.0, 550.0])
    found = fused.sample_differentials(*given)
    assert found.differentials is not None and (found.status[:2] != st.PASSED).all() and found.status[2] == st.PASSED
    numbers = (found.origin_m, found.direction, found.differentials.origin_m, found.differentials.direction)
    assert all(np.isfinite(a).all() for a in numbers) and (found.weight > 0).tolist() == [False, False, True]


@pytest.mark.parametrize("length", [1.01, *whole(0.0, math.nan)])
def test_directions_of_another_length_pass_nothing(length: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a poor network makes of a few rays, here of those of half the film."""

    whole_graph = OnnxLens.graph

    def spoilt(model: OnnxLens, *form: Any) -> Graph:
        g = whole_graph(model, *form)
        zero = g.select(g.input("rays", 5)[0] <= 0.0, 0.0, 1.0)
        strange = zero / zero if math.isnan(length) else 1.0 / zero
        factor = strange if not math.isfinite(length) else g.select(zero <= 0.0, length, 1.0)
        scene_ray = g.outputs["scene_ray"]
        g.outputs["scene_ray"] = g.concat(scene_ray[0:3], scene_ray[3:6] * factor)
        return g

    _, whole = pair()
    half = OnnxCamera(load_model(model_file()), Shot(FILM, 2.0, runtime="c"))
    monkeypatch.setattr(OnnxLens, "graph", spoilt)
    half.start("c")
    given = numbers(4000, seed=2)
    wanted, found = whole.sample(*given), half.sample(*given)
    left, passed = given[0][0] <= 0, wanted.status == st.PASSED
    assert passed[left].any() and passed[~left].any()
    assert (found.status[left & passed] == st.OUTSIDE_DOMAIN).all() and not found.weight[left].any()
    assert (found.direction[:, left].T == (0, 0, -1)).all()
    assert np.array_equal(found.status[~left], wanted.status[~left])
    assert np.array_equal(found.weight[~left] > 0, wanted.weight[~left] > 0)


def test_cameras_that_cannot_be_compiled() -> None:
    twice = f"thick:fused:{lens_models.LENSES / 'phone_lens_6'}.toml"
    for spec in ("fused:thin", "fused:", "fused:nothing.onnx", twice):
        with pytest.raises(InputError):
            make_camera(spec, Shot(FILM, 2.0))
