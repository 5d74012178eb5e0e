"""Surrogates of a lens in many states (zoom, internal focus): models of one structure at nodes, mixed between.

A `StateSpace` says which states: the axes of a lens file, and its lens and domain at every state. Every number of the
model at a state is interpolated from the nodes (see `surrogates.axes`), so that the model at a state is a plain
`LensModel`, and everything that knows those knows this one. A core is linear in its numbers: its error at a state is at
most a small multiple (the Lebesgue constant) of the nodes' errors, plus that of interpolating the exact lens itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from neurolens.base.errors import InputError
from neurolens.lens.paraxial import first_order
from neurolens.lens.prescription import Lens
from neurolens.setting.focusing import film_range_mm, infinity_states, nearest_focus_m
from neurolens.setting.pupils import image_radius_mm
from neurolens.setting.states import set_lens
from neurolens.surrogates.axes import Array, Axis, product, weights
from neurolens.surrogates.domain import domain_of
from neurolens.surrogates.model import Domain, LensModel, mixed

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
_GAP_MM, _MOST = 1e-4, 12  # error of interpolated gaps that is enough, and the highest degree tried for it
_BETWEEN = (0.08, 0.35, 0.5, 0.77, 0.93)  # of the way from knot to knot: where gaps are measured


@dataclass(frozen=True)
class StateSpace:
    """The states of a lens that one model is of.

    Attributes:
        lens: the lens as its file gives it, or scaled.
        axes: zoom, internal focus, or both in this order.
        zoom: state of the file where zoom is no axis.
        f_number: None is the widest stop of each state.
        film_radius_mm: None takes the lit film of each state.
        focus_m: object distances (far, near) that moving the film reaches, the same in every state or following from
            the lens. Without effect where internal focus is an axis.
        wavelength_nm: shortest and longest.
    """

    lens: Lens
    axes: tuple[Axis, ...]
    zoom: str | float | None = None
    f_number: float | None = None
    film_radius_mm: float | None = None
    focus_m: tuple[float, float] | Callable[[Lens], tuple[float, float]] = (math.inf, math.inf)
    wavelength_nm: tuple[float, float] = (400.0, 700.0)

    @cached_property
    def _planes_mm(self) -> list[float]:
        """The tightest pupil plane at every knot of the axes."""
        return [self._domain(state, None).pupil_z_mm for state in product(self._knots)]

    @property
    def _knots(self) -> tuple[Axis, ...]:
        return tuple(replace(a, degree=1) for a in self.axes)

    def _asked(self, state: Sequence[float]) -> tuple[str | float | None, float | None]:
        """Zoom position, and the distance (m) of internal focus where that is an axis."""
        values = dict(zip((a.name for a in self.axes), state, strict=True))
        vergence = values.get("focus")
        focus_m = None if vergence is None else 1 / vergence if vergence > 0 else math.inf
        return values.get("zoom", self.zoom), focus_m

    def lens_at(self, state: Sequence[float]) -> Lens:
        """The exact lens at a state; with internal focus, focused there, else at infinity focus."""
        zoom, focus_m = self._asked(state)
        return self._lens(zoom, focus_m)

    def _lens(self, zoom: str | float | None, focus_m: float | None) -> Lens:
        if focus_m is None:
            return set_lens(self.lens, zoom=zoom, f_number=self.f_number)
        distance = None if math.isinf(focus_m) else focus_m
        return set_lens(self.lens, zoom=zoom, f_number=self.f_number, focus_mode="internal", focus_m=distance)

    def domain_at(self, state: Sequence[float]) -> Domain:
        """The domain of a state: the full lit film, and the film positions that focusing by the film needs.

        Its pupil plane is straight between the knots: the tightest one of every state by itself would jump.
        """
        return self._domain(state, float(weights(self._knots, state) @ np.array(self._planes_mm)))

    def _domain(self, state: Sequence[float], pupil_z_mm: float | None) -> Domain:
        zoom, focus_m = self._asked(state)
        lens, radius, film_z = self._lens(zoom, focus_m), self.film_radius_mm, None
        if focus_m is None:
            focus = self.focus_m if isinstance(self.focus_m, tuple) else self.focus_m(lens)
        else:
            # The picture's size is that of the lens at infinity focus: it breathes, the film does not.
            if radius is None:
                radius = image_radius_mm(self._lens(zoom, math.inf))[0]
            assert lens.film_z_mm is not None
            film_z = film_range_mm(lens, focus_m, self.wavelength_nm)
            focus = (focus_m, focus_m)
        return domain_of(
            lens,
            film_radius_mm=radius,
            focus_m=focus,
            wavelength_nm=self.wavelength_nm,
            film_z_mm=film_z,
            pupil_z_mm=pupil_z_mm,
        )


def zoom_axis(lens: Lens, degree: int | None = None) -> Axis:
    """The whole range of a zoom: focal length in mm, smooth between the states of the file.

    `degree` None follows from the range.

    Raises:
        InputError: a file with fewer than two zoom states.
    """
    found = sorted((float(first_order(set_lens(lens, zoom=s.name)).efl_mm), s.name) for s in infinity_states(lens))
    knots: list[float] = []
    for efl, _ in found:
        if not knots or efl > knots[-1] * (1 + _SAME):
            knots.append(efl)
    if len(knots) < 2:
        raise InputError(lens.path, "zoom", "range", "a lens file with two zoom states or more")
    if degree is None:
        largest = max(b / a for a, b in zip(knots, knots[1:], strict=False))
        degree = _BASE_DEGREE + math.ceil(_DEGREES_PER_LOG * math.log(largest))
        degree = max(degree, math.ceil(_LEAST_STEPS / (len(knots) - 1)))
    # Ray slopes go as 1 / f: in that coordinate they are straight.
    return Axis("zoom", "mm", tuple(knots), degree, reciprocal=True, stated=tuple((n, e) for e, n in found))


def focus_axis(lens: Lens, zoom: Sequence[str | float | None] = (None,), degree: int = FOCUS_DEGREE) -> Axis:
    """Internal focus from infinity to the near limit that all the zoom positions given reach: vergence in 1/m.

    Raises:
        InputError: a file without focus states.
    """
    nearest = max(nearest_focus_m(set_lens(lens, zoom=z)) for z in zoom)
    return Axis("focus", "1/m", (0.0, (1 - 1e-9) / nearest), degree)


def axes_of(lens: Lens, *, zoom: bool, internal: bool, state: str | float | None = None) -> tuple[Axis, ...]:
    """The axes asked for: the zoom's whole range, internal focus, or both.

    Args:
        state: the zoom position where `zoom` is False.

    Raises:
        InputError: neither, or what the file has no states for.
    """
    if not (zoom or internal):
        raise InputError(lens.path, "states", "(none)", "the zoom's range, internal focus, or both")
    if not zoom:
        return (focus_axis(lens, (state,)),)
    first = zoom_axis(lens)
    if not internal:
        return (first,)
    low, high = first.range
    places = [1 / (1 / high + (1 / low - 1 / high) * k / (_LIMITS - 1)) for k in range(_LIMITS)]
    inner = [v for v in places if low < v < high]
    focus = focus_axis(lens, [*(n for n, _ in first.stated), *inner])
    return replace(first, degree=max(1, first.degree - _FEWER)), replace(focus, degree=focus.degree - _FEWER)


@dataclass(frozen=True)
class StateModel:
    """Models at the nodes of one or more state axes.

    Attributes:
        space: the states, and the exact lens at each.
        nodes: one model a node, in the order of `surrogates.axes.product`; of one structure: they differ in numbers.
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
        """The state variables."""
        return self.space.axes

    @property
    def first_state(self) -> State:
        """The first end of every axis: what a model shows where no state is asked for."""
        return tuple(a.range[0] for a in self.axes)

    def at(self, *state: float) -> LensModel:
        """The model of one state; InputError as `surrogates.axes.weights`."""
        first = self.nodes[0]
        return replace(
            mixed(self.nodes, weights(self.axes, state)),
            lens=self.space.lens_at(state),
            settings={**first.settings, "state": dict(zip((a.name for a in self.axes), state, strict=True))},
            fit_s=self.fit_s,
        )


def gap_axis(first: Axis, lens_at: Callable[[float], Lens]) -> tuple[Axis, float]:
    """An axis with nodes enough for the gaps of the lens at its values, and their largest error in mm between nodes.

    Args:
        first: the axis, of the least degree that is tried.
    """

    def places(value: float) -> Array:
        lens = lens_at(value)
        return np.array(lens.vertices_mm[: len(lens.surfaces)])

    def turned(value: float) -> float:
        return 1 / value if first.reciprocal else value

    ends = [(turned(a), turned(b)) for a, b in zip(first.knots, first.knots[1:], strict=False)]
    known = [(v, places(v)) for a, b in ends for v in (turned(a + (b - a) * share) for share in _BETWEEN)]
    for degree in range(first.degree, _MOST + 1):
        axis = replace(first, degree=degree)
        nodes = np.array([places(v) for v in axis.nodes])
        error = max(float(np.abs(weights((axis,), (v,)) @ nodes - exact).max()) for v, exact in known)
        if error < _GAP_MM:
            break
    return axis, error
