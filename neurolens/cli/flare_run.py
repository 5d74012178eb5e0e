"""What `neurolens flare` does: lights and lenses of all frames, pictures of their ghosts, and tables."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from neurolens import __version__
from neurolens.analysis.layout import lens_layout
from neurolens.base.errors import InputError, warn
from neurolens.base.progress import Progress
from neurolens.base.records import plain
from neurolens.base.settings import changed
from neurolens.cameras.build import make_camera
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.exact import placed_settings
from neurolens.cameras.field import Field, field_of
from neurolens.cli.arguments import floats
from neurolens.cli.keys import frames_of
from neurolens.cli.output import number, table
from neurolens.flare.canvas import Raster
from neurolens.flare.ghosts import RANKED, Ghost, GhostTracer, ghost_layout, ghost_pairs, ghost_table
from neurolens.flare.layers import brightest, flare_layers, kept_beside, sum_of, with_coating
from neurolens.flare.lights import SUN, KeptLights, Light, SceneLights, highlights, keep, read_lights, with_disc
from neurolens.flare.picture import FlareJob
from neurolens.frames.frame import Files, flare_channels
from neurolens.lens.prescription import Lens
from neurolens.readers.any_format import read_any
from neurolens.render.colour import COLOUR_SPACES, SRGB, ColourSpace, conversion, converted
from neurolens.render.lights import SUN_RADIUS_RAD
from neurolens.render.pictures import (
    read_colour_space,
    read_exr,
    read_metadata,
    standard_attributes,
    write_exr,
    write_png,
)
from neurolens.render.scene import Scene, files_named, load_scene, seen_from

if TYPE_CHECKING:
    from neurolens.cli.flare import Flare

_COMMAND = "neurolens flare"
_SHOWN, _SHOWN_LIGHTS, _KEPT = 12, 4, 64  # ghosts of a table; tables; ghosts of a light in metadata
_FEWEST = 256  # rays behind a table
_GHOST_FRAMES = 16  # at most, which decide which ghosts are the brightest
_QUANTILE, _SHOWN_AT = 0.99, 0.8  # the preview's exposure takes this quantile of the lit pixels to this value


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


def run_flare(args: Flare) -> int:
    """Trace the ghosts, print their table, and write the picture."""
    progress, began = Progress(quiet=args.quiet or args.json), time.perf_counter()
    if args.quick:
        settings = args.settings
        progress.note(f"quick: {args.width} pixels wide, {settings.bins} wavelengths, cells of {settings.cell_px:g}")
    states = list(_states(args))
    shots = Shots(args, read_any(args.file), progress)
    first = shots.at(states[0])
    results = {"lens": first.job.lens.name, "pairs": len(ghost_pairs(first.job.lens)), **first.metadata()}
    if args.path is not None:
        _draw(first.job, args.path[0], Path(args.path[1]))
        results["path"] = args.path[1]
    if args.out is not None:
        results["out"] = [str(state.out) for state in states]
        results["preview"] = [str(state.picture.with_suffix(".png")) for state in states]
        try:
            results |= _write_all(states, shots, progress)
        except KeyboardInterrupt as error:
            if args.frames.frames is not None:
                error.add_note("the frames that are there are kept: the same command goes on")
            elif kept := [str(path) for path in kept_beside(args.out)]:
                error.add_note(f"the same command goes on from {' and '.join(kept)}")
            raise
    results["seconds"] = time.perf_counter() - began
    return args.answer(results, lambda: _text(first, results))


def _states(flare: Flare) -> Iterator[Flare]:
    """The command with the settings of each frame."""
    state = replace(flare.state, focus_m=flare.focus_m)
    if flare.frames.frames is None:
        yield replace(flare, state=state)
        return
    for frame, digits, values in frames_of(flare.frames.frames, flare.frames.key, vars(flare.state), _COMMAND):
        of_lens = {name: value for name, value in values.items() if name in vars(state)}
        place = {name: value for name, value in values.items() if name not in of_lens}
        out = flare.picture.with_name(f"{flare.picture.stem}.{digits}{flare.picture.suffix}")
        yield replace(flare, state=replace(state, **of_lens), frame=frame, out=out, **place)


class Shots:
    """The flare of each frame. Files are read once, and frames with the same focus, stop and zoom share the lens."""

    def __init__(self, args: Flare, tabled: Lens, progress: Progress) -> None:
        if not (args.light or args.lights or args.image):
            raise InputError(_COMMAND, "--light", "(missing)", "--light, --lights or --image")
        self._tabled, self._progress = tabled, progress
        self._fixed = [_light(text) for text in args.light]
        self._tracks = [t for path in args.lights if path.suffix.lower() != ".toml" for t in read_lights(path)]
        scenes = [(path, load_scene(path)) for path in args.lights if path.suffix.lower() == ".toml"]
        self._scenes: list[tuple[Path, Scene, SceneLights]] = [(p, scene, SceneLights(scene)) for p, scene in scenes]
        self._fields: dict[tuple[Any, ...], Field] = {}
        self._lenses: dict[tuple[Any, ...], Lens] = {}
        self._last: tuple[Flare, Shot] | None = None

    def at(self, args: Flare) -> Shot:
        """The flare of the frame with these arguments."""
        if self._last is None or self._last[0] is not args:
            lens = self._lens(args)
            lights, tracer = self._lights(args, lens), GhostTracer(lens)
            raster = Raster(args.film, args.width, max(1, round(args.width * args.film[1] / args.film[0])))
            job = FlareJob(lens, lights, raster, args.settings, threads=args.threads, ghosts=tracer)
            rays = max(_FEWEST, RANKED // max(len(lights), 1))
            self._last = args, Shot(job, [ghost_table(tracer, light, 550.0, rays) for light in lights])
        return self._last[1]

    def reads(self, args: Flare) -> Iterator[Path]:
        """The files that a frame's lights and the shape of the stop come from, which no picture may overwrite."""
        yield from args.lights
        yield from (path.parent / name for path, scene, _ in self._scenes for name in files_named(scene.settings))
        yield from (path for path in (args.state.stop.aperture_mask, _plate(args)) if path is not None)

    def colour_space(self, args: Flare) -> ColourSpace:
        """The colour space of a frame's picture: that of --colour-space, of --image or of a scene, or else sRGB."""
        if args.colour_space is not None:
            return COLOUR_SPACES[args.colour_space]
        if (plate := _plate(args)) is not None:
            return read_colour_space(plate) or SRGB
        return COLOUR_SPACES[self._scenes[0][1].settings.film.colour_space] if self._scenes else SRGB

    def _lens(self, args: Flare) -> Lens:
        """The lens in its state, coated."""
        state = args.state.focus_m, args.state.f_number, args.state.zoom
        if state not in self._lenses:
            self._lenses[state] = with_coating(args.state.set_lens(self._tabled), args.settings)
        return self._lenses[state]

    def _lights(self, args: Flare, lens: Lens) -> list[Light]:
        """The lights at a frame, where the lens and the camera of a scene are as `args` says."""
        at = "" if args.frame is None else f" at frame {args.frame}"
        of_lists = [track.at(args.frame or 0) for track in self._tracks]
        lights = [*self._fixed, *(light for light in of_lists if light is not None and any(light.rgb))]
        if behind := of_lists.count(None):
            warn(f"{behind} lights of lists stand behind the lens{at}")
        for path, scene, sources in self._scenes:
            camera = seen_from(scene, path, args.position_m, args.look_at_m)
            found = sources.seen(camera, lens.film_z_mm or 0.0)
            lights += _with_warning(keep(found, args.settings.most, fade=args.frame is not None), path)
        if (plate := _plate(args)) is not None:
            lights += self._of_picture(args, plate, lens)
        if not lights:
            warn(f"no light: the flare is black{at}")
        return lights

    def _of_picture(self, args: Flare, path: Path, lens: Lens) -> list[Light]:
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
        state = args.state.focus_m, args.state.f_number, args.state.zoom
        if state not in self._fields:
            camera = make_camera(args.file, args.state.shot(args.film), self._progress)
            self._fields[state] = field_of(camera, args.focus_m, "equidistant")
        return self._fields[state]


