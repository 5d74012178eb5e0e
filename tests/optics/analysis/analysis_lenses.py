"""Lenses whose behaviour is known in closed form, and the library's for everything else."""

import math
from dataclasses import replace
from typing import Any

import torch
from shipped import tabled

from neurolens.optics.analysis.bundles import Pattern
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.lens.figures import Figure
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.setting.states import set_lens

INF = math.inf


def library(name: str, **state: Any) -> Scene:
    """A lens of the library in a state, looking at what it is focused on."""
    return Scene(set_lens(tabled(name), **state), state.get("focus_m", INF))


def scene(rows: list[Surface], half_field_deg: float = 10.0, focus_m: float = INF) -> Scene:
    """Surfaces as a scene in focus."""
    return Scene(set_lens(Lens("test", "", tuple(rows), 4.0, half_field_deg=half_field_deg), focus_m=focus_m), focus_m)


def thin(bending: float, stop_mm: float = 5.0, n: float = 1.5, gap_mm: float = 0.0, v: float | None = 60.0) -> Scene:
    """A thin lens of f = 100 mm and shape factor (c1 + c2) / (c1 - c2), its stop `gap_mm` behind it."""
    total = 1 / (100 * (n - 1))
    c1, c2 = total * (bending + 1) / 2, total * (bending - 1) / 2
    radii = [1 / c if c else INF for c in (c1, c2)]
    rows = [Surface(radii[0], 0.0, 60, n, v), Surface(radii[1], gap_mm, 60), Surface(INF, 80, 2 * stop_mm, stop=True)]
    return scene(rows)


def cartesian(stop_mm: float = 10.0, n: float = 1.5, f: float = 100.0) -> Scene:
    """Plano-hyperbolic lens, K = -n^2: collimated light comes to a perfect focus (Descartes 1637)."""
    rows = [
        Surface(INF, 0.0, 2 * stop_mm, stop=True),
        Surface(INF, 12.0, 3 * stop_mm, n),
        Surface(-f * (n - 1), f, 3 * stop_mm, figure=Figure(conic=-n * n)),
    ]
    return scene(rows, half_field_deg=2.0)


def slower(given: Scene, share: float) -> Scene:
    """The same scene with a smaller stop."""
    return replace(given, lens=given.lens.with_stop_radius(share * given.lens.stop_radius_mm))


def grid(n: int) -> Pattern:
    """Centres of the cells of an n by n square over the stop that lie inside it, all of one weight."""
    line = (torch.arange(n, dtype=torch.float64) + 0.5) * (2 / n) - 1
    t, s = (v.reshape(-1) for v in torch.meshgrid(line, line, indexing="ij"))
    inside = t * t + s * s < 1
    return Pattern(t[inside], s[inside], torch.full_like(t[inside], 1 / int(inside.sum())))
