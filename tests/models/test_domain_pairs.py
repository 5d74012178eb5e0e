"""Domains and ray pairs: uniform, repeatable, and without a ray in two splits."""

import json
import math
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from neurolens.base.errors import InputError
from neurolens.models.fitted import Domain
from neurolens.models.pairs import (
    PairSettings,
    RayPairs,
    domain_of,
    focused_plane_z_mm,
    make_pairs,
    sample_domain,
    trace_pairs,
)
from neurolens.models.targets import film_equivalent_weights
from neurolens.optics.lens.glass import LINE_D_NM
from neurolens.optics.lens.paraxial import PupilBounds, film_z_mm, first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens

ROOT = Path(__file__).parents[2] / "lenses"
BOUNDS = PupilBounds(10.0, 20.0, (-5.0, -4.0), (5.0, 6.0), (5.0, 5.0), 7.0)
DOMAIN = Domain(20.0, (50.0, 55.0), (math.inf, 0.5), 10.0, 7.35, (400.0, 700.0), 6.0, BOUNDS)


def singlet() -> Lens:
    return set_lens(read_lens(ROOT / "thorlabs_lb1471_biconvex_50.toml"), f_number=4.0)


@pytest.fixture(scope="module")
def pairs() -> RayPairs:
    lens = singlet()
    domain = domain_of(lens, film_radius_mm=12.0, focus_m=(math.inf, 1.0))
    return make_pairs(lens, domain, PairSettings(train=3000, held_out=2000, rim=2500, seed=3))


# ---- sampling ----


def test_sampling_is_uniform() -> None:
    """Radii and azimuths of both discs, wavelength and film position: largest deviation of their distributions."""
    count = 20000
    rays = sample_domain(DOMAIN, count, seed=7)
    film, pupil = torch.hypot(rays.film_x, rays.film_y), torch.hypot(rays.pupil_x, rays.pupil_y)
    turn = 2 * math.pi
    uniform = {
        "film area": (film / 20) ** 2,
        "pupil area": (pupil / 7.35) ** 2,
        "film azimuth": torch.atan2(rays.film_y, rays.film_x) / turn + 0.5,
        "pupil azimuth": torch.atan2(rays.pupil_y, rays.pupil_x) / turn + 0.5,
        "wavelength": (rays.wavelength_nm - 400) / 300,
    }
    steps = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    columns = torch.stack([*uniform.values(), rays.film_z])
    for name, u in uniform.items():
        assert (u >= 0).all() and (u <= 1).all(), name
        assert (u.sort().values - steps).abs().max() < 2e-3, name  # random numbers would give 1e-2
    assert (torch.corrcoef(columns) - torch.eye(6)).abs().max() < 0.01
    # Film positions: equally many rays at equal steps, both limits among them.
    planes, shares = rays.film_z.unique(return_counts=True)
    torch.testing.assert_close(planes, torch.linspace(50, 55, len(planes), dtype=torch.float64))
    assert len(planes) > 8 and (shares / count * len(planes) - 1).abs().max() < 0.01


def test_sampling_is_repeatable_and_continues() -> None:
    whole = sample_domain(DOMAIN, 3000, seed=7).columns()
    assert all(torch.equal(a, b) for a, b in zip(whole, sample_domain(DOMAIN, 3000, seed=7).columns(), strict=True))
    for skip in (1, 1000, 1024):
        rest = sample_domain(DOMAIN, 3000 - skip, seed=7, skip=skip).columns()
        assert all(torch.equal(a[skip:], b) for a, b in zip(whole, rest, strict=True))
    assert not torch.equal(whole[0], sample_domain(DOMAIN, 3000, seed=8).film_x)


# ---- domains ----


def test_domains_survive_json_and_cards_without_a_nearest_object_still_load() -> None:
    for domain in (DOMAIN, replace(DOMAIN, nearest_m=0.3)):
        assert Domain.from_dict(json.loads(json.dumps(domain.to_dict()))) == domain
    data = DOMAIN.to_dict()
    del data["nearest_m"]
    assert Domain.from_dict({**data, "written_by": "a later version"}) == DOMAIN


def test_near_objects_before_the_plane_in_focus_keep_their_place() -> None:
    """A position error counts by the magnification of the nearest thing in view, in focus or not."""
    lens = set_lens(singlet(), focus_m=5.0)
    position: dict[float | None, float] = {}
    planes = set()
    for nearest_m in (None, 10.0, 0.5):
        domain = domain_of(lens, film_radius_mm=5.0, focus_m=(5.0, 5.0), nearest_m=nearest_m)
        position[nearest_m] = film_equivalent_weights(lens, domain)[0]
        planes.add(domain.film_z_mm)
    assert len(planes) == 1
    f = first_order(lens).efl_mm
    # No less than the magnification at 20 focal lengths.
    assert position[None] == position[10.0] == pytest.approx(1000 / 19 * lens.surfaces[0].semi_diameter_mm)
    assert position[0.5] / position[None] == pytest.approx(f / (500 - f) * 19)


def test_one_shot_needs_less_than_the_whole_lens() -> None:
    lens = set_lens(read_lens(ROOT / "brendel_tessar_100.toml"), focal_length_mm=50)
    full = domain_of(lens, focus_m=(math.inf, 0.7))
    stopped = set_lens(lens, focus_m=2.0, f_number=8.0)
    shot = domain_of(stopped, film_radius_mm=14.4, focus_m=(2.0, 2.0), wavelength_nm=(500, 600))
    assert shot.pupil_radius_mm < 0.6 * full.pupil_radius_mm
    assert shot.stop_radius_mm < 0.5 * full.stop_radius_mm
    near, far = shot.film_z_mm
    assert near < film_z_mm(lens, 2.0) < far and far - near < 0.2 * (full.film_z_mm[1] - full.film_z_mm[0])
    assert full.film_z_mm[0] < near and far < full.film_z_mm[1]
    assert near < set_lens(stopped, f_number=8.0, focus_m=2.0, focus_mode="best").film_z_mm < far


