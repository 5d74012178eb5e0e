"""The cores of surrogates: polynomials in the invariants, small networks, and sums of both.

A core maps a light field to vectors (position, direction, stop crossing) and scalars (transmittance, gates). It is
plain data with one method that writes it into a graph (`neurolens.graph`); every evaluator and writer reads that. A new
kind of core is one class here with its name in files (`stored_as`).

A light field has the coordinates of a ray on two planes fixed to the glass, centred and scaled: its crossing p with a
plane near the film and u with the pupil plane. Free space is linear, so another film position only moves where the ray
starts. For a rotationally symmetric lens every output vector is

    out = A(rho, sigma, tau, w) p + B(rho, sigma, tau, w) u,   rho = p.p,  sigma = p.u,  tau = u.u,

which holds the symmetry and the mirror symmetry exactly and has no singular point on the axis. A lens with cylinders
keeps its two planes of symmetry only: then x (and y likewise) of every vector is

    out_x = A_x(q) p_x + B_x(q) u_x,   q = p_x^2, p_x u_x, u_x^2, p_y^2, p_y u_y, u_y^2, w.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from operator import add
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self, TypeVar

import numpy as np
from numpy.polynomial import Polynomial
from numpy.polynomial.chebyshev import cheb2poly
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Exponents, Form, Graph, Value
from neurolens.optics.trace.arithmetic import Graphs

if TYPE_CHECKING:
    from torch import Tensor


Array = NDArray[np.float64]
# Order of the vectors of every core.
POSITION, DIRECTION, STOP = 0, 1, 2


# Invariants as pairs of the rows p_x, p_y, u_x, u_y: rho, sigma, tau. Of two mirrors those of x, then of y.
ROUND: tuple[Form, ...] = (((0, 0), (1, 1)), ((0, 2), (1, 3)), ((2, 2), (3, 3)))
MIRROR: tuple[Form, ...] = tuple(((a, b),) for i in (0, 1) for a, b in ((i, i), (i, 2 + i), (2 + i, 2 + i)))


class LightField(NamedTuple):
    """Scaled coordinates of N rays: p and u [2, N] within about the unit disc, w [N] in [-1, 1]."""

    p: Tensor
    u: Tensor
    w: Tensor

    def __len__(self) -> int:
        """Return the number of rays."""
        return self.w.shape[0]

    def invariants(self, mirror: bool = False) -> Tensor:
        """Return the rotational invariants rho, sigma and tau, and w, [4, N].

        With `mirror` return the invariants of two planes of symmetry, [7, N]: p_x^2, p_x u_x, u_x^2, those in y, and w.
        """
        import torch

        rows = (*self.p, *self.u)
        sums = (reduce(add, (rows[i] * rows[j] for i, j in form)) for form in (MIRROR if mirror else ROUND))
        return torch.stack([*sums, self.w])


def angle_vector(dx: Tensor, dy: Tensor, dz: Tensor) -> Tensor:
    """Return v = theta (dx, dy) / |(dx, dy)| [2, N] with theta from -z: smooth through 90 degrees, equivariant."""
    import torch

    sine = torch.hypot(dx, dy)
    # theta / sine tends to 1 on the axis; the guard also keeps the exact axis finite.
    theta = torch.atan2(sine, -dz)
    ratio = torch.where(sine > 1e-12, theta / torch.where(sine > 1e-12, sine, 1.0), 1.0)
    return torch.stack([ratio * dx, ratio * dy])


@dataclass(frozen=True)
class Field:
    """The light field in a graph.

    Attributes:
        planes: rows p_x, p_y, u_x, u_y, and v where w = v^2 + w_bias.
        w_bias: see `planes`. w: the wavelength's variable itself, where there is no v. Without both, w is 0.
    """

    planes: Value
    w_bias: float = 0.0
    w: Value | None = None

    @property
    def p(self) -> Value:
        return self.planes[0:2]

    @property
    def u(self) -> Value:
        return self.planes[2:4]

    @property
    def dispersive(self) -> bool:
        return self.w is not None or self.planes.rows == 5

    def products(self, forms: Sequence[Form]) -> Value:
        """Return sums of products of the rows p and u, and below them w where it varies."""
        g = self.planes.graph
        if self.w is not None:
            return g.concat(g.quadratic(self.planes, forms), self.w)
        if self.planes.rows == 5:
            return g.quadratic(self.planes, [*forms, ((4, 4),)], [*np.zeros(len(forms)), self.w_bias])
        return g.quadratic(self.planes, forms)

    def colour(self) -> Value:
        """Return w, which must vary, as it is given or from the fifth row of the planes."""
        return self.w if self.w is not None else self.planes.graph.quadratic(self.planes, [((4, 4),)], [self.w_bias])


@dataclass(frozen=True)
class Units:
    """Factors on a core's outputs, folded into its coefficients: on the three vectors, and on the gates."""

    vectors: tuple[float, float, float] = (1.0, 1.0, 1.0)
    gates: float = 1.0

    def scalars(self, count: int) -> Array:
        """Return the factors [count] on the scalars: transmittance, then gates."""
        return np.array([1.0, *[self.gates] * (count - 1)])


