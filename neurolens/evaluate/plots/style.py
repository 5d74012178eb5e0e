"""The look of the report's plots (`analysis.plot_style`), colours by family of models, and labels that keep clear."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from neurolens.analysis.plot_style import FAINT, FIELD_COLOURS, INK, new_figure, plain_log_ticks, save, style

__all__ = [
    "FAINT",
    "FAMILY_COLOURS",
    "FAMILY_NAMES",
    "FIELD_COLOURS",
    "INK",
    "OTHER_COLOUR",
    "family_colour",
    "new_figure",
    "place_labels",
    "plain_log_ticks",
    "save",
    "style",
]

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


def family_colour(family: str | None) -> str:
    return FAMILY_COLOURS.get(str(family), OTHER_COLOUR)


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
