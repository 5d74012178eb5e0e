"""Noise of the ways to sample wavelengths, at equal samples and at equal time.

Every way has the same mean, so its error is its variance over seeds: of luminance Y, and of colour (R - G and B - G),
each relative to (Y + 0.05)^2 of the pixel and averaged over the picture, so that lamps do not outweigh the rest. The
scenes of experiments/scenes at 96 pixels across through a thin lens, and one through an exact lens, which disperses.
Writes spectral_noise.json and spectral_noise.md.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from experiments import lab
from neurolens.base.progress import Progress
from neurolens.cameras.build import Shot, make_camera
from neurolens.render.colour import SRGB
from neurolens.render.film_settings import FilmSettings
from neurolens.render.renderer import RenderResult, render
from neurolens.render.scene import load_scene

WIDTH = 96
EXACT = "laikin_double_gauss_50"
UNIFORM = FilmSettings(wavelengths="one", wavelength_sampling="uniform")


WAYS = {
    "one, uniform": UNIFORM,
    "one, importance": FilmSettings(wavelengths="one"),
    "hero, uniform": FilmSettings(wavelengths="hero", wavelength_sampling="uniform"),
    "hero, importance": FilmSettings(wavelengths="hero"),
}


DISPERSIVE_WAYS = {
    "one, uniform": UNIFORM,
    "one, importance": FilmSettings(wavelengths="one"),
    "lanes, importance": FilmSettings(wavelengths="lanes"),
}


PICTURES = [(scene, "thin", WAYS) for scene in ("room", "lights", "grid", "lamps")] + [("room", EXACT, DISPERSIVE_WAYS)]


def measure(
    scene_name: str, camera_name: str, ways: dict[str, FilmSettings], seeds: int, samples: int
) -> list[lab.Row]:
    """Variances and seconds of each way, and how many times less than the first way's they are."""
    scene = load_scene(lab.SCENES / f"{scene_name}.toml")
    shot = scene.settings.camera
    film_mm = (shot.film_width_mm, shot.film_height_mm)
    spec = camera_name if camera_name == "thin" else lab.LENSES / f"{camera_name}.toml"
    camera = make_camera(spec, Shot(film_mm, shot.focus_m, shot.f_number, clamp_f_number=True))
    size: dict[str, Any] = {"width": WIDTH, "height": round(WIDTH * film_mm[1] / film_mm[0])}
    results: dict[str, list[RenderResult]] = {name: [] for name in ways}
    for seed in range(seeds):
        for name, film in ways.items():
            results[name].append(render(scene, camera, samples=samples, seed=seed, threads=1, film=film, **size))
    return [{"scene": scene_name, "camera": camera_name, "wavelengths": n, **_noise(r)} for n, r in results.items()]


def _noise(results: list[RenderResult]) -> dict[str, float]:
    pictures = np.stack([r.rgb for r in results]).astype(np.float64)
    luminance = pictures @ SRGB.to_xyz[1]
    scale = (luminance.mean(axis=0) + 0.05) ** 2
    colour = (pictures[..., [0, 2]] - pictures[..., 1:2]).var(axis=0, ddof=1).sum(axis=-1)
    return {
        "luminance": float(np.mean(luminance.var(axis=0, ddof=1) / scale)),
        "colour": float(np.mean(colour / scale)),
        "seconds": min(r.stats["seconds"] for r in results),
    }


def _columns(base: lab.Row) -> tuple[lab.Column, ...]:
    """Of a picture, over its first way."""

    def gain(kind: str, equal_time: bool) -> Any:
        return lambda r: base[kind] / r[kind] / (r["seconds"] / base["seconds"] if equal_time else 1.0)

    return lab.columns(
        ("scene", "scene"),
        ("camera", "camera"),
        ("wavelengths", "wavelengths"),
        ("variance of luminance", "luminance", ".4f"),
        ("of colour", "colour", ".4f"),
        ("time", "seconds", ".2f", 1 / base["seconds"]),
        ("luminance, equal samples", gain("luminance", False), ".2f"),
        ("colour, equal samples", gain("colour", False), ".2f"),
        ("luminance, equal time", gain("luminance", True), ".2f"),
        ("colour, equal time", gain("colour", True), ".2f"),
    )


def page(pictures: list[list[lab.Row]], seeds: int, samples: int) -> str:
    """The table."""
    cells = [[c.cell(row) for c in _columns(rows[0])] for rows in pictures for row in rows]
    return lab.page(
        "# Noise of the ways to sample wavelengths",
        f"`python -m experiments spectral-noise --seeds {seeds} --samples {samples}`. The last four columns "
        "say how many times less the variance is than with one uniform wavelength per path.",
        lab.table([c.title for c in _columns(pictures[0][0])], cells),
    )


OPTIONS = (lab.count("seeds", 24, "default 24", 2), lab.count("samples", 16, "a pixel (default 16)"), lab.out())


def run(args: argparse.Namespace) -> None:
    """Measure and write."""
    lab.quiet_glasses()
    found: list[list[lab.Row]] = []
    with Progress(quiet=args.quiet).stage("spectral noise") as report:
        for scene, camera, ways in PICTURES:
            found.append(measure(scene, camera, ways, args.seeds, args.samples))
            report(len(found) / len(PICTURES))
    settings = {"seeds": args.seeds, "samples": args.samples}
    data = {"settings": settings, "rows": [row for rows in found for row in rows]}
    print(lab.write_results(args.out, "spectral_noise", page(found, args.seeds, args.samples), data))