@dataclass(frozen=True)
class CoreValues:
    """The outputs of a core: three vectors (2 rows each), transmittance, gates (a row each; None without any).

    `unit`: the unit direction (3 rows) where a core gives it instead of `vectors[DIRECTION]`. `index`: the index of the
    front glass, where the direction is that inside it (see `Refracted`). `path_um`: see `Phased`.
    """

    vectors: tuple[Value, Value, Value]
    transmittance: Value
    gates: Value | None
    unit: Value | None = None
    index: Value | None = None
    path_um: Value | None = None


_CoreType = TypeVar("_CoreType", bound=type)
# Cores by the name that files carry. Their fields are float and integer arrays, numbers, tuples and other cores.
CORES: dict[str, type[Core]] = {}


def stored_as(name: str) -> Callable[[_CoreType], _CoreType]:
    """Return a decorator of a core's class; it gives the class the name that model files carry."""

    def register(kind: _CoreType) -> _CoreType:
        CORES[name] = kind
        return kind

    return register


class Core:
    """The base of all cores; their numbers are float64 numpy arrays. `basis` is a word for cards."""

    basis: ClassVar[str] = "invariants"

    def build(self, g: Graph, field: Field, units: Units) -> CoreValues:
        """Append the core to a graph."""
        raise NotImplementedError

    def fixed(self, w: float) -> Self:
        """Return the core for one value of w, whose powers are folded into the coefficients; its w is then 0."""
        raise InputError("export", "fix", type(self).__name__, "nothing fixed: a published method is written whole")

    def keep(self, scalars: Sequence[int]) -> Self:
        """Return the core without its other scalars."""
        raise InputError("export", "fix", type(self).__name__, "nothing fixed: a published method is written whole")

    @property
    def coefficients(self) -> int:
        """Return the number of coefficients that are not 0; of a network, the number of its weights."""
        raise NotImplementedError

    @property
    def coefficients_per_vector(self) -> int:
        """Return the coefficients of position or of direction, whichever has more (A and B terms both count)."""
        return self.coefficients

    def __call__(self, field: LightField) -> tuple[Tensor, Tensor]:
        """Return vectors [3, 2, N] and scalars [1 + G, N] of a light field of tensors, in its precision."""
        import torch

        out = evaluate(self._graph, {"p": field.p, "u": field.u, "w": field.w[None]})
        direction = angle_vector(*out["unit"]) if "unit" in out else out["direction"]
        vectors = [v.expand(2, len(field)) for v in (out["position"], direction, out["stop"])]
        return torch.stack(vectors), out["scalars"].expand(-1, len(field))

    @cached_property
    def _graph(self) -> Graph:
        g = Graph()
        values = self.build(g, Field(g.concat(g.input("p", 2), g.input("u", 2)), w=g.input("w")), Units())
        g.outputs = dict(zip(("position", "direction", "stop"), values.vectors, strict=True))
        if values.unit is not None:
            g.outputs["unit"] = values.unit
        gates = [] if values.gates is None else [values.gates]
        g.outputs["scalars"] = g.concat(values.transmittance, *gates)
        return g


def symmetric(rows: Value, field: Field, scalars: int, light: Value | None = None) -> CoreValues:
    """Make vectors A p + B u and scalars of rows, which are A of each vector, B of each, then the scalars.

    With two planes of symmetry each A and each B is two rows, for x and y. `light` is added to the transmittance.
    """
    g, wide = rows.graph, (rows.rows - scalars) // 6
    *ab, transmittance, gates = g.split(rows, [wide] * 6 + [1, scalars - 1])
    p, u = field.p, field.u
    vectors = tuple(a * p + b * u for a, b in zip(ab[:3], ab[3:], strict=True))
    through = transmittance if light is None else transmittance + light
    return CoreValues(vectors, through, gates if scalars > 1 else None)  # type: ignore[arg-type]


