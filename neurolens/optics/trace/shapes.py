"""The shape of a surface for rays: its figure as numbers, its depth, and where an iteration along a ray starts.

A conic of curvature c and constant K is the surface c (x^2 + y^2 + (1 + K) z^2) - 2 z = 0; a cylinder lacks the square
of the coordinate along which it is straight. An asphere adds the sum of A_p h^p, with h the distance from the axis (for
a cylinder, from its plane of symmetry). All arithmetic is that of `arithmetic`: the same text serves tensors, arrays
and graphs.

Beyond its rim a polynomial soon means nothing: a term in r^20 is 3,000 times as large at 1.5 times the rim. Where rims
are ignored, an asphere therefore follows its figures only as far as its slope stays close to that at the rim. From
there it continues with the same slope and curvature, the curvature dies away, and it becomes a cone that every ray can
meet.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from neurolens.optics.lens.figures import Centred, Figure, figure_of, number_of
from neurolens.optics.lens.prescription import Surface
from neurolens.optics.trace.arithmetic import NUMPY, TINY, Arithmetic, is_number, times

# How many steps the iteration takes, by how far (in rim radii) the asphere departs from the conic that it starts from.
# The count is fixed, because with a test of convergence an accelerator would wait for its host at every surface.
STEPS = ((3e-4, 2), (3e-3, 3), (3e-2, 4), (math.inf, 7))
# The iteration counts as converged where its deciding step is shorter than this, in rim radii: the error left is of the
# order of its square.
LAST_STEP = 3e-4
# The iteration follows conics up to this steepness, as cos^2 of the slope.
STEEPEST = 1e-7
# How far (rad) an asphere's slope may turn beyond its rim before it continues smoothly, and again after that.
TURN = 0.25
FARTHEST = 1.5  # rim radii up to which figures are followed at most
# From this ratio of rim radius to radius of curvature on, a sphere's rim is tested by its depth.
DEEP = 0.25
_UPRIGHT = 1e6  # slope and bend that stand for infinite ones

Quadric = tuple[Any, Any, Any]


class Curve(NamedTuple):
    """Describes a surface's shape as rays meet it, in mm, with numbers, 0-d tensors or values of a graph.

    Attributes:
        curvature, stretch: c and 1 + K of the conic.
        plain: whether it is a sphere or a plane, of which only the curvature counts.
        bent: whether it is curved along x, and along y.
        terms: the A_p as coefficients of h^(p - 2), lowest first, for every second power where they are `even`, else
            for every power; () without a polynomial.
        even: whether only even powers occur.
        centred: the same polynomial, where its powers cancel; see `centred`.
        start: cx, cy, cz of the quadric cx x^2 + cy y^2 + cz z^2 = 2 z that the iteration starts from; None without an
            iteration.
        steps: how many steps the iteration takes.
        last_step: how long its last step may be.
        across: curvature and 1 + K of a toroid or biconic along the other axis; () for other surfaces.
        turned: whether it is a toroid.
        beyond: where and how an asphere continues smoothly; None where it follows its polynomial everywhere.
    """

    curvature: Any
    stretch: Any = 1.0
    plain: bool = False
    bent: tuple[bool, bool] = (True, True)
    terms: Sequence[Any] = ()
    even: bool = True
    centred: Centred | None = None
    start: Quadric | None = None
    steps: int = 0
    last_step: Any = 0.0
    across: tuple[Any, ...] = ()
    turned: bool = False
    beyond: Beyond | None = None

    @property
    def flat(self) -> bool:
        """Whether it is known to be a plane: a curvature that is no plain number may take another value."""
        return self.plain and is_number(self.curvature) and self.curvature == 0


class Beyond(NamedTuple):
    """The continuation of a curve beyond the height up to which its figures are followed.

    At a distance d beyond that height its slope is slope + bend * length * (1 - exp(-d / length)).
    """

    height: float  # where the figures end
    slope: float
    bend: float  # second derivative there
    length: float  # in which the second derivative dies away


def curve_of(surface: Surface, number: Callable[[Any], Any] = float) -> Curve:
    """Return the curve of a surface by its own numbers; `number` turns fields that are tensors into numbers."""
    figure, c, k = surface.figure, number(surface.curvature), number(surface.figure.conic)
    powers = {int(n): number(a) for n, a in figure.powers}
    if is_number(k) and k == 0 and not powers and not figure.axis:
        return Curve(c, plain=True)
    even = all(n % 2 == 0 for n in powers)
    numbers = all(is_number(a) for a in powers.values())  # only then: derivatives by coefficients are taken in powers
    return Curve(
        c,
        1 + k,
        bent=(figure.axis != "y", figure.axis != "x"),
        terms=[powers.get(n, 0.0) for n in range(2, max(powers, default=0) + 1, 2 if even else 1)],
        even=even,
        centred=centred(surface) if powers and numbers else None,
        across=(1 / figure.across[0], 1 + (figure.across[1] or 0.0)) if figure.across else (),
        turned=bool(figure.across and figure.across[1] is None),
    )


def centred(surface: Surface) -> Centred | None:
    """Return the polynomial of a surface about the middle of its zone; None where float32 copes with its powers."""
    return surface.figure.centred(float(_extent_mm(surface)))


def traced_curve(surface: Surface, number: Callable[[Any], Any] = lambda value: value) -> Curve:
    """Return the curve of a surface with the start of its iteration; arguments are those of `curve_of`."""
    curve = curve_of(surface, number)
    if not curve.terms and not curve.across:
        return curve
    start, steps = start_of(surface)
    beyond = None if surface.followed_mm == math.inf else _end_of(surface)
    return curve._replace(start=start, steps=steps, last_step=LAST_STEP * _extent_mm(surface), beyond=beyond)


def without_rim(curve: Curve) -> Curve:
    """Return the curve with an iteration that starts from the quadric at its vertex, for lenses without rims."""
    if not curve.terms and not curve.across:
        return curve
    c, (other, _) = curve.curvature, curve.across or (0.0, 1.0)
    start = (c if curve.bent[0] else other), (c if curve.bent[1] else other), c * curve.stretch
    return curve._replace(start=start, steps=STEPS[-1][1], last_step=math.inf)


def start_of(surface: Surface) -> tuple[tuple[float, float, float], int]:
    """Return cx, cy, cz of the quadric cx x^2 + cy y^2 + cz z^2 = 2 z nearest to a surface.

    It is nearest inside the rim. The number of Newton steps from it to the surface is returned, too.
    """
    figure = figure_of(surface.figure.record())  # of numbers
    (c, other, cz), steps = _fitted(number_of(surface.curvature), figure, _extent_mm(surface))
    if not figure.across:
        return (c * (figure.axis != "y"), c * (figure.axis != "x"), cz), steps
    return ((other, c, cz) if figure.axis == "y" else (c, other, cz)), steps


def followed_mm(surface: Surface) -> float:
    """The distance from the axis, at least the rim's, up to which figures are followed where rims are ignored."""
    height = surface.semi_diameter_mm * np.linspace(1, FARTHEST, 51)
    with np.errstate(invalid="ignore", divide="ignore"):
        angle = np.arctan(_profile(surface, height)[0])
        tame = np.abs(angle - angle[0]) <= TURN  # NaN beyond the end of the conic is not
    return float(height[max(int(np.argmin(tame)) - 1, 0) if not tame.all() else -1])


