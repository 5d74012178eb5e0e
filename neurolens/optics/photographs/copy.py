"""From the sharpness that photographs of one copy show in the middle and in the corners to what is off in that copy.

Fitted are the decentre of one element, tilt and swing of the film, its focus, and for each frequency a factor: that of
the sensor, of diffraction and of sharpening, which is taken to be the same all over the picture. Which element it is,
the corners tell only roughly, so every element is tried. Rays change with a decentre as the exact tracer says, to first
order about the decentre that was found last.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares  # type: ignore[import-untyped]

from neurolens.base.errors import InputError
from neurolens.base.files import read_rows
from neurolens.base.report import Report, over
from neurolens.base.units import as_float
from neurolens.optics.analysis.corners import FINE, GRID, Corners, Spot
from neurolens.optics.analysis.fields import Array, Scene
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.setting.copies import Off, elements_of, perturbed

_COLUMNS = ("x_mm", "y_mm", "frequency_per_mm", "tangential", "sagittal")
_STEP_MM = 2e-3  # of decentres, for derivatives
_SCALES = (0.03, 0.03, 0.1, 0.1, 0.03)  # mm, mm, degrees, degrees, mm: how far starts lie from the lens as designed
_STARTS, _SEED = 12, 54
_LEAST, _SOLE = 0.02, 1.5  # the least contrast that tells; by how many times an element must fit better than others


class Measured(NamedTuple):
    """Contrasts [2, P, K], tangential and sagittal, at P points of the picture and K frequencies."""

    picture_mm: Array
    per_mm: tuple[float, ...]
    contrast: Array

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which contrasts are so high that they tell."""
        return self.contrast >= _LEAST


def read_measured(path: Path) -> Measured:
    """Read a table with the columns x_mm, y_mm (to the right and up), frequency_per_mm, tangential, sagittal.

    Raises:
        InputError: another table, a contrast outside 0 to 1, a place without one of the frequencies, or fewer than five
            places.
    """
    rows = read_rows(path, "a list of measured contrasts")
    found = dict[tuple[float, float], dict[float, tuple[float, float]]]()
    for number, row in enumerate(rows, 1):
        try:
            x, y, per_mm, *both = (as_float(str(row[name])) for name in _COLUMNS)
        except (KeyError, ValueError):
            raise InputError(path, f"row {number}", dict(row), f"numbers for {', '.join(_COLUMNS)}") from None
        if not (math.isfinite(x + y + per_mm) and per_mm > 0 and all(0 <= v <= 1 for v in both)):
            raise InputError(path, f"row {number}", dict(row), "a frequency above 0, and contrasts of 0 to 1")
        found.setdefault((x, y), {})[per_mm] = (both[0], both[1])
    frequencies = sorted({f for some in found.values() for f in some})
    if len(found) < 5 or any(len(some) < len(frequencies) for some in found.values()):
        raise InputError(path, "rows", f"({len(found)} places)", "five places or more, each with all frequencies")
    contrast = np.array([[some[f] for f in frequencies] for some in found.values()])
    return Measured(np.array(list(found)), tuple(frequencies), contrast.transpose(2, 0, 1))


@dataclass(frozen=True)
class FittedCopy(Report):
    """What is off in a copy, so that it is as sharp as measured.

    Attributes:
        element: first and last surface of the element that is decentred.
        decentre_x_mm, decentre_y_mm: its decentre, lens frame.
        film_tilt_deg, film_swing_deg, film_shift_mm: how the film stands, and by how much it is farther away.
        error: standard errors of these five, by name, from what is left; they do not know how alike elements are.
        factor: by frequency, what the measured contrast is times the lens's.
        rms_before, rms: of the contrasts, as designed (with the best factors) and as fitted.
        rms_by_element: the same for each element tried, by its first surface.
        doubt: a sentence where other elements fit nearly as well.
    """

    element: tuple[int, int]
    decentre_x_mm: float
    decentre_y_mm: float
    film_tilt_deg: float
    film_swing_deg: float
    film_shift_mm: float
    error: dict[str, float]
    factor: dict[float, float] = field(metadata=over("frequency_per_mm"))
    rms_before: float
    rms: float
    rms_by_element: dict[str, float]
    doubt: str = ""

    def lens(self, lens: Lens) -> Lens:
        """Return a lens with the decentre."""
        return perturbed(lens, _decentred(lens, self.element[0], (self.decentre_x_mm, self.decentre_y_mm)))


_NAMES = ("decentre_x_mm", "decentre_y_mm", "film_tilt_deg", "film_swing_deg", "film_shift_mm")


def _decentred(lens: Lens, first: int, decentre_mm: Sequence[float]) -> Off:
    off = Off.none(lens)
    off.decentre_mm[[e[0] for e in elements_of(lens)].index(first)] = decentre_mm
    return off


