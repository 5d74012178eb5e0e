"""Render time by the shape of the stop: what Willi's Table 6.3 asks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from neurolens.base.errors import InputError
from neurolens.cameras.build import FUSED, make_camera
from neurolens.evaluate.benches.render_times import LENSES, Size, one_render, shot
from neurolens.optics.apertures import Aperture
from neurolens.render.scene import Scene


@dataclass
class Shape:
    """A shape of the biconvex lens's stop: area over that of the round one, rays that pass, seconds of every round."""

    name: str
    aperture: Aperture | None
    area: float
    passed: float = 0.0
    seconds: list[float] = field(default_factory=list)


def shapes() -> list[Shape]:
    """The round stop, 5 and 50 straight edges, a star and a heart, with their areas over the circle's."""
    found = [Shape("round", None, 1.0)]
    for n in (5, 50):
        found.append(Shape(f"{n} edges", Aperture(blades=n), n / 2 * np.sin(2 * np.pi / n) / np.pi))
    side = (np.arange(1024) + 0.5) / 512 - 1
    x, y = np.meshgrid(side, -side)
    # A star of five points whose inner corners lie at 0.48 of the radius; a heart, (x^2 + y^2 - 1)^3 <= x^2 y^3.
    part = np.mod(np.arctan2(x, y) + np.pi / 5, 2 * np.pi / 5) - np.pi / 5
    across, along = np.hypot(x, y) * np.abs(np.sin(part)), np.hypot(x, y) * np.cos(part)
    inner = 0.48 * np.array([np.sin(np.pi / 5), np.cos(np.pi / 5)])
    star = along <= 1 - across * (1 - inner[1]) / inner[0]
    u, v = 1.5 * x, 1.5 * y + 0.1
    heart = (u * u + v * v - 1) ** 3 <= u * u * v**3
    disc = x * x + y * y <= 1
    for name, mask in (("star", star), ("heart", heart)):
        found.append(Shape(name, Aperture(mask=mask & disc), float((mask & disc).sum() / disc.sum())))
    return found


def time_shapes(root: Path, scene: Scene, size: Size, report: Callable[[float], None]) -> list[Shape]:
    """The biconvex lens, compiled, with every shape of its stop."""
    _, _, stem, efl = LENSES[0]
    spec = f"{FUSED}{root / 'lenses' / f'{stem}.toml'}"
    found = shapes()
    try:
        cameras = [make_camera(spec, shot(efl, spec, shape.aperture)) for shape in found]
    except InputError:
        return []
    for k in range(size.rounds):
        for shape, camera in zip(found, cameras, strict=True):
            stats = one_render(scene, camera, size)
            shape.seconds.append(stats["seconds"])
            shape.passed = stats["passed_fraction"]
        report((k + 1) / size.rounds)
    return found
