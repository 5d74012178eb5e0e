"""--frames and --key: focus, stop, zoom and place of the camera between keys, for commands that make many frames."""

import argparse
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

from neurolens.base.errors import InputError
from neurolens.base.files import read_rows
from neurolens.base.settings import FOCAL_MM, Option, group, said, setting, spelling, unit_of, within
from neurolens.base.tomlfile import reject_unknown
from neurolens.base.units import in_unit
from neurolens.cli.arguments import floats
from neurolens.optics.lens.shot import Shot
from neurolens.pictures.render.scenetables import FARTHEST_M

_MOST = 100_000
_PLACE_M = (-FARTHEST_M, FARTHEST_M)
_Keys = list[tuple[int, list[float]]]  # frames, and their values in the measure that is linear between keys


def _inverse(value: float) -> float:
    return 1 / value if value else math.inf


class _Quantity(NamedTuple):
    """A quantity that keys change.

    Attributes:
        setting: its name in a `Frame` or a `Shot`. unit: of its numbers. size: how many numbers it has.
        linear_in: the measure that is linear between keys. to, back: the functions that lead to it and back.
    """

    setting: str
    bounds: tuple[float, float]
    unit: str
    linear_in: str
    to: Callable[[float], float] = float
    back: Callable[[float], float] = float
    size: int = 1


_LOGARITHM = "the logarithm of mm", math.log, math.exp
_MEASURES: dict[str, tuple[Any, ...]] = {
    "focus_m": ("1/m", _inverse, _inverse),
    "f_number": ("stops", math.log, math.exp),
    "focal_length_mm": _LOGARITHM,
    "zoom": _LOGARITHM,
}


def _of_shot() -> Iterator[tuple[str, _Quantity]]:
    """Yield the numbers of a `Shot` by the names of their options; most are linear in themselves."""
    for f in fields(Shot):
        option: Option | None = f.metadata.get("option")
        if option and (bounds := FOCAL_MM if f.name == "zoom" else option.within):
            unit = "mm" if f.name == "zoom" else unit_of(f.name)
            yield spelling(f, option)[2:], _Quantity(f.name, bounds, unit, *_MEASURES.get(f.name, (unit,)))


_QUANTITIES = dict(_of_shot()) | {
    "position": _Quantity("position_m", _PLACE_M, "m", "m", size=3),
    "look-at": _Quantity("look_at_m", _PLACE_M, "m", "m", size=3),
}
ALL_KEYS, LENS_KEYS = tuple(_QUANTITIES), tuple(name for name, q in _QUANTITIES.items() if q.size == 1)


def _frames(text: str) -> range:
    """Read --frames; farms write FIRST-LAST."""
    words = re.split("[:-]", text)
    if 2 <= len(words) <= 3 and all(w.isascii() and w.isdecimal() and len(w) <= 7 for w in words):
        first, last, step = (*map(int, words), 1)[:3]
        if first <= last and step > 0 and (last - first) // step < _MOST:
            return range(first, last + 1, step)
    raise argparse.ArgumentTypeError(f"got {text!r}, expected FIRST:LAST or FIRST:LAST:STEP, at most {_MOST} frames")


@dataclass(frozen=True, kw_only=True)
class Frames:
    """The numbers of frames, and the keys of their settings."""

    frames: range | None = setting(None, "{}", kind=_frames, metavar="FIRST:LAST[:STEP]")
    key: tuple[str, ...] = setting(
        (), "values at frames, repeatable, of {}. Before the first key and after the last one they stay. Or a file of "
        "keys, .csv with a header or .json (a list of objects): a column frame, and one for each NAME; an empty cell "
        "is no key", metavar="NAME=FRAME:VALUE,...",
    )  # fmt: skip

    def states(
        self, fixed: Mapping[str, Any], command: str, names: Sequence[str] = ALL_KEYS
    ) -> list[tuple[int | None, str, dict[str, Any]]]:
        """The frames as `frames_of` yields them; without --frames a single one with no number, digits or settings."""
        if self.frames is not None:
            return list(frames_of(self.frames, self.key, fixed, command, names))
        if self.key:
            raise InputError(command, "--key", self.key[0], "--frames beside it")
        return [(None, "", {})]


