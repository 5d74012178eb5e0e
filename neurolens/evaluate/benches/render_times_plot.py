"""Seconds of a render over the refractions of its lens, a panel a scene."""

from __future__ import annotations

from pathlib import Path

from neurolens.evaluate.benches.render_times import EXACT_C, FUSED_MODELS, GRAPHS, PINHOLE, SCENES, THIN, TORCH
from neurolens.evaluate.benches.render_times_page import Found
from neurolens.evaluate.plots.style import INK, new_figure, save, style

# Okabe and Ito's colours; what runs compiled is filled.
_LOOK = {
    TORCH: (INK, "s", "white"),
    EXACT_C: (INK, "s", INK),
    GRAPHS[0]: ("#0072b2", "o", "white"),
    FUSED_MODELS[0]: ("#0072b2", "o", "#0072b2"),
    GRAPHS[1]: ("#d55e00", "^", "white"),
    FUSED_MODELS[1]: ("#d55e00", "^", "#d55e00"),
}
_LINES = {THIN: ("#009e73", "--"), PINHOLE: ("#7f7f7f", ":")}


def draw(found: Found, path: Path) -> None:
    """Draw one panel for every scene that was rendered; nothing where none was."""
    scenes = [s for s in SCENES if found.ideal(PINHOLE, s)]
    if not scenes:
        return
    with style():
        figure = new_figure(4.4 * len(scenes) + 2.6, 4.6)
        for axes, scene in zip(figure.subplots(1, len(scenes), squeeze=False)[0], scenes, strict=True):
            for kind, (colour, marker, fill) in _LOOK.items():
                points = [
                    (s.refractions, min(r.seconds))
                    for s in found.subjects
                    if s.kind == kind and (r := found.row(s, scene)) is not None
                ]
                if points:
                    look = {"color": colour, "mfc": fill, "mec": colour, "ms": 5, "lw": 1.1}
                    axes.plot(*zip(*points, strict=True), marker=marker, label=kind, **look)
            for kind, (colour, dash) in _LINES.items():
                row = found.ideal(kind, scene)
                if row is not None:
                    axes.axhline(min(row.seconds), color=colour, ls=dash, lw=1.2, label=kind)
            axes.set(
                xlabel="refractions of the lens", ylabel="seconds a render", title=scene, xlim=(0, None), ylim=(0, None)
            )
            axes.grid(True)
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.suptitle("Render time over refractions", x=0.01, ha="left", fontweight="bold")
        figure.legend(handles, labels, loc="outside right upper")
        save(figure, path)