def without_w(exponents: Exponents, w: float) -> tuple[Exponents, Array]:
    """Return the terms [U, V] that are left of [M, V] when w is known, and the matrix [M, U] that sums coefficients."""
    rest = exponents.copy()
    rest[:, -1] = 0
    unique, place = np.unique(rest, axis=0, return_inverse=True)
    merge = np.zeros((len(rest), len(unique)))
    merge[np.arange(len(rest)), place.reshape(-1)] = w ** exponents[:, -1].astype(float)
    return unique, merge


@dataclass(frozen=True, eq=False)
class Symmetric(Core):
    """Polynomials in invariants for the scalars and for A and B of A p + B u: `ab` [3, 2, .., M], `scalars` [S, M].

    The last column of the exponents is that of w.
    """

    exponents: Exponents
    ab: Array
    scalars: Array
    _forms: ClassVar[tuple[Form, ...]]

    def fixed(self, w: float) -> Self:
        exponents, merge = without_w(self.exponents, w)
        return replace(self, exponents=exponents, ab=self.ab @ merge, scalars=self.scalars @ merge)

    def plus(self, ab: Array, scalars: Array) -> Self:
        """Return the polynomial with constants added to `ab` [3, 2, ..] and to the scalars [S]."""
        exponents, more = self.exponents, [ab[..., None], scalars[:, None]]
        constant = (exponents == 0).all(1)
        if constant.any():
            both = (old + new * constant for old, new in zip((self.ab, self.scalars), more, strict=True))
        else:
            exponents = np.concatenate([exponents, np.zeros((1, exponents.shape[1]), np.int64)])
            both = (np.concatenate(pair, -1) for pair in zip((self.ab, self.scalars), more, strict=True))
        return replace(self, exponents=exponents, **dict(zip(("ab", "scalars"), both, strict=True)))

    def keep(self, scalars: Sequence[int]) -> Self:
        return replace(self, scalars=self.scalars[list(scalars)])

    @cached_property
    def coefficients(self) -> int:
        return int((self.ab != 0).sum() + (self.scalars != 0).sum())

    def rows(self, g: Graph, field: Field, units: Units, more: Sequence[Array] = ()) -> Value:
        """Return the rows of A for the three vectors, then of B, then the scalars without `light`.

        Behind them stand the rows with `more` coefficients [R, M].

        No terms in w are written where it is 0.
        """
        ab = self.ab * np.array(units.vectors).reshape(3, *[1] * (self.ab.ndim - 1))
        scalars = self.scalars * units.scalars(len(self.scalars))[:, None]
        a, b = (ab[:, k].reshape(-1, len(self.exponents)) for k in (0, 1))
        x, weight = field.products(self._forms), np.concatenate([a, b, scalars, *more])
        used = ~self._coloured if field.dispersive else self.exponents[:, -1] == 0
        return g.polynomial(self.exponents[used][:, : x.rows], weight[:, used], x)

    @cached_property
    def serves(self) -> NDArray[np.bool_]:
        """Return which terms [M] serve another output than the transmittance."""
        ab = (self.ab != 0).any(axis=tuple(range(self.ab.ndim - 1)))
        return np.asarray(ab | (self.scalars[1:] != 0).any(0))

    @property
    def _coloured(self) -> NDArray[np.bool_]:
        return ~self.serves & (self.exponents[:, -1] > 0)

    def light(self, g: Graph, field: Field) -> Value | None:
        """Return the part of the transmittance with powers of w that no other output has; None without any.

        It is the sum of q_j(w) T_j(T_4(w)) over j, where T are Chebyshev polynomials and q_j are cubics, whose
        coefficients are short polynomials in the ray. Powers of w up to 20 would cancel, so that float32 would lose up
        to 3e-3 of the light at 380 nm. This sum loses 3e-6 and takes hardly longer.
        """
        terms, powers = self.exponents[self._coloured], self.exponents[self._coloured, -1]
        if not field.dispersive or not len(terms):
            return None
        exponents, place = np.unique(terms[:, :-1], axis=0, return_inverse=True)
        count = int(powers.max()) // 4 + 1
        weight = np.zeros((4 * count, len(exponents)))
        weight[powers, place.reshape(-1)] = self.scalars[0, self._coloured]
        x = field.products(self._forms)
        rows, w = g.polynomial(exponents, in_cubics(weight), x[0 : x.rows - 1]), x[x.rows - 1]
        cubics = reduce(lambda total, row: total * w + row, reversed(g.split(rows, [count] * 4)))
        return Graphs(g).chebyshev(g.series(w, cheb2poly([0, 0, 0, 0, 1])), [cubics[j] for j in range(count)])

    def build(self, g: Graph, field: Field, units: Units) -> CoreValues:
        return symmetric(self.rows(g, field, units), field, len(self.scalars), self.light(g, field))


