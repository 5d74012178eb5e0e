"""Models as C: compiled by the system's compiler and held against the float64 model, inside its domain and outside."""

from __future__ import annotations

import math
import subprocess
from functools import cache
from pathlib import Path

import lens_models
import numpy as np
import pytest
import torch

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.evaluate.candidates import FLAGS, CompiledSource, find_compiler
from neurolens.evaluate.speed import Unavailable
from neurolens.graph.c import literal
from neurolens.graph.program import SCENE_RAY, Program
from neurolens.optics.paraxial import first_order
from neurolens.surrogates.assemble import ALL, RAY_ONLY, Parts
from neurolens.surrogates.card import card_of
from neurolens.surrogates.domain import FilmRays, sample_domain
from neurolens.surrogates.fit import ModelSettings, fit_model
from neurolens.surrogates.model import LensModel, Prediction
from neurolens.surrogates.source import export_source, fused_program
from neurolens.surrogates.specialise import Fix, fixed_models

COUNT = 50_000
KINDS = (*lens_models.KINDS, "zones")
COLUMNS = ("film_x_mm", "film_y_mm", "pupil_x_mm", "pupil_y_mm", "wavelength_nm")


@pytest.mark.slow
def test_a_lens_with_cylinders() -> None:
    model = fit_model(lens_models.anamorphic(), ModelSettings(terms=48, degree=4, planes=False))
    film_z, stop = model.domain.film_z_mm[0], model.domain.stop_radius_mm
    rays = rays_of(model, COUNT, seed=3)
    found = built(fused_program([model])).rays({**rays, "film_z_mm": film_z, "stop_radius_mm": stop})
    agree(model, found, predict(model, rays, film_z, stop), edge_distance(model, rays, film_z, stop))


@cache
def compiled(kind: str) -> CompiledSource:
    # Quick to compile; that -O3 gives the same is a test of its own.
    return built(fused_program([lens_models.model(kind)]), "-O1")


def built(program: Program, level: str = "-O1") -> CompiledSource:
    try:
        find_compiler()
    except Unavailable as reason:
        pytest.skip(f"the C form is not compiled here: {reason}")
    return CompiledSource(program, ("-std=c99", level, "-march=native", "-Wall", "-Wextra", "-Werror"))


def rays_of(model: LensModel, count: int, seed: int) -> dict[str, np.ndarray]:
    s = sample_domain(model.domain, count, seed)
    columns = (s.film_x, s.film_y, s.pupil_x, s.pupil_y, s.wavelength_nm)
    return {name: c.float().numpy() for name, c in zip(COLUMNS, columns, strict=True)}


def predict(model: LensModel, rays: dict[str, np.ndarray], film_z: float, stop: float) -> Prediction:
    fx, fy, px, py, wavelength = (torch.from_numpy(rays[name]).double() for name in COLUMNS)
    z = torch.full_like(fx, float(np.float32(film_z)))
    with torch.no_grad():
        return model.predict(FilmRays(fx, fy, z, px, py, wavelength), float(np.float32(stop)))


def edge_distance(model: LensModel, rays: dict[str, np.ndarray], film_z: float, stop: float) -> np.ndarray:
    """How far each ray is from changing its status: least of |scalar| and of |(r / stop radius)^2 - 1|."""
    fx, fy, px, py, wavelength = (torch.from_numpy(rays[name]).double() for name in COLUMNS)
    vectors, scalars = model.core(model.encoding(FilmRays(fx, fy, torch.full_like(fx, film_z), px, py, wavelength)))
    square = ((vectors[2] * model.scales.stop_mm) ** 2).sum(0) / stop**2 - 1
    return torch.cat([scalars[1:], square[None]]).abs().min(0).values.numpy()


def agree(model: LensModel, found: dict[str, np.ndarray], expected: Prediction, edge: np.ndarray) -> None:
    """The tolerances of the ONNX graph: float32 costs a few parts in ten million."""
    status = expected.status.numpy()
    differ = found["status"] != status
    assert np.all(edge[differ] < 1e-4), "status differs away from an edge"
    passed = (status == st.PASSED) & ~differ
    assert passed.mean() > 0.01 and len(np.unique(status)) > 2
    scene = np.stack([found[name] for name in SCENE_RAY])
    point, direction = np.split(torch.stack(list(expected.rays)).numpy(), 2)
    efl_um = 1e3 * abs(first_order(model.lens).efl_mm)
    assert np.quantile(efl_um * np.linalg.norm(scene[3:] - direction, axis=0)[passed], 0.99) < 0.05
    assert np.quantile(np.linalg.norm(scene[:3] - point, axis=0)[passed], 0.99) < 1e-4
    assert np.abs(np.linalg.norm(scene[3:, passed], axis=0) - 1).max() < 1e-6
    if "transmittance" in found:
        assert np.abs(found["transmittance"] - expected.transmittance.numpy())[passed].max() < 1e-5
    if "stop_x_mm" in found:
        off = [found["stop_x_mm"] - expected.stop_x.numpy(), found["stop_y_mm"] - expected.stop_y.numpy()]
        assert np.abs(off)[:, passed].max() < 1e-4


