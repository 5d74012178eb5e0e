"""Plots: the style that all plots of the package share, and one function for each analysis of a lens."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from neurolens.base.errors import NeurolensError, pip_install, without_controls
from neurolens.base.files import atomic_path

if TYPE_CHECKING:
    from neurolens.optics.analysis.corners import Spread
    from neurolens.optics.analysis.field_curves import Colour, Curvature, Distortion, Illumination, Seidel
    from neurolens.optics.analysis.psf import Psf
    from neurolens.optics.analysis.spots import Fans, Mtf, Spots

# Okabe and Ito's colours, distinguishable by colour-blind readers.
FIELD_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#56b4e9", "#7f7f7f")
INK, FAINT = "#1b1f24", "#8a929b"
_GREY = "#7f7f7f"
_STYLE: Any = {
    "font.family": "DejaVu Sans", "font.size": 9.5, "axes.titlesize": 11, "axes.labelsize": 10.5,
    "axes.edgecolor": "#4a5058", "axes.labelcolor": INK, "axes.spines.top": False, "axes.spines.right": False,
    "axes.axisbelow": True, "grid.color": "#e3e6ea", "grid.linewidth": 0.7, "legend.frameon": False,
    "legend.fontsize": 8.8, "text.color": INK, "xtick.color": "#33383f", "ytick.color": "#33383f",
    "figure.dpi": 150, "savefig.dpi": 150, "text.parse_math": False,  # no mathtext in names with dollar signs
}  # fmt: skip


def style() -> Any:
    """Return a context in which a figure is made and written, untouched by the user's own settings of matplotlib."""
    try:
        import matplotlib
    except ImportError as error:
        raise NeurolensError(f"plots need matplotlib: {pip_install('train')}") from error
    return matplotlib.rc_context(_STYLE)


def new_figure(width_in: float, height_in: float) -> Any:
    """Return a matplotlib Figure on an Agg canvas: no pyplot, no window, nothing left open."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure


@contextmanager
def drawing(path: str | Path, width_in: float, height_in: float, title: str = "", subtitle: str = "") -> Iterator[Any]:
    """Yield a figure in the common style; it is written to `path` (PNG, PDF or SVG, by its suffix) after the block.

    A title stands at its top left, with the subtitle in a lighter colour below it.
    """
    with style():
        figure = new_figure(width_in, height_in)
        heads = list[Any]()
        if title:
            room = "\n\n" + "\n" * subtitle.count("\n") if subtitle else ""  # lines that the layout keeps free
            heads = [
                figure.suptitle(title + room, x=0.01, ha="left", fontsize=12, fontweight="bold"),
                figure.text(0.01, 1 - 0.36 / height_in, subtitle, ha="left", va="top", fontsize=9, color="#555b63"),
            ]
        yield figure
        for text in figure.findobj(lambda artist: hasattr(artist, "set_text")):
            text.set_text(without_controls(text.get_text()))  # a lens's name may hold anything, and SVG is XML
        for text in heads:  # long names stay within the picture
            wide = text.get_window_extent().width / figure.bbox.width
            text.set_fontsize(text.get_fontsize() * min(1.0, 0.98 / max(wide, 1e-9)))
        with atomic_path(path) as temporary:
            figure.savefig(temporary, facecolor="white")


def plain_log_ticks(*axes: Any) -> None:
    """Label logarithmic axes 0.1, 1, 10,000 rather than by powers; with 2 and 5 between where that leaves few ticks."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis in axes:
        low, high = sorted(axis.get_view_interval())
        subs = (1.0,) if high / max(low, 1e-300) > 400 else (1.0, 2.0, 5.0)
        axis.set_major_locator(LogLocator(base=10, subs=subs, numticks=15))
        axis.set_minor_locator(LogLocator(base=10, subs=tuple(range(2, 10)), numticks=60))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.7g}"))
        axis.set_minor_formatter(NullFormatter())


def _wavelength_colour(wavelength_nm: float) -> str:
    """Return a colour similar to that of the wavelength, legible on white."""
    limits = ((450, "#7b4fa3"), (505, "#0072b2"), (600, "#009e73"), (1e9, "#d55e00"))
    return next(colour for limit, colour in limits if wavelength_nm < limit)


def _field_name(field_deg: float) -> str:
    return "axis" if field_deg == 0 else f"{field_deg:.1f}°"


def _wavelengths(wavelength_nm: Iterable[float]) -> str:
    return ", ".join(f"{nm:.0f}" for nm in wavelength_nm) + " nm"


