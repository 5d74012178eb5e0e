"""The exit pupil of a light (`optics.analysis.exit_pupil`), and the outline of the opening through which it leaves."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from contourpy import contour_generator

from neurolens.base.errors import InputError
from neurolens.optics.analysis.exit_pupil import Array, ExitPupil, arrived, fitted_pupil
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.setting.pupils import camera_rays, pupil_plane_z_mm
from neurolens.optics.trace.aiming import without_rims
from neurolens.optics.trace.arrays import passing
from neurolens.optics.trace.rays import Rays, trace
from neurolens.pictures.flare.lights import Light, Patch, disc, light_towards, rays_across

CELLS = 1024  # cells across the pupil
_SEARCH, _BOX = 1 << 16, 48  # rays that find where light passes; rays along a side, for the polynomials
_STEP_MM, _NEWTON, _MET = 1e-4, 8, 1e-3  # of the search for chief rays: differences, steps, stop radii from the middle
_BENT = 0.1  # sine of the smallest angle that counts as a corner


def exit_pupil(lens: Lens, light: Light, wavelength_nm: float, like: ExitPupil | None = None) -> ExitPupil | None:
    """Return a light's exit pupil; None if no light arrives, or its rays meet nowhere (a pinhole, a plate).

    Args:
        lens: its film must be placed (`set_lens`).
        like: the pupil of another wavelength, whose boxes are taken.

    Raises:
        InputError: the lens has no film, or the light is inside the lens.
    """
    if lens.film_z_mm is None:
        raise InputError(lens.path, "film", None, "a focused lens (set_lens)")
    box = _box(lens, light, wavelength_nm) if like is None else like.box
    if box is None:
        return None
    places = _grid(box, 1.1, _BOX)
    rays, area = rays_across(lens, light, places)
    found = arrived(lens, Rays(*torch.from_numpy(rays)), wavelength_nm)
    return fitted_pupil(lens.aperture, found, places, area / math.pi, wavelength_nm, like, box)


def pupils_seen(
    lens: Lens, distance_m: float, places_mm: Array, wavelengths_nm: Sequence[float]
) -> list[list[ExitPupil | None]]:
    """Return the exit pupils of the object points that are seen at film places, as `diffraction.pupils_at` does.

    The lens need not be round. The ray from the place through the middle of the stop finds the object point.

    Args:
        lens: its film must be placed (`set_lens`). distance_m: of the plane of objects from the film, or inf.
        places_mm: [P, 2] x and y on the film.
    """
    film_z, plane, open_lens = float(lens.film_z_mm or 0), pupil_plane_z_mm(lens), without_rims(lens)
    film, at, step = torch.from_numpy(places_mm.T), torch.zeros(2, len(places_mm), dtype=torch.float64), _STEP_MM
    for last in [False] * _NEWTON + [True]:
        tried = torch.stack([at, at + torch.tensor([[step], [0]]), at + torch.tensor([[0], [step]])], 1).flatten(1)
        (x, y), (u, v) = film.tile(1, 3), tried
        rays = camera_rays(x, y, film_z, u, v, plane)
        with torch.no_grad():
            out = trace(open_lens, rays, wavelengths_nm[0], record=[lens.stop_index])
        stop = torch.stack([out.crossings[lens.stop_index].x, out.crossings[lens.stop_index].y]).reshape(2, 3, -1)
        slopes = ((stop[:, 1:] - stop[:, :1]) / step).permute(2, 0, 1)
        if not last:
            at = at - torch.linalg.solve(slopes.nan_to_num() + 1e-12 * torch.eye(2), stop[:, 0].T.nan_to_num()).T
    met = (torch.hypot(*stop[:, 0]) < _MET * lens.stop_radius_mm) & (out.status[: len(places_mm)] == 0)
    found = list[list[ExitPupil | None]]()
    for ray, seen in zip(torch.stack(list(out.rays))[:, : len(places_mm)].T.numpy(), met.tolist(), strict=True):
        towards, far = ray[3:], math.inf
        if math.isfinite(distance_m):
            towards = ray[:3] + ray[3:] * ((film_z - 1000 * distance_m - ray[2]) / ray[5])
            far = float(np.linalg.norm(towards)) / 1000
        light = light_towards(towards, (1, 1, 1), far) if seen else None
        own = list[ExitPupil | None]()
        for nm in wavelengths_nm:
            like = own[0] if own else None
            own.append(None if light is None or own[:1] == [None] else exit_pupil(lens, light, nm, like))
        found.append(own)
    return found


def image_moves(lens: Lens, patch: Patch, wavelength_nm: float) -> Array:
    """Return how far the image of a point moves on the film (mm) along the sides of a light's patch, [2, 2]."""
    moves = np.zeros((2, 2))
    for along, side in zip(moves, patch.sides, strict=True):
        ends = [
            light_towards(patch.light.towards + f * side, patch.light.rgb, patch.light.distance_m) for f in (-0.5, 0.5)
        ]
        pupils = [exit_pupil(lens, light, wavelength_nm) for light in ends if light is not None and side.any()]
        if len(pupils) == 2 and pupils[0] and pupils[1]:
            along[:] = pupils[1].centre_mm - pupils[0].centre_mm
    return moves


