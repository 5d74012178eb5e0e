"""Cat's eyes: what of the pupil passes at several film radii, of the exact lens and of its model together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neurolens.base import status as st
from neurolens.evaluate.benches.vignetting import OPENINGS
from neurolens.evaluate.plots.style import FIELD_COLOURS, INK, new_figure, save, style
from neurolens.surrogates.domain import FilmRays
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.pairs import trace_pairs

_RADII = (0.0, 0.4, 0.7, 0.9, 1.0)  # shares of the film radius
_POINTS = 200
_EXACT, _MODEL = "#cfd8e3", "#d55e00"
_SHOWN = ("full", "6 blades")


def cats_eyes(models: Sequence[LensModel], path: Path) -> Path:
    """Draw one row a model: exact passing pupils filled, the model's outlined, open and with blades two stops down."""
    with style():
        figure = new_figure(2.1 * len(_RADII), 2.2 * len(models) + 0.5)
        grid = figure.subplots(len(models), len(_RADII), squeeze=False)
        for axes_row, model in zip(grid, models, strict=True):
            for axes, share in zip(axes_row, _RADII, strict=True):
                _draw(axes, model, share)
                axes.set_title(f"{share * model.domain.film_radius_mm:.1f} mm", fontsize=8)
            axes_row[0].set_ylabel(model.lens.name[:28], fontsize=8)
        figure.suptitle(
            "Passing pupil by film radius: exact (filled), model (outline); open, and 6 blades 2 stops down", fontsize=9
        )
        return save(figure, path)


def _draw(axes: Any, model: LensModel, share: float) -> None:
    u, v, exact, said = pupil_masks(model, share)
    for k, name in enumerate(_SHOWN):
        if exact[name].any():
            fill = _EXACT if k == 0 else FIELD_COLOURS[0]
            axes.contourf(u, v, exact[name].astype(float), levels=[0.5, 2.0], colors=[fill], alpha=1.0 - 0.55 * k)
        if said[name].any():
            axes.contour(u, v, said[name].astype(float), levels=[0.5], colors=[_MODEL], linewidths=0.9)
    axes.set_aspect("equal")
    axes.tick_params(labelsize=6, colors=INK)


def pupil_masks(
    model: LensModel, share: float, points: int = _POINTS
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Grids u and v [points, points] of the pupil plane, mm, and what passes there, exact and by the model.

    From a film point at `share` of the film radius along +x, on the first film plane, at the middle wavelength; masks
    by name of opening.
    """
    b, d = model.domain.bounds, model.domain
    row = min(len(b.low_mm) - 1, round(share * (len(b.low_mm) - 1)))
    low, high, half = b.low_mm[row], b.high_mm[row], b.half_mm[row]
    if low >= high:
        low, high, half = -d.pupil_radius_mm, d.pupil_radius_mm, d.pupil_radius_mm
    reach = 1.08 * max((high - low) / 2, half)
    grid = torch.linspace(-reach, reach, points, dtype=torch.float64)
    u, v = (t.reshape(-1) for t in torch.meshgrid(grid + (low + high) / 2, grid, indexing="xy"))
    film_x = torch.full_like(u, share * d.film_radius_mm)
    wavelength = torch.full_like(u, sum(d.wavelength_nm) / 2)
    rays = FilmRays(film_x, torch.zeros_like(u), torch.full_like(u, d.film_z_mm[0]), u, v, wavelength)
    traced, found, stop = trace_pairs(model.lens, rays, d.pupil_z_mm), model.predict(rays), model.lens.stop_index
    exact: dict[str, np.ndarray] = {}
    said: dict[str, np.ndarray] = {}
    for name, (closed, blades) in OPENINGS.items():
        radius = d.stop_radius_mm / math.sqrt(2) ** closed
        both = (
            (exact, traced.status, traced.cross_x[stop], traced.cross_y[stop]),
            (said, found.status, found.stop_x, found.stop_y),
        )
        for masks, status, x, y in both:
            within = x * x + y * y <= radius**2 if blades is None else torch.as_tensor(blades.inside(x, y, radius))
            masks[name] = ((status == st.PASSED) & within).reshape(points, points).numpy()
    return u.reshape(points, points).numpy(), v.reshape(points, points).numpy(), exact, said
