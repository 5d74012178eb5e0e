"""Noise of the ways to sample wavelengths, at equal samples and at equal time.

    python experiments/spectral_noise.py [--seeds 24] [--samples 16]

Every way has the same mean, so its error is its variance over seeds: of luminance Y, and of colour (R - G and B - G),
each relative to (Y + 0.05)^2 of the pixel and averaged over the picture, so that lamps do not outweigh the rest. The
scenes of experiments/scenes at 96 pixels across through a thin lens, and one through an exact lens, which disperses.
Writes spectral_noise.json and spectral_noise.md to experiments/results/.
"""

from __future__ import annotations

import argparse
import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.base.errors import NeurolensWarning
from neurolens.base.files import atomic_write_text
from neurolens.cameras.build import Shot, make_camera
from neurolens.render.colour import SRGB
from neurolens.render.film import FilmSettings
from neurolens.render.renderer import RenderResult, render
from neurolens.render.scene import load_scene

ROOT = Path(__file__).parents[1]
OUT = ROOT / "experiments" / "results"
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
) -> dict[str, dict[str, float]]:
    """Relative variances of one picture and the fastest render's seconds, by way; the ways take turns."""
    scene = load_scene(ROOT / "experiments" / "scenes" / f"{scene_name}.toml")
    shot = scene.settings.camera
    film_mm = (shot.film_width_mm, shot.film_height_mm)
    spec = camera_name if camera_name == "thin" else ROOT / "lenses" / f"{camera_name}.toml"
    camera = make_camera(spec, Shot(film_mm, shot.focus_m, shot.f_number, clamp_f_number=True))
    size: dict[str, Any] = {"width": WIDTH, "height": round(WIDTH * film_mm[1] / film_mm[0])}
    results: dict[str, list[RenderResult]] = {name: [] for name in ways}
    for seed in range(seeds):
        for name, film in ways.items():
            results[name].append(render(scene, camera, samples=samples, seed=seed, threads=1, film=film, **size))
    return {name: _noise(found) for name, found in results.items()}


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


def row(name: str, found: dict[str, float], base: dict[str, float]) -> str:
    """A line of the table: variances, and how many times less they are than the first way's."""
    slower = found["seconds"] / base["seconds"]
    cells = [name, f"{found['luminance']:.4f}", f"{found['colour']:.4f}", f"{slower:.2f}"]
    cells += [f"{base[kind] / found[kind] / by:.2f}" for by in (1.0, slower) for kind in ("luminance", "colour")]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=24)
    parser.add_argument("--samples", type=int, default=16)
    args = parser.parse_args()
    warnings.simplefilter("ignore", NeurolensWarning)
    rows: list[dict[str, Any]] = []
    header = "scene | camera | wavelengths | variance of luminance | of colour | time"
    gains = "luminance, equal samples | colour, equal samples | luminance, equal time | colour, equal time"
    lines = [
        "# Noise of the ways to sample wavelengths",
        "",
        f"`python experiments/spectral_noise.py --seeds {args.seeds} --samples {args.samples}`. The last four columns "
        "say how many times less the variance is than with one uniform wavelength per path.",
        "",
        f"| {header} | {gains} |",
        "|" + "---|" * 10,
    ]
    for scene, camera, ways in PICTURES:
        measured = measure(scene, camera, ways, args.seeds, args.samples)
        for name, found in measured.items():
            rows.append({"scene": scene, "camera": camera, "wavelengths": name, **found})
            lines.append(row(f"{scene} | {camera} | {name}", found, measured["one, uniform"]))
            print(lines[-1], flush=True)
    OUT.mkdir(parents=True, exist_ok=True)
    settings = {"seeds": args.seeds, "samples": args.samples}
    atomic_write_text(OUT / "spectral_noise.json", json.dumps({"settings": settings, "rows": rows}, indent=1) + "\n")
    atomic_write_text(OUT / "spectral_noise.md", "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
