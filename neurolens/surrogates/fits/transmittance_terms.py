"""Further terms for the transmittance, where those of the ray tell it badly.

Absorption and coatings change with the wavelength faster than any ray's path does, and near grazing rays faster with
the ray: powers of the wavelength and a few products that position and direction have no use for.
"""

from __future__ import annotations

import itertools

import numpy as np

from neurolens.surrogates.bases import Exponents, invariant_exponents, monomials, solve
from neurolens.surrogates.fits.boundaries import FitData
from neurolens.surrogates.fits.selection import Sweep

TRANSMITTANCE_ERROR = 2.5e-4  # RMS at which no term is added
_RAYS = 6000
_DEGREE, _MOST_W = 7, 8  # of the candidates
_LEAST_GAIN = 0.03  # a term must take away this share of the squared error left


def transmittance_terms(data: FitData, exponents: Exponents, most: int) -> Exponents:
    """[K, 4] further exponents, at most `most`, by forward selection beside those given [M, 4]; often none."""
    rays = data.pairs.train.select(slice(0, _RAYS))
    none = exponents[:0]
    if most == 0 or len(rays) < 2 * (len(exponents) + most):
        return none
    invariants, wanted = data.encoding(rays.inputs).invariants(), rays.transmittance[None]
    features = monomials(invariants, exponents)
    left = wanted - solve(features, wanted) @ features
    allowed = TRANSMITTANCE_ERROR**2 * len(rays)
    if not float((left**2).sum()) > allowed:
        return none
    known = {tuple(e) for e in exponents.tolist()}
    offered = [tuple(e) for e in _candidates(dispersive=data.encoding.w_half != 0).tolist()]
    new = np.array([e for e in offered if e not in known], dtype=np.int64).reshape(-1, 4)
    features = monomials(invariants, np.concatenate([exponents, new]))
    sweep = Sweep((features @ features.T).numpy(), (features @ wanted.T).numpy(), (wanted**2).sum(1).numpy())
    for k in range(len(exponents)):
        if sweep.scores("ols")[k] >= 0:
            sweep.add(k)
    chosen: list[int] = []
    while len(chosen) < most and sweep.residual > allowed:
        scores = sweep.scores("ols")
        best = int(scores.argmax())
        if not scores[best] > _LEAST_GAIN * sweep.residual:
            break
        sweep.add(best)
        chosen.append(best - len(exponents))
    return new[[k for k in chosen if k >= 0]]


def _candidates(*, dispersive: bool) -> Exponents:
    plain = invariant_exponents(_DEGREE, dispersive=dispersive)
    if not dispersive:
        return plain
    low = [p for p in itertools.product(range(2), repeat=3) if sum(p) <= 1]
    colours = np.array([(*p, w) for w in range(1, _MOST_W + 1) for p in low], dtype=np.int64)
    return np.unique(np.concatenate([plain, colours]), axis=0)
