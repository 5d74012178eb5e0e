"""Pictures of flare: what `neurolens render` and `neurolens flare` make of suns, headlights, coatings, stops, frames.

Beside each picture stand the commands that made it. A picture is the sum of what they made. Renders are denoised (Open
Image Denoise). Pictures are brightened by some stops, highlights are rolled off from 0.6 on, and colours that sRGB does
not hold are turned towards grey. `python -m experiments flare-gallery` writes the pictures and this page; OpenEXR files
that are in runs/flare already (OUT in the commands) are not made again.
"""

from __future__ import annotations

import argparse
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from experiments import lab
from neurolens import cli
from neurolens.base.errors import NeurolensError
from neurolens.base.files import atomic_write_text
from neurolens.pictures.render.colour import SRGB, in_gamut, linear_to_srgb
from neurolens.pictures.render.pictures import read_exr, read_layers

OPTIONS = [lab.ONLY, lab.out(lab.RESULTS / "flare", "folder for pictures and page")]
_SHOULDER, _MOST_BYTES, _QUALITIES = 0.6, 700_000, (93, 88, 82, 75)
_LAYERS = "ghosts", "glare", "starburst"
_SUN, _ROAD = "experiments/scenes/sun.toml", "experiments/scenes/road.toml"
_GAUSS, _RETRO = "lenses/laikin_double_gauss_50.toml", "lenses/tajima_retrofocus_24.toml"
_FLARE = "neurolens flare"
_OF_SUN = f"{_FLARE} tajima_retrofocus_24 --lights {_SUN} --focus 40 --blades 6"
_ANAMORPHIC = f"{_FLARE} cooke_anamorphic_42 --lights {_ROAD} --most 4 --focus 14 --film 24x18 --width 640"
_ACROSS = f"{_FLARE} laikin_double_gauss_50 --lights OUT/across.csv --f-number 5.6 --blades 6 --width 432"
_KEYS = "light,frame,azimuth_deg,elevation_deg,r,g,b\nsun,1,-24,9,3,3,3\nsun,6,24,9,3,3,3\n"


@dataclass(frozen=True)
class Panel:
    """A picture, the sum of what commands made: its label, its width over that of its file, stops it is brighter.

    `over` is the render whose plate lies under it, reduced to its size.
    """

    files: tuple[str, ...]
    label: str = ""
    stretch: float = 1.0
    stops: float = 0.0
    over: str = ""


@dataclass(frozen=True)
class Picture:
    """Panels in rows of `columns`, their text, their commands (OUT is the folder), the exposure in stops."""

    name: str
    text: str
    commands: tuple[str, ...]
    panels: tuple[Panel, ...]
    columns: int = 1
    stops: float = 0.0


