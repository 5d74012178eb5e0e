"""`neurolens flare LENS --light AZ,EL ...`: the ghosts of lights as a table and as a picture with layers."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from neurolens import __version__
from neurolens.base.errors import InputError, warn
from neurolens.base.options import add_options, from_options
from neurolens.base.progress import Progress
from neurolens.base.records import plain
from neurolens.cli.arguments import (
    add_exposure,
    add_json,
    add_lens,
    add_lens_state,
    add_option,
    add_output,
    check_suffix,
    state_of,
    whole,
)
from neurolens.cli.flare_fit import add_fit, check_fit, fitted, run_fit, stopped
from neurolens.cli.flare_lights import add_lights
from neurolens.cli.output import answer, number, table
from neurolens.cli.render import film_size
from neurolens.cli.render_frames import add_frames, frames_of
from neurolens.render.film_settings import FilmSettings
from neurolens.render.flaresettings import FlareSettings

if TYPE_CHECKING:
    from neurolens.cameras.contract import FloatArray
    from neurolens.cli.flare_lights import Sources
    from neurolens.flare.ghostmodel import GhostModel
    from neurolens.flare.ghosts import Ghost
    from neurolens.flare.layers import FlareJob
    from neurolens.lens.prescription import Lens

_DESCRIPTION = """\
Trace all ghosts of a lens exactly: light that two of its surfaces reflect on its way to the film, with
the reflectance of Fresnel's equations or of the coatings, all rims, the shape of the stop, and the
spectrum. The command prints the brightest ghosts with their energy, position and size. Positions are
on the film itself, which pictures show turned by 180 degrees: a light to the right is imaged at x < 0.

With -o the ghosts are written as an OpenEXR picture that can be added to a render of the same lens,
film and focus: R, G and B are the sum of the layers (ghosts.R, .G, .B, and so on). The --layers ghosts
with the greatest values on the film become layers of their own (g07-03 is reflected at surface 7, then
at surface 3, counted from 0 at the front), and the layer "rest" has the others. A PNG preview beside
the EXR shows the flare, brighter by --exposure. Values are those of `neurolens render`: a white card of
radiance 1 is 1 on the axis.

Each surface divides light by the mean of both polarisations. If polarisation were followed from surface
to surface, the light of all ghosts would change by -2 to +12% in three lenses tried, and that of single
bright ghosts by -22 to +48%, most in coated lenses. Edges of ghosts are as rays draw them, without the
rings of diffraction, which no option adds.

