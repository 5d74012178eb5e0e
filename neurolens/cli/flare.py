"""`neurolens flare LENS --light AZ,EL ...`: the ghosts of lights as a table and as a picture with layers."""

from __future__ import annotations

import argparse
import math
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neurolens import __version__
from neurolens.base.errors import InputError, warn
from neurolens.base.progress import Progress
from neurolens.base.report import BULK, OPTIONAL, PART, Report, plain
from neurolens.base.settings import changed, group, positive, setting
from neurolens.base.units import in_unit
from neurolens.cameras.build import make_camera
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.exact import placed_settings
from neurolens.cameras.field import Field, field_of
from neurolens.cameras.pose import FilmPose, warn_beyond
from neurolens.cli import arguments as cli
from neurolens.cli.keys import Frames, frames_group, numbered
from neurolens.optics.analysis.layout import lens_layout
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.lens.shot import BY_LENSES, POSES
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.setting.focusing import require_film
from neurolens.optics.setting.states import set_lens
from neurolens.pictures.flare.canvas import Raster
from neurolens.pictures.flare.ghosts import RANKED, Ghost, GhostTracer, ghost_layout, ghost_pairs, ghost_table
from neurolens.pictures.flare.job import FlareJob
from neurolens.pictures.flare.layers import brightest, flare_layers, kept_beside, sum_of
from neurolens.pictures.flare.lights import (
    SUN,
    KeptLights,
    Light,
    SceneLights,
    highlights,
    keep,
    read_lights,
    with_disc,
)
from neurolens.pictures.frames import Files, flare_channels
from neurolens.pictures.render.colour import COLOUR_SPACES, SRGB, ColourSpace, conversion, converted, in_gamut
from neurolens.pictures.render.lights import SUN_RADIUS_RAD
from neurolens.pictures.render.pictures import (
    read_colour_space,
    read_exr,
    read_metadata,
    standard_attributes,
    write_channels,
    write_png,
)  # fmt: skip
from neurolens.pictures.render.scene import files_named, load_scene, seen_from
from neurolens.pictures.render.settings import LAYERS, OF_LAYERS, OF_LIGHTS, OF_PICTURE, ColourSpaceName, FlareSettings

_COMMAND = "neurolens flare"
_QUICK_WIDTH = 480  # pixels at most
_SHOWN, _SHOWN_LIGHTS, _KEPT = 12, 4, 64  # ghosts of a table; tables; ghosts of a light in metadata
_FEWEST = 256  # rays behind a table
_GHOST_FRAMES = 16  # at most, which decide which ghosts are the brightest
_QUANTILE, _SHOWN_AT = 0.99, 0.8  # the preview's exposure takes this quantile of the lit pixels to this value


