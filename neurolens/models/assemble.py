"""A whole model as one graph: mm and nm in; scene ray, transmittance, stop crossing and status out.

Light field, core, decoding, front surface, rims, domain: everything round a core is written here, once, for every kind
of model. Inputs of the graph are `rays` (film x, y, pupil x, y in mm, wavelength in nm) and, of the call, `film_z_mm`
and `stop_radius_mm`; outputs `scene_ray` (x, y, z in mm, unit direction), `transmittance`, `stop_xy_mm`, `status`, and
`path_um` of models with optical path.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.status import DOMAIN_SLACK
from neurolens.graph.ir import Graph, Value
from neurolens.models.cores import DIRECTION, POSITION, STOP, CoreValues, Field, Units
from neurolens.models.fitted import Encoding, Fitted
from neurolens.optics.lens.prescription import Surface
from neurolens.optics.trace.arithmetic import NUMPY, TINY, Graphs
from neurolens.optics.trace.shapes import curve_of, depth, polynomials

Array = NDArray[np.float64]

# Passing rays cross the front surface within its rim; a little more, for the model's own error.
_FRONT_REACH = 1.02
_SAG_MM = 1e-6
_SERIES = 3e-8  # error of a direction's series: float32's last bit
_TILT = 1e-7  # error of the series of the front's tilt
_GRAZING = 1e-12  # least squared cosine of a ray that leaves the front surface


@dataclass(frozen=True)
class Form:
    """How a graph is written, which depends on what reads it.

    Attributes:
        gate_scale: factor on all tests of rims, so large in ONNX that any failure exceeds every status code.
        sag_terms: most terms of a series for the front surface, which then replaces a square root; 0 keeps the root.
        exact: whether series hold 1e-14, for float64.
        monic: whether to scale the direction vector so that series are monic. That saves a pass over the rays, except
            where a product and a sum are one operation.
        wavelength: whether rays always come with a wavelength, which then is tested.
    """

    gate_scale: float = 1.0
    sag_terms: int = 12
    exact: bool = False
    monic: bool = False
    wavelength: bool = False


SCALARS = Form()
ONNX = Form(gate_scale=1e30, sag_terms=5, monic=True, wavelength=True)
EXACT = Form(sag_terms=0, exact=True, wavelength=True)


@dataclass(frozen=True)
class Parts:
    """Which outputs a graph has besides the scene ray and the test of the domain.

    Attributes:
        transmittance: whether it is an output.
        stop: whether the crossing with the stop is an output.
        vignetting: whether the status tells of the stop and of the rims.
        path: whether the optical path is an output, of models that have it.
    """

    transmittance: bool = True
    stop: bool = True
    vignetting: bool = True
    path: bool = True


ALL, RAY_ONLY = Parts(), Parts(False, False, False, False)


def model_graph(model: Fitted, form: Form, parts: Parts = ALL) -> Graph:
    """Write the graph of a model."""
    g = Graph()
    rays, film_z = g.input("rays", 5), g.input("film_z_mm", per_call=True)
    radius = g.input("stop_radius_mm", per_call=True) if parts.vignetting else None
    inside = within_domain(model, rays, film_z, radius, form)
    field = light_field(g, model.encoding, rays, film_z)
    series = DirectionSeries.of(model, form)
    values = model.core.build(g, field, units_of(model, series, form))
    g.outputs["status"] = add_outputs(model, values, inside, radius, series, form, parts).whole()
    return g


def units_of(model: Fitted, series: DirectionSeries, form: Form) -> Units:
    """Return the units of a core whose outputs `add_outputs` takes: mm, and kappa rad."""
    return Units((model.scales.position_mm, series.kappa, model.scales.stop_mm), form.gate_scale)


def add_outputs(
    model: Fitted,
    values: CoreValues,
    inside: Value,
    radius: Value | None,
    series: DirectionSeries,
    form: Form,
    parts: Parts = ALL,
) -> Value:
    """Make a model's outputs from what its core gives (in `units_of`); the status is returned, the others are set.

    Args:
        inside: whether a ray is within the domain. radius: of the stop; without it neither stop nor rims are tested.
    """
    g = inside.graph
    g.outputs["scene_ray"] = scene_ray(model, values, series, form)
    if parts.transmittance:
        g.outputs["transmittance"] = values.transmittance
    if parts.stop:
        g.outputs["stop_xy_mm"] = values.vectors[STOP]
    if parts.path and values.path_um is not None:
        g.outputs["path_um"] = values.path_um
    tests = _tests(model, values, radius, form) if radius is not None else []
    if series.sinc is not None and values.unit is None:
        longest = (series.kappa * series.angle) ** 2
        tests.append((_scaled(form, g.square(values.vectors[DIRECTION]), g.constant(longest)), st.OUTSIDE_DOMAIN))
    status = g.first_failure([pair for pair, _ in tests], [code for _, code in tests]) if tests else float(st.PASSED)
    return g.select(inside, status, float(st.OUTSIDE_DOMAIN))


def light_field(g: Graph, e: Encoding, rays: Value, film_z: Value) -> Field:
    """Return the light field of rays: crossings with two planes, centred and scaled by one matrix.

    The film position moves that matrix. With a = (film plane - pupil plane) / (film z - pupil plane), the ray crosses
    the film's plane at p = u + (film - u) a.
    """

    def rows(along: float) -> Array:
        """Return rows [4, 4] of the matrix from film x, y and pupil x, y."""
        film, pupil = np.array([1.0, 0.0]), np.array([0.0, 1.0])
        p = along * film + (1 - along) * pupil
        matrix = np.zeros((4, 4))
        for axis, (chief, scale) in enumerate(zip(e.chiefs, e.pupil_scales_mm, strict=True)):
            matrix[axis::2, axis::2] = np.stack([p / e.film_scale_mm, (pupil - chief * p) / scale])
        return matrix

    along = (e.film_plane_z_mm - e.pupil_plane_z_mm) / (film_z - e.pupil_plane_z_mm)
    base, change, points = rows(0.0), rows(1.0) - rows(0.0), rays[0:4]
    if e.w_half:
        points = g.concat(points, wavelength_row(e, rays[4]))
        base, change = np.pad(base, ((0, 1), (0, 1))), np.pad(change, ((0, 1), (0, 1)))
        base[4, 4] = 1
    return Field(g.affine(base, points, moving=(along, change)), -e.w_middle / e.w_half if e.w_half else 0.0)


def wavelength_row(e: Encoding, wavelength_nm: Value) -> Value:
    """Return v = 1000 / (lambda sqrt(half)), so that w = v^2 - middle / half."""
    return (1000 / math.sqrt(e.w_half)) / wavelength_nm


def within_domain(model: Fitted, rays: Value, film_z: Value, radius: Value | None, form: Form) -> Value:
    """Return whether film point, pupil point, wavelength, film position and stop lie in the domain; NaN does not.

    Film position and stop are tested once a call: where they fail, film points must lie within a squared radius of -1.
    """
    g, d = rays.graph, model.domain
    near, far = d.film_z_mm
    call = film_z.between(near / DOMAIN_SLACK, far * DOMAIN_SLACK)
    if radius is not None:
        call = call & radius.between(0.0, d.stop_radius_mm * DOMAIN_SLACK)
    film, pupil = ((r * DOMAIN_SLACK) ** 2 for r in (d.film_radius_mm, d.pupil_radius_mm))
    inside = (g.square(rays[0:2]) <= g.select(call, film, -1.0)) & (g.square(rays[2:4]) <= pupil)
    if form.wavelength or model.encoding.w_half:
        inside = inside & rays[4].between(*model.wavelength_limits_nm)
    return inside


def _tests(model: Fitted, values: CoreValues, radius: Value, form: Form) -> list[tuple[tuple[Value, Value], int]]:
    """Return the tests of stop and rims as camera rays meet them: last surface first, at each as in `base.status`."""
    g = radius.graph
    crossing = _scaled(form, g.square(values.vectors[STOP]), radius * radius)
    tests = [(crossing, st.blocked(model.lens.stop_index, st.RIM))]
    if values.gates is not None:
        rows = [values.gates[k] for k in range(values.gates.rows)]
        tests += [((row, g.constant(0.0)), gate.status) for row, gate in zip(rows, model.gates, strict=True)]
    return sorted(tests, key=lambda test: (-(test[1] // 4), test[1]))


def _scaled(form: Form, value: Value, limit: Value) -> tuple[Value, Value]:
    return (value, limit) if form.gate_scale == 1 else (value * form.gate_scale, limit * form.gate_scale)


@dataclass(frozen=True)
class DirectionSeries:
    """How a core's direction vector v becomes a unit direction.

    It is (v sinc|v|, -cos|v|) by polynomials in t = |kappa v|^2, up to an angle; where v is a slope, a root is taken.

    Attributes:
        kappa: factor on v that makes the polynomial of sinc monic, which saves an operation a ray.
        angle: a ray with a longer v (rad) lies outside the domain, because no ray of the lens has one.
        sinc, minus_cos: coefficients, lowest first; kappa v times sinc(t) is the direction's x and y. None: v is a
            slope.
    """

    kappa: float
    angle: float = math.inf
    sinc: Array | None = None
    minus_cos: Array | None = None

    @staticmethod
    def of(model: Fitted, form: Form) -> DirectionSeries:
        """Choose the series that decode a model's direction vector up to its largest angle; slopes need none."""
        if model.direction == "slope":
            return DirectionSeries(1.0)
        angle = model.angle
        return DirectionSeries.exact(angle) if form.exact else DirectionSeries.fitted(angle, form.monic)

    @staticmethod
    def exact(angle: float = math.pi) -> DirectionSeries:
        """Return Taylor's series; its 12 terms hold 1e-14 up to 130 degrees."""
        k = np.arange(12)
        cos = (-1.0) ** k / np.array([math.factorial(2 * i) for i in k], np.float64)
        return DirectionSeries(1.0, angle, cos / (2 * k + 1), -cos)

    @staticmethod
    def fitted(angle: float, monic: bool = True) -> DirectionSeries:
        """Return the shortest series that hold float32's last bit up to an angle (rad).

        With `monic` the vector is v times `kappa`, so that the highest coefficient of `sinc` is 1.
        """
        sinc = fit_series(lambda t: np.sinc(np.sqrt(t) / np.pi), angle**2, _SERIES / max(angle, 0.1))
        minus_cos = fit_series(lambda t: -np.cos(np.sqrt(t)), angle**2, _SERIES)
        if not monic:
            return DirectionSeries(1.0, angle, sinc, minus_cos)
        n = len(sinc) - 1
        kappa = math.copysign(abs(sinc[n]) ** (1 / (2 * n + 1)), sinc[n])
        scaled = sinc / kappa ** (2.0 * np.arange(n + 1) + 1)
        scaled[n] = 1.0
        return DirectionSeries(kappa, angle, scaled, minus_cos / kappa ** (2.0 * np.arange(len(minus_cos))))

    def decode(self, vector: Value) -> Value:
        """Return the unit direction (3 rows) of kappa v (2 rows)."""
        g = vector.graph
        t = g.square(vector)
        if self.sinc is None or self.minus_cos is None:  # (dx, dy) = slope / sqrt(1 + slope^2), dz = -1 / sqrt(..)
            factor = 1.0 / (t + 1.0).sqrt()
            return g.concat(vector * factor, -factor)
        return g.concat(vector * g.series(t, self.sinc), g.series(t, self.minus_cos))


