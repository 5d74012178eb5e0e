"""Make neurolens/pictures/render/data/spectra.csv: CIE 1931 observer (2 degrees), D65, D50, Mallett-Yuksel 2019.

Also experiments/scenes/fl11.csv, the CIE's narrow-band fluorescent lamp FL11 (CIE 15:2004), a measured spectrum.

Needs colour-science, which is no dependency of neurolens, so run it in an environment of its own:

    python -m venv spectra && spectra/bin/pip install colour-science==0.4.7
    spectra/bin/python experiments/data/make_spectral_tables.py
"""

from __future__ import annotations

from pathlib import Path

import colour
import numpy as np
from colour.recovery import MSDS_BASIS_FUNCTIONS_sRGB_MALLETT2019

ROOT = Path(__file__).parents[2]
TARGET = ROOT / "neurolens" / "pictures" / "render" / "data" / "spectra.csv"
LAMP = ROOT / "experiments" / "scenes" / "fl11.csv"
SHAPE = colour.SpectralShape(380, 780, 5)


def main() -> None:
    """Write one row every 5 nm, 380-780 nm: wavelength_nm, x, y, z, d65 and d50 (100 at 560 nm), red, green, blue."""
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(SHAPE)
    daylight = [colour.SDS_ILLUMINANTS[name].copy().align(SHAPE).values for name in ("D65", "D50")]
    basis = MSDS_BASIS_FUNCTIONS_sRGB_MALLETT2019.copy().align(SHAPE)
    rows = np.column_stack([SHAPE.wavelengths, observer.values, *daylight, basis.values])
    header = "wavelength_nm,x,y,z,d65,d50,red,green,blue"
    formats = ["%.0f"] + ["%.7g"] * 8
    np.savetxt(TARGET, rows, fmt=formats, delimiter=",", header=header, comments="")
    lamp = colour.SDS_ILLUMINANTS["FL11"].copy().align(SHAPE)
    rows = np.column_stack([lamp.wavelengths, lamp.values])
    np.savetxt(LAMP, rows, fmt=["%.0f", "%.7g"], delimiter=",", header="wavelength_nm,relative_power", comments="")


if __name__ == "__main__":
    main()
