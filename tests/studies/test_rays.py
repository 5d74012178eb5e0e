"""Errors of rays and of vignetting whose size is known in closed form; a real lens agrees with itself."""

import math
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from shipped import whole

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.models.fitted import Domain, FilmRays
from neurolens.models.pairs import PairSet, domain_of, passing_rays, sample_domain, trace_pairs
from neurolens.optics.lens.paraxial import PupilBounds, first_order
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.pupils import camera_rays, image_radius_mm
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.rays import trace
from neurolens.optics.trace.surfaces import Rays
from neurolens.studies.rays import (
    angles_deg,
    focused_vergence,
    frame_width_mm,
    local_jacobian,
    pupil_middle,
    ray_errors,
    relative_illumination,
)

LENSES = Path(__file__).parents[2] / "lenses"


def lens_and_domain(
    name: str, efl_mm: float | None, focus_m: float, film_radius_mm: float | None = None
) -> tuple[Lens, Domain]:
    lens = set_lens(read_lens(LENSES / f"{name}.toml"), focal_length_mm=efl_mm, focus_m=focus_m)
    return lens, domain_of(lens, focus_m=(focus_m, focus_m), film_radius_mm=film_radius_mm)


def held_out(lens: Lens, domain: Domain, count: int = 2000) -> PairSet:
    return passing_rays(lens, domain, count, seed=1)


def says(rays: Rays, transmittance: torch.Tensor) -> SimpleNamespace:
    return SimpleNamespace(rays=rays, transmittance=transmittance)


@pytest.fixture(scope="module")
def gauss() -> tuple[Lens, Domain, PairSet]:
    lens, domain = lens_and_domain("laikin_double_gauss_50", None, 2.0)
    return lens, domain, held_out(lens, domain)


def turned(rays: Rays, angle: float) -> Rays:
    """Directions turned by `angle` radians about y."""
    c, s = math.cos(angle), math.sin(angle)
    return rays._replace(dx=c * rays.dx + s * rays.dz, dz=c * rays.dz - s * rays.dx)


def test_the_exact_lens_has_no_error(gauss: tuple[Lens, Domain, PairSet]) -> None:
    lens, domain, rays = gauss
    errors = ray_errors(lens, domain, rays, lambda _: says(rays.scene, rays.transmittance))
    settings = ("pixel_um", "rays", "share_beyond_60_deg")
    assert all(value == 0 for key, value in asdict(errors).items() if key not in settings)
    assert errors.rays == len(rays)


def test_a_direction_error_at_infinity_is_f_times_the_angle() -> None:
    lens, domain = lens_and_domain("laikin_double_gauss_50", None, math.inf, film_radius_mm=0.01)
    lens = lens.with_stop_radius(1.0)  # paraxial rays only
    domain = domain_of(lens, film_radius_mm=0.01)
    rays, epsilon = held_out(lens, domain), 1e-6
    errors = ray_errors(lens, domain, rays, lambda _: says(turned(rays.scene, epsilon), rays.transmittance))
    expected = 1000 * first_order(lens).efl_mm * epsilon
    for key in ("rms_um", "rms_infinity_um", "p99_um", "max_um"):
        assert getattr(errors, key) == pytest.approx(expected, rel=5e-3)  # the d line's f, over 400-700 nm
    assert errors.direction_max_deg == pytest.approx(math.degrees(epsilon), rel=1e-6)


def test_a_shift_at_a_finite_plane_is_magnification_times_the_shift() -> None:
    lens, _ = lens_and_domain("laikin_double_gauss_50", None, 1.0)
    lens = lens.with_stop_radius(1.0)
    assert lens.film_z_mm is not None
    film_z_mm = (lens.film_z_mm, lens.film_z_mm)
    domain = domain_of(lens, focus_m=(1.0, 1.0), film_radius_mm=0.01, film_z_mm=film_z_mm)
    rays, shift = held_out(lens, domain), 1e-3
    moved = rays.scene._replace(x=rays.scene.x + shift)
    errors = ray_errors(lens, domain, rays, lambda _: says(moved, rays.transmittance))
    data = first_order(lens)
    extension = lens.film_z_mm - data.rear_focal_z_mm
    magnification = extension / data.efl_mm  # Newton
    assert errors.rms_um == pytest.approx(1000 * magnification * shift, rel=5e-3)
    assert errors.rms_infinity_um == 0
    assert errors.position_rms_um == pytest.approx(1000 * shift, rel=1e-3)  # directions are not quite along the axis


