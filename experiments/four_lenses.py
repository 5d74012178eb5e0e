"""One night scene through a thin lens and three real ones: the first picture of the README.

Three are scaled to 50 mm. The anamorphic lens has its own size, since it focuses by its groups; it stands where the
king is as large on its smaller film, and its picture is drawn twice as wide. All stops are open. Each picture is
exposed so that the pieces in its middle are as bright as through the thin lens. Open Image Denoise takes the noise that
is left. Writes night.jpg.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from experiments import lab
from neurolens.base.progress import Progress
from neurolens.cameras.build import FUSED, Shot, make_camera
from neurolens.render.renderer import render
from neurolens.render.scene import load_scene
from neurolens.study.image import Image, to_srgb

SCENE = lab.SCENES / "chess.toml"
_GAP = 6  # pixels between the pictures
_MOST_BYTES = 500_000


@dataclass(frozen=True)
class Lens:
    """A picture.

    Attributes:
        camera: as `make_camera` takes it. f_number: the widest.
        squeeze: how many times wider its picture is drawn than it is on the film. film_height_mm: of its film.
        focus_m: distance from the film to the king, where it is not the scene's.
    """

    camera: str
    title: str
    f_number: float
    squeeze: float = 1.0
    film_height_mm: float = 20.25
    focus_m: float | None = None


LENSES = (
    Lens("thin", "Thin lens, f/1.4", 1.4),
    Lens("merte_biotar_100", "Biotar f/1.4 (1927)", 1.4),
    Lens("petzval_portrait_100", "Petzval's portrait lens f/3.6 (1840)", 3.6),
    Lens("cooke_anamorphic_42", "Anamorphic f/2.4 (2013)", 2.4, 2.0, 10.0, 1.03),
)

OPTIONS = [
    lab.count("samples", 320, "of a pixel (default: 320)"),
    lab.count("width", 800, "of one of the four pictures (default: 800)", most=4096),
    lab.out(lab.RESULTS, "folder for night.jpg"),
]


def run(args: argparse.Namespace) -> None:
    """Render all four and write the picture."""
    lab.quiet_glasses()
    size = (args.width, round(args.width * 9 / 16))
    with Progress(quiet=args.quiet).stage("pictures") as report:
        pictures = []
        for k, lens in enumerate(LENSES):

            def part(fraction: float, seconds_left: float | None = None, before: int = k) -> None:
                report((before + fraction) / len(LENSES))

            pictures.append(picture_of(lens, size, args.samples, part))
    write_sheet(args.out, pictures)
    print(args.out / "night.jpg")


def picture_of(lens: Lens, size: tuple[int, int], samples: int, report: lab.Report) -> Image:
    """The scene through a lens, denoised: linear RGB [height, width, 3]."""
    scene = load_scene(SCENE)
    settings = scene.settings.camera
    position, there = np.array(settings.position_m), np.array(settings.look_at_m)
    focus_m = lens.focus_m or settings.focus_m
    back = (position - there) / np.linalg.norm(position - there) * (focus_m - settings.focus_m)
    own = lens.focus_m is not None
    shot = Shot(
        film_mm=(lens.film_height_mm * 16 / 9 / lens.squeeze, lens.film_height_mm),
        focus_m=focus_m,
        f_number=lens.f_number,
        efl_mm=None if own else 50.0,
        focus="internal" if own else "best",
    )
    camera = make_camera(lens.camera if lens.camera == "thin" else f"{FUSED}{lens.camera}", shot)
    scene = replace(
        scene, settings=replace(scene.settings, camera=replace(settings, position_m=tuple(position + back)))
    )
    width, height = size[0], round(size[1] * lens.squeeze)  # pixels of a squeezed picture stay square
    samples = max(1, round(samples / lens.squeeze))
    done = render(scene, camera, width=width, height=height, samples=samples, progress=report)
    return lab.denoised(done.rgb).reshape(size[1], -1, width, 3).mean(axis=1)


def write_sheet(folder: Path, pictures: list[Image]) -> None:
    """Two rows of two pictures, each with its title, as JPEG: a photograph's noise would fill a PNG."""
    from PIL import Image as Pictures
    from PIL import ImageDraw

    height, width, _ = pictures[0].shape
    middle = np.s_[height // 3 : -height // 8, width // 4 : -width // 4]
    sheet = Pictures.new("RGB", (2 * width + _GAP, 2 * height + _GAP), "white")
    for k, (lens, picture) in enumerate(zip(LENSES, pictures, strict=True)):
        exposure = float(np.median(pictures[0][middle]) / np.median(picture[middle]))
        part = Pictures.fromarray(np.uint8(np.round(255 * to_srgb(picture, exposure))))
        place = ImageDraw.Draw(part)
        place.text((12, 8), lens.title, "white", font_size=20, stroke_width=2, stroke_fill="black")
        sheet.paste(part, ((k % 2) * (width + _GAP), (k // 2) * (height + _GAP)))
    folder.mkdir(parents=True, exist_ok=True)
    lab.write_small(folder / "night.jpg", [(sheet, {"quality": quality}) for quality in (90, 80, 70)], _MOST_BYTES)