def fit_copy(
    scene: Scene, measured: Measured, first: int | None = None, wavelength_nm: Sequence[float] | None = None
) -> FittedCopy:
    """Fit what is off in a copy to its measured sharpness.

    Args:
        scene: the lens, set as it was for the photographs.
        first: the first surface of the element that is off; None tries each.
        wavelength_nm: of the light in which it was measured, all alike; None takes `Scene.waves_nm`.

    Raises:
        InputError: a surface that begins no element, too few contrasts, and what `Corners` raises.
    """
    firsts = [e[0] for e in elements_of(scene.lens)]
    if first is not None and first not in firsts:
        raise InputError(scene.lens.path, "element", first, f"the first surface of an element: {firsts}")
    coarse, corners = (Corners(scene, measured.picture_mm, wavelength_nm, grid) for grid in (GRID, FINE))
    count, least = int(measured.known.sum()), len(_NAMES) + len(measured.per_mm) + 1
    if count < least:
        raise InputError(scene.lens.path, "measured", f"({count})", f"{least} contrasts of {_LEAST} or more")
    fits = {k: _fitted((coarse, corners, corners), measured, k) for k in (firsts if first is None else [first])}
    found = min(fits, key=lambda k: fits[k][1])
    values, rms, error = fits[found]
    others = [k for k in fits if k != found and fits[k][1] < max(_SOLE * rms, rms + 1e-3)]
    names = ", ".join(f"s{k:02}" for k in others)
    doubt = f"elements {names} fit nearly as well (state which it is, if you know)" if others else ""
    plain = corners.contrast(corners.spots(scene.lens), 0.0, measured.per_mm)
    model = _contrast(corners, _spots(corners, found, values[:2]), values, measured)
    (last,) = (e[-1] for e in elements_of(scene.lens) if e[0] == found)
    return FittedCopy(
        element=(found, last), error=dict(zip(_NAMES, error.tolist(), strict=True)),
        factor=dict(zip(measured.per_mm, _factors(model, measured).tolist(), strict=True)),
        rms_before=_rms(_left(plain, measured)), rms=rms, doubt=doubt,
        rms_by_element={f"s{k:02}": one[1] for k, one in fits.items()},
        **dict(zip(_NAMES, values.tolist(), strict=True)),
    )  # fmt: skip


def _spots(corners: Corners, first: int, decentre_mm: Array) -> Spot:
    return corners.spots(perturbed(corners.scene.lens, _decentred(corners.scene.lens, first, decentre_mm.tolist())))


def _contrast(corners: Corners, spot: Spot, values: Array, measured: Measured) -> Array:
    """Return the contrasts [2, P, K] on a film that stands so."""
    tilt, swing = np.tan(np.radians(values[2:4]))
    x, y = corners.film_mm
    return corners.contrast(spot, values[4] + tilt * y + swing * x, measured.per_mm)


def _factors(model: Array, measured: Measured) -> Array:
    """Return for each frequency [K] the factor on a model's contrasts that fits best."""
    both = np.where(measured.known, model, 0.0)
    return np.asarray((both * measured.contrast).sum((0, 1)) / np.maximum((both * both).sum((0, 1)), 1e-300))


def _left(model: Array, measured: Measured) -> Array:
    return np.asarray((model * _factors(model, measured) - measured.contrast)[measured.known])


def _rms(values: Array) -> float:
    return float(np.sqrt((values * values).mean()))


def _fitted(rounds: Sequence[Corners], measured: Measured, first: int) -> tuple[Array, float, Array]:
    """Return the five figures of `_NAMES` for an element, what is left, and standard errors; first from many starts."""
    rng, scales, best = np.random.default_rng(_SEED), np.array(_SCALES), np.zeros(len(_NAMES))
    starts = [best, *(rng.normal(size=(_STARTS, len(_NAMES))) * scales)]
    for corners in rounds:
        here, centre = _spots(corners, first, best[:2]), best[:2].copy()
        ways = []
        for step in np.eye(2) * _STEP_MM:
            ahead, behind = (_spots(corners, first, centre + k * step) for k in (1, -1))
            both = (ahead.weight > 0) & (behind.weight > 0)
            ways.append(np.where(both, (ahead.off_mm - behind.off_mm) / (2 * _STEP_MM), 0.0))

        def left(
            values: Array,
            corners: Corners = corners,
            here: Spot = here,
            ways: Sequence[Array] = ways,
            centre: Array = centre,
        ) -> Array:
            moved = sum((way * v for way, v in zip(ways, values[:2] - centre, strict=True)), here.off_mm)
            return _left(_contrast(corners, here._replace(off_mm=moved), values, measured), measured)

        tried = [least_squares(lambda v: left(v * scales), start / scales, method="lm") for start in starts]
        nearest = min(tried, key=lambda one: float(one.cost))
        starts = [best := nearest.x * scales]
    found = _left(_contrast(corners, _spots(corners, first, best[:2]), best, measured), measured)
    free = max(len(found) - len(best) - len(measured.per_mm), 1)
    covariance = np.linalg.pinv(nearest.jac.T @ nearest.jac) * (found @ found) / free
    return best, _rms(found), np.sqrt(np.diag(covariance)) * scales