def _profile(surface: Surface, height: Any) -> tuple[Any, Any]:
    """The first and second derivative, by height, of a surface's meridional curve (of a cylinder, across its lines)."""
    own = replace(surface, figure=_round(surface.figure))
    step = 1e-4 * height
    before, slope = (sag_and_derivatives(own, h, 0 * h)[1] for h in (height - step, height))
    return slope, (slope - before) / step


def _extent_mm(surface: Surface) -> float:
    """Return the distance from the axis up to which a surface's own figures hold."""
    return min(surface.semi_diameter_mm, surface.followed_mm)


@lru_cache(maxsize=4096)
def _end_of(surface: Surface) -> Beyond:
    with np.errstate(divide="ignore", invalid="ignore"):  # a conic may end at its rim, upright
        profile = _profile(surface, np.array(surface.followed_mm))
    slope, bend = (float(np.nan_to_num(v, nan=0.0, posinf=_UPRIGHT, neginf=-_UPRIGHT)) for v in profile)
    length = min(TURN * surface.followed_mm, TURN * (1 + slope * slope) / max(abs(bend), 1e-300))
    return Beyond(surface.followed_mm, slope, bend, length)


def _round(figure: Figure) -> Figure:
    """Return the figure of revolution whose meridian is the curve of the radius."""
    return Figure(figure.conic, figure.asphere) if figure.axis else figure