@pytest.mark.parametrize(
    "name, efl_mm, focus_m", [("laikin_double_gauss_50", None, 0.7), ("muller_fisheye_100", 14.0, 1.0)]
)
@pytest.mark.parametrize("radial, tangential", [(6e-4, -8e-4), *whole((1e-3, 0.0), (0.0, 1e-3))])
def test_a_ray_from_one_micrometre_beside_is_an_error_of_one_micrometre(
    name: str, efl_mm: float | None, focus_m: float, radial: float, tangential: float
) -> None:
    """The definition itself, at every film radius and azimuth, for rays through the middle of the pupil."""
    lens, domain = lens_and_domain(name, efl_mm, focus_m)
    radius = torch.linspace(0.02, 0.9, 23, dtype=torch.float64) * domain.film_radius_mm
    azimuth = torch.linspace(0, 6, 23, dtype=torch.float64)
    cos, sin, middle = torch.cos(azimuth), torch.sin(azimuth), pupil_middle(domain, radius)
    film_z = torch.full_like(radius, domain.film_z_mm[0])
    place = (film_z, cos * middle, sin * middle, torch.full_like(radius, 550.0))
    rays = trace_pairs(lens, FilmRays(radius * cos, radius * sin, *place), domain.pupil_z_mm)
    rays = rays.select((rays.status == 0) & (rays.scene.dz < -0.6))
    inputs = rays.inputs
    cos, sin = (c / torch.hypot(inputs.film_x, inputs.film_y) for c in (inputs.film_x, inputs.film_y))
    film_x, film_y = (inputs.film_x + cos * radial - sin * tangential, inputs.film_y + sin * radial + cos * tangential)
    beside = replace(inputs, film_x=film_x, film_y=film_y)
    moved = trace_pairs(lens, beside, domain.pupil_z_mm)
    errors = ray_errors(lens, domain, rays, lambda _: says(moved.scene, moved.transmittance))
    assert len(rays) > 10
    for key in ("rms_um", "max_um", "rms_infinity_um", "max_infinity_um"):
        assert getattr(errors, key) == pytest.approx(1.0, rel=1e-3)


