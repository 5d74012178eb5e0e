"""Adaptive sparse polynomials with a partition of the light field (Zheng and Zheng 2017, The Visual Computer).

Every scalar output has terms of its own, grown from the lowest (`grow`): each chosen term brings its
products with the variables into the candidates, so that no degree limits them. Where the error stays high the light
field is divided: the cell with the largest summed error is cut in two halves of its rays, along whichever of its
coordinates leaves least, and each half is fitted anew, until the number of cells asked for is reached.

Left open by the paper and chosen here: the coordinates that may be cut are the squared film radius, the squared slope
and the product of both (rho, tau, sigma of the light field), since cuts in x or y alone would break the lens's
symmetry; cuts are at the median, and dense cubics tell which coordinate to cut; neighbours share a margin of rays; who
passes is tested as in the other polynomial methods (stop, inner and outer pupil).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from experiments.accuracy.published.data import Outputs, RawData, RawPolynomial, outer_pupil, solve_outputs
from experiments.accuracy.published.polynomials import fit_dense
from neurolens.base.errors import InputError
from neurolens.graph.ir import Graph
from neurolens.models.cores import ROUND, Composite, CoreValues, Field, Units, stored_as
from neurolens.models.pairs import PairSet
from neurolens.models.targets import film_equivalent, targets_of
from neurolens.models.terms import Exponents, Sweep, forward, further, monomials, replace_terms

# A cell's fit sees this share of its rays' range beyond a cut, so that neighbours meet.
MARGIN = 0.03
_FEWEST_RAYS = 400
# Rays that decide the choice of terms; the coefficients are fitted on all of them afterwards.
SELECTION_RAYS = 6000
_COORDINATES = (0, 2, 1)  # rho, tau, sigma: of equal errors the first is cut


@stored_as("cells")
@dataclass(frozen=True, eq=False)
class Cells(Composite):
    """A partition of the light field into two halves, each with a polynomial of its own or divided again.

    Attributes:
        variable: 0, 1 or 2: which invariant decides (rho, sigma, tau of the light field).
        threshold: rays above it are those of the second half.
        parts: the halves.
    """

    variable: int
    threshold: float
    parts: tuple[RawPolynomial | Cells, RawPolynomial | Cells]

    def build(self, g: Graph, field: Field, units: Units) -> CoreValues:
        low, high = (half.build(g, field, units) for half in self.parts)
        first = g.quadratic(field.planes, ROUND[self.variable : self.variable + 1]) <= self.threshold
        vectors = [g.select(first, a, b) for a, b in zip(low.vectors, high.vectors, strict=True)]
        gates = None if low.gates is None or high.gates is None else g.select(first, low.gates, high.gates)
        return CoreValues(tuple(vectors), g.select(first, low.transmittance, high.transmittance), gates)  # type: ignore[arg-type]


@dataclass
class _Node:
    """A cell while the tree grows: its rays, and once cut the two halves."""

    data: RawData
    inside: Tensor  # [N] bool, of all training rays
    polynomial: RawPolynomial
    error: float
    cut: tuple[int, float, _Node, _Node] | None = None

    def leaves(self) -> list[_Node]:
        return [self] if self.cut is None else [*self.cut[2].leaves(), *self.cut[3].leaves()]

    def core(self) -> RawPolynomial | Cells:
        if self.cut is None:
            return self.polynomial
        variable, threshold, low, high = self.cut
        return Cells(variable, threshold, (low.core(), high.core()))


def fit_adaptive(
    data: RawData, terms: int, cells: int, progress: Callable[[float], object] = lambda share: None
) -> RawPolynomial | Cells:
    """`terms` terms of each scalar output in each of `cells` cells.

    Raises:
        InputError: more cells than the rays allow.
    """
    count = len(data.pairs.train)
    if cells > 1 and count < cells * _FEWEST_RAYS:
        most = max(1, count // _FEWEST_RAYS)
        raise InputError("fit", "partitions", cells, f"1 to {most} cells for {count} training rays")
    invariants = data.encoding(data.pairs.train.inputs).invariants()
    everything = torch.ones(count, dtype=torch.bool)
    root = _Node(data, everything, fit_grown(data, terms), 0.0)
    root.error = _squared_error(data, root.polynomial, data.pairs.train)
    for done in range(1, cells):
        progress(done / cells)
        worst = max(root.leaves(), key=lambda leaf: leaf.error)
        variable, threshold = _where_to_cut(data, worst, invariants)
        worst.cut = (variable, threshold, *_halves(data, worst, invariants, variable, threshold, terms))
    return root.core()


def fit_grown(data: RawData, terms: int) -> RawPolynomial:
    """Grown terms of each output by itself."""
    return solve_outputs(data.outputs, [_support(output, terms, data.dispersive) for output in data.outputs])


def _support(output: Outputs, terms: int, dispersive: bool) -> Exponents:
    known = slice(None) if output.weights is None else output.weights > 0
    variables, values = output.variables[:, known], output.values[:, known]
    return grow(variables, values, min(terms, values.shape[1] // 2), dispersive=dispersive)


def grow(variables: Tensor, outputs: Tensor, terms: int, *, dispersive: bool) -> Exponents:
    """Choose `terms` terms by growth, which knows no limit of degree: each brings its products into the candidates.

    Args:
        variables: [5, N] raw coordinates. outputs: [R, N].
        dispersive: False leaves the last variable (the wavelength) out.

    Returns the exponents [K, 5].
    """
    step = max(1, variables.shape[1] // SELECTION_RAYS)
    rays, target = variables[:, ::step], outputs[:, ::step]
    unit = np.eye(5, dtype=np.int64)[: None if dispersive else -1]
    # A component of a vector is odd in the four coordinates: a single factor leads to terms that never help.
    factors = [unit[a] + unit[b] for a in range(4) for b in range(a, 4)] + list(unit[4:])
    exponents, chosen = np.concatenate([np.zeros_like(unit[:1]), unit]), list[int]()
    while len(chosen) < terms:
        sweep = Sweep.of_columns(monomials(rays, exponents), target)
        sweep.restart(chosen)
        forward(sweep, min(terms, len(sweep.chosen) + max(1, terms // 16)))
        if len(sweep.chosen) == len(chosen):
            break
        replace_terms(sweep, passes=2)
        chosen = list(sweep.chosen)
        products = np.array([exponents[k] + factor for k in chosen for factor in factors])
        exponents = np.concatenate([exponents, further(products, exponents)])
    return exponents[chosen]


def _squared_error(data: RawData, polynomial: RawPolynomial, rays: PairSet) -> float:
    """Summed squared film-equivalent error (um^2)."""
    lens, domain, core = data.pairs.lens, data.pairs.domain, outer_pupil(data, polynomial)[0]
    targets = targets_of(lens, data.encoding, rays)
    fitted, wanted = (film_equivalent(lens, domain, v) for v in (core(targets.field)[0], targets.vectors))
    return float(((fitted - wanted) ** 2).sum())


def _halves(
    data: RawData, cell: _Node, invariants: Tensor, variable: int, threshold: float, terms: int | None = None
) -> tuple[_Node, _Node]:
    """Both sides of a cut, with grown terms, or with dense cubics."""

    def half(above: bool) -> _Node:
        inside = cell.inside & ((invariants[variable] > threshold) == above)
        zone = _zone(cell.data, variable, threshold, above)
        polynomial = fit_dense(zone, 3) if terms is None else fit_grown(zone, terms)
        return _Node(zone, inside, polynomial, _squared_error(data, polynomial, data.pairs.train.select(inside)))

    return half(False), half(True)


def _where_to_cut(data: RawData, cell: _Node, invariants: Tensor) -> tuple[int, float]:
    """The coordinate whose halves dense cubics fit best, and the median there."""
    best, found = float("inf"), (0, 0.0)
    for variable in _COORDINATES:
        threshold = float(invariants[variable][cell.inside].median())
        error = sum(half.error for half in _halves(data, cell, invariants, variable, threshold))
        if error < best:
            best, found = error, (variable, threshold)
    return found


def _zone(data: RawData, variable: int, threshold: float, above: bool) -> RawData:
    """The rays of one side of a cut, with a margin; about the rims all of them where too few are left."""

    def side(rays: PairSet, fewest: int) -> PairSet:
        values = data.encoding(rays.inputs).invariants()[variable]
        margin = MARGIN * float(values.max() - values.min())
        kept = values > threshold - margin if above else values <= threshold + margin
        return rays.select(kept) if int(kept.sum()) >= fewest else rays

    pairs = data.pairs
    zone = replace(pairs, train=side(pairs.train, 1), rim=side(pairs.rim, _FEWEST_RAYS))
    return RawData(zone, data.encoding)