@pytest.mark.parametrize("kind", KINDS)
def test_c_agrees_with_the_model(kind: str) -> None:
    model = lens_models.model(kind)
    d = model.domain
    rays = rays_of(model, COUNT, seed=3)
    for film_z, stop in ((d.film_z_mm[0], d.stop_radius_mm), (d.film_z_mm[1], 0.5 * d.stop_radius_mm)):
        found = compiled(kind).rays({**rays, "film_z_mm": film_z, "stop_radius_mm": stop})
        agree(model, found, predict(model, rays, film_z, stop), edge_distance(model, rays, film_z, stop))


def test_the_compiler_makes_vectors_and_loses_nothing() -> None:
    model = lens_models.model("invariants")
    program = fused_program([model])
    rays = {**rays_of(model, 4099, seed=5), "film_z_mm": model.domain.film_z_mm[0], "stop_radius_mm": 4.0}
    slow, fast = built(program).rays(rays), CompiledSource(program, FLAGS).rays(rays)
    for name, column in slow.items():
        np.testing.assert_allclose(fast[name], column, rtol=0, atol=2e-5)
    asked = [*find_compiler().split(), "--version"]
    if "gcc" in subprocess.run(asked, capture_output=True, text=True, check=True).stdout:
        assert "loop vectorized" in CompiledSource(program, (*FLAGS, "-fopt-info-vec")).warnings


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_outside_the_domain_passes(kind: str) -> None:
    model = lens_models.model(kind)
    d, rng = model.domain, np.random.default_rng(7)
    rays = rays_of(model, COUNT, seed=4)
    strange = np.array(
        [math.nan, math.inf, -math.inf, 1e-42, -1e-42, 0.0, 3.4e38, -3.4e38, 1.9e19, 1e10, 1e3, -1e3], np.float32
    )
    for column in rays.values():
        where = rng.random(COUNT) < 0.3
        column[where] = rng.choice(strange, int(where.sum()))
    r = {name: column.astype(np.float64) for name, column in rays.items()}
    low, high = model.wavelength_limits_nm
    with np.errstate(all="ignore"):
        inside = np.hypot(r["film_x_mm"], r["film_y_mm"]) <= d.film_radius_mm * 1.0001
        inside &= np.hypot(r["pupil_x_mm"], r["pupil_y_mm"]) <= d.pupil_radius_mm * 1.0001
        if model.encoding.w_half:
            inside &= (r["wavelength_nm"] >= low / 1.0001) & (r["wavelength_nm"] <= high * 1.0001)
    found = compiled(kind).rays({**rays, "film_z_mm": d.film_z_mm[0], "stop_radius_mm": d.stop_radius_mm})
    assert np.all(found["status"][~inside] == st.OUTSIDE_DOMAIN)
    passed = found["status"] == st.PASSED
    assert passed.any() and all(np.isfinite(found[name][passed]).all() for name in SCENE_RAY)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 0.0, -1.0, 1e30, 1e-42])
@pytest.mark.parametrize("which", ["film_z_mm", "stop_radius_mm"])
def test_calls_outside_the_domain(which: str, bad: float) -> None:
    model = lens_models.model("invariants")
    given = {"film_z_mm": model.domain.film_z_mm[0], "stop_radius_mm": model.domain.stop_radius_mm, which: bad}
    found = compiled("invariants").rays({**rays_of(model, 1000, seed=5), **given})
    # A stop that is shut is inside the domain: it blocks.
    blocks = which == "stop_radius_mm" and 0 <= bad < 1
    assert not (found["status"] == st.PASSED).any()
    assert bool(np.all(found["status"] == st.OUTSIDE_DOMAIN)) != blocks