@lru_cache(maxsize=4096)
def _fitted(curvature: float, figure: Figure, rim_mm: float) -> tuple[tuple[float, float, float], int]:
    """Fit a quadric to a figure by linear least squares, and return its three numbers and the steps it needs.

    A point's error is, times 2, that of its height along the axis.
    """
    across = figure.across
    if not math.isfinite(rim_mm):
        start = (curvature, 1 / across[0], 0.0) if across else (curvature, curvature, curvature * (1 + figure.conic))
        return start, STEPS[-1][1]
    radius_mm = 1 / curvature if curvature else math.inf
    placed = figure_of(figure.record() | {"cylinder": "y"}) if across else _round(figure)
    same = Surface(radius_mm, 0.0, 2 * rim_mm, figure=placed)
    turns = np.linspace(0, math.pi / 2, 9) if across else np.zeros(1)
    h, turn = (v.ravel() for v in np.meshgrid(rim_mm * np.arange(1, 25) / 24, turns))
    a, h = h * np.sin(turn), h * np.cos(turn)
    z = sag_mm(same, a, h)
    a, h, z = (v[np.isfinite(z)] for v in (a, h, z))
    columns = np.stack([h * h, a * a, z * z] if across else [h * h, z * z], 1)
    fit, *_ = np.linalg.lstsq(columns, 2 * z, rcond=1e-9)
    worst = np.abs(columns @ fit - 2 * z).max(initial=0.0) / 2
    c, other, cz = fit.tolist() if across else (fit[0].item(), fit[0].item(), fit[1].item())
    return (c, other, cz), next(steps for departure, steps in STEPS if worst <= departure * rim_mm)


class Depth(NamedTuple):
    """The curve of a figure at a distance h from its axis or plane of symmetry.

    Attributes:
        sag: depth towards +z; 0 where `depth` was called with order 1.
        slope: d sag / d h, divided by h.
        turn: the derivative of `slope` by h, divided by h, of the conic alone; 0 where `order` is below 2.
        cos2: squared cosine of the conic's slope, positive where the conic exists; None without a conic.
    """

    sag: Any
    slope: Any
    turn: Any
    cos2: Any


def depth(o: Arithmetic, curve: Curve, h2: Any, order: int = 2, steepest: float = STEEPEST) -> Depth:
    """Return the depth of a curve at squared distances h2 (mm^2); it stays finite beyond the end of its conic.

    Args:
        order: 0 for depth and slope, 1 for the slope alone, 2 for everything.
        steepest: least squared cosine of the conic's slope.
    """
    if curve.beyond is None:
        return _followed(o, curve, h2, order, steepest)
    end, slope, bend, length = curve.beyond
    inside = _followed(o, curve, o.least(h2, o.like(h2, end * end)), order, steepest)
    h = o.held_root(h2, end * end)
    d = h - end
    left = o.exp(d / -length)
    turned = bend * length * (1 - left)
    rise = slope * d + bend * length * (d - length * (1 - left))
    turn = o.select(h2, end * end, inside.turn, (bend * left - (slope + turned) / h) / (h * h))
    return Depth(inside.sag + rise, inside.slope * (end / h) + turned / h, turn, inside.cos2)


