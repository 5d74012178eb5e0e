"""The table of passage rates as Markdown and JSON, theirs beside ours, and the picture of the pupils."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.base.files import atomic_write_text
from neurolens.cameras.exact import ExactCamera
from neurolens.evaluate.benches.passage import FILM_MM, METHODS, OURS, Passage
from neurolens.evaluate.plots.style import FAINT, FIELD_COLOURS, INK, new_figure, save, style

_INTRO = """\
# Share of rays that pass

`neurolens bench pupils`: {width:g} x {height:g} mm film, focus at infinity, 400 to 700 nm, {samples} rays a method.
Rates are percent of the rays sent from lit film points; the dark share of the film costs nothing and stands apart.
In brackets what the theses say of their lens. *Light* is the irradiance found through the pupil over that found
through a disc that is surely wide enough, in percent: below 100 the pupil is too small (its noise is about 0.2).
*Lost* is the share of the light that passes outside our outlines. *Search*: seconds, once a camera; *ns*: a sample.
"""
_METHODS = """\
rear rim: its disc, Steinert's and Willi's global pupil. exit pupil: the paraxial one at this stop. Wu: one disc by a
search in two steps. pixel disc, ellipse: about 128 probe rays a pixel (Steinert). radial boxes: pbrt's bounds, 50
intervals of the film radius, 2000 samples each; radial ellipses: the ellipses inside them. interpolated boxes: those of
this project before, between 33 film radii. outlines (ours): `neurolens.cameras.pupil_outline`.
"""


def page(passages: Sequence[Passage], pixel: Sequence[tuple[float, float, float]], samples: int) -> str:
    """The whole page in Markdown."""
    width, height = FILM_MM
    parts = [_INTRO.format(width=width, height=height, samples=samples)]
    head = ["lens", "f/", "dark %", *METHODS, "lost", "search s", "ns"]
    rows = [_row(p) for p in passages]
    parts += [_table(head, rows), _METHODS]
    light = [[_name(p), f"{p.case.f_number:g}", *(f"{100 * p.rates[m].light:.1f}" for m in METHODS)] for p in passages]
    parts += ["## Light found, percent\n", _table(["lens", "f/", *METHODS], light)]
    sources = dict.fromkeys(f"- {_name(p)}: {p.case.source}." for p in passages if p.case.source)
    parts += ["Figures in brackets:\n", "\n".join(sources) + "\n"]
    if pixel:
        parts += [
            "## Closing the stop: Tessar 50 mm, one pixel, rear rim\n",
            "Pixel (128, 96) of 512 x 384 on 36 x 27 mm, d line; Steinert 2009, Table 5.3, in the second row.\n",
            _table(
                ["f/", *(f"{n:g}" for n, _, _ in pixel)],
                [["ours", *(f"{a:.2f}" for _, a, _ in pixel)], ["theirs", *(f"{b:g}" for _, _, b in pixel)]],
            ),
        ]
    return "\n".join(parts)


def _name(p: Passage) -> str:
    return f"{p.case.lens.rsplit('_', 1)[0].replace('_', ' ')} {p.case.focal_length_mm:g} mm"


def _row(p: Passage) -> list[str]:
    rates = []
    for method in METHODS:
        theirs = p.case.theirs.get(method)
        rates.append(f"{100 * p.rates[method].passed:.1f}" + (f" [{theirs:g}]" if theirs is not None else ""))
    ours = p.rates[OURS]
    lost = f"{p.lost:.0e}"
    return [
        _name(p),
        f"{p.case.f_number:g}",
        f"{100 * p.dark:.1f}",
        *rates,
        lost,
        f"{ours.search_s:.2f}",
        f"{ours.sample_ns:.0f}",
    ]


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)]) + "\n"


def write(
    passages: Sequence[Passage],
    pixel: Sequence[tuple[float, float, float]],
    shown: Sequence[Passage],
    cameras: Sequence[ExactCamera],
    samples: int,
    folder: Path,
) -> str:
    """Write passage.md, passage.json and passage.png (the cases shown, with their cameras); returns the page."""
    folder.mkdir(parents=True, exist_ok=True)
    text = page(passages, pixel, samples)
    atomic_write_text(folder / "passage.md", text)
    data = {"film_mm": FILM_MM, "samples": samples, "cases": [_json(p) for p in passages], "tessar_pixel": list(pixel)}
    atomic_write_text(folder / "passage.json", json.dumps(data, indent=1, allow_nan=False) + "\n")
    with style():
        save(picture(shown, cameras), folder / "passage.png")
    return text


def _json(p: Passage) -> dict[str, Any]:
    return {
        "lens": p.case.lens,
        "focal_length_mm": p.case.focal_length_mm,
        "f_number": p.case.f_number,
        "lit_radius_mm": p.lit_radius_mm,
        "dark": p.dark,
        "lost": p.lost,
        "theirs_percent": p.case.theirs,
        "source": p.case.source,
        "rates": {name: vars(rate) for name, rate in p.rates.items()},
    }


_SHOWN = (OURS, "radial ellipses", "pixel ellipse", "pixel disc", "Wu, two steps", "rear rim")


def picture(passages: Sequence[Passage], cameras: Sequence[ExactCamera]) -> Any:
    """Above: rates against the film radius of some cases; below: what passes their pupil planes, and our outlines."""
    figure = new_figure(3.6 * len(passages), 5.2)
    axes = figure.subplots(2, len(passages), squeeze=False, height_ratios=(1.7, 1))
    for column, (p, camera) in enumerate(zip(passages, cameras, strict=True)):
        above, below = axes[:, column]
        for method, colour in zip(_SHOWN, (INK, *FIELD_COLOURS), strict=False):
            values = 100 * p.by_radius[method]
            radius = (np.arange(values.size) + 0.5) * p.lit_radius_mm / values.size
            above.plot(radius, values, color=colour, lw=2.2 if method == OURS else 1.3, label=method)
        above.set(ylim=(0, 103), xlim=(0, p.lit_radius_mm), xlabel="film radius (mm)")
        above.set_title(f"{_name(p)}, f/{p.case.f_number:g}", loc="left")
        above.grid(axis="y")
        if column == 0:
            above.set_ylabel("rays that pass (%)")
            above.legend(loc="lower left")
        _draw_outlines(below, camera)
        if column == 0:
            below.set_ylabel("y on the pupil plane (mm)")
    return figure


def _draw_outlines(axes: Any, camera: ExactCamera) -> None:
    """What passes at 550 nm (dots) and our outlines, from the axis (left) to the end of the light."""
    outline = camera.film.outline
    end = outline.film_radius_mm
    axes.set_aspect("equal", "box")
    left, ticks = 0.0, []
    square = np.stack([a.ravel() for a in np.meshgrid(*[(np.arange(36) + 0.5) / 36] * 2)]).astype(np.float32)
    wavelength = np.full(square.shape[1], 550, np.float32)
    for share in (0.0, 0.6, 0.85, 0.97):
        film = np.zeros_like(square)
        film[0] = share * end
        points, passed = _around(camera, film, square, wavelength)
        x, y = _polygon(camera, share * end)
        middle, half = (x.min() + x.max()) / 2, (x.max() - x.min()) / 2
        left += 1.25 * half
        axes.plot(points[0] - middle + left, points[1], ".", ms=1.1, color=FAINT, rasterized=True)
        axes.plot(points[0][passed] - middle + left, points[1][passed], ".", ms=1.6, color=FIELD_COLOURS[0])
        axes.plot(x - middle + left, y, color=INK, lw=1.2)
        ticks.append((left, f"{share * end:.1f}"))
        left += 1.25 * half
    axes.set_xticks([t for t, _ in ticks], [t for _, t in ticks])
    axes.set_xlabel("pupils at film radius (mm), one scale")


def _around(camera: ExactCamera, film: Any, square: Any, wavelength: Any) -> tuple[Any, Any]:
    """Points on a grid a quarter wider than the outline, and which pass."""
    x, y = _polygon(camera, float(film[0, 0]))
    points = np.stack(
        [
            (x.min() + x.max()) / 2 + 1.25 * (x.max() - x.min()) * (square[0] - 0.5),
            1.25 * 2 * y.max() * (square[1] - 0.5),
        ]
    ).astype(np.float32)
    return points, camera.film.scene(film, points, wavelength).status == 0


def _polygon(camera: ExactCamera, radius: float) -> tuple[Any, Any]:
    """The closed outline of a film radius at 550 nm, on the pupil plane, mm."""
    outline = camera.film.outline
    row, step, _ = (a[0] for a in outline.place(np.array([radius], np.float32)))
    share = outline.share(np.array([550], np.float32))[0] if len(outline.wavelength_nm) > 1 else 0.0
    after = min(row + 1, outline.centre.size - 1)

    def at(values: Any) -> Any:
        return (1 - step) * values[row] + step * values[after]

    x, y = ((1 - share) * at(c[0]) + share * at(c[-1]) for c in (outline.x, outline.y))
    return at(outline.centre) + np.concatenate([x, x[::-1]]), np.concatenate([y, -y[::-1]])
