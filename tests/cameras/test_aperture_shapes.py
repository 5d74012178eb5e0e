"""Blades and masks in cameras: the exact lens, its models and the thin lens let the same rays pass."""

from __future__ import annotations

from functools import cache

import lens_models
import numpy as np
import pytest

from neurolens.base.errors import InputError
from neurolens.cameras.build import Shot, make_camera
from neurolens.cameras.contract import Camera
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.ideal import ThinLens
from neurolens.cameras.model import OnnxCamera, load_model
from neurolens.optics.apertures import Aperture

FILM = (36.0, 24.0)
STAR = Aperture(mask=np.array([[0, 0, 1, 0, 0], [0, 0, 1, 0, 0], [1, 1, 1, 1, 1], [0, 1, 1, 1, 0], [0, 1, 0, 1, 0]]))
SHAPES = {"five": Aperture(5, 15.0), "curved": Aperture(7, 0.0, 0.5), "star": STAR}


@cache
def camera(kind: str, name: str | None) -> Camera:
    """A camera at f/5.6 with one of `SHAPES` or none; kept, for the exact lens seeks its outline for seconds."""
    shape = None if name is None else SHAPES[name]
    if kind == "exact":
        lens, bounds = lens_models.lens().with_aperture(shape), lens_models.domain().bounds
        return ExactCamera(lens, film_mm=FILM, focus_m=2.0, f_number=5.6, bounds=bounds)
    if kind == "thin":
        return ThinLens(50.0, 5.6, 2.0, FILM, aperture=shape)
    model = load_model(lens_models.exported(kind))
    return OnnxCamera(model, film_mm=FILM, focus_m=2.0, f_number=5.6, aperture=shape)


def sample(camera: Camera, point: tuple[float, float], count: int = 40_000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(4)
    film = np.repeat(np.array([point], np.float32).T, count, axis=1)
    out = camera.sample(film, rng.random((2, count), np.float32), rng.uniform(400, 700, count).astype(np.float32))
    return out.status, out.weight


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("point", [(0.0, 0.0), (8.0, -5.0)])
def test_exact_lens_and_model_pass_the_same_share(name: str, point: tuple[float, float]) -> None:
    shape, shares = SHAPES[name], {}
    for kind in ("exact", "invariants"):
        (before, _), (after, _) = (sample(camera(kind, s), point) for s in (None, name))
        assert not ((after == 0) & (before != 0)).any()
        shares[kind] = (after == 0).sum() / (before == 0).sum()
        stopped = set(after[(before == 0) & (after != 0)].tolist())
        assert stopped == {4 * (lens_models.lens().stop_index + 1) + 2}
    assert shares["invariants"] == pytest.approx(shares["exact"], abs=0.004)
    assert shares["exact"] == pytest.approx(shape.area_share, abs=0.02)


@pytest.mark.parametrize("name", SHAPES)
def test_exact_lens_and_model_stop_the_same_rays(name: str) -> None:
    exact, model = (sample(camera(kind, name), (5.0, 3.0))[0] == 0 for kind in ("exact", "invariants"))
    assert np.mean(exact != model) < 0.01


@pytest.mark.parametrize("kind", ["exact", "invariants", "thin"])
def test_a_shape_keeps_the_exposure_on_the_axis(kind: str) -> None:
    _, weight = sample(camera(kind, "five"), (0.0, 0.0))
    assert weight.mean() == pytest.approx(1, abs=0.02)


def test_the_thin_lens_s_share_is_that_of_the_shape() -> None:
    for name, shape in SHAPES.items():
        status, _ = sample(camera("thin", name), (3.0, 4.0))
        assert (status == 0).mean() == pytest.approx(shape.area_share, abs=0.01)


def test_models_keep_their_shape_in_a_worker_and_say_so() -> None:
    first = camera("invariants", "five")
    other = first.for_worker()  # type: ignore[attr-defined]
    assert (sample(first, (5.0, 3.0))[0] == sample(other, (5.0, 3.0))[0]).all()
    assert first.settings["aperture"] == {"blades": 5, "rotation_deg": 15.0, "curvature": 0.0}
    assert camera("invariants", None).settings["aperture"] is None


def test_a_shot_shapes_every_camera_but_a_point() -> None:
    shot = Shot(FILM, 2.0, f_number=5.6, aperture=Aperture(6))
    for spec in (lens_models.LENSES / "laikin_double_gauss_50.toml", lens_models.exported("invariants"), "thin"):
        assert make_camera(spec, shot).settings["aperture"]["blades"] == 6
    with pytest.raises(InputError, match="aperture"):
        make_camera("pinhole", shot)


def test_a_shot_zooms_and_focuses_inside() -> None:
    zoom = lens_models.LENSES / "nikon_zoom_70_200.toml"
    near = make_camera(zoom, Shot(FILM, 3.0, zoom=100.0, focus="internal"))
    far = make_camera(zoom, Shot(FILM, 3.0, zoom=100.0))
    assert near.settings["film_z_mm"] < far.settings["film_z_mm"]
    assert near.settings["efl_mm"] < far.settings["efl_mm"] == pytest.approx(100, rel=1e-9)
    for field, shot in (("zoom", Shot(FILM, 2.0, zoom="x")), ("focus", Shot(FILM, 2.0, focus="internal"))):
        for spec in ("thin", "pinhole", lens_models.exported("invariants")):
            with pytest.raises(InputError, match=field):
                make_camera(spec, shot)
