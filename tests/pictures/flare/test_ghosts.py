"""Ghosts as compiled code against the exact path by path, closed forms, and what light may not do."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from film_light import film_light

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.exact import ExactCamera
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.designs import coated
from neurolens.optics.lens.figures import Biconic, Qcon, Toroid
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.rays import Rays, follow, trace, turning
from neurolens.pictures.flare.canvas import Raster
from neurolens.pictures.flare.ghosts import GhostTracer, Pair, ghost_layout, ghost_pairs
from neurolens.pictures.flare.job import FlareJob, axis_irradiance
from neurolens.pictures.flare.layers import photon_picture
from neurolens.pictures.flare.lights import Light, light_rays
from neurolens.pictures.flare.photons import PhotonTracer
from neurolens.pictures.render.settings import FlareSettings
from tests.ghost_pictures import ghost_picture

LENSES = Path(__file__).parents[3] / "lenses"


def lens_of(name: str, **state: float) -> Lens:
    """A lens of the library, focused at infinity; for other tests of flare, too."""
    return set_lens(read_lens(LENSES / f"{name}.toml"), focus_m=math.inf, **state)


def double_gauss() -> Lens:
    return lens_of("laikin_double_gauss_50")


def plate(wide: float = 20.0) -> Lens:
    """Glass 4 mm thick, a stop, the film."""
    rows = Surface(math.inf, 4.0, wide, 1.5), Surface(math.inf, 6.0, wide), Surface(math.inf, 10.0, wide, stop=True)
    return Lens("plate", "", rows, 2.0, film_z_mm=20.0)


def exact(lens: Lens, rays: np.ndarray, pair: Pair, wavelength_nm: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Film points [2, N], power [N] and whether they arrive [N], in float64."""
    steps = turning(len(lens.surfaces), pair.reflections)
    found = follow(lens, Rays(*torch.from_numpy(rays.copy())), steps, wavelength_nm)
    assert lens.film_z_mm is not None
    way = (lens.film_z_mm - found.rays.z) / found.rays.dz
    place = torch.stack([found.rays.x + way * found.rays.dx, found.rays.y + way * found.rays.dy])
    return place.numpy(), found.power.numpy(), (found.status == st.PASSED).numpy()


def forbes() -> Lens:
    """A triplet with a short Qcon at its front and one of 20 terms at its back."""
    lens = lens_of("cooke_triplet_50")
    first, *middle, last = lens.surfaces
    short = Qcon(qcon=(-0.02, 3e-3), norm_mm=first.semi_diameter_mm)
    long = Qcon(qcon=(3e-5,) * 20, norm_mm=last.semi_diameter_mm)
    return replace(lens, surfaces=(replace(first, figure=short), *middle, replace(last, figure=long)))


def toric() -> Lens:
    """A triplet with an aspheric toroid at its front and a biconic at its back."""
    lens = lens_of("cooke_triplet_50")
    first, *middle, last = lens.surfaces
    toroid = Toroid(cylinder="x", asphere=((4, -1e-6),), across_mm=first.radius_mm * 1.2)
    biconic = Biconic(cylinder="y", conic=0.3, across_mm=last.radius_mm * 0.9, across_conic=-0.6)
    return replace(lens, surfaces=(replace(first, figure=toroid), *middle, replace(last, figure=biconic)))


# The letter F.
LETTER = np.zeros((50, 50), bool)
LETTER[5:45, 10:20] = LETTER[5:15, 10:40] = LETTER[22:30, 10:32] = True

