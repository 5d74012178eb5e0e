"""The figures of surfaces: what shape each has besides its radius of curvature.

A figure is a class below, named in `FIGURES`, and no other module asks which class it is. Its fields are the keys of a
surface in a lens file. It answers what the readers, the hashes, the first-order and Seidel sums and the checks ask, and
gives `optics.trace.shapes` the numbers by which rays meet it: a conic with the surface's radius, a second section
across that, and a polynomial of the height. Lengths are in mm; a height h is a distance from the axis (of a cylinder,
from its plane of symmetry).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from fractions import Fraction
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

# Slope at the rim that an asphere's powers add up to if all have one sign: from 100 on they are summed about the middle
# of the zone; where the powers about the middle still add up to it, as Chebyshev's polynomials. Float32 loses 6e-8 rad
# for each unit of that slope; below 180 no lens that ships gains by it (`python -m experiments precision`).
CANCELS = 100.0
MOST_Q_TERMS = 20
LEAST_NORM_MM = 1e-3
WIDEST_Q = 2.0  # rim radius over the normalisation radius of a Qcon; beyond this ratio its terms overflow
Bound = tuple[str, float, float, float, str]


class Centred(NamedTuple):
    """An asphere's sums of A_p h^(p - 2) and of p A_p h^(p - 2), expanded about the middle of the zone inside the rim.

    Attributes:
        scale: the sums are series in t = scale h^2 - 1 (scale h - 1 where odd powers occur), which runs from -1 on the
            axis to 1 at the rim; a float32 holds it exactly.
        sag, slope: coefficients of the two series, lowest first: of powers of t, or of Chebyshev's polynomials of t.
        chebyshev: whether they are coefficients of Chebyshev's polynomials.
    """

    scale: Any
    sag: Sequence[Any]
    slope: Sequence[Any]
    chebyshev: bool = False


@dataclass(frozen=True)
class Figure:
    """A conic, of which a sphere is the simplest, plus a polynomial of the height.

    Attributes:
        conic: Schwarzschild's constant K (0 sphere, -1 paraboloid): the depth is c h^2 / (1 + sqrt(1 - (1 + K) c^2
            h^2)).
        asphere: (power p, coefficient A_p) pairs, sorted by power, whose sum of A_p h^p is added, A_p in mm^(1 - p).
            Odd powers are allowed, and so is p = 2, which adds 2 A_2 to the curvature at the vertex.

    Values of both may be 0-d tensors where gradients with respect to them are wanted.
    """

    conic: Any = 0.0
    asphere: tuple[tuple[int, Any], ...] = ()

    @property
    def axis(self) -> str | None:
        """The transverse axis, "x" or "y", along which the curve of the radius runs; None where the figure is round."""
        return None

    @property
    def across(self) -> tuple[float, float | None] | None:
        """Radius and conic constant of the section at right angles to `axis`; None where that section is straight.

        The conic constant is None for a curve that is turned about a line parallel to its axis.
        """
        return None

    @property
    def power(self) -> float:
        """1 / focal length of an ideal lens, in 1/mm; 0.0 for a surface that refracts."""
        return 0.0

    @property
    def powers(self) -> tuple[tuple[int, Any], ...]:
        """The polynomial that is added to the conic: pairs of p and A_p, whose sum is that of A_p h^p."""
        return self.asphere

    @property
    def aspheric(self) -> bool:
        """Whether the curve is no circle, or may turn into another one because its conic is a tensor."""
        return bool(self.powers) or not isinstance(self.conic, int | float) or self.conic != 0

    @property
    def plain(self) -> bool:
        """Whether the surface is a sphere or a plane."""
        return not (self.aspheric or self.axis)

    @property
    def bends(self) -> bool:
        """Whether the figure bends rays even where the radius is infinite."""
        return bool(self.powers or self.across or self.power)

    def vertex_curvature(self, curvature: Any, meridian: str) -> Any:
        """Return the curvature at the vertex along "x" or "y", in 1/mm, for a surface of this curvature."""
        if self.axis not in (None, meridian):
            return 0.0 if self.across is None else 1.0 / self.across[0]
        return curvature + sum(2 * a for p, a in self.powers if p == 2)

    def centred(self, rim_mm: float) -> Centred | None:
        """Return the polynomial about the middle of the zone inside the rim; None where float32 copes with its powers.

        Powers of opposite sign cancel, and float32 loses the digits. Of a sum of n of Forbes's polynomials, single
        powers of h exceed the sum by a factor of up to 6^n, powers about the middle by 2.4^n, Chebyshev's polynomials
        hardly.
        """
        return _centred(tuple((int(p), number_of(a)) for p, a in self.powers if p >= 2), rim_mm)

    def scaled(self, factor: float) -> Figure:
        """Return the figure of a surface all of whose lengths are multiplied by `factor`."""
        return replace(self, asphere=tuple((p, a * factor ** (1 - p)) for p, a in self.asphere))

    def bounds(self, rim_mm: float) -> list[Bound]:
        """Return what `optics.setting.rims.check_figures` checks: key, size, least, most, and the unit of the size."""
        sags = [float(a) * rim_mm**p for p, a in self.powers]
        sag = max(1e-6 * sum(map(abs, sags)), abs(sum(sags)))
        return [("conic", abs(self.conic), 0.0, 1e9, ""), ("asphere", sag, 0.0, 1e6, " mm of sag at the rim")]

    @classmethod
    def read(cls, row: Any) -> dict[str, Any]:
        """The fields, read from a surface of a lens file (an `optics.readers.source.Table`); raises its errors."""
        example = "a table such as { 4 = 1e-6, 6 = 2e-9 }"
        found: dict[str, Any] = {"conic": row.number("conic")} if "conic" in row else {}
        return found | ({"asphere": row.powers("asphere", example)} if "asphere" in row else {})

    def cells(self) -> dict[str, Any]:
        """Return the values by the keys of a lens file, without those that have no effect."""
        given = {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) != f.default}
        given |= {"conic": float(self.conic)} if "conic" in given else {}
        return given | ({"asphere": {str(p): float(a) for p, a in self.asphere}} if self.asphere else {})

    def record(self) -> dict[str, Any]:
        """Return the numbers by key for hashes, caches and files of models; `figure_of` makes the figure of them again.

        The hashes of lens files are computed from them, so the keys and their order must not change.
        """
        found = self.cells()
        found |= {"asphere": [(int(p), float(a)) for p, a in self.asphere]} if self.asphere else {}
        rest = {key: value for key, value in found.items() if not key.startswith("across")}
        return rest | ({"across": self.across} if self.across else {})

    def words(self) -> str:
        """Return what a table of surfaces says of the figure, by the keys of lens files; empty for a sphere."""
        found = self.cells()
        if powers := list(found.pop("asphere", ())):
            found = {"asphere": "-".join(dict.fromkeys((powers[0], powers[-1])))} | found
        said = {key: f"of {len(value)} terms" for key, value in found.items() if isinstance(value, tuple)}
        said |= {key: f"{value:.6g}" for key, value in found.items() if isinstance(value, float)}
        return ", ".join(f"{key} {value}" for key, value in (found | said).items())


SPHERE = Figure()


@dataclass(frozen=True, kw_only=True)
class Cylinder(Figure):
    """A curve along one transverse axis that is straight along the other.

    Attributes:
        cylinder: the axis along which it is curved, "x" or "y".
    """

    cylinder: str

    @property
    def axis(self) -> str | None:
        return self.cylinder

    @classmethod
    def read(cls, row: Any) -> dict[str, Any]:
        for key in (k for k in ("across_mm", "across_conic") if k in row and "cylinder" not in row):
            raise row.error("cylinder", "(missing)", f'the axis of the curve that {key} goes with: "x" or "y"')
        axis = row.text("cylinder")
        if axis not in ("x", "y"):
            raise row.error("cylinder", axis, 'the axis along which it is curved: "x" or "y"')
        return super().read(row) | {"cylinder": axis}


@dataclass(frozen=True, kw_only=True)
class Toroid(Cylinder):
    """A curve along one transverse axis that is turned about a line parallel to that axis.

    Attributes:
        across_mm: radius of the circle that the curve's vertex is turned on.
    """

    across_mm: float

    @property
    def across(self) -> tuple[float, float | None] | None:
        return self.across_mm, None

    def scaled(self, factor: float) -> Figure:
        return replace(self, asphere=super().scaled(factor).asphere, across_mm=self.across_mm * factor)

    def bounds(self, rim_mm: float) -> list[Bound]:
        return [("across_mm", abs(self.across_mm), 1e-6, math.inf, ""), *super().bounds(rim_mm)]

    @classmethod
    def read(cls, row: Any) -> dict[str, Any]:
        """Return the fields as `Figure.read` does; with an infinite radius they are those of a cylinder."""
        found = super().read(row)
        if "across_mm" not in row:
            raise row.error("across_mm", "(missing)", "the radius that across_conic goes with")
        radius = row.number("across_mm", unit="mm", finite=False)
        if not abs(radius) > 0:
            raise row.error("across_mm", radius, "a radius of curvature other than 0, or inf")
        return found | ({"across_mm": radius} if math.isfinite(radius) else {})


@dataclass(frozen=True, kw_only=True)
class Biconic(Toroid):
    """A surface with a conic section along each of the transverse axes, and without a polynomial.

    Attributes:
        across_mm, across_conic: radius and conic constant of the second section.
    """

    across_conic: float

    @property
    def across(self) -> tuple[float, float | None] | None:
        return self.across_mm, self.across_conic

    def bounds(self, rim_mm: float) -> list[Bound]:
        return [("across_conic", abs(self.across_conic), 0.0, 1e9, ""), *super().bounds(rim_mm)]

    @classmethod
    def read(cls, row: Any) -> dict[str, Any]:
        found = super().read(row)
        if "asphere" in row:
            raise row.error("asphere", row.data["asphere"], "none: a biconic has no polynomial (a toroid has)")
        return found | ({"across_conic": row.number("across_conic")} if "across_mm" in found else {})


@dataclass(frozen=True, kw_only=True)
class Ideal(Figure):
    """An ideal thin lens in air: a plane that refracts nothing, but changes slopes by -x / f and -y / f.

    Attributes:
        focal_mm: the focal length f.
    """

    focal_mm: float

    @property
    def power(self) -> float:
        return 1 / self.focal_mm

    def scaled(self, factor: float) -> Figure:
        return replace(self, focal_mm=self.focal_mm * factor)

    def bounds(self, rim_mm: float) -> list[Bound]:
        return [("focal_mm", abs(self.focal_mm), 1e-6, 1e9, "")]

    @classmethod
    def read(cls, row: Any) -> dict[str, Any]:
        shaped = [key for key in ("conic", "asphere", *KEYS, "coating") if key in row and key != "focal_mm"]
        if shaped or not math.isinf(row.number("radius_mm", finite=False)):
            key = shaped[0] if shaped else "radius_mm"
            expected = "a plane in air (radius_mm = inf, nothing else), as focal_mm makes it an ideal thin lens"
            raise row.error(key, row.data.get(key), expected)
        focal = row.number("focal_mm", unit="mm")
        if focal == 0:
            raise row.error("focal_mm", focal, "a focal length other than 0")
        return {"focal_mm": focal}


@dataclass(frozen=True, kw_only=True)
class Qcon(Figure):
    """A conic plus Forbes's strong asphere u^4 sum a_m P_m^(0,4)(2 u^2 - 1), with u = h / `norm_mm` and Jacobi's P.

    Source: G. W. Forbes, "Shape specification for axially symmetric optical surfaces", Opt. Express 15, 5218 (2007).

    Attributes:
        qcon: the coefficients a_0, a_1, ... in mm.
        norm_mm: the normalisation radius, usually the radius of the rim.
    """

    qcon: tuple[float, ...]
    norm_mm: float

    def __post_init__(self) -> None:
        finite = all(map(math.isfinite, self.qcon)) and len(self.qcon) <= MOST_Q_TERMS
        if not (finite and LEAST_NORM_MM <= self.norm_mm < math.inf):
            least = f"a normalisation radius of at least {LEAST_NORM_MM:g} mm"
            raise ValueError(f"at most {MOST_Q_TERMS} finite coefficients and {least}")

    @property
    def powers(self) -> tuple[tuple[int, Any], ...]:
        return tuple((p, float(a)) for p, a in qcon_powers(self.qcon, self.norm_mm))

    def centred(self, rim_mm: float) -> Centred | None:
        return _centred(qcon_powers(self.qcon, self.norm_mm), rim_mm)

    def scaled(self, factor: float) -> Figure:
        return replace(self, qcon=tuple(a * factor for a in self.qcon), norm_mm=self.norm_mm * factor)

    def bounds(self, rim_mm: float) -> list[Bound]:
        sag = sum(map(abs, self.qcon))
        norm = "norm_mm", self.norm_mm, rim_mm / WIDEST_Q, 1e9, " mm, at least half of the rim's radius"
        return [super().bounds(0.0)[0], ("qcon", sag, 0.0, 1e6, " mm of sag"), norm]

    @classmethod
    def read(cls, row: Any) -> dict[str, Any]:
        values = row.data["qcon"]
        if not isinstance(values, list) or not 0 < len(values) <= MOST_Q_TERMS:
            raise row.error("qcon", values, f"1 to {MOST_Q_TERMS} coefficients in mm, from m = 0")
        if "asphere" in row:
            raise row.error("asphere", row.data["asphere"], "none beside qcon")
        each = replace(row, data={f"qcon[{m}]": value for m, value in enumerate(values)})
        norm = row.number("norm_mm", unit="mm", above=LEAST_NORM_MM)
        return super().read(row) | {"qcon": [each.number(key) for key in each.data], "norm_mm": norm}


# The key that marks each figure in a surface's table; where several are given, the last counts. A surface with none of
# them is a plain `Figure`.
FIGURES: dict[str, type[Figure]] = {
    "cylinder": Cylinder,
    "across_mm": Toroid,
    "across_conic": Biconic,
    "focal_mm": Ideal,
    "qcon": Qcon,
}
_COMMON = {f.name for f in fields(Figure)}
KEYS = tuple(dict.fromkeys(f.name for kind in FIGURES.values() for f in fields(kind) if f.name not in _COMMON))


def figure_of(record: Mapping[str, Any]) -> Figure:
    """Return the figure of numbers by key, as `Figure.record` or `Figure.read` gives them; ignores other keys."""
    given = {key: value for key, value in record.items() if value is not None}
    across_mm, across_conic = given.pop("across", (None, None))
    given |= {} if across_mm is None else {"across_mm": across_mm}
    given |= {} if across_conic is None else {"across_conic": across_conic}
    if "asphere" in given:
        given["asphere"] = tuple((int(p), float(a)) for p, a in given["asphere"])
    given |= {key: tuple(value) for key, value in given.items() if isinstance(value, list)}
    kind = _kind(given)
    return kind(**{f.name: given[f.name] for f in fields(kind) if f.name in given})


def read_figure(row: Any) -> Figure:
    """Return the figure of a surface of a lens file (an `optics.readers.source.Table`); raises its errors."""
    kind = _kind(row.data)
    found = figure_of(kind.read(row))
    known = {f.name for f in fields(kind)}
    for key in (key for key in KEYS if key in row and key not in known):
        owner = next(mark for mark, one in FIGURES.items() if key in {f.name for f in fields(one)})
        expected = f"{owner} beside it"
        if key in FIGURES:
            expected = f"none beside {', '.join(mark for mark in FIGURES if mark in known and mark in row)}"
        raise row.error(key, row.data[key], expected)
    return found


def _kind(given: Mapping[str, Any]) -> type[Figure]:
    return next((kind for key, kind in reversed(FIGURES.items()) if key in given), Figure)


def number_of(value: Any) -> float:
    """Return a number, also where it is given as a 0-d tensor."""
    return float(value.detach() if hasattr(value, "detach") else value)


@lru_cache(maxsize=4096)
def qcon_powers(a: tuple[float, ...], norm_mm: float) -> tuple[tuple[int, Fraction], ...]:
    """Return a Qcon sum as powers of h with exact coefficients."""
    found = [Fraction()] * len(a)
    for m, value in enumerate(a):
        for k in range(m + 1):
            found[k] += (-1) ** (m + k) * math.comb(m, k) * math.comb(m + k + 4, m) * Fraction(value)
    return tuple((2 * k + 4, sum_ / Fraction(norm_mm) ** (2 * k + 4)) for k, sum_ in enumerate(found))


@lru_cache(maxsize=4096)
def _centred(powers: tuple[tuple[int, float | Fraction], ...], rim_mm: float) -> Centred | None:
    down = 1 if any(p % 2 for p, _ in powers) else 2
    with np.errstate(all="ignore"):
        reach = float(sum(p * abs(float(a)) * np.float64(rim_mm) ** (p - 1) for p, a in powers))
        scale = float(np.float32(2 / np.float64(rim_mm) ** down))
    if not (CANCELS < reach < 1e30 and 0 < scale < math.inf):
        return None
    # Exact fractions: each coefficient is rounded only once, at the end.
    terms = [((p - 2) // down, p, Fraction(a) / Fraction(scale) ** ((p - 2) // down)) for p, a in powers]
    degrees = range(max(j for j, _, _ in terms) + 1)
    exact = [
        [sum((a * math.comb(j, k) * (p if sloping else 1) for j, p, a in terms if j >= k), Fraction()) for k in degrees]
        for sloping in (False, True)
    ]
    size = rim_mm * float(sum(map(abs, exact[1])))
    cancels = size > CANCELS
    sag, slope = (tuple(map(float, _chebyshev(row) if cancels else row)) for row in exact)
    return Centred(scale, sag, slope, cancels) if 2 * size < reach else None


def _chebyshev(powers: Sequence[Fraction]) -> list[Fraction]:
    """Return, exactly, the coefficients of Chebyshev's polynomials that equal a sum of powers, both lowest first."""
    found = [Fraction()] * len(powers)
    for k, a in enumerate(powers):  # 2^k t^k = sum C(k, j) T_|k - 2 j|
        for j in range(k + 1):
            found[abs(k - 2 * j)] += a * math.comb(k, j) / 2**k
    return found
