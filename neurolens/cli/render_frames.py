"""`neurolens render --frames`: a picture a frame, focus, stop, zoom and place of the camera between keys."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens.base.bounds import F_NUMBER, FOCAL_MM, said, within
from neurolens.base.errors import InputError, warn
from neurolens.base.files import read_rows
from neurolens.base.tomlfile import reject_unknown
from neurolens.render.scenetables import FARTHEST_M

if TYPE_CHECKING:
    from neurolens.frames.frame import Frame

_COMMAND = "neurolens render"
_MOST = 100_000
_FOCUS_M, _PLACE_M = (1e-6, math.inf), (-FARTHEST_M, FARTHEST_M)


@dataclass(frozen=True)
class _Quantity:
    """What keys may change: where it goes, its components, their bounds, the measure that is linear between keys."""

    option: str
    size: int
    bounds: tuple[float, float]
    linear_in: str
    to: Callable[[float], float]
    back: Callable[[float], float]


def _inverse(value: float) -> float:
    return 1 / value if value else math.inf


def _itself(value: float) -> float:
    return value


_QUANTITIES = {
    "focus": _Quantity("focus_m", 1, _FOCUS_M, "1/m", _inverse, _inverse),
    "f-number": _Quantity("f_number", 1, F_NUMBER, "stops", math.log, math.exp),
    "zoom": _Quantity("zoom", 1, FOCAL_MM, "the logarithm of mm", math.log, math.exp),
    "position": _Quantity("position_m", 3, _PLACE_M, "m", _itself, _itself),
    "look-at": _Quantity("look_at_m", 3, _PLACE_M, "m", _itself, _itself),
}


LENS_KEYS = "focus", "f-number", "zoom"
_RENDERED = (
    "render these frames to OUT.0001.exr and so on; a frame that exists is kept (--restart: none is), an "
    "interrupted one goes on; the seed grows by the frame's number; --json prints an object a frame"
)


def add_frames(parser: argparse.ArgumentParser, does: str = _RENDERED, names: Sequence[str] = (*_QUANTITIES,)) -> None:
    """Add --frames and --key; `names` are the quantities of the keys."""
    group = parser.add_argument_group("frames")
    group.add_argument("--frames", metavar="FIRST:LAST[:STEP]", type=_frames, help=does)
    measures = ", ".join(f"{name} (linear in {_QUANTITIES[name].linear_in})" for name in names)
    points = "; position and look-at are X/Y/Z in m" if "position" in names else ""
    group.add_argument(
        "--key", metavar="NAME=FRAME:VALUE,...", action="append", default=[],
        help=f"values at frames, repeatable: {measures}{points}; before the first key and after the last one they "
        "stay. Or a file of keys, .csv with a header or .json (a list of objects): a column frame, and one for each "
        "NAME; an empty cell is no key",
    )  # fmt: skip


def frames_by_file(args: argparse.Namespace, frame: Frame) -> dict[Path, Frame]:
    """The frames of --frames by the files of their pictures; `frame` has the settings that no key sets.

    Raises:
        InputError: a key that is none, or of a quantity that the command line sets too.
    """
    frames = {}
    for number, digits, values in frames_of(args):
        out = args.out.with_name(f"{args.out.stem}.{digits}{args.out.suffix}")
        frames[out] = replace(frame, **values, number=number, seed=frame.seed + number)
    return frames


def missing_frames(args: argparse.Namespace, frames: Mapping[Path, Frame]) -> dict[Path, Frame]:
    """The frames that are to be rendered: without --restart those that do not exist, or that have a checkpoint.

    Warns:
        NeurolensWarning: frames that exist are kept, whatever keys they were rendered by.
    """
    from neurolens.frames.frame import Files
    from neurolens.render.tiles import tile_path

    missing = {}
    for out, frame in frames.items():
        written = tile_path(out, frame.tile)
        if args.restart or not written.is_file() or Files.of(written).checkpoint.exists():
            missing[out] = frame
    if kept := len(frames) - len(missing):
        warn(
            f"{kept} of {len(frames)} frames exist and are kept, even if their settings differ; "
            "--restart renders them again"
        )
    return missing


def frames_of(
    args: argparse.Namespace, command: str = _COMMAND, names: Sequence[str] = (*_QUANTITIES,)
) -> Iterator[tuple[int, str, dict[str, Any]]]:
    """The frames of --frames: number, its digits in file names, and the options that the keys set there.

    Raises:
        InputError: a key that is none, or of a quantity that the command line sets too.
    """
    given = [track for text in args.key for track in _tracks(text, command, names)]
    tracks = dict(given)
    if len(tracks) < len(given):
        raise InputError(command, "--key", args.key, "each quantity once")
    for name in tracks:
        option = _QUANTITIES[name].option
        if getattr(args, option, None) is not None:
            raise InputError(command, f"--{name}", getattr(args, option), f"left out: --key {name} sets it")
    digits = max(4, len(str(args.frames[-1])))
    for frame in args.frames:
        values = {_QUANTITIES[name].option: _at(name, track, frame) for name, track in tracks.items()}
        yield frame, f"{frame:0{digits}d}", values


def _frames(text: str) -> range:
    """Type of --frames; farms write FIRST-LAST."""
    words = re.split("[:-]", text)
    if 2 <= len(words) <= 3 and all(w.isascii() and w.isdecimal() and len(w) <= 7 for w in words):
        first, last, step = (*map(int, words), 1)[:3]
        if first <= last and step > 0 and (last - first) // step < _MOST:
            return range(first, last + 1, step)
    raise argparse.ArgumentTypeError(f"got {text!r}, expected FIRST:LAST or FIRST:LAST:STEP, at most {_MOST} frames")


def _tracks(text: str, command: str, names: Sequence[str]) -> Iterator[tuple[str, list[tuple[int, list[float]]]]]:
    """The quantities of one --key, or of the file of keys that it names."""
    path = Path(text)
    if path.suffix.lower() not in (".csv", ".json") or "=" in path.name:
        yield _track(text, command, names)
        return
    rows = read_rows(path, "a list of keys")
    for number, row in enumerate(rows):
        reject_unknown(path, f"row {number + 1}, ", row, ["frame", *names])
    for name in names:
        keys: list[tuple[int, list[float]]] = []
        for number, row in enumerate(rows):
            frame, value = row.get("frame"), row.get(name)
            if value not in (None, ""):
                value = "/".join(map(str, value)) if isinstance(value, list) else str(value)
                _append(keys, name, str(frame).strip(), value.strip(), (path, f"row {number + 1}, {name}"))
        if keys:
            yield name, keys


def _track(text: str, command: str, names: Sequence[str]) -> tuple[str, list[tuple[int, list[float]]]]:
    """Name and keys, (frame, measures), of one --key."""
    name, _, rest = text.partition("=")
    if name not in names:
        raise InputError(command, "--key", text, f"NAME=FRAME:VALUE,... with NAME of {', '.join(names)}")
    keys: list[tuple[int, list[float]]] = []
    for word in rest.split(","):
        frame, _, value = word.partition(":")
        _append(keys, name, frame, value, (command, f"--key {name}"))
    return name, keys


def _append(
    keys: list[tuple[int, list[float]]], name: str, frame: str, value: str, place: tuple[str | Path, str]
) -> None:
    """One more key of a quantity, as words; `place`: where they stand, for errors."""
    quantity = _QUANTITIES[name]
    try:
        numbers = [float(v) for v in value.split("/")] if len(value) < 100 else []
    except ValueError:
        numbers = []
    good = [within(quantity.bounds, v) for v in numbers]
    later = frame.isascii() and frame.isdecimal() and len(frame) <= 7 and (not keys or int(frame) > keys[-1][0])
    if not later or len(numbers) != quantity.size or not all(good):
        form = f"{'X/Y/Z in m' if quantity.size > 1 else 'a number'} {said(quantity.bounds)}"
        raise InputError(*place, f"{frame}:{value}", f"FRAME:VALUE, frames increasing, VALUE {form}")
    keys.append((int(frame), [quantity.to(v) for v in numbers]))


def _at(name: str, keys: Sequence[tuple[int, list[float]]], frame: int) -> float | tuple[float, ...]:
    """The value of a quantity at a frame."""
    import numpy as np

    frames, measures = [k for k, _ in keys], np.transpose([m for _, m in keys])
    found = tuple(_QUANTITIES[name].back(float(np.interp(frame, frames, row))) for row in measures)
    return found if len(found) > 1 else found[0]
