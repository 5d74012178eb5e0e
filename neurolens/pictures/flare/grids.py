"""Grids of rays that draw ghosts: which part of a light's disc each ghost takes, and how fine its grid is."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base.report import some_of
from neurolens.base.settings import LIGHT_NM
from neurolens.cameras.contract import FloatArray
from neurolens.optics.lens.paraxial import first_order
from neurolens.pictures.flare.ghosts import GhostTracer, Pair
from neurolens.pictures.flare.lights import Light, Patch, light_towards, rays_across
from neurolens.pictures.flare.steps import LOST, entering

Array = NDArray[np.float64]
# Lit cells, at least, which leave up to 4% of the light of a ghost of many layers wrong; cells along a side, at most.
FEWEST, MOST = 320, 512
REACH = 16.0  # of `GhostTracer.follow`, so that rims can be cut between rays inside and outside
_SCOUTS = 48  # cells a side of the grid of scouts, the rays that look for ghosts
_FEW = 2  # every n-th scout along a side is traced at all wavelengths
_NEAR = 2.0  # rays beyond rims count for the spread of colours up to this r^2 / R^2
_EVEN = 0.02  # the least unevenness, and spread of colours over its size, that a ghost is taken to have
_STEP = 0.25  # share of a cell by which a rim's shadow may move on the film between two wavelengths
_BAND = 0.02  # a step of colour that may remain in one ghost, over the irradiance that wide ghosts leave on the film
_NODES = 31  # wavelengths of scouts
_FOLD = 2.0  # change in the logarithm of a ray's power, up and down together, from one band to the next
_AT_ONCE = 128  # ghosts that are scouted at a time
_MOVED, _LONG, _SOFT, _SHORT = 32, math.radians(0.25), 0.2, 2.5  # for moves: cells a side, step, soft edge in r^2 / R^2
_ERROR, _WORST = 3.0, 0.25  # share of light beside its place, times the cells across half the film; at most


@dataclass(frozen=True)
class Grid:
    """A regular grid over a rectangle in the square about a light's disc.

    Attributes:
        low, high: corners of the rectangle, in disc radii. columns, rows: how many cells it has.
        wavelengths: about how many stand for the whole range.
        spectrum: wavelengths in nm, each with the power of a ray over that at the first wavelength; empty if unknown.
    """

    low: tuple[float, float]
    high: tuple[float, float]
    columns: int
    rows: int
    wavelengths: int = 1
    spectrum: tuple[tuple[float, float], ...] = ()

    @property
    def places(self) -> Array:
        """Return the corners of the cells, [2, (rows + 1) (columns + 1)], row after row."""
        u, v = (
            np.linspace(a, b, n + 1) for a, b, n in zip(self.low, self.high, (self.columns, self.rows), strict=True)
        )
        return np.stack([np.tile(u, len(v)), np.repeat(v, len(u))])

    def coarser(self, factor: int, least: int) -> Grid:
        """Return the grid with fewer cells and wavelengths by a factor, but with at least `least` cells a side."""
        columns, rows = (min(n, max(n // factor, least)) for n in (self.columns, self.rows))
        return replace(self, columns=columns, rows=rows, wavelengths=max(self.wavelengths // factor, 1))

    @property
    def cell(self) -> float:
        """The area of a cell over that of the disc."""
        (a, b), (c, d) = self.low, self.high
        return (c - a) * (d - b) / (np.pi * self.columns * self.rows)


def grids_of(
    tracer: GhostTracer,
    light: Light,
    wavelength_nm: float,
    half_mm: tuple[float, float],
    cell_mm: float,
    wavelengths_nm: Sequence[float] = LIGHT_NM,
    only: Sequence[Pair] | None = None,
) -> dict[Pair, Grid]:
    """Make the grids of all ghosts that reach the film, or of those in `only`.

    A cell has one density, and a wavelength stands for its neighbours: both put light beside its place. With n cells a
    side and k wavelengths, its shares are a / n and b / k. The work of a ghost is n k times its size on the film. For a
    given sum of errors, the work of all ghosts is least where a / n and b / k of each are the cube root of a b size,
    times a number that all ghosts share. So most cells go to ghosts that are bright, small and uneven.

    Args:
        wavelength_nm: that of the scouts; at others ghosts differ little.
        half_mm: half the film's width and height.
        cell_mm: about the size of cells on the film, to which the share of light beside its place is proportional.
        wavelengths_nm: those of the light, increasing.
    """
    whole = Grid((-1.0, -1.0), (1.0, 1.0), _SCOUTS, _SCOUTS)
    start = entering(rays_across(tracer.lens, light, whole.places)[0])
    few = np.ascontiguousarray(start.reshape(len(start), _SCOUTS + 1, -1)[:, ::_FEW, ::_FEW].reshape(len(start), -1))
    nodes = some_of(wavelengths_nm, _NODES)
    ghosts: list[tuple[Pair, NDArray[np.bool_], _Look]] = []
    pairs = tracer.pairs if only is None else only
    for k in range(0, len(pairs), _AT_ONCE):
        some = pairs[k : k + _AT_ONCE]
        rows = tracer.follow(start, wavelength_nm, only=some, reach=REACH).rows
        each = [tracer.follow(few, nm, only=some, reach=REACH).rows for nm in nodes]
        for pair, kept, of_one, *by_colour in zip(
            some, _kept(rows, half_mm), rows, *_colours(each, half_mm), strict=True
        ):  # fmt: skip
            if kept.any():
                ghosts.append((pair, kept, _look(kept, of_one, tuple(by_colour), nodes, half_mm)))
    work = np.array([((look.along_u + look.along_v) * look.colours * look.size_mm) ** (1 / 3) for *_, look in ghosts])
    most = min(_ERROR * cell_mm / half_mm[0], _WORST)
    error = work * (most / max(float(work.sum()), 1e-300)) + 1e-30
    film = 4 * half_mm[0] * half_mm[1]
    band = _BAND * sum(k.light / k.size_mm**2 * min(k.size_mm**2 / film, 1.0) ** 2 for *_, k in ghosts)
    grids = {}
    for (pair, kept, look), each_error in zip(ghosts, error.tolist(), strict=True):
        least = min(look.swept_mm / (_STEP * cell_mm), look.light / max(look.size_mm**2 * band, 1e-300))
        grids[pair] = _around(kept, look, each_error, math.ceil(least))
    return grids


def ghost_moves(tracer: GhostTracer, patch: Patch, pair: Pair, grid: Grid, wavelength_nm: float) -> tuple[Array, Array]:
    """Return how a ghost moves and changes on the film while its light moves over a patch.

    The first array [2, 2] says how far (mm) the middle of the ghost's light moves along each side of the patch. The
    second [2] has the light that comes or goes along the side where that is most, and the light of the ghost.

    The middle moves as the ghost's edges do, which are mostly images of the stop; light through one point of the front
    moves by another amount. Rays near rims weigh less, so that no ray comes or goes at once. Where rims cut light away,
    the middle moves by up to that share of the radius as well, and the way is shortened by as much. A way is at least
    `_SHORT` images of the side, because a ghost without a smear would show edges.
    """
    coarse = replace(grid, columns=min(grid.columns, _MOVED), rows=min(grid.rows, _MOVED))

    def seen(off: Array) -> tuple[Array, float, float] | None:
        light = light_towards(patch.light.towards + off, patch.light.rgb, patch.light.distance_m)
        if light is None:
            return None
        rays, area = rays_across(tracer.lens, light, coarse.places)
        x, y, power, worst = tracer.follow_each(entering(rays), [wavelength_nm], pair)[0].astype(np.float64)
        weight = np.where(power > 0, power * np.clip((1 - worst) / _SOFT, 0, 1), 0)
        lit, whole = weight > 0, float(weight.sum())
        energy = area * coarse.cell * whole
        if not energy:  # nothing arrives, or from so far that floats do not hold it
            return None
        place, share = np.stack([x, y])[:, lit], weight[lit] / whole
        middle = place @ share
        return middle, math.sqrt(((place.T - middle) ** 2).sum(1) @ share), energy

    moves, changing, efl = np.zeros((2, 2)), np.zeros(2), abs(float(first_order(tracer.lens).efl_mm))
    for along, side in zip(moves, patch.sides, strict=True):
        step = _LONG / max(float(np.linalg.norm(side)), 1e-300)
        places = [(f, place) for f in (-step, step) if side.any() and (place := seen(f * side)) is not None]
        if len(places) == 1:
            places += [(0.0, place) for place in (seen(0 * side),) if place is not None]
        if len(places) == 2:
            (f, (one, radius, light)), (g, (other, _, end)) = places
            change, moved = 2 * abs((end - light) / ((end + light) * (g - f))), (other - one) / (g - f)
            way, short = max(float(np.linalg.norm(moved)), 1e-300), _SHORT * efl * _LONG / step
            along[:] = moved * max(1 - change * radius / way, min(short / way, 1))
            changing = np.maximum(changing, 0.5 * (end + light) * np.array([change, 1]))
    return moves, changing


class _Look(NamedTuple):
    """A ghost as its first, coarse rays (the scouts) see it.

    Attributes:
        along_u, along_v: light that cells of one density put beside its place, times the number of cells along a side.
        colours: the same for wavelengths, times their number. size_mm: that of the part on the film.
        lit: share of the rectangle that holds its light. light: its light on the film.
        swept_mm: about how far a rim's shadow moves on the film from one end of the spectrum to the other.
        spectrum: as in `Grid`.
    """

    along_u: float
    along_v: float
    colours: float
    size_mm: float
    lit: float
    light: float
    swept_mm: float
    spectrum: tuple[tuple[float, float], ...]


def _look(
    kept: NDArray[np.bool_],
    rows: FloatArray,
    colours: tuple[Any, ...],
    nm: Sequence[float],
    half_mm: tuple[float, float],
) -> _Look:
    """Measure a ghost: cells that are kept, rows [4, N] of its scouts, and `_colours` at its wavelengths."""
    x, y, power, worst = rows.reshape(4, _SCOUTS + 1, _SCOUTS + 1).astype(np.float64)
    lit, half = worst <= 1, np.array(half_mm)[:, None]
    whole = kept & _corners(lit, np.logical_and)
    light = np.where(whole, 0.25 * _corners(power, np.add), 0)
    with np.errstate(invalid="ignore", over="ignore"):
        area = np.abs(
            (x[1:, 1:] - x[:-1, :-1]) * (y[1:, :-1] - y[:-1, 1:])
            - (x[1:, :-1] - x[:-1, 1:]) * (y[1:, 1:] - y[:-1, :-1])
        )
    level = np.log(np.where(whole, np.maximum(light, 1e-30) / np.maximum(area, 1e-30), 1))
    off, box, inside = [], [], []
    for axis in (1, 0):
        step = np.minimum(np.abs(np.diff(level, axis=axis)), 1) * _pairs(whole, axis, np.logical_and)
        at = np.flatnonzero(kept.any(1 - axis))
        box.append(int(at[-1]) + 1 - int(at[0]))
        inside.append(slice(int(at[0]), int(at[-1]) + 2))
        off.append(0.125 * float((step * _pairs(light, axis, np.add)).sum()) * box[-1])
    places = np.clip(np.stack([x[lit], y[lit]]), -half, half) if lit.any() else np.zeros((2, 1))
    share = (lit[inside[1], inside[0]].sum() + 0.5) / ((box[0] + 1) * (box[1] + 1))
    size, whole_light = max(float(np.ptp(places, 1).max()), 1e-3 * half_mm[0]), float(light.sum())
    along_u, along_v = (max(v, _EVEN * whole_light) for v in off)
    moved, swept, power_at = colours
    spectrum = tuple(zip(nm, power_at.tolist(), strict=True))
    of_colours = whole_light * min(max(moved / size, _EVEN), 1.0)
    return _Look(along_u, along_v, of_colours, size, share, whole_light, swept, spectrum)


def _pairs(a: NDArray[Any], axis: int, of: Callable[[Any, Any], Any]) -> NDArray[Any]:
    return of(a[1:], a[:-1]) if axis == 0 else of(a[:, 1:], a[:, :-1])


def _colours(each: Sequence[FloatArray], half_mm: tuple[float, float]) -> tuple[Array, Array, Array]:
    """Measure how ghosts differ by the wavelength, from the rows [P, 4, N] of their rays at each of W wavelengths.

    The first array [P] is how far (mm) each ghost moves from the first to the last wavelength; inf for a ghost without
    light. The second [P] is about how far (mm) the shadows of rims move on the film, summed from wavelength to
    wavelength. A rim may cut a ghost at another place in each colour even where the rays themselves do not move.
    Between two wavelengths a shadow moves by the share of the rays on the film that pass at only one of them, times the
    ghost's width. The third [P, W] is the power at each wavelength over that at the first, from rays that pass at both
    of two neighbours.
    """
    one, other = each[0], each[-1]
    here = (one[:, 3] <= _NEAR) & (other[:, 3] <= _NEAR) & (np.abs(one[:, :2]).max(1) < 2 * max(half_mm))
    off = np.where(here, ((other[:, :2] - one[:, :2]).astype(np.float64) ** 2).sum(1), 0).sum(1)
    moved = np.where(here.any(1), np.sqrt(off / np.maximum(here.sum(1), 1)), np.inf)

    half = np.array(half_mm, np.float32)[:, None]
    passed = [(rows[:, 3] <= 1) & (np.abs(rows[:, :2]) < half).all(1) for rows in each]
    share = sum(((a ^ b).sum(1) / np.maximum((a | b).sum(1), 1) for a, b in pairwise(passed)), np.zeros(len(one)))
    inside = [np.where(lit[:, None], rows[:, :2], np.nan) for lit, rows in zip(passed, each, strict=True)]
    low, high = (of(np.concatenate(inside, 2), 2) for of in (np.fmin.reduce, np.fmax.reduce))
    swept = share * np.nan_to_num((high - low).max(1))

    ratios = [np.ones(len(one))]
    for before, after in pairwise(rows[:, 2].astype(np.float64) for rows in each):
        sums = [np.where((before > 0) & (after > 0), power, 0).sum(1) for power in (before, after)]
        ratios.append(np.divide(sums[1], sums[0], out=np.ones_like(sums[0]), where=sums[0] > 0))
    return moved, np.asarray(swept), np.cumprod(ratios, 0).T.astype(np.float64)


def _kept(rows: FloatArray, half_mm: tuple[float, float]) -> NDArray[np.bool_]:
    """Return whether light of each cell may reach the film, [P, S, S], from the rows [P, 4, N] of the scouts.

    A cell whose corners are all stopped by a rim is kept where `worst`, extrapolated by its change in the cell, reaches
    1.
    """
    xy, worst = np.split(rows.reshape((len(rows), 4, _SCOUTS + 1, _SCOUTS + 1))[:, [0, 1, 3]], [2], 1)
    lost = ~(worst < LOST)
    inf = np.float32(np.inf)
    low, high = _corners(np.where(lost, inf, xy), np.minimum), _corners(np.where(lost, -inf, xy), np.maximum)
    near, far = (_corners(np.where(lost, v, worst), op)[:, 0] for v, op in ((inf, np.minimum), (-inf, np.maximum)))
    half = np.array(half_mm, np.float32)[:, None, None]
    return np.asarray(((near <= 1) | (2 * near - far <= 1)) & ((low < half) & (high > -half)).all(1))


def _corners(a: NDArray[Any], of: Callable[[Any, Any], Any]) -> NDArray[Any]:
    rows = of(a[..., :-1, :], a[..., 1:, :])
    return of(rows[..., :-1], rows[..., 1:])


def _around(kept: NDArray[np.bool_], look: _Look, error: float, least: int) -> Grid:
    """Return the grid about the cells that are kept [S, S], so fine that `error` of the light lies beside its place.

    It has at least `least` wavelengths.
    """
    low, high, fewest = [], [], math.sqrt(FEWEST / look.lit)
    for axis in (0, 1):
        at = np.flatnonzero(kept.any(axis))
        low.append(2 * int(at[0]) / _SCOUTS - 1)
        high.append(2 * (int(at[-1]) + 1) / _SCOUTS - 1)
    columns, rows = (int(min(max(math.ceil(a / error), fewest), MOST)) for a in (look.along_u, look.along_v))
    power = np.log([max(power, 1e-30) for _, power in look.spectrum])
    folds = math.ceil(np.abs(np.diff(power)).sum() / _FOLD)
    wavelengths = max(1, least, folds, math.ceil(look.colours / error))
    return Grid((low[0], low[1]), (high[0], high[1]), columns, rows, wavelengths, look.spectrum)
