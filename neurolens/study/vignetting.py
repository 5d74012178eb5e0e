"""Vignetting of a surrogate against the exact lens: rays passed or blocked in error, and relative illumination."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.lens.prescription import Lens
from neurolens.setting.pupils import camera_rays
from neurolens.study.rays import Predict
from neurolens.surrogates.domain import FilmRays, sample_domain
from neurolens.surrogates.model import Domain
from neurolens.surrogates.pairs import PairSet
from neurolens.trace.rays import trace

NEAR_RIM = 0.02  # relative distance to a rim's radius that counts as near
ZONES = {"centre": (0.0, 1 / 3), "mid": (1 / 3, 2 / 3), "edge": (2 / 3, 1.0)}  # shares of the film radius
SEED = 104729  # unlikely as the seed of a fit's rays


def false_shares(exact_passes: Tensor, model_passes: Tensor) -> dict[str, float | None]:
    """false_pass and false_block of [N] booleans of rays uniform over the lit film and the domain's pupil disc.

    False pass: rays that the model passes and the exact lens blocks, over those that the model passes. False block:
    rays that the model blocks and the exact lens passes, over those that the exact lens passes. None over no rays.
    """
    wrong_pass, wrong_block = model_passes & ~exact_passes, exact_passes & ~model_passes
    return {"false_pass": _share(wrong_pass, model_passes), "false_block": _share(wrong_block, exact_passes)}


def _share(part: Tensor, whole: Tensor) -> float | None:
    total = int(whole.sum())
    return int(part.sum()) / total if total else None


def deciding_rim_ratio(lens: Lens, pairs: PairSet) -> Tensor:
    """[N] largest crossing radius over rim radius along each ray, stop included: at most 1 where every rim passes it.

    Surfaces beyond one that the ray misses, or that reflects it totally, do not count.
    """
    radii = torch.tensor(lens.semi_diameters_mm, dtype=torch.float64)[:, None]
    ratio = torch.hypot(pairs.cross_x, pairs.cross_y) / radii
    on_the_way, largest = torch.ones(len(pairs), dtype=torch.bool), torch.zeros(len(pairs), dtype=torch.float64)
    for k in range(len(lens.surfaces) - 1, -1, -1):  # camera rays meet the last surface first
        on_the_way = on_the_way & (pairs.meets[k] > 0)
        largest = torch.where(on_the_way, torch.maximum(largest, ratio[k]), largest)
        on_the_way = on_the_way & (pairs.refracts[k] > 0)
    return largest


@dataclass(frozen=True)
class Illumination:
    """Shares of the exact lens's value on the axis, by film radius.

    Attributes:
        film_radius_mm, exact, model: one value a radius.
        max_difference: of the two.
    """

    film_radius_mm: list[float]
    exact: list[float]
    model: list[float]
    max_difference: float


def relative_illumination(
    lens: Lens, domain: Domain, predict: Predict, *, points: int = 16384, rows: int = 17, seed: int = SEED
) -> Illumination:
    """Film irradiance of a uniform environment by film radius, of the exact lens and of the model.

    The weight of a ray is T cos^4(theta) / Z^2 over the pupil disc, T the transmittance; wavelengths are uniform over
    the domain. Both curves are divided by the exact lens's value on the axis, so that a uniformly dark model is
    visible. The film plane is the domain's nearest to the lens (its farthest focus), the stop the domain's.

    Args:
        points: rays per film radius, the same pupil points and wavelengths for all.
        rows: film radii.

    Raises:
        InputError: no ray passes on the axis.
    """
    radius = domain.stop_radius_mm
    stopped = lens.with_stop_radius(radius)
    sample = sample_domain(domain, points, seed)
    film_z = torch.full_like(sample.film_z, domain.film_z_mm[0])
    radii = [domain.film_radius_mm * i / (rows - 1) for i in range(rows)]
    sums: tuple[list[float], list[float]] = ([], [])
    for r in radii:
        rays = FilmRays(torch.full_like(film_z, r), torch.zeros_like(film_z), film_z, *sample.columns()[3:])
        start = camera_rays(rays.film_x, rays.film_y, film_z, rays.pupil_x, rays.pupil_y, domain.pupil_z_mm)
        with torch.no_grad():
            traced = trace(stopped, start, rays.wavelength_nm, transmittance=True)
        for values, given in zip(sums, (traced, predict(rays, radius)), strict=True):
            power = torch.where(given.status == st.PASSED, given.transmittance.to(torch.float64), 0.0)
            values.append(float((power * start.dz**4).sum()))  # one film plane and pupil plane: Z is the same for all
    on_axis = sums[0][0]
    if not on_axis > 0:
        expected = "a lens that illuminates the centre of the film"
        raise InputError(lens.path, "domain", "(no ray passes on the axis)", expected)
    exact, model = ([v / on_axis for v in values] for values in sums)
    return Illumination(radii, exact, model, max(abs(a - b) for a, b in zip(exact, model, strict=True)))
