"""A Zemax file while it is read, and the draft of a lens that it becomes at its end."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

from neurolens.optics.prescription import Surface
from neurolens.readers.draft import Draft, Row
from neurolens.readers.source import Line, warn
from neurolens.readers.zemax_shapes import Block, shape_of
from neurolens.readers.zemax_states import Zoom, draft_states


@dataclass
class File:
    """A file while it is read."""

    path: str
    blocks: list[Block] = field(default_factory=list)
    zoom: Zoom = field(default_factory=Zoom)
    name: str = ""
    notes: list[str] = field(default_factory=list)
    unit: str | None = None
    pupil: float | None = None
    f_number: float | None = None
    makers: list[str] = field(default_factory=list)
    working: Line | None = None  # where the f-number is said to be the working one
    field_type: int = 0
    fields: int = 0
    heights: dict[str, list[float]] = field(default_factory=dict)
    ignored: Counter[str] = field(default_factory=Counter)
    oddities: list[str] = field(default_factory=list)


def draft_of(file: File) -> Draft:
    """The draft of a file that has been read to its end.

    Raises:
        InputError: a file that was cut off, a shape that the lens model cannot hold, the working f-number of a near
            object.
    """
    *_, image = file.blocks
    for before, block in zip(file.blocks, file.blocks[1:], strict=False):
        if block.kind == "COORDBRK" and block.glass is None:
            block.medium = before.medium  # it stands in the medium of the surface before it
    rows = tuple(Row(_surface_of(b), b.aperture) for b in file.blocks[1:-1])
    for block in file.blocks:
        if math.isnan(block.thickness):
            raise block.start.error("DISZ", "(missing)", "the thickness behind every surface (is the file cut off?)")
    if image.thickness or image.medium or image.stop:
        raise image.start.error("SURF", "(the last in the file)", "an image surface (is the file cut off?)")
    if image.curvature:
        file.oddities.append("the image surface is curved; the film is taken as plane")
    if file.f_number is not None and file.working and math.isfinite(file.blocks[0].thickness):
        raise file.working.error("FNUM", "(the working f-number of a near object)", "ENPD, FLOA, or FNUM with flag 0")
    for text in (*file.oddities, *(f"{text} ({count})" for text, count in file.ignored.items() if count)):
        warn(file.path, text)
    last = file.blocks[-2]
    return Draft(
        file=file.path,
        kind="Zemax",
        rows=rows,
        name=file.name,
        notes="\n".join(file.notes).strip(),
        states=tuple(draft_states(file.zoom, file.blocks, file.f_number is not None)),
        pupil=file.pupil,
        f_number=file.f_number,
        object_distance=file.blocks[0].thickness,
        film_given=not (last.solve and last.solve[0] == "MAZH" and last.thickness == 0),
        unit=file.unit,
        rims="estimated" if any(b.automatic and not b.stop for b in file.blocks[1:-1]) else "source",
        **dict(_field(file)),
    )


def _surface_of(block: Block) -> Surface:
    return Surface(
        thickness_mm=block.thickness,
        diameter_mm=2 * (block.semi_diameter if block.clear is None else block.clear),
        stop=block.stop,
        **shape_of(block),
        **block.medium,
    )


def _field(file: File) -> Iterator[tuple[str, float]]:
    """Half field or image radius: the field point farthest from the axis. FTYP 0 angle, 2 and 3 image height."""
    points = [(x, y) for x, y in zip(*(file.heights.get(k, [0.0] * 100) for k in ("XFLN", "YFLN")), strict=False)]
    edge = max((math.hypot(x, y) for x, y in points[: file.fields or None]), default=0.0)
    if edge > 0 and file.field_type == 0:
        yield "half_field_deg", edge
    elif edge > 0 and file.field_type in (2, 3):
        yield "image_radius", edge
    elif edge > 0:
        warn(file.path, f"the field is given as type {file.field_type} (not an angle, not an image height): left out")
