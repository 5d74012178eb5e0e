"""`neurolens defocus` beside path-traced pictures of the same lens, and beside a thin lens.

Six scenes through a 50 mm f/1.4, wide open: a sharp plate (pinhole, 128 samples a pixel), the lens and the thin lens
framed as it, path-traced (256 samples). FLIP (0 is equal) of the blurred plate against the path-traced lens, with
highlights as discs and without, and of the path-traced thin lens against it. Rendered pictures stay in the folder
`--pictures` and are taken from there by the next run; all take an hour of one slow core. The noise of both pictures
is part of FLIP: that of two path-traced pictures of other seeds is its floor, measured on the scene with the largest
FLIP. Also a 4K plate, made of the first scene's by repeating pixels, for its time. Writes defocus.md and defocus.json.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

from experiments import lab
from neurolens.cameras.build import make_camera
from neurolens.cameras.contract import Camera
from neurolens.cameras.field import frame_of
from neurolens.cli import main
from neurolens.defocus.picture import Defocused, defocus
from neurolens.defocus.plate import Eye, Layer
from neurolens.defocus.read import DepthSettings, Plate, read_plate
from neurolens.lens.shot import Shot
from neurolens.render.pictures import read_exr, write_png
from neurolens.render.scene import load_scene
from neurolens.study.image import flip

LENS = "leica_summilux_m_50mm_f1_4"
SCENES = ("room", "garden", "lights", "chess", "studio", "lamps")
F_NUMBER, WIDTH, SAMPLES = 1.4, 480, {"pinhole": 128, "fused": 256, "thin": 256}
_LARGE = 3840, 2160
_FLOOR_SEED = 1000


@dataclass(frozen=True)
class Row:
    """One scene: FLIP against the path-traced lens, seconds of a core, and what `defocus` said."""

    scene: str
    flip: float
    flip_without_highlights: float
    flip_thin: float
    cpu_s: float
    render_cpu_s: float | None
    highlights: int
    filled: float
    beyond: float


def picture_of(scene: str, kind: str, folder: Path, seed: int = 0) -> tuple[Path, float | None]:
    """The rendered picture of a scene, and the seconds of a core that it took, None where it was there."""
    name = f"{scene}.{kind}{f'.{seed}' if seed else ''}.exr"
    path = folder / name
    if path.is_file():
        return path, None
    began = lab.cpu_s()
    words = ["render", f"experiments/scenes/{scene}.toml", "--camera", f"{kind}:{lab.LENSES / LENS}.toml"]
    words += ["--f-number", str(F_NUMBER), "--width", str(WIDTH), "--samples", str(SAMPLES[kind]), "--threads", "1"]
    if code := main([*words, "--seed", str(seed), "-o", str(path), "--quiet"]):
        raise SystemExit(code)
    return path, lab.cpu_s() - began


def camera_and_plate(scene: str, path: Path) -> tuple[Camera, Plate]:
    """The lens as the scene sets it, and the scene's plate."""
    settings = load_scene(lab.ROOT / "experiments" / "scenes" / f"{scene}.toml").settings.camera
    shot = Shot(settings.film_mm, settings.focus_m, f_number=F_NUMBER, wavelength_nm=settings.wavelength_nm)
    camera = make_camera(f"fused:{lab.LENSES / LENS}.toml", shot)
    return camera, read_plate(path, settings.film_mm, frame_of(camera), DepthSettings())


def blurred(scene: str, path: Path, highlights: bool) -> tuple[Defocused, float]:
    """A scene's plate through the lens, and the seconds of a core."""
    camera, plate = camera_and_plate(scene, path)
    began = time.process_time()
    return defocus(plate, camera, highlights=highlights), time.process_time() - began


