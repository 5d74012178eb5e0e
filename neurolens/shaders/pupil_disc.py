"""One wide disc that holds the pupil, for lenses whose pupil no circles describe.

Far off the axis of simple lenses two parts of the pupil show one part of the stop: the stop's image folds. An ellipse
about everything that passes from a film point needs no image. More of its samples are blocked, and none is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.progress import Report
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Exponents, Graph, Value
from neurolens.shaders.blades import Blades
from neurolens.shaders.pupil_circles import frame_of_film_point, unit_disc
from neurolens.shaders.shader_lens import ShaderLens

Array = NDArray[np.float64]
_RADII, _STOPS, _RAYS = 17, (0.08, 0.16, 0.25, 0.35, 0.5, 0.7, 1.0), 20_000  # at which extents are measured; of each
_RCOND = 1e-4  # of least squares: numbers stay small enough for float32
_DEGREE, _OF_STOP = 6, 3  # highest powers of the film radius and of the stop
_LEAST = 0.01  # of the widest stop's radius: a disc is nowhere narrower
_CHECKED, _FEW, _LOST, _STEP = 400_000, 2500, 8e-4, 1.02  # rays that check; few of a zone; what may be lost; widening


@dataclass(frozen=True)
class PupilDisc:
    """An ellipse that holds the passing rays of film points, in the frame of the film point (x towards it).

    Attributes:
        film_radius_mm: beyond it no light passes. unit_mm, stop_mm: units of film radius and stop, the same in all
            states of a lens.
        exponents: [M, 2] of film radius and stop. numbers: [3, M]: centre, half width along x and half height (mm).
    """

    film_radius_mm: float
    unit_mm: float
    stop_mm: float
    exponents: Exponents
    numbers: Array

    @cached_property
    def graph(self) -> Graph:
        """`sampler`."""
        return self.sampler()

    def sampler(self, blades: type[Blades] | None = None, margin: float = 0.0) -> Graph:
        """See `PupilCircles.sampler`; blades do not move points, and there is no `at_stop`."""
        g = Graph()
        film, disc = g.input("film_mm", 2), unit_disc(g.input("square", 2))
        radius, turn, aside = frame_of_film_point(film)
        size = g.input("stop_radius_mm", per_call=True) * (1 / self.stop_mm)
        centre, wide, tall = self._rows(radius * (1 / self.unit_mm), size)
        area = wide * tall * math.pi
        g.outputs["pupil_mm"] = turn * (centre + wide * disc[0]) + aside * (tall * disc[1])
        g.outputs["area_mm2"] = g.select(radius <= self.film_radius_mm, area, 0.0)
        g.outputs["mean_area_mm2"] = area
        return g

    def _rows(self, radius: Value, size: Value) -> list[Value]:
        """Centre and half widths, with coefficients of the call."""
        g, powers = radius.graph, np.unique(self.exponents[:, 0])
        rows = []
        for numbers in self.numbers:
            weights = np.stack([numbers[self.exponents[:, 0] == p] for p in powers])
            coefficients = g.polynomial(np.unique(self.exponents[:, 1])[:, None], weights, size)
            rows.append(g.dot(coefficients, g.polynomial(powers[:, None], np.eye(len(powers)), radius)))
        return [rows[0], *(row.maximum(_LEAST * self.stop_mm) for row in rows[1:])]

    def mixed(self, others: Sequence[PupilDisc], weights: Array) -> PupilDisc:
        """The disc of a state between states, with these weights of itself and of others of the same lens."""
        states = [self, *others]
        radius = float(weights @ [s.film_radius_mm for s in states])
        return replace(self, film_radius_mm=radius, numbers=np.tensordot(weights, [s.numbers for s in states], 1))


def fit_discs(
    lenses: Sequence[ShaderLens], report: Report, between: Sequence[tuple[Array, ShaderLens]] = ()
) -> list[PupilDisc]:
    """The disc of a lens in each of its states; arguments of `pupil_circles_fit.fit_pupil`."""
    exponents = np.array([(i, j) for i in range(_DEGREE + 1) for j in range(_OF_STOP + 1)])
    unit, stop = max(x.film_radius_mm for x in lenses), max(x.stop_radius_mm for x in lenses)
    discs = []
    for lens in lenses:
        disc = PupilDisc(lens.end_of_light_mm(), unit, stop, exponents, np.zeros((3, len(exponents))))
        discs.append(replace(disc, numbers=_fitted(lens, disc)))
        report(len(discs) / (len(lenses) + 1))
    states = [*zip(np.eye(len(discs)), lenses, strict=True), *between]
    while max(disc_lost(discs[0].mixed(discs[1:], weights), lens) for weights, lens in states) > _LOST:
        discs = [replace(d, numbers=d.numbers * [[1.0], [_STEP], [_STEP]]) for d in discs]
    return discs


def _fitted(lens: ShaderLens, disc: PupilDisc) -> Array:
    """Numbers [3, M] by asymmetric least squares on the extents of what passes: those too small weigh more."""
    rng, extents, at = np.random.default_rng(6), [], []
    for radius in np.linspace(0, 0.9999 * disc.film_radius_mm, _RADII):
        for share in _STOPS:
            size = share * lens.stop_radius_mm
            pupil, passed = _rays(lens, np.full(_RAYS, radius), np.full(_RAYS, size), rng)
            if passed.any():
                (x, y), scaled = pupil[:, passed], (radius / disc.unit_mm, size / disc.stop_mm)
                centre, wide, tall = (x.max() + x.min()) / 2, (x.max() - x.min()) / 2, np.abs(y).max()
                corners = np.hypot((x - centre) / max(wide, 1e-9), y / max(tall, 1e-9)).max()
                extents.append((centre, wide * corners, tall * corners))
                at.append(np.prod(np.array(scaled) ** disc.exponents, axis=1))
    rows, wanted = np.array(at), np.array(extents).T
    numbers = list[Array]()
    for k, values in enumerate(wanted):
        # A centre may lie on either side: half widths are measured about the fitted one.
        if k == 1:
            values = values + np.abs(wanted[0] - rows @ numbers[0])
        weight = np.ones(len(values))
        for _ in range(20):
            fit = np.linalg.lstsq(rows * weight[:, None], values * weight, rcond=_RCOND)[0]
            weight = np.where((rows @ fit < values) & (k > 0), 10.0, 1.0)
        numbers.append(fit)
    return np.stack(numbers)


def _rays(lens: ShaderLens, radius: Array, stop: Array, rng: np.random.Generator) -> tuple[Array, NDArray[np.bool_]]:
    """Random pupil points [2, N] in the boxes of film points, in their frames, and whether rays pass there."""
    count, radii = radius.size, np.linspace(0, lens.film_radius_mm, lens.table.rows.shape[1])
    low, high, half = (np.interp(radius, radii, row) for row in lens.table.rows)
    pupil = np.stack([low + (high - low) * rng.random(count), half * rng.uniform(-1, 1, count)])
    angle = 2 * np.pi * rng.random(count) * lens.anamorphic
    turn = np.exp(1j * angle)
    film, turned = radius * turn, (pupil[0] + 1j * pupil[1]) * turn
    z, nm = (rng.uniform(*span, count) for span in (lens.film_z_mm, lens.wavelength_nm))
    film_mm, pupil_mm = (np.stack([v.real, v.imag]) for v in (film, turned))
    return pupil, np.asarray(lens.status(film_mm, pupil_mm, nm, z, stop) == st.PASSED)


def disc_lost(disc: PupilDisc, lens: ShaderLens) -> float:
    """The share of random rays that pass beyond the disc, in the worst zone of film and stop."""
    rng = np.random.default_rng(7)
    area, share = rng.random(_CHECKED), rng.choice(_STOPS, _CHECKED)
    radius, stop = disc.film_radius_mm * np.sqrt(area), share * lens.stop_radius_mm
    pupil, passed = _rays(lens, radius, stop, rng)
    g = Graph()
    g.outputs["rows"] = g.concat(*disc._rows(g.input("radius"), g.input("stop")))
    inputs = {"radius": radius[None] / disc.unit_mm, "stop": stop[None] / disc.stop_mm}
    centre, wide, tall = evaluate(g, inputs)["rows"]
    out = passed & (np.hypot((pupil[0] - centre) / wide, pupil[1] / tall) > 1)
    zone = (8 * area).astype(np.intp) * 3 + np.digitize(share, (0.3, 0.6))
    counts, missed = (np.bincount(zone[rows], minlength=24) for rows in (passed, out))
    return float((missed / np.maximum(counts, _FEW)).max())
