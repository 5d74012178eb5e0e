"""Fits the transmittance of models apart from where rays go, so that it can be fitted again when coatings change.

What films reflect changes with the wavelength and the angle faster than any ray's path does. So the transmittance is a
polynomial with terms of its own. Some are those that serve position, direction and gates, which cost a product less;
the others are high powers of the wavelength times low powers of the ray. Networks have no part in it; they get such a
polynomial beside them.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from neurolens.base.settings import LIGHT_NM
from neurolens.models.cores import (
    Array,
    Core,
    InvariantPolynomial,
    MirrorPolynomial,
    Network,
    Phased,
    Refracted,
    Residual,
)
from neurolens.models.fitted import FilmRays
from neurolens.models.model import LensModel
from neurolens.models.terms import (
    Exponents,
    Sweep,
    forward,
    monomials,
    ordered,
    pinned_threads,
    powers,
    replace_terms,
    solve,
    united,
)

# RMS at which no term is added: so long as there are fewer than `_CHEAP`, and from then on.
FINE, TRANSMITTANCE_ERROR, _CHEAP = 8e-5, 4e-4, 24
# The degree of candidates in the ray's invariants and w together, by the number of invariants; the degree in the
# invariants beside high powers of w; and the highest power of w. Of 12 coated lenses more of the first two gained
# nothing; of 17, powers of w to 20 took 40% (median) off the error that those to 10 had in the light of pictures, which
# films and flints make below 450 nm. Twice the terms gain 4% at most, and the logarithm loses 1 to 31%.
_DEGREE, _BESIDE_W, MOST_W = {3: 5, 6: 4}, 2, 20
_CHOICE_RAYS, _PASSES = 8000, 3
_BEYOND_LIGHT = 0.3  # weight of rays outside `LIGHT_NM`, where films reflect most and pictures have hardly any light

Polynomial = InvariantPolynomial | MirrorPolynomial
Sample = tuple[FilmRays, Tensor]  # rays that pass, and the transmittance [N] of the exact lens


def with_transmittance(models: Sequence[LensModel], samples: Sequence[Sample], most: int) -> list[LensModel]:
    """Return the models with their transmittance fitted to the rays of each, by terms that are the same for all.

    Args:
        models: of one structure, such as the nodes of a zoom.
        most: terms of the transmittance, at most.
    """
    opened = [_opened(model.core) for model in models]
    needed = np.any([polynomial.serves for polynomial, _ in opened], axis=0)
    known = opened[0][0].exponents[needed]
    fields = [
        (model.encoding(rays).invariants(model.encoding.mirror), power, _weight(rays))
        for model, (rays, power) in zip(models, samples, strict=True)
    ]
    found = []
    with pinned_threads():
        own = _chosen(fields, known, most, dispersive=models[0].encoding.dispersive)
        exponents, (_, places) = united([known, own])
        more = np.zeros((1, len(exponents) - len(known)))
        for model, (polynomial, closed), (variables, power, weight) in zip(models, opened, fields, strict=True):
            ab, scalars = (_joined(a[..., needed], more) for a in (polynomial.ab, polynomial.scalars))
            scalars[0] = 0.0
            scalars[0, places] = solve(monomials(variables, own), power[None], weight)[0].numpy()
            core = closed(replace(polynomial, exponents=exponents, ab=ab, scalars=scalars))
            found.append(replace(model, core=core))
    return found


def _joined(coefficients: Array, more: Array) -> Array:
    return np.concatenate([coefficients, np.broadcast_to(more, (*coefficients.shape[:-1], more.shape[1]))], axis=-1)


def _weight(rays: FilmRays) -> Tensor:
    """Return the weights [N] of rays: full for the light that pictures are made of."""
    low, high = LIGHT_NM
    seen = (rays.wavelength_nm >= low) & (rays.wavelength_nm <= high)
    return torch.where(seen, 1.0, _BEYOND_LIGHT).to(torch.float64)


def _opened(core: Core) -> tuple[Polynomial, Callable[[Polynomial], Core]]:
    """Return the polynomial that holds the transmittance, and a function that makes a core with another one."""
    if isinstance(core, (InvariantPolynomial, MirrorPolynomial)):
        return core, lambda new: new
    if isinstance(core, (Phased, Refracted)):
        inner, closed = _opened(core.parts[0])
        return inner, lambda new: replace(core, parts=(closed(new),))
    network = core.parts[1] if isinstance(core, Residual) else core
    assert isinstance(network, Network)
    weight, bias = (a.copy() for a in network.output)
    weight[network.ab_rows], bias[network.ab_rows] = 0.0, 0.0
    silent = replace(network, output=(weight, bias))
    if isinstance(core, Residual):
        return core.parts[0], lambda new: Residual((new, silent))
    kind, shape = (MirrorPolynomial, (3, 2, 2, 0)) if network.mirror else (InvariantPolynomial, (3, 2, 0))
    nothing = kind(
        np.zeros((0, len(network.shift)), np.int64), np.zeros(shape), np.zeros((len(bias) - network.ab_rows, 0))
    )
    return nothing, lambda new: Residual((new, silent))


def _chosen(fields: Sequence[tuple[Tensor, ...]], known: Exponents, most: int, *, dispersive: bool) -> Exponents:
    """Choose terms [K, V] for all fields (invariants, transmittance, weights), known ones and others."""
    variables = known.shape[1] - 1
    degree = _DEGREE[variables]
    reach = range(MOST_W + 1 if dispersive else 1)
    rows = [(*p, w) for w in reach for p in powers(variables, max(degree - w, _BESIDE_W))]
    candidates, _ = united([known, ordered(rows)])
    some = [[part[..., :_CHOICE_RAYS] for part in field] for field in fields]
    sweep = Sweep.joined([Sweep.of_columns(monomials(v, candidates) * w, (t * w)[None]) for v, t, w in some])
    count = sum(len(w) for *_, w in some)

    def enough(residual: float, terms: int) -> bool:
        return residual <= (FINE if terms < _CHEAP else TRANSMITTANCE_ERROR) ** 2 * count

    for terms in range(1, most + 1):
        forward(sweep, terms)
        if enough(sweep.residual, terms):
            break
    replace_terms(sweep, _PASSES)
    while len(some) == 1 and enough(sweep.residual + (costs := sweep.costs()).min(), len(sweep.chosen) - 1):
        sweep.drop(sweep.chosen[int(costs.argmin())])
    return candidates[sorted(sweep.chosen) or [0]]
