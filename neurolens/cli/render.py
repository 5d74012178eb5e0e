"""`neurolens render SCENE --camera ...`: a picture of a scene through a lens, a model, a thin lens or a pinhole; and
`neurolens demo`: one scene through all of these, on a page."""

import argparse
import importlib.util
import shlex
import signal
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from neurolens.base.cluster import Dask, distributed
from neurolens.base.errors import NeurolensError, printable, program, warn
from neurolens.base.files import atomic_write_text, how_to_resume, library
from neurolens.base.html import html
from neurolens.base.progress import Progress, duration
from neurolens.base.report import PART, Report
from neurolens.base.settings import changed, group, positive, setting
from neurolens.base.tasks import Stopping, Unfinished
from neurolens.cameras.contract import FloatArray
from neurolens.cli import arguments as cli
from neurolens.cli.keys import Frames, frames_group, numbered
from neurolens.pictures.frames import Files, Frame, Picture, Prepared, flare_choice, flare_of, prepare, write_pictures
from neurolens.pictures.frames.farm import render_frames
from neurolens.pictures.render.pictures import write_png
from neurolens.pictures.render.renderer import Merged, RenderResult, Statistics, Watch, merge_tiles, tile_path
from neurolens.pictures.render.settings import FilmSettings, SensorSettings

_FARMS, _LONG = "farms", "long renders"  # titles in the help


def _tile(text: str) -> tuple[int, int]:
    """Read --tile."""
    words = text.split("/")
    if len(words) == 2 and all(w.isascii() and w.isdecimal() and len(w) <= 6 for w in words):
        number, count = map(int, words)
        if 1 <= number <= count:
            return number, count
    raise argparse.ArgumentTypeError(f"got {text!r}, expected I/N, tile I of N, from 1/N to N/N")