def scene_ray(model: Fitted, values: CoreValues, series: DirectionSeries, form: Form) -> Value:
    """Return the position on the front surface (mm) and the unit direction, 6 rows."""
    g, position = values.transmittance.graph, values.vectors[POSITION]
    z = g.affine(np.zeros((1, 2)), position) if model.front is None else sag(position, model.front, form)
    direction = series.decode(values.vectors[DIRECTION]) if values.unit is None else values.unit
    if values.index is not None:
        assert model.front is not None
        direction = refracted(position, direction, values.index, model.front)
    return g.concat(position, z, direction)


def refracted(position: Value, inside: Value, index: Value, front: Surface) -> Value:
    """Return the unit direction (3 rows) in front of the lens from that inside the front glass; see `tilt_series`."""
    g, tilt = position.graph, tilt_series(front)
    assert tilt is not None
    across = position * (g.series(g.square(position), tilt) if len(tilt) > 1 else float(tilt[0]))
    normal = g.concat(across, -(1.0 - g.square(across)).maximum(0.0).sqrt())
    cosine = index * g.dot(inside, normal)
    # Where the model's ray is beyond the grazing one, this makes the direction's length differ a little from 1.
    square = (cosine * cosine - index * index + 1.0).maximum(_GRAZING)
    way = inside * index + normal * (square.sqrt() - cosine)
    return way * (1.0 / g.square(way).sqrt())


