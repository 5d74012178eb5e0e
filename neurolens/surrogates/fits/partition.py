"""Light-field partition: zones of the film with a fit of their own where one fit leaves the error high.

After Zheng and Zheng 2017 (adaptive sparse polynomials) and NeuroLens 2017 (networks), which both split the space of
rays. Zones are rings of the film, so that the rotational symmetry of the invariants survives.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from neurolens.base.errors import InputError
from neurolens.surrogates.cores import InvariantPolynomial, Network, Partitioned, RawPolynomial, Residual
from neurolens.surrogates.lightfield import Encoding
from neurolens.surrogates.pairs import PairSet, RayPairs
from neurolens.surrogates.targets import film_equivalent, targets_of

ZoneCore = InvariantPolynomial | RawPolynomial | Network | Residual
# A zone's fit sees this share of rho beyond its edges, so that neighbours meet.
OVERLAP = 0.03
_FEWEST_RAYS = 200
_FITTED = ("train", "rim", "edge", "far")  # the splits that fits see


def fit_partitioned(
    pairs: RayPairs, encoding: Encoding, zones: int, fit: Callable[[RayPairs], ZoneCore]
) -> Partitioned | ZoneCore:
    """Split the zone with the largest summed squared error in two halves of its rays, until there are `zones`.

    Args:
        fit: fits one core to the ray pairs of a zone.

    Raises:
        InputError: fewer than one zone, or several with fewer than 200 training rays each.
    """
    if zones < 1 or (zones > 1 and len(pairs.train) < zones * _FEWEST_RAYS):
        most = max(1, len(pairs.train) // _FEWEST_RAYS)
        raise InputError("fit", "partitions", zones, f"1 to {most} zones for {len(pairs.train)} training rays")
    rhos = {name: encoding(getattr(pairs, name).inputs).invariants()[0] for name in _FITTED}
    rho = rhos["train"]
    bounds = [(-torch.inf, torch.inf)]
    cores = [fit(pairs)]
    while len(cores) < zones:
        inside = [(rho > low) & (rho <= high) for low, high in bounds]
        errors = [_squared_error(pairs, encoding, core, at) for core, at in zip(cores, inside, strict=True)]
        worst = errors.index(max(errors))
        low, high = bounds[worst]
        middle = float(rho[inside[worst]].median())
        halves = [(low, middle), (middle, high)]
        bounds[worst : worst + 1] = halves
        cores[worst : worst + 1] = [fit(_zone(pairs, rhos, *half)) for half in halves]
    if zones == 1:
        return cores[0]
    return Partitioned(tuple(high for _, high in bounds[:-1]), tuple(cores))


def _squared_error(pairs: RayPairs, encoding: Encoding, core: ZoneCore, at: Tensor) -> float:
    targets = targets_of(pairs.lens, encoding, pairs.train.select(at))
    vectors, _ = core(targets.field)
    found = film_equivalent(pairs.lens, pairs.domain, vectors)
    return float(((found - film_equivalent(pairs.lens, pairs.domain, targets.vectors)) ** 2).sum())


def _zone(pairs: RayPairs, rhos: dict[str, Tensor], low: float, high: float) -> RayPairs:
    def within(name: str) -> PairSet:
        rho, rays = rhos[name], getattr(pairs, name)
        chosen: PairSet = rays.select((rho > low - OVERLAP) & (rho <= high + OVERLAP))
        return chosen

    return replace(pairs, train=within("train"), rim=within("rim"), edge=within("edge"), far=within("far"))