@contextmanager
def _curves(
    path: str | Path, size: tuple[float, float], title: str, subtitle: str, labels: dict[str, Any], columns: int = 0
) -> Iterator[Any]:
    """Yield axes with a grid for curves, the legend inside or, in some columns, below; `labels` go to `axes.set`."""
    with drawing(path, *size, title, subtitle) as figure:
        axes = figure.add_subplot()
        axes.grid(True)
        axes.set(**labels)
        yield axes
        if columns:
            figure.legend(loc="outside lower center", ncols=columns)
        else:
            axes.legend()


def plot_colour(data: Colour, path: str | Path, title: str, subtitle: str) -> None:
    """Plot longitudinal colour by zones against wavelength, and lateral colour against field."""
    with drawing(path, 9.4, 4.6, title, f"Colour; {subtitle}") as figure:
        left, right = figure.subplots(1, 2)
        names = ("paraxial", f"zone {data.zone[1]:.2f}", "edge of the stop")
        for k, name in enumerate(names):
            left.plot(data.spectrum_nm, data.focus_shift_mm[:, k], color=FIELD_COLOURS[k], label=name)
        left.axhline(0, color=FAINT, lw=0.7)
        left.set(xlabel="wavelength (nm)", ylabel="focus from the film (mm)", title="longitudinal, on the axis")
        for k, nm in enumerate(data.line_nm):
            right.plot(data.field_deg, data.lateral_um[:, k], color=_wavelength_colour(nm), label=f"{nm:.0f} nm")
        right.set(xlabel="field (degrees)", ylabel=f"height from that at {data.line_nm[0]:.0f} nm (µm)")
        right.set_title("lateral, chief rays")
        if (np.nan_to_num(np.abs(data.lateral_um)) < 1e-3).all():
            right.set_ylim(-1e-3, 1e-3)  # rounding is not drawn as colour
        for axes in (left, right):
            axes.grid(True)
            axes.legend()


def plot_curvature(data: Curvature, path: str | Path, title: str, subtitle: str) -> None:
    """Plot sagittal, tangential and Petzval foci (across) against image height (up), as lens catalogues draw them."""
    text = f"Field curvature and astigmatism, {data.wavelength_nm:.0f} nm\n{subtitle}"
    labels = {"xlabel": "focus from the film, away from the lens (mm)", "ylabel": "image height (mm)"}
    with _curves(path, (6.4, 5.2), title, text, labels) as axes:
        axes.plot(data.sagittal_mm, data.height_mm, color=FIELD_COLOURS[0], label="sagittal")
        axes.plot(data.tangential_mm, data.height_mm, color=FIELD_COLOURS[3], label="tangential")
        if np.isfinite(data.petzval_mm).all():
            axes.plot(data.petzval_mm, data.height_mm, color=_GREY, ls="--", label="Petzval (third order)")
        axes.axvline(0, color=FAINT, lw=0.7)
        _degrees(axes, data)


def plot_distortion(data: Distortion, path: str | Path, title: str, subtitle: str) -> None:
    """Plot distortion against the closest projections; the reference is a thick line."""
    limit = max(2.0, 1.25 * float(np.nan_to_num(np.abs(data.error_percent[data.reference])).max()))
    text = f"Distortion, {data.wavelength_nm:.0f} nm; {subtitle}"
    labels = {"xlabel": "field (degrees)", "ylabel": "distortion (%)", "ylim": (-limit, limit)}
    with _curves(path, (7.4, 4.8), title, text, labels, columns=2) as axes:
        for k, (name, error) in enumerate(data.error_percent.items()):
            chosen = name == data.reference
            label = f"against {name}{' (reference)' if chosen else ''}"
            look = {"lw": 2.2, "zorder": 3} if chosen else {"lw": 1.0, "zorder": 2}
            axes.plot(data.field_deg, error, color=FIELD_COLOURS[k], label=label, **look)
        axes.axhline(0, color=FAINT, lw=0.7)


def plot_vignetting(data: Illumination, path: str | Path, title: str, subtitle: str) -> None:
    """Plot relative illumination and its factors against image height."""
    rows = (
        (data.relative, "relative illumination", FIELD_COLOURS[0], "-", 2.2),
        (data.unvignetted, "without the rims", FIELD_COLOURS[2], "-", 1.2),
        (data.passed, "share of the stop's beam that the rims pass", FIELD_COLOURS[3], "-", 1.2),
        (data.cos4, "cos⁴ of the field", _GREY, "--", 1.2),
    )
    top = max(105.0, 105 * float(np.nan_to_num([data.relative, data.unvignetted]).max()))
    text = f"Vignetting and relative illumination; {subtitle}"
    labels = {"xlabel": "image height (mm)", "ylabel": "share of the axis (%)", "ylim": (0, top)}
    with _curves(path, (7.4, 4.8), title, text, labels) as axes:
        for values, label, colour, line, width in rows:
            axes.plot(data.height_mm, 100 * values, color=colour, ls=line, lw=width, label=label)
        _degrees(axes, data, across=True)


