"""What all plots share: one look, one palette, no global matplotlib state, files whole or not there."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from neurolens.errors import NeurolensError
from neurolens.files import atomic_path

# Okabe and Ito's colours, told apart by colour-blind readers too; black is kept for the exact tracer.
FAMILY_COLOURS = {
    "paraxial": "#7f7f7f",
    "dense": "#56b4e9",
    "omp": "#e69f00",
    "ols": "#0072b2",
    "adaptive": "#009e73",
    "mlp": "#d55e00",
}
FAMILY_NAMES = {
    "paraxial": "paraxial",
    "dense": "dense",
    "omp": "OMP",
    "ols": "orthogonal LS",
    "adaptive": "adaptive",
    "mlp": "MLP",
}
OTHER_COLOUR = "#cc79a7"
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
    "text.parse_math": False,  # a name with dollar signs stays a name
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
    """Write the figure (PNG, PDF or SVG, by the suffix) whole or not at all."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, facecolor="white")
    return Path(path)


def family_colour(family: str | None) -> str:
    return FAMILY_COLOURS.get(str(family), OTHER_COLOUR)


def plain_log_ticks(axis: Any) -> None:
    """Log axis labelled 0.1, 1, 10 rather than by powers, and with 2 and 5 between where that leaves few ticks."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = sorted(axis.get_view_interval())
    subs = (1.0,) if high / max(low, 1e-300) > 400 else (1.0, 2.0, 5.0)
    axis.set_major_locator(LogLocator(base=10, subs=subs, numticks=15))
    axis.set_minor_locator(LogLocator(base=10, subs=tuple(range(2, 10)), numticks=60))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.6g}" if value < 1e4 else f"{value:.0e}"))
    axis.set_minor_formatter(NullFormatter())


def place_labels(axes: Any, points: Sequence[tuple[float, float]], labels: Sequence[str], **text: Any) -> None:
    """Write each label beside its point where it covers the fewest other points and labels.

    Greedy: each label takes the best of twelve places round its marker, in pixels, after the labels before it.
    """
    axes.figure.canvas.draw()  # the transform and text extents are known only after a layout pass
    renderer = axes.figure.canvas.get_renderer()
    pixels = [tuple(axes.transData.transform(point)) for point in points]
    frame = axes.get_window_extent(renderer)
    taken: list[tuple[float, float, float, float]] = []
    for (x, y), point, label in zip(pixels, points, labels, strict=True):
        note = axes.annotate(label, point, textcoords="offset pixels", xytext=(0, 0), **text)
        box = note.get_window_extent(renderer)
        best = min(
            _places(box.width, box.height),
            key=lambda d: _cost((x + d[0], y + d[1], box.width, box.height), pixels, taken, frame) + 0.002 * abs(d[1]),
        )
        note.set_position(best)
        note.set(ha="left", va="bottom")
        taken.append((x + best[0], y + best[1], box.width, box.height))


def _places(width: float, height: float) -> list[tuple[float, float]]:
    """Offsets in pixels from a point to the lower left corner of its label, nearest first."""
    places = []
    for gap in (9.0, 20.0):
        rows = (-height / 2, gap / 2, -height - gap / 2)
        places += [(gap, row) for row in rows] + [(-width - gap, row) for row in rows]
        places += [(-width / 2, gap), (-width / 2, -height - gap)]
    return places


def _cost(box: tuple[float, float, float, float], points: Sequence[Any], taken: Sequence[Any], frame: Any) -> float:
    """How bad a label's place is: markers it covers, label area it overlaps, and leaving the axes worst of all."""
    x, y, w, h = box
    cost = sum(2.0 for px, py in points if x - 6 < px < x + w + 6 and y - 6 < py < y + h + 6)
    for x2, y2, w2, h2 in taken:
        across, along = min(x + w, x2 + w2) - max(x, x2), min(y + h, y2 + h2) - max(y, y2)
        cost += 3.0 * max(0.0, across + 3) * max(0.0, along + 1) / (w * h)
    if x < frame.x0 or y < frame.y0 or x + w > frame.x1 or y + h > frame.y1:
        cost += 100.0
    return cost


def _matplotlib() -> Any:
    try:
        import matplotlib
    except ImportError as error:
        raise NeurolensError("plots need matplotlib: pip install '.[train]' in the project's folder") from error
    return matplotlib
