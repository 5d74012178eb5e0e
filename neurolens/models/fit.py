"""Fits: from settings to a complete model, of one state of a lens or of many (zoom, internal focus).

A `StateSpace` says which states: it has the axes of a lens file, and its lens and domain at every state. Models of many
states have one structure; every number of the model at a state is interpolated between nodes (see `models.axes`), so
that it is a plain `LensModel`. A core is linear in its numbers: its error at a state is at most a small multiple (the
Lebesgue constant) of the nodes' errors, plus the error of interpolating the exact lens itself.

A fit of many states chooses one support and the same gates for all nodes; the coefficients of each node are fitted on
its own rays. They need not vary smoothly, because what is mixed between nodes is the functions. Measured on three
zooms: between nodes the error is that at the nodes, and at most doubles.
"""

import itertools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from neurolens.base.errors import InputError
from neurolens.base.report import some_of
from neurolens.base.settings import LIGHT_NM
from neurolens.models.axes import Array, Axis, product, weights
from neurolens.models.boundaries import invariant_core
from neurolens.models.cores import STOP, Core, Refracted, Residual
from neurolens.models.fitted import Domain, Encoding, Scales
from neurolens.models.model import LensModel, mixed
from neurolens.models.network import fit_network, training_s, with_boundary_terms
from neurolens.models.pairs import (
    PairSettings,
    RayPairs,
    domain_of,
    make_pairs,
)
from neurolens.models.phase import with_phase
from neurolens.models.polynomial import fit_mirror, fit_paraxial, fit_planes, fit_polynomial
from neurolens.models.targets import (
    NETWORKS,
    PLANES_SEARCHED,
    POLYNOMIALS,
    TRANSMITTANCE_TERMS,
    ModelSettings,
    Prepared,
    film_equivalent,
    fit_encoding,
    grazes,
    index_series,
    inside_front,
    prepare,
    scales_of,
    with_angle,
    without_idle_gates,
)  # fmt: skip
from neurolens.models.terms import (
    Exponents,
    Sweep,
    forward,
    invariant_exponents,
    kept,
    monomials,
    pinned_threads,
    replace_terms,
    solve,
    vector_columns,
)  # fmt: skip
from neurolens.models.transmittance import with_transmittance
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.setting.focusing import film_range_mm, focused_inside, infinity_states, nearest_focus_m
from neurolens.optics.setting.pupils import image_radius_mm
from neurolens.optics.setting.states import set_lens


def fit_model(
    prepared: Prepared,
    settings: ModelSettings,
    progress: Callable[[float], object] = lambda share: None,
    *,
    checkpoint: Path | None = None,
) -> LensModel:
    """Fit one surrogate.

    Args:
        checkpoint: file in which the training of networks keeps its state, to go on from there after a kill (see
            `fit_network`). The fit does not remove the file when it ends: the caller does.

    Raises:
        InputError: an unknown method, or settings that the method refuses.
    """
    start = time.perf_counter()
    pairs, encoding = prepared.pairs, prepared.encoding
    with pinned_threads():
        shown, refracts = pairs, settings.method in POLYNOMIALS and grazes(pairs)
        if refracts:
            shown = replace(pairs, train=inside_front(pairs.lens, pairs.train))
        if settings.planes and settings.method in PLANES_SEARCHED:
            encoding = fit_planes(shown, encoding, settings.terms, settings.position_weight)
        core = _fit_core(replace(prepared, pairs=shown, encoding=encoding), settings, progress, checkpoint)
        if refracts:
            core = Refracted((core,), index_series(pairs.lens, encoding))
    fit_s = max(time.perf_counter() - start, training_s(checkpoint))
    model = as_model(replace(prepared, encoding=encoding), core, settings, fit_s)
    if settings.family != "paraxial":
        sample = (pairs.train.inputs, pairs.train.transmittance)
        model = with_transmittance([model], [sample], settings.transmittance_terms)[0]
    if settings.phase:
        model = with_phase(model, pairs.train.inputs)
    return without_idle_gates((model,), settings.idle_gates)[0] if settings.idle_gates else model