With --photons light goes on by chance instead, with any number of reflections, smoothed by a kernel.
With --glare, or if anything scatters, photons of the same kind make the layer "glare": light that is
reflected more than twice or scatters, so that ghosts and glare together are all the light. With
--starburst the layer "starburst" has the light that diffraction sends aside, by the shape of the
opening as each light sees it: the streaks of blades. It is 0 at the image of the light itself, which a
render has. Needs the extra "train" (torch) and a C compiler."""
_EPILOG = """\
examples:
  neurolens flare laikin_double_gauss_50 --light 15,8 --path g08-06 path.png
  neurolens flare laikin_double_gauss_50 --light 15,8 --coating quarter-wave --blades 6 --f-number 8 -o flare.exr
  neurolens flare lenses/ogawa_zoom_70_200.toml --zoom 100 --light -12,3,3/2.5/1.5 --layers 8 -o flare.exr
  neurolens flare laikin_double_gauss_50 --light 15,8 --coating multi-layer --barrel 0.05 --dust 0.01 -o flare.exr
  neurolens flare laikin_double_gauss_50 --light 15,8 --blades 7 --f-number 11 --starburst -o flare.exr
  neurolens flare laikin_double_gauss_50 --lights sun.csv --frames 1:48 --key camera.csv -o flare.exr
  neurolens flare laikin_double_gauss_50 --fit ghosts.onnx; neurolens flare ghosts.onnx --light 15,8 -o flare.exr"""
_COMMAND = "neurolens flare"
_SHOWN, _SHOWN_LIGHTS, _KEPT = 12, 4, 64  # ghosts of a table; tables; ghosts of a light in metadata
_FEWEST = 256  # rays behind a table
_QUICK_WIDTH = 480  # at most
_RANKED_FRAMES = 16  # at most; they decide which ghosts are the brightest
_QUANTILE, _SHOWN_AT = 0.99, 0.8  # the preview's exposure takes this quantile of the lit pixels to this value
_FRAMES = (
    "flare of these frames to OUT.0001.exr and so on, of lights by their keys in lists, the lens, and the camera of a "
    "scene of --lights by --key; a frame that exists is kept. Fitted ghosts keep their focus and zoom"
)


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "flare", help="ghosts of lights: a table, and a picture with layers", description=_DESCRIPTION, epilog=_EPILOG
    )
    add_lens(parser, "file", "; a model is one of fitted ghosts", models=True)
    add_lights(parser)
    add_options(parser, FlareSettings, ["coating"])
    add_output(parser, "OUT.exr", "picture to write; the preview is OUT.png (default: only the table)")
    parser.add_argument(
        "--path",
        metavar=("GHOST", "OUT"),
        nargs=2,
        help="draw the rays of one ghost of the first light (PNG, PDF, SVG)",
    )
    _add_picture(parser)
    add_fit(parser)
    add_frames(parser, _FRAMES)
    parser.add_argument("--restart", action="store_true", help="of --frames: make those that exist again")
    add_lens_state(parser, efl="as tabled", f_number="the widest")
    add_json(parser, quiet=True)
    parser.set_defaults(run=run, kept="nothing is written", position_m=None, look_at_m=None, frame=None)


def _add_picture(parser: argparse.ArgumentParser) -> None:
    """Add what the picture is, and the settings of its flare."""
    group = parser.add_argument_group("picture")
    group.add_argument("--film", metavar="WxH", type=film_size, default=(36.0, 24.0), help="in mm (default: 36x24)")
    group.add_argument(
        "--width", metavar="PIXELS", type=whole(1, 16384), default=960, help="of the picture (default: 960)"
    )
    add_options(group, FlareSettings, ["cell_px", "bins"])
    add_exposure(group, None, "99% of the lit pixels become no brighter than 0.8; frames share one value")
    (space,) = add_options(group, FilmSettings, ["colour_space"], unset=True)
    space.help = f"{space.help}; default: that of --image, else of a scene's [film] table, else sRGB"
    add_option(
        group, "--quick", old=("--preview",), action="store_true",
        help="at most 480 pixels wide, 5 wavelengths and 65536 photons a light and wavelength, --cell at least 24",
    )  # fmt: skip
    group = parser.add_argument_group("layers")
    add_options(group, FlareSettings, ["brightest", "without", "starburst"])
    gain = group.add_argument(
        "--gain", metavar="NAME=X", action="append", default=[], dest="gains", type=_gain,
        help="factor of a layer (ghosts) or a ghost (g07-03), or one for each colour, NAME=R/G/B; repeatable, gains "
        "multiply",
    )  # fmt: skip
    parser._option_string_actions["--tint"] = gain
    group = parser.add_argument_group("photons, and what scatters them")
    names = ("photons", "most_reflections", "kernel_px", "glare", "barrel", "sensor", "dust", "haze_per_mm", "seed")
    add_options(group, FlareSettings, names, most_reflections=None)
    parser.add_argument("--threads", metavar="N", type=whole(1, 256), default=2, help="default: 2")


def _gain(text: str) -> tuple[str, list[float]]:
    """Type of --gain: a name, and factors of red, green and blue."""
    name, _, rest = text.partition("=")
    try:
        found = [float(word) for word in rest.split("/")]
    except ValueError:
        found = []
    if len(found) not in (1, 3) or not all(0 <= v < math.inf for v in found):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected NAME=X or NAME=R/G/B, of at least 0")
    return name, found * (3 // len(found))


def _settings(args: argparse.Namespace) -> FlareSettings:
    """The settings of the arguments, those of a quick look where it is one."""
    gains: dict[str, tuple[float, float, float]] = {}
    for name, factors in args.gains:
        r, g, b = (a * b for a, b in zip(gains.get(name, (1.0, 1.0, 1.0)), factors, strict=True))
        gains[name] = (r, g, b)
    settings = replace(from_options(FlareSettings(), args), gains=gains)
    return settings.quick() if args.quick else settings


def run(args: argparse.Namespace) -> int:
    """Trace the ghosts, print their table, and write the picture."""
    from neurolens.cli.flare_lights import Sources
    from neurolens.flare.ghosts import ghost_pairs
    from neurolens.flare.layers import kept_beside
    from neurolens.readers.any_format import read_any

    _check(args)
    settings = args.settings = _settings(args)
    progress, began = Progress(quiet=args.quiet or args.json), time.perf_counter()
    if args.quick:
        args.width = min(args.width, _QUICK_WIDTH)
        progress.note(f"quick: {args.width} pixels wide, {settings.bins} wavelengths, cells of {settings.cell_px:g}")
    states = list(_states(args))
    model = fitted(args, states)
    tabled = read_any(args.file) if model is None else model.lens
    if args.fit is not None:
        return run_fit(args, None if model else _lens(states[0], tabled), model)
    shots = _Shots(tabled, Sources(args, () if args.frames is None else states), progress, model)
    first = shots.at(states[0])
    results = {"lens": first.job.lens.name, "pairs": len(ghost_pairs(first.job.lens)), **first.metadata()}
    results["fitted"] = 0 if model is None else len(model.pairs)
    if args.path is not None:
        _draw(first.job, args.path[0], Path(args.path[1]))
        results["path"] = args.path[1]
    if args.out is not None:
        results["out"] = [str(state.out) for state in states]
        results["preview"] = [str(state.out.with_suffix(".png")) for state in states]
        try:
            results |= _write_all(states, shots, progress)
        except KeyboardInterrupt:
            if args.frames is None and (kept := [str(path) for path in kept_beside(args.out)]):
                args.kept = f"the same command goes on from {' and '.join(kept)}"
            raise
    results["seconds"] = time.perf_counter() - began
    return answer(args, results, lambda: _text(first, results))


def _check(args: argparse.Namespace) -> None:
    """Refuse options that exclude each other and files that cannot be written; raises InputError."""
    check_fit(args)
    if args.frames is None and args.key:
        raise InputError(_COMMAND, "--key", args.key[0], "--frames beside it")
    if args.frames is not None:
        if args.out is None:
            raise InputError(_COMMAND, "--frames", f"({len(args.frames)})", "-o beside it")
        args.kept = "the frames that are there are kept: the same command goes on"
    by_chance = args.photons or args.glare or args.barrel or args.sensor or args.dust or args.haze_per_mm
    if not by_chance and args.reflections not in (None, 2):
        expected = "2, or --photons or --glare beside it, whose light is reflected more often"
        raise InputError(_COMMAND, "--reflections", args.reflections, expected)
    if args.photons and args.layers:
        expected = "no --photons beside it: they tell no single ghosts apart"
        raise InputError(_COMMAND, "--layers", args.layers, expected)
    if args.out is not None:
        from neurolens.frames.frame import Files

        Files.of(args.out)
    if args.path is not None:
        check_suffix(Path(args.path[1]), "--path", (".png", ".pdf", ".svg"))


def _states(args: argparse.Namespace) -> Iterator[argparse.Namespace]:
    """The arguments of each frame."""
    frames = [(None, "", {})] if args.frames is None else frames_of(args, _COMMAND)
    for frame, digits, values in frames:
        state = argparse.Namespace(**vars(args) | values | {"frame": frame})
        state.focus = math.inf if state.focus is None else state.focus
        if frame is not None:
            state.out = args.out.with_name(f"{args.out.stem}.{digits}{args.out.suffix}")
        yield state


class _Shot(NamedTuple):
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


class _Shots:
    """The flare of each frame. Frames with the same focus, stop and zoom share the lens."""

    def __init__(self, tabled: Lens, sources: Sources, progress: Progress, model: GhostModel | None) -> None:
        self._tabled, self.sources, self._progress, self._model = tabled, sources, progress, model
        self._lenses: dict[tuple[Any, ...], tuple[Lens, GhostModel | None]] = {}
        self._last: tuple[argparse.Namespace, _Shot] | None = None

    def at(self, args: argparse.Namespace) -> _Shot:
        """The flare of the frame with these arguments."""
        if self._last is None or self._last[0] is not args:
            self._last = args, self._make(args)
        return self._last[1]

    def _make(self, args: argparse.Namespace) -> _Shot:
        from neurolens.flare.canvas import Raster
        from neurolens.flare.ghosts import RANKED, GhostTracer, ghost_table
        from neurolens.flare.layers import FlareJob

        state = args.focus, args.f_number, args.zoom
        if state not in self._lenses:
            model = None if self._model is None else stopped(args, self._model)
            self._lenses[state] = _lens(args, self._tabled) if model is None else model.lens, model
        lens, model = self._lenses[state]
        lights, tracer = self.sources.at(args, lens, self._progress), model or GhostTracer(lens)
        raster = Raster(args.film, args.width, max(1, round(args.width * args.film[1] / args.film[0])))
        job = FlareJob(lens, lights, raster, args.settings, threads=args.threads, ghosts=tracer)
        rays = max(_FEWEST, RANKED // max(len(lights), 1))
        return _Shot(job, [ghost_table(tracer, light, 550.0, rays) for light in lights])


def _lens(args: argparse.Namespace, tabled: Lens) -> Lens:
    """The lens of a file in its state, coated."""
    from neurolens.flare.layers import with_coating

    return with_coating(state_of(args, tabled), args.settings)


def _write_all(states: list[argparse.Namespace], shots: _Shots, progress: Progress) -> dict[str, Any]:
    """Write the picture, or those of the frames that are missing.

    Returns the names of the ghosts that are layers, and the exposure of the previews in stops.
    """
    from neurolens.flare.layers import brightest
    from neurolens.render.pictures import read_metadata

    args, single, exposure = states[0], tuple[str, ...](), states[0].exposure
    if args.layers:  # the same in all frames
        jobs = [shots.at(state).job for state in states[:: -(-len(states) // _RANKED_FRAMES)]]
        with progress.stage("brightest ghosts") as report:
            single = brightest(jobs, report)
        if len(single) < args.layers:
            warn(f"layers of {len(single)} single ghosts, not {args.layers}: no other leaves light on the film")
    if args.frames is None:
        exposure = _write(args, shots, single, exposure, progress)
        return {"layers": single, "exposure": exposure or 0.0}
    with progress.stage(f"{len(states)} frames") as report:
        for number, state in enumerate(states):
            if args.restart or not state.out.is_file():
                exposure = _write(state, shots, single, exposure, Progress(quiet=True))
            elif exposure is None:  # the frames of all runs share it
                exposure = read_metadata(state.out).get("flare", {}).get("exposure")
            report((number + 1) / len(states))
    return {"layers": single, "exposure": exposure or 0.0}


def _write(
    args: argparse.Namespace, shots: _Shots, single: tuple[str, ...], exposure: float | None, progress: Progress
) -> float | None:
    """Write a picture and its preview; returns the exposure in stops, or None where it is free and all is dark."""
    from neurolens.cameras.exact import placed_settings
    from neurolens.flare.layers import flare_layers, kept_beside, sum_of
    from neurolens.frames.frame import Files
    from neurolens.frames.picture import flare_channels
    from neurolens.render.exr_attributes import standard_attributes
    from neurolens.render.pictures import write_exr, write_png

    files, shot, space = Files.of(args.out), shots.at(args), shots.sources.colour_space(args)
    files.spare(shots.sources.reads(args))
    job = replace(shot.job, single=single, keep=args.out)
    layers = flare_layers(job, progress)
    total = sum_of(layers, job.raster)
    if args.frames is None:  # frames have the same layers, dark ones too
        layers = {name: picture for name, picture in layers.items() if picture.any()}
    exposure = _exposure(total) if exposure is None else exposure
    options = {k: v for k, v in vars(args).items() if isinstance(v, str | int | float | list | tuple | None)}
    about = {**shot.metadata(), "exposure": exposure, "settings": options | asdict(args.settings)}
    metadata = plain({"neurolens": __version__, "colour": space.stated, "flare": about})
    camera = placed_settings(job.lens, args.film, args.focus)
    header = standard_attributes(camera, job.raster.width, job.raster.height, args.frame)
    channels = flare_channels(layers, space)
    write_png(files.preview, total, exposure or 0.0)  # first: a frame whose EXR exists is kept
    write_exr(args.out, total, metadata=metadata, space=space, layers=channels, attributes=header)
    for path in kept_beside(args.out):
        path.unlink()
    return exposure


def _exposure(picture: FloatArray) -> float | None:
    """Stops that take the 99% quantile of the lit pixels of a picture [H, W, 3] to 0.8; None where none is lit."""
    import numpy as np

    bright = picture.max(-1)
    lit = bright[bright > 0]
    return round(math.log2(_SHOWN_AT / float(np.quantile(lit, _QUANTILE))), 2) if len(lit) else None


def _draw(job: FlareJob, name: str, out: Path) -> None:
    """Draw the rays of one ghost of the first light."""
    from neurolens.analysis.layout import lens_layout
    from neurolens.flare.ghosts import ghost_layout, ghost_pairs

    pairs = ghost_pairs(job.lens)
    pair = next((p for p in pairs if p.name == name), None)
    if pair is None or not job.lights:
        expected = f"a ghost of this lens, as {pairs[0].name}, and a light" if pairs else "a lens with ghosts"
        raise InputError(_COMMAND, "--path", name, expected)
    lens_layout(ghost_layout(job.lens, pair, job.lights[0]), out)


def _text(shot: _Shot, results: dict[str, Any]) -> str:
    lines = [f"{results['lens']}: {results['pairs']} pairs of surfaces"]
    if results["fitted"]:
        lines[0] += f", {results['fitted']} ghosts of them fitted: the table is of the fit"
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
