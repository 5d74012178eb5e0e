"""`neurolens render --merge TILE... -o OUT.exr`: tiles of `neurolens render --tile` put together."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens.base.errors import InputError
from neurolens.base.files import check_writable
from neurolens.commands.arguments import Parser, check_folder, check_suffix
from neurolens.commands.output import answer

if TYPE_CHECKING:
    from neurolens.render.tiles import Tile


def run_merge(args: argparse.Namespace) -> int:
    """Check all tiles, then write a picture a frame."""
    _check_alone(args)
    check_suffix(args.out, "--output", (".exr",))
    check_folder(args.out, "--output")
    from neurolens.render.tiles import check_together, read_tile

    frames: dict[int | None, list[Tile]] = {}
    for path in args.scene:
        tile = read_tile(path)
        frames.setdefault(tile.frame, []).append(tile)
    digits = max(4, *(len(str(frame)) for frame in frames))
    outs = {}
    for frame, tiles in frames.items():
        check_together(tiles)
        number = "" if frame is None else f".{frame:0{digits}d}"
        outs[frame] = args.out.with_name(f"{args.out.stem}{number}{args.out.suffix}")
        _spare(outs[frame], args.scene)
    pictures = [write_picture(tiles, outs[frame], args.exposure) for frame, tiles in frames.items()]
    return answer(args, {"pictures": pictures}, lambda: "\n".join(str(p["file"]) for p in pictures))


def _check_alone(args: argparse.Namespace) -> None:
    """Refuse no tiles at all, and options that tiles have settled already; raises InputError."""
    from neurolens.commands import render

    parser, taken = Parser(), ("scene", "merge", "out", "exposure", "quiet", "json")
    render.add_parser(parser.add_subparsers())
    for name, unset in vars(parser.parse_args(["render", "-o", "a.exr"])).items():
        if name not in taken and getattr(args, name) != unset:
            option = f"--{name.replace('_', '-')}"
            raise InputError("neurolens render", option, "(beside --merge)", "tiles, -o and --exposure alone")
    if not args.scene:
        raise InputError("neurolens render", "--merge", "(no tiles)", "the tiles of a render")


def write_picture(
    tiles: Sequence[Tile], out: Path, exposure: float, correct: Callable[[dict[str, Any]], None] = lambda _: None
) -> dict[str, Any]:
    """Write the picture of these tiles and its preview; its file and statistics. `correct` may change its metadata."""
    import numpy as np

    from neurolens.render.colour import COLOUR_SPACES, SRGB, conversion, converted
    from neurolens.render.pictures import write_png
    from neurolens.render.tiles import merged, write_merged

    channels, told = merged(tiles)
    correct(told)
    rgb = np.stack([channels[name].astype(np.float32) for name in "RGB"], axis=-1)
    if (space := told["colour"]["space"]) != SRGB.name:
        rgb = converted(rgb, conversion(COLOUR_SPACES[space], SRGB)).astype(np.float32)
    write_merged(out, channels, told, tiles[0].frame)
    write_png(preview := out.with_suffix(".png"), rgb, exposure)
    return {"file": str(out), "preview": str(preview), "tiles": len(tiles), **told["render"]}


def _spare(out: Path, tiles: Sequence[Path]) -> None:
    """Refuse, before anything is written, to write over a tile, or where nothing can be written."""
    if out.exists() and any(out.samefile(tile) for tile in tiles):
        raise InputError(out, "--output", out.name, "another name: it is one of the tiles")
    for path in (out, out.with_suffix(".png")):
        check_writable(path)