@dataclass(frozen=True, kw_only=True)
class Render(cli.Reporting):
    """Path-trace a scene with the size, film, focus and samples that it states, through a lens with its widest stop
    and all its dispersion, and write OpenEXR in linear sRGB with a PNG preview beside it.

    The EXR's metadata keep the settings, the camera and the card of a model, as JSON in the attribute "neurolens".

    The same seed gives the same picture for any number of threads, and all cameras share its random numbers. Lenses and
    models run as C where the machine has a compiler; compiling takes some seconds, once. Only --field needs torch.

    The preview is updated during the render. Ctrl-C (SIGTERM, SIGHUP) writes the picture so far. The same command then
    goes on from OUT.exr.part and ends with the same picture, bit for bit."""

    epilog = f"""{cli.CAMERAS_HELP}

examples:
  neurolens render lights --camera canon_50mm_f1_2 --f-number 1.2 --width 480 --samples 64 -o first.exr
  neurolens render grid --camera ogawa_zoom_70_200 --zoom 100 --blades 8 --blade-curvature 0.5 -o zoom.exr
  neurolens render room --camera thin --samples 64 --keep-checkpoint -o room.exr
  neurolens render room --camera thin --samples 256 -o room.exr   # 192 more
  neurolens render room --camera thin --tile 1/2 -o room.exr   # and 2/2 elsewhere
  neurolens render --merge room.tile-*.exr -o room.exr
  neurolens render room --camera models/NAME.onnx --frames 1:48 \\
      --key focus=1:1.2,48:3 --key position=1:0/1.6/3,48:0.5/1.6/2.5 -o pull.exr"""
    kept = "no picture was written; older files of that name are untouched"

    scene: tuple[Path, ...] = setting(
        (), "scene file (.toml) or its name in experiments/scenes, or tiles of --merge", positional=True,
        metavar="SCENE", nargs="*", kind=cli.scene_file,
    )  # fmt: skip
    camera: str | None = cli.lens(None, models=True, cameras=True, old=("lens",))
    out: Path = cli.output_path("OUT.exr", "picture to write; the preview is OUT.png")
    picture: Picture = group("picture")
    colour: FilmSettings = group("colour (left out: the scene's [film] table)", unset=True)
    sensor: SensorSettings = group(
        "sensor (any of these, or a scene's [sensor] table, adds what it reads as channels raw)", unset=True
    )
    frames: Frames = frames_group(
        "render these frames to OUT.0001.exr and so on; a frame that exists is kept (--restart: none is), an "
        "interrupted one goes on; the seed grows by the frame's number; --json prints an object a frame"
    )
    tile: tuple[int, int] | None = setting(
        None, "render the I-th of N bands of rows, to OUT.tile-I-of-N.exr (goes with --frames). A scene's [flare] is "
        "computed whole for each tile", kind=_tile, metavar="I/N", title=_FARMS,
    )  # fmt: skip
    merge: bool = setting(
        False, "put tiles together: the picture that one run gives, bit for bit (with --diffraction within rounding, "
        "after which a sensor's noise is another), with its preview and metadata, whose times are summed; of tiles of "
        "frames a picture a frame. Takes -o and --exposure alone, and no tile of other settings, missing, doubled or "
        "unfinished", title=_FARMS,
    )  # fmt: skip
    dask: str | None = cli.dask(_FARMS)
    checkpoint_every: float = setting(
        30.0, "seconds between checkpoints, OUT.exr.part; inf: only when the render is stopped (default: 30)",
        kind=positive("seconds", infinite=True), metavar="S", title=_LONG,
    )  # fmt: skip
    restart: bool = setting(False, "start anew, ignoring OUT.exr.part", title=_LONG)
    keep_checkpoint: bool = setting(
        False, "keep OUT.exr.part, so that the same command with more --samples adds them (from a multiple of 16)",
        title=_LONG,
    )  # fmt: skip
    state: cli.LensState = cli.camera_state(texts=dict.fromkeys(("focus_m", "f_number"), "the scene's, else "))
    threads: int = cli.threads("workers, each pinned to a core if there are as many as cores")

    def assumed(self) -> Any:
        """Assume nothing for tiles: their picture has the name that it was rendered to."""
        if self.merge and self.out is None:
            self.refuse("--output", "(missing)", "-o OUT.exr beside --merge")
        return super().assumed()

    def run(self) -> int:
        """Render frames, or merge tiles; return the exit code of the first frame that fails."""
        if not self.merge and (len(self.scene) != 1 or self.camera is None):
            scene, camera = " ".join(map(str, self.scene)) or "(missing)", self.camera or "(missing)"
            missing, got = ("SCENE", scene) if len(self.scene) != 1 else ("--camera", camera)
            self.refuse(missing, got, "one scene and one camera, as in: neurolens render lights --camera helios")
        try:
            return self._merge() if self.merge else self._run()
        except MemoryError as error:  # in one line
            raise NeurolensError(f"render: out of memory ({str(error) or 'no more said'})") from None

    def _run(self) -> int:
        if self.dask is not None:
            distributed()  # before a camera is made
        frame = self.frame()
        frames = {
            numbered(self.out, digits): frame.at(**values, number=number, seed=frame.seed + (number or 0))
            for number, digits, values in self.frames.states(vars(frame) | vars(frame.shot), self.called)
        }
        missing = frames if self.frames.frames is None else self._missing(frames)
        if self.dask is not None:
            return self._run_on_dask(self.dask, frames, missing)
        choice = None
        for number, (out, frame) in enumerate(missing.items()):
            progress = self.progress()
            prepared = prepare(frame, out, progress)
            choice = choice if number else flare_choice(list(frames.values()), prepared, self.threads)
            code = self._render(prepared, flare_of(prepared, choice, self.threads, progress), progress)
            if code:
                return code
        return 0

    def frame(self) -> Frame:
        """Return the frame that the options describe."""
        assert self.camera is not None
        return Frame.of(
            self.scene[0], self.camera, shot=self.state.shot(), **vars(self.picture), glass_files=self.glass,
            colour=self.colour, sensor=self.sensor, tile=self.tile,
        )  # fmt: skip

    def _missing(self, frames: Mapping[Path, Frame]) -> dict[Path, Frame]:
        """Return the frames to render: without --restart those that do not exist, or that have a checkpoint.

        Warns:
            NeurolensWarning: frames that exist are kept, whatever keys they were rendered by.
        """
        missing = {}
        for out, frame in frames.items():
            written = tile_path(out, frame.tile)
            if self.restart or not written.is_file() or Files.of(written).checkpoint.exists():
                missing[out] = frame
        if kept := len(frames) - len(missing):
            warn(
                f"{kept} of {len(frames)} frames exist and are kept, even if their settings differ; "
                "--restart renders them again"
            )
        return missing

    def _render(self, prepared: Prepared, flare: Mapping[str, FloatArray], progress: Progress) -> int:
        """Render a frame until it is done or a signal asks to stop, write its pictures, and print a summary."""
        files = prepared.files
        with Stopping() as stopping, progress.stage(f"render {prepared.name}") as report:
            result = prepared.render(self.threads, report, self._watch(files, stopping))
            if not result.stats.complete:
                raise Unfinished
        kept = files.kept() if stopping() else self.kept
        if not result.stats.paths:
            return _interrupted(stopping, kept)
        with cli.keeps(kept):
            write_pictures(prepared, result, flare)
        if dropped := result.stats.dropped_samples:
            warn(f"{dropped} of {result.stats.paths} samples were not finite and count as black")
        if not result.stats.complete:
            return _interrupted(stopping, f"{_so_far(result, files)}; {files.kept()}")
        if not self.keep_checkpoint:
            files.checkpoint.unlink(missing_ok=True)
        return self.answer(Rendered(str(files.out), str(files.preview), result.stats, prepared.camera.settings))

    def _watch(self, files: Files, stop: Stopping) -> Watch:
        """Return what watches a render: it updates the preview, writes checkpoints, and stops when asked to."""
        return Watch(
            preview=partial(write_png, files.preview, exposure=self.picture.exposure), checkpoint=files.checkpoint,
            checkpoint_s=self.checkpoint_every, restart=self.restart, keep=self.keep_checkpoint,
            stop=stop, note=warn,
        )  # fmt: skip

    def _run_on_dask(self, address: str, frames: Mapping[Path, Frame], missing: Mapping[Path, Frame]) -> int:
        """Render frames by tiles on a cluster."""
        for option, value in (("--tile", self.tile), ("--keep-checkpoint", self.keep_checkpoint or None)):
            if value is not None:
                self.refuse(option, value, "left out beside --dask")
        if not missing:
            return 0
        folder = self.out.with_name(f"{self.out.name}.tiles")
        with cli.keeps(how_to_resume(folder)), Dask(address) as executor:
            pictures = render_frames(
                missing, executor, folder, shown=list(frames.values()), restart=self.restart,
                progress=self.progress(),
            )  # fmt: skip
        return self.answer(RenderedTiles(pictures))

    def _merge(self) -> int:
        """Put tiles together to their picture."""
        taken = ("--merge", "--output", "--exposure", "--quiet", "--json")
        for option in changed(self):
            if option not in taken:
                self.refuse(option, "(beside --merge)", "tiles, -o and --exposure alone")
        if not self.scene:
            self.refuse("--merge", "(no tiles)", "the tiles of a render")
        return self.answer(RenderedTiles(merge_tiles(list(self.scene), self.out, self.picture.exposure)))