def _followed(o: Arithmetic, curve: Curve, h2: Any, order: int, steepest: float) -> Depth:
    """Return the depth by a curve's own numbers: c h^2 / (1 + cos) + sum A_p h^p."""
    sag, slope = polynomials(o, curve, h2, order)
    c = curve.curvature
    if is_number(c) and c == 0:
        return Depth(times(h2, sag), slope + o.like(h2, 0.0), 0.0, None)
    even = is_number(curve.stretch) and curve.stretch == 0  # a paraboloid
    cos2 = o.like(h2, 1.0) if even else o.fma(h2, -(curve.stretch * c * c), 1.0)
    cos = o.held_root(cos2, steepest)
    if order == 1:
        return Depth(0.0, c / cos + slope, 0.0, cos2)
    both = c / o.fma(cos, cos, cos)  # one division for both c h^2 / (1 + cos) and c / cos
    inverse = o.fma(both, cos, both)
    turn = times(inverse * inverse * inverse, curve.stretch) if order else 0.0
    return Depth(o.fma(both, cos, sag) * h2, inverse + slope, turn, cos2)


def polynomials(o: Arithmetic, curve: Curve, h2: Any, order: int) -> tuple[Any, Any]:
    """Return sum A_p h^(p - 2) and sum p A_p h^(p - 2), in powers of h^2, or of h where odd ones occur, or centred."""
    if not curve.terms:
        return 0.0, 0.0
    # The root is held above 0, where its derivative is infinite.
    h, down = (h2, 2) if curve.even else (o.held_root(h2), 1)
    if curve.centred is not None:
        h, sum_ = o.fma(h, curve.centred.scale, -1.0), o.chebyshev if curve.centred.chebyshev else o.horner
        return 0.0 if order == 1 else sum_(h, curve.centred.sag), sum_(h, curve.centred.slope)
    slopes = [a * float(2 + down * k) for k, a in enumerate(curve.terms)]
    return 0.0 if order == 1 else o.horner(h, curve.terms), o.horner(h, slopes)


def toroid(c: Any, section: tuple[Any, Any, Any], at: tuple[Any, Any, Any], p: tuple[Any, Any, Any]) -> tuple[Any, ...]:
    """Return a function that is 0 on a toroid, its gradient, and its second derivative along p.

    The function is (c (a^2 + z^2) - c g^2) / 2 - z + g. Any arithmetic that has operators serves.

    Args:
        c: 1 / radius of rotation.
        section: the sag g(h), its slope over h, and the derivative of that by h over h.
        at, p: a point and a direction, each as components across the curve, along it, and along z.
    """
    (g, slope, turn), (a, h, z), (pa, ph, pz) = section, at, p
    way = 1 - g * c
    value = (a * a + z * z) * c * 0.5 - z + g * (way + 1) * 0.5
    bend = (pa * pa + pz * pz) * c + ph * ph * ((slope + turn * h * h) * way - slope * slope * h * h * c)
    return value, (a * c, slope * h * way, z * c - 1), bend


def biconic(
    along: tuple[Any, Any], across: tuple[Any, Any], at: tuple[Any, Any, Any], p: tuple[Any, Any, Any], root: Any
) -> tuple[Any, ...]:
    """Return sag less z of a biconic, its gradient, its second derivative along p, and what stands under the root.

    Args:
        along, across: curvature and 1 + conic constant of the two sections.
        at, p: as for `toroid`.
        root: a square root that is held above 0.
    """
    (c, k), (ca, ka), (a, h, z), (pa, ph, _) = along, across, at, p
    kc, kca = k * c * c, ka * ca * ca
    square = 1 - (h * h * kc + a * a * kca)
    r = root(square)
    over = 1 / (r + 1)
    sag = (h * h * c + a * a * ca) * over
    rh, ra = h * kc / r, a * kca / r  # derivatives of the root, with the sign changed
    sh, sa = (h * c * 2 + sag * rh) * over, (a * ca * 2 + sag * ra) * over
    change, rise = ph * rh + pa * ra, ph * sh + pa * sa
    bend = (ph * ph * c + pa * pa * ca + rise * change) * 2 + sag * (ph * ph * kc + pa * pa * kca + change * change) / r
    return sag - z, (sa, sh, -1.0), bend * over, square


def height2(o: Arithmetic, curve: Curve, x: Any, y: Any) -> Any:
    """Return the squared distance from the axis, or from a cylinder's plane of symmetry."""
    if all(curve.bent):
        return o.dot((x, y), (x, y))
    return x * x if curve.bent[0] else y * y


