"""Pictures of flare: what `neurolens render` and `neurolens flare` make of suns, headlights, coatings, stops, frames.

Each picture is one or more commands, told beside it; OpenEXR files (in runs/flare, OUT in the commands) that are there
are not made again. Shown is the sum of what the commands made, brighter by some stops, its highlights rolled off from
0.6 on, colours that sRGB does not hold turned towards grey. Writes the pictures and their page.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterator
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
from neurolens.render.colour import SRGB, linear_to_srgb
from neurolens.render.pictures import read_exr, read_layers

OPTIONS = [lab.ONLY, lab.out(lab.RESULTS / "flare", "folder for pictures and page")]
_SHOULDER, _MOST_BYTES = 0.6, 420_000
_LAYERS = "ghosts", "glare", "starburst"
_SUN, _ROAD = "experiments/scenes/sun.toml", "experiments/scenes/road.toml"
_GAUSS = "lenses/laikin_double_gauss_50.toml"
_FLARE = "neurolens flare"
_RETRO = f"{_FLARE} tajima_retrofocus_24 --lights {_SUN} --focus 40 --f-number 8 --blades 6"
_STOPS = f"{_FLARE} tajima_retrofocus_24 --light 13.7,10 --blades 6 --starburst --width 360"
_ANAMORPHIC = f"{_FLARE} cooke_anamorphic_42 --light 8,4,2 --film 24x18 --width 360"
_ACROSS = f"{_FLARE} laikin_double_gauss_50 --lights OUT/across.csv --f-number 5.6 --blades 6 --width 240"
_KEYS = "light,frame,azimuth_deg,elevation_deg,r,g,b\nsun,1,-24,9,3,3,3\nsun,6,24,9,3,3,3\n"


@dataclass(frozen=True)
class Panel:
    """A picture: what commands made, added up; its label; its width over that of its file; stops it is brighter.

    `over` is the render whose plate lies under it, of twice its size.
    """

    files: tuple[str, ...]
    label: str = ""
    stretch: float = 1.0
    stops: float = 0.0
    over: str = ""


@dataclass(frozen=True)
class Picture:
    """Panels in rows of `columns`; what is said of them; their commands, OUT being the folder; exposure in stops."""

    name: str
    text: str
    commands: tuple[str, ...]
    panels: tuple[Panel, ...]
    columns: int = 1
    stops: float = 0.0


_COATINGS = ("bare", "single-layer", "three-layer", "multi-layer")
_N = ("2.8", "8", "16")
PICTURES = (
    Picture(
        "sun",
        "A low sun over hills, by a 24 mm retrofocus lens at f/8 with single-layer coatings: ghosts and starburst are "
        "layers of the render, which the scene's table [flare] asks for.",
        (f"neurolens render {_SUN} --camera lenses/tajima_retrofocus_24.toml --channels beauty -o OUT/sun.exr",),
        (Panel(("sun",)),),
        stops=-0.3,
    ),
    Picture(
        "headlights",
        "A wet street at night by a 50 mm double Gauss at f/8, bare, its six blades in the headlights' stars. The "
        "plate is by the thin lens of the same frame: no noise of dispersion.",
        (
            f"neurolens render {_ROAD} --camera thin:{_GAUSS} --channels beauty -o OUT/road.exr",
            f"{_FLARE} laikin_double_gauss_50 --lights {_ROAD} --most 8 --focus 14 --f-number 8 --blades 6 --starburst "
            "--width 720 -o OUT/road-flare.exr",
        ),
        (Panel(("road", "road-flare")),),
        stops=1.0,
    ),
    Picture(
        "coatings",
        "The sun above, its ghosts by what is on the glass.",
        tuple(
            f"{_RETRO} {'' if name == 'bare' else f'--coating {name} '}--width 360 -o OUT/coating-{name}.exr"
            for name in _COATINGS
        ),
        tuple(Panel((f"coating-{name}",), name, over="sun") for name in _COATINGS),
        columns=2,
        stops=-0.3,
    ),
    Picture(
        "stops",
        "A light by the same lens, bare, opened and stopped down, exposed alike: ghosts take the shape of the stop, "
        "and light that diffraction sends aside grows.",
        tuple(f"{_STOPS} --f-number {n} -o OUT/stop-{n}.exr" for n in _N),
        tuple(Panel((f"stop-{n}",), f"f/{n}") for n in _N),
        columns=3,
    ),
    Picture(
        "anamorphic",
        "An anamorphic lens, shown unsqueezed: its cylinders draw ghosts out to streaks in both meridians. Bare, and "
        "with multi-layer coatings, seven stops brighter, its strongest streak six times as strong and blue.",
        (
            f"{_ANAMORPHIC} -o OUT/anamorphic.exr",
            f"{_ANAMORPHIC} --coating multi-layer --gain g13-12=6 --tint g13-12=0.25/0.5/1 -o OUT/anamorphic-blue.exr",
        ),
        (
            Panel(("anamorphic",), "bare", 2.0, -3.0),
            Panel(("anamorphic-blue",), "multi-layer, g13-12 times 1.5 / 3 / 6", 2.0, 4.0),
        ),
    ),
    Picture(
        "animation",
        "A light that crosses the frame, by keys in a list: `" + _KEYS.strip().replace("\n", "`, `") + "`.",
        (f"{_ACROSS} --frames 1:6 -o OUT/across.exr",),
        tuple(Panel((f"across.{frame:04d}",), f"frame {frame}") for frame in range(1, 7)),
        columns=3,
        stops=-1.5,
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
        plates = [_half(_read(made / f"{p.over}.exr")["plate"]) if p.over else 0.0 for p in picture.panels]
        lab.write_small_png(args.out / f"{picture.name}.png", _sizes(_drawn(picture, panels, plates)), _MOST_BYTES)
        parts += [f"## {picture.name}", f"![{picture.name}]({picture.name}.png)", picture.text]
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
        return {"plate": picture, **found, "sum": np.sum([picture, *found.values()], 0)}
    return {**found, "sum": picture}


def _half(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    """A picture of half the size."""
    height, width = picture.shape[:2]
    return picture.reshape(height // 2, 2, width // 2, 2, 3).mean((1, 3))


def _drawn(picture: Picture, panels: list[list[dict[str, NDArray[np.float32]]]], plates: list[Any]) -> Image.Image:
    tiles = []
    for panel, found, plate in zip(picture.panels, panels, plates, strict=True):
        tile = Image.fromarray(
            _shown((np.sum([f["sum"] for f in found], 0) + plate) * 2.0 ** (picture.stops + panel.stops))
        )
        tile = tile.resize((round(tile.width * panel.stretch), tile.height), Image.Resampling.LANCZOS)
        ImageDraw.Draw(tile).text((6, 4), panel.label, fill=(235, 235, 235))
        tiles.append(tile)
    width, height = tiles[0].size
    rows = -(-len(tiles) // picture.columns)
    whole = Image.new("RGB", (picture.columns * (width + 2) - 2, rows * (height + 2) - 2))
    for k, tile in enumerate(tiles):
        whole.paste(tile, (k % picture.columns * (width + 2), k // picture.columns * (height + 2)))
    return whole


def _sizes(picture: Image.Image) -> Iterator[Image.Image]:
    for share in (1, 0.75, 0.5):
        yield picture.resize((round(share * picture.width), round(share * picture.height)), Image.Resampling.LANCZOS)


def _shown(picture: NDArray[np.float32]) -> NDArray[np.uint8]:
    """A linear picture as sRGB bytes."""
    grey = np.maximum(picture @ SRGB.to_xyz[1], 0)[..., None]
    low = picture.min(-1, keepdims=True)
    inside = grey + (picture - grey) * np.minimum(grey / np.maximum(grey - low, 1e-12), 1)
    inside += (grey - inside) * np.clip((grey - 2) / 8, 0, 1)  # what dazzles has no colour
    rolled = _SHOULDER + (1 - _SHOULDER) * -np.expm1(-np.maximum(inside - _SHOULDER, 0) / (1 - _SHOULDER))
    return np.rint(255 * linear_to_srgb(np.where(inside > _SHOULDER, rolled, inside))).astype(np.uint8)


def _rows(picture: Picture, panels: list[list[dict[str, NDArray[np.float32]]]]) -> list[lab.Row]:
    """Mean luminance of each part of each panel."""
    rows = []
    for panel, found in zip(picture.panels, panels, strict=True):
        row: lab.Row = {"label": panel.label or picture.name}
        for one in found:
            row |= {name: float((part @ SRGB.to_xyz[1]).mean()) for name, part in one.items() if name != "sum"}
        rows.append(row)
    return rows


_COLUMNS = lab.columns(
    ("mean luminance (1: a white card)", "label"),
    ("plate", "plate", ".3g"),
    ("ghosts", "ghosts", ".3g"),
    ("starburst", "starburst", ".3g"),
)