def as_model(prepared: Prepared, core: Core, settings: ModelSettings, fit_s: float) -> LensModel:
    """Make a complete model of a core that was fitted to the prepared pairs in `fit_s` seconds."""
    pairs = prepared.pairs
    model = LensModel(
        lens=pairs.lens,
        domain=pairs.domain,
        encoding=prepared.encoding,
        scales=scales_of(pairs.lens),
        gates=prepared.gates,
        core=core,
        method=settings.label,
        settings={**asdict(settings), "rays": len(pairs.train), "rays_seed": pairs.settings.seed},
        direction="slope" if settings.family == "paraxial" else "angle",
        fit_s=fit_s,
    )
    return with_angle(model)


def _fit_core(
    prepared: Prepared, settings: ModelSettings, progress: Callable[[float], object], checkpoint: Path | None
) -> Core:
    mirror = prepared.encoding.mirror
    if settings.method in ("thin", "thick") and not mirror:
        return fit_paraxial(prepared, settings.method)
    if settings.method not in (*POLYNOMIALS, *NETWORKS):
        methods = ("thin", "thick", *POLYNOMIALS, *NETWORKS)
        raise InputError("fit", "method", settings.method, f"one of {', '.join(methods)}")
    if mirror and settings.method != "mlp":
        return fit_mirror(prepared, settings.method, settings.terms, settings.degree)
    base = None
    if settings.method != "mlp":
        base = fit_polynomial(prepared, replace(settings, method="ols") if settings.method == "ols+mlp" else settings)
    if settings.method not in NETWORKS:
        assert base is not None
        return base
    network = fit_network(prepared, settings, base=base, checkpoint=checkpoint, progress=progress)
    return with_boundary_terms(prepared, network) if base is None else Residual((base, network))


# ---- lenses in many states ----

State = tuple[float, ...]

# Degree of the polynomials between stated positions: of a zoom, by the largest ratio of two neighbours, so that
# interpolation adds no more error than the nodes have (measured on five zooms).
FOCUS_DEGREE, _BASE_DEGREE, _DEGREES_PER_LOG = 4, 2, 4.6
_LEAST_STEPS = 6  # between nodes, over the whole range
# With both axes the nodes multiply: one degree less of each.
_FEWER = 1
_SAME = 1e-3  # focal lengths that differ by less than this share are one
# Zoom positions at which the common near limit of internal focus is sought.
_LIMITS = 9
_GAP_MM, _MOST = 1e-4, 12  # an error of interpolated gaps that is small enough; the highest degree tried for it
_BETWEEN = (0.08, 0.35, 0.5, 0.77, 0.93)  # where gaps are measured, as shares of the way from knot to knot
# Nodes that choose the support and the gates; the others only fit coefficients.
_CHOOSERS = 7
_PASSES = 2  # passes of replacement


