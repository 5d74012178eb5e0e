"""Stars about lights: checks of the diffraction against closed forms, and the seconds that stars take.

The lens is a double Gauss 50 mm f/1.8 on 36 x 24 mm. Seconds of the clock stand beside
seconds of a core, since other programs share the machine. Writes starburst.md and starburst.json.
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
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens
from neurolens.pictures.flare.canvas import Raster
from neurolens.pictures.flare.diffraction import far_field, outline_spectrum, star, starburst_picture
from neurolens.pictures.flare.exit_pupil import Array, ExitPupil, coverage, exit_pupil, outline
from neurolens.pictures.flare.job import FlareJob
from neurolens.pictures.flare.lights import Light

LENS, NM, FILM_MM = "laikin_double_gauss_50", 550.0, (36.0, 24.0)
STOPS, LARGE = (1.8, 4.0, 8.0, 16.0, 45.0), (960, 640)

OPTIONS = [lab.count("threads", 2, "default: 2"), lab.out()]


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
    """Check, time, write; 1 where a check is off by more than its goal."""
    progress = Progress(quiet=args.quiet)
    with progress.stage("checks"):
        rings, streaks, light = _rings(), _streaks(), _light()
    with progress.stage("seconds"):
        seconds = [_seconds(f_number, args) for f_number in STOPS]
    goals = [
        lab.Goal("dark ring, relative error", 0.005, max(c.off for c in rings)),
        lab.Goal("number of streaks, relative error", 0.0, max(c.off for c in streaks)),
        lab.Goal("all light, relative error", 0.005, max(c.off for c in light)),
        lab.Goal("seconds of a core for a picture", 10.0, max(s["core"] for s in seconds)),
    ]
    text = lab.page(
        "# Stars", __doc__ or "", lab.table(_CHECKS, [*rings, *streaks, *light]), lab.table(_SECONDS, seconds),
        lab.goal_table("Goal", goals), lab.machine_line(),
    )  # fmt: skip
    checks = [*rings, *streaks, *light]
    data = {"machine": lab.machine(), "checks": checks, "seconds": seconds}
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
    film = starburst_picture(FlareJob(lens, [light], Raster(FILM_MM, *LARGE), threads=args.threads))
    spent = time.perf_counter() - began[0], time.process_time() - began[1]
    pupil = exit_pupil(lens, light, NM)
    assert pupil is not None
    lines, pixel = outline(pupil), FILM_MM[0] / LARGE[0]
    film = _star(pupil, lines, pixel, 400)
    aside = float(film.sum()) * pixel**2 / light_of(pupil, lines)
    return {"stop": f"f/{f_number:g}", "seconds": spent[0], "core": spent[1], "aside": aside}


_CHECKS = lab.columns(
    ("", "what"), ("measured", "found", ".4f"), ("right", "right", ".4f"), ("off", "off", ".3%")
)  # fmt: skip
_SECONDS = lab.columns(
    ("960 x 640, 15 wavelengths, 7 blades, 6 and 3 degrees off", "stop"),
    ("seconds", "seconds", ".1f"),
    ("of a core", "core", ".1f"),
    ("light that leaves the image, 550 nm", "aside", ".2%"),
)
