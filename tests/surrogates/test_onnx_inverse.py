"""Derivatives and inverse maps as files: what numpy and onnxruntime make of them is what torch makes."""

import shutil
from functools import cache
from pathlib import Path

import lens_models
import numpy as np
import onnxruntime
import pytest
import torch
from lens_models import edited, prepared

from neurolens.base import status as st
from neurolens.base.errors import InputError, ModelError
from neurolens.cameras.model import OnnxCamera, load_model
from neurolens.cameras.onnxmaps import load_inverse
from neurolens.lens.shot import Shot
from neurolens.surrogates.cardkeys import MODEL_KEY
from neurolens.surrogates.domain import FilmRays, sample_domain
from neurolens.surrogates.export import export_inverse, export_onnx
from neurolens.surrogates.fit import ModelSettings, fit_model
from neurolens.surrogates.inverse import InverseModel
from neurolens.surrogates.inverse_fit import fit_inverse

KINDS = ("invariants", "raw", "network", "thick", "fisheye")


@cache
def inverse(kind: str) -> InverseModel:
    name = "horimoto_fisheye_16" if kind == "fisheye" else "laikin_double_gauss_50"
    return fit_inverse(lens_models.model(kind), prepared(name).pairs)


def _rays(kind: str, count: int = 3000) -> FilmRays:
    """Rays of the domain's farthest film plane, as float32 holds them."""
    domain = lens_models.model(kind).domain
    rays = sample_domain(domain, count, seed=21)
    plane = torch.full_like(rays.film_z, domain.film_z_mm[1])
    columns = (rays.film_x, rays.film_y, plane, rays.pupil_x, rays.pupil_y, rays.wavelength_nm)
    return FilmRays(*(c.float().double() for c in columns))


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_of_the_file_are_those_of_the_model(kind: str, tmp_path: Path) -> None:
    m = lens_models.model(kind)
    plain = load_model(lens_models.exported(kind))
    loaded = load_model(export_onnx(m, tmp_path / "m.onnx", derivatives=True))
    rays = _rays(kind)
    film, pupil = (torch.stack(p).float().numpy() for p in ((rays.film_x, rays.film_y), (rays.pupil_x, rays.pupil_y)))
    w, plane, stop = rays.wavelength_nm.float().numpy(), float(rays.film_z[0]), m.domain.stop_radius_mm
    session = onnxruntime.InferenceSession(loaded.path.read_bytes(), providers=["CPUExecutionProvider"])
    feeds = {"rays": np.concatenate([film, pupil, w[None]]), "film_z_mm": np.float32([plane])}
    names = ["scene_ray_d_film", "scene_ray_d_pupil"]
    found = [np.moveaxis(a, 0, 1) for a in session.run(names, feeds | {"stop_radius_mm": np.float32([stop])})]
    wanted = m.differentiate(rays)
    ok = (wanted.prediction.status == st.PASSED).numpy()
    for a, b in zip(found, (wanted.d_film.numpy(), wanted.d_pupil.numpy()), strict=True):
        for rows in (slice(0, 3), slice(3, 6)):
            assert np.abs(a - b)[rows][..., ok].max() < 1e-5 * np.abs(b[rows][..., ok]).max()
    # Those who do not ask get what the plain file gives.
    for a, b in zip(loaded.rays(film, pupil, w, plane), plain.rays(film, pupil, w, plane), strict=True):
        np.testing.assert_allclose(a[..., ok], b[..., ok], atol=2e-5, rtol=1e-5)


@pytest.mark.slow
def test_cameras_agree_on_ray_differentials(tmp_path: Path) -> None:
    known = prepared()
    m = fit_model(known, ModelSettings("ols", terms=64, planes=False))
    model = load_model(export_onnx(m, tmp_path / "m.onnx"))
    camera = OnnxCamera(model, Shot((36.0, 24.0), 2.0))
    exact = lens_models.exact_camera(2.0, None)
    random = np.random.default_rng(0)
    film = (random.random((2, 2000), np.float32) - np.float32(0.5)) * np.array([[36], [24]], np.float32)
    square, w = random.random((2, 2000), np.float32), np.full(2000, 550, np.float32)
    a, b = (c.sample_differentials(film, square, w) for c in (camera, exact))
    assert a.differentials and b.differentials
    assert camera.sample(film, square, w).differentials is None
    both = (a.status == st.PASSED) & (b.status == st.PASSED)
    assert both.sum() > 1000
    for mine, truth in (
        (a.differentials.origin_m, b.differentials.origin_m),
        (a.differentials.direction, b.differentials.direction),
    ):
        off = np.sqrt(np.mean((mine - truth)[..., both] ** 2) / np.mean(truth[..., both] ** 2))
        assert off < 0.01