@dataclass(frozen=True)
class StateSpace:
    """The states of a lens that one model covers.

    Attributes:
        lens: the lens as its file gives it, or scaled.
        axes: zoom, internal focus, or both in this order.
        zoom: the state of the file, where zoom is no axis.
        f_number: None takes the widest stop of each state.
        film_radius_mm: None takes the lit film of each state.
        focus_m: object distances (far, near) that moving the film reaches, the same in every state, or a function of
            the lens. They have no effect where internal focus is an axis.
        wavelength_nm: shortest and longest.
    """

    lens: Lens
    axes: tuple[Axis, ...]
    zoom: str | float | None = None
    f_number: float | None = None
    film_radius_mm: float | None = None
    focus_m: tuple[float, float] | Callable[[Lens], tuple[float, float]] = (math.inf, math.inf)
    wavelength_nm: tuple[float, float] = LIGHT_NM

    @property
    def _knots(self) -> tuple[Axis, ...]:
        return tuple(replace(a, degree=1) for a in self.axes)

    @cached_property
    def _planes_mm(self) -> Array:
        """Find, at every knot of the axes, the plane on which the pupil is smallest."""
        return np.array([self._domain(state, None).pupil_z_mm for state in product(self._knots)])

    def _settings(self, state: Sequence[float]) -> tuple[str | float | None, float | None]:
        """Return the zoom position, and the distance (m) of internal focus where that is an axis."""
        values = dict(zip((a.name for a in self.axes), state, strict=True))
        vergence = values.get("focus")
        focus_m = None if vergence is None else 1 / vergence if vergence > 0 else math.inf
        return values.get("zoom", self.zoom), focus_m

    def lens_at(self, state: Sequence[float]) -> Lens:
        """Return the exact lens at a state; focused there where internal focus is an axis, else at infinity focus."""
        return self._lens(*self._settings(state))

    def _lens(self, zoom: str | float | None, focus_m: float | None) -> Lens:
        lens = set_lens(self.lens, zoom=zoom, f_number=self.f_number)
        return lens if focus_m is None else focused_inside(lens, focus_m)

    def domain_at(self, state: Sequence[float]) -> Domain:
        """Return the domain of a state: the full lit film, and the film positions that focusing by the film needs.

        Its pupil plane is interpolated linearly between the knots: the plane of the smallest pupil jumps between
        states.
        """
        return self._domain(state, float(weights(self._knots, state) @ self._planes_mm))

    def _domain(self, state: Sequence[float], pupil_z_mm: float | None) -> Domain:
        zoom, focus_m = self._settings(state)
        lens, radius, film_z = self._lens(zoom, focus_m), self.film_radius_mm, None
        if focus_m is None:
            focus = self.focus_m if isinstance(self.focus_m, tuple) else self.focus_m(lens)
        else:
            # The picture's size is that of the lens at infinity focus: it breathes, the film does not.
            if radius is None:
                radius = image_radius_mm(self._lens(zoom, math.inf))[0]
            focus, film_z = (focus_m, focus_m), film_range_mm(lens, focus_m, self.wavelength_nm)
        return domain_of(
            lens,
            film_radius_mm=radius,
            focus_m=focus,
            wavelength_nm=self.wavelength_nm,
            film_z_mm=film_z,
            pupil_z_mm=pupil_z_mm,
        )


def zoom_axis(lens: Lens, degree: int | None = None) -> Axis:
    """Return the axis of a zoom's whole range: focal length in mm, smooth between the states of the file.

    With `degree` None it follows from the range.

    Raises:
        InputError: a file with fewer than two zoom states.
    """
    stated = sorted((float(first_order(set_lens(lens, zoom=s.name)).efl_mm), s.name) for s in infinity_states(lens))
    knots: list[float] = []
    for efl, _ in stated:
        if not knots or efl > knots[-1] * (1 + _SAME):
            knots.append(efl)
    if len(knots) < 2:
        raise InputError(lens.path, "zoom", "range", "a lens file with two zoom states or more")
    if degree is None:
        largest = max(b / a for a, b in zip(knots, knots[1:], strict=False))
        degree = _BASE_DEGREE + math.ceil(_DEGREES_PER_LOG * math.log(largest))
        degree = max(degree, math.ceil(_LEAST_STEPS / (len(knots) - 1)))
    # Ray slopes go as 1 / f: in that coordinate they are straight.
    return Axis("zoom", "mm", tuple(knots), degree, reciprocal=True, stated=tuple((n, e) for e, n in stated))


def focus_axis(lens: Lens, zoom: Sequence[str | float | None] = (None,), degree: int = FOCUS_DEGREE) -> Axis:
    """Return the axis of internal focus: vergence (1/m) from infinity to the near limit of all zoom positions given.

    Raises:
        InputError: a file without focus states.
    """
    nearest = max(nearest_focus_m(set_lens(lens, zoom=z)) for z in zoom)
    return Axis("focus", "1/m", (0.0, (1 - 1e-9) / nearest), degree)


def axes_of(lens: Lens, *, zoom: bool, internal: bool, state: str | float | None = None) -> tuple[Axis, ...]:
    """Return the axes of a model of many states: the zoom's whole range, internal focus, or both.

    Args:
        state: the zoom position of a model that has no axis of zoom.

    Raises:
        InputError: neither axis is asked for, or the lens file has no states for it.
    """
    if not (zoom or internal):
        raise InputError(lens.path, "states", "(none)", "the zoom's range, internal focus, or both")
    if not zoom:
        return (focus_axis(lens, (state,)),)
    first = zoom_axis(lens)
    if not internal:
        return (first,)
    low, high = first.range
    zooms = [1 / (1 / high + (1 / low - 1 / high) * k / (_LIMITS - 1)) for k in range(_LIMITS)]
    focus = focus_axis(lens, [*(n for n, _ in first.stated), *(v for v in zooms if low < v < high)])
    return replace(first, degree=max(1, first.degree - _FEWER)), replace(focus, degree=focus.degree - _FEWER)