@pytest.mark.parametrize("kind", ["invariants", "network", "raw", "zones"])
def test_wavelengths_film_and_stop_fixed(kind: str) -> None:
    model = lens_models.model(kind)
    waves, d = (450.0, 550.0, 650.0), model.domain
    film_z, stop = float(np.mean(d.film_z_mm)), 0.5 * d.stop_radius_mm
    models = fixed_models(model, Fix(waves, film_z, stop))
    program = fused_program(models, ALL, Fix((), film_z, stop))
    whole, free = built(program), sum(fused_program([model]).count().values())
    assert whole.signature.inputs == COLUMNS[:4] and whole.signature.bands == 3
    assert sum(program.count().values()) < (free if kind == "network" else 0.9 * free)
    rays = rays_of(model, COUNT, seed=6)
    for band, wave in enumerate(waves):
        rays["wavelength_nm"][:] = wave
        found, expected = whole.rays(rays, band), predict(model, rays, film_z, stop)
        # A rim that went blocked next to nothing by itself; rays that something else stops have another's code.
        passing = found["status"] == st.PASSED
        assert np.mean(passing != (expected.status.numpy() == st.PASSED)) < 5e-5
        both = passing & (expected.status.numpy() == st.PASSED)
        direction = np.stack([found[name] for name in SCENE_RAY[3:]])
        assert np.abs(direction - torch.stack(list(expected.rays))[3:].numpy())[:, both].max() < 2e-6
    for band in (-1, 3, 2**31 - 1):
        assert np.all(whole.rays(rays, band)["status"] == st.OUTSIDE_DOMAIN)


def test_only_what_is_wanted() -> None:
    model = lens_models.model("invariants")
    rays = {**rays_of(model, 5000, seed=6), "film_z_mm": model.domain.film_z_mm[0], "stop_radius_mm": 5.0}
    ray, whole = built(fused_program([model], RAY_ONLY)), compiled("invariants").rays(rays)
    found = ray.rays(rays)
    assert set(found) == {*SCENE_RAY, "status"} and "stop_radius_mm" not in ray.signature.inputs
    assert set(np.unique(found["status"])) <= {st.PASSED, st.OUTSIDE_DOMAIN}
    for name in SCENE_RAY:
        np.testing.assert_allclose(found[name], whole[name], rtol=0, atol=2e-5)
    gates = built(fused_program([model], Parts(transmittance=False, stop=False, vignetting=True))).rays(rays)
    assert set(gates) == set(found) and np.mean(gates["status"] != whole["status"]) < 1e-3


def test_fixed_values_outside_the_domain_are_refused() -> None:
    model = lens_models.model("invariants")
    for fix, field in (
        (Fix(film_z_mm=1.0), "film_z"),
        (Fix(stop_radius_mm=99.0), "stop"),
        (Fix(wavelengths_nm=(200.0,)), "wavelength_nm"),
        (Fix(wavelengths_nm=(500.0, 500.0)), "wavelengths"),
    ):
        with pytest.raises(InputError, match=field):
            fixed_models(model, fix)
    with pytest.raises(InputError, match="film_z"):
        fused_program([model], ALL, Fix(film_z_mm=1.0))


def test_tanh() -> None:
    program = Program()
    program.outputs["y"] = program.tanh(program.input("x"))
    x = np.concatenate([np.linspace(-12, 12, 200_001), 10.0 ** np.linspace(-40, 1, 5001), [0.0, 3e38]])
    x = x.astype(np.float32)
    found = program.evaluate({"x": x})["y"].astype(np.float64)
    exact = np.tanh(x.astype(np.float64))
    normal = np.abs(x) > 1e-37
    assert np.abs(found / np.where(normal, exact, 1.0) - 1)[normal].max() < 3.2e-7
    assert np.abs(found[~normal]).max() < 1e-37


def test_literals_keep_every_bit() -> None:
    numbers = np.random.default_rng(1).integers(0, 2**32, 20_000, dtype=np.uint32).view(np.float32)
    numbers = numbers[np.isfinite(numbers)]
    read = np.array([np.float32(literal(float(v)).strip("()").removesuffix("f")) for v in numbers])
    assert np.array_equal(read.view(np.uint32), numbers.view(np.uint32))


def test_the_card_stands_on_top(tmp_path: Path) -> None:
    model = lens_models.model("invariants")
    card = card_of(model, {"rms_um": 1.25})
    card["lens"]["source"] = "A book */ #include <stdlib.h>\nand a second line"
    text = export_source([model], tmp_path / "lens.h", "c", card).path.read_text(encoding="utf-8")
    head = text[: text.index("#ifndef")]
    assert head.startswith("/*") and head.count("*/") == 1 and "\n#include" not in head
    for word in ("rms_um 1.25", "Double Gauss", "film radius", "26 blocked by the stop", "A book"):
        assert word in " ".join(head.split())
    with pytest.raises(InputError, match="name"):
        export_source([model], tmp_path / "x.h", "c", card, name="a b")
    with pytest.raises(InputError, match="to"):
        export_source([model], tmp_path / "x.h", "fortran", card)
    assert [p.name for p in tmp_path.iterdir()] == ["lens.h"]