def _interrupted(stopping: Stopping, kept: str) -> int:
    """Print what remains of an interrupted render to stderr; return the exit code, 128 plus the signal's number."""
    print(f"\nneurolens: interrupted; {printable(kept)}", file=sys.stderr)
    return 128 + (stopping.number or signal.SIGINT)


def _so_far(result: RenderResult, files: Files) -> str:
    """Return the part of an interrupted picture that is done."""
    samples = result.layers.samples
    least, most = int(samples.min()), int(samples.max())
    spread = f" ({least} to {most})" if least < most else ""
    done, asked = result.stats.samples_done, result.stats.samples
    return f"{files.out} holds {done:.3g} of {asked} samples per pixel{spread}"


@dataclass(frozen=True)
class RenderedTiles(Report):
    """Pictures that were put together from tiles."""

    pictures: Sequence[Merged]

    def text(self) -> str:
        """Return the files."""
        return "\n".join(str(picture.file) for picture in self.pictures)


@dataclass(frozen=True)
class Rendered(Report):
    """A finished picture, with what it took and the settings of its camera."""

    file: str
    preview: str
    took: Statistics = field(metadata=PART)
    camera: Mapping[str, Any]

    def text(self) -> str:
        """Return the size of the picture, its time and its files."""
        took = self.took
        return (
            f"{took.scene} through {took.camera}: {took.settings['width']} x {took.settings['height']}, {took.samples} "
            f"samples in {duration(took.seconds)} ({took.mpaths_per_s:.2f} Mpath/s, "
            f"{100 * took.passed_fraction:.0f}% of the rays pass, "
            f"{100 * took.camera_fraction:.0f}% of the time in the camera)\n{self.file}\n{self.preview}"
        )