CASES = {
    "blades": lambda: replace(set_lens(double_gauss(), f_number=5.6), aperture=Aperture(blades=6)),
    "mask": lambda: replace(set_lens(double_gauss(), f_number=4.0), aperture=Aperture(mask=LETTER, rotation_deg=30.0)),
    "coated": lambda: coated(double_gauss(), "broadband"),
    "aspheres": lambda: lens_of("phone_lens_6"),
    "aspheres that cancel": lambda: lens_of("fujifilm_fujinon_xf_35mm_f1_4_r"),
    "Forbes": forbes,
    "cylinders": lambda: lens_of("schneider_anamorphic_31"),
    "toroids": toric,
    "absorbing": lambda: replace(
        double_gauss(),
        surfaces=tuple(replace(s, absorption_per_mm=0.02 * (s.n_d > 1)) for s in double_gauss().surfaces),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_compiled_ghosts_are_the_exact_ones(case: str) -> None:
    lens = CASES[case]()
    pairs = ghost_pairs(lens)
    tracer = GhostTracer(lens, pairs[:: max(1, len(pairs) // 9)])
    rays, _ = light_rays(lens, Light(7.0, -4.0), 0, 3000)
    found = tracer.trace(rays, 480.0)
    arrived = 0
    for number, pair in enumerate(tracer.pairs):
        place, power, passed = exact(lens, rays, pair, 480.0)
        mine = found.worst[number] <= 1
        edge = np.abs(found.worst[number] - 1) < 1e-4
        assert np.all((mine == passed) | edge)
        both = mine & passed
        arrived += int(both.sum())
        # Within a pixel of 5 um; far outside the picture the error grows as the distance does.
        near = both & (np.hypot(*place) < 100)
        off = np.hypot(*(found.film_xy_mm[number][:, near] - place[:, near]))
        assert off.max(initial=0.0) < 5e-3 and (not near.any() or np.median(off) < 5e-4)
        assert found.power[number][both] == pytest.approx(power[both], rel=1e-3, abs=2e-4**2)
        assert np.all(found.power[number][~mine] == 0)
    assert arrived > 300


def test_a_plate_by_hand() -> None:
    lens = plate()
    tracer = GhostTracer(lens)
    assert tracer.pairs == (Pair(0, 1),)
    angle = math.radians(10)
    ray = np.array([[0.0, 0, -1, math.sin(angle), 0, math.cos(angle)]]).T
    found = tracer.trace(ray, 550.0, direct=True)
    inside = math.tan(math.asin(math.sin(angle) / 1.5))
    outside = math.tan(angle)
    assert found.film_xy_mm[0, 0, 0] == pytest.approx(17 * outside + 12 * inside, abs=1e-5)
    assert found.film_xy_mm[1, 0, 0] == pytest.approx(17 * outside + 4 * inside, abs=1e-5)
    cos_t = math.cos(math.asin(math.sin(angle) / 1.5))
    r_s = ((math.cos(angle) - 1.5 * cos_t) / (math.cos(angle) + 1.5 * cos_t)) ** 2
    r_p = ((1.5 * math.cos(angle) - cos_t) / (1.5 * math.cos(angle) + cos_t)) ** 2
    r = (r_s + r_p) / 2
    assert found.power[0, 0] == pytest.approx(r * r * (1 - r) ** 2, rel=1e-6)
    assert found.power[1, 0] == pytest.approx((1 - r) ** 2, rel=1e-6)


def test_masks_are_those_of_their_lens() -> None:
    """Of two lenses with masks of one size, compiled alike, each keeps its own, whichever is traced."""
    masks = LETTER, LETTER[::-1, ::-1]
    lenses = [replace(set_lens(double_gauss(), f_number=4.0), aperture=Aperture(mask=mask)) for mask in masks]
    tracers = [GhostTracer(lens, [Pair(11, 12)]) for lens in lenses]
    rays, _ = light_rays(lenses[0], Light(3.0, 2.0), 0, 20_000)
    for lens, tracer in zip(lenses, tracers, strict=True):
        found = tracer.trace(rays, 550.0, direct=True).power > 0
        plain = trace(lens, Rays(*torch.from_numpy(rays.copy())), 550.0, towards="film")
        assert 200 < found[1].sum() and np.mean(found[1] != (plain.status == 0).numpy()) < 1e-3
    through = PhotonTracer(lenses[0]).trace(rays, 550.0, most_reflections=0, seed=1).reflections.size
    assert 0.3 * found[1].sum() < through < found[1].sum()  # twelve bare surfaces


def test_the_exposure_is_the_integral_of_the_pupil() -> None:
    lens = double_gauss()
    assert axis_irradiance(lens, 550.0) == pytest.approx(
        film_light(lens, [0.0], wavelength_nm=550.0).irradiance[0], rel=3e-3
    )


def test_flare_and_a_render_have_one_unit() -> None:
    """Old coatings and glass pass little violet light: a camera's exposure is the mean over the wavelengths."""
    lens = read_lens(LENSES / "takahashi_retrofocus_100.toml")
    camera = ExactCamera(lens, Shot((12.0, 8.0), f_number=8.0, aperture=Aperture(5), runtime="onnxruntime"))
    job = FlareJob(camera.lens, [], Raster((12.0, 8.0), 24, 16))
    assert job.exposure == pytest.approx(camera.film.exposure, rel=2e-3)
    assert job.exposure < 0.95 * axis_irradiance(camera.lens, 550.0)


def test_a_picture_holds_the_light_that_falls_on_it() -> None:
    """A film that holds every ghost of a plate: the picture's sum is the rays' power, in every layer."""
    lens = plate()
    tracer, raster, light = GhostTracer(lens), Raster((60.0, 40.0), 120, 80), Light(5.0, 0.0, (2.0, 2.0, 2.0))
    job = FlareJob(lens, [light], raster, FlareSettings(bins=3), ghosts=tracer, finer=1)
    picture = ghost_picture(job, [1])
    assert picture.shape == (2, 80, 120, 3) and not picture[0].any()
    rays, area = light_rays(lens, light, 0, 4096)
    flux = 2 * area * tracer.trace(rays, 550.0).power[0].mean()
    pixel = (60.0 / 120) ** 2
    expected = flux / pixel / job.exposure
    np.testing.assert_allclose(picture[1].sum((0, 1)), expected, rtol=2e-3)
    # The light stands to the right: so do its image and, in a plate, its ghost.
    places = picture[1].sum((0, 2)) @ (np.arange(120) + 0.5) / picture[1].sum()
    found = tracer.trace(rays, 550.0)
    assert places == pytest.approx(60 - 2 * np.average(found.film_xy_mm[0, 0], weights=found.power[0]), abs=0.1)
    assert places > 61


@pytest.mark.parametrize("name", ["panavision_anamorphic_zoom_21", "shimizu_fisheye_220"])
def test_extremes_stay_finite(name: str) -> None:
    """57 surfaces, 220 degrees; light on the axis, at 89 degrees, in the near field; no rays at all."""
    lens = lens_of(name)
    pairs = ghost_pairs(lens)
    tracer = GhostTracer(lens, pairs[:: max(1, len(pairs) // 9)])
    for light in (Light(0.0, 0.0), Light(89.0, 0.0), Light(10.0, 70.0, distance_m=0.2)):
        for nm in (380.0, 780.0):
            rays, _ = light_rays(lens, light, 0, 400)
            found = tracer.trace(rays, nm, direct=True)
            lit = found.worst <= 1
            assert np.isfinite(found.power).all() and np.all((found.power >= 0) & (found.power <= 1))
            assert np.isfinite(np.moveaxis(found.film_xy_mm, 1, 2)[lit]).all()
    assert tracer.trace(np.zeros((6, 0)), 550.0).power.shape == (len(tracer.pairs), 0)
    broken = np.full((6, 3), np.nan)
    assert np.all(tracer.trace(broken, 550.0).power == 0)


BAD = [
    (lambda: Light(180.0, 0.0), "within 90 degrees"),
    (lambda: Light(math.nan, 0.0), "within 90 degrees"),
    (lambda: Light(0.0, 0.0, distance_m=0.0), "positive distance"),
    (lambda: Light(0.0, 0.0, (1.0, -1.0, 0.0)), "from 0 to"),
    (lambda: light_rays(plate(), Light(0.0, 0.0, distance_m=0.005), 0, 9), "outside the lens"),
    (lambda: GhostTracer(plate(), [Pair(1, 2)]), "surfaces that reflect"),
    (lambda: GhostTracer(replace(plate(), film_z_mm=None)), "focused"),
    (lambda: GhostTracer(plate()).trace(np.zeros((3, 4)), 550.0), r"\[6, N\]"),
]


@pytest.mark.parametrize(("call", "word"), BAD)
def test_refusals(call: object, word: str) -> None:
    with pytest.raises(InputError, match=word):
        call()  # type: ignore[operator]


@pytest.mark.parametrize(("distance_m", "depth"), [(math.inf, 0.0), (3.0, 0.0), (0.08, 0.0), (0.08, 4.0)])
def test_lights_send_what_the_front_receives(distance_m: float, depth: float) -> None:
    """Light through the front rim's disc, so far behind the vertex: that of a point source, by quadrature over the
    disc, which makes the irradiance given at the vertex."""
    lens = plate()
    dome = replace(lens.surfaces[0], radius_mm=(100 + depth**2) / (2 * depth) if depth else math.inf)
    lens = replace(lens, surfaces=(dome, *lens.surfaces[1:]))
    light = Light(20.0, 10.0, distance_m=distance_m)
    rays, area = light_rays(lens, light, 0, 200_000)
    way = (depth - rays[2]) / rays[5]
    at = rays[:2] + way * rays[3:5]
    inside = np.hypot(*at) <= 10.0
    cos = -light.towards[2]
    expected = math.pi * 100 * cos
    if math.isfinite(distance_m):
        r, angle = np.meshgrid(10 * np.sqrt((np.arange(400) + 0.5) / 400), np.arange(64) * math.pi / 32)
        disc = np.stack([r * np.cos(angle), r * np.sin(angle), 0 * r + depth], -1)
        to = 1000 * distance_m * light.towards - disc
        far = np.linalg.norm(to, axis=-1)
        expected = math.pi * 100 * np.mean(-to[..., 2] / far**3) * (1000 * distance_m) ** 2
    assert area * inside.mean() == pytest.approx(expected, rel=4e-3)


def test_photons_are_the_ghosts_and_none_is_lost() -> None:
    lens, light, count = double_gauss(), Light(15.0, 8.0), 1 << 17
    lens = replace(lens, surfaces=tuple(replace(s, absorbs_as=None) for s in lens.surfaces))  # clear glass
    rays, _ = light_rays(lens, light, 0, count)
    exact = GhostTracer(lens).trace(rays[:, : 1 << 15], 550.0, direct=True)
    direct, twice = float(exact.power[-1].mean()), float(exact.power[:-1].sum(0).mean())
    tracer = PhotonTracer(lens)
    for most in (0, 2, 10):
        found = tracer.trace(rays, 550.0, most_reflections=most, seed=most)
        times = np.bincount(found.reflections, minlength=4)
        assert found.cast == count == times.sum() + found.left + found.stopped + found.absorbed + found.cut
        assert not times[1::2].any() and found.absorbed == 0  # an even number leads to the film
        for share, expected in ((times[0], direct), (times[2], twice if most else 0.0)):
            assert share / count == pytest.approx(expected, abs=4 * math.sqrt(expected / count) + 2e-4 * expected)
    again = tracer.trace(rays, 550.0, most_reflections=10, seed=10)
    assert np.array_equal(again.film_xy_mm, found.film_xy_mm)
    # Where they arrive, too.
    mean = found.film_xy_mm[:, found.reflections == 0].mean(1)
    place = exact.film_xy_mm[-1] @ exact.power[-1] / exact.power[-1].sum()
    assert mean == pytest.approx(place, abs=0.01)


def test_few_wavelengths_and_few_photons_have_the_light_of_coated_ghosts() -> None:
    """The reflectance of coatings oscillates with the wavelength, and no photon of 10^4 would be reflected twice.

    Colours of three wavelengths are within 2% of those of 30 on the same grids; by single wavelengths red was negative.
    Photons have the light of the grids within their noise, 3%.
    """
    lens, light = lens_of("cooke_triplet_50"), Light(10.0, 8.0)
    assert all(s.coating is not None for s in lens.surfaces if s.n_d > 1)
    raster, tracer = Raster((36.0, 24.0), 24, 16), GhostTracer(lens)
    few, many = (
        ghost_picture(FlareJob(lens, [light], raster, FlareSettings(bins=n), ghosts=tracer)).sum((0, 1, 2))
        for n in (3, 30)
    )
    assert few == pytest.approx(many, rel=0.02)
    job = FlareJob(lens, [light], raster, FlareSettings(bins=3, kernel_px=0))
    assert photon_picture(job, "ghosts", 40_000)[..., 1].sum() == pytest.approx(float(many[1]), rel=0.12)


def test_photons_are_absorbed_as_beer_says() -> None:
    lens = plate()
    grey = replace(lens, surfaces=(replace(lens.surfaces[0], absorption_per_mm=0.2), *lens.surfaces[1:]))
    rays, _ = light_rays(grey, Light(0.0, 0.0), 0, 1 << 16)
    inside = np.hypot(*rays[:2]) < 9.9
    found = PhotonTracer(grey).trace(rays[:, inside], 550.0, most_reflections=0)
    through = 0.96**2 * math.exp(-0.8)
    assert found.reflections.size / found.cast == pytest.approx(through, abs=4 * math.sqrt(through / found.cast))
    nothing = PhotonTracer(grey).trace(np.zeros((6, 0)), 550.0)
    assert nothing.cast == 0 and nothing.film_xy_mm.shape == (2, 0)
    with pytest.raises(InputError, match="most_reflections"):
        PhotonTracer(grey).trace(rays, 550.0, most_reflections=-1)


def test_the_picture_of_a_path_goes_from_the_light_to_the_film() -> None:
    """A ray of a plate's ghost, drawn: forward, back, forward; ends on the film as the closed form says."""
    lens = plate()
    layout = ghost_layout(lens, Pair(0, 1), Light(10.0, 0.0))
    inside, outside = math.tan(math.asin(math.sin(math.radians(10)) / 1.5)), math.tan(math.radians(10))
    for line in layout.rays:
        z, y = line.points.T
        assert z[1:] == pytest.approx([0, 4, 0, 4, 10, 20])
        assert y[1] - y[-1] == pytest.approx(16 * outside + 12 * inside)
    assert len(layout.rays) == 9
    with pytest.raises(InputError, match="arrives"):
        ghost_layout(lens, Pair(0, 1), Light(80.0, 0.0))
