"""`neurolens defocus` beside path-traced pictures of the same lens, and beside a thin lens.

Six scenes through a 50 mm f/1.4, wide open: a sharp plate (pinhole, 512 samples a pixel), the lens (1,024) and
the thin lens framed as it (256), path-traced. FLIP (0 is equal) of the blurred plate against the path-traced lens, with
highlights as discs and without, and of the path-traced thin lens against it. Rendered pictures stay in the folder
`--pictures` and are taken from there by the next run; all take half an hour of one core. The noise of both pictures
is part of FLIP: that of two path-traced pictures of other seeds is its floor, measured on the scene with the largest
FLIP. Also a 4K plate, made of the first scene's by repeating pixels, for its time; `--large` takes that time alone, and
the rest from the results that are there. Writes defocus.md and defocus.json.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import tempfile
import time
from pathlib import Path

import numpy as np

from experiments import lab
from neurolens.base.settings import LIGHT_NM
from neurolens.cameras.build import make_camera
from neurolens.cameras.contract import Camera
from neurolens.cameras.field import frame_of
from neurolens.cli import main
from neurolens.optics.lens.shot import Shot
from neurolens.pictures.defocus.kernels import kernel_at, own_plate, tint
from neurolens.pictures.defocus.picture import Gathered, defocus
from neurolens.pictures.defocus.plate import DepthSettings, Layer, Plate, PlatePinhole, read_plate
from neurolens.pictures.render.pictures import read_exr, write_png
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.scene import load_scene
from neurolens.studies.scenes import flip, rel_mse

LENS = "leica_summilux_m_50mm_f1_4"
SCENES = ("room", "garden", "lights", "chess", "studio", "lamps")
F_NUMBER, WIDTH, SAMPLES = 1.4, 480, {"pinhole": 512, "fused": 1024, "thin": 256}
_LARGE = 3840, 2160
_FLOOR_SEED = 1000
# A render of a point of light has this film, pixels per mm, focus and radius of the ball in pixels; its kernel has so
# many pixels across each pixel of the render.
_STRIP_MM, _PER_MM, _STRIP_FOCUS_M, _BALL_PX, _FINER = (4.5, 30.0), 10.0, 1.2, 1, 8


def rendered(scene: Path, camera: str, path: Path, samples: int, *more: str) -> tuple[Path, float]:
    """The rendered picture of a scene, and the seconds of a core that it took, which a file beside it keeps."""
    spent = path.with_suffix(".seconds")
    if not (path.is_file() and spent.is_file()):
        began = lab.cpu_s()
        words = ["render", str(scene), "--camera", f"{camera}:{lab.LENSES / LENS}.toml", "--f-number", str(F_NUMBER)]
        words += ["--samples", str(samples), "--threads", "1", *more, "-o", str(path), "--quiet"]
        if code := main(words):
            raise SystemExit(code)
        spent.write_text(f"{lab.cpu_s() - began}\n", encoding="utf-8")
    return path, float(spent.read_text(encoding="utf-8"))


def picture_of(scene: str, kind: str, folder: Path, seed: int = 0) -> tuple[Path, float]:
    """A scene's picture through the lens or what stands for it, and the seconds of a core that it took."""
    path = folder / f"{scene}.{kind}{f'.{seed}' if seed else ''}.exr"
    return rendered(_scene(scene), kind, path, SAMPLES[kind], "--width", str(WIDTH), "--seed", str(seed))


def _scene(name: str) -> Path:
    return lab.ROOT / "experiments" / "scenes" / f"{name}.toml"


def camera_and_plate(scene: str, path: Path, *behind: Path) -> tuple[Camera, Plate]:
    """The lens as the scene sets it, and the scene's plate."""
    settings = load_scene(_scene(scene)).settings.camera
    shot = Shot(settings.film_mm, settings.focus_m, f_number=F_NUMBER, wavelength_nm=settings.wavelength_nm)
    camera = make_camera(f"{lab.LENSES / LENS}.toml", shot)
    return camera, read_plate(path, settings.film_mm, frame_of(camera), DepthSettings(), behind)


def blurred(scene: str, path: Path, highlights: bool, *behind: Path) -> tuple[Gathered, float]:
    """A scene's plate through the lens, and the seconds of a core."""
    camera, plate = camera_and_plate(scene, path, *behind)
    began = time.process_time()
    return defocus(plate, camera, highlights=highlights), time.process_time() - began


