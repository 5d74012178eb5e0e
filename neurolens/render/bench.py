"""How fast the renderer is: `python -m neurolens.render.bench SCENE --threads 2 --depth 3 --samples 16 --repeats 5`.

Prints minimum and median time and the speeds they stand for, through a thin lens with the scene's focus and aperture.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path

from neurolens.base.errors import InputError, NeurolensError
from neurolens.cameras.thin import ThinLens
from neurolens.render.renderer import render
from neurolens.render.scene import load_scene
from neurolens.render.wavelengths import LANES


def measure(
    scene: str | Path, threads: int = 2, depth: int = 3, samples: int = 16, repeats: int = 5
) -> dict[str, float]:
    """Speed of a scene file at its own picture size.

    Returns:
        mpaths_per_s of the fastest and of the median render, their seconds, threads, depth, lanes (wavelengths a path)
        and paths a render.

    Raises:
        InputError: a scene that cannot be read, a count below 1.
    """
    if repeats < 1:
        raise InputError("bench", "repeats", repeats, "an integer above 0")
    loaded = load_scene(scene)
    settings = loaded.settings.camera
    film_mm = (settings.film_width_mm, settings.film_height_mm)
    camera = ThinLens(50.0, settings.f_number or 2.8, settings.focus_m, film_mm)
    stats = [
        render(loaded, camera, samples=samples, threads=threads, max_depth=depth, seed=k).stats for k in range(repeats)
    ]
    seconds = [s["seconds"] for s in stats]
    paths = stats[0]["paths"]
    return {
        "mpaths_per_s": paths / min(seconds) * 1e-6,
        "mpaths_per_s_median": paths / statistics.median(seconds) * 1e-6,
        "seconds_min": min(seconds),
        "seconds_median": statistics.median(seconds),
        "paths": paths,
        "threads": threads,
        "max_depth": depth,
        "lanes": LANES if stats[0]["wavelengths"] == "hero" else 1,
    }


def main(argv: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status, 2 for bad input."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="scene file (TOML)")
    for name, default in (("threads", 2), ("depth", 3), ("samples", 16), ("repeats", 5)):
        parser.add_argument(f"--{name}", type=int, default=default, help=f"default {default}")
    try:
        found = measure(**vars(parser.parse_args(argv)))
    except NeurolensError as error:
        print(error, file=sys.stderr)
        return 2
    print(
        f"{found['mpaths_per_s']:.2f} Mpath/s fastest, {found['mpaths_per_s_median']:.2f} median "
        f"({found['paths']} paths of depth {found['max_depth']}, wavelengths each: {found['lanes']}, "
        f"{found['threads']} threads, {found['seconds_min']:.2f} s fastest, {found['seconds_median']:.2f} s median)"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
