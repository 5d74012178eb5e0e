"""The core of a copy whose elements are off the axis, and the core of a model that can be set to any copy of its lens.

A vector e across the axis (an element's decentre, or where its axis leans) changes every output vector, to first order,
by the most general form that the symmetry of a round lens leaves:

    (f1 I + f2 p p' + f3 p u' + f4 u p' + f5 u u') e,   a gate by  (h1 p + h2 u) . e,

with functions f and h of the invariants. All perturbations share the terms of f and h. So each
coefficient of a copy is a sum over its perturbations, and a copy costs the same however many figures are off. What
leaves a lens round (a thickness, a radius, an index) changes the coefficients of its own polynomial.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import Self

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.graph.ir import Exponents, Graph, Value
from neurolens.models.axes import STATE
from neurolens.models.cores import (
    ROUND,
    Array,
    Composite,
    CoreValues,
    Field,
    InvariantPolynomial,
    Symmetric,
    Units,
    stored_as,
    without_w,
)
from neurolens.models.model import LensModel
from neurolens.optics.setting.copies import Off, figure_names

FORMS = 5  # I, p p', p u', u p', u u'


@stored_as("copy")
@dataclass(frozen=True, eq=False)
class Copied(Symmetric):
    """The polynomial of a round lens, and how elements off its axis change it.

    Attributes:
        exponents, ab, scalars: as of `InvariantPolynomial`.
        bends: [3, 5, 2, M] for each vector the coefficients of f1 to f5, times x and y of e, summed over all
            perturbations.
        leans: [G, 2, 2, M] the same for each gate, of h1 and h2.
    """

    bends: Array
    leans: Array
    _forms = ROUND

    @cached_property
    def coefficients(self) -> int:
        return sum(int((a != 0).sum()) for a in (self.ab, self.scalars, self.bends, self.leans))

    @cached_property
    def coefficients_per_vector(self) -> int:
        return int(((self.ab[:2] != 0).sum((1, 2)) + (self.bends[:2] != 0).sum((1, 2, 3))).max())

    @cached_property
    def serves(self) -> NDArray[np.bool_]:
        used = [(a != 0).any((0, 1, 2)) for a in (self.ab[:, :, None], self.bends, self.leans)]
        return np.asarray(np.any([*used, (self.scalars[1:] != 0).any(0)], axis=0))

    def fixed(self, w: float) -> Self:
        _, merge = without_w(self.exponents, w)
        return replace(super().fixed(w), bends=self.bends @ merge, leans=self.leans @ merge)

    def keep(self, scalars: Sequence[int]) -> Self:
        return replace(super().keep(scalars), leans=self.leans[[k - 1 for k in scalars[1:]]])

    def build(self, g: Graph, field: Field, units: Units) -> CoreValues:
        count, terms = len(self.scalars), len(self.exponents)
        bends = self.bends * np.array(units.vectors).reshape(3, 1, 1, 1)
        forms = np.concatenate([bends.reshape(-1, 2, terms), (self.leans * units.gates).reshape(-1, 2, terms)])
        used = np.flatnonzero((forms != 0).any((1, 2))).tolist()
        rows = self.rows(g, field, units, [forms[used].reshape(-1, terms)])
        *ab, scalars, own = g.split(rows, [1] * 6 + [count, 2 * len(used)])
        across = {k: own[2 * i : 2 * i + 2] for i, k in enumerate(used)}

        def along(k: int, row: Value) -> Value:
            """Add to a row the products of p and u with the vectors k and k + 1.

            The products are summed row by row: ONNX makes a scalar product of squares of sums, which loses digits where
            the factors differ much in size.
            """
            for number, ray in ((k, field.p), (k + 1, field.u)):
                if number in across:
                    both = ray * across[number]
                    row = row + both[0] + both[1]
            return row

        vectors = []
        for v in range(3):
            first = FORMS * v
            out = along(first + 1, ab[v]) * field.p + along(first + 3, ab[3 + v]) * field.u
            vectors.append(out + across[first] if first in across else out)
        gates = [along(3 * FORMS + 2 * k, scalars[1 + k]) for k in range(count - 1)]
        light = self.light(g, field)
        through = scalars[0] if light is None else scalars[0] + light
        return CoreValues((vectors[0], vectors[1], vectors[2]), through, g.concat(*gates) if gates else None)


@stored_as("perturbed")
@dataclass(frozen=True, eq=False)
class Perturbed(Composite):
    """The core of a round lens, with its derivatives by what may be off in a copy; by itself it is that round core.

    Attributes:
        parts: the round core, of M terms.
        exponents: [K, 4] its terms, and others below them.
        bends, leans: [V, 3, 5, K] and [V, G, 2, K] the coefficients of f and h for each vector across the axis.
        ab, scalars: [P, 3, 2, K] and [P, 1 + G, K] what each figure that leaves the lens round adds to the polynomial.
        limits: [F] how far each of `Off.figures` may be off where it is an input of exported files; 0 where it is none.
    """

    parts: tuple[InvariantPolynomial]
    exponents: Exponents
    bends: Array
    leans: Array
    ab: Array
    scalars: Array
    limits: Array

    def __post_init__(self) -> None:
        base = self.parts[0]
        if not np.array_equal(self.exponents[: len(base.exponents)], base.exponents):
            raise ValueError("terms of the derivatives that do not begin with those of the round core")

    def build(self, g: Graph, field: Field, units: Units) -> CoreValues:
        return self.parts[0].build(g, field, units)

    def fixed(self, w: float) -> Self:
        base = self._widened.fixed(w)
        _, merge = without_w(self.exponents, w)
        rows = {name: getattr(self, name) @ merge for name in ("bends", "leans", "ab", "scalars")}
        return replace(self, parts=(base,), exponents=base.exponents, **rows)

    def keep(self, scalars: Sequence[int]) -> Self:
        gates = [k - 1 for k in scalars[1:]]
        return replace(super().keep(scalars), leans=self.leans[:, gates], scalars=self.scalars[:, list(scalars)])

    def copy(self, vectors: Array, scalars: Array) -> InvariantPolynomial | Copied:
        """Return the core of a copy, to first order; where nothing is off, it is the round core itself.

        Args:
            vectors: [V, 2] decentres and tilts, and scalars: [P] other figures, in the order of `bends` and of `ab`.
        """
        if not vectors.any() and not scalars.any():
            return self.parts[0]
        base = self._widened
        ab, rows = (np.tensordot(scalars, each, 1) for each in (self.ab, self.scalars))
        base = replace(base, ab=base.ab + ab, scalars=base.scalars + rows)
        if not vectors.any():
            return base
        bends, leans = (
            np.moveaxis((vectors.T @ each.reshape(len(each), -1)).reshape(2, *each.shape[1:]), 0, -2)
            for each in (self.bends, self.leans)
        )
        return Copied(base.exponents, base.ab, base.scalars, bends, leans)

    @cached_property
    def _widened(self) -> InvariantPolynomial:
        """Return the round core with coefficients of 0 for the other terms."""
        base, more = self.parts[0], len(self.exponents) - len(self.parts[0].exponents)
        ab, scalars = (np.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, more)]) for a in (base.ab, base.scalars))
        return InvariantPolynomial(self.exponents, ab, scalars)


def copy_of(model: LensModel, off: Off, name: str = "") -> LensModel:
    """Return a model of a copy of a lens, to first order; where nothing is off, its rays are the round model's.

    The copy is focused as its lens is: its film has moved by as much as its paraxial focus, and the frame with it.

    Args:
        model: one whose core is `Perturbed`, as `perturbations.with_perturbations` makes it.
        name: of the copy.

    Raises:
        InputError: another model, or figures of a lens with other elements or surfaces.
    """
    core, lens = model.core, model.lens
    if not isinstance(core, Perturbed):
        raise InputError(lens.path, "model", model.method, "one with derivatives by what is off in copies")
    given, known = (len(off.vectors), len(off.scalars)), (len(core.bends), len(core.ab))
    if given != known:
        raise InputError(lens.path, "copy", given, f"{known[0]} vectors and {known[1]} figures, as the lens has")
    named = replace(lens, name=name or f"{lens.name}, a copy")
    settings = {**model.settings, "copy": named.name}
    return replace(model, core=core.copy(off.vectors, off.scalars), lens=named, settings=settings)


def copy_inputs(model: LensModel) -> dict[str, float]:
    """Return what is off in a copy, as inputs of an exported model: names in their order, and how far each may be off.

    Only models whose core is `Perturbed` have any.
    """
    if not isinstance(model.core, Perturbed):
        return {}
    pairs = zip(figure_names(model.lens), model.core.limits.tolist(), strict=True)
    return {name: limit for name, limit in pairs if limit}


def copy_nodes(model: LensModel) -> tuple[list[LensModel], Graph, Array]:
    """Return models of one structure that are mixed into any copy, and how, as `axes.state_graph` does for a zoom.

    A copy is a linear function of what is off. The first node has every figure at its limit, so that no coefficient is
    0 that may be other than 0 in a copy; each of the others has one figure off by twice its limit.
    """
    core, inputs = model.core, copy_inputs(model)
    assert isinstance(core, Perturbed) and inputs
    limits, places = core.limits, np.flatnonzero(core.limits)
    offs = [Off.of(model.lens, limits + each) for each in (0 * limits, *np.diag(limits)[places])]
    nodes = [replace(model, core=core.copy(off.vectors, off.scalars)) for off in offs]
    g, reach = Graph(), np.array(list(inputs.values()))
    state = g.input(STATE, len(reach), per_call=True)
    within = state.between(-reach, reach)
    inside = reduce(lambda a, b: a & b, (within[k] for k in range(len(reach))))
    g.outputs = {"features": g.concat(g.constant(1.0), state * (1 / reach) - 1.0), "inside": inside}
    transform = np.eye(len(nodes))
    transform[1:, 0] = -1
    return nodes, g, transform