def measure(scene: str, folder: Path) -> lab.Row:
    """Render what is missing of a scene, blur its plate, compare by FLIP with the path-traced lens."""
    plate, _ = picture_of(scene, "pinhole", folder)
    (exact, seconds), (thin, _) = (picture_of(scene, kind, folder) for kind in ("fused", "thin"))
    truth = read_exr(exact)[0]
    (found, cpu_s), (without, _) = (blurred(scene, plate, highlights) for highlights in (True, False))
    write_png(folder / f"{scene}.defocus.png", found.rgb)
    best, noisy, thin_flip = (flip(rgb, truth) for rgb in (found.rgb, without.rgb, read_exr(thin)[0]))
    row: lab.Row = {"scene": scene, "flip": best, "flip_without_highlights": noisy, "flip_thin": thin_flip}
    row |= {"cpu_s": cpu_s, "render_cpu_s": seconds, "highlights": found.highlights}
    return row | {"filled": found.filled, "beyond": found.beyond}


def equal_noise(folder: Path, samples: int) -> lab.Row:
    """Blurred plates of the lights, with overscan and the layer behind the figures, beside path-traced pictures.

    Noise is variance (`rel_mse`) by two seeds; error the mean square distance from the mean of two path-traced
    pictures, without their noise; `faster`, `faster_to_error`: how many times as long path tracing takes to the same.
    """
    scene, behind = _scene("lights"), folder / "behind.toml"
    rows = scene.read_text(encoding="utf-8").splitlines()
    figures = [row for row in rows if "centre_m" in row and "material" in row]
    behind.write_text("\n".join(row for row in rows if row not in figures), encoding="utf-8")
    traced, found, spent = [], [], []
    for seed in (0, _FLOOR_SEED):
        exact, exact_s = picture_of("lights", "fused", folder, seed)
        more = "--film", "54x30.375", "--width", str(WIDTH * 3 // 2), "--seed", str(seed)
        (front, front_s), (back, back_s) = (
            rendered(path, "pinhole", folder / f"{name}.{samples}.{seed}.exr", samples, *more)
            for name, path in (("front", scene), ("behind", behind))
        )
        blur, blur_s = blurred("lights", front, True, back)
        traced.append(read_exr(exact)[0].astype(np.float64))
        found.append(blur.rgb)
        spent.append((front_s + back_s + blur_s, exact_s))
    mean = (traced[0] + traced[1]) / 2
    noise, traced_noise = (rel_mse(mean + (a - b) / math.sqrt(2), mean) for a, b in (found, traced))
    error = float(np.mean([rel_mse(rgb, mean) for rgb in found])) - traced_noise / 2
    ours, theirs = np.min(spent, axis=0).tolist()
    light = float(np.sum(found, dtype=np.float64) / np.sum(traced) - 1)
    faster = [theirs * traced_noise / v / ours for v in (noise, error)]
    row: lab.Row = {"plate": samples, "cpu_s": ours, "noise": noise, "error": error, "light": light}
    row |= {"traced_s": theirs, "traced_noise": traced_noise}
    return row | {"faster": faster[0], "faster_to_error": faster[1]}


def point_light(field_mm: float, distance_m: float, samples: int = 32768) -> lab.Row:
    """A small ball that shines, path-traced through the lens, beside the lens's kernel at its place.

    The film is a strip, as wide as the disc of blur: the same lens and the same field, and fewer pixels. The kernel is
    spread over the ball's own picture. Returns FLIP, and relative differences of area ((sum)^2 / sum of squares) and
    of light.
    """
    shot = Shot(_STRIP_MM, _STRIP_FOCUS_M, f_number=F_NUMBER, wavelength_nm=LIGHT_NM)
    camera = make_camera(f"{lab.LENSES / LENS}.toml", shot)
    size = round(_STRIP_MM[0] * _PER_MM), round(_STRIP_MM[1] * _PER_MM)
    fine = size[0] * _FINER, size[1] * _FINER  # the kernel's pixels, so that the ball's outline is sharp
    plate, ball = own_plate(camera, fine), _BALL_PX * _FINER
    pinhole = plate.pinhole
    place, ahead = (fine[0] / 2, fine[1] / 2 - field_mm * _PER_MM * _FINER), distance_m - pinhole.before_film_mm / 1000
    kernel = kernel_at(camera, plate, place, 1 / ahead, place)
    assert kernel is not None
    kernel = kernel.tinted(tint(camera))
    scene = (
        "[camera]\nposition_m = [0, 0, 0]\nlook_at_m = [0, 0, -1]\nfocus_m = 1\n[environment]\ncolour = [0, 0, 0]\n"
        f"[[spheres]]\ncentre_m = [0, {(fine[1] / 2 - place[1]) / pinhole.reach_px[1] * ahead}, {-distance_m}]\n"
        f"radius_m = {ball / pinhole.reach_px[0] * ahead}\nemission = [1, 1, 1]\n"
    )
    with tempfile.TemporaryDirectory() as folder:
        (path := Path(folder) / "point.toml").write_text(scene, encoding="utf-8")
        loaded = load_scene(path)
    reach = kernel.corner_px[1], kernel.corner_px[1] + kernel.light.shape[0]
    rows = max(0, (reach[0] - ball) // _FINER - 2), min(size[1], (reach[1] + ball) // _FINER + 3)
    traced = render(
        loaded, camera, width=size[0], height=size[1], samples=samples, threads=1, max_depth=1, rows=rows
    ).rgb
    meant, side = np.zeros((fine[1], fine[0], 3)), range(-ball, ball + 1)
    inside = [(j, i) for j, i in itertools.product(side, side) if math.hypot(j, i) <= ball]
    share = math.pi * ball**2 * math.hypot(1, (fine[1] / 2 - place[1]) / pinhole.reach_px[1]) / len(inside)
    for j, i in inside:  # off the axis a ball looks larger, by the cosine
        here = meant[kernel.corner_px[1] + j :, kernel.corner_px[0] + i :]
        here[: kernel.light.shape[0], : kernel.light.shape[1]] += share * kernel.light
    meant = meant.reshape(size[1], _FINER, size[0], _FINER, 3).mean(axis=(1, 3))[rows[0] : rows[1]]
    bright = 2 * float((meant**2).sum() / meant.sum())  # twice the mean over the disc
    areas = [float(rgb.sum()) ** 2 / float((rgb.astype(np.float64) ** 2).sum()) for rgb in (meant, traced)]
    light = float(meant.sum() / traced.sum(dtype=np.float64))
    row: lab.Row = {"field_mm": field_mm, "distance_m": distance_m, "flip": flip(meant / bright, traced / bright)}
    return row | {"area": areas[0] / areas[1] - 1, "light": light - 1, "area_px": areas[1] / 3}


def large_s(scene: str, folder: Path) -> tuple[float, int]:
    """Seconds of a core for a plate of 4K, and its highlights."""
    camera, small = camera_and_plate(scene, picture_of(scene, "pinhole", folder)[0])
    factor = _LARGE[0] // small.size[0]
    texel = small.layers[0].texel.repeat(factor, 0).repeat(factor, 1)
    pinhole = small.pinhole
    (x, y), (u, v) = pinhole.reach_px, pinhole.centre_px
    pinhole = PlatePinhole((x * factor, y * factor), (u * factor, v * factor), pinhole.before_film_mm)
    plate = Plate([Layer(texel[..., :3], texel[..., 3])], pinhole, (texel.shape[1], texel.shape[0]), small.space)
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
{lens} at f/{f_number:g}, {width} pixels wide; FLIP of plates of {plate} samples a pixel, blurred, against the same lens
path-traced with {samples} (goal 0.06). Two path-traced pictures of {worst} with other seeds differ by FLIP
{floor:.3f}; from the mean of both the blurred plate differs by {better:.3f}. A plate of {first} at
{wide} x {high} takes {large:.0f} s of one core (goal 60), {count} highlights among them."""
_POINTS, _PLATES = ((0.0, 0.8), (12.0, 0.8), (12.0, 10.0)), (16, 64)
_POINT_COLUMNS = lab.columns(
    ("mm from the axis", "field_mm", "g"),
    ("m", "distance_m", "g"),
    ("area, pixels", "area_px", ".0f"),
    ("FLIP", "flip", ".3f"),
    ("area", "area", "+.2%"),
    ("light", "light", "+.2%"),
)
_NOISE_COLUMNS = lab.columns(
    ("samples of the plates", "plate"),
    ("CPU s, plates and blur", "cpu_s", ".1f"),
    ("CPU s, path-traced", "traced_s", ".1f"),
    ("noise", "noise", ".5f"),
    ("noise, path-traced", "traced_noise", ".5f"),
    ("error", "error", ".5f"),
    ("light", "light", "+.2%"),
    ("times as long to equal noise", "faster", ".1f"),
    ("to equal error", "faster_to_error", ".1f"),
)
_CHECKS = """\
{lens} at f/{f_number:g}. A ball two pixels wide, path-traced through the lens with 32,768 samples a pixel, beside the
kernel of its place, spread over the ball's picture (goals: FLIP 0.02, area within 1%; area is (sum)^2 over the sum of
squares). FLIP is over a strip about the disc, with twice the disc's mean as white; the render's noise is in it.

The scene lights: plates with overscan and a layer behind the figures, blurred, beside the lens path-traced with
{samples} samples a pixel (goals: ten times, light within 1%). Noise and error are relative mean squares: noise by two
seeds, error against the mean of both path-traced pictures, whose noise is taken out. Times to equal noise scale the
path-traced noise by 1 / samples; to equal error, what one eye cannot see (mirrors, edges) counts, too."""
OPTIONS = (
    lab.ONLY,
    lab.option("--pictures", type=Path, default=Path("runs/defocus"), metavar="FOLDER", help="where renders are kept"),
    lab.option("--large", action="store_true", help="the time of a 4K plate alone"),
    lab.option("--checks", action="store_true", help="points of light and equal noise only: defocus_checks.md"),
    lab.out(),
)


def run_checks(args: argparse.Namespace) -> None:
    """Points of light, and the time to equal noise."""
    points = [point_light(*place) for place in _POINTS]
    noises = [equal_noise(args.pictures, samples) for samples in _PLATES]
    about = _CHECKS.format(lens=LENS, f_number=F_NUMBER, samples=SAMPLES["fused"])
    parts = about.split("\n\n")
    head = (
        "# Kernels beside renders of points of light, and the time to equal noise",
        "`python -m experiments defocus --checks`",
    )
    tables = lab.table(_POINT_COLUMNS, points), parts[1], lab.table(_NOISE_COLUMNS, noises)
    text = lab.page(*head, parts[0], lab.machine_line(), *tables)
    data = {"machine": lab.machine(), "points": points, "noise": noises}
    print(lab.write_results(args.out, "defocus_checks", text, data))


def run(args: argparse.Namespace) -> None:
    """Measure scene by scene."""
    lab.quiet_glasses()
    args.pictures.mkdir(parents=True, exist_ok=True)
    if args.checks:
        return run_checks(args)
    if args.large:
        known = json.loads((lab.RESULTS / "defocus.json").read_text(encoding="utf-8"))
        rows, _ = known.pop("rows"), known.pop("machine")
        large, count = large_s(known["first"], args.pictures)
        return _write(args, {**known, "large": large, "count": count}, rows)
    rows = []
    for scene, report in lab.stages(lab.chosen(SCENES, str, args.only, "defocus"), str, args.quiet):
        rows.append(measure(scene, args.pictures))
        report(1.0)
    first, worst = rows[0]["scene"], max(rows, key=lambda row: row["flip"])["scene"]
    two = [read_exr(picture_of(worst, "fused", args.pictures, seed)[0])[0] for seed in (0, _FLOOR_SEED)]
    plate = picture_of(worst, "pinhole", args.pictures)[0]
    better = flip(blurred(worst, plate, True)[0].rgb, (two[0] + two[1]) / 2)
    large, count = large_s(first, args.pictures)
    known = {"lens": LENS, "f_number": F_NUMBER, "width": WIDTH, "first": first, "worst": worst, "better": better}
    known |= {"samples": SAMPLES["fused"], "plate": SAMPLES["pinhole"]}
    known |= {"floor": flip(*two), "wide": _LARGE[0], "high": _LARGE[1], "large": large, "count": count}
    _write(args, known, rows)


def _write(args: argparse.Namespace, known: lab.Row, rows: list[lab.Row]) -> None:
    """Write the page and its figures."""
    head = "# Blur of a lens for sharp pictures, beside path-traced ones", "`python -m experiments defocus`"
    text = lab.page(*head, _NOTES.format(**known), lab.machine_line(), lab.table(_COLUMNS, rows))
    print(lab.write_results(args.out, "defocus", text, {**known, "machine": lab.machine(), "rows": rows}))