def plot_mtf(data: Mtf, path: str | Path, title: str, subtitle: str) -> None:
    """Plot MTF against frequency: a colour per field, tangential solid, sagittal dashed."""
    text = f"Geometric MTF at {_wavelengths(data.wavelength_nm)}, without diffraction; {subtitle}"
    labels: dict[str, Any] = {
        "xlabel": "frequency (cycles/mm)",
        "ylabel": "contrast",
        "ylim": (0, 1.02),
        "xlim": (0, data.frequency_per_mm[-1]),
    }
    with _curves(path, (8.4, 6.0), title, text, labels, columns=4) as axes:
        for k, field in enumerate(data.field_deg):
            both = (("tangential", data.tangential, "-"), ("sagittal", data.sagittal, "--"))
            for name, contrast, line in both[: 2 if field else 1]:
                look = {"color": FIELD_COLOURS[k % len(FIELD_COLOURS)], "ls": line}
                axes.plot(data.frequency_per_mm, contrast[k], label=f"{_field_name(field)}, {name}", **look)
        if np.isfinite(data.diffraction_limit).all():
            limit = f"diffraction limit, f/{data.working_f_number:.3g}"
            axes.plot(data.frequency_per_mm, data.diffraction_limit, color=INK, ls=":", label=limit)


def plot_mtf_over_height(data: Mtf, path: str | Path, title: str, subtitle: str) -> None:
    """Plot MTF against image height: a colour per frequency, tangential solid, sagittal dashed."""
    text = f"Geometric MTF at {_wavelengths(data.wavelength_nm)}, without diffraction; {subtitle}"
    labels: dict[str, Any] = {
        "xlabel": "image height (mm)",
        "ylabel": "contrast",
        "ylim": (0, 1.02),
        "xlim": (0, float(np.nanmax(data.height_mm))),
    }
    with _curves(path, (7.4, 5.4), title, text, labels, columns=len(data.frequency_per_mm)) as axes:
        for k, frequency in enumerate(data.frequency_per_mm):
            for name, values, line in (("tangential", data.tangential, "-"), ("sagittal", data.sagittal, "--")):
                look = {"color": FIELD_COLOURS[k % len(FIELD_COLOURS)], "ls": line, "lw": 1.6}
                axes.plot(data.height_mm, values[:, k], label=f"{frequency:g} cycles/mm, {name}", **look)
        _degrees(axes, data, across=True)


def plot_seidel(data: Seidel, path: str | Path, title: str, subtitle: str) -> None:
    """Plot Seidel sums as bars, surface by surface, with their total apart."""
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


def plot_spread(data: Spread, path: str | Path, title: str, subtitle: str) -> None:
    """Plot the shares of copies below each contrast, at each place, and how their focal planes are turned."""
    frequency = f"{data.frequency_per_mm[-1]:g} cycles/mm"
    text = f"{len(data.copy)} copies, seed {data.seed}; dashed: as designed; {subtitle}"
    with drawing(path, 9.4, 4.8, title, text) as figure:
        left, right = figure.subplots(1, 2)
        share = 100 * (np.arange(len(data.copy)) + 0.5) / len(data.copy)
        for k, place in enumerate(data.place):
            left.plot(np.sort(data.copy_contrast[:, k]), share, color=FIELD_COLOURS[k], label=place)
            left.axvline(data.contrast[k], color=FIELD_COLOURS[k], ls="--", lw=0.9)
        left.set(xlabel=f"MTF at {frequency}, mean of both directions", ylabel="copies that have at most this (%)")
        left.set(xlim=(0, 1), ylim=(0, 100))
        right.plot(data.film_swing_deg, data.film_tilt_deg, "o", ms=3.5, mew=0, alpha=0.6, color=FIELD_COLOURS[0])
        reach = 1.1 * float(np.abs([data.film_tilt_deg, data.film_swing_deg]).max()) or 1.0
        right.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", title="turn of the focal plane")
        right.set(xlabel="film swing that follows it (degrees)", ylabel="film tilt that follows it (degrees)")
        right.locator_params(nbins=5)
        for axes in (left, right):
            axes.grid(True)
        left.legend()


