"""The lights of `neurolens flare`: options, lists over frames, the lights of a scene, and highlights of a picture."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens.base.errors import InputError, warn
from neurolens.base.lensname import is_model
from neurolens.base.options import add_options
from neurolens.base.progress import Progress
from neurolens.cli.arguments import aperture_of, positive
from neurolens.render.flaresettings import FlareSettings

if TYPE_CHECKING:
    from neurolens.cameras.field import Field
    from neurolens.flare.lights import Light
    from neurolens.flare.sources import Kept, Name, SceneLights
    from neurolens.lens.prescription import Lens
    from neurolens.render.colour import ColourSpace
    from neurolens.render.scene import Scene

_COMMAND = "neurolens flare"
_RANKED_FRAMES = 64  # at most; they decide which lights of a scene have the most energy


def add_lights(parser: argparse.ArgumentParser) -> None:
    """Add --light, --lights and --image."""
    group = parser.add_argument_group("lights, at least one; all of them together")
    group.add_argument(
        "--light", metavar="AZ,EL[,E[,M]]", action="append", default=[], dest="light",
        help="degrees to the right of and above the axis, as the camera sees it; irradiance at the lens, radiance "
        "times solid angle in sr, as a number or R/G/B, of a point (default: the sun's disc with pi, which lights a "
        "white card to radiance 1); and distance in metres (default: inf); repeatable",
    )  # fmt: skip
    group.add_argument(
        "--lights", metavar="FILE", type=Path, action="append", default=[],
        help="a scene (.toml), whose shapes that shine, points, spots and sun the camera of the scene sees; or a list, "
        "CSV or JSON, with azimuth_deg, elevation_deg, and where wanted light (a name), frame (keys), r, g, b, "
        "diameter_deg (of a disc; the sun has 0.53), distance_m; repeatable",
    )  # fmt: skip
    group.add_argument(
        "--image", metavar="PLATE.exr", type=Path,
        help="connected regions of this picture by the same lens, film and focus that reach --threshold, as lights far "
        "away; # in its name stands for the frame's digits",
    )  # fmt: skip
    group.add_argument(
        "--threshold", metavar="T", type=positive("a value of the picture"), default=2.0,
        help="of --image: value of a colour, where a white card of radiance 1 is 1; pixels count in full from 2 T on, "
        "so that none switches on at once (default: 2)",
    )  # fmt: skip
    add_options(group, FlareSettings, ["most"])


class Sources:
    """The lights that a command line names, whose files are read once.

    Args:
        states: the arguments of all frames; empty for a single picture.
    """

    def __init__(self, args: argparse.Namespace, states: Sequence[argparse.Namespace] = ()) -> None:
        from neurolens.flare.lights import read_lights
        from neurolens.flare.sources import SceneLights
        from neurolens.render.scene import load_scene

        if not (args.light or args.lights or args.image):
            raise InputError(_COMMAND, "--light", "(missing)", "--light, --lights or --image")
        self._fixed = [_light(text) for text in args.light]
        self._tracks = [t for path in args.lights if path.suffix.lower() != ".toml" for t in read_lights(path)]
        scenes = [(path, load_scene(path)) for path in args.lights if path.suffix.lower() == ".toml"]
        self._scenes: list[tuple[Path, Scene, SceneLights]] = [(p, scene, SceneLights(scene)) for p, scene in scenes]
        self._fields: dict[tuple[Any, ...], Field] = {}
        self._states = states[:: -(-len(states) // _RANKED_FRAMES)] if states else ()
        self._chosen: dict[Path, frozenset[Name]] = {}

    def at(self, args: argparse.Namespace, lens: Lens, progress: Progress) -> list[Light]:
        """The lights at the frame of `args`, where the lens and the camera of a scene are as `args` says."""
        from neurolens.flare.sources import chosen, keep_named

        of_lists = [track.at(args.frame or 0) for track in self._tracks]
        lights = [*self._fixed, *(light for light in of_lists if light is not None)]
        if behind := len(self._fixed) + len(of_lists) - len(lights):
            warn(f"{behind} lights of lists stand behind the lens{_at(args)}")
        assert lens.film_z_mm is not None
        for path, scene, sources in self._scenes:
            visible = _visible(scene, path, sources, args, lens.film_z_mm)
            if path not in self._chosen:
                in_frames = [_visible(scene, path, sources, state, lens.film_z_mm) for state in self._states]
                self._chosen[path] = chosen(in_frames or [visible], args.most)
            lights += _with_warning(keep_named(visible, self._chosen[path]), path)
        if args.image is not None:
            lights += self._of_picture(args, lens, progress)
        if not lights:
            warn(f"no light: the flare is black{_at(args)}")
        return lights

    def reads(self, args: argparse.Namespace) -> Iterator[Path]:
        """The files that a frame's lights and the shape of the stop come from, which no picture may overwrite."""
        from neurolens.render.scene import files_named

        yield from args.lights
        yield from (path.parent / name for path, scene, _ in self._scenes for name in files_named(scene.settings))
        yield from () if args.aperture_mask is None else (args.aperture_mask,)
        yield from () if args.image is None else (picture_path(args),)

    def colour_space(self, args: argparse.Namespace) -> ColourSpace:
        """The colour space of a frame's picture: that of --colour-space, of --image or of a scene, or else sRGB."""
        from neurolens.render.colour import COLOUR_SPACES, SRGB
        from neurolens.render.pictures import read_colour_space

        if args.colour_space is not None:
            return COLOUR_SPACES[args.colour_space]
        if args.image is not None:
            return read_colour_space(picture_path(args)) or SRGB
        return COLOUR_SPACES[self._scenes[0][1].settings.film.colour_space] if self._scenes else SRGB

    def _of_picture(self, args: argparse.Namespace, lens: Lens, progress: Progress) -> list[Light]:
        from neurolens.flare.sources import highlights
        from neurolens.render.colour import SRGB, conversion, converted
        from neurolens.render.pictures import read_colour_space, read_exr

        path = picture_path(args)
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
            regions = highlights(picture, self._field(args, lens, progress), args.film, args.threshold, args.most, fade)
        except InputError as error:
            raise InputError(path, error.field, error.value, error.expected) from None
        return _with_warning(regions, path)

    def _field(self, args: argparse.Namespace, lens: Lens, progress: Progress) -> Field:
        from neurolens.cameras.build import Shot, make_camera
        from neurolens.cameras.exact import ExactCamera
        from neurolens.cameras.field import field_of
        from neurolens.setting.states import set_lens

        state = args.focus, args.f_number, args.zoom
        if state not in self._fields and is_model(args.file):  # fitted ghosts, with their film
            moved = (lens.film_z_mm or 0.0) - (set_lens(lens, focus_m=math.inf).film_z_mm or 0.0)
            camera = ExactCamera(lens, film_mm=args.film, focus_m=math.inf, film_offset_mm=moved, progress=progress)
            self._fields[state] = field_of(camera, args.focus, "equidistant")
        elif state not in self._fields:
            shot = Shot(
                film_mm=args.film, focus_m=args.focus, f_number=args.f_number, efl_mm=args.efl, zoom=args.zoom,
                field_deg=args.field, focus=args.focusing, aperture=aperture_of(args),
            )  # fmt: skip
            exact = make_camera(args.file, shot, progress)
            self._fields[state] = field_of(exact, args.focus, "equidistant")
        return self._fields[state]