@pytest.mark.parametrize("focus_m", [0.3, 1.0, 100.0])
def test_focused_plane_is_the_inverse_of_focusing(focus_m: float) -> None:
    lens = singlet()
    film = film_z_mm(lens, focus_m)
    plane = float(focused_plane_z_mm(lens, torch.tensor([film], dtype=torch.float64))[0])
    assert film - plane == pytest.approx(1000 * focus_m, rel=1e-9)
    infinity = film_z_mm(lens, math.inf)
    beyond = torch.tensor([infinity, infinity - 0.1], dtype=torch.float64)
    assert torch.equal(focused_plane_z_mm(lens, beyond), torch.full((2,), -math.inf, dtype=torch.float64))


def test_without_dispersion_there_is_one_wavelength() -> None:
    fisheye = set_lens(read_lens(ROOT / "muller_fisheye_100.toml"), focal_length_mm=14, f_number=16)
    plain = replace(fisheye, surfaces=tuple(replace(s, V_d=None) for s in fisheye.surfaces))
    domain = domain_of(plain, film_radius_mm=5.0)
    assert domain.wavelength_nm == (LINE_D_NM, LINE_D_NM)
    assert (sample_domain(domain, 10, 1).wavelength_nm == LINE_D_NM).all()


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"film_radius_mm": 0.0}, "film_radius_mm"),
        ({"film_radius_mm": 1e308}, "film_radius_mm"),
        ({"film_radius_mm": math.inf}, "film_radius_mm"),
        ({"nearest_m": 0.0}, "nearest_m"),
        ({"wavelength_nm": (700.0, 400.0)}, "wavelength_nm"),
        ({"wavelength_nm": (0.4, 0.7)}, "wavelength_nm"),
        ({"focus_m": (math.inf, 0.05)}, "focus_m"),
        ({"focus_m": (math.inf, math.nan)}, "focus_m"),
    ],
)
def test_domains_that_are_none(wrong: dict[str, object], named: str) -> None:
    with pytest.raises(InputError, match=named):
        domain_of(singlet(), **{"film_radius_mm": 5.0, **wrong})  # type: ignore[arg-type]


# ---- pairs ----


def test_splits_have_their_sizes_and_share_no_ray(pairs: RayPairs) -> None:
    assert (len(pairs.train), len(pairs.held_out), len(pairs.rim)) == (3000, 2000, 2500)
    assert (pairs.train.status == 0).all() and (pairs.held_out.status == 0).all()
    keys = [{tuple(r) for r in torch.stack(s.inputs.columns()).T.tolist()} for s in (pairs.train, pairs.held_out)]
    assert [len(k) for k in keys] == [3000, 2000]
    assert not keys[0] & keys[1]


def test_rim_rays_lie_on_both_sides_of_a_rim(pairs: RayPairs) -> None:
    radii = torch.tensor(pairs.lens.semi_diameters_mm, dtype=torch.float64)[:, None]
    ratio = (torch.hypot(pairs.rim.cross_x, pairs.rim.cross_y) / radii).max(0).values
    assert 0.05 < (ratio > 1).double().mean() < 0.95
    assert ratio.max() <= 1.25
    assert all(torch.isfinite(c).all() for c in replace(pairs.rim, transmittance=ratio).columns())
    assert pairs.rim.transmittance.isnan().all() and not pairs.train.transmittance.isnan().any()
    # Outside every rim and blocked are the same thing for rays that refract all the way.
    assert torch.equal(ratio > 1, pairs.rim.status != 0)


def test_tested_gives_the_share_that_passes(pairs: RayPairs) -> None:
    drawn = sample_domain(pairs.domain, 20000, seed=99)
    share = float((trace_pairs(pairs.lens, drawn, pairs.domain.pupil_z_mm, power=False).status == 0).double().mean())
    assert len(pairs.train) / pairs.tested == pytest.approx(share, abs=0.02)


def test_the_seed_decides(pairs: RayPairs) -> None:
    small = PairSettings(train=100, held_out=50, rim=50, seed=5)
    one, two = (make_pairs(pairs.lens, pairs.domain, small) for _ in range(2))
    for name in ("train", "rim"):
        columns = (getattr(pairs, name).columns() for pairs in (one, two))
        assert all(torch.allclose(a, b, rtol=0, atol=0, equal_nan=True) for a, b in zip(*columns, strict=True))
    other = make_pairs(pairs.lens, pairs.domain, replace(small, seed=6))
    assert not torch.equal(one.train.scene.x, other.train.scene.x)


@pytest.mark.parametrize("wrong", [{"train": 0}, {"held_out": 0}, {"rim": 0}, {"train": -5}])
def test_settings_that_are_none(wrong: dict[str, int]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        PairSettings(**wrong)


def test_a_domain_that_nothing_reaches(pairs: RayPairs) -> None:
    shut = pairs.lens.with_stop_radius(1e-6)
    with pytest.raises(InputError, match="domain"):
        make_pairs(shut, pairs.domain, PairSettings(10, 10, 10))


def test_a_focus_beyond_all_floats_in_mm_is_infinity() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        far, infinite = (domain_of(singlet(), film_radius_mm=5.0, focus_m=(f, f)) for f in (1e308, math.inf))
    assert far.film_z_mm == pytest.approx(infinite.film_z_mm, rel=1e-12)