_COATINGS = {"bare": 0.0, "single-layer": 4.0, "three-layer": 7.0, "multi-layer": 9.0}
_N = ("2.8", "5.6", "11", "22")
PICTURES = (
    Picture(
        "sun",
        "A low sun over a lake, through a 24 mm retrofocus lens at f/8 with single-layer coatings. Dust covers 2% of "
        "its front. The flare has ghosts, the star of six blades, and a veil about the sun by 63 million photons. The "
        "plate is by the thin lens whose focal length images the sun at the same place.",
        (
            f"neurolens render {_SUN} --camera thin:{_RETRO} --focal-length 23.9 --channels beauty -o OUT/sun.exr",
            f"{_OF_SUN} --f-number 8 --coating single-layer --starburst --width 1280 -o OUT/sun-flare.exr",
            f"{_OF_SUN} --f-number 8 --coating single-layer --without ghosts --dust 0.02 --glare 4194304 --kernel 24 "
            "--width 640 -o OUT/veil.exr",
        ),
        (Panel(("sun", "sun-flare", "veil")),),
        stops=0.4,
    ),
    Picture(
        "headlights",
        "A wet street at night, through a 50 mm double Gauss at f/8 with single-layer coatings. The stars of the "
        "headlights show its six blades. The plate is by the thin lens of the same frame.",
        (
            f"neurolens render {_ROAD} --camera thin:{_GAUSS} --channels beauty -o OUT/road.exr",
            f"{_FLARE} laikin_double_gauss_50 --lights {_ROAD} --most 8 --focus 14 --f-number 8 --blades 6 --starburst "
            "--coating single-layer --width 1280 -o OUT/road-flare.exr",
        ),
        (Panel(("road", "road-flare")),),
        stops=1.0,
    ),
    Picture(
        "coatings",
        "The same sun with four coatings. On the left the flare is over the plate, with the same veil of dust, and all "
        "panels are exposed alike. On the right are the ghosts alone, brighter by the stops that each panel states.",
        tuple(f"{_OF_SUN} --f-number 8 --coating {name} --width 640 -o OUT/coating-{name}.exr" for name in _COATINGS),
        tuple(
            panel
            for name, stops in _COATINGS.items()
            for panel in (
                Panel((f"coating-{name}", "veil"), name, over="sun"),
                Panel((f"coating-{name}",), f"ghosts alone, {stops:+g} stops", stops=stops),
            )
        ),
        columns=2,
    ),
    Picture(
        "stops",
        "The same sun alone through the same lens without coatings, opened and stopped down, exposed alike. Ghosts "
        "take the shape of the stop, and diffraction sends more light aside.",
        tuple(f"{_OF_SUN} --starburst --f-number {n} --coating bare --width 640 -o OUT/stop-{n}.exr" for n in _N),
        tuple(Panel((f"stop-{n}",), f"f/{n}") for n in _N),
        columns=2,
    ),
    Picture(
        "anamorphic",
        "The street through an anamorphic lens, shown unsqueezed. Its cylinders draw ghosts out to streaks in both "
        "meridians. Above it is bare. Below it has multi-layer coatings, and its strongest streak is made blue and "
        "stronger.",
        (
            f"neurolens render {_ROAD} --camera lenses/cooke_anamorphic_42.toml --film 24x18 --width 640 "
            "--channels beauty -o OUT/squeezed.exr",
            f"{_ANAMORPHIC} --coating bare -o OUT/anamorphic.exr",
            f"{_ANAMORPHIC} --coating multi-layer --gain g13-12=250/500/1000 -o OUT/anamorphic-blue.exr",
        ),
        (
            Panel(("squeezed", "anamorphic"), "bare, one stop darker", 2.0, -1.0),
            Panel(("squeezed", "anamorphic-blue"), "multi-layer, g13-12 times 250 / 500 / 1000", 2.0),
        ),
        stops=1.0,
    ),
    Picture(
        "animation",
        "A light crosses the frame, by keys in a list: `" + _KEYS.strip().replace("\n", "`, `") + "`. The lens has the "
        "coatings assumed of its year, and the picture is nine stops brighter.",
        (f"{_ACROSS} --frames 1:6 -o OUT/across.exr",),
        tuple(Panel((f"across.{frame:04d}",), f"frame {frame}") for frame in range(1, 7)),
        columns=3,
        stops=9.0,
    ),
)


def run(args: argparse.Namespace) -> int:
    """Make what is missing, draw, write the page."""
    args.out.mkdir(parents=True, exist_ok=True)
    made = lab.ROOT / "runs" / "flare"
    made.mkdir(parents=True, exist_ok=True)
    atomic_write_text(made / "across.csv", _KEYS)
    parts = []
    for picture in lab.chosen(PICTURES, lambda p: p.name, args.only, "flare-gallery"):
        for command in picture.commands:
            _make(command, made, args.quiet)
        panels = [[_read(made / f"{file}.exr") for file in panel.files] for panel in picture.panels]
        plates = [_read(made / f"{panel.over}.exr")["plate"] if panel.over else None for panel in picture.panels]
        drawn = _drawn(picture, panels, plates)
        forms = ((drawn, {"quality": quality, "optimize": True}) for quality in _QUALITIES)
        lab.write_small(args.out / f"{picture.name}.jpg", forms, _MOST_BYTES)
        parts += [f"## {picture.name}", f"![{picture.name}]({picture.name}.jpg)", picture.text]
        parts += ["```\n" + "\n".join(picture.commands) + "\n```", lab.table(_COLUMNS, _rows(picture, panels))]
    if not args.only:
        atomic_write_text(args.out / "README.md", lab.page("# Flare in pictures", __doc__ or "", *parts))
    return 0


