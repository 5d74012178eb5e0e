"""Options of `neurolens render` for farms and long renders, its reaction to signals, and its summary."""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from neurolens.base.errors import printable, warn
from neurolens.base.progress import duration
from neurolens.base.signals import handled
from neurolens.cli.arguments import add_dask, positive

if TYPE_CHECKING:
    from neurolens.frames.frame import Files
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
