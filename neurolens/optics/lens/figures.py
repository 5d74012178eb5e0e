"""The figures of surfaces: what shape each has besides its radius of curvature.

A figure is a class below, named in `FIGURES`, and nothing outside asks which class it is. Its fields are the keys of a
surface in a lens file. It answers what readers, hashes, first-order and Seidel sums and checks ask, and gives
`optics.trace.shapes` the numbers by which rays meet it: a conic of the surface's radius, a second section across it,
and a polynomial of the height. Lengths are in mm, heights h are distances from the axis (from the plane of symmetry
of a cylinder).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from fractions import Fraction
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

# Slopes at the rim of an asphere's powers, all of one sign, from which on they are summed about the middle of the zone,
# and of those powers, from which on Chebyshev's polynomials take their place. Float32 loses 6e-8 rad for each 1; below
# 180 no lens that ships gains by it (`python -m experiments precision`).
CANCELS = 100.0
MOST_Q_TERMS = 20
LEAST_NORM_MM = 1e-3
WIDEST_Q = 2.0  # rim radius over the normalisation radius of a Qcon; beyond, its terms overflow
Bound = tuple[str, float, float, float, str]


class Centred(NamedTuple):
    """Sums of A_p h^(p - 2) and of p A_p h^(p - 2) about the middle of the zone inside the rim.

    Attributes:
        scale: of t = scale h^2 - 1 (scale h - 1 where odd powers occur), from -1 on the axis to 1 at the rim; float32
            has it exactly.
        sag, slope: coefficients of powers of t, lowest first; of Chebyshev's polynomials where `chebyshev` is true.
    """

    scale: Any
    sag: Sequence[Any]
    slope: Sequence[Any]
    chebyshev: bool = False


@dataclass(frozen=True)
class Figure:
    """A conic, of which a sphere is the simplest, and a polynomial of the height added to it.

    Attributes:
        conic: Schwarzschild's K (0 sphere, -1 paraboloid): c h^2 / (1 + sqrt(1 - (1 + K) c^2 h^2)).
        asphere: (power, coefficient) pairs, sorted by power: sum of A_p h^p, A_p in mm^(1 - p). Odd powers and p = 2
            (which adds 2 A_2 to the curvature at the vertex) are allowed.

    Both may be 0-d tensors where gradients with respect to them are wanted.
    """

    conic: Any = 0.0
    asphere: tuple[tuple[int, Any], ...] = ()

    @property
    def axis(self) -> str | None:
        """The transverse axis, "x" or "y", of a figure that is not round: along it runs the curve of the radius."""
        return None

    @property
    def across(self) -> tuple[float, float | None] | None:
        """Radius of the section across that curve, None where it is straight, and the section's conic constant, None
        where the curve is turned about a line parallel to its axis."""
        return None

    @property
    def power(self) -> float:
        """1 / focal length of an ideal lens; 0.0 of a surface that refracts."""
        return 0.0

    @property
    def powers(self) -> tuple[tuple[int, Any], ...]:
        """The polynomial that is added to the conic, as (power, coefficient) pairs: sum of A_p h^p."""
        return self.asphere

    @property
    def aspheric(self) -> bool:
        """Whether the curve of the radius is more than a circle; a conic constant that is a tensor may become so."""
        return bool(self.powers) or not isinstance(self.conic, int | float) or self.conic != 0

    @property
    def plain(self) -> bool:
        """Whether the surface is a sphere or a plane."""
        return not (self.aspheric or self.axis)

    @property
    def bends(self) -> bool:
        """Whether rays are bent by it even where the radius is infinite."""
        return bool(self.powers or self.across or self.power)

    def vertex_curvature(self, curvature: Any, meridian: str) -> Any:
        """Curvature at the vertex along "x" or "y" in 1/mm, of a surface of this curvature."""
        if self.axis not in (None, meridian):
            return 0.0 if self.across is None else 1.0 / self.across[0]
        return curvature + sum(2 * a for p, a in self.powers if p == 2)

    def centred(self, rim_mm: float) -> Centred | None:
        """The polynomial about the middle of the zone inside the rim; None where float32 carries its powers.

        The powers of Forbes's polynomials of n terms exceed their sum by 6^n, those about the middle by 2.4^n,
        Chebyshev's polynomials hardly.
        """
        return _centred(tuple((int(p), number_of(a)) for p, a in self.powers if p >= 2), rim_mm)

    def scaled(self, factor: float) -> Figure:
        """Return the figure with all lengths times `factor`."""
        return replace(self, asphere=tuple((p, a * factor ** (1 - p)) for p, a in self.asphere))

    def bounds(self, rim_mm: float) -> list[Bound]:
        """What `optics.setting.rims.check_figures` checks: key, size, least, most, and what the size is of."""
        sags = [float(a) * rim_mm**p for p, a in self.powers]
        sag = max(1e-6 * sum(map(abs, sags)), abs(sum(sags)))
        return [("conic", abs(self.conic), 0.0, 1e9, ""), ("asphere", sag, 0.0, 1e6, " mm of sag at the rim")]

    @classmethod
    def read(cls, row: Any) -> dict[str, Any]:
        """Fields from a surface of a lens file, an `optics.readers.source.Table`; raises its errors."""
        example = "a table such as { 4 = 1e-6, 6 = 2e-9 }"
        found: dict[str, Any] = {"conic": row.number("conic")} if "conic" in row else {}
        return found | ({"asphere": row.powers("asphere", example)} if "asphere" in row else {})

    def cells(self) -> dict[str, Any]:
        """Values by the keys of a lens file, without those that say nothing."""
        given = {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) != f.default}
        given |= {"conic": float(self.conic)} if "conic" in given else {}
        return given | ({"asphere": {str(p): float(a) for p, a in self.asphere}} if self.asphere else {})

    def record(self) -> dict[str, Any]:
        """Numbers by key, for hashes, caches and files of models, from which `figure_of` makes the figure again.

        Hashes of lens files are made of them: keys and their order do not change.
        """
        found = self.cells()
        found |= {"asphere": [(int(p), float(a)) for p, a in self.asphere]} if self.asphere else {}
        rest = {key: value for key, value in found.items() if not key.startswith("across")}
        return rest | ({"across": self.across} if self.across else {})

    def words(self) -> str:
        """What a table of surfaces says of it besides the radius, by the keys of lens files; empty for a sphere."""
        found = self.cells()
        if powers := list(found.pop("asphere", ())):
            found = {"asphere": "-".join(dict.fromkeys((powers[0], powers[-1])))} | found
        said = {key: f"of {len(value)} terms" for key, value in found.items() if isinstance(value, tuple)}
        said |= {key: f"{value:.6g}" for key, value in found.items() if isinstance(value, float)}
        return ", ".join(f"{key} {value}" for key, value in (found | said).items())


SPHERE = Figure()


@dataclass(frozen=True, kw_only=True)
class Cylinder(Figure):
    """A curve along one transverse axis, straight along the other.

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
    """A curve along one transverse axis, turned about a line parallel to that axis.

    Attributes:
        across_mm: radius at which it is turned.
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
        """As `Figure.read`; an infinite radius leaves a cylinder."""
        found = super().read(row)
        if "across_mm" not in row:
            raise row.error("across_mm", "(missing)", "the radius that across_conic goes with")
        radius = row.number("across_mm", unit="mm", finite=False)
        if not abs(radius) > 0:
            raise row.error("across_mm", radius, "a radius of curvature other than 0, or inf")
        return found | ({"across_mm": radius} if math.isfinite(radius) else {})


@dataclass(frozen=True, kw_only=True)
class Biconic(Toroid):
    """Two conic sections, along both transverse axes, without a polynomial.

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
    """An ideal thin lens in air, a plane that refracts nothing: slopes change by -x / f and -y / f.

    Attributes:
        focal_mm: f.
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
    """A conic and Forbes's strong asphere: with u = h / `norm_mm` and Jacobi's P, u^4 sum a_m P_m^(0,4)(2 u^2 - 1).

    G. W. Forbes, "Shape specification for axially symmetric optical surfaces", Opt. Express 15, 5218 (2007).

    Attributes:
        qcon: a_0, a_1, ... in mm.
        norm_mm: normalisation radius, usually that of the rim.
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


# The key of a surface that marks each figure, of several the last; a surface with none of them is a `Figure`.
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
    """Return the figure of numbers by key, as `Figure.record` or `Figure.read` gives them; other keys are ignored."""
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
    """Return the figure of a surface of a lens file, an `optics.readers.source.Table`; raises its errors."""
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
    """Return a number that may be a 0-d tensor."""
    return float(value.detach() if hasattr(value, "detach") else value)


@lru_cache(maxsize=4096)
def qcon_powers(a: tuple[float, ...], norm_mm: float) -> tuple[tuple[int, Fraction], ...]:
    """The powers of h of a Qcon sum, exactly."""
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
    # Exact, but for one rounding of each coefficient.
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
    """Return the coefficients of Chebyshev's polynomials of a sum of powers, both lowest first, exactly."""
    found = [Fraction()] * len(powers)
    for k, a in enumerate(powers):  # 2^k t^k = sum C(k, j) T_|k - 2 j|
        for j in range(k + 1):
            found[abs(k - 2 * j)] += a * math.comb(k, j) / 2**k
    return found