def _gain(text: str) -> tuple[str, list[float]]:
    """Read --gain: a name, and factors of red, green and blue."""
    name, _, rest = text.partition("=")
    factors = cli.floats(rest, "/")
    if len(factors) not in (1, 3) or not all(0 <= v < math.inf for v in factors):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected NAME=X or NAME=R/G/B, of at least 0")
    return name, factors * (3 // len(factors))


@dataclass(frozen=True, kw_only=True)
class Flare(cli.Figures):
    """Print the brightest ghosts of a lens that is focused at infinity, and write a picture of its flare (with -o, or
    where only a lens is given).

    A ghost is light that two surfaces reflect on its way to the film. It is traced exactly, with the reflectance of
    Fresnel's equations or of the coatings, all rims, the shape of the stop, and the spectrum. The table has its energy,
    position and size on the film itself, which pictures show turned by 180 degrees.

    The OpenEXR picture can be added to a render of the same lens, film and focus. R, G and B are the sum of the layers
    (ghosts.R, .G, .B, and so on); --layers N gives the N ghosts with the greatest values on the film a layer each. A
    white card of radiance 1 is 1 on the axis, as in `neurolens render`.

    With --photons, photons take the place of ghosts, and are reflected by chance any number of times. With --glare, or
    if anything scatters, photons make the layer "glare": light that is reflected more than twice or scatters. The layer
    "starburst" has the light that diffraction sends aside, but not the image of the light itself. Each surface divides
    light by the mean of both polarisations. Needs the extra "train" (torch) and a C compiler."""

    epilog = """\
examples:
  neurolens flare laikin_double_gauss_50 --light 15,8 -o flare.exr
  neurolens flare laikin_double_gauss_50 --light 15,8 --path g08-06 path.png
  neurolens flare laikin_double_gauss_50 --light 15,8 --coating quarter-wave --blades 6 --f-number 8 -o flare.exr
  neurolens flare ogawa_zoom_70_200 --zoom 100 --light -12,3,3/2.5/1.5 --layers 8 -o flare.exr
  neurolens flare laikin_double_gauss_50 --light 15,8 --coating multi-layer --barrel 0.05 --dust 0.01 -o flare.exr
  neurolens flare laikin_double_gauss_50 --lights sun.csv --frames 1:48 --key camera.csv -o flare.exr"""

    file: Path = cli.lens(positional=True)
    light: tuple[str, ...] = setting(
        (), "a light: degrees to the right of the axis and above it, as the camera sees it; the irradiance of a point "
        "at the lens, a number or R/G/B, which is radiance times solid angle in sr (default: the sun's disc with pi, "
        "which lights a white card to radiance 1); its distance in metres (default: inf); repeatable",
        metavar="AZ,EL[,E[,M]]", title=OF_LIGHTS, common=True,
    )  # fmt: skip
    lights: tuple[Path, ...] = setting(
        (), "a scene (.toml), whose shapes that shine, points, spots and sun the camera of the scene sees; or a list, "
        "CSV or JSON, with azimuth_deg, elevation_deg, and where wanted light (a name), frame (keys), r, g, b, "
        "diameter_deg (of a disc; the sun has 0.53), distance_m, visible (share that shows); repeatable",
        title=OF_LIGHTS,
    )  # fmt: skip
    image: Path | None = setting(
        None, "a picture by the same lens, film and focus, whose connected regions above --threshold are lights far "
        "away; # in its name stands for the frame's digits", metavar="PLATE.exr", title=OF_LIGHTS,
    )  # fmt: skip
    threshold: float = setting(
        2.0, "value of a colour from which a pixel of --image counts as light; a white card of radiance 1 has 1. "
        "Pixels count in full from 2 T on, so that none switches on at once (default: 2)",
        kind=positive("a value of the picture"), metavar="T", title=OF_LIGHTS,
    )  # fmt: skip
    out: Path | None = cli.output_path("OUT.exr", "picture to write, of a light that is given; the preview is OUT.png")
    path: tuple[str, str] | None = setting(
        None, "draw the rays of one ghost of the first light (PNG, PDF, SVG)",
        kind=str, nargs=2, metavar=("GHOST", "OUT"),
    )  # fmt: skip
    film: tuple[float, float] = cli.film(title=OF_PICTURE)
    width: int = setting(
        960, "width of the picture (default: 960)", within=(1, 16384), metavar="PIXELS", title=OF_PICTURE, common=True
    )
    exposure: float | None = cli.exposure(
        None, "99% of the lit pixels become no brighter than 0.8; frames share one value", title=OF_PICTURE
    )
    colour_space: ColourSpaceName | None = setting(
        None, "linear colours of the EXR: sRGB (D65) or ACEScg (AP1, the white of ACES). ACEScg holds more "
        "saturated lights; a colour beyond becomes paler, never negative (default: that of --image, else of a"
        " scene, else sRGB)",
        title=OF_PICTURE,
    )  # fmt: skip
    quick: bool = setting(
        False, "at most 480 pixels wide, 5 wavelengths and 65536 photons a light and wavelength, --cell at least 24",
        old=("preview",), title=OF_PICTURE,
    )  # fmt: skip
    gain: tuple[tuple[str, list[float]], ...] = setting(
        (), "factor of a layer (ghosts) or a ghost (g07-03), or one for each colour, NAME=R/G/B; repeatable, gains "
        "multiply", kind=_gain, metavar="NAME=X", old=("tint",), title=OF_LAYERS,
    )  # fmt: skip
    settings: FlareSettings = group("")
    threads: int = cli.threads()
    frames: Frames = frames_group(
        "flare of these frames to OUT.0001.exr and so on, of lights by their keys in lists, the lens, and the camera "
        "of a scene of --lights by --key; a frame that exists is kept."
    )
    restart: bool = setting(False, "make frames again that exist (with --frames)")
    state: cli.LensState = group("state of the lens", names=(*BY_LENSES, *POSES), unset=True)

    frame: int | None = None
    position_m: tuple[float, float, float] | None = None  # of a scene's camera
    look_at_m: tuple[float, float, float] | None = None

    @property
    def focus_m(self) -> float:
        """Distance to the object in focus in metres."""
        return math.inf if self.state.given.focus_m is None else self.state.given.focus_m

    @property
    def picture(self) -> Path:
        """The picture to write, with -o."""
        assert self.out is not None
        return self.out

    @property
    def plate(self) -> Path | None:
        """The file of --image at this frame."""
        if self.image is None:
            return None
        return Path(re.sub("#+", lambda digits: f"{self.frame or 0:0{len(digits[0])}d}", str(self.image)))

    @classmethod
    def of(cls, args: argparse.Namespace) -> Flare:
        """The command, with its gains multiplied and with coarse settings of --quick.

        Raises:
            InputError: options that exclude each other.
        """
        flare = super().of(args)
        gains: dict[str, tuple[float, float, float]] = {}
        for name, factors in flare.gain:
            r, g, b = (a * b for a, b in zip(gains.get(name, (1.0, 1.0, 1.0)), factors, strict=True))
            gains[name] = (r, g, b)
        settings = replace(flare.settings, gains=gains)
        if flare.quick:
            settings, flare = settings.quick(), replace(flare, width=min(flare.width, _QUICK_WIDTH))
        flare = replace(flare, settings=settings)
        flare._check()
        return flare

    def _check(self) -> None:
        """Refuse options that exclude each other and files that cannot be written; raises InputError."""
        if self.frames.frames is not None and self.out is None:
            self.refuse("--frames", f"({len(self.frames.frames)})", "-o beside it")
        by_chance, reflections = self.settings.photons or self.settings.glare, self.settings.most_reflections
        if not by_chance and reflections not in (FlareSettings.most_reflections, 2):
            self.refuse("--reflections", reflections, "2, or --photons or --glare beside it, which take more")
        if self.out is not None:
            Files.of(self.out)
        if self.path is not None:
            cli.check_written(Path(self.path[1]), "--path", "OUT.png")

    def assumed(self) -> Any:
        """Assume a light; and a small picture, where the command names no light, path, CSV or JSON."""
        found = super().assumed() | ({} if self.lights or self.image else {"light": ("--light", self._a_light)})
        if any((self.light, self.lights, self.image, self.path, self.csv, self.json, self.frames.frames)):
            del found["out"]
        elif self.out is None and self.width == type(self).width:
            found["quick"] = "--quick", lambda: (True, "")
        return found

    def _film(self) -> tuple[tuple[float, float], str]:
        """The film that the lens covers, with --image of its shape."""
        film = super()._film()
        return film if self.plate is None else cli.film_like(self.plate, *film)

    def _a_light(self) -> tuple[tuple[str], str]:
        """Return the sun where its image lies half-way from the film's centre to its right and its upper edge."""
        width, height = self.film or self._film()[0]
        efl_mm = first_order(set_lens(read_any(self.file), **self._size())).efl_mm
        right, up = (math.degrees(math.atan(share / float(efl_mm))) for share in (width / 4, height / 4))
        return (f"{right:.3g},{up:.3g}",), f"{right:.3g},{up:.3g}"

    def run(self) -> int:
        """Trace the ghosts, print their table, and write the picture."""
        progress, began = self.progress(), time.perf_counter()
        if self.quick:
            cells = f"{self.settings.bins} wavelengths, cells of {self.settings.cell_px:g}"
            progress.note(f"quick: {self.width} pixels wide, {cells}")
        states = list(self._states())
        shots = Shots(self, read_any(self.file), progress)
        first = shots.at(states[0])
        found = Flared(first.job.lens.name, len(ghost_pairs(first.job.lens)), first.metadata(), first)
        if self.path is not None:
            _draw(first.job, self.path[0], Path(self.path[1]))
            found = replace(found, path=self.path[1])
        if self.out is not None:
            previews = [state.picture.with_suffix(".png") for state in states]
            try:
                layers, exposure = self._write_all(states, shots, progress)
                outs = [state.picture for state in states]
                found = replace(found, out=outs, preview=previews, layers=layers, exposure=exposure)
            except KeyboardInterrupt as error:
                if self.frames.frames is not None:
                    error.add_note("the frames that are there are kept: the same command goes on")
                elif kept := [str(path) for path in kept_beside(self.out)]:
                    error.add_note(f"the same command goes on from {' and '.join(kept)}")
                raise
        return self.answer(replace(found, seconds=time.perf_counter() - began))

    def _states(self) -> Iterator[Flare]:
        """Yield the command with the settings of each frame."""
        for frame, digits, values in self.frames.states(vars(self.state.given), self.called):
            of_lens = {"focus_m": self.focus_m} | {k: v for k, v in values.items() if k in vars(self.state.given)}
            place = {name: value for name, value in values.items() if name not in of_lens}
            out = self.out and numbered(self.out, digits)
            yield replace(self, state=self.state.at(**of_lens), frame=frame, out=out, **place)

    def _write_all(self, states: list[Flare], shots: Shots, progress: Progress) -> tuple[tuple[str, ...], float]:
        """Write the picture, or those of the frames that are missing.

        Returns the names of the ghosts that are layers, and the exposure of the previews in stops.
        """
        single, exposure = tuple[str, ...](), self.exposure
        if most := self.settings.brightest:  # the same in all frames
            jobs = [shots.at(state).job for state in states[:: -(-len(states) // _GHOST_FRAMES)]]
            with progress.stage("brightest ghosts") as report:
                single = brightest(jobs, report)
            if len(single) < most:
                warn(f"layers of {len(single)} single ghosts, not {most}: no other leaves light on the film")
        if self.frames.frames is None:
            return single, _write(states[0], shots, single, exposure, progress) or 0.0
        with progress.stage(f"{len(states)} frames") as report:
            for done, state in enumerate(states, start=1):
                if self.restart or not state.picture.is_file():
                    exposure = _write(state, shots, single, exposure, Progress(quiet=True))
                elif exposure is None:  # the frames of all runs share it
                    exposure = read_metadata(state.picture).get("flare", {}).get("exposure")
                report(done / len(states))
        return single, exposure or 0.0


class Shot(NamedTuple):
    """The flare of one frame, and the ghosts of each of its lights, brightest first."""

    job: FlareJob
    ghosts: list[list[Ghost]]

    def metadata(self) -> dict[str, Any]:
        """The lights and their ghosts, for files and --json."""
        ghosts = [
            [
                {"name": g.pair.name, "energy": g.energy, "x_mm": g.centre_mm[0], "y_mm": g.centre_mm[1],
                 "size_mm": g.size_mm, "passed": g.passed}
                for g in of_light[:_KEPT]
            ]
            for of_light in self.ghosts
        ]  # fmt: skip
        return {"lights": [plain(light.about) for light in self.job.lights], "ghosts": ghosts}


class Shots:
    """The flare of each frame. Files are read once, and frames with the same focus, stop and zoom share the lens."""

    def __init__(self, command: Flare, tabled: Lens, progress: Progress) -> None:
        self._fixed = [_light(text) for text in command.light]
        self._tracks = [t for path in command.lights if path.suffix.lower() != ".toml" for t in read_lights(path)]
        scenes = [(path, load_scene(path)) for path in command.lights if path.suffix.lower() == ".toml"]
        self._scenes = [(path, scene, SceneLights(scene)) for path, scene in scenes]
        self._lens = cache(lambda state: set_lens(tabled, state.shot()))
        self._progress, self._fields = progress, dict[cli.LensState, Field]()
        self._last: tuple[Flare, Shot] | None = None

    def at(self, args: Flare) -> Shot:
        """The flare of the frame with these arguments."""
        if self._last is None or self._last[0] is not args:
            lens = require_film(self._lens(args.state))
            pose = FilmPose.of(args.state.shot(args.film).whole())
            warn_beyond(args.file, lens, pose)
            lights, tracer = self._lights(args, lens), GhostTracer(lens, pose=pose)
            raster = Raster(args.film, args.width, max(1, round(args.width * args.film[1] / args.film[0])))
            job = FlareJob(lens, lights, raster, args.settings, threads=args.threads, ghosts=tracer, pose=pose)
            rays = max(_FEWEST, RANKED // max(len(lights), 1))
            self._last = args, Shot(job, [ghost_table(tracer, light, 550.0, rays) for light in lights])
        return self._last[1]

    def reads(self, args: Flare) -> Iterator[Path]:
        """The files that a frame's lights and the shape of the stop come from, which no picture may overwrite."""
        yield from args.lights
        yield from (path.parent / name for path, scene, _ in self._scenes for name in files_named(scene.settings))
        yield from (path for path in (args.state.stop.aperture_mask, args.plate) if path is not None)

    def colour_space(self, args: Flare) -> ColourSpace:
        """The colour space of a frame's picture: that of --colour-space, of --image or of a scene, or else sRGB."""
        if args.colour_space is not None:
            return COLOUR_SPACES[args.colour_space]
        if args.plate is not None:
            return read_colour_space(args.plate) or SRGB
        return COLOUR_SPACES[self._scenes[0][1].settings.film.colour_space] if self._scenes else SRGB

    def _lights(self, args: Flare, lens: Lens) -> list[Light]:
        """The lights at a frame, where the lens and the camera of a scene are as `args` says."""
        at = "" if args.frame is None else f" at frame {args.frame}"
        of_lists = [track.at(args.frame or 0) for track in self._tracks]
        lights = [*self._fixed, *(light for light in of_lists if light is not None and any(light.rgb))]
        if behind := of_lists.count(None):
            warn(f"{behind} lights of lists stand behind the lens{at}")
        for path, scene, sources in self._scenes:
            found = sources.seen(seen_from(scene, path, args.position_m, args.look_at_m), lens.film_z_mm or 0.0)
            lights += _with_warning(keep(found, args.settings.most, fade=args.frame is not None), path)
        if args.plate is not None:
            lights += self._of_picture(args, args.plate)
        if not lights:
            warn(f"no light: the flare is black{at}")
        return lights

    def _of_picture(self, args: Flare, path: Path) -> list[Light]:
        picture, _ = read_exr(path)
        space = read_colour_space(path) or self.colour_space(args)
        if space is not SRGB:
            picture = converted(picture, conversion(space, SRGB)).astype(picture.dtype)
        shape = args.film[0] / args.film[1]
        if abs(picture.shape[1] / picture.shape[0] / shape - 1) > 1.01 / min(picture.shape[:2]):
            size = f"{picture.shape[1]} x {picture.shape[0]} pixels"
            raise InputError(path, "shape", f"({size})", "the film's, {:g}x{:g}".format(*args.film))
        try:
            fade = args.frame is not None and path != args.image
            regions = highlights(picture, self._field(args), args.film, args.threshold, args.settings.most, fade)
        except InputError as error:
            raise InputError(path, error.field, error.value, error.expected) from None
        return _with_warning(regions, path)

    def _field(self, args: Flare) -> Field:
        """The directions that the film sees, which frames of one state share."""
        if args.state not in self._fields:
            camera = make_camera(args.file, args.state.shot(args.film, runtime="onnxruntime"), self._progress)
            self._fields[args.state] = field_of(camera, args.focus_m, "equidistant")
        return self._fields[args.state]


def _with_warning(kept: KeptLights, path: Path) -> list[Light]:
    """The lights that are kept, after a warning about the energy of those that are not."""
    if kept.dropped > 0:
        warn(f"{path}: {len(kept.lights)} of {kept.of} lights; the others have {kept.dropped:.2%} of the energy")
    return kept.lights


def _light(text: str) -> Light:
    """The light of a --light option."""
    words = text.split(",")
    angles = in_unit("deg", cli.floats)(",".join(words[:2]))
    rgb = cli.floats(words[2], "/") if len(words) > 2 else [SUN]
    distance = in_unit("m", cli.floats)(words[3]) if len(words) > 3 else [math.inf]
    if len(angles) != 2 or len(words) > 4 or len(rgb) not in (1, 3) or not distance:
        raise InputError(_COMMAND, "--light", text, "AZ,EL[,E[,M]], numbers, E also as R/G/B")
    try:
        light = Light(angles[0], angles[1], (rgb[0], rgb[-2 % len(rgb)], rgb[-1]), distance[0])
        return with_disc(light, 0.0 if len(words) > 2 else 2 * math.degrees(SUN_RADIUS_RAD))
    except InputError as error:
        raise InputError(_COMMAND, "--light", text, error.expected) from None


def _write(
    args: Flare, shots: Shots, single: tuple[str, ...], exposure: float | None, progress: Progress
) -> float | None:
    """Write a picture and its preview; returns the exposure in stops, or None where it is free and all is dark."""
    files, shot, space = Files.of(args.picture), shots.at(args), shots.colour_space(args)
    files.spare(shots.reads(args))
    job = replace(shot.job, single=single, keep=args.out)
    layers = flare_layers(job, progress)
    total = in_gamut(sum_of(layers, job.raster))
    if args.frames.frames is None:  # frames have the same layers, dark ones too
        layers = {name: picture for name, picture in layers.items() if picture.any()}
    exposure = _exposure(total) if exposure is None else exposure
    options = {name.removeprefix("--"): value for name, value in changed(args).items()}
    about = {**shot.metadata(), "exposure": exposure, "settings": options | asdict(args.settings)}
    metadata = plain({"neurolens": __version__, "colour": space.stated, "flare": about})
    camera = placed_settings(job.lens, args.film, args.focus_m)
    header = standard_attributes(camera, job.raster.width, job.raster.height, args.frame)
    write_png(files.preview, total, exposure or 0.0)  # first: a frame whose EXR exists is kept
    channels = flare_channels(layers, space)
    rgb = {c: sum((channels[f"{name}.{c}"] for name in LAYERS if name in layers), 0 * total[..., 0]) for c in "RGB"}
    write_channels(args.picture, rgb | channels, space, metadata, header)
    for path in kept_beside(args.picture):
        path.unlink()
    return exposure


def _exposure(picture: FloatArray) -> float | None:
    """Return the stops that take the 99% quantile of a picture's lit pixels to 0.8; None where none is lit."""
    bright = picture.max(-1)
    lit = bright[bright > 0]
    return round(math.log2(_SHOWN_AT / float(np.quantile(lit, _QUANTILE))), 2) if len(lit) else None


def _draw(job: FlareJob, name: str, out: Path) -> None:
    """Draw the rays of one ghost of the first light."""
    pairs = ghost_pairs(job.lens)
    pair = next((p for p in pairs if p.name == name), None)
    if pair is None or not job.lights:
        expected = f"a ghost of this lens, as {pairs[0].name}, and a light" if pairs else "a lens with ghosts"
        raise InputError(_COMMAND, "--path", name, expected)
    lens_layout(ghost_layout(job.lens, pair, job.lights[0]), out)


@dataclass(frozen=True)
class Flared(Report):
    """The ghosts of the first frame, and the pictures of all frames.

    Attributes:
        pairs: how many pairs of surfaces reflect.
        metadata: the lights and their brightest ghosts. shot: all ghosts.
        path: the drawing of one ghost.
        layers: the names of the ghosts that are layers. exposure: of the previews, in stops.
    """

    lens: str
    pairs: int
    metadata: Mapping[str, Any] = field(metadata=PART)
    shot: Shot = field(metadata=BULK)
    path: str | None = field(default=None, metadata=OPTIONAL)
    out: Sequence[Path] | None = field(default=None, metadata=OPTIONAL)
    preview: Sequence[Path] | None = field(default=None, metadata=OPTIONAL)
    layers: Sequence[str] | None = field(default=None, metadata=OPTIONAL)
    exposure: float | None = field(default=None, metadata=OPTIONAL)
    seconds: float = 0.0

    def text(self) -> str:
        """Return a table of each light's ghosts, and the files."""
        lines = [f"{self.lens}: {self.pairs} pairs of surfaces", *_ghost_tables(self.shot)]
        if self.layers:
            lines.append(f"layers of the ghosts with the greatest values on the film: {', '.join(self.layers)}")
        spans = [f"{f[0]} to {f[-1]}" if len(f) > 1 else str(f[0]) for f in (self.out, self.preview) if f]
        end = f"{spans[0]}, and the preview {spans[1]} at {self.exposure:+g} stops" if spans else "done"
        return "\n\n".join([*lines, f"{end}: {self.seconds:.1f} s"])


def _ghost_tables(shot: Shot) -> list[str]:
    lines = list[str]()
    head = ("ghost", "energy of the image's", "x mm", "y mm", "RMS radius mm", "rays that arrive %")
    lights = shot.job.lights
    for light, ghosts in zip(lights[:_SHOWN_LIGHTS], shot.ghosts, strict=False):
        energy = sum(ghost.energy for ghost in ghosts)
        lines.append(
            f"light at {light.azimuth_deg:g}, {light.elevation_deg:g} deg: {len(ghosts)} ghosts reach the film's "
            f"plane, with {cli.number(100 * energy)}% of the image's light; the brightest at 550 nm:"
        )
        figures = [(g.energy, *g.centre_mm, g.size_mm, 100 * g.passed) for g in ghosts[:_SHOWN]]
        rows = [[g.pair.name, *map(cli.number, row)] for g, row in zip(ghosts, figures, strict=False)]
        lines.append(cli.table(head, rows))
    if more := len(lights[_SHOWN_LIGHTS:]):
        lines.append(f"and {more} more lights")
    return lines