@pytest.mark.parametrize("kind", ["invariants", "network", "fisheye"])
def test_inverse_maps_of_the_file_are_those_of_torch(kind: str, tmp_path: Path) -> None:
    inv, rays = inverse(kind), _rays(kind)
    export_inverse(inv, tmp_path / "m.onnx", {"rms_um": 1.0})
    loaded = load_inverse(tmp_path / "m.onnx", lens=inv.model.lens.sha256)
    forward = inv.model.predict(rays)
    film, w, plane = torch.stack([rays.film_x, rays.film_y]).numpy(), rays.wavelength_nm.numpy(), float(rays.film_z[0])
    stop = torch.stack([forward.stop_x, forward.stop_y])
    found = loaded.through_stop(film, stop.numpy(), w, plane)
    wanted = inv.through_stop(rays.film_x, rays.film_y, rays.film_z, stop[0], stop[1], rays.wavelength_nm)
    passed = (forward.status == st.PASSED).numpy()
    rim = (stop.norm(dim=0) > 0.999 * inv.model.domain.stop_radius_mm).numpy()
    sure = passed & ~rim
    assert (found.status == wanted.prediction.status.numpy())[sure].mean() > 0.999
    scale = inv.model.domain.pupil_radius_mm
    assert np.abs(found.rays[2] - wanted.rays.pupil_x.numpy())[sure].max() < 2e-4 * scale
    np.testing.assert_allclose(found.density[sure], wanted.density.numpy()[sure], rtol=2e-3)
    scene = torch.stack(list(forward.rays)).numpy()
    back = loaded.from_scene(scene[:3] + 50 * scene[3:], scene[3:], w, plane)
    side = inv.from_scene(forward.rays, rays.film_z, rays.wavelength_nm)
    assert (back.status == side.prediction.status.numpy())[sure].mean() > 0.999
    inverted = (side.rays.film_x, side.rays.film_y, side.rays.pupil_x, side.rays.pupil_y)
    for row, column in zip(back.rays[:4], inverted, strict=True):
        assert np.abs(row - column.numpy())[sure].max() < 2e-4 * scale
    np.testing.assert_allclose(back.density[sure], side.density.numpy()[sure], rtol=5e-3)
    fit = loaded.card["inverse"]["fit"]
    assert min(fit["stop"]["converged"], fit["scene"]["converged"]) >= 0.999


def test_nonsense_gets_a_status(tmp_path: Path) -> None:
    export_inverse(inverse("invariants"), tmp_path / "m.onnx")
    loaded = load_inverse(tmp_path / "m.onnx")
    odd = np.array([0.0, 1e-40, 5.0, 1e6, 1e38, np.inf, -np.inf, np.nan])
    a, b, c = (v.ravel() for v in np.meshgrid(odd, odd, odd))
    points = np.stack([a, b, c])
    wild = (~np.isfinite(points) | (np.abs(points) > 100)).any(0)
    out = loaded.through_stop(np.stack([a, np.zeros_like(a)]), np.stack([b, c]), 550.0)
    assert (out.status != st.PASSED)[wild].all()
    back = loaded.from_scene(points, np.stack([c, a, b]), 550.0)
    assert (back.status != st.PASSED)[~np.isfinite(points).all(0)].all()
    for bad in (np.zeros(3), [["a"], ["b"]]):
        with pytest.raises(InputError, match="film_xy_mm"):
            loaded.through_stop(bad, np.zeros((2, 3)), 550.0)


def test_files_that_are_no_inverse_maps_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="no such files"):
        load_inverse(tmp_path / "m.onnx")
    shutil.copy(lens_models.exported("invariants"), tmp_path / "m.stop.onnx")
    with pytest.raises(ModelError, match="inverse"):
        load_inverse(tmp_path / "m.onnx")
    export_inverse(inverse("invariants"), tmp_path / "m.onnx")
    with pytest.raises(ModelError, match="another lens"):
        load_inverse(tmp_path / "m.onnx", lens="0" * 64)
    scene = shutil.copy(tmp_path / "m.scene.onnx", tmp_path / "whole.onnx")
    edited(scene, tmp_path / "m.scene.onnx", lambda card: card["inverse"].update(map="stop"))
    with pytest.raises(ModelError, match="card: inverse"):
        load_inverse(tmp_path / "m.onnx")
    for change in (
        lambda d: d.pop("guess"),
        lambda d: d["guess"]["ab"].update(shape=[1, 1]),
        lambda d: d["guess"].pop("ab"),
    ):
        edited(scene, tmp_path / "m.scene.onnx", change, MODEL_KEY)
        with pytest.raises(ModelError, match="first guess"):
            load_inverse(tmp_path / "m.onnx")
    shutil.copy(scene, tmp_path / "m.scene.onnx")
    (tmp_path / "m.stop.onnx").unlink()
    with pytest.raises(InputError, match="map"):
        load_inverse(tmp_path / "m.onnx").through_stop(np.zeros((2, 1)), np.zeros((2, 1)), 550.0)
    with pytest.raises(ModelError):
        load_model(tmp_path / "m.scene.onnx")
