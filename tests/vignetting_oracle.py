"""False passes and blocks at one stop, traced at that stop: `studies.measure` is held to it."""

from collections.abc import Callable
from typing import Any

import torch

from neurolens.base import status as st
from neurolens.models.fitted import Domain, FilmRays
from neurolens.models.pairs import sample_domain, trace_pairs
from neurolens.optics.lens.prescription import Lens
from neurolens.studies.rays import SEED, ZONES, false_shares

_BATCH = 65536


def vignetting_errors(
    lens: Lens, domain: Domain, predict: Callable[[FilmRays, float | None], Any], *,
    stop_radius_mm: float | None = None, count: int = 300_000, seed: int = SEED,
) -> dict[str, Any]:  # fmt: skip
    """The false shares over all rays and by zone; and the share that passes.

    Args:
        predict: takes rays and the stop radius in mm, gives a status [N], 0 where the ray passes.
        stop_radius_mm: None takes the domain's, full aperture; a smaller one tests the same fit stopped down.
        seed: of scrambled Sobol points; other than the fit's, so that rays are fresh.
    """
    radius = domain.stop_radius_mm if stop_radius_mm is None else stop_radius_mm
    stopped, parts = lens.with_stop_radius(radius), []
    for start in range(0, count, _BATCH):
        rays = sample_domain(domain, min(_BATCH, count - start), seed, start)
        exact = trace_pairs(stopped, rays, domain.pupil_z_mm, power=False)
        zone = torch.hypot(rays.film_x, rays.film_y) / domain.film_radius_mm
        parts.append((exact.status == st.PASSED, predict(rays, radius).status == st.PASSED, zone))
    exact_passes, model_passes, zone = (torch.cat(v) for v in zip(*parts, strict=True))

    def shares(part: torch.Tensor) -> dict[str, float | None]:
        return false_shares(exact_passes[part], model_passes[part])

    return {
        **false_shares(exact_passes, model_passes),
        "stop_radius_mm": radius,
        "passing_share": float(exact_passes.double().mean()),
        "zones": {n: shares((zone >= low) & ((zone < high) | (high == 1.0))) for n, (low, high) in ZONES.items()},
    }
