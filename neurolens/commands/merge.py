"""`neurolens merge TILE... -o OUT.exr`: tiles of `neurolens render --tile` put together."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens.base.errors import InputError
from neurolens.base.files import check_writable
from neurolens.commands.arguments import add_exposure, add_json, add_output, check_folder, check_suffix
from neurolens.commands.output import answer

if TYPE_CHECKING:
    from neurolens.render.tiles import Tile

_DESCRIPTION = """\
Put the tiles of "neurolens render --tile" together: the picture that one run gives, bit for bit, with its
metadata (times are summed), and its preview. Tiles of frames become a picture a frame, OUT.0001.exr and
so on. Tiles of other settings, missing ones, doubled ones and unfinished ones are named and refused."""
_EPILOG = """\
examples:
  neurolens render experiments/scenes/room.toml --camera thin --tile 1/2 -o room.exr
  neurolens render experiments/scenes/room.toml --camera thin --tile 2/2 -o room.exr
  neurolens merge room.tile-*.exr -o room.exr

On farms: experiments/farm/render.openjd.yaml (OpenJD) and experiments/farm/render.sbatch (SLURM)."""


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "merge", help="put the tiles of a render together", description=_DESCRIPTION, epilog=_EPILOG
    )
    parser.add_argument("tiles", metavar="TILE", nargs="+", type=Path, help="tiles, in any order")
    add_output(parser, "OUT.exr", "picture to write; the preview is OUT.png", required=True)
    add_exposure(parser)
    add_json(parser)
    parser.set_defaults(run=run, kept="what was merged before is written; tiles are untouched")


def run(args: argparse.Namespace) -> int:
    """Check all tiles, then write a picture a frame."""
    check_suffix(args.out, "--output", (".exr",))
    check_folder(args.out, "--output")
    from neurolens.render.tiles import check_together, read_tile

    frames: dict[int | None, list[Tile]] = {}
    for path in args.tiles:
        tile = read_tile(path)
        frames.setdefault(tile.frame, []).append(tile)
    digits = max(4, *(len(str(frame)) for frame in frames))
    outs = {}
    for frame, tiles in frames.items():
        check_together(tiles)
        number = "" if frame is None else f".{frame:0{digits}d}"
        outs[frame] = args.out.with_name(f"{args.out.stem}{number}{args.out.suffix}")
        _spare(outs[frame], args.tiles)
    pictures = [write_picture(tiles, outs[frame], args.exposure) for frame, tiles in frames.items()]
    return answer(args, {"pictures": pictures}, lambda: "\n".join(str(p["file"]) for p in pictures))


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