def _visible(
    scene: Scene, path: Path, sources: SceneLights, args: argparse.Namespace, film_z_mm: float
) -> dict[Name, Light]:
    """The lights of a scene that its camera sees from the position that `args` gives it."""
    from neurolens.render.scene import seen_from

    return sources.named(seen_from(scene, path, args.position_m, args.look_at_m), film_z_mm)


def _with_warning(kept: Kept, path: Path) -> list[Light]:
    """The lights that are kept, after a warning about the energy of those that are not."""
    if kept.dropped > 0:
        warn(f"{path}: {len(kept.lights)} of {kept.of} lights; the others have {kept.dropped:.2%} of the energy")
    return kept.lights


def picture_path(args: argparse.Namespace) -> Path:
    """The file of --image at a frame."""
    frame = args.frame or 0
    return Path(re.sub("#+", lambda digits: f"{frame:0{len(digits[0])}d}", str(args.image)))


def _at(args: argparse.Namespace) -> str:
    """Where a warning belongs to, if there are frames."""
    return "" if args.frame is None else f" at frame {args.frame}"


def _light(text: str) -> Light:
    """The light of a --light option."""
    from neurolens.flare.lights import SUN, Light, with_disc
    from neurolens.render.environment import SUN_RADIUS_RAD

    words = text.split(",")
    try:
        angles = [float(word) for word in words[:2]]
        rgb = [float(word) for word in (words[2] if len(words) > 2 else str(SUN)).split("/")]
        distance = float(words[3]) if len(words) > 3 else math.inf
    except ValueError:
        angles, rgb, distance = [], [], math.inf
    if len(angles) != 2 or len(words) > 4 or len(rgb) not in (1, 3):
        raise InputError(_COMMAND, "--light", text, "AZ,EL[,E[,M]], numbers, E also as R/G/B")
    try:
        light = Light(angles[0], angles[1], (rgb[0], rgb[-2 % len(rgb)], rgb[-1]), distance)
        return with_disc(light, 0.0 if len(words) > 2 else 2 * math.degrees(SUN_RADIUS_RAD))
    except InputError as error:
        raise InputError(_COMMAND, "--light", text, error.expected) from None
