"""Spectra of a scene in one table."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.render.checks import Vector
from neurolens.render.illuminants import Spectrum, illuminant
from neurolens.render.sky import daylight_table
from neurolens.render.spectrum import SpectralRange

Index = NDArray[np.intp]


class Palette:
    """Spectra [rows, bins], looked up by row and wavelength bin; colours that occur twice share a row."""

    def __init__(
        self,
        spectral: SpectralRange,
        measured: Mapping[str, Spectrum] | None = None,
        reflectances: Mapping[str, Spectrum] | None = None,
    ) -> None:
        self._spectral, self._measured, self._reflectances = spectral, measured or {}, reflectances or {}
        self._rows: list[FloatArray] = []
        self._numbers: dict[object, int] = {}
        self._flat: FloatArray = np.zeros(0, np.float32)

    def colour(self, rgb: Vector) -> int:
        """Row of a colour."""
        return self._row(rgb, lambda: self._spectral.spectrum(rgb))

    def reflectance(self, value: Vector | str) -> int:
        """Row of a colour, or of a measured reflectance."""
        if not isinstance(value, str):
            return self.colour(value)
        return self._row(("reflectance", value), lambda: self._spectral.means(*self._reflectances[value]))

    def absorption(self, transmittance: Vector, depth_m: float) -> int:
        """Row of the absorption coefficient in 1/m of which `transmittance` is left after `depth_m`."""
        return self._row(
            ("absorption", transmittance, depth_m), lambda: -np.log(self._spectral.spectrum(transmittance)) / depth_m
        )

    def light(self, rgb: Vector, name: str) -> int:
        """Row of the light of an illuminant, tinted by a colour; relative to D65."""
        if name == "D65" or not any(rgb):
            return self.colour(rgb)
        return self._row((*rgb, name), lambda: self._spectral.spectrum(rgb) * self.illuminant(name))

    def illuminant(self, name: str) -> FloatArray:
        """Radiance [bins] relative to D65 of an illuminant of luminance 1 on the film."""
        found = illuminant(name, self._measured)
        assert found is not None  # names are checked where scenes are read
        return self._spectral.relative(*found).astype(np.float32)

    def measured_light(self, key: object, spectrum: Spectrum, luminance: float) -> int:
        """Row of a light of a spectrum in any unit, scaled to a luminance (1 is that of D65)."""
        return self._row(("light", key), lambda: self._spectral.relative(*spectrum) * luminance)

    def daylight(self, component: int) -> tuple[int, float]:
        """Row of component S0, S1 or S2 of daylight over D65, and its luminance on the film."""
        nm, components = daylight_table()
        ratio = self._spectral.over_d65(nm, components[component])
        return self._row(("daylight", component), lambda: ratio), self._spectral.luminance(ratio)

    def index(self, n_d: float, v_d: float | None) -> int:
        """Row of a refractive index."""
        return self._row(("index", n_d, v_d), lambda: self._spectral.refractive_index(n_d, v_d))

    def _row(self, key: object, make: Callable[[], NDArray[np.floating]]) -> int:
        if key not in self._numbers:
            self._numbers[key] = len(self._rows)
            self._rows.append(np.asarray(make(), np.float32))
        return self._numbers[key]

    def mean(self, row: int) -> float:
        """Mean of a row over the bins."""
        return float(self._rows[row].mean())

    def freeze(self) -> None:
        """Lay the rows out for `look_up`."""
        rows = np.stack(self._rows) if self._rows else np.zeros((1, self._spectral.bins), np.float32)
        rows = self._spectral.rotated(rows)
        self._flat = rows.reshape(*rows.shape[:-2], -1)

    def look_up(self, row: Index, bins: Index) -> FloatArray:
        """Values [N] of rows [N] at wavelength bins [N]; [lanes, N] where a path carries several wavelengths."""
        where = row * self._spectral.bins
        where += bins
        return self._flat.take(where, axis=-1)
