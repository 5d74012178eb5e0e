"""Cameras by name and with options: white surroundings, blades and masks, zoom; the same rays through all."""

from functools import cache
from pathlib import Path

import lens_models
import numpy as np
import pytest
from camera_helpers import GAUSS, ROOT
from shipped import whole

from neurolens.base.errors import InputError
from neurolens.cameras.build import make_camera
from neurolens.cameras.contract import Camera
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.ideal import ThinLens
from neurolens.cameras.model import OnnxCamera, load_model
from neurolens.cli import main
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.shot import Shot
from neurolens.pictures.render.pictures import read_exr

SCENE = ROOT / "experiments" / "scenes" / "white.toml"


def white(tmp_path: Path, camera_name: str, *options: str) -> np.ndarray:
    out = tmp_path / "a.exr"
    small = ("--width", "12", "--samples", "64", "--threads", "1", "--quiet", "--json", "-o", str(out))
    assert main(["render", str(SCENE), "--camera", camera_name, *small, *options]) == 0
    picture: np.ndarray = read_exr(out)[0]
    return picture


@pytest.mark.parametrize("name", ["thin", f"thick:{GAUSS}"])
def test_a_white_card_without_vignetting_is_white(name: str, tmp_path: Path) -> None:
    flat, card = (white(tmp_path, name, "--efl", "35", "--vignetting", left) for left in ("none", "natural"))
    assert flat.mean() == pytest.approx(1, abs=0.02) and np.ptp(flat.mean(2)) < 0.25  # noise of the spectrum
    assert card[0, 0].mean() < card[4, 6].mean() - 0.04


FILM = (36.0, 24.0)
STAR = Aperture(mask=np.array([[0, 0, 1, 0, 0], [0, 0, 1, 0, 0], [1, 1, 1, 1, 1], [0, 1, 1, 1, 0], [0, 1, 0, 1, 0]]))
SHAPES = {"five": Aperture(5, 15.0), "curved": Aperture(7, 0.0, 0.5), "star": STAR}


@cache
def shaped(kind: str, name: str | None) -> Camera:
    """A camera at f/5.6 with one of `SHAPES` or none; kept, for the exact lens seeks its outline for seconds."""
    shape = None if name is None else SHAPES[name]
    if kind == "exact":
        lens, bounds = lens_models.lens().with_aperture(shape), lens_models.domain().bounds
        return ExactCamera(lens, Shot(FILM, 2.0, 5.6), bounds=bounds)
    if kind == "thin":
        return ThinLens(50.0, 5.6, 2.0, FILM, aperture=shape)
    model = load_model(lens_models.exported(kind))
    return OnnxCamera(model, Shot(FILM, 2.0, 5.6, aperture=shape))


def sample(camera: Camera, point: tuple[float, float], count: int = 40_000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(4)
    film = np.repeat(np.array([point], np.float32).T, count, axis=1)
    out = camera.sample(film, rng.random((2, count), np.float32), rng.uniform(400, 700, count).astype(np.float32))
    return out.status, out.weight


@pytest.mark.parametrize("name", ["five", *whole("curved", "star")])
@pytest.mark.parametrize("point", [(0.0, 0.0), (8.0, -5.0)])
def test_exact_lens_and_model_pass_the_same_share(name: str, point: tuple[float, float]) -> None:
    shape, shares = SHAPES[name], {}
    for kind in ("exact", "invariants"):
        (before, _), (after, _) = (sample(shaped(kind, s), point) for s in (None, name))
        assert not ((after == 0) & (before != 0)).any()
        shares[kind] = (after == 0).sum() / (before == 0).sum()
        stopped = set(after[(before == 0) & (after != 0)].tolist())
        assert stopped == {4 * (lens_models.lens().stop_index + 1) + 2}
    assert shares["invariants"] == pytest.approx(shares["exact"], abs=0.004)
    exact, model = (sample(shaped(kind, name), point)[0] == 0 for kind in ("exact", "invariants"))
    assert np.mean(exact != model) < 0.01
    assert shares["exact"] == pytest.approx(shape.area_share, abs=0.02)


@pytest.mark.parametrize("kind", ["exact", "invariants", "thin"])
def test_a_shape_keeps_the_exposure_on_the_axis(kind: str) -> None:
    _, weight = sample(shaped(kind, "five"), (0.0, 0.0))
    assert weight.mean() == pytest.approx(1, abs=0.02)


def test_a_shot_shapes_every_camera_but_a_point() -> None:
    shot = Shot(FILM, 2.0, f_number=5.6, aperture=Aperture(6))
    for spec in (lens_models.LENSES / "laikin_double_gauss_50.toml", lens_models.exported("invariants"), "thin"):
        assert make_camera(spec, shot).settings["aperture"]["blades"] == 6
    with pytest.raises(InputError, match="aperture"):
        make_camera("pinhole", shot)
