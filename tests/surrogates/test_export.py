"""Exported graphs against the torch model in float64, inside the domain and out of it; the card."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import lens_models
import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from neurolens.base import status as st
from neurolens.base.errors import InputError, ModelError
from neurolens.cameras.model import load_model
from neurolens.modelfile import CARD_KEY
from neurolens.optics.paraxial import first_order
from neurolens.surrogates.card import card_of, card_to_json
from neurolens.surrogates.domain import Domain, FilmRays, sample_domain
from neurolens.surrogates.export import export_onnx
from neurolens.surrogates.model import LensModel, Prediction
from neurolens.surrogates.specialise import at_wavelength

COUNT = 100_000


def run(kind: str, rays: np.ndarray, film_z: float, stop: float) -> list[np.ndarray]:
    session = onnxruntime.InferenceSession(str(lens_models.exported(kind)), providers=["CPUExecutionProvider"])
    feeds = {"rays": rays, "film_z_mm": np.array([film_z], np.float32), "stop_radius_mm": np.array([stop], np.float32)}
    return session.run(["scene_ray", "transmittance", "stop_xy_mm", "status"], feeds)


def predict(model: LensModel, rays: np.ndarray, film_z: float, stop: float) -> Prediction:
    fx, fy, px, py, wavelength = torch.from_numpy(rays).double()
    z = torch.full_like(fx, float(np.float32(film_z)))
    with torch.no_grad():
        return model.predict(FilmRays(fx, fy, z, px, py, wavelength), float(np.float32(stop)))


def domain_rays(domain: Domain, count: int, seed: int) -> np.ndarray:
    s = sample_domain(domain, count, seed)
    return torch.stack([s.film_x, s.film_y, s.pupil_x, s.pupil_y, s.wavelength_nm]).float().numpy()


def rim_distance_mm(model: LensModel, rays: np.ndarray, film_z: float, stop: float) -> np.ndarray:
    """Distance in mm of each ray's nearest crossing from the rim (or stop) that it crosses, in the model's own eyes."""
    fx, fy, px, py, wavelength = torch.from_numpy(rays).double()
    field = model.encoding(FilmRays(fx, fy, torch.full_like(fx, film_z), px, py, wavelength))
    vectors, scalars = model.core(field)
    margins = [(torch.linalg.norm(vectors[2] * model.scales.stop_mm, dim=0) - stop).abs()]
    for gate, value in zip(model.gates, scalars[1:], strict=True):
        margins.append(value.abs() / 2 * model.lens.surfaces[gate.surface].semi_diameter_mm)
    return torch.stack(margins).min(0).values.numpy()


@pytest.mark.parametrize("kind", lens_models.KINDS)
@pytest.mark.parametrize("stopped", [1.0, 0.5])
def test_graph_agrees_with_the_model(kind: str, stopped: float) -> None:
    model = lens_models.model(kind)
    domain = model.domain
    rays = domain_rays(domain, COUNT, seed=3)
    film_z, stop = domain.film_z_mm[0] + 0.3 * np.ptp(domain.film_z_mm), stopped * domain.stop_radius_mm
    scene, power, stop_xy, status = run(kind, rays, film_z, stop)
    expected = predict(model, rays, film_z, stop)
    assert [a.dtype for a in (scene, power, stop_xy, status)] == [np.float32] * 3 + [np.int32]

    differ = status != expected.status.numpy()
    assert np.all(rim_distance_mm(model, rays, film_z, stop)[differ] < 1e-3)
    passed = (expected.status.numpy() == st.PASSED) & ~differ
    assert passed.mean() > 0.01 and len(np.unique(status)) > 2
    point, direction = np.split(torch.stack(list(expected.rays)).numpy(), 2)
    efl_um = 1e3 * abs(first_order(model.lens).efl_mm)
    film_error = efl_um * np.linalg.norm(scene[3:] - direction, axis=0)[passed]
    assert np.quantile(film_error, 0.99) < 0.05
    assert np.quantile(np.linalg.norm(scene[:3] - point, axis=0)[passed], 0.99) < 1e-4
    assert np.abs(power - expected.transmittance.numpy())[passed].max() < 1e-5
    assert np.abs(stop_xy - torch.stack([expected.stop_x, expected.stop_y]).numpy())[:, passed].max() < 1e-4
    assert np.abs(np.linalg.norm(scene[3:, passed], axis=0) - 1).max() < 1e-6


@pytest.mark.parametrize("kind", lens_models.KINDS)
def test_nothing_outside_the_domain_passes(kind: str) -> None:
    domain = lens_models.domain("muller_fisheye_100" if kind == "fisheye" else "laikin_double_gauss_50")
    rng = np.random.default_rng(7)
    rays = domain_rays(domain, COUNT, seed=4)
    strange = np.array(
        [np.nan, np.inf, -np.inf, 1e-42, -1e-42, 0.0, 3.4e38, -3.4e38, 1.9e19, 1e10, 1e3, -1e3], np.float32
    )
    where = rng.random(rays.shape) < 0.3
    rays[where] = rng.choice(strange, int(where.sum()))
    wild = rng.random(COUNT) < 0.2
    rays[:, wild] = (10.0 ** rng.uniform(-45, 38, (5, int(wild.sum())))).astype(np.float32)
    low, high = domain.wavelength_nm
    with np.errstate(all="ignore"):
        r = rays.astype(np.float64)
        inside = np.hypot(r[0], r[1]) <= domain.film_radius_mm * 1.0001
        inside &= np.hypot(r[2], r[3]) <= domain.pupil_radius_mm * 1.0001
        if low < high:
            inside &= (r[4] >= low / 1.0001) & (r[4] <= high * 1.0001)
        else:
            inside &= (r[4] > 0) & np.isfinite(r[4])
    scene, _, _, status = run(kind, rays, domain.film_z_mm[0], domain.stop_radius_mm)
    assert np.all(status[~inside] == st.OUTSIDE_DOMAIN)
    passed = status == st.PASSED
    assert passed.any() and np.isfinite(scene[:, passed]).all()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 0.0, -1.0, 1e30, "near", "far"])
def test_film_position_outside_the_domain(bad: float | str) -> None:
    domain = lens_models.domain()
    z = {"near": domain.film_z_mm[0] * 0.999, "far": domain.film_z_mm[1] * 1.001}.get(bad, bad)
    rays = domain_rays(domain, 1000, seed=5)
    for kind in ("invariants", "network"):
        assert np.all(run(kind, rays, float(z), domain.stop_radius_mm)[3] == st.OUTSIDE_DOMAIN)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1.001, -1e-6, -0.5, -math.inf])
def test_stop_wider_than_the_domain_and_closed_stop(bad: float) -> None:
    domain = lens_models.domain()
    rays = domain_rays(domain, 1000, seed=5)
    stop = bad * domain.stop_radius_mm
    assert np.all(run("invariants", rays, domain.film_z_mm[0], stop)[3] == st.OUTSIDE_DOMAIN)
    closed = run("invariants", rays, domain.film_z_mm[0], 0.0)[3]
    assert not (closed == st.PASSED).any() and not (closed == st.OUTSIDE_DOMAIN).any()


@pytest.mark.parametrize("kind", ["laser", "fisheye"])
def test_one_wavelength_models_refuse_what_is_no_wavelength(kind: str, tmp_path: Path) -> None:
    """A model for one wavelength knows no other; one of a lens without dispersion takes any that is one."""
    model = lens_models.model("invariants" if kind == "laser" else kind)
    path = lens_models.exported(kind) if kind != "laser" else tmp_path / "laser.onnx"
    if kind == "laser":
        model = at_wavelength(model, 550.0)
        export_onnx(model, path)
    good = [550.0, 550.0 * (1 + 5e-6)] if kind == "laser" else [587.6, 1.0, 1e6]
    bad = [math.nan, math.inf, -math.inf, 0.0, -550.0, *([551.0, 400.0] if kind == "laser" else [])]
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    rays = domain_rays(model.domain, 500, seed=8)
    film_z, stop = model.domain.film_z_mm[0], model.domain.stop_radius_mm
    for wavelength in (*good, *bad):
        rays[4] = wavelength
        feeds = {"rays": rays, "film_z_mm": np.float32([film_z]), "stop_radius_mm": np.float32([stop])}
        status = session.run(["status"], feeds)[0]
        for found in (status, predict(model, rays, film_z, stop).status.numpy()):
            assert np.all((found == st.OUTSIDE_DOMAIN) == (wavelength not in good)), wavelength


def test_domain_limits_are_inside() -> None:
    domain = lens_models.domain()
    angle = np.linspace(0, 2 * np.pi, 64)
    edge = domain.film_radius_mm * np.stack([np.cos(angle), np.sin(angle)])
    for wavelength in domain.wavelength_nm:
        rays = np.stack([*edge, *(0 * edge), np.full(64, wavelength)]).astype(np.float32)
        for z in domain.film_z_mm:
            assert not (run("invariants", rays, z, domain.stop_radius_mm)[3] == st.OUTSIDE_DOMAIN).any()


def test_card_is_strict_json_and_says_what_the_model_is(tmp_path: Path) -> None:
    model = lens_models.model("invariants")
    session = onnxruntime.InferenceSession(str(lens_models.exported("invariants")), providers=["CPUExecutionProvider"])

    def refuse(name: str) -> None:
        raise AssertionError(name)

    card = json.loads(session.get_modelmeta().custom_metadata_map["neurolens"], parse_constant=refuse)
    assert card["lens"]["sha256"] == model.lens.sha256
    assert card["lens"]["efl_mm"] == pytest.approx(first_order(model.lens).efl_mm)
    assert Domain.from_dict(card["domain"]) == model.domain
    assert card["errors"] == {"rms_um": 1.0}
    assert set(card["status_codes"]) == {"0", "1", *(str(g.status) for g in model.gates), str(4 * 6 + 2)}
    with pytest.raises(InputError, match="errors.p99_um"):
        card_to_json(card_of(model, {"p99_um": math.nan}))
    with pytest.raises(InputError, match="errors"):
        export_onnx(model, tmp_path / "bad.onnx", {"rms_um": math.inf})
    assert list(tmp_path.iterdir()) == []


def test_weights_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    model = lens_models.model("invariants")
    core = replace(model.core, scalars=model.core.scalars * math.nan)  # type: ignore[type-var, attr-defined]
    with pytest.raises(InputError, match="finite"):
        export_onnx(replace(model, core=core), tmp_path / "bad.onnx", {})


def test_the_card_says_what_float32_costs(tmp_path: Path) -> None:
    """Within it reference rays come out; beyond it, and where it is no number, the file is refused."""
    file = lens_models.exported("fisheye")
    rounding = load_model(file).card["reference"]["rounding"]
    assert set(rounding) == {"position_mm", "direction", "transmittance", "stop_mm"}
    assert all(0 <= v < 1e-3 for v in rounding.values())
    for changed, refused in ((1e-3, False), ("inf", True), ("much", True), (None, True)):
        proto = onnx.load(file)
        entry = next(p for p in proto.metadata_props if p.key == CARD_KEY)
        card = json.loads(entry.value)
        card["reference"]["rounding"]["stop_mm"] = changed
        entry.value = json.dumps(card)
        onnx.save(proto, tmp_path / "changed.onnx")
        if refused:
            with pytest.raises(ModelError, match="rounding"):
                load_model(tmp_path / "changed.onnx")
        else:
            load_model(tmp_path / "changed.onnx")
