"""White surroundings through every camera, at extremes too, and with vignetting switched off."""

import math
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import lens_models
import numpy as np
import pytest
from camera_helpers import FILM, FISHEYES, KINDS, RADII, camera, film_rays, film_value, jittered, light, tabled
from shipped import disc_irradiance

from neurolens.base import status as st
from neurolens.cameras.build import make_camera
from neurolens.cameras.contract import CameraRays
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.ideal import PROJECTIONS, Pinhole, ThickLens, ThinLens
from neurolens.cameras.onnxlens import load_model
from neurolens.cameras.reduced import Vignetted
from neurolens.cameras.sampling import stratified
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens

MODELS = Path(__file__).parents[2] / "models"


def expected(kind: str) -> np.ndarray:
    """Film values at `RADII`, none of them by the camera's own code."""
    if kind in FISHEYES:
        if kind == "fisheye-orthographic":
            return (RADII < 14.0).astype(float)
        theta = PROJECTIONS[kind.removeprefix("fisheye-")].angle(RADII / 14.0)
        return (np.sinc(theta / math.pi), 1 + 0 * theta, np.cos(theta / 2) ** 4)[FISHEYES.index(kind)]
    if kind == "pinhole":
        return (1 + (RADII / 50.0) ** 2) ** -2.0
    if kind in ("thin", "thick"):
        lens = set_lens(lens_models.lens(), focus_m=2.0, f_number=4.0)
        data = first_order(lens)
        assert lens.film_z_mm is not None
        image = camera("thin").image_distance_mm
        disc = (
            (6.25, image)
            if kind == "thin"
            else (data.exit_pupil_diameter_mm / 2, lens.film_z_mm - data.exit_pupil_z_mm)
        )
        irradiance = disc_irradiance(*disc, RADII)
        return irradiance / irradiance[0]
    return light().relative


@pytest.mark.parametrize("kind", KINDS)
def test_film_values_of_white_surroundings(kind: str) -> None:
    found = np.array([film_value(camera(kind), (0.8 * r, -0.6 * r), wavelength_nm=550.0) for r in RADII])
    assert film_value(camera(kind), (0.0, 0.0)) == pytest.approx(1, abs=1e-3)
    assert found / found[0] == pytest.approx(expected(kind), abs=1.2e-3)


def test_white_is_1_on_the_axis_of_a_coated_lens_whose_glasses_have_no_known_dispersion() -> None:
    """Its coatings colour the light, all of which the exposure counts."""
    lens = read_lens(MODELS.parent / "lenses" / "tronnier_double_gauss_100.toml")
    made = ExactCamera(lens, Shot((6.0, 4.0), f_number=4.0, coating="v-coat", runtime="onnxruntime"))
    square, nm = stratified(64, (400.0, 700.0))
    assert made.sample(np.zeros_like(square), square, nm).weight.mean() == pytest.approx(1.0, abs=3e-3)


def test_models_of_anamorphic_lenses_are_lit_at_every_azimuth() -> None:
    """As by a lattice over the whole pupil: near the end of the light each azimuth has another pupil."""
    name = "cooke_anamorphic_42.ols-64.onnx"
    found = make_camera(str(MODELS / name), Shot((26.0, 20.0), 4.0, wavelength_nm=(550.0, 550.0), clamp_f_number=True))
    model = load_model(MODELS / name)
    film_z, domain = float(found.settings["film_z_mm"]), model.card["domain"]
    across = domain["pupil_radius_mm"] * ((np.arange(160) + 0.5) / 80 - 1)
    pupil = np.stack(np.meshgrid(across, across)).reshape(2, -1)
    lattice, value = [], []
    for point in ((0.0, 0.0), (9.0, 9.8), (12.8, 1.0), (-1.0, 12.8)):
        value.append(film_value(found, point, wavelength_nm=550.0))
        film = np.repeat(np.array(point)[:, None], pupil.shape[1], axis=1)
        rays = model.rays(film, pupil, 550.0, film_z, float(found.settings["stop_radius_mm"]))
        cos2 = 1 / (1 + ((film - pupil) ** 2).sum(0) / (film_z - domain["pupil_z_mm"]) ** 2)
        lattice.append((np.where(rays.status == st.PASSED, rays.transmittance, 0) * cos2**2).sum())
    assert np.divide(value, value[0]) == pytest.approx(np.divide(lattice, lattice[0]), rel=0.01)


@pytest.mark.parametrize("f_number", [0.7, 45.0])
def test_extreme_stops(f_number: float) -> None:
    """The closed form for ideal lenses, and 1 on the axis for the exact lens, whatever then is its stop."""
    wanted = disc_irradiance(50.0 / (2 * f_number), 50.0, RADII)
    for lens in (ThinLens(50.0, f_number, math.inf), ThickLens(50.0, f_number, math.inf)):
        found = [film_value(lens, (r, 0.0)) for r in RADII]
        assert found == pytest.approx(wanted / wanted[0], abs=5e-4)
    lens = ExactCamera(lens_models.lens(), Shot(FILM, 2.0, f_number), bounds=lens_models.domain().bounds)
    assert film_value(lens, (0.0, 0.0)) == pytest.approx(1, abs=4e-3)
    assert 0 < film_value(lens, (17.5, 11.5)) < 1


