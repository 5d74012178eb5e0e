"""Pictures of spots, ray fans and point spread: one row or panel a field."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.analysis.fans import Fans
from neurolens.analysis.plot_style import FAINT, field_name, heading, new_figure, save, style, wavelength_colour
from neurolens.analysis.psf import Psf
from neurolens.analysis.spots import Spots

_SHIFTS = 5


def plot_spots(data: Spots, path: str | Path, title: str, subtitle: str) -> Path:
    """Spots: rows are fields, columns the film moved through focus, the middle one as it stands; Airy disc beside."""
    shifts = np.linspace(data.shift_mm[0], data.shift_mm[-1], _SHIFTS)
    rows = len(data.field_deg)
    half = _half_width(data)
    with style():
        figure = new_figure(9.4, 1.75 * rows + 1.3)
        heading(figure, title, f"Spots through focus; {subtitle}")
        grid = figure.subplots(rows, _SHIFTS, sharex=True, sharey=True, squeeze=False)
        for i, j in np.ndindex(rows, _SHIFTS):
            axes = grid[i, j]
            _spot(axes, data, i, float(shifts[j]))
            axes.set(xlim=(-half, half), ylim=(-half, half), aspect="equal")
            axes.tick_params(labelsize=8)
            if i == 0:
                axes.set_title(f"film {1000 * shifts[j]:+.0f} µm" if abs(shifts[j]) > 1e-12 else "film as it stands")
            if j == 0:
                axes.set_ylabel(
                    f"{field_name(float(data.field_deg[i]))}, {data.height_mm[i]:.1f} mm\ntangential (µm)", size=8.5
                )
            if i == rows - 1:
                axes.set_xlabel("sagittal (µm)", size=8.5)
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), markerscale=4)
        return save(figure, path)


def _spot(axes: Any, data: Spots, field: int, shift_mm: float) -> None:
    t = data.tangential_um[field] + 1000 * shift_mm * data.slope_tangential[field]
    s = data.sagittal_um[field] + 1000 * shift_mm * data.slope_sagittal[field]
    middle_t, middle_s = _middle(t), _middle(s)
    for k, nm in enumerate(data.wavelength_nm):
        axes.plot(
            s[k] - middle_s, t[k] - middle_t, ".", ms=1.3, mew=0, color=wavelength_colour(nm), label=f"{nm:.0f} nm"
        )
    angle = np.linspace(0, 2 * math.pi, 65)
    if math.isfinite(data.airy_um):
        axes.plot(
            data.airy_um * np.cos(angle), data.airy_um * np.sin(angle), color="black", lw=0.8,
            label=f"Airy disc, radius {data.airy_um:.1f} µm",
        )  # fmt: skip
    rms = float(np.interp(shift_mm, data.shift_mm, data.through_focus_um[field]))
    axes.annotate(
        f"RMS {rms:.3g} µm" if math.isfinite(rms) else "no light",
        (0.04, 0.03),
        xycoords="axes fraction",
        fontsize=7,
        color="#555b63",
    )


def _middle(values: np.ndarray) -> float:
    return 0.0 if np.isnan(values).all() else float(np.nanmean(values))


def _half_width(data: Spots) -> float:
    """Half width that holds nearly all rays at every focus shown."""
    reach = [data.airy_um * 1.5] if math.isfinite(data.airy_um) else []
    for shift in (data.shift_mm[0], 0.0, data.shift_mm[-1]):
        t = data.tangential_um + 1000 * shift * data.slope_tangential
        s = data.sagittal_um + 1000 * shift * data.slope_sagittal
        for i in range(len(t)):
            away = np.hypot(t[i] - _middle(t[i]), s[i] - _middle(s[i]))
            if np.isfinite(away).any():
                reach.append(float(np.nanquantile(away, 0.97)))
    return 1.1 * max(reach, default=0.0) or 1.0


def plot_fans(data: Fans, path: str | Path, title: str, subtitle: str) -> Path:
    """Ray fans: a row a field, tangential left and sagittal right, one scale for all."""
    rows = len(data.field_deg)
    both = np.concatenate([data.tangential_um.ravel(), data.sagittal_um.ravel()])
    reach = 1.1 * float(np.nanmax(np.abs(both))) if np.isfinite(both).any() else 1.0
    with style():
        figure = new_figure(8.6, 1.55 * rows + 1.5)
        heading(figure, title, f"Ray fans, from the chief ray at {data.wavelength_nm[0]:.0f} nm; {subtitle}")
        grid = figure.subplots(rows, 2, sharex=True, sharey=True, squeeze=False)
        for i in range(rows):
            for axes, values, name in zip(
                grid[i], (data.tangential_um[i], data.sagittal_um[i]), ("tangential", "sagittal"), strict=True
            ):
                for k, nm in enumerate(data.wavelength_nm):
                    axes.plot(data.pupil, values[k], color=wavelength_colour(nm), lw=1.3, label=f"{nm:.0f} nm")
                axes.axhline(0, color=FAINT, lw=0.6)
                axes.axvline(0, color=FAINT, lw=0.6)
                axes.set(xlim=(-1, 1), ylim=(-reach, reach))
                if i == 0:
                    axes.set_title(name)
            grid[i, 0].set_ylabel(f"{field_name(float(data.field_deg[i]))}\naberration (µm)", size=8.5)
        for axes in grid[-1]:
            axes.set_xlabel("height in the stop / its radius")
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
        return save(figure, path)


def plot_psf(data: Psf, path: str | Path, title: str, subtitle: str) -> Path:
    """Point spread: geometric above, diffraction below, square root of the values so that faint light shows."""
    columns = len(data.field_deg)
    with style():
        figure = new_figure(max(9.0, 2.25 * columns), 6.0)
        heading(figure, title, f"Point spread, brightness as square root; {subtitle}")
        grid = figure.subplots(2, columns, squeeze=False)
        for i in range(columns):
            half = float(np.nan_to_num(data.half_width_um[i], nan=1.0))
            for axes, image in zip(grid[:, i], (data.geometric[i], data.diffraction[i]), strict=True):
                axes.tick_params(labelsize=7.5)
                axes.set(xlim=(-half, half), ylim=(-half, half), aspect="equal")
                if np.isfinite(image).all():
                    shown = np.sqrt(np.maximum(image, 0))
                    axes.imshow(shown, origin="lower", extent=(-half, half, -half, half), cmap="magma", vmin=0)
                else:
                    why = "aberrations far larger\nthan diffraction" if data.pupil_points[i] else "next to no light"
                    axes.text(0, 0, why, ha="center", va="center", fontsize=8)
            grid[0, i].set_title(field_name(float(data.field_deg[i])))
            if np.isfinite(data.strehl[i]):
                grid[1, i].set_title(f"Strehl ratio {data.strehl[i]:.3f}", fontsize=9)
            grid[1, i].set_xlabel("sagittal (µm)", size=8.5)
        waves = ", ".join(f"{nm:.0f}" for nm in data.wavelength_nm)
        grid[0, 0].set_ylabel(f"geometric ({waves} nm)\ntangential (µm)", size=8.5)
        grid[1, 0].set_ylabel(f"diffraction ({data.wavelength_nm[0]:.0f} nm)\ntangential (µm)", size=8.5)
        return save(figure, path)