def in_cubics(weight: Array) -> Array:
    """Return the coefficients of w^k T_j(T_4(w)) [4 J, M], k = 0 to 3 and j fastest, for those of powers of w."""
    t4, size = Polynomial(cheb2poly([0, 0, 0, 0, 1])), len(weight)
    outer = [Polynomial(cheb2poly(row))(t4).coef for row in np.eye(size // 4)]
    basis = [np.pad(row, (k, size))[:size] for row in outer for k in range(4)]  # degree by degree: zeros stay zeros
    found = np.linalg.solve(np.transpose(basis), weight).reshape(-1, 4, weight.shape[1])
    return np.asarray(found.swapaxes(0, 1).reshape(weight.shape), np.float64)


@stored_as("invariants")
@dataclass(frozen=True, eq=False)
class InvariantPolynomial(Symmetric):
    """The polynomial of a round lens: out = A p + B u; A, B and the scalars are polynomials in rho, sigma, tau, w.

    Attributes:
        exponents: [M, 4] int64 of rho, sigma, tau, w; rows are unique.
        ab: [3, 2, M]: for each vector, the coefficients of A and of B.
        scalars: [S, M].
    """

    _forms = ROUND

    @cached_property
    def coefficients_per_vector(self) -> int:
        return int((self.ab[:2] != 0).sum((1, 2)).max())


@stored_as("mirror")
@dataclass(frozen=True, eq=False)
class MirrorPolynomial(Symmetric):
    """The polynomial of a lens with two planes of symmetry: out_x = A_x p_x + B_x u_x, and y likewise.

    Attributes:
        exponents: [M, 7] int64 of p_x^2, p_x u_x, u_x^2, the same of y, w; rows are unique.
        ab: [3, 2, 2, M]: for each vector, A and B, of x and of y.
        scalars: [S, M].
    """

    basis = "mirror"
    _forms = MIRROR

    @cached_property
    def coefficients_per_vector(self) -> int:
        """Count the coefficients of a vector's two components together, the larger of position and direction."""
        return int((self.ab[:2] != 0).sum((1, 2, 3)).max())


@stored_as("network")
@dataclass(frozen=True, eq=False)
class Network(Core):
    """A multilayer perceptron from the invariants to the coefficients A and B of each vector and to the scalars.

    Attributes:
        hidden: weight [units, inputs] and bias [units] of each tanh layer; the first takes scaled invariants.
        output: weight [6 + S, units] and bias [6 + S]; rows 2 v and 2 v + 1 are A and B of vector v, then the scalars.
            The bias of those rows is the constant part of A and B. A lens with cylinders has 12 + S rows: for each
            vector A and B of x, then of y.
        shift, scale: [4] each: the network sees (invariants - shift) * scale; [7] of a lens with cylinders.
    """

    hidden: tuple[tuple[Array, Array], ...]
    output: tuple[Array, Array]
    shift: Array
    scale: Array

    @property
    def mirror(self) -> bool:
        """Return whether it stands for a lens with cylinders."""
        return len(self.shift) == 7

    @property
    def ab_rows(self) -> int:
        """Return the number of outputs before the scalars."""
        return 12 if self.mirror else 6

    def rows(self, g: Graph, field: Field, units: Units, added: Value | None = None) -> Value:
        """Return the rows of A for the three vectors, then of B, then the scalars.

        The rows of `added`, in the same order, are added to them.
        """
        h = field.products(MIRROR if self.mirror else ROUND)
        for k, (weight, bias) in enumerate(self.hidden):
            if k == 0:  # shift and scale are folded into it; without dispersion the last invariant is 0
                weight = weight * self.scale
                bias = bias - (weight * self.shift).sum(1)
                weight = weight[:, : h.rows]
            h = g.affine(weight, h, bias).tanh()
        weight, bias = self.output
        n, axes = self.ab_rows, self.ab_rows // 6
        order = [*range(0, n, 2), *range(1, n, 2), *range(n, len(weight))]  # A of the three vectors, then B
        vectors = np.repeat(units.vectors, axes)
        factors = np.concatenate([vectors, vectors, units.scalars(len(weight) - n)])
        weight, bias = factors[:, None] * weight[order], factors * bias[order]
        return g.affine(weight, h, bias, added=added)

    def build(self, g: Graph, field: Field, units: Units) -> CoreValues:
        return symmetric(self.rows(g, field, units), field, len(self.output[1]) - self.ab_rows)

    def fixed(self, w: float) -> Self:
        # Its input is then w = 0, which the shift makes the wanted value.
        shift = self.shift.copy()
        shift[-1] -= w
        return replace(self, shift=shift)

    def keep(self, scalars: Sequence[int]) -> Self:
        rows = [*range(self.ab_rows), *(self.ab_rows + k for k in scalars)]
        return replace(self, output=(self.output[0][rows], self.output[1][rows]))

    @cached_property
    def coefficients(self) -> int:
        return sum(w.size + b.size for w, b in (*self.hidden, self.output))


class Composite(Core):
    """A core that is made of several."""

    parts: tuple[Any, ...]

    def fixed(self, w: float) -> Self:
        return replace(self, parts=tuple(part.fixed(w) for part in self.parts))  # type: ignore[type-var]

    def keep(self, scalars: Sequence[int]) -> Self:
        return replace(self, parts=tuple(part.keep(scalars) for part in self.parts))  # type: ignore[type-var]

    @property
    def coefficients_per_vector(self) -> int:
        """Return the coefficients of all parts together."""
        return sum(part.coefficients_per_vector for part in self.parts)

    @property
    def coefficients(self) -> int:
        return sum(part.coefficients for part in self.parts)


@stored_as("residual")
@dataclass(frozen=True, eq=False)
class Residual(Composite):
    """The sum of a polynomial and a network that is fitted to what the polynomial leaves, on the same invariants.

    The polynomial takes the bulk, which is smooth and of low degree, the network the fine structure of every output.
    """

    parts: tuple[InvariantPolynomial | MirrorPolynomial, Network]

    def build(self, g: Graph, field: Field, units: Units) -> CoreValues:
        polynomial, network = self.parts
        # The network's last bias joins the polynomial's constant, so that its last product adds the two.
        (weight, bias), n = network.output, network.ab_rows
        vectors = bias[:n].reshape(3, n // 6, 2).swapaxes(1, 2)  # A and B, each of x and y where these differ
        whole = polynomial.plus(vectors.reshape(polynomial.ab.shape[:-1]), bias[n:])
        network = replace(network, output=(weight, np.zeros_like(bias)))
        rows = network.rows(g, field, units, whole.rows(g, field, units))
        return symmetric(rows, field, len(bias) - n, whole.light(g, field))


@stored_as("refracted")
@dataclass(frozen=True, eq=False)
class Refracted(Composite):
    """A core whose rays end inside the front glass: the refraction there follows exactly, by `assemble.refracted`.

    Where rays leave the front surface at grazing angles, their direction turns as the square root of the distance to
    the grazing ray. No polynomial follows that, while the direction inside the glass is as smooth as anywhere.

    Attributes:
        parts: the one core; its direction vector is the angle vector of the ray inside the glass.
        index: [K] the index of the glass as a power series in w.
    """

    parts: tuple[Any]
    index: Array

    def build(self, g: Graph, field: Field, units: Units) -> CoreValues:
        n = g.series(field.colour(), self.index) if field.dispersive else g.constant(self.index[0])
        return replace(self.parts[0].build(g, field, units), index=n)

    def fixed(self, w: float) -> Self:
        return replace(super().fixed(w), index=np.array([np.polyval(self.index[::-1], w)]))


@stored_as("phased")
@dataclass(frozen=True, eq=False)
class Phased(Composite):
    """A core with a polynomial beside it that gives the optical path of `models.phase`.

    Attributes:
        parts: the one core, whose rays stay as they are.
        exponents: [M, 4] int64 of rho, sigma, tau, w. path: [M] coefficients in um.
        focal_z_mm, front_z_mm: of the plane on which the path begins, and of the point about which it ends.
        direction: coefficients of the direction s(P) in which a wave leaves; see `models.phase.Waves`.
    """

    parts: tuple[Any]
    exponents: Exponents
    path: Array
    focal_z_mm: float
    front_z_mm: float
    direction: tuple[float, ...]

    def build(self, g: Graph, field: Field, units: Units) -> CoreValues:
        x, used = field.products(ROUND), self.exponents[:, -1] == 0
        used = used | field.dispersive
        path = g.polynomial(self.exponents[used][:, : x.rows], self.path[None, used], x)
        return replace(self.parts[0].build(g, field, units), path_um=path)

    def fixed(self, w: float) -> Self:
        unique, merge = without_w(self.exponents, w)
        return replace(super().fixed(w), exponents=unique, path=self.path @ merge)

    @property
    def coefficients(self) -> int:
        return super().coefficients + len(self.path)
