"""Which part of a light's disc each ghost takes on its way to a picture, and how fine a grid draws it there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurolens.flare.ghostmodel import GhostModel
from neurolens.flare.ghosts import GhostRays, GhostTracer, Way
from neurolens.flare.lights import Light, rays_across
from neurolens.flare.stack import Floats
from neurolens.flare.steps import LOST

FEWEST, MOST = 24, 512  # cells along a side
REACH = 16.0  # of `GhostTracer.trace`: rims are cut between rays inside and outside
_SCOUTS = 48  # cells a side of the grid that looks for ghosts
_AT_ONCE = 128  # ghosts
_COARSER = (0.5, 4.0)  # cells of a ghost than those of a ghost of some brightness


@dataclass(frozen=True)
class Grid:
    """A regular grid over a rectangle of the square about a light's disc.

    Attributes:
        low, high: corners of the rectangle, in disc radii. columns, rows: cells.
    """

    low: tuple[float, float]
    high: tuple[float, float]
    columns: int
    rows: int

    @property
    def places(self) -> NDArray[np.float64]:
        """[2, (rows + 1) (columns + 1)] of the corners of cells, row after row."""
        u, v = (
            np.linspace(a, b, n + 1) for a, b, n in zip(self.low, self.high, (self.columns, self.rows), strict=True)
        )
        return np.stack([np.tile(u, len(v)), np.repeat(v, len(u))])

    @property
    def cell(self) -> float:
        """Area of a cell over that of the disc."""
        (a, b), (c, d) = self.low, self.high
        return (c - a) * (d - b) / (np.pi * self.columns * self.rows)


def grids_of(
    tracer: GhostTracer | GhostModel, light: Light, wavelength_nm: float, half_mm: tuple[float, float], cell_mm: float
) -> dict[Way, Grid]:
    """The grids of all ghosts that reach the film.

    Args:
        wavelength_nm: of the rays that look for them; others differ little.
        half_mm: half the film's width and height.
        cell_mm: size of cells on the film, of a ghost a tenth as bright as all on average; fainter ones are drawn
            coarser, brighter ones finer, as the root of their brightness, within `_COARSER`.
    """
    whole = Grid((-1.0, -1.0), (1.0, 1.0), _SCOUTS, _SCOUTS)
    start = tracer.start(rays_across(tracer.lens, light, whole.places)[0])
    seen: dict[Way, tuple[NDArray[np.bool_], Floats, float, float]] = {}
    for k in range(0, len(tracer.pairs), _AT_ONCE):
        some = tracer.pairs[k : k + _AT_ONCE]
        rays = tracer.follow(start, wavelength_nm, only=some, reach=REACH)
        power = rays.power.reshape(-1, _SCOUTS + 1, _SCOUTS + 1)[:, 1:, 1:]
        for pair, kept, steps, of_cells in zip(some, *_lit(rays, half_mm), power, strict=True):
            if kept.any():
                area = float(np.prod(steps, 0, dtype=np.float64, where=kept).sum(where=kept))
                seen[pair] = kept, steps, float(of_cells.sum(where=kept)), area
    mean = sum(light for *_, light, _ in seen.values()) / (4 * half_mm[0] * half_mm[1])
    found = {}
    for pair, (kept, steps, light_here, area) in seen.items():
        with np.errstate(divide="ignore", invalid="ignore"):
            coarser = np.nan_to_num(np.sqrt(0.1 * mean * area / np.float64(light_here)), nan=np.inf)
        found[pair] = _around(kept, steps / (cell_mm * float(np.clip(coarser, *_COARSER))))
    return found


def _lit(rays: GhostRays, half_mm: tuple[float, float]) -> tuple[NDArray[np.bool_], Floats]:
    """[P, S, S] whether light of a cell may reach the film, and lengths [P, 2, S, S] on film of its first two sides.

    A cell all of whose corners a rim stops is kept where the worst, going on as it does within it, may reach 1.
    """
    shape = (len(rays.rows), 4, _SCOUTS + 1, _SCOUTS + 1)
    xy, worst = np.split(rays.rows.reshape(shape)[:, [0, 1, 3]], [2], 1)
    lost = ~(worst < LOST)
    inf = np.float32(np.inf)
    low, high = _corners(np.where(lost, inf, xy), np.minimum), _corners(np.where(lost, -inf, xy), np.maximum)
    near, far = (_corners(np.where(lost, v, worst), op)[:, 0] for v, op in ((inf, np.minimum), (-inf, np.maximum)))
    half = np.array(half_mm, np.float32)[:, None, None]
    kept = ((near <= 1) | (2 * near - far <= 1)) & ((low < half) & (high > -half)).all(1)
    xy = np.where(lost, np.float32(0), xy)
    u, v = (np.hypot(*np.moveaxis(np.diff(xy, axis=axis), 1, 0)) for axis in (3, 2))
    u *= ~(lost[:, 0, :, 1:] | lost[:, 0, :, :-1])
    v *= ~(lost[:, 0, 1:] | lost[:, 0, :-1])
    return kept, np.stack([np.maximum(u[:, :-1], u[:, 1:]), np.maximum(v[..., :-1], v[..., 1:])], 1)


def _corners(a: Floats, of: Callable[[Floats, Floats], Floats]) -> Floats:
    rows = of(a[..., :-1, :], a[..., 1:, :])
    return of(rows[..., :-1], rows[..., 1:])


def _around(kept: NDArray[np.bool_], steps: Floats) -> Grid:
    """About the cells that are kept [S, S], with `steps` [2, S, S] cells on each of theirs."""
    low, high, cells = [], [], []
    for axis, length in zip((0, 1), steps, strict=True):
        at = np.flatnonzero(kept.any(axis))
        low.append(2 * int(at[0]) / _SCOUTS - 1)
        high.append(2 * (int(at[-1]) + 1) / _SCOUTS - 1)
        size = float(np.sqrt(np.mean(np.square(length[kept], dtype=np.float64))))
        cells.append(int(np.clip(np.ceil((at[-1] + 1 - at[0]) * size), FEWEST, MOST)))
    return Grid((low[0], low[1]), (high[0], high[1]), cells[0], cells[1])