@dataclass(frozen=True)
class StateModel:
    """Models at the nodes of one or more state axes.

    Attributes:
        space: the states, and the exact lens at each.
        nodes: one model a node, in the order of `models.axes.product`; they differ in numbers alone.
        fit_s: seconds that the whole fit took.
    """

    space: StateSpace
    nodes: tuple[LensModel, ...]
    fit_s: float = 0.0

    def __post_init__(self) -> None:
        count = len(product(self.axes))
        if len(self.nodes) != count:
            raise InputError("state model", "nodes", f"({len(self.nodes)})", f"{count}, as many as the axes have")

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Return the state variables."""
        return self.space.axes

    @property
    def first_state(self) -> State:
        """Return the first end of every axis: what a model shows where no state is asked for."""
        return tuple(a.range[0] for a in self.axes)

    def at(self, *state: float) -> LensModel:
        """Return the model of one state; raises InputError as `models.axes.weights`."""
        first = self.nodes[0]
        return replace(
            mixed(self.nodes, weights(self.axes, state)),
            lens=self.space.lens_at(state),
            settings={**first.settings, "state": dict(zip((a.name for a in self.axes), state, strict=True))},
            fit_s=self.fit_s,
        )


def gap_axis(first: Axis, lens_at: Callable[[float], Lens]) -> tuple[Axis, float]:
    """Return an axis with enough nodes to interpolate the lens's gaps, and their largest error (mm) between nodes.

    Args:
        first: the axis with the least degree that is tried.
    """

    def vertices_mm(value: float) -> Array:
        lens = lens_at(value)
        return np.array(lens.vertices_mm[: len(lens.surfaces)])

    coordinates = [1 / knot if first.reciprocal else knot for knot in first.knots]
    between = [a + (b - a) * share for a, b in itertools.pairwise(coordinates) for share in _BETWEEN]
    exact = {v: vertices_mm(v) for v in (1 / c if first.reciprocal else c for c in between)}
    for degree in range(first.degree, _MOST + 1):
        axis = replace(first, degree=degree)
        nodes = np.array([vertices_mm(v) for v in axis.nodes])
        error = max(float(np.abs(axis.weights(v) @ nodes - wanted).max()) for v, wanted in exact.items())
        if error < _GAP_MM:
            break
    return axis, error


# ---- fits ----


@dataclass(frozen=True)
class StateSettings:
    """How a model of many states is fitted: see `ModelSettings`; `rays` are those of each node."""

    terms: int = 64
    degree: int = 7
    rays: int = 20_000
    seed: int = 1
    name: str = ""
    transmittance_terms: int = TRANSMITTANCE_TERMS

    @property
    def label(self) -> str:
        return self.name or f"states-{self.terms}"


def fit_states(
    space: StateSpace, settings: StateSettings | None = None, progress: Callable[[float], object] = lambda share: None
) -> StateModel:
    """Fit a model of all states of a space.

    Args:
        progress: called with the share done.

    Raises:
        InputError: what `pairs.make_pairs` refuses at a node; fewer than two terms.
    """
    settings, start = settings or StateSettings(), time.perf_counter()
    if space.lens.anamorphic:
        raise InputError(space.lens.path, "surfaces", "(cylinders)", "a lens that is round about its axis, for states")
    if not 2 <= settings.terms < settings.rays:
        raise InputError("fit", "terms", settings.terms, f"from 2 to fewer than the {settings.rays} rays of a node")
    states = product(space.axes)
    with pinned_threads():
        choosers = some_of(range(len(states)), _CHOOSERS)
        chosen: dict[int, Prepared] = {}
        for done, k in enumerate(choosers):
            chosen[k] = prepare(_pairs(space, states[k], settings))
            progress(0.3 * (done + 1) / len(choosers))
        # Every gate that any node needs, in the order in which camera rays meet them.
        needed = {g for p in chosen.values() for g in p.gates}
        gates = tuple(sorted(needed, key=lambda g: (-g.surface, g.reason)))
        # Scales and chief ray are those of all nodes: a node's own follow its domain, which need not be smooth in the
        # state, and so would make models that are not smooth in it either.
        encodings = [d.encoding for d in chosen.values()]
        largest = {key: max(getattr(e, key) for e in encodings) for key in ("film_scale_mm", "pupil_scale_mm")}
        scales = replace(encodings[0], chief=sum(e.chief for e in encodings) / len(encodings), **largest)
        chosen = {k: replace(d, encoding=_scaled_like(scales, d.encoding)) for k, d in chosen.items()}
        stop_mm = max(d.pairs.lens.stop_radius_mm for d in chosen.values())
        exponents, columns = _choose_jointly(list(chosen.values()), settings)
        nodes, samples = [], []
        for k, state in enumerate(states):
            if k in chosen:
                data = replace(chosen.pop(k), gates=gates)
            else:
                pairs = _pairs(space, state, settings)
                data = Prepared(pairs, _scaled_like(scales, fit_encoding(pairs.domain, pairs.train)), gates)
            nodes.append(_fit_node(data, exponents, columns, stop_mm, settings))
            samples.append((data.pairs.train.inputs, data.pairs.train.transmittance))
            progress(0.4 + 0.6 * (k + 1) / len(states))
        nodes = with_transmittance(nodes, samples, settings.transmittance_terms)
    return StateModel(space, tuple(nodes), time.perf_counter() - start)


def _pairs(space: StateSpace, state: State, settings: StateSettings) -> RayPairs:
    lens, domain = space.lens_at(state), space.domain_at(state)
    return make_pairs(lens, domain, PairSettings(settings.rays, 1, settings.rays, settings.seed))


def _scaled_like(scales: Encoding, own: Encoding) -> Encoding:
    """Return a node's encoding: its own planes, with the scales of all nodes."""
    return replace(scales, film_plane_z_mm=own.film_plane_z_mm, pupil_plane_z_mm=own.pupil_plane_z_mm)