def test_angles_have_no_floor_and_no_ceiling() -> None:
    zero, one = torch.zeros(1, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    ahead = Rays(zero, zero, zero, zero, zero, -one)
    for angle in (0.0, 1e-9, 1e-4, 45.0, 120.0, 180.0):
        assert float(angles_deg(ahead, turned(ahead, math.radians(angle)))) == pytest.approx(angle, rel=1e-9, abs=1e-14)


def test_the_point_on_the_ray_does_not_matter_the_transmittance_does(gauss: tuple[Lens, Domain, PairSet]) -> None:
    lens, domain, rays = gauss
    s = rays.scene
    further = s._replace(x=s.x + 30 * s.dx, y=s.y + 30 * s.dy, z=s.z + 30 * s.dz)
    errors = ray_errors(lens, domain, rays, lambda _: says(further, rays.transmittance - 0.01))
    assert errors.position_rms_um < 1e-9 and errors.max_um < 1e-8
    assert (errors.transmittance_rms, errors.transmittance_max) == pytest.approx((0.01, 0.01))


def test_pixels_and_the_common_scale(gauss: tuple[Lens, Domain, PairSet]) -> None:
    lens, domain, rays = gauss
    assert frame_width_mm(math.hypot(36, 24) / 2) == pytest.approx(36)

    def slightly_off(_: FilmRays) -> SimpleNamespace:
        return says(turned(rays.scene, 1e-5), rays.transmittance)

    errors = ray_errors(lens, domain, rays, slightly_off)
    assert errors.pixel_um == pytest.approx(9, rel=3e-3)
    assert errors.rms_px == pytest.approx(errors.rms_um / errors.pixel_um)
    half = lens.scaled(0.5)
    small = domain_of(half, focus_m=(1.0, 1.0))
    few = held_out(half, small)
    scaled = ray_errors(half, small, few, lambda _: says(turned(few.scene, 1e-5), few.transmittance))
    assert scaled.rms_um_at_21_6 == pytest.approx(2 * scaled.rms_um)
    assert scaled.rms_um_at_21_6 == pytest.approx(errors.rms_um_at_21_6, rel=0.01)


def test_beyond_60_degrees_only_angles_count() -> None:
    lens, domain = lens_and_domain("muller_fisheye_100", 14.0, math.inf)
    rays = held_out(lens, domain)
    wide = -rays.scene.dz < 0.5
    bent = turned(rays.scene, 1e-3)
    mixed = Rays(*(torch.where(wide, b, s) for b, s in zip(bent, rays.scene, strict=True)))
    errors = ray_errors(lens, domain, rays, lambda _: says(mixed, rays.transmittance))
    assert errors.max_um == 0
    assert errors.direction_max_deg == pytest.approx(math.degrees(1e-3), rel=1e-4)  # of a ray nearly across the y axis
    assert 0.1 < errors.share_beyond_60_deg == pytest.approx(float(wide.double().mean()))
    far = rays.select(wide)
    only_far = ray_errors(lens, domain, far, lambda _: says(far.scene, far.transmittance))
    assert math.isnan(only_far.rms_um) and only_far.direction_rms_deg == 0


def test_nonsense_is_not_averaged_away(gauss: tuple[Lens, Domain, PairSet]) -> None:
    lens, domain, rays = gauss
    first = torch.arange(len(rays)) == 0
    s = rays.scene
    backwards = s._replace(dz=torch.where(first, -s.dz, s.dz))
    errors = ray_errors(lens, domain, rays, lambda _: says(backwards, rays.transmittance))
    assert math.isinf(errors.max_um) and errors.direction_max_deg > 90
    broken = s._replace(dx=torch.where(first, math.nan, s.dx))
    errors = ray_errors(lens, domain, rays, lambda _: says(broken, rays.transmittance))
    assert math.isnan(errors.rms_um) and math.isnan(errors.direction_rms_deg)


def test_blocked_or_no_rays_are_refused(gauss: tuple[Lens, Domain, PairSet]) -> None:
    lens, domain, rays = gauss
    blocked = replace(rays, status=torch.full_like(rays.status, 6))
    for wrong in (blocked, rays.select(slice(0, 0))):
        with pytest.raises(InputError, match="held_out"):
            ray_errors(lens, domain, wrong, lambda _: says(rays.scene, rays.transmittance))


def pupil_disc_share(lens: Lens, domain: Domain, count: int) -> float:
    """Share of the passing rays that the domain's pupil disc contains; the definition of the errors requires 0.9999.

    Rays uniform over the film disc, wavelengths and film positions, and over a disc on the pupil plane that holds the
    whole rear surface seen from the film point, independent of the domain's bounds.
    """
    rays = sample_domain(domain, count, 7)
    scaled = [c / domain.pupil_radius_mm for c in (rays.pupil_x, rays.pupil_y)]  # uniform in the unit disc
    rear = lens.surfaces[-1]
    vertex, c, size = float(lens.vertices_mm[len(lens.surfaces) - 1]), float(rear.curvature), rear.semi_diameter_mm
    edge = vertex + c * size**2 / (1 + math.sqrt(max(0.0, 1 - (c * size) ** 2)))
    # The rear surface lies between the planes of its vertex and of its edge: a disc round both projections.
    stretch = torch.stack([(rays.film_z - domain.pupil_z_mm) / (rays.film_z - z) for z in (vertex, edge)])
    along = (1 - stretch).mean(0)
    reach = size * stretch.abs().max(0).values
    reach = reach + torch.hypot(rays.film_x, rays.film_y) * (stretch[0] - stretch[1]).abs() / 2
    pupil_x, pupil_y = rays.film_x * along + reach * scaled[0], rays.film_y * along + reach * scaled[1]
    start = camera_rays(rays.film_x, rays.film_y, rays.film_z, pupil_x, pupil_y, domain.pupil_z_mm)
    with torch.no_grad():
        traced = trace(lens, start, rays.wavelength_nm)
    weight = torch.where(traced.status == st.PASSED, reach * reach, 0.0)  # the discs differ in size
    held = torch.hypot(pupil_x, pupil_y) <= domain.pupil_radius_mm
    return min(1.0, float(weight[held].sum() / weight.sum()))


def test_the_pupil_disc_of_a_hole() -> None:
    """A hole of radius 10: a disc of half that radius holds a quarter of its rays."""
    lens, domain = hole(10.0)
    assert pupil_disc_share(lens, domain, 65536) == 1.0
    assert pupil_disc_share(lens, replace(domain, pupil_radius_mm=5.0), 65536) == pytest.approx(0.25, rel=2e-3)


@pytest.mark.parametrize("name, efl_mm", [("laikin_double_gauss_50", None), ("brendel_tessar_100", 50.0)])
def test_the_domain_holds_the_passing_rays(name: str, efl_mm: float | None) -> None:
    lens, domain = lens_and_domain(name, efl_mm, math.inf)
    assert pupil_disc_share(lens, domain, 131072) >= 0.9999


def test_the_middle_of_the_pupil_passes() -> None:
    lens, domain = lens_and_domain("laikin_double_gauss_50", None, math.inf)
    radius = torch.linspace(0, image_radius_mm(lens)[0], 50, dtype=torch.float64)
    zero = torch.zeros_like(radius)
    rays = camera_rays(radius, zero, domain.film_z_mm[0], pupil_middle(domain, radius), zero, domain.pupil_z_mm)
    assert bool((trace(lens, rays).status == 0).all())


def test_where_the_image_folds_an_error_counts_for_ten_times_first_order_at_most() -> None:
    """A loupe's film, far out, sees one direction twice: two samples of rays still agree about the same error."""
    front, flat = Surface(51.5, 9.0, 60.0, n_d=1.7, V_d=40.0), Surface(math.inf, 20.0, 60.0)
    lens = Lens(
        name="loupe", source="made up", f_number=10.0, surfaces=(front, flat, Surface(math.inf, 40.0, 6.0, stop=True))
    )
    lens = set_lens(lens)
    domain, f = domain_of(lens, film_radius_mm=80.0), first_order(lens).efl_mm
    rms = []
    for seed in (1, 2):
        rays = passing_rays(lens, domain, 3000, seed)
        errors = ray_errors(lens, domain, rays, lambda _, r=rays: says(turned(r.scene, 1e-6), r.transmittance))
        rms.append(errors.rms_infinity_um)
        assert errors.max_infinity_um < 1000 * 10 * f * 1e-6 / math.cos(math.radians(60)) ** 2
    radial, _ = local_jacobian(lens, domain, rays.inputs, focused_vergence(lens, rays.inputs.film_z))
    assert float(radial.min()) < 0.01 / f
    assert rms[0] == pytest.approx(rms[1], rel=0.1)


FILM_Z, FILM_RADIUS = 50.0, 15.0


def hole(radius_mm: float) -> tuple[Lens, Domain]:
    """A hole in an opaque plane, its rays sampled on that plane to 1.05 radii."""
    lens = Lens("hole", "test", (Surface(math.inf, FILM_Z, 2 * radius_mm, stop=True),), 2.5)
    row = (radius_mm, radius_mm)
    bounds = PupilBounds(0.0, FILM_RADIUS, (-radius_mm, -radius_mm), row, row, radius_mm)
    planes, focus, nanometres = (FILM_Z, FILM_Z), (math.inf, math.inf), (500.0, 600.0)
    return lens, Domain(FILM_RADIUS, planes, focus, 0.0, 1.05 * radius_mm, nanometres, radius_mm, bounds)


def opening(
    factor: float, transmittance: float = 1.0, beyond_mm: float = 0.0
) -> Callable[[FilmRays, float | None], SimpleNamespace]:
    """A model of the hole whose radius is wrong by `factor` for film points beyond `beyond_mm`."""

    def predict(rays: FilmRays, stop_radius_mm: float | None) -> SimpleNamespace:
        assert stop_radius_mm is not None
        wrong = torch.hypot(rays.film_x, rays.film_y) >= beyond_mm
        limit = stop_radius_mm * torch.where(wrong, factor, 1.0)
        passes = torch.hypot(rays.pupil_x, rays.pupil_y) <= limit
        status = torch.where(passes, st.PASSED, st.blocked(0, st.RIM))
        return SimpleNamespace(status=status, transmittance=torch.full_like(rays.film_x, transmittance))

    return predict


def test_illumination_of_a_small_hole_is_cos4() -> None:
    result = relative_illumination(*hole(0.2), opening(1.0, 0.9), points=4096, rows=9)
    expected = [math.cos(math.atan2(r, FILM_Z)) ** 4 for r in result.film_radius_mm]
    assert result.exact == pytest.approx(expected, rel=1e-4)
    assert result.model == pytest.approx([0.9 * e for e in expected], rel=1e-4)
    assert result.max_difference == pytest.approx(0.1, rel=1e-4)
    assert result.film_radius_mm[-1] == FILM_RADIUS