def measure(scene: str, folder: Path) -> Row:
    """Render what is missing of a scene, blur its plate, compare."""
    plate, _ = picture_of(scene, "pinhole", folder)
    (exact, seconds), (thin, _) = (picture_of(scene, kind, folder) for kind in ("fused", "thin"))
    truth = read_exr(exact)[0]
    (found, cpu_s), (without, _) = (blurred(scene, plate, highlights) for highlights in (True, False))
    write_png(folder / f"{scene}.defocus.png", found.rgb)
    best, noisy, thin_flip = (flip(rgb, truth) for rgb in (found.rgb, without.rgb, read_exr(thin)[0]))
    return Row(scene, best, noisy, thin_flip, cpu_s, seconds, found.highlights, found.filled, found.beyond)


def large_s(scene: str, folder: Path) -> tuple[float, int]:
    """Seconds of a core for a plate of 4K, and its highlights."""
    camera, small = camera_and_plate(scene, picture_of(scene, "pinhole", folder)[0])
    factor = _LARGE[0] // small.size[0]
    texel = small.layers[0].texel.repeat(factor, 0).repeat(factor, 1)
    eye = small.eye
    (x, y), (u, v) = eye.reach_px, eye.centre_px
    eye = Eye((x * factor, y * factor), (u * factor, v * factor), eye.before_film_mm)
    plate = Plate([Layer(texel[..., :3], texel[..., 3])], eye, (texel.shape[1], texel.shape[0]), small.space)
    began = time.process_time()
    found = defocus(plate, camera)
    return time.process_time() - began, found.highlights


_COLUMNS = lab.columns(
    ("scene", "scene"),
    ("FLIP", "flip", ".3f"),
    ("without discs", "flip_without_highlights", ".3f"),
    ("thin lens, path-traced", "flip_thin", ".3f"),
    ("CPU s", "cpu_s", ".1f"),
    ("CPU s, path-traced", "render_cpu_s", ".0f"),
    ("highlights", "highlights"),
    ("filled in", "filled", ".2%"),
    ("from beyond the plate", "beyond", ".2%"),
)
_NOTES = """\
{lens} at f/{f_number:g}, {width} pixels wide; FLIP against the same lens path-traced with {samples} samples a pixel
(goal 0.06). Two path-traced pictures of {worst} with other seeds differ by FLIP {floor:.3f}; from the
mean of both the blurred plate differs by {better:.3f}. A plate of {first} at
{wide} x {high} takes {large:.0f} s of one core (goal 60), {count} highlights among them. CPU seconds of a path-traced
picture are empty where it was there already."""
OPTIONS = (
    lab.ONLY,
    lab.option("--pictures", type=Path, default=Path("runs/defocus"), metavar="FOLDER", help="where renders are kept"),
    lab.out(),
)


def run(args: argparse.Namespace) -> None:
    """Measure scene by scene."""
    lab.quiet_glasses()
    args.pictures.mkdir(parents=True, exist_ok=True)
    rows = []
    for scene, report in lab.stages(lab.chosen(SCENES, str, args.only, "defocus"), str, args.quiet):
        rows.append(measure(scene, args.pictures))
        report(1.0)
    first, worst = rows[0].scene, max(rows, key=lambda row: row.flip).scene
    two = [read_exr(picture_of(worst, "fused", args.pictures, seed)[0])[0] for seed in (0, _FLOOR_SEED)]
    plate = picture_of(worst, "pinhole", args.pictures)[0]
    better = flip(blurred(worst, plate, True)[0].rgb, (two[0] + two[1]) / 2)
    large, count = large_s(first, args.pictures)
    known = {
        "lens": LENS,
        "f_number": F_NUMBER,
        "width": WIDTH,
        "samples": SAMPLES["fused"],
        "first": first,
        "worst": worst,
        "better": better,
    }
    known |= {"floor": flip(*two), "wide": _LARGE[0], "high": _LARGE[1], "large": large, "count": count}
    head = "# Blur of a lens for sharp pictures, beside path-traced ones", "`python -m experiments defocus`"
    text = lab.page(*head, _NOTES.format(**known), lab.machine_line(), lab.table(_COLUMNS, rows))
    print(lab.write_results(args.out, "defocus", text, {**known, "machine": lab.machine(), "rows": rows}))