def _box(lens: Lens, light: Light, wavelength_nm: float) -> Array | None:
    """Find the box [2 (low, high), 2] of passing rays on the disc across the light's direction, for a round stop."""
    lens, box = replace(lens, aperture=None), np.zeros((2, 2))
    places: Array = disc(0, _SEARCH)
    for step in (0.02, 0.05, 0.05):
        rays, _ = rays_across(lens, light, places)
        passed = passing(lens, Rays(*rays.astype(np.float64)), wavelength_nm, "film")
        if not passed.any():
            return None
        box = np.stack([places[:, passed].min(1), places[:, passed].max(1)])
        box += np.array([[-1], [1]]) * (step if step < 0.05 else step / 2 * (box[1] - box[0]))
        places = _grid(box, 1.0, 64)
    return box


def _grid(box: Array, widened: float, count: int) -> Array:
    """Return points [2, count^2] of a box [2 (low, high), 2], widened by a factor."""
    share = np.linspace(-widened, widened, count)
    place = np.stack(np.meshgrid(share, share)).reshape(2, -1)
    return box.mean(0)[:, None] + (box[1] - box[0])[:, None] / 2 * place


def outline(pupil: ExitPupil) -> list[Array]:
    """Trace the edge of the opening through a grid's cells: closed lines [2, P] in the box, light on the left."""
    nodes = np.linspace(-1, 1, CELLS + 1)
    lit = pupil.passes((nodes, nodes))
    lit[[0, -1]] = lit[:, [0, -1]] = False
    # Half steps from the grid's corner. Above 0.5, a cell whose lit nodes are opposite corners keeps these apart.
    found: Any = contour_generator(z=lit.T.astype(float)).lines(0.51)
    closed = [np.rint(2 * line[:-1].T).astype(int) for line in found]
    twice = np.concatenate(closed, 1) if closed else np.zeros((2, 0), int)
    ends = twice // 2, (twice + 1) // 2  # the nodes at both ends of the grid's edge that the line crosses
    first_lit = lit[tuple(ends[0])]
    inner, outer = (nodes[np.where(first_lit == k, *ends)] for k in (True, False))
    for _ in range(24):
        middle = (inner + outer) / 2
        passed = pupil.passes(middle)
        inner, outer = np.where(passed, middle, inner), np.where(passed, outer, middle)
    cuts = np.cumsum([line.shape[1] for line in closed])[:-1]
    return [_with_corners(line) for line in np.split(inner, cuts, 1)] if closed else []


def _with_corners(line: Array) -> Array:
    """Add to a closed line through cells the corners that it cuts off, where its parts before and after a cell meet."""
    before, here, there, after = (np.roll(line, k, 1) for k in (1, 0, -1, -2))
    come, go, gap = here - before, after - there, there - here

    def cross(a: Array, b: Array) -> Array:
        return np.asarray(a[0] * b[1] - a[1] * b[0])

    turn = cross(come, go)
    bent = np.abs(turn) > _BENT * np.hypot(*come) * np.hypot(*go)
    on, back = (cross(gap, d) / np.where(bent, turn, 1) for d in (go, come))
    corner, cell = here + on * come, 2 / CELLS
    near = (np.hypot(*(corner - here)) < 2 * cell) & (np.hypot(*(corner - there)) < 2 * cell)
    beyond = (on * np.hypot(*come) > 1e-3 * cell) & (-back * np.hypot(*go) > 1e-3 * cell)
    kept = np.nonzero(bent & near & beyond)[0]
    return np.insert(line, kept + 1, corner[:, kept], axis=1)


def coverage(lines: Sequence[Array], cells: int) -> Array:
    """Return the share [cells, cells], x before y, of each cell of the box -1 to 1 that closed lines [2, N] enclose.

    It is exact if `cells` divides `CELLS`.
    """
    share = np.zeros((cells + 1, cells))
    for line in lines:
        a = (line + 1) / 2 * cells
        b = np.roll(a, -1, 1)
        column, row = np.minimum(((a + b) / 2).astype(int), cells - 1)
        rise, beside = b[1] - a[1], (a[0] + b[0]) / 2 - column
        np.add.at(share, (column, row), -rise * (1 - beside))
        np.add.at(share, (column + 1, row), -rise * beside)
    return np.cumsum(share, 0)[:-1]
