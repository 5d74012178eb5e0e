"""The trade of one lens's surrogates in two panels: error against time, and against coefficients."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neurolens.evaluate.benches.surrogate_methods import GROUPS
from neurolens.evaluate.plots.style import INK, new_figure, place_labels, plain_log_ticks, save, style
from neurolens.evaluate.records import number, pareto_front

Record = Mapping[str, Any]
_LOOK = {  # Okabe and Ito's colours; shapes tell the groups apart without them
    "paraxial": ("#7f7f7f", "D"),
    "published": ("#e69f00", "s"),
    "ours": ("#0072b2", "o"),
    "ablations": ("#cc79a7", "^"),
}
_ERRORS = {
    "rms_um_at_21_6": "film-equivalent error, RMS (µm at 21.6 mm image radius)",
    "direction_rms_deg": "direction error, RMS (degrees)",
}


def trade_plot(name: str, records: Sequence[Record], exact: Sequence[Record], path: Path) -> bool:
    """Draw both panels, logarithmic; hollow markers are fused C. Returns whether there was anything to draw.

    Exact tracers, which have no error, are lines at their time. The staircase is the front that nothing betters.
    """
    error = next((k for k in _ERRORS if any((number(r, k) or 0) > 0 for r in records)), None)
    if error is None:
        return False
    shown = [r for r in records if (number(r, error) or 0) > 0]
    with style():
        figure = new_figure(13.0, 5.8)
        left, right = figure.subplots(1, 2, sharey=True)
        times = [*_points(shown, "ns_per_ray.min", error), *_points(shown, "fused_ns_per_ray.min", error)]
        _panel(left, times, "time per ray (ns, one thread, best of the rounds)")
        for one in exact:
            time = number(one, "ns_per_ray.min")
            if time:
                look = {"color": INK, "lw": 1.0, "ls": "--" if "compiled" in one["name"] else ":"}
                left.axvline(time, label=f"{one['name']} {time:.3g} ns", **look)
        sizes = _points(shown, "coefficients_per_vector", error)
        sizes += [p for p in _points(shown, "parameters", error) if number(p[2], "coefficients_per_vector") is None]
        _panel(right, sizes, "coefficients of one vector output (networks: all weights)")
        left.set_ylabel(_ERRORS[error])
        plain_log_ticks(left.yaxis)
        for axes in (left, right):
            plain_log_ticks(axes.xaxis)
            axes.grid(True, which="major")
        figure.suptitle(f"{name}: what an error costs", x=0.01, ha="left", fontweight="bold")
        handles = {
            label: h for axes in (left, right) for h, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        figure.legend(handles.values(), handles.keys(), loc="outside right upper")
        for axes, points in ((left, times), (right, sizes)):
            if points:
                labels = [str(p[2]["method"]) for p in points]
                place_labels(axes, [p[:2] for p in points], labels, fontsize=6.4, color="#333333")
        save(figure, path)
    return True


def _points(records: Sequence[Record], key: str, error: str) -> list[tuple[float, float, Record, bool]]:
    fused = key.startswith("fused")
    return [(x, number(r, error) or 0.0, r, fused) for r in records if (x := number(r, key) or 0.0) > 0]


def _panel(axes: Any, points: Sequence[tuple[float, float, Record, bool]], label: str) -> None:
    axes.set(xscale="log", yscale="log", xlabel=label)
    for group, (colour, marker) in _LOOK.items():
        for fused in (False, True):
            part = [p[:2] for p in points if p[2]["group"] == group and p[3] == fused]
            if part:
                look = {"mfc": "white" if fused else colour, "mec": colour, "ms": 6.5, "mew": 1.4, "ls": "none"}
                said = GROUPS[group] + (", fused C" if fused else "")
                axes.plot(*zip(*part, strict=True), marker, label=said, zorder=3, **look)
    if points:
        front = [points[i][:2] for i in pareto_front([p[:2] for p in points])]
        axes.step(*zip(*front, strict=True), where="post", color=INK, lw=1.2, alpha=0.7, label="Pareto front")
