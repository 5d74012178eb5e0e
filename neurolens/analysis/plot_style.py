"""Shared style of plots: palette, no global matplotlib state, atomic files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from neurolens.base.errors import NeurolensError
from neurolens.base.files import atomic_path

# Okabe and Ito's colours, distinguishable by colour-blind readers.
FIELD_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#56b4e9", "#7f7f7f")
INK, FAINT = "#1b1f24", "#8a929b"

_STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "axes.titlesize": 11,
    "axes.labelsize": 10.5,
    "axes.edgecolor": "#4a5058",
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": "#e3e6ea",
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "legend.fontsize": 8.8,
    "text.color": INK,
    "xtick.color": "#33383f",
    "ytick.color": "#33383f",
    "figure.dpi": 150,
    "savefig.dpi": 150,
    "text.parse_math": False,  # no mathtext in names with dollar signs
}


def style() -> Any:
    """Context in which a figure is built and written: the user's own settings are neither used nor changed."""
    return _matplotlib().rc_context(_STYLE)


def new_figure(width_in: float, height_in: float) -> Any:
    """A matplotlib Figure on an Agg canvas: no pyplot, no window, nothing left open."""
    _matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Any, path: str | Path) -> Path:
    """Write the figure (PNG, PDF or SVG, by the suffix) atomically."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, facecolor="white")
    return Path(path)


def heading(figure: Any, title: str, subtitle: str) -> None:
    """Title of a figure with a lighter line below it, both to the left; they keep their room."""
    below = "\n\n" + "\n" * subtitle.count("\n") if subtitle else ""
    figure.suptitle(title + below, x=0.01, ha="left", fontsize=12, fontweight="bold")
    figure.text(0.01, 1 - 0.36 / figure.get_figheight(), subtitle, ha="left", va="top", fontsize=9, color="#555b63")


@contextmanager
def drawing(path: str | Path, width_in: float, height_in: float, title: str = "", subtitle: str = "") -> Iterator[Any]:
    """A figure in the common style, with a heading if there is a title; written to `path` at the end of the block."""
    with style():
        figure = new_figure(width_in, height_in)
        if title:
            heading(figure, title, subtitle)
        yield figure
        save(figure, path)


def wavelength_colour(wavelength_nm: float) -> str:
    """A colour similar to that of the wavelength, legible on white."""
    limits = ((450, "#7b4fa3"), (505, "#0072b2"), (600, "#009e73"), (1e9, "#d55e00"))
    return next(colour for limit, colour in limits if wavelength_nm < limit)


def field_name(field_deg: float) -> str:
    return "axis" if field_deg == 0 else f"{field_deg:.1f}°"


def plain_log_ticks(*axes: Any) -> None:
    """Log axes labelled 0.1, 1, 10 rather than by powers, and with 2 and 5 between where that leaves few ticks."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis in axes:
        low, high = sorted(axis.get_view_interval())
        subs = (1.0,) if high / max(low, 1e-300) > 400 else (1.0, 2.0, 5.0)
        axis.set_major_locator(LogLocator(base=10, subs=subs, numticks=15))
        axis.set_minor_locator(LogLocator(base=10, subs=tuple(range(2, 10)), numticks=60))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.6g}" if value < 1e4 else f"{value:.0e}"))
        axis.set_minor_formatter(NullFormatter())


def _matplotlib() -> Any:
    try:
        import matplotlib
    except ImportError as error:
        raise NeurolensError(
            "plots need matplotlib: pip install 'neurolens[train]', or '.[train]' in a checkout"
        ) from error
    return matplotlib