def sag(o: Arithmetic, curve: Curve, x: Any, y: Any) -> tuple[Any, Any]:
    """Return the depth at points, and what is at least 0 where the surface exists; None where it does everywhere."""
    h2 = height2(o, curve, x, y)
    if not curve.across:
        found = depth(o, curve, h2, order=0, steepest=TINY)
        return found.sag, found.cos2
    (c, stretch), a = curve.across, y if curve.bent[0] else x
    a2 = a * a
    if not curve.turned:
        square = 1 - (h2 * (curve.stretch * curve.curvature**2) + a2 * (stretch * c * c))
        return (h2 * curve.curvature + a2 * c) / (1 + o.held_root(square)), square
    found = depth(o, curve, h2, order=0, steepest=TINY)
    way = 1 - c * found.sag  # distance to the line that the curve is turned about, over the radius there
    square = way * way - a2 * (c * c)
    z = (found.sag * (1 + way) + a2 * c) / (1 + o.held_root(square))
    return z, square if found.cos2 is None else o.least(found.cos2, square)


def sag_mm(shape: Surface, x: Any, y: Any, *, held: bool = False) -> Any:
    """Return the depth z (mm) of a surface at points x, y (mm) relative to its vertex, towards +z.

    Args:
        x, y: floats, numpy arrays or torch tensors.
        held: whether a conic continues as a plane beyond its end, where the depth would be NaN; arrays and tensors
            only.
    """
    tensor = next((v for v in (x, y) if hasattr(v, "new_full")), None)
    o = NUMPY if tensor is None else import_module("neurolens.optics.trace.tensors").Tensors(False, tensor.dtype)
    z, exists = sag(o, curve_of(shape), x, y)
    z = z if held or exists is None else o.select(0.0, exists, z, math.nan)
    return float(z) if is_number(x) and is_number(y) else z


def sag_and_derivatives(shape: Surface, x: Any, y: Any) -> tuple[Any, Any, Any]:
    """Return the depth (mm) at points x, y (numpy arrays) and its derivatives by x and y; NaN beyond a conic's end."""
    figure, z = curve_of(shape), sag_mm(shape, x, y)
    if figure.across:
        _, (gx, gy, gz), *_ = crossed(NUMPY, figure, (x, y, z), (0.0, 0.0, 1.0))
        return z, -gx / gz, -gy / gz
    slope = depth(NUMPY, figure, height2(NUMPY, figure, x, y), order=1, steepest=TINY).slope + 0 * z
    return z, figure.bent[0] * x * slope, figure.bent[1] * y * slope


def crossed(o: Arithmetic, curve: Curve, at: Quadric, p: Quadric) -> tuple[Any, Quadric, Any, Any]:
    """Return a function that is 0 on a toroid or biconic and grows with -z.

    Returns:
        Its value at points, its gradient, its second derivative along p, and what is positive where the surface exists.
    """
    (c, stretch), swapped = curve.across, not curve.bent[1]
    (a, h, z), (pa, ph, pz) = ((v[swapped], v[not swapped], v[2]) for v in (at, p))
    if curve.turned:
        found = depth(o, curve, h * h)
        value, gradient, bend = toroid(c, found[:3], (a, h, z), (pa, ph, pz))
        exists = -gradient[2] if found.cos2 is None else o.least(found.cos2, -gradient[2])
    else:
        along = curve.curvature, curve.stretch
        place, way = (a, h, z), (pa, ph, pz)
        value, gradient, bend, exists = biconic(
            along, (c, stretch), place, way, lambda square: o.held_root(square, STEEPEST)
        )
        gradient = gradient[0], gradient[1], o.like(z, -1.0)
    return value, (gradient[swapped], gradient[not swapped], gradient[2]), bend, exists


def is_deep(surface: Surface) -> bool:
    """Test whether a sphere's depth at its rim tells heights as exactly as their squares do."""
    if not is_number(surface.radius_mm) or not surface.figure.plain:
        return False
    return DEEP < rim_sine(surface) <= 1


def rim_sine(surface: Surface) -> float:
    """Return a surface's rim radius over its radius of curvature."""
    return abs(surface.semi_diameter_mm * surface.curvature)
