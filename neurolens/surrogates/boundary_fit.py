"""What every polynomial fits on the terms that are there anyway: stop crossing, transmittance and gates."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from neurolens import status as st
from neurolens.surrogates.bases import Exponents, monomials, solve, vector_columns
from neurolens.surrogates.gates import boundary_rays, gate_reach, gate_values
from neurolens.surrogates.lightfield import Encoding, LightField
from neurolens.surrogates.model import Gate
from neurolens.surrogates.pairs import PairSet, RayPairs
from neurolens.surrogates.targets import Targets, targets_of

# Only the neighbourhood of a rim decides who passes: rows of the gate fit weigh 1 / sqrt(1 + (g / width)^2).
GATE_WIDTH = 0.1


@dataclass(frozen=True)
class FitData:
    """What every polynomial fit of one set of ray pairs shares."""

    pairs: RayPairs
    encoding: Encoding
    gates: tuple[Gate, ...]

    @property
    def train(self) -> Targets:
        return targets_of(self.pairs.lens, self.encoding, self.pairs.train)

    @cached_property
    def boundary(self) -> PairSet:
        """The rays on which gates and the stop crossing are fitted."""
        return boundary_rays(self.pairs, self.gates)

    @property
    def boundary_field(self) -> LightField:
        return self.encoding(self.boundary.inputs)


def fit_stop(data: FitData, exponents: Exponents) -> Tensor:
    """[2 M]: A and B of the stop crossing (in stop radii) on the monomials given, from rays on both sides of rims."""
    crossing, weight = stop_crossing(data)
    field = data.boundary_field
    columns = vector_columns(monomials(field.invariants(), exponents), field)
    return solve(columns, crossing.reshape(1, -1), None if weight is None else weight.repeat(2))[0]


def stop_crossing(data: FitData) -> tuple[Tensor, Tensor | None]:
    """[2, N] crossings of the boundary rays in stop radii, and their weights [N]: 0 for rays lost before the stop."""
    pairs, lens = data.boundary, data.pairs.lens
    crossing = torch.stack([pairs.cross_x[lens.stop_index], pairs.cross_y[lens.stop_index]]) / lens.stop_radius_mm
    arrives = gate_reach((Gate(lens.stop_index, st.RIM),), pairs)[0]
    return crossing, None if arrives.all() else arrives.to(crossing.dtype)


def fit_scalars(data: FitData, exponents: Exponents) -> Tensor:
    """[1 + G, M]: transmittance and gates on the monomials of the invariants given."""
    train = data.train
    boundary_features = monomials(data.boundary_field.invariants(), exponents)
    return solve_scalars(data, monomials(train.field.invariants(), exponents), train.transmittance, boundary_features)


def solve_scalars(data: FitData, features: Tensor, transmittance: Tensor, boundary_features: Tensor) -> Tensor:
    """Transmittance on the passing rays, each gate on the rays that get as far, most on those near its boundary."""
    rows = [solve(features, transmittance[None])]
    values, known = gate_values(data.pairs.lens, data.gates, data.boundary), gate_reach(data.gates, data.boundary)
    for value, arrives in zip(values, known, strict=True):
        weight = (1 / torch.sqrt(1 + (value / GATE_WIDTH) ** 2)).where(arrives, 0.0)
        rows.append(solve(boundary_features, value[None], weight))
    return torch.cat(rows)