@pytest.mark.parametrize("kind", KINDS)
def test_the_contract_of_rays(kind: str) -> None:
    """No ray, many rays, film points that are none; over the film to its corners unit directions, and weights that are
    0 where and only where a ray did not pass."""
    lens, nothing, count = camera(kind), np.empty((2, 0), np.float32), 150_000
    for rays in (lens.sample(nothing, nothing, nothing[0]), lens.natural(nothing, nothing, nothing[0])):
        assert getattr(rays, "weight", rays).shape == (0,)
    film = np.tile(np.array([[1.0], [2.0]], np.float32), count)
    rays = lens.sample(film, np.full((2, count), 0.3, np.float32), np.full(count, 550, np.float32))
    assert rays.direction.shape == (3, count) and (rays.status == st.PASSED).all()
    assert np.ptp(rays.weight) <= 1e-5 and np.ptp(rays.direction, axis=1).max() <= 1e-5

    square, wavelength = jittered(64)
    film = (np.random.default_rng(2).random((2, 4096)) - 0.5).astype(np.float32) * np.array([FILM], np.float32).T
    film[:, :4] = np.array([[18, 18, -18, -18], [12, -12, 12, -12]])
    none = [math.nan, math.inf, -math.inf, 1e30, -3e38]
    film[:, 4:14] = [[*none, *none], [*none, *[0.0] * 5]]
    rays = lens.sample(film, square, wavelength)
    assert (rays.weight[4:14] == 0).all() and (rays.status[4:14] == st.OUTSIDE_DOMAIN).all()
    passed = rays.status == st.PASSED
    assert np.linalg.norm(rays.direction, axis=0) == pytest.approx(1, abs=1e-5)
    assert (rays.weight[passed] > 0).all() and (rays.weight[~passed] == 0).all()
    if kind not in FISHEYES:  # left in the scene is right on the film, and all of it lies before the camera
        assert (rays.direction[2, passed] < 0).all() and (rays.origin_m[2, passed] < 0).all()
        far = passed & (np.abs(film).min(0) > 6)
        assert (rays.direction[:, far][:2] * film[:, far] < 0).all() and far.sum() > 500
    for numbers in (rays.origin_m, rays.direction, rays.weight):
        assert np.isfinite(numbers).all() and numbers.dtype == np.float32
    assert rays.status.dtype == np.int32


SWITCHED = ("pinhole", "thin", "thick", "exact", "network", "fisheye-equidistant", "fisheye-orthographic")


def without(kind: str, left: str) -> Vignetted:
    """The camera with that vignetting left; all kinds share one table."""
    made = copy(tabled(kind))
    made.vignetting = left
    return made


def card(kind: str, left: str) -> np.ndarray:
    made = camera(kind) if left == "both" else without(kind, left)
    return np.array([film_value(made, (0.6 * r, 0.8 * r), 96) for r in RADII])


@pytest.mark.parametrize("kind", SWITCHED)
def test_the_four_white_cards(kind: str) -> None:
    both, natural, optical, none = (card(kind, left) for left in ("both", "natural", "optical", "none"))
    lit = both > 0
    assert none == pytest.approx(lit.astype(float), abs=2e-3)
    assert both == pytest.approx(natural * optical, abs=2e-3)
    if kind not in ("exact", "network"):  # nothing clips in an ideal lens
        assert optical == pytest.approx(lit.astype(float), abs=2e-3)


def test_natural_and_optical_are_what_an_integral_over_the_pupil_gives() -> None:
    assert card("exact", "natural") == pytest.approx(light().natural, abs=2e-3)
    # The losses of the glass go with the aperture.
    aperture = light().area_mm2 * light().transmittance
    assert card("exact", "optical") == pytest.approx(aperture / aperture[0], abs=4e-3)


@pytest.mark.parametrize("kind", ["thin", "exact", "fisheye-orthographic"])
def test_rays_stay_where_they_are_and_the_dark_stays_dark(kind: str) -> None:
    rays = film_rays(camera(kind), 3000)
    before, after = camera(kind).sample(*rays), without(kind, "none").sample(*rays)
    assert np.array_equal(before.direction, after.direction) and np.array_equal(before.status, after.status)
    assert np.array_equal(before.weight > 0, after.weight > 0) and np.isfinite(after.weight).all()
    assert np.array_equal(without(kind, "both").sample(*rays).weight, before.weight)
    moved = without(kind, "none").sample_differentials(*rays)
    assert np.array_equal(moved.weight, after.weight) and moved.differentials is not None


class Uneven(Pinhole):
    """A pinhole whose light depends on the azimuth: less on one side, none at a corner."""

    def sample(self, film_mm: Any, pupil: Any, wavelength_nm: Any) -> CameraRays:
        rays = super().sample(film_mm, pupil, wavelength_nm)
        radius = np.hypot(*film_mm) / 22
        share = 1 - 0.5 * radius * (1 + np.cos(np.arctan2(film_mm[1], film_mm[0]) - 0.7))
        return replace(rays, weight=(rays.weight * np.clip(share, 0, 1)).astype(np.float32))

    def natural(self, film_mm: Any, pupil: Any, wavelength_nm: Any) -> Any:
        return super().sample(film_mm, pupil, wavelength_nm).weight


def test_cameras_that_are_not_round() -> None:
    """The table then goes over azimuths, too."""
    lens = Uneven(50.0, FILM)
    none, natural = (Vignetted(lens, left) for left in ("none", "natural"))
    for point in ((0.0, 0.0), (12.0, 8.0), (-12.0, -8.0), (-3.0, 10.0), (14.0, -2.0), (-14.0, 1e-6)):
        cos4 = (1 + (math.hypot(*point) / 50) ** 2) ** -2
        assert film_value(none, point, 4) == pytest.approx(1, abs=5e-3)
        assert film_value(natural, point, 4) == pytest.approx(cos4, abs=5e-3)
