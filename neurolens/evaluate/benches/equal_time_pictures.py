"""The pictures of `neurolens bench equal-time`: error over time, FLIP maps at equal samples, film-space maps."""

from __future__ import annotations

import math
from pathlib import Path

from PIL import Image

from neurolens.base.files import atomic_path
from neurolens.evaluate.benches.equal_time import MEASURES, CameraResult, SceneResult
from neurolens.evaluate.benches.equal_time_cameras import EXACT
from neurolens.evaluate.plots.equal_time import Panel, error_over_time_plot, film_maps_plot
from neurolens.evaluate.plots.image import side_by_side

_MOST_BYTES = 150_000  # of a picture
_TITLES = {"mse": "RMSE (linear radiance)", "rel_mse": "relative RMSE (share of 1)"}


def draw(result: SceneResult, folder: Path) -> list[Path]:
    """Three pictures: error over time, FLIP maps at equal samples, film-space maps."""
    shot, counts = result.settings, result.counts
    threads = f"{result.threads} thread" + ("" if result.threads == 1 else "s")
    where = f"{result.name}, f/{result.f_number:.3g}, focused at {shot.focus_m:g} m"
    size = f"{counts.size[0]} x {counts.size[1]} pixels"
    over_time = error_over_time_plot(
        [*(_root_panel(result, measure) for measure in MEASURES), _flip_panel(result)],
        folder / f"{result.name}-error.png",
        f"Error against render time: {where}",
        f"{size}, {threads}; markers: 1, 2, 4 ... samples a pixel; the reference has {2 * counts.reference}",
    )
    total = counts.pass_samples * counts.passes
    shown = {n: c for n, c in result.cameras.items() if not n.startswith("fused")}  # whose pictures are their models'
    flips = side_by_side(
        {"reference": result.reference} | {n: c.picture for n, c in shown.items()},
        {n: c.flip_map for n, c in shown.items()},
        folder / f"{result.name}-flip.png",
        {n: _flip_caption(c) for n, c in shown.items()},
        title=f"{result.name}: FLIP against the reference, {total} samples each",
    )
    films = film_maps_plot(
        {n: c.film.median_um for n, c in result.cameras.items()},
        (shot.film_width_mm, shot.film_height_mm),
        folder / f"{result.name}-film.png",
        f"Film-space error: {where}",
        "against the exact ray in float64 of the same film and pupil point; median over pupil and wavelengths",
        {
            n: f"all rays: median {um_text(c.film.p50_um)}, 99% {um_text(c.film.p99_um)} µm"
            for n, c in result.cameras.items()
        },
    )
    for picture in (over_time, flips, films):
        _fewer_colours(picture)
    return [over_time, flips, films]


def um_text(value: float) -> str:
    """Micrometres with two figures, whole from 100 on."""
    return f"{value:.0f}" if value >= 100 else f"{value:.2g}"


def _flip_caption(camera: CameraResult) -> str:
    same = "" if camera.name == EXACT else f"\nfrom exact, same random numbers: {camera.flip_same:.2g}"
    return f"FLIP {camera.flip_map.mean():.3g}{same}"


def _root_panel(result: SceneResult, measure: str) -> Panel:
    def curve(camera: CameraResult) -> tuple[list[float], list[float]]:
        squares = [getattr(level, measure) for level in camera.levels]
        return [level.seconds_min for level in camera.levels], [math.sqrt(s) if s > 0 else math.nan for s in squares]

    biased = {n: math.sqrt(c.bias2[measure].value) for n, c in result.cameras.items() if c.bias2[measure].resolved}
    curves = {n: curve(c) for n, c in result.cameras.items()}
    return Panel(_TITLES[measure], curves, math.sqrt(result.noise2[measure]), "noise of the reference", biased)


def _flip_panel(result: SceneResult) -> Panel:
    curves = {
        n: ([level.seconds_min for level in c.levels], [level.flip for level in c.levels])
        for n, c in result.cameras.items()
    }
    return Panel("mean FLIP (0 to 1)", curves, result.flip_halves, "between halves of the reference", {})


def _fewer_colours(picture: Path) -> None:
    """Keep at most 256 colours of a PNG, half as many and so on until it is small enough for the repository."""
    with Image.open(picture) as full:
        pixels = full.convert("RGB")
    for colours in (256, 128, 64, 32):
        with atomic_path(picture) as temporary:
            pixels.quantize(colours, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(
                temporary, optimize=True
            )
        if picture.stat().st_size <= _MOST_BYTES:
            return
