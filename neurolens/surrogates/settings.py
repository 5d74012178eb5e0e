"""The settings of a surrogate."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from neurolens.base.errors import InputError
from neurolens.surrogates.cores import Basis

Method = Literal["thin", "thick", "dense", "omp", "ols", "adaptive", "mlp", "ols+mlp"]
POLYNOMIALS = ("dense", "omp", "ols", "adaptive")
NETWORKS = ("mlp", "ols+mlp")
PLANES_SEARCHED = ("ols", "adaptive", "ols+mlp")
# About 5000 candidate columns, whose Gram matrix takes 200 MB.
_MOST_DEGREE = {"invariants": 16, "raw": 11}


@dataclass(frozen=True)
class ModelSettings:
    """One surrogate of an experiment.

    Attributes:
        name: of the file and of the table's row; made from the other settings where empty.
        method: "thin", "thick" (first order); polynomials: "dense" (all terms up to `degree`), "omp" (matching
            pursuit), "ols" (orthogonal least squares with replacement), "adaptive" (terms of any degree grown from
            chosen terms); "mlp"; "ols+mlp" (a polynomial and a network on what it leaves).
        basis: of polynomials: "invariants" (rotational symmetry held exactly) or "raw" (p_x, p_y, u_x, u_y, w).
        terms: coefficients per vector output; ignored by "dense".
        degree: largest total degree of the candidates that a fit starts from; ignored by "adaptive".
        replacement: whether "ols" exchanges terms afterwards.
        elimination: whether "ols" first chooses half as many terms again, and drops those that cost least.
        growth: rounds in which "ols" in the invariants adds to the candidates what the chosen terms give, multiplied by
            each variable: terms of higher degree where they help. From 2 on a few more follow where directions err yet.
        position_weight: how much more than to first order the position counts in the choice of terms.
        transmittance_terms: how many more terms the transmittance may have where it needs them.
        idle_gates: rims that alone block at most this share of the domain's rays are left out.
        planes: whether `PLANES_SEARCHED` methods in the invariants search the planes of the light field.
        partitions: zones of the film with a fit of their own (polynomials and networks).
        units, layers: of the network.
        steps: most iterations of a network's training, which ends before where it has converged; never a time, so that
            a machine gives the same bytes whatever its load. One on n times the fewest rays counts n (see
            `fits.network`).
        seed: of the network's first weights.

    Raises:
        InputError: numbers that ask for more than a fit can hold, or for less than one.
    """

    method: Method = "ols"
    name: str = ""
    basis: Basis = "invariants"
    terms: int = 40
    degree: int = 7
    replacement: bool = True
    elimination: bool = True
    growth: int = 2
    position_weight: float = 2.0
    transmittance_terms: int = 16
    idle_gates: float = 0.0
    planes: bool = True
    partitions: int = 1
    units: int = 16
    layers: int = 2
    steps: int = 400
    seed: int = 0

    def __post_init__(self) -> None:
        most_degree = _MOST_DEGREE[self.basis] if self.basis in _MOST_DEGREE else min(_MOST_DEGREE.values())
        limits = {
            "terms": (1, 2000),
            "degree": (0, most_degree),
            "growth": (0, 16),
            "transmittance_terms": (0, 200),
            "partitions": (1, 64),
            "units": (1, 512),
            "layers": (1, 8),
            "steps": (1, 100_000),
        }
        for name, (least, most) in limits.items():
            if not least <= getattr(self, name) <= most:
                raise InputError("settings", name, getattr(self, name), f"an integer from {least} to {most}")
        if not 0 <= self.idle_gates < 1:
            raise InputError("settings", "idle_gates", self.idle_gates, "a share from 0 to below 1")
        if not 0 < self.position_weight < math.inf:
            raise InputError("settings", "position_weight", self.position_weight, "a number above 0")

    @property
    def label(self) -> str:
        """The name, or one made from the settings: "ols-40", "raw-omp-80", "dense-d4", "mlp-16x2"."""
        if self.name:
            return self.name
        zones = f"-{self.partitions}zones" if self.partitions > 1 else ""
        if self.method in NETWORKS:
            before = f"ols-{self.terms}-" if self.method == "ols+mlp" else ""
            return f"{before}mlp-{self.units}x{self.layers}{zones}"
        if self.method in ("thin", "thick"):
            return self.method
        size = f"-d{self.degree}" if self.method == "dense" else f"-{self.terms}"
        return f"{'raw-' if self.basis == 'raw' else ''}{self.method}{size}{zones}"

    @property
    def family(self) -> str:
        return "paraxial" if self.method in ("thin", "thick") else self.method
