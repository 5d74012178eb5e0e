"""Vignetting of a surrogate against the exact lens: rays passed or blocked in error, and relative illumination.

False pass: rays that the model passes and the exact lens blocks, over the rays that the model passes. False block: rays
that the model blocks and the exact lens passes, over the rays that the exact lens passes. Rays are uniform over the lit
film and over the domain's pupil disc, which is that of all passing rays enlarged by 5%.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.optics.prescription import Lens
from neurolens.optics.pupils import camera_rays
from neurolens.optics.trace import trace
from neurolens.surrogates.domain import Domain, FilmRays, sample_domain
from neurolens.surrogates.pairs import PairSet

NEAR_RIM = 0.02  # relative distance to a rim's radius that counts as near
ZONES = {"centre": (0.0, 1 / 3), "mid": (1 / 3, 2 / 3), "edge": (2 / 3, 1.0)}  # shares of the film radius
SEED = 104729  # unlikely as the seed of a fit's rays


class Lit(Protocol):
    """What `predict` gives for N rays: status [N], 0 where the ray passes, and transmittance [N]."""

    @property
    def status(self) -> Tensor: ...

    @property
    def transmittance(self) -> Tensor: ...


def false_shares(exact_passes: Tensor, model_passes: Tensor) -> dict[str, float | None]:
    """false_pass and false_block of [N] booleans; None where the denominator is empty."""
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


def relative_illumination(
    lens: Lens,
    domain: Domain,
    predict: Callable[[FilmRays, float | None], Lit],
    *,
    film_z_mm: float | None = None,
    stop_radius_mm: float | None = None,
    points: int = 16384,
    rows: int = 17,
    seed: int = SEED,
) -> dict[str, Any]:
    """Film irradiance of a uniform environment by film radius, of the exact lens and of the model.

    The weight of a ray is T cos^4(theta) / Z^2 over the pupil disc, T the transmittance; wavelengths are uniform over
    the domain. Both curves are divided by the exact lens's value on the axis, so that a uniformly dark model is
    visible.

    Args:
        film_z_mm: film plane; None takes the domain's nearest to the lens (its farthest focus).
        stop_radius_mm: None takes the domain's.
        points: rays per film radius, the same pupil points and wavelengths for all.

    Returns: film_radius_mm, exact, model (lists of `rows`), max_difference (of the two, a share of the axis value).
    """
    plane = domain.film_z_mm[0] if film_z_mm is None else film_z_mm
    radius = domain.stop_radius_mm if stop_radius_mm is None else stop_radius_mm
    stopped = lens.with_stop_radius(radius)
    sample = sample_domain(domain, points, seed)
    film_z = torch.full_like(sample.film_z, plane)
    radii = [domain.film_radius_mm * i / (rows - 1) for i in range(rows)]
    sums: tuple[list[float], list[float]] = ([], [])
    for r in radii:
        rays = FilmRays(torch.full_like(film_z, r), torch.zeros_like(film_z), film_z, *sample.columns()[3:])
        start = camera_rays(rays.film_x, rays.film_y, film_z, rays.pupil_x, rays.pupil_y, domain.pupil_z_mm)
        with torch.no_grad():
            traced = trace(stopped, start, rays.wavelength_nm, transmittance=True)
        said = predict(rays, radius)
        assert traced.transmittance is not None
        both = ((traced.status, traced.transmittance), (said.status, said.transmittance))
        for values, (status, transmittance) in zip(sums, both, strict=True):
            power = torch.where(status == st.PASSED, transmittance.to(torch.float64), 0.0)
            values.append(float((power * start.dz**4).sum()))  # one film plane and pupil plane: Z is the same for all
    on_axis = sums[0][0]
    if not on_axis > 0:
        raise InputError(
            lens.path, "domain", "(no ray passes on the axis)", "a lens that illuminates the centre of the film"
        )
    exact, model = ([v / on_axis for v in values] for values in sums)
    difference = max(abs(a - b) for a, b in zip(exact, model, strict=True))
    return {"film_radius_mm": radii, "exact": exact, "model": model, "max_difference": difference}
