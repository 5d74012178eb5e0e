"""A lens in one state as a shader uses it: its graph over ranges of film position, wavelength and stop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base import status as st
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.pupil_search import PupilTable, end_of_light, pass_test
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph, Value
from neurolens.lens.prescription import LINE_D_NM
from neurolens.shaders.source import Focusing

if TYPE_CHECKING:
    from neurolens.shaders.pupil import PupilCircles, PupilDisc

Array = NDArray[np.float64]
_PART = 1 << 15  # rays that are evaluated together
_PARTS, _LOW_BITS = 16.0, 4096.0  # of the spectrum; the bits of a number below 1 / 4096 choose the place within a part


@dataclass(frozen=True)
class ShaderLens:
    """A lens in one state.

    Attributes:
        graph: the lens; see `cameragraph.LensGraph`.
        table: boxes on the pupil plane that hold the rays which pass.
        film_z_mm, wavelength_nm: the ranges. stop_radius_mm: the widest stop.
        stop_surface: its number, for the status of the rays that it blocks.
        anamorphic: whether the lens is symmetric about the x and y axes only.
        focusing: where the film stands. f_number: of the widest stop. efl_mm: the focal length.
    """

    graph: Graph
    table: PupilTable
    film_z_mm: tuple[float, float]
    wavelength_nm: tuple[float, float]
    stop_radius_mm: float
    stop_surface: int
    anamorphic: bool
    focusing: Focusing
    f_number: float
    efl_mm: float

    @property
    def film_radius_mm(self) -> float:
        """The model knows no ray from beyond it."""
        return self.table.film_radius_mm

    def end_of_light_mm(self) -> float:
        """The film radius at which light ends."""
        low, high = self.film_z_mm
        radii = [0.0]
        for z in {low, (low + high) / 2, high}:
            for azimuth in np.linspace(0, np.pi / 2, 4) if self.anamorphic else [0.0]:
                passes = partial(self._passes, film_z=z, azimuth=azimuth)
                radii.append(end_of_light(self.table, pass_test(passes, self.wavelength_nm)) or 0.0)
        return min(max(radii), self.film_radius_mm)

    def drawn_in_boxes(self, radius: Array, rng: np.random.Generator) -> Array:
        """Random pupil points [2, N] in the boxes of film points at radii [N] along +x."""
        radii = np.linspace(0, self.film_radius_mm, self.table.rows.shape[1])
        low, high, half = (np.interp(radius, radii, row) for row in self.table.rows)
        return np.stack([low + (high - low) * rng.random(radius.size), half * rng.uniform(-1, 1, radius.size)])

    def _passes(
        self, film: FloatArray, pupil: FloatArray, nanometres: float, film_z: float, azimuth: float
    ) -> NDArray[np.bool_]:
        """Test whether rays pass through points [2, N] of the boxes, turned about the axis or mirrored."""
        cos, sin = np.cos(azimuth), np.sin(azimuth)
        turn, sides = np.array([[cos, -sin], [sin, cos]]), (1.0, -1.0) if self.anamorphic else (1.0,)
        points = [(turn @ film, turn @ (pupil * [[1.0], [side]])) for side in sides]
        codes = np.stack([self.status(*pair, nanometres, film_z, self.stop_radius_mm) for pair in points])
        return np.asarray((np.hypot(*film) <= self.film_radius_mm) & (codes == st.PASSED).any(0))

    def status(
        self, film: ArrayLike, pupil: ArrayLike, nanometres: ArrayLike, film_z: ArrayLike, stop: ArrayLike
    ) -> NDArray[Any]:
        """Status [N] of rays from film points [2, N] through pupil points [2, N] (mm). The other arguments are [N] or
        one number."""
        film = np.asarray(film)
        rays = np.concatenate([film, pupil, np.broadcast_to(nanometres, (1, film.shape[1]))]).astype(np.float32)
        call = {"film_z_mm": _row(film_z), "stop_radius_mm": _row(stop)}
        codes = []
        for start in range(0, rays.shape[1], _PART):
            part = np.s_[:, start : start + _PART]
            inputs = {"rays": rays[part]} | {name: v[part] if v.size > 1 else v for name, v in call.items()}
            status = evaluate(self._status, inputs)["status"][0]
            codes.append(np.broadcast_to(status, inputs["rays"].shape[1]))
        return np.concatenate(codes) if codes else np.zeros(0)

    @cached_property
    def _status(self) -> Graph:
        """The graph of the status alone."""
        return replace(self.graph, outputs={"status": self.graph.outputs["status"]})


def _row(value: ArrayLike) -> NDArray[np.float32]:
    return np.asarray(value, np.float32).reshape(1, -1)


_SAMPLES, _TRIES = 20_000, 64  # film points; samples that decide whether one has light


def passing_share(
    lens: ShaderLens, pupil: PupilCircles | PupilDisc, stops: Sequence[float] = (1.0, 0.5, 0.25)
) -> dict[float, float]:
    """The share of samples that pass, all over the film, by shares of the widest stop.

    Film points without light do not count: those whose ray is blocked count where any of 64 more rays passes.
    """
    rng, shares = np.random.default_rng(3), {}
    for stop in stops:
        angle, radius = 2 * np.pi * rng.random(_SAMPLES), 0.98 * pupil.film_radius_mm * np.sqrt(rng.random(_SAMPLES))
        film = radius * np.stack([np.cos(angle), np.sin(angle)])
        call = np.stack([rng.uniform(*span, _SAMPLES) for span in (lens.film_z_mm, lens.wavelength_nm)])
        passed = _sampled(lens, pupil, rng.random((2, _SAMPLES)), film, call, stop)
        blocked = np.flatnonzero(~passed)
        lit, tries = np.zeros(blocked.size, bool), 0
        while tries < _TRIES and not lit.all():
            # Each round doubles the rays of a dark point: a call with few rays takes nearly as long as one with many.
            more = min(max(1, min(tries, _SAMPLES // int(np.count_nonzero(~lit)))), _TRIES - tries)
            dark, tries = np.repeat(blocked[~lit], more), tries + more
            again = _sampled(lens, pupil, rng.random((2, dark.size)), film[:, dark], call[:, dark], stop)
            lit[~lit] = again.reshape(-1, more).any(1)
        shares[stop] = float(passed.sum() / max(passed.sum() + lit.sum(), 1))
    return shares


def _sampled(
    lens: ShaderLens, pupil: PupilCircles | PupilDisc, square: Array, film: Array, call: Array, share: float
) -> NDArray[np.bool_]:
    """Test whether rays [N] of points of the unit square pass, at film positions and wavelengths `call` [2, N]."""
    (film_z, nanometres), stop = call, np.array([[share * lens.stop_radius_mm]])
    inputs = {"film_mm": film, "square": square, "film_z_mm": film_z[None], "wavelength_nm": nanometres[None]}
    sample = evaluate(pupil.graph, inputs | {"stop_radius_mm": stop})
    passed = lens.status(film, sample["pupil_mm"], nanometres, film_z, stop) == st.PASSED
    return np.asarray(passed & (sample["area_mm2"][0] > 0))


def light(range_nm: tuple[float, float], numbers: Value, in_colour: Value) -> tuple[Value, Value, Value]:
    """Choose a ray's wavelength and colour weights [3], red to blue; its two random numbers leave two for its pupil.

    Cycles's numbers are the second and third dimension of Sobol's sequence, most even in their high bits. Four bits
    choose one of sixteen parts of the spectrum: the first of either number, whether the second ones differ, and the
    third of the first number. Its lowest bits choose the wavelength within the part, and the other bits are left. So
    sixteen samples of a pixel hold each eighth of the spectrum twice, once in either half by which adaptive sampling
    judges noise. A half holds the samples whose index has an odd number of the bits 2, 8, 32...: the second bit of a
    number is uneven there, and the first ones, and whether the second ones differ, are even. The weights are
    Bernstein's polynomials of second order: never negative, of mean 1 each.
    """
    g, (short, long) = numbers.graph, range_nm
    halves = numbers * 2.0
    left = halves - halves.floor()
    quarters, many = (left * 2.0).floor(), left[0] * 4.0
    first, third = many - many.floor(), many.floor() - quarters[0] * 2.0
    fine = first * _LOW_BITS
    eighth = halves[0].floor() * 8.0 + halves[1].floor() * 4.0 + (quarters[0] - quarters[1]).abs() * 2.0
    part = (eighth + third + fine - fine.floor()) * (1 / _PARTS)
    rest, grey = 1.0 - part, in_colour <= 0.5
    nanometres = g.select(grey, min(max(LINE_D_NM, short), long), part * (short - long) + long)
    colour = g.concat(rest * rest * 3.0, part * rest * 6.0, part * part * 3.0)
    return nanometres, g.select(grey, 1.0, colour), g.select(grey, numbers, g.concat(first, left[1]))
