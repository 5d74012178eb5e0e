"""Files of `neurolens render` (picture, preview, checkpoint) and its reaction to signals."""

from __future__ import annotations

import argparse
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens.base.errors import InputError, NeurolensError, NeurolensWarning, printable
from neurolens.base.files import check_writable
from neurolens.base.progress import duration
from neurolens.base.signals import handled
from neurolens.commands.arguments import check_folder, check_suffix, positive
from neurolens.commands.farm import add_dask
from neurolens.evaluate.records import plain

if TYPE_CHECKING:
    from neurolens.cameras.contract import FloatArray
    from neurolens.render.colour import ColourSpace
    from neurolens.render.film_settings import FilmSettings
    from neurolens.render.renderer import RenderResult, Watch

_AT_ONCE_S = 1.0


def add_tile(parser: argparse.ArgumentParser) -> None:
    """Add --tile."""
    group = parser.add_argument_group("farms")
    group.add_argument(
        "--tile", metavar="I/N", type=_tile,
        help="render the I-th of N bands of rows, to OUT.tile-I-of-N.exr (goes with --frames). A scene's [flare] is "
        "computed whole for each tile",
    )  # fmt: skip
    group.add_argument(
        "--merge", action="store_true",
        help="put tiles together: the picture that one run gives, bit for bit, with its preview and metadata, whose "
        "times are summed; of tiles of frames a picture a frame. Takes -o and --exposure alone, and no tile of other "
        "settings, missing, doubled or unfinished",
    )  # fmt: skip
    add_dask(group)


def _tile(text: str) -> tuple[int, int]:
    """Type of --tile."""
    words = text.split("/")
    if len(words) == 2 and all(w.isascii() and w.isdecimal() and len(w) <= 6 for w in words):
        number, count = map(int, words)
        if 1 <= number <= count:
            return number, count
    raise argparse.ArgumentTypeError(f"got {text!r}, expected I/N, tile I of N, from 1/N to N/N")


def add_safety(parser: argparse.ArgumentParser) -> None:
    """Add the options of long renders."""
    group = parser.add_argument_group("long renders")
    group.add_argument(
        "--checkpoint-every", metavar="S", type=positive("seconds", infinite=True), default=30.0,
        help="seconds between checkpoints, OUT.exr.part; inf: only when the render is stopped (default: 30)",
    )  # fmt: skip
    group.add_argument("--restart", action="store_true", help="start anew, ignoring OUT.exr.part")
    group.add_argument(
        "--keep-checkpoint", action="store_true",
        help="keep OUT.exr.part, so that the same command with more --samples adds them (from a multiple of 16)",
    )  # fmt: skip


@dataclass(frozen=True)
class Files:
    """Files of a render: the EXR, the PNG beside it, and the temporary checkpoint."""

    out: Path
    preview: Path
    checkpoint: Path

    @classmethod
    def of(cls, out: Path) -> Files:
        """The files of `--output`; refuses names that cannot be written before anything is rendered.

        Raises:
            InputError: not .exr, or no such folder.
            OSError: a folder that cannot be written, a folder of that name.
        """
        check_suffix(out, "--output", (".exr",))
        check_folder(out, "--output")
        files = cls(out, out.with_suffix(".png"), out.with_name(f"{out.name}.part"))
        for path in (files.out, files.preview, files.checkpoint):
            check_writable(path)
        return files

    def spare(self, inputs: Iterable[Path]) -> None:
        """Raise InputError if an output is one of `inputs`, such as a texture with the preview's name."""
        for read in inputs:
            for written in (self.out, self.preview, self.checkpoint):
                if written.exists() and read.exists() and written.samefile(read):
                    raise InputError(self.out, "--output", written.name, f"another name: the scene reads {read}")

    def kept(self) -> str:
        """How to resume a render that ended early."""
        if self.checkpoint.exists():
            return f"the same command resumes from {self.checkpoint}"
        return "there is no checkpoint to resume from"


class Stopping:
    """Inside the block, Ctrl-C, SIGTERM and SIGHUP first request a stop; a second signal takes its usual effect.

    `timeout` and others send a signal twice at once, to the process and to its group: that counts as one.
    """

    def __init__(self) -> None:
        self._handled = handled(self._asked)
        self._before: dict[int, Any] = {}
        self._number: int | None = None
        self._at = 0.0

    def __enter__(self) -> Stopping:
        self._before = self._handled.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> bool:
        self._handled.__exit__(None, None, None)
        return kind is Unfinished

    def __call__(self) -> bool:
        """Whether a stop was requested."""
        return self._number is not None

    def _asked(self, number: int) -> None:
        if self._number is None:
            self._number, self._at = number, time.monotonic()
        elif time.monotonic() > self._at + _AT_ONCE_S:
            signal.signal(number, self._before[number])
            signal.raise_signal(number)

    def say(self, what: str) -> int:
        """Print what remains of an interrupted render to stderr; the exit code, 128 plus the signal's number."""
        print(f"\nneurolens: interrupted; {printable(what)}", file=sys.stderr)
        return 128 + (self._number or signal.SIGINT)