_LENS = "laikin_double_gauss_50"
_PICTURES = (
    ("model", f"{_LENS}.mlp-16x2", "its model, a network of 556 weights: cat's eyes, dark corners, colour fringes"),
    ("exact", _LENS, "the lens itself, every ray through every surface"),
    ("thin", "thin", "a thin lens: round discs to the corner"),
    ("pinhole", "pinhole", "a pinhole: no blur at all"),
    ("fisheye", "isshiki_fisheye_10.mlp-16x2", "another lens: the model of a 180-degree fisheye"),
)
_SIZE = "--focal-length 49.64"
_MORE = {"thin": f"{_SIZE} --f-number 1.8", "pinhole": _SIZE, "fisheye": "--film 30x16.875"}


@dataclass(frozen=True, kw_only=True)
class Demo(cli.Command):
    """Render lights at many depths through a model of a 50 mm f/1.8 double Gauss, the lens itself, a thin
    lens and a pinhole that show the plane in focus at the same size, then through a fisheye's model,
    and write them on one page, each with its command. Needs no checkout: the library ships."""

    epilog = "examples:\n  neurolens demo --width 160 -o small/"
    kept = "pictures so far are kept; the same command goes on"
    alone = True

    out: Path = cli.output_path(
        "FOLDER", "folder of the page and its pictures (default: neurolens-demo)", Path("neurolens-demo")
    )
    width: int = setting(480, "width of the pictures (default: 480)", within=(1, 4096), metavar="PIXELS")
    samples: int = setting(32, "samples of a pixel (default: 32)", within=(1, 2**16))

    def run(self) -> int:
        """Render and write the page."""
        from neurolens.studies.pages import figures_of

        self.out.mkdir(parents=True, exist_ok=True)
        parser = cli.Parser()
        Render.fill(parser)
        scene = str(library() / "experiments" / "scenes" / "lights.toml")
        figures = []
        for name, camera, caption in _PICTURES:
            size = ["--width", str(self.width), "--samples", str(self.samples), "-o", str(self.out / f"{name}.exr")]
            words = [scene, "--camera", camera, *_MORE.get(name, "").split(), *size]
            command = f"{program()} render {shlex.join(words)}"
            print(command, flush=True)
            args = parser.parse_args(words)
            args.run(args)
            figures.append({"file": f"{name}.png", "title": caption, "caption": command})
        page = html("demo.html", title="One scene, five cameras", shown=figures_of(self.out, figures))
        atomic_write_text(self.out / "index.html", page)
        more = [f"  {program()} {words}" for words in ("--help", "models", "lens list")]
        more[2] += "" if importlib.util.find_spec("torch") else "   # with the extra 'train', which traces lenses"
        print("\n".join([f"\nLook at {self.out}/index.html\nThen", *more]))
        return 0
