"""False passes and blocks at one stop, traced at that stop: what `evaluate.measure` finds is held to it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.evaluate.vignetting import NEAR_RIM, SEED, ZONES, deciding_rim_ratio, false_shares
from neurolens.optics.prescription import Lens
from neurolens.surrogates.domain import Domain, FilmRays, sample_domain
from neurolens.surrogates.pairs import trace_pairs

_BATCH = 65536


class Gated(Protocol):
    """What `predict` gives for N rays: status [N], 0 where the ray passes."""

    @property
    def status(self) -> Tensor: ...


def vignetting_errors(
    lens: Lens,
    domain: Domain,
    predict: Callable[[FilmRays, float | None], Gated],
    *,
    stop_radius_mm: float | None = None,
    count: int = 300_000,
    seed: int = SEED,
) -> dict[str, Any]:
    """False passes and false blocks at one stop.

    Args:
        lens: the exact lens in the model's state.
        domain: of the model.
        predict: takes rays and the stop radius in mm.
        stop_radius_mm: None takes the domain's, full aperture; a smaller one tests the same fit stopped down.
        count, seed: rays, scrambled Sobol points; a seed other than the fit's, so that they are fresh.

    Returns: false_pass, false_block (shares of 1; None where no ray counts), false_pass_near_rim, false_block_near_rim
        (rays whose nearest deciding rim, the stop included, they cross within 2% of its radius), stop_radius_mm, rays,
        passing_share (of the exact lens over the disc), zones: the first two by third of the film radius.

    Raises:
        InputError: a stop wider than the domain's, or not positive.
    """
    radius = domain.stop_radius_mm if stop_radius_mm is None else stop_radius_mm
    if not 0 < radius <= domain.stop_radius_mm:
        raise InputError(
            "vignetting_errors", "stop_radius_mm", radius, f"above 0, up to {domain.stop_radius_mm:.6g} mm"
        )
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