def _make(command: str, folder: Path, quiet: bool) -> None:
    """Run a command whose file is not there."""
    words = [word.replace("OUT/", f"{folder}/") for word in shlex.split(command)[1:]]
    out = Path(words[-1])
    if out.is_file() or out.with_name(f"{out.stem}.0006.exr").is_file():
        return
    if cli.main([*words, *(["--quiet"] if quiet else [])]):
        raise NeurolensError(f"failed: {command}")


def _read(file: Path) -> dict[str, NDArray[np.float32]]:
    """The picture of a file with its flare, and layers of flare by name, [H, W, 3]; of a render, `plate` too."""
    picture, planes = read_exr(file)[0], read_layers(file)
    found = {n: np.stack([planes[f"{n}.{c}"] for c in "RGB"], -1) for n in _LAYERS if f"{n}.R" in planes}
    if "render" in read_exr(file)[1]:
        picture = lab.denoised(picture)
        return {"plate": picture, **found, "sum": np.sum([picture, *found.values()], 0)}
    return {**found, "sum": picture}


def _drawn(picture: Picture, panels: list[list[dict[str, NDArray[np.float32]]]], plates: list[Any]) -> Image.Image:
    tiles = []
    for panel, found, plate in zip(picture.panels, panels, plates, strict=True):
        parts = [one["sum"] for one in found] + ([] if plate is None else [plate])
        total = np.sum([_sized(part, *parts[0].shape[1::-1]) for part in parts], 0)
        tile = Image.fromarray(_shown(total * 2.0 ** (picture.stops + panel.stops)))
        tile = tile.resize((round(tile.width * panel.stretch), tile.height), Image.Resampling.LANCZOS)
        ImageDraw.Draw(tile).text((8, 6), panel.label, fill=(235, 235, 235), font_size=16)
        tiles.append(tile)
    whole: Image.Image = lab.sheet(tiles, picture.columns, 2, "black")
    return whole


def _sized(picture: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """A linear picture of another size."""
    way = Image.Resampling.BOX if width < picture.shape[1] else Image.Resampling.BICUBIC
    planes = [Image.fromarray(plane).resize((width, height), way) for plane in np.moveaxis(picture, 2, 0)]
    return np.stack([np.asarray(plane) for plane in planes], -1)


def _shown(picture: NDArray[np.float32]) -> NDArray[np.uint8]:
    """A linear picture as sRGB bytes."""
    inside = in_gamut(picture)
    grey = (inside @ SRGB.to_xyz[1])[..., None]
    inside += (grey - inside) * np.clip((grey - 2) / 8, 0, 1)  # what dazzles has no colour
    rolled = _SHOULDER + (1 - _SHOULDER) * -np.expm1(-np.maximum(inside - _SHOULDER, 0) / (1 - _SHOULDER))
    return np.rint(255 * linear_to_srgb(np.where(inside > _SHOULDER, rolled, inside))).astype(np.uint8)


def _rows(picture: Picture, panels: list[list[dict[str, NDArray[np.float32]]]]) -> list[lab.Row]:
    """Mean luminance of each part of each panel."""
    rows = []
    for panel, found in zip(picture.panels, panels, strict=True):
        if panel.label.startswith("ghosts alone"):
            continue  # the row before has it
        row: lab.Row = {"label": panel.label or picture.name}
        for one in found:
            row |= {name: float((part @ SRGB.to_xyz[1]).mean()) for name, part in one.items() if name != "sum"}
        rows.append(row)
    return rows


_COLUMNS = lab.columns(
    ("mean luminance (1: a white card)", "label"),
    ("plate", "plate", ".3g"),
    ("ghosts", "ghosts", ".3g"),
    ("glare", "glare", ".3g"),
    ("starburst", "starburst", ".3g"),
)
