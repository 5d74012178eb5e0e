"""A plate as a lens would have photographed it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from neurolens.base.errors import InputError, warn
from neurolens.base.progress import Progress
from neurolens.cameras.contract import Camera
from neurolens.cameras.field import WIDEST_DEG
from neurolens.defocus.gather import Gathered, gather, spread_over
from neurolens.defocus.highlights import spread_highlights, take_highlights
from neurolens.defocus.read import Plate

_SAID = 0.002  # share of the light that was made up, from which it is said
_EDGE = 9  # points of each side of the film that are tried


def defocus(
    plate: Plate, camera: Camera, samples: int = 64, threads: int = 1, highlights: bool = True,
    progress: Progress | None = None,
) -> Gathered:  # fmt: skip
    """The picture that a camera takes of a plate.

    Args:
        samples: of a pixel, at most, 8 to 512; rounded up to a power of two.
        highlights: spread pixels that are far brighter than their surroundings as discs, without noise.

    Warns:
        NeurolensWarning: light that the plate does not have.

    Raises:
        InputError: a camera that sees 85 degrees from its axis or more; no C compiler.
    """
    progress = progress or Progress(quiet=True)
    check_field(camera)
    layers, pinhole, size = plate.layers, plate.pinhole, plate.size
    spread = spread_over(camera, pinhole, size)
    taken = [take_highlights(v, pinhole, spread, size, layers[:k]) for k, v in enumerate(layers) if highlights]
    with progress.stage(f"blur by {camera.name}") as report:
        found = gather(layers, pinhole, camera, size, spread, 1 << (samples - 1).bit_length(), threads, report)
    for some in taken:
        if len(some.radius_px):
            with progress.stage(f"spread {len(some.radius_px)} highlights") as report:
                spread_highlights(found.rgb, some, layers, pinhole, camera, report)
    _say(found, len(layers))
    return replace(found, highlights=sum(len(some.radius_px) for some in taken))


def _say(found: Gathered, layers: int) -> None:
    if found.filled > _SAID:
        more = "" if layers > 1 else "; layers behind (--behind, or a deep file) have it"
        warn(f"{100 * found.filled:.1f}% of the light comes from behind edges, which the plate does not show: what is "
             f"beside them was put there{more}")  # fmt: skip
    if found.beyond > _SAID:
        warn(f"{100 * found.beyond:.1f}% of the light comes from beyond the plate's borders, whose pixels were "
             "repeated: render it with overscan")  # fmt: skip


def check_field(camera: Camera) -> None:
    """Refuse (InputError) a camera that a plate, which is a plane, cannot serve."""
    width, height = camera.film_mm
    side = np.linspace(-0.5, 0.5, _EDGE)
    film = np.stack(np.meshgrid(side * width, side * height), 0).reshape(2, -1).astype(np.float32)
    low, high = camera.wavelength_nm or (400.0, 700.0)
    nm = np.full(film.shape[1], min(max(550.0, low), high), np.float32)
    rays = camera.sample(film, np.full(film.shape, 0.5, np.float32), nm)
    passed = rays.status == 0
    if not passed.any():
        raise InputError(camera.name, "film", f"({width:g} x {height:g} mm)", "a film on which light arrives")
    widest = math.degrees(math.acos(float(np.clip((-rays.direction[2][passed]).min(), -1, 1))))
    if widest > WIDEST_DEG:
        expected = f"at most {WIDEST_DEG:g}: a plate is a plane, on which no wider field has room"
        raise InputError(camera.name, "half field, degrees", round(widest, 1), expected)