def _with_warning(kept: KeptLights, path: Path) -> list[Light]:
    """The lights that are kept, after a warning about the energy of those that are not."""
    if kept.dropped > 0:
        warn(f"{path}: {len(kept.lights)} of {kept.of} lights; the others have {kept.dropped:.2%} of the energy")
    return kept.lights


def _plate(args: Flare) -> Path | None:
    """The file of --image at a frame."""
    if args.image is None:
        return None
    return Path(re.sub("#+", lambda digits: f"{args.frame or 0:0{len(digits[0])}d}", str(args.image)))


def _light(text: str) -> Light:
    """The light of a --light option."""
    words = text.split(",")
    angles, rgb = floats(",".join(words[:2])), floats(words[2], "/") if len(words) > 2 else [SUN]
    distance = floats(words[3]) if len(words) > 3 else [math.inf]
    if len(angles) != 2 or len(words) > 4 or len(rgb) not in (1, 3) or not distance:
        raise InputError(_COMMAND, "--light", text, "AZ,EL[,E[,M]], numbers, E also as R/G/B")
    try:
        light = Light(angles[0], angles[1], (rgb[0], rgb[-2 % len(rgb)], rgb[-1]), distance[0])
        return with_disc(light, 0.0 if len(words) > 2 else 2 * math.degrees(SUN_RADIUS_RAD))
    except InputError as error:
        raise InputError(_COMMAND, "--light", text, error.expected) from None