def _choose_jointly(data: Sequence[Prepared], settings: StateSettings) -> tuple[Exponents, list[int]]:
    """Choose one support for all nodes: orthogonal least squares by the sum of their gains, then replacement.

    Returns the exponents [M, 4] kept and the columns of `vector_columns` chosen among them (m p, then m u).
    """
    exponents = invariant_exponents(settings.degree, dispersive=data[0].encoding.dispersive)
    sweeps = []
    for d in data:
        train = d.train
        outputs = film_equivalent(d.pairs.lens, d.pairs.domain, train.vectors)
        sweeps.append(Sweep.of_vectors(monomials(train.field.invariants(), exponents), train.field, outputs))
    joint = Sweep.joined(sweeps)
    forward(joint, settings.terms)
    replace_terms(joint, _PASSES)
    return kept(exponents, sorted(joint.chosen))


def _fit_node(
    data: Prepared, exponents: Exponents, columns: list[int], stop_mm: float, settings: StateSettings
) -> LensModel:
    """Fit the model of one node; its stop crossing is in units of `stop_mm`, the same at every node."""
    pairs, train, scales = data.pairs, data.train, scales_of(data.pairs.lens)
    vectors = vector_columns(monomials(train.field.invariants(), exponents), train.field)[columns]
    core = invariant_core(data, exponents, columns, solve(vectors, train.vectors[:STOP].flatten(1)))
    core.ab[STOP] *= scales.stop_mm / stop_mm
    model = LensModel(
        lens=pairs.lens,
        domain=pairs.domain,
        encoding=data.encoding,
        scales=Scales(scales.position_mm, stop_mm),
        gates=data.gates,
        core=core,
        method=settings.label,
        settings={"method": "ols", **asdict(settings), "rays_seed": settings.seed},
    )
    return with_angle(model)