class Unfinished(Exception):
    """Leaves the block of a `Stopping`, and a stage of the progress without its final line."""


def warn(text: str) -> None:
    """A warning, which the command line prints to stderr."""
    warnings.warn(text, NeurolensWarning, stacklevel=2)


def watch_of(args: argparse.Namespace, files: Files, stop: Callable[[], bool]) -> Watch:
    """Preview, checkpoint and stop of the command line."""
    from neurolens.render.pictures import write_png
    from neurolens.render.renderer import Watch

    return Watch(
        preview=partial(write_png, files.preview, exposure=args.exposure),
        checkpoint=files.checkpoint,
        checkpoint_s=args.checkpoint_every,
        restart=args.restart,
        keep=args.keep_checkpoint,
        stop=stop,
        note=warn,
    )


def write_pictures(
    files: Files,
    result: RenderResult,
    metadata: dict[str, Any],
    film: FilmSettings,
    args: argparse.Namespace,
    flare: Mapping[str, FloatArray],
) -> None:
    """Write EXR and PNG; if they cannot be written, the checkpoint.

    Args:
        flare: layers by name, [H, W, 3] linear sRGB, which are to be added.

    Raises:
        NeurolensError: they cannot be written; with the way to resume.
    """
    from neurolens.render.colour import COLOUR_SPACES
    from neurolens.render.exr_attributes import standard_attributes
    from neurolens.render.job import MEANING
    from neurolens.render.pictures import write_exr, write_png
    from neurolens.render.tiles import rows_of, windows

    space = COLOUR_SPACES[film.colour_space]
    told = metadata | {"render": plain(result.stats)}
    told["colour"] = space.stated
    layers: dict[str, FloatArray] = {}
    if args.channels == "all" or not result.stats["complete"]:
        layers, told["layers"] = asdict(result.layers), MEANING
    width, height = result.stats["width"], result.stats["height"]
    rows = (0, height) if args.tile is None else rows_of(height, args.tile)
    layers |= flare_channels({name: picture[slice(*rows)] for name, picture in flare.items()}, space)
    attributes = standard_attributes(metadata["camera"], width, height, args.frame)
    if args.tile is not None:
        number, count = args.tile
        told["tile"] = {"number": number, "of": count, "frame": args.frame, "half": args.half}
        told["tile"]["identity"] = plain(result.identity)
        attributes |= windows(width, height, rows)
    try:
        write_exr(
            files.out, result.rgb, half=args.half, metadata=told, space=space, layers=layers, attributes=attributes
        )
        write_png(files.preview, result.rgb, args.exposure)
    except (OSError, NeurolensError) as error:
        raise NeurolensError(f"{_said(error)}; {_rescued(files, result)}") from None


def flare_channels(flare: Mapping[str, FloatArray], space: ColourSpace) -> dict[str, FloatArray]:
    """The channels of layers of flare in a colour space, of pictures [H, W, 3] linear sRGB by name."""
    from neurolens.render.colour import SRGB, conversion, converted

    channels: dict[str, FloatArray] = {}
    for name, picture in flare.items():
        colour = picture if space is SRGB else converted(picture, conversion(SRGB, space)).astype(picture.dtype)
        channels |= {f"{name}.{c}": colour[..., k] for k, c in enumerate("RGB")}
    return channels


def _rescued(files: Files, result: RenderResult) -> str:
    """Save a render whose picture cannot be written; returns how to resume.

    A checkpoint is larger than the picture (64 bytes per pixel), but the disk may be full only for a moment, or the
    picture itself may be refused.
    """
    try:
        assert result.save is not None
        result.save()
    except (OSError, NeurolensError, MemoryError) as error:
        if files.checkpoint.exists():
            return f"only a part of the render is kept ({_said(error)}): {files.kept()}"
        return f"the render is lost, for the checkpoint cannot be written either ({_said(error)})"
    return f"the render is kept: {files.kept()}"


def _said(error: BaseException) -> str:
    if not isinstance(error, OSError):
        return str(error) or type(error).__name__
    place = "" if error.filename is None else f"{error.filename}: "
    return f"{place}{error.strerror or error}"


def so_far(result: RenderResult, files: Files) -> str:
    """How much of an interrupted picture is done."""
    samples = result.layers.samples
    least, most = int(samples.min()), int(samples.max())
    spread = f" ({least} to {most})" if least < most else ""
    done, asked = result.stats["samples_done"], result.stats["samples"]
    return f"{files.out} holds {done:.3g} of {asked} samples per pixel{spread}"


def summary(stats: dict[str, Any], files: Files) -> str:
    """Summary of a finished render."""
    return (
        f"{stats['scene']} through {stats['camera']}: {stats['width']} x {stats['height']}, {stats['samples']} samples "
        f"in {duration(stats['seconds'])} ({stats['mpaths_per_s']:.2f} Mpath/s, "
        f"{100 * stats['passed_fraction']:.0f}% of the rays pass, "
        f"{100 * stats['camera_fraction']:.0f}% of the time in the camera)\n{files.out}\n{files.preview}"
    )