def _write_all(states: list[Flare], shots: Shots, progress: Progress) -> dict[str, Any]:
    """Write the picture, or those of the frames that are missing.

    Returns the names of the ghosts that are layers, and the exposure of the previews in stops.
    """
    args, single, exposure = states[0], tuple[str, ...](), states[0].exposure
    if most := args.settings.brightest:  # the same in all frames
        jobs = [shots.at(state).job for state in states[:: -(-len(states) // _GHOST_FRAMES)]]
        with progress.stage("brightest ghosts") as report:
            single = brightest(jobs, report)
        if len(single) < most:
            warn(f"layers of {len(single)} single ghosts, not {most}: no other leaves light on the film")
    if args.frames.frames is None:
        exposure = _write(args, shots, single, exposure, progress)
        return {"layers": single, "exposure": exposure or 0.0}
    with progress.stage(f"{len(states)} frames") as report:
        for done, state in enumerate(states, start=1):
            if args.restart or not state.picture.is_file():
                exposure = _write(state, shots, single, exposure, Progress(quiet=True))
            elif exposure is None:  # the frames of all runs share it
                exposure = read_metadata(state.picture).get("flare", {}).get("exposure")
            report(done / len(states))
    return {"layers": single, "exposure": exposure or 0.0}


def _write(
    args: Flare, shots: Shots, single: tuple[str, ...], exposure: float | None, progress: Progress
) -> float | None:
    """Write a picture and its preview; returns the exposure in stops, or None where it is free and all is dark."""
    files, shot, space = Files.of(args.picture), shots.at(args), shots.colour_space(args)
    files.spare(shots.reads(args))
    job = replace(shot.job, single=single, keep=args.out)
    layers = flare_layers(job, progress)
    total = sum_of(layers, job.raster)
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
    write_exr(args.picture, total, metadata=metadata, space=space, layers=channels, attributes=header)
    for path in kept_beside(args.picture):
        path.unlink()
    return exposure


def _exposure(picture: FloatArray) -> float | None:
    """Stops that take the 99% quantile of the lit pixels of a picture [H, W, 3] to 0.8; None where none is lit."""
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


def _text(shot: Shot, results: dict[str, Any]) -> str:
    lines = [f"{results['lens']}: {results['pairs']} pairs of surfaces"]
    head = ("ghost", "energy of the image's", "x mm", "y mm", "RMS radius mm", "rays that arrive %")
    lights = shot.job.lights
    for light, ghosts in zip(lights[:_SHOWN_LIGHTS], shot.ghosts, strict=False):
        energy = sum(ghost.energy for ghost in ghosts)
        lines.append(
            f"light at {light.azimuth_deg:g}, {light.elevation_deg:g} deg: {len(ghosts)} ghosts reach the film's "
            f"plane, with {number(100 * energy)}% of the image's light; the brightest at 550 nm:"
        )
        cells = [
            [g.pair.name, number(g.energy), *map(number, g.centre_mm), number(g.size_mm), number(100 * g.passed)]
            for g in ghosts[:_SHOWN]
        ]
        lines.append(table(head, cells))
    if more := len(lights[_SHOWN_LIGHTS:]):
        lines.append(f"and {more} more lights")
    if results.get("layers"):
        lines.append(f"layers of the ghosts with the greatest values on the film: {', '.join(results['layers'])}")
    files = [results[key] for key in ("out", "preview") if key in results]
    spans = [f"{names[0]} to {names[-1]}" if len(names) > 1 else names[0] for names in files]
    end = f"{spans[0]}, and the preview {spans[1]} at {results['exposure']:+g} stops" if spans else "done"
    return "\n\n".join([*lines, f"{end}: {results['seconds']:.1f} s"])