def _degrees(axes: Any, data: Any, across: bool = False) -> None:
    """Add an axis with the field in degrees to that of image heights."""
    known = np.isfinite(data.height_mm)
    height, field = data.height_mm[known], data.field_deg[known]
    if len(height) < 2 or not (np.diff(height) > 0).all():
        return
    # Both are continued linearly at their ends, for ticks beyond them.
    height, field = (
        np.concatenate([[v[0] - 100 * (v[1] - v[0])], v, [v[-1] + 100 * (v[-1] - v[-2])]]) for v in (height, field)
    )
    functions = (lambda h: np.interp(h, height, field), lambda f: np.interp(f, field, height))
    if across:
        axes.secondary_xaxis("top", functions=functions).set_xlabel("field (degrees)")
    else:
        axes.secondary_yaxis("right", functions=functions).set_ylabel("field (degrees)")


_SHIFTS = 5


def plot_spots(data: Spots, path: str | Path, title: str, subtitle: str) -> None:
    """Plot spots: a row per field, a column per focus with the unshifted film in the middle, and the Airy disc."""
    rows, columns = len(data.field_deg), min(_SHIFTS, len(data.shift_mm))
    shifts, half = np.linspace(data.shift_mm[0], data.shift_mm[-1], columns), _half_width(data)
    size = 1.4 + 1.6 * max(columns, 2), 1.75 * rows + 1.3
    with drawing(path, *size, title, f"Spots{' through focus' * (columns > 1)}; {subtitle}") as figure:
        grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for i, j in np.ndindex(rows, columns):
            axes = grid[i, j]
            _spot(axes, data, i, float(shifts[j]))
            axes.set(xlim=(-half, half), ylim=(-half, half), aspect="equal")
            axes.tick_params(labelsize=8)
        for j, axes in enumerate(grid[0]):
            axes.set_title(f"film {1000 * shifts[j]:+.0f} µm" if abs(shifts[j]) > 1e-12 else "film in place")
        for i, axes in enumerate(grid[:, 0]):
            name = f"{_field_name(float(data.field_deg[i]))}, {abs(data.height_mm[i]):.1f} mm"
            axes.set_ylabel(f"{name}\ntangential (µm)", size=8.5)
        for axes in grid[-1]:
            axes.set_xlabel("sagittal (µm)", size=8.5)
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), markerscale=4)


def _points(data: Spots, field: int, shift_mm: float) -> tuple[Any, Any]:
    """Tangential and sagittal points [W, P] of a field from their middle, with the film moved; NaN if blocked."""
    t = data.tangential_um[field] + 1000 * shift_mm * data.slope_tangential[field]
    s = data.sagittal_um[field] + 1000 * shift_mm * data.slope_sagittal[field]
    return (t, s) if np.isnan(t).all() else (t - np.nanmean(t), s - np.nanmean(s))


def _spot(axes: Any, data: Spots, field: int, shift_mm: float) -> None:
    t, s = _points(data, field, shift_mm)
    for k, nm in enumerate(data.wavelength_nm):
        axes.plot(s[k], t[k], ".", ms=1.3, mew=0, color=_wavelength_colour(nm), label=f"{nm:.0f} nm")
    angle = np.linspace(0, 2 * math.pi, 65)
    if math.isfinite(data.airy_um):
        ring = data.airy_um * np.array([np.cos(angle), np.sin(angle)])
        axes.plot(*ring, color="black", lw=0.8, label=f"Airy disc, radius {data.airy_um:.1f} µm")
    rms = float(np.interp(shift_mm, data.shift_mm, data.through_focus_um[field]))
    text = f"RMS {rms:.3g} µm" if math.isfinite(rms) else "no light"
    axes.annotate(text, (0.04, 0.03), xycoords="axes fraction", fontsize=7, color="#555b63")


def _half_width(data: Spots) -> float:
    """Return the half width that contains nearly all rays at every focus shown."""
    reach = [data.airy_um * 1.5] if math.isfinite(data.airy_um) else []
    for shift in (data.shift_mm[0], 0.0, data.shift_mm[-1]):
        away = [np.hypot(*_points(data, i, shift)) for i in range(len(data.field_deg))]
        reach += [float(np.nanquantile(a, 0.97)) for a in away if np.isfinite(a).any()]
    return 1.1 * max(reach, default=0.0) or 1.0