def frames_group(does: str, names: Sequence[str] = ALL_KEYS) -> Any:
    """Return a field of `Frames`; `does` is the help of --frames, `names` are the quantities that keys may set."""
    other = (f"{name} in {q.linear_in}" for name, q in _QUANTITIES.items() if name in names and q.linear_in != q.unit)
    measures = f"{', '.join(names)}. Between keys they move evenly in their unit, but {', '.join(other)}" + (
        "; position and look-at are X/Y/Z in m" * ("position" in names)
    )
    return group("frames", texts={"frames": does, "key": measures})


def frames_of(
    frames: range, keys: Sequence[str], fixed: Mapping[str, Any], command: str, names: Sequence[str] = ALL_KEYS
) -> Iterator[tuple[int | None, str, dict[str, Any]]]:
    """Yield the frames of --frames: number, its digits in file names, and the settings that the keys have there.

    Args:
        fixed: the settings of the command line; a key may set only one that is None.

    Raises:
        InputError: a text that is no key, or a key of a quantity that the command line sets too.
    """
    given = [track for text in keys for track in _tracks(text, command, names)]
    tracks = dict(given)
    if len(tracks) < len(given):
        raise InputError(command, "--key", keys, "each quantity once")
    for name in tracks:
        if (value := fixed.get(_QUANTITIES[name].setting)) is not None:
            raise InputError(command, f"--{name}", value, f"left out: --key {name} sets it")
    digits = max(4, len(str(frames[-1])))
    for frame in frames:
        values = {_QUANTITIES[name].setting: _at(name, track, frame) for name, track in tracks.items()}
        yield frame, f"{frame:0{digits}d}", values


def numbered(file: Path, digits: str) -> Path:
    """Return the file of a frame: OUT.0001.exr for OUT.exr."""
    return file.with_name(f"{file.stem}.{digits}{file.suffix}") if digits else file


def _tracks(text: str, command: str, names: Sequence[str]) -> Iterator[tuple[str, _Keys]]:
    """Yield the quantities of one --key, or of the file of keys that it names."""
    path = Path(text)
    if path.suffix.lower() not in (".csv", ".json") or "=" in path.name:
        name, _, rest = text.partition("=")
        if name not in names:
            raise InputError(command, "--key", text, f"NAME=FRAME:VALUE,... with NAME of {', '.join(names)}")
        keys: _Keys = []
        for word in rest.split(","):
            frame, _, value = word.partition(":")
            _append(keys, name, frame, value, (command, f"--key {name}"))
        yield name, keys
        return
    rows = read_rows(path, "a list of keys")
    for number, row in enumerate(rows):
        reject_unknown(path, f"row {number + 1}, ", row, ["frame", *names])
    if all(row.get(name) in (None, "") for row in rows for name in names):
        raise InputError(path, "keys", "(none)", f"a value of {', '.join(names)} at a frame")
    for name in names:
        keys = []
        for number, row in enumerate(rows):
            if (cell := row.get(name)) not in (None, ""):
                value = "/".join(map(str, cell)) if isinstance(cell, list) else str(cell)
                place = (path, f"row {number + 1}, {name}")
                _append(keys, name, str(row.get("frame")).strip(), value.strip(), place)
        if keys:
            yield name, keys


def _append(keys: _Keys, name: str, frame: str, value: str, place: tuple[str | Path, str]) -> None:
    """Append a key that two words give; `place` tells where they stand, for errors."""
    quantity = _QUANTITIES[name]
    parts = value.split("/") if quantity.size > 1 else [value]
    numbers = in_unit(quantity.unit, floats)(",".join(parts)) if len(value) < 100 else []
    good = [within(quantity.bounds, v) for v in numbers]
    later = frame.isascii() and frame.isdecimal() and len(frame) <= 7 and (not keys or int(frame) > keys[-1][0])
    if not later or len(numbers) != quantity.size or not all(good):
        form = f"{'X/Y/Z in m' if quantity.size > 1 else 'a number'} {said(quantity.bounds)}"
        raise InputError(*place, f"{frame}:{value}", f"FRAME:VALUE, frames increasing, VALUE {form}")
    keys.append((int(frame), [quantity.to(v) for v in numbers]))


def _at(name: str, keys: _Keys, frame: int) -> float | tuple[float, ...]:
    """Return the value of a quantity at a frame."""
    import numpy as np

    frames, measures = [k for k, _ in keys], np.transpose([m for _, m in keys])
    values = tuple(_QUANTITIES[name].back(float(np.interp(frame, frames, row))) for row in measures)
    return values if len(values) > 1 else values[0]