def tilt_series(front: Surface) -> Array | None:
    """Return sin(tilt) / h of a round surface at the height h, as a power series in h^2 (mm^2).

    It is None where the surface is not round, where no glass is behind it, and where no short series fits.
    """
    figure = front.figure
    if figure.axis or figure.power or float(front.n_d) == 1.0:
        return None
    if figure.plain:
        return np.array([float(front.curvature)])
    curve = curve_of(front)

    def exact(h2: Array) -> Array:
        rise = depth(NUMPY, curve, h2, order=1, steepest=1e-6).slope
        return np.asarray(rise / np.sqrt(1 + rise * rise * h2))

    with np.errstate(all="ignore"):
        reach_mm = _FRONT_REACH * front.semi_diameter_mm
        return _series_in(exact, reach_mm**2, _TILT / reach_mm)


def sag(position: Value, surface: Surface, form: Form) -> Value:
    """Return z of a surface at x and y: by a short series in the squared height where one holds it, else by a root.

    Beyond the end of a conic the value is finite, without meaning.
    """
    g = position.graph
    axes = {None: (0, 1), "x": (0,), "y": (1,)}[surface.figure.axis]
    h2 = g.quadratic(position, [tuple((i, i) for i in axes)])
    c, bend = float(surface.curvature), (1 + float(surface.figure.conic)) * float(surface.curvature) ** 2
    curve = curve_of(surface)

    def exact(square: Array) -> Array:
        return np.asarray(depth(NUMPY, curve, square, order=0, steepest=TINY).sag)

    if form.sag_terms and surface.figure.across is None:
        series = _series_in(exact, (_FRONT_REACH * surface.semi_diameter_mm) ** 2, _SAG_MM)
        if series is not None and len(series) <= form.sag_terms:
            return g.series(h2, series)
    # c h^2 / (1 + root) has no cancellation and no case for a paraboloid.
    other, square, sum_ = surface.figure.across, 1.0 - h2 * bend, h2 * c
    if other is not None and other[1] is not None:
        a2 = g.square(position[int(surface.figure.axis == "x")])
        square, sum_ = square - a2 * ((1 + other[1]) / other[0] ** 2), sum_ + a2 * (1 / other[0])
    z = sum_ / (square.maximum(0.0).sqrt() + 1.0)
    if other is not None and other[1] is None:
        return _turned(position, _with_polynomial(z, h2, surface), surface)
    return _with_polynomial(z, h2, surface)


