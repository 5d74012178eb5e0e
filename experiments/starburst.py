"""Stars about lights: their shapes by stop, blades and field, checks of the diffraction against closed forms, and the
sampled Keller cones of Steinert's thesis (2009) beside it.

The lens is a double Gauss 50 mm f/1.8 on 36 x 24 mm; a light on the axis and one 15 degrees off. Keller's cones: edge
points drawn by chance, from each a ray across its edge whose light falls as the square of the angle, added without
phase (the constant is that of the geometrical theory of diffraction for small angles). Seconds are told with those of a
core, for others work on the machine. Writes starburst.md, starburst.json and starburst.png.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments import lab
from neurolens.base.progress import Progress
from neurolens.flare.canvas import Raster
from neurolens.flare.diffraction import far_field, outline_spectrum, star, starburst_picture
from neurolens.flare.exit_pupil import Array, ExitPupil, coverage, exit_pupil, outline
from neurolens.flare.lights import Light
from neurolens.lens.apertures import Aperture
from neurolens.lens.prescription import Lens
from neurolens.readers.lensfile import read_lens
from neurolens.setting.states import set_lens

LENS, NM, FILM_MM = "laikin_double_gauss_50", 550.0, (36.0, 24.0)
STOPS, BLADES, CURVATURES, FIELDS = (4.0, 8.0, 16.0), (6, 7, 9), (0.0, 0.7), (0.0, 15.0)
LARGE, SMALL, DECADES = (960, 640), (216, 144), 5.0
_RAYS, _MOST_BYTES = 1 << 20, 350_000

OPTIONS = [
    lab.count("wavelengths", 5, "of the pictures drawn (default: 5)"),
    lab.count("threads", 2, "default: 2"),
    lab.out(),
]


@dataclass(frozen=True)
class Check:
    """A measured figure and the right one; `off` is the relative error."""

    what: str
    found: float
    right: float

    @property
    def off(self) -> float:
        return abs(self.found / self.right - 1)


def run(args: argparse.Namespace) -> int:
    """Check, draw, write; 1 where a check is off by more than its goal."""
    progress = Progress(quiet=args.quiet)
    with progress.stage("checks"):
        rings, streaks, light = _rings(), _streaks(), _light()
        keller = _keller_rows()
    with progress.stage("seconds"):
        seconds = [_seconds(f_number, args) for f_number in (1.8, *STOPS, 45.0)]
    with progress.stage("pictures") as report:
        _draw(args, report)
    goals = [
        lab.Goal("dark ring, relative error", 0.005, max(c.off for c in rings)),
        lab.Goal("number of streaks, relative error", 0.0, max(c.off for c in streaks)),
        lab.Goal("all light, relative error", 0.005, max(c.off for c in light)),
        lab.Goal("seconds of a core for a picture", 10.0, max(s["core"] for s in seconds)),
    ]
    text = lab.page(
        "# Stars", __doc__ or "", lab.table(_CHECKS, [*rings, *streaks, *light]), lab.table(_SECONDS, seconds),
        "Keller's cones, sampled, beside the far field, f/16:", lab.table(_KELLER, keller),
        lab.goal_table("Goal", goals), f"{_PICTURE} {lab.machine_line()}",
    )  # fmt: skip
    checks = [*rings, *streaks, *light]
    data = {"machine": lab.machine(), "checks": checks, "seconds": seconds, "keller": keller}
    print(lab.write_results(args.out, "starburst", text, data))
    return int(any(goal.verdict == "missed" for goal in goals))


def lens_at(f_number: float, aperture: Aperture | None = None) -> Lens:
    """The lens, focused at infinity."""
    lens = read_lens(lab.LENSES / f"{LENS}.toml").with_aperture(aperture)
    return set_lens(lens, f_number=f_number, focus_m=math.inf, focus_mode="best")


def _pupil(f_number: float, aperture: Aperture | None = None) -> tuple[ExitPupil, list[Array]]:
    pupil = exit_pupil(lens_at(f_number, aperture), Light(0.0, 0.0), NM)
    assert pupil is not None
    return pupil, outline(pupil)


def _rings() -> list[Check]:
    """The first dark ring of round stops, 0.6098 lambda / NA."""
    found = []
    for f_number in (8.0, 16.0, 45.0):
        pupil, lines = _pupil(f_number)
        right = 0.609835 * NM * 1e-6 / (np.ptp(lines[0][0]) / 2 * pupil.half[0])
        x = right * np.linspace(0.9, 1.1, 401)
        dark = x[np.argmin(far_field(pupil, lines, x, np.zeros(1))[0])]
        found.append(Check(f"first dark ring at f/{f_number:g}, um", 1000 * float(dark), 1000 * float(right)))
    return found


def _star(pupil: ExitPupil, lines: list[Array], pixel: float, reach: int) -> Array:
    x = np.arange(-reach, reach + 1) * pixel
    return star(pupil, lines, outline_spectrum(pupil, lines, NM, pixel, 1.5 * x[-1]), x, x, pixel)


def streaks(film: Array, low: int, high: int) -> int:
    """The number of streaks of a star [N, N] from `low` to `high` pixels out."""
    angle, middle = np.arange(720) * math.pi / 360, len(film) // 2
    rows, columns = (np.rint(middle + np.arange(low, high)[:, None] * f(angle)).astype(int) for f in (np.sin, np.cos))
    smooth = np.fft.irfft(np.fft.rfft(film[rows, columns].mean(0))[:60], 720)
    peaks = (smooth > np.roll(smooth, 1)) & (smooth > np.roll(smooth, -1)) & (smooth > 0.3 * smooth.max())
    return int(peaks.sum())


def _streaks() -> list[Check]:
    """2 n of an odd number of blades, n of an even one."""
    found = []
    for blades in (5, 6, 7, 8, 9):
        count = streaks(_star(*_pupil(16.0, Aperture(blades=blades, rotation_deg=7.0)), 0.0375, 100), 70, 95)
        found.append(Check(f"streaks of {blades} blades", float(count), float(blades * (1 + blades % 2))))
    return found


def light_of(pupil: ExitPupil, lines: list[Array]) -> float:
    """Light that passes, for an irradiance of 1 at the lens, mm^2."""
    share = (np.arange(256) + 0.5) / 128 - 1
    e = np.abs(pupil.field((share, share))) ** 2 * coverage(lines, 256)
    return float(e.sum() * np.prod(pupil.half / 128))


def _light() -> list[Check]:
    """Layer, image and what round stops send beyond the frame (2 lambda N / pi^2 r) against all that arrives."""
    found, pixel, reach = [], 0.0375, 100
    for f_number in (8.0, 16.0):
        pupil, lines = _pupil(f_number)
        film = _star(pupil, lines, pixel, reach)
        parts = 33
        fine = ((np.arange(-2, 3)[:, None] + (np.arange(parts) + 0.5) / parts - 0.5) * pixel).reshape(-1)
        core = far_field(pupil, lines, fine, fine).reshape(5, parts, 5, parts).mean((1, 3))
        core = core * (film[reach - 2 : reach + 3, reach - 2 : reach + 3] == 0)
        angle, na = np.linspace(0, math.pi / 4, 200), np.ptp(lines[0][0]) / 2 * pupil.half[0]
        tail = np.mean(NM * 1e-6 / na / (math.pi**2 * (reach + 0.5) * pixel / np.cos(angle)))
        share = (core.sum() + film.sum()) * pixel**2 / light_of(pupil, lines) + tail
        found.append(Check(f"all light at f/{f_number:g}", float(share), 1.0))
    return found


def _seconds(f_number: float, args: argparse.Namespace) -> dict[str, Any]:
    lens, light = lens_at(f_number, Aperture(blades=7)), Light(6.0, 3.0)
    began = time.perf_counter(), time.process_time()
    film = starburst_picture(lens, [light], Raster(FILM_MM, *LARGE), threads=args.threads)
    spent = time.perf_counter() - began[0], time.process_time() - began[1]
    pupil = exit_pupil(lens, light, NM)
    assert pupil is not None
    lines, pixel = outline(pupil), FILM_MM[0] / LARGE[0]
    film = _star(pupil, lines, pixel, 400)
    aside = float(film.sum()) * pixel**2 / light_of(pupil, lines)
    return {"stop": f"f/{f_number:g}", "seconds": spent[0], "core": spent[1], "aside": aside}


def _edges(pupil: ExitPupil, lines: list[Array]) -> tuple[Array, Array]:
    """Parts of an edge: their ways [2, N] in cosines, and e dl [N]."""
    ends = [np.append(line, line[:, :1], 1) * pupil.half[:, None] for line in lines]
    way = np.concatenate([np.diff(e) for e in ends], 1)
    middle = np.concatenate([(e[:, 1:] + e[:, :-1]) / 2 for e in ends], 1)
    return way, np.hypot(*way) * np.abs(pupil.field(middle / pupil.half[:, None])) ** 2


def _edge_light(pupil: ExitPupil, lines: list[Array]) -> float:
    """Light that cones send farther than u, times u."""
    return 2 * NM * 1e-6 * float(_edges(pupil, lines)[1].sum()) / (4 * math.pi**2)


def keller(pupil: ExitPupil, lines: list[Array], pixel: float, reach: int, rays: int = _RAYS) -> Array:
    """A star by sampled cones, [2 reach + 1] pixels a side: rays across edges, from half a pixel to beyond the frame.

    An element dl of the edge sends lambda e dl / (4 pi^2 u^2) to each side, per mm at the distance u.
    """
    way, weight = _edges(pupil, lines)
    chance = np.random.default_rng(0)
    which = chance.choice(len(weight), rays, p=weight / weight.sum())
    near, far = 0.5 * pixel, 2 * reach * pixel
    u = 1 / (1 / far + chance.random(rays) * (1 / near - 1 / far)) * chance.choice([-1, 1], rays)
    at = u * np.stack([way[1], -way[0]])[:, which] / np.hypot(*way[:, which])
    edges = (np.arange(2 * reach + 2) - reach - 0.5) * pixel
    count = np.histogram2d(at[1], at[0], bins=(edges, edges))[0]
    return count * (_edge_light(pupil, lines) * (1 / near - 1 / far) / rays / pixel**2)


def _keller_rows() -> list[dict[str, Any]]:
    rows, pixel, reach = [], 0.0375, 100
    for name, aperture in (("round", None), ("7 blades", Aperture(blades=7))):
        pupil, lines = _pupil(16.0, aperture)
        exact, cones = _star(pupil, lines, pixel, reach), keller(pupil, lines, pixel, reach)
        away = np.hypot(*np.mgrid[-reach : reach + 1, -reach : reach + 1])
        ring = (away > 20) & (away < 80)
        peak = [exact[np.abs(away - k) < 1].max() for k in range(101)]
        dim = ring & (exact < 0.01 * np.interp(away, np.arange(101), peak))
        even = np.interp(away, np.arange(101), [cones[np.abs(away - k) < 1].mean() for k in range(101)])
        # Where Airy's first ring is dark and the next bright, cones say the same.
        fringe = NM * 1e-6 * 16 * np.array([1.22, 1.635])
        first, second = (far_field(pupil, lines, np.array([r]), np.zeros(1))[0, 0] for r in fringe)
        row = {"stop": name, "light": float(cones[ring].sum() / exact[ring].sum())}
        row["dim"] = float(cones[dim].sum() / exact[dim].sum()) if dim.any() else None
        row["noise"] = float(np.std(cones[ring] / even[ring] - 1)) if aperture is None else None
        row["contrast"] = float((second - first) / (second + first)) if aperture is None else None
        row["too_much"] = _edge_light(pupil, lines) / light_of(pupil, lines) / (NM * 1e-6 * 16)
        rows.append(row)
    return rows


def _shown(picture: Array, white: float) -> Array:
    """A picture [H, W, 3] with brightness by its logarithm, `DECADES` below white; hues stay."""
    bright = np.maximum(picture.max(-1, keepdims=True), 1e-30)
    scale = np.clip(1 + np.log10(bright / white) / DECADES, 0, 1)
    return np.clip(picture / bright, 0, 1) * scale


def _draw(args: argparse.Namespace, report: Any) -> None:
    from PIL import Image, ImageDraw

    columns = [(n, c) for n in STOPS for c in CURVATURES]
    rows = [(b, f) for b in BLADES for f in FIELDS]
    width, height, edge = *SMALL, 14
    size = (len(columns) * (width + 2), (len(rows) + 2) * (height + edge))
    sheet, done = Image.new("RGB", size, (24, 24, 24)), 0
    write = ImageDraw.Draw(sheet)

    def put(row: int, column: int, picture: Array, white: float, title: str) -> None:
        at = column * (width + 2), row * (height + edge)
        made = Image.fromarray((255 * _shown(picture, white)).astype(np.uint8))
        sheet.paste(made, (at[0], at[1] + edge))
        write.text((at[0] + 2, at[1] + 1), title, (220, 220, 220))

    for row, (blades, field) in enumerate(rows):
        for column, (f_number, curvature) in enumerate(columns):
            lens = lens_at(f_number, Aperture(blades=blades, curvature=curvature, rotation_deg=7.0))
            light, raster = Light(field, 0.0), Raster(FILM_MM, *SMALL)
            film = starburst_picture(lens, [light], raster, wavelengths=args.wavelengths, threads=args.threads)
            title = f"f/{f_number:g} {blades} {'round' if curvature else 'straight'} {field:g} deg"
            put(row, column, film, float(np.quantile(film.max(-1), 0.9999)), title)
            done += 1
            report(done / len(rows) / len(columns))
    half = min(SMALL) // 2 - 1
    for row, aperture in enumerate((None, Aperture(blades=7, rotation_deg=7.0))):
        pupil, lines = _pupil(16.0, aperture)
        exact = _star(pupil, lines, 0.0375, half)
        some, many = (keller(pupil, lines, 0.0375, half, rays) for rays in (1 << 14, 1 << 20))
        fine = 0.05 / half
        x = np.arange(-half, half + 1) * fine
        near, cones = far_field(pupil, lines, x, x), keller(pupil, lines, fine, half)
        panels = (
            (exact, "far field"), (some, "cones, 16384 rays"), (many, "cones, 2^20 rays"),
            (near, "far field, 0.1 mm"), (cones, "cones, 0.1 mm"),
        )  # fmt: skip
        for column, (film, title) in enumerate(panels):
            white = float((exact if column < 3 else near).max())
            put(len(rows) + row, column, np.repeat(film[..., None], 3, 2), white, f"f/16 550 nm {title}")
    args.out.mkdir(parents=True, exist_ok=True)
    colours = (sheet.quantize(n) for n in (256, 64, 32))
    forms = ((picture, {"optimize": True}) for picture in (sheet, *colours))
    lab.write_small(args.out / "starburst.png", forms, _MOST_BYTES)


_PICTURE = (
    "![Stars](starburst.png) Rows: 6, 7 and 9 blades, on the axis and 15 degrees off; columns: f/4, f/8, f/16, blades "
    "straight and rounded; brightness by its logarithm, five decades. Below: one wavelength, round and 7 blades, "
    "beside Keller's cones."
)
_CHECKS = lab.columns(
    ("", "what"), ("measured", "found", ".4f"), ("right", "right", ".4f"), ("off", "off", ".3%")
)  # fmt: skip
_SECONDS = lab.columns(
    ("960 x 640, 15 wavelengths, 7 blades, 6 and 3 degrees off", "stop"),
    ("seconds", "seconds", ".1f"),
    ("of a core", "core", ".1f"),
    ("light that leaves the image, 550 nm", "aside", ".2%"),
)
_KELLER = lab.columns(
    ("stop", "stop"),
    ("its light from 0.75 to 3 mm over ours", "light", ".3f"),
    ("the same between streaks", "dim", ".3f"),
    ("noise of a pixel, a million rays", "noise", ".0%"),
    ("contrast of the first rings (its: 0)", "contrast", ".2f"),
    ("distance in lambda N within which it has more than all light", "too_much", ".2f"),
)
