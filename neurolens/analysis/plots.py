"""Plots of the analyses: one function each. All but the Seidel sums are curves, or one panel per field."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.analysis.field_curves import Colour, Curvature, Distortion, Illumination
from neurolens.analysis.plot_style import FAINT, FIELD_COLOURS, INK, drawing, field_name, wavelength_colour
from neurolens.analysis.seidel import Seidel
from neurolens.analysis.spots import Fans, Mtf, Spots
from neurolens.analysis.wavefront import Psf


def plot_colour(data: Colour, path: str | Path, title: str, subtitle: str) -> None:
    """Longitudinal colour by zones against wavelength, and lateral colour against field."""
    with drawing(path, 9.4, 4.6, title, f"Colour; {subtitle}") as figure:
        left, right = figure.subplots(1, 2)
        names = ("paraxial", f"zone {data.zone[1]:.2f}", "edge of the stop")
        for k, name in enumerate(names):
            left.plot(data.spectrum_nm, data.focus_shift_mm[:, k], color=FIELD_COLOURS[k], label=name)
        left.axhline(0, color=FAINT, lw=0.7)
        left.set(xlabel="wavelength (nm)", ylabel="focus from the film (mm)", title="longitudinal, on the axis")
        for k, nm in enumerate(data.line_nm):
            right.plot(data.field_deg, data.lateral_um[:, k], color=wavelength_colour(nm), label=f"{nm:.0f} nm")
        right.set(xlabel="field (degrees)", ylabel=f"height from that at {data.line_nm[0]:.0f} nm (µm)")
        right.set_title("lateral, chief rays")
        if (np.nan_to_num(np.abs(data.lateral_um)) < 1e-3).all():
            right.set_ylim(-1e-3, 1e-3)  # rounding is not drawn as colour
        for axes in (left, right):
            axes.grid(True)
            axes.legend()


def plot_curvature(data: Curvature, path: str | Path, title: str, subtitle: str) -> None:
    """Sagittal, tangential and Petzval foci (across) against image height (up), as lens catalogues draw them."""
    text = f"Field curvature and astigmatism, {data.wavelength_nm:.0f} nm\n{subtitle}"
    with drawing(path, 6.4, 5.2, title, text) as figure:
        axes = figure.add_subplot()
        axes.plot(data.sagittal_mm, data.height_mm, color=FIELD_COLOURS[0], label="sagittal")
        axes.plot(data.tangential_mm, data.height_mm, color=FIELD_COLOURS[3], label="tangential")
        if np.isfinite(data.petzval_mm).all():
            axes.plot(data.petzval_mm, data.height_mm, color="#7f7f7f", ls="--", label="Petzval (third order)")
        axes.axvline(0, color=FAINT, lw=0.7)
        axes.grid(True)
        axes.set(xlabel="focus from the film, away from the lens (mm)", ylabel="image height (mm)")
        _degrees(axes, data.height_mm, data.field_deg)
        axes.legend()


def plot_distortion(data: Distortion, path: str | Path, title: str, subtitle: str) -> None:
    """Distortion against the closest projections, the reference drawn thick."""
    with drawing(path, 7.4, 4.8, title, f"Distortion, {data.wavelength_nm:.0f} nm; {subtitle}") as figure:
        axes = figure.add_subplot()
        limit = max(2.0, 1.25 * float(np.nan_to_num(np.abs(data.error_percent[data.reference])).max()))
        for k, (name, error) in enumerate(data.error_percent.items()):
            chosen = name == data.reference
            label = f"against {name}{' (reference)' if chosen else ''}"
            look = {"lw": 2.2, "zorder": 3} if chosen else {"lw": 1.0, "zorder": 2}
            axes.plot(data.field_deg, error, color=FIELD_COLOURS[k], label=label, **look)
        axes.axhline(0, color=FAINT, lw=0.7)
        axes.grid(True)
        axes.set(xlabel="field (degrees)", ylabel="distortion (%)", ylim=(-limit, limit))
        figure.legend(loc="outside lower center", ncols=2)


def plot_vignetting(data: Illumination, path: str | Path, title: str, subtitle: str) -> None:
    """Relative illumination and what it is made of, against image height."""
    with drawing(path, 7.4, 4.8, title, f"Vignetting and relative illumination; {subtitle}") as figure:
        axes = figure.add_subplot()
        rows = (
            (data.relative, "relative illumination", FIELD_COLOURS[0], "-", 2.2),
            (data.unvignetted, "without the rims", FIELD_COLOURS[2], "-", 1.2),
            (data.passed, "share of the stop's beam that the rims pass", FIELD_COLOURS[3], "-", 1.2),
            (data.cos4, "cos⁴ of the field", "#7f7f7f", "--", 1.2),
        )
        for values, label, colour, line, width in rows:
            axes.plot(data.height_mm, 100 * values, color=colour, ls=line, lw=width, label=label)
        axes.grid(True)
        axes.set(xlabel="image height (mm)", ylabel="share of the axis (%)")
        axes.set_ylim(0, max(105.0, 105 * float(np.nan_to_num([data.relative, data.unvignetted]).max())))
        _degrees(axes, data.height_mm, data.field_deg, across=True)
        axes.legend(loc="lower left")


def plot_mtf(data: Mtf, path: str | Path, title: str, subtitle: str) -> None:
    """MTF against frequency: a colour per field, tangential solid, sagittal dashed."""
    waves = ", ".join(f"{nm:.0f}" for nm in data.wavelength_nm)
    with drawing(path, 8.4, 6.0, title, f"Geometric MTF at {waves} nm, without diffraction; {subtitle}") as figure:
        axes = figure.add_subplot()
        for k, field in enumerate(data.field_deg):
            colour, look = FIELD_COLOURS[k % len(FIELD_COLOURS)], {"tangential": "-", "sagittal": "--"}
            for name, contrast in (("tangential", data.tangential), ("sagittal", data.sagittal))[: 2 if field else 1]:
                label = f"{field_name(field)}, {name}"
                axes.plot(data.frequency_per_mm, contrast[k], color=colour, ls=look[name], label=label)
        if np.isfinite(data.diffraction_limit).all():
            limit = f"diffraction limit, f/{data.working_f_number:.3g}"
            axes.plot(data.frequency_per_mm, data.diffraction_limit, color=INK, ls=":", label=limit)
        axes.grid(True)
        axes.set(xlabel="frequency (cycles/mm)", ylabel="contrast", ylim=(0, 1.02))
        axes.set_xlim(0, data.frequency_per_mm[-1])
        figure.legend(loc="outside lower center", ncols=4)


def plot_mtf_over_height(data: Mtf, path: str | Path, title: str, subtitle: str) -> None:
    """MTF against image height: a colour per frequency, tangential solid, sagittal dashed."""
    waves = ", ".join(f"{nm:.0f}" for nm in data.wavelength_nm)
    with drawing(path, 7.4, 5.4, title, f"Geometric MTF at {waves} nm, without diffraction; {subtitle}") as figure:
        axes = figure.add_subplot()
        for k, frequency in enumerate(data.frequency_per_mm):
            for name, values, line in (("tangential", data.tangential, "-"), ("sagittal", data.sagittal, "--")):
                look = {"color": FIELD_COLOURS[k % len(FIELD_COLOURS)], "ls": line, "lw": 1.6}
                axes.plot(data.height_mm, values[:, k], label=f"{frequency:g} cycles/mm, {name}", **look)
        axes.grid(True)
        axes.set(xlabel="image height (mm)", ylabel="contrast", ylim=(0, 1.02))
        axes.set_xlim(0, float(np.nanmax(data.height_mm)))
        _degrees(axes, data.height_mm, data.field_deg, across=True)
        figure.legend(loc="outside lower center", ncols=len(data.frequency_per_mm))


def plot_seidel(data: Seidel, path: str | Path, title: str, subtitle: str) -> None:
    """Seidel sums as bars, surface by surface, with their total apart."""
    text = f"Seidel sums at {data.image_height_mm:.1f} mm image height, {data.wavelength_nm:.0f} nm; {subtitle}"
    with drawing(path, max(8.4, 0.3 * len(data.surfaces) + 3), 10.0, title, text) as figure:
        rows = figure.subplots(len(data.names), 1, sharex=True)
        place = np.arange(len(data.surfaces))
        for k, (axes, name) in enumerate(zip(rows, data.names, strict=True)):
            axes.bar(place, data.surfaces[:, k], color=FIELD_COLOURS[0], width=0.7, label="surface")
            axes.bar([len(place) + 0.5], [data.total[k]], color=FIELD_COLOURS[3], width=0.9, label="total")
            axes.axhline(0, color=FAINT, lw=0.7)
            axes.set_ylabel(f"{name.replace(' ', chr(10), 1)}\n(mm)", size=8)
            axes.annotate(f"total {data.total[k]:.3g}", (1, 0.9), xycoords="axes fraction", ha="right", fontsize=8)
        step = 1 if len(place) <= 24 else 2
        rows[-1].set_xticks([*place[::step], len(place) + 0.5], [*map(str, place[::step]), "total"])
        rows[-1].set_xlabel("surface, counted from the scene")
        figure.legend(*rows[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)


def _degrees(axes: Any, height: Any, field: Any, across: bool = False) -> None:
    sound = np.isfinite(height)
    height, field = (_lengthened(v[sound]) for v in (height, field))

    def to_field(h: Any) -> Any:
        return np.interp(h, height, field)

    def to_height(f: Any) -> Any:
        return np.interp(f, field, height)

    if len(height) < 2 or not (np.diff(height) > 0).all():
        return
    make = axes.secondary_xaxis if across else axes.secondary_yaxis
    second = make("top" if across else "right", functions=(to_field, to_height))
    (second.set_xlabel if across else second.set_ylabel)("field (degrees)")


def _lengthened(values: Any) -> Any:
    """The values extrapolated linearly at both ends, for ticks beyond them."""
    if len(values) < 2:
        return values
    before, after = values[0] - 100 * (values[1] - values[0]), values[-1] + 100 * (values[-1] - values[-2])
    return np.concatenate([[before], values, [after]])


_SHIFTS = 5


def plot_spots(data: Spots, path: str | Path, title: str, subtitle: str) -> None:
    """Spots: rows are fields, columns the film moved through focus, the middle one unshifted, with the Airy disc."""
    columns = min(_SHIFTS, len(data.shift_mm))
    shifts = np.linspace(data.shift_mm[0], data.shift_mm[-1], columns)
    rows = len(data.field_deg)
    half = _half_width(data)
    with drawing(
        path, 1.4 + 1.6 * max(columns, 2), 1.75 * rows + 1.3, title, f"Spots through focus; {subtitle}"
    ) as figure:
        grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for i, j in np.ndindex(rows, columns):
            axes = grid[i, j]
            _spot(axes, data, i, float(shifts[j]))
            axes.set(xlim=(-half, half), ylim=(-half, half), aspect="equal")
            axes.tick_params(labelsize=8)
            if i == 0:
                axes.set_title(f"film {1000 * shifts[j]:+.0f} µm" if abs(shifts[j]) > 1e-12 else "film in place")
            if j == 0:
                axes.set_ylabel(
                    f"{field_name(float(data.field_deg[i]))}, {data.height_mm[i]:.1f} mm\ntangential (µm)", size=8.5
                )
            if i == rows - 1:
                axes.set_xlabel("sagittal (µm)", size=8.5)
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), markerscale=4)


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
        ring = data.airy_um * np.array([np.cos(angle), np.sin(angle)])
        axes.plot(*ring, color="black", lw=0.8, label=f"Airy disc, radius {data.airy_um:.1f} µm")
    rms = float(np.interp(shift_mm, data.shift_mm, data.through_focus_um[field]))
    text = f"RMS {rms:.3g} µm" if math.isfinite(rms) else "no light"
    axes.annotate(text, (0.04, 0.03), xycoords="axes fraction", fontsize=7, color="#555b63")


def _middle(values: np.ndarray) -> float:
    return 0.0 if np.isnan(values).all() else float(np.nanmean(values))


def _half_width(data: Spots) -> float:
    """Half width that contains nearly all rays at every focus shown."""
    reach = [data.airy_um * 1.5] if math.isfinite(data.airy_um) else []
    for shift in (data.shift_mm[0], 0.0, data.shift_mm[-1]):
        t = data.tangential_um + 1000 * shift * data.slope_tangential
        s = data.sagittal_um + 1000 * shift * data.slope_sagittal
        for i in range(len(t)):
            away = np.hypot(t[i] - _middle(t[i]), s[i] - _middle(s[i]))
            if np.isfinite(away).any():
                reach.append(float(np.nanquantile(away, 0.97)))
    return 1.1 * max(reach, default=0.0) or 1.0


def plot_fans(data: Fans, path: str | Path, title: str, subtitle: str) -> None:
    """Ray fans: a row per field, tangential left and sagittal right, one scale for all."""
    rows = len(data.field_deg)
    every = np.concatenate([data.tangential_um.ravel(), data.sagittal_um.ravel()])
    reach = 1.1 * float(np.nanmax(np.abs(every))) if np.isfinite(every).any() else 1.0
    heading = f"Ray fans, from the chief ray at {data.wavelength_nm[0]:.0f} nm; {subtitle}"
    with drawing(path, 8.6, 1.55 * rows + 1.5, title, heading) as figure:
        grid = figure.subplots(rows, 2, sharex=True, sharey=True, squeeze=False)
        for i in range(rows):
            both = (("tangential", data.tangential_um[i]), ("sagittal", data.sagittal_um[i]))
            for axes, (name, values) in zip(grid[i], both, strict=True):
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


def plot_psf(data: Psf, path: str | Path, title: str, subtitle: str) -> None:
    """Point spread: geometric above, diffraction below, square root of the values so that faint light shows."""
    columns = len(data.field_deg)
    text = f"Point spread, brightness as square root; {subtitle}"
    with drawing(path, max(9.0, 2.25 * columns), 6.0, title, text) as figure:
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
                    why = "aberrations far larger\nthan diffraction" if data.pupil_points[i] else "almost no light"
                    axes.text(0, 0, why, ha="center", va="center", fontsize=8)
            grid[0, i].set_title(field_name(float(data.field_deg[i])))
            if np.isfinite(data.strehl[i]):
                grid[1, i].set_title(f"Strehl ratio {data.strehl[i]:.3f}", fontsize=9)
            grid[1, i].set_xlabel("sagittal (µm)", size=8.5)
        waves = ", ".join(f"{nm:.0f}" for nm in data.wavelength_nm)
        grid[0, 0].set_ylabel(f"geometric ({waves} nm)\ntangential (µm)", size=8.5)
        grid[1, 0].set_ylabel(f"diffraction ({data.wavelength_nm[0]:.0f} nm)\ntangential (µm)", size=8.5)