def _turned(position: Value, curve: Value, surface: Surface) -> Value:
    """Return z of a toroid from that of its curve; see `optics.trace.shapes.sag_mm`."""
    assert surface.figure.across is not None
    c, a2 = 1 / surface.figure.across[0], position.graph.square(position[int(surface.figure.axis == "x")])
    way = 1.0 - curve * c
    return (curve * (way + 1.0) + a2 * c) / ((way * way - a2 * (c * c)).maximum(0.0).sqrt() + 1.0)


def _with_polynomial(z: Value, h2: Value, surface: Surface) -> Value:
    powers, curve = {int(p): float(a) for p, a in surface.figure.powers}, curve_of(surface)
    if not powers:
        return z
    if curve.centred is not None:  # powers that float32 does not carry
        return z + polynomials(Graphs(z.graph), curve, h2, order=0)[0] * h2
    rim, even = surface.semi_diameter_mm, all(p % 2 == 0 for p in powers)
    h, step = (h2 * rim**-2, 2) if even else ((h2 * rim**-2).sqrt(), 1)
    terms = np.zeros(max(powers) // step + 1)
    for p, a in powers.items():
        terms[p // step] = a * rim**p
    return z + z.graph.series(h, terms)


def fit_series(function: Callable[[Array], Array], upper: float, tolerance: float) -> Array:
    """Fit a power series of the lowest degree that holds the tolerance on [0, upper] (Chebyshev interpolation)."""
    t = np.linspace(0, upper, 400)
    for degree in range(1, 16):
        fit = np.polynomial.Chebyshev.interpolate(function, degree, [0, upper])
        if np.abs(fit(t) - function(t)).max() < tolerance:
            break
    return np.asarray(fit.convert(kind=np.polynomial.Polynomial).coef, dtype=np.float64)


def _series_in(function: Callable[[Array], Array], reach: float, tolerance: float) -> Array | None:
    """Fit a power series, in units of `reach`, that holds twice the tolerance on [0, reach]; None where none does."""
    series = fit_series(lambda s: function(s * reach), 1.0, tolerance)
    t = np.linspace(0, 1, 1000)
    off = np.abs(np.polynomial.Polynomial(series)(t) - function(t * reach)).max()
    return series / reach ** np.arange(len(series)) if off < 2 * tolerance else None