def plot_fans(data: Fans, path: str | Path, title: str, subtitle: str) -> None:
    """Plot ray fans: a row per field, tangential left and sagittal right, one scale for all."""
    rows = len(data.field_deg)
    every = np.concatenate([data.tangential_um.ravel(), data.sagittal_um.ravel()])
    reach = 1.1 * float(np.nanmax(np.abs(every))) if np.isfinite(every).any() else 1.0
    heading = f"Ray fans, from the chief ray at {data.wavelength_nm[0]:.0f} nm; {subtitle}"
    with drawing(path, 8.6, 1.55 * rows + 1.5, title, heading) as figure:
        grid = figure.subplots(rows, 2, sharex=True, sharey=True, squeeze=False)
        for i in range(rows):
            for axes, values in zip(grid[i], (data.tangential_um[i], data.sagittal_um[i]), strict=True):
                for k, nm in enumerate(data.wavelength_nm):
                    axes.plot(data.pupil, values[k], color=_wavelength_colour(nm), lw=1.3, label=f"{nm:.0f} nm")
                axes.axhline(0, color=FAINT, lw=0.6)
                axes.axvline(0, color=FAINT, lw=0.6)
                axes.set(xlim=(-1, 1), ylim=(-reach, reach))
            grid[i, 0].set_ylabel(f"{_field_name(float(data.field_deg[i]))}\naberration (µm)", size=8.5)
        for axes, name in zip(grid[0], ("tangential", "sagittal"), strict=True):
            axes.set_title(name)
        for axes in grid[-1]:
            axes.set_xlabel("height in the stop / its radius")
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))


def plot_psf(data: Psf, path: str | Path, title: str, subtitle: str) -> None:
    """Plot point spread: geometric above, diffraction below; the square root of the values shows faint light."""
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
                    brightness = np.sqrt(np.maximum(image, 0))
                    axes.imshow(brightness, origin="lower", extent=(-half, half, -half, half), cmap="magma", vmin=0)
                else:
                    why = "aberrations far larger\nthan diffraction" if data.pupil_points[i] else "almost no light"
                    axes.text(0, 0, why, ha="center", va="center", fontsize=8)
            grid[0, i].set_title(_field_name(float(data.field_deg[i])))
            if np.isfinite(data.strehl[i]):
                grid[1, i].set_title(f"Strehl ratio {data.strehl[i]:.3f}", fontsize=9)
            grid[1, i].set_xlabel("sagittal (µm)", size=8.5)
        grid[0, 0].set_ylabel(f"geometric ({_wavelengths(data.wavelength_nm)})\ntangential (µm)", size=8.5)
        grid[1, 0].set_ylabel(f"diffraction ({data.wavelength_nm[0]:.0f} nm)\ntangential (µm)", size=8.5)


def plot_point_spread(arrays: Any, pixel_um: float, path: str | Path, title: str, channels: Any) -> None:
    """Plot the point spread functions over the picture, of the first f-number and distance in a file of `psf`.

    Three channels are drawn as red, green and blue, the longest wavelengths first; other numbers of channels are grey.
    All spots have the same scale in length. Each is as bright as its own maximum allows, and the square root is drawn.
    """
    whole = arrays["psf"][0, 0]
    order = sorted(range(whole.shape[2]), key=lambda c: -np.mean(list(channels.values())[c]))
    colours = whole[:, :, order] if len(order) == 3 else whole.sum(2, keepdims=True).repeat(3, 2)
    rows, columns, _, side, _ = colours.shape
    away = np.abs(np.arange(side) - side // 2)
    ring = np.maximum(away[:, None], away)
    total = whole.sum((0, 1, 2))
    inner = next(k for k in range(side // 2 + 1) if total[ring <= k].sum() >= 0.98 * total.sum())
    part = slice(side // 2 - inner, side // 2 + inner + 1)
    distance, number = float(arrays["distance_m"][0]), float(arrays["f_number"][0])
    focus = "infinity" if math.isinf(distance) else f"{distance:g} m"
    text = f"Point spread over the picture, f/{number:g}, object at {focus}; brightness as square root"
    each_in = max(1.0, 4.8 / columns)
    with drawing(path, each_in * columns + 0.4, each_in * rows + 1.0, title, text) as figure:
        grid = figure.subplots(rows, columns, squeeze=False)
        for i, j in np.ndindex(rows, columns):
            image = colours[i, j][:, part, part].transpose(1, 2, 0)
            grid[i, j].imshow(np.sqrt(image / max(float(image.max()), 1e-30)), interpolation="nearest")
            grid[i, j].set(xticks=[], yticks=[])
        width_um = (2 * inner + 1) * pixel_um
        bar = next(n * 10.0**k for k in range(3, -4, -1) for n in (5, 2, 1) if n * 10.0**k <= 0.6 * width_um)
        corner = grid[-1, 0]
        corner.plot([0.2 * inner, 0.2 * inner + bar / pixel_um], [1.75 * inner] * 2, color="white", lw=2)
        corner.text(0.2 * inner, 1.65 * inner, f"{bar:g} µm", color="white", fontsize=7, va="bottom")
