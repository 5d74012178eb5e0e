"""False passes and blocks at one stop, traced at that stop: `study.measure` is held to it."""

from collections.abc import Callable
from typing import Any

import torch

from neurolens.base import status as st
from neurolens.lens.prescription import Lens
from neurolens.study.vignetting import NEAR_RIM, SEED, ZONES, deciding_rim_ratio, false_shares
from neurolens.surrogates.domain import FilmRays, sample_domain
from neurolens.surrogates.model import Domain
from neurolens.surrogates.pairs import trace_pairs

_BATCH = 65536


def vignetting_errors(
    lens: Lens,
    domain: Domain,
    predict: Callable[[FilmRays, float | None], Any],
    *,
    stop_radius_mm: float | None = None,
    count: int = 300_000,
    seed: int = SEED,
) -> dict[str, Any]:
    """False passes and blocks at one stop: false_shares in all, near a rim, and by zone; the share that passes.

    Args:
        predict: takes rays and the stop radius in mm, gives what has a status [N], 0 where the ray passes.
        stop_radius_mm: None takes the domain's, full aperture; a smaller one tests the same fit stopped down.
        seed: of scrambled Sobol points; other than the fit's, so that rays are fresh.
    """
    radius = domain.stop_radius_mm if stop_radius_mm is None else stop_radius_mm
    stopped = lens.with_stop_radius(radius)
    passes, model, near, place = [], [], [], []
    for start in range(0, count, _BATCH):
        rays = sample_domain(domain, min(_BATCH, count - start), seed, start)
        exact = trace_pairs(stopped, rays, domain.pupil_z_mm)
        passes.append(exact.status == st.PASSED)
        model.append(predict(rays, radius).status == st.PASSED)
        near.append((deciding_rim_ratio(stopped, exact) - 1).abs() <= NEAR_RIM)
        place.append(torch.hypot(rays.film_x, rays.film_y) / domain.film_radius_mm)
    right, said, close, where = (torch.cat(v) for v in (passes, model, near, place))
    near_rim = false_shares(right[close], said[close])
    zones = {}
    for name, (low, high) in ZONES.items():
        part = (where >= low) & ((where < high) | (high == 1.0))
        zones[name] = false_shares(right[part], said[part])
    return {
        **false_shares(right, said),
        **{f"{key}_near_rim": value for key, value in near_rim.items()},
        "stop_radius_mm": radius,
        "rays": count,
        "passing_share": float(right.double().mean()),
        "zones": zones,
    }
