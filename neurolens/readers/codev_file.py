"""A CODE V file while it is read, and the draft of a lens that it becomes at its end."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from neurolens.base.errors import InputError
from neurolens.optics.prescription import Surface
from neurolens.readers.assemble import UNKNOWN
from neurolens.readers.codev_shapes import Block, shape_of
from neurolens.readers.codev_zoom import Zoom
from neurolens.readers.draft import Draft, Row
from neurolens.readers.source import warn


@dataclass
class File:
    """A file while it is read."""

    path: str
    blocks: list[Block] = field(default_factory=list)
    closed: bool = False  # whether the image has come
    zoom: Zoom = field(default_factory=Zoom)
    radii: bool | None = None
    title: str = ""
    unit: str | None = None
    pupil: float | None = None
    f_number: float | None = None
    fields: dict[str, list[float]] = field(default_factory=dict)
    private: dict[str, dict[str, Any]] = field(default_factory=dict)
    private_nm: list[float] | None = None
    ignored: Counter[str] = field(default_factory=Counter)


def draft_of(file: File) -> Draft:
    """The draft of a file that has been read to its end.

    Raises:
        InputError: no surface, a solve or a shape that the lens model cannot hold.
    """
    first, *middle, image = file.blocks
    if not middle:
        raise InputError(file.path, "S", "(no surface)", "at least one surface between object and image")
    if image.curvature:
        warn(file.path, "the image surface is curved; the film is taken as plane")
    for text, count in file.ignored.items():
        if count:
            warn(file.path, f"{text} ({count})")
    # The image lies off the last thickness by the thickness of SI: a defocus.
    middle[-1].thickness += image.thickness
    rows = []
    for k, block in enumerate(middle):
        diameter = UNKNOWN if math.isnan(block.semi_diameter) else 2 * block.semi_diameter
        if block.solved and block is not middle[-1]:
            raise block.start.error("PIM", f"(on surface {k + 1})", "the last surface")
        surface = Surface(
            thickness_mm=block.thickness,
            diameter_mm=diameter,
            stop=block.stop,
            **shape_of(block),
            **block.medium,
        )
        rows.append(Row(surface, aperture=not math.isnan(diameter)))
    angles, heights = (_edge(file, pairs) for pairs in ((("XAN", "YAN"),), (("XIM", "YIM"), ("XRI", "YRI"))))
    if _edge(file, (("XOB", "YOB"),)) and not angles:
        warn(file.path, "the field is given as an object height: left out")
    return Draft(
        file=file.path,
        kind="CODE V",
        rows=tuple(rows),
        name=file.title,
        states=tuple(file.zoom.states(middle, first.thickness, image.thickness)),
        pupil=file.pupil,
        f_number=file.f_number,
        object_distance=first.thickness,
        film_given=not (middle[-1].solved and middle[-1].thickness == image.thickness),
        unit=file.unit,
        half_field_deg=angles,
        image_radius=heights,
    )


def _edge(file: File, pairs: tuple[tuple[str, str], ...]) -> float | None:
    """The field point farthest from the axis; None where the file has none of that kind."""
    far = 0.0
    for x, y in pairs:
        across, up = file.fields.get(x, []), file.fields.get(y, [])
        longest = max(len(across), len(up))
        across, up = across + [0.0] * (longest - len(across)), up + [0.0] * (longest - len(up))
        far = max([far, *(math.hypot(a, b) for a, b in zip(across, up, strict=True))])
    return far or None
