"""One night scene through a thin lens and three real ones: the first picture of the README.

Three are scaled to 50 mm. The anamorphic lens has its own size, since it focuses by its groups; it stands where the
king is as large on its smaller film, and its picture is drawn twice as wide. All stops are open. Each picture is
exposed so that the pieces in its middle are as bright as through the thin lens. Open Image Denoise takes the noise that
is left. Writes night.jpg.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from experiments import lab
from neurolens.base.progress import Progress
from neurolens.cameras.build import make_camera
from neurolens.optics.lens.shot import Shot
from neurolens.pictures.render.colour import linear_to_srgb
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.scene import load_scene
from neurolens.studies.scenes import Image

SCENE = lab.SCENES / "chess.toml"
_GAP = 6  # pixels between the pictures
_MOST_BYTES = 500_000


@dataclass(frozen=True)
class Lens:
    """A picture of the sheet.

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
    """Render all four and write the sheet: two rows of two pictures with their titles.

    It is a JPEG, because a photograph's noise would fill a PNG.
    """
    from PIL import Image as Pictures

    lab.quiet_glasses()
    size = (args.width, round(args.width * 9 / 16))
    with Progress(quiet=args.quiet).stage("pictures") as report:
        parts = [lab.part_of(report, k, len(LENSES)) for k in range(len(LENSES))]
        pictures = [picture_of(lens, size, args.samples, part) for lens, part in zip(LENSES, parts, strict=True)]
    middle = np.s_[size[1] // 3 : -size[1] // 8, size[0] // 4 : -size[0] // 4]
    shown = []
    for lens, picture in zip(LENSES, pictures, strict=True):
        exposure = float(np.median(pictures[0][middle]) / np.median(picture[middle]))
        shown.append(
            lab.labelled(Pictures.fromarray(np.uint8(np.round(255 * linear_to_srgb(exposure * picture)))), lens.title)
        )
    args.out.mkdir(parents=True, exist_ok=True)
    forms = [(lab.sheet(shown, 2, _GAP), {"quality": quality}) for quality in (90, 80, 70)]
    lab.write_small(args.out / "night.jpg", forms, _MOST_BYTES)
    print(args.out / "night.jpg")


def picture_of(lens: Lens, size: tuple[int, int], samples: int, report: lab.Report) -> Image:
    """The scene through a lens, denoised: linear RGB [height, width, 3]."""
    scene = load_scene(SCENE)
    settings, internal = scene.settings.camera, lens.focus_m is not None
    position, target = np.array(settings.position_m), np.array(settings.look_at_m)
    focus_m = lens.focus_m or settings.focus_m
    back = (position - target) / np.linalg.norm(position - target) * (focus_m - settings.focus_m)
    film_mm = (lens.film_height_mm * 16 / 9 / lens.squeeze, lens.film_height_mm)
    focus: Any = "internal" if internal else "best"
    shot = Shot(film_mm, focus_m, lens.f_number, focal_length_mm=None if internal else 50.0, focus_mode=focus)
    camera = make_camera(lens.camera, shot)
    moved = replace(settings, position_m=tuple(position + back))
    scene = replace(scene, settings=replace(scene.settings, camera=moved))
    width, height = size[0], round(size[1] * lens.squeeze)  # pixels of a squeezed picture stay square
    samples = max(1, round(samples / lens.squeeze))
    done = render(scene, camera, width=width, height=height, samples=samples, progress=report)
    return lab.denoised(done.rgb).reshape(size[1], -1, width, 3).mean(axis=1)
