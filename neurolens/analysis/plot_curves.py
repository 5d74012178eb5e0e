"""Pictures of what is a curve: colour, field curvature, distortion, illumination, MTF, and the Seidel sums as bars."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from neurolens.analysis.colour import Colour
from neurolens.analysis.curvature import Curvature
from neurolens.analysis.distortion import Distortion
from neurolens.analysis.illumination import Illumination
from neurolens.analysis.mtf import Mtf
from neurolens.analysis.plot_style import (
    FAINT,
    FIELD_COLOURS,
    INK,
    field_name,
    heading,
    new_figure,
    save,
    style,
    wavelength_colour,
)
from neurolens.analysis.seidel import Seidel


def plot_colour(data: Colour, path: str | Path, title: str, subtitle: str) -> Path:
    """Longitudinal colour by zones against wavelength, and lateral colour against field."""
    with style():
        figure = new_figure(9.4, 4.6)
        heading(figure, title, f"Colour; {subtitle}")
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
        for axes in (left, right):
            axes.grid(True)
            axes.legend()
        return save(figure, path)


def plot_curvature(data: Curvature, path: str | Path, title: str, subtitle: str) -> Path:
    """Sagittal, tangential and Petzval foci (across) against image height (up), as lens catalogues draw them."""
    with style():
        figure = new_figure(6.4, 5.2)
        heading(figure, title, f"Field curvature and astigmatism, {data.wavelength_nm:.0f} nm\n{subtitle}")
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
        return save(figure, path)


def plot_distortion(data: Distortion, path: str | Path, title: str, subtitle: str) -> Path:
    """Distortion against the projections that come near, the reference drawn thick."""
    with style():
        figure = new_figure(7.4, 4.8)
        heading(figure, title, f"Distortion, {data.wavelength_nm:.0f} nm; {subtitle}")
        axes = figure.add_subplot()
        limit = max(2.0, 1.25 * float(np.nan_to_num(np.abs(data.error_percent[data.reference])).max()))
        for k, (name, error) in enumerate(data.error_percent.items()):
            chosen = name == data.reference
            label = f"against {name}{' (reference)' if chosen else ''}"
            axes.plot(
                data.field_deg, error, color=FIELD_COLOURS[k], lw=2.2 if chosen else 1.0, label=label,
                zorder=3 if chosen else 2,
            )  # fmt: skip
        axes.axhline(0, color=FAINT, lw=0.7)
        axes.grid(True)
        axes.set(xlabel="field (degrees)", ylabel="distortion (%)", ylim=(-limit, limit))
        figure.legend(loc="outside lower center", ncols=2)
        return save(figure, path)


def plot_vignetting(data: Illumination, path: str | Path, title: str, subtitle: str) -> Path:
    """Relative illumination and what it is made of, against image height."""
    with style():
        figure = new_figure(7.4, 4.8)
        heading(figure, title, f"Vignetting and relative illumination; {subtitle}")
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
        return save(figure, path)


def plot_mtf(data: Mtf, path: str | Path, title: str, subtitle: str) -> Path:
    """MTF against frequency: a colour a field, tangential solid, sagittal dashed."""
    waves = ", ".join(f"{nm:.0f}" for nm in data.wavelength_nm)
    with style():
        figure = new_figure(8.4, 6.0)
        heading(figure, title, f"Geometric MTF at {waves} nm, without diffraction; {subtitle}")
        axes = figure.add_subplot()
        for k, field in enumerate(data.field_deg):
            colour = FIELD_COLOURS[k % len(FIELD_COLOURS)]
            axes.plot(data.frequency_per_mm, data.tangential[k], color=colour, label=f"{field_name(field)}, tangential")
            if field:
                axes.plot(
                    data.frequency_per_mm,
                    data.sagittal[k],
                    color=colour,
                    ls="--",
                    label=f"{field_name(field)}, sagittal",
                )
        if np.isfinite(data.diffraction_limit).all():
            limit = f"diffraction limit, f/{data.working_f_number:.3g}"
            axes.plot(data.frequency_per_mm, data.diffraction_limit, color=INK, ls=":", label=limit)
        axes.grid(True)
        axes.set(xlabel="frequency (cycles/mm)", ylabel="contrast", ylim=(0, 1.02))
        axes.set_xlim(0, data.frequency_per_mm[-1])
        figure.legend(loc="outside lower center", ncols=4)
        return save(figure, path)


def plot_seidel(data: Seidel, path: str | Path, title: str, subtitle: str) -> Path:
    """Seidel sums as bars, surface by surface, with their total apart."""
    with style():
        figure = new_figure(max(8.4, 0.3 * len(data.surfaces) + 3), 10.0)
        text = f"Seidel sums at {data.image_height_mm:.1f} mm image height, {data.wavelength_nm:.0f} nm; {subtitle}"
        heading(figure, title, text)
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
        return save(figure, path)


def _degrees(axes: Any, height: Any, field: Any, across: bool = False) -> None:
    """A second axis with the field in degrees beside the image height."""
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
    """The values with their ends carried on straight, so that ticks beyond them are right."""
    if len(values) < 2:
        return values
    before, after = values[0] - 100 * (values[1] - values[0]), values[-1] + 100 * (values[-1] - values[-2])
    return np.concatenate([[before], values, [after]])
