"""Colour to spectrum and back: surface and light colours are RGB, paths carry wavelengths.

A colour becomes the spectrum r R(l) + g G(l) + b B(l) of three basis functions that add up to 1 (Mallett and Yuksel
2019, "Spectral primary decomposition for rendering with sRGB reflectance"). Radiance is counted relative to daylight
D65, so white light is the number 1 at every wavelength and D65 itself sits in the film's response.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.render.colour import SRGB, FloatArray64, Spectrum, daylight_table, illuminant, table
from neurolens.render.scenetables import Vector

_DFC_NM = 587.5618, 486.1327, 656.2725  # Fraunhofer lines d, F and C
# Beyond this condition number the three responses are too similar: separating them would only amplify noise.
_LARGEST_CONDITION = 30.0
_DEFENSIVE = 0.1  # share of the wavelengths drawn uniformly, independent of the importance
_STEPS = 2048  # at which the importance is sampled


class SpectralRange:
    """A wavelength range cut into bins of equal probability, and the tables of basis and film response by bin.

    Wavelengths are continuous, drawn by inverting the piecewise linear distribution function that the bins are; spectra
    are means over bins.

    Args:
        low_nm, high_nm: the range; equal for light of one wavelength.
        bins: table length.
        lanes: wavelengths that a path carries, a whole number of bins apart.
        light: expected spectrum of the light (nm, radiance relative to D65). None draws wavelengths evenly; else a
            wavelength is drawn in proportion to the film's response to it (root of the sum of squares of R, G and B)
            times light, and a tenth of all evenly.

    Attributes:
        edges_nm: [bins + 1], centres_nm: [bins] float64.
        basis: [3, bins] float64, in [0, 1], adding up to 1.
        response: [3, bins] float32, linear sRGB film value of radiance 1 at a wavelength drawn from a bin, over the
            density with which it is drawn. The mean of response times basis is the unit matrix, so a colour lit by
            white light is reproduced for any range. A range too narrow to tell colours apart gives a grey
            film.
        colours: whether the range tells colours apart.
    """

    def __init__(
        self, low_nm: float, high_nm: float, bins: int = 256, light: Spectrum | None = None, lanes: int = 1
    ) -> None:
        self.low_nm, self.high_nm = low_nm, high_nm
        self.bins, self.lanes = bins, lanes
        assert bins % lanes == 0
        self._set_edges(np.linspace(low_nm, high_nm, bins + 1))
        if light is not None and self.colours:
            self._set_edges(self._quantiles(*light))

    def same(self, other: SpectralRange) -> bool:
        """Whether its tables are those of another."""
        tables = ("edges_nm", "basis", "response")
        return self.lanes == other.lanes and all(np.array_equal(getattr(self, n), getattr(other, n)) for n in tables)

    def _set_edges(self, edges: FloatArray64) -> None:
        self.edges_nm, self.centres_nm = edges, 0.5 * (edges[1:] + edges[:-1])
        self._edges, self._widths = edges[:-1].astype(np.float32), np.diff(edges).astype(np.float32)
        nm = table("wavelength_nm")
        basis = np.stack([self.means(nm, table(name)) for name in ("red", "green", "blue")])
        self.basis = basis / basis.sum(axis=0)
        # Bins stand for as much of the range as they are wide: 1 on average.
        share = np.diff(edges) * self.bins / (self.high_nm - self.low_nm) if self.low_nm < self.high_nm else 1.0
        observer = np.stack([self.means(nm, table(name) * table("d65")) for name in "xyz"]) * share
        mixing = observer @ self.basis.T / self.bins  # [3 XYZ, 3 basis], of each basis colour in white light
        self.colours = bool(np.linalg.cond(np.linalg.solve(SRGB.to_xyz, mixing)) < _LARGEST_CONDITION)
        response = np.linalg.solve(mixing, observer) if self.colours else np.ones((3, self.bins)) * share
        self.response = response.astype(np.float32)

    def _quantiles(self, light_nm: FloatArray64, light: FloatArray64) -> FloatArray64:
        """Edges [bins + 1] between which wavelengths are equally probable."""
        nm = np.linspace(self.low_nm, self.high_nm, _STEPS + 1)
        seen = np.sqrt(np.sum(self.response.astype(np.float64) ** 2, axis=0))
        importance = np.interp(nm, self.centres_nm, seen) * np.interp(nm, light_nm, light)
        each = 0.5 * (importance[1:] + importance[:-1])
        if not each.sum() > 0:
            return self.edges_nm
        reached = np.concatenate([[0.0], np.cumsum((1 - _DEFENSIVE) * each / each.sum() + _DEFENSIVE / _STEPS)])
        edges = np.interp(np.arange(self.bins + 1) / self.bins, reached / reached[-1], nm)
        edges[[0, -1]] = self.low_nm, self.high_nm
        return edges

    def means(self, nm: ArrayLike, values: ArrayLike) -> FloatArray64:
        """Mean [bins] over each bin of a spectrum given at wavelengths and linear in between."""
        nm, values = np.asarray(nm, np.float64), np.asarray(values, np.float64)
        if self.low_nm == self.high_nm:
            return np.interp(self.centres_nm, nm, values)
        x = np.union1d(nm, self.edges_nm)
        y = np.interp(x, nm, values)
        integral = np.concatenate([[0.0], np.cumsum(0.5 * (y[1:] + y[:-1]) * np.diff(x))])
        return np.diff(integral[np.searchsorted(x, self.edges_nm)]) / np.diff(self.edges_nm)

    def wavelengths_nm(self, sample: FloatArray) -> FloatArray:
        """Wavelengths [N] in nm for uniform samples [N] in [0, 1)."""
        place = sample * np.float32(self.bins)
        number = place.astype(np.intp)
        place -= number
        place *= self._widths.take(number)
        place += self._edges.take(number)
        return place

    def bin_of(self, sample: FloatArray) -> NDArray[np.intp]:
        """Bins [N] of uniform samples [N] in [0, 1)."""
        return (sample * np.float32(self.bins)).astype(np.intp)

    def rotated(self, table: NDArray[Any]) -> NDArray[Any]:
        """A table [..., bins] as [lanes, ..., bins], each lane's turned to its own bin.

        Lane k of a path whose hero is in bin b is in bin b + k bins / lanes, counted round: as probable as the hero's,
        for all bins are equally probable (Wilkie et al. 2014).
        """
        step = self.bins // self.lanes
        return np.stack([np.roll(table, -lane * step, axis=-1) for lane in range(self.lanes)])

    def film_rgb(self, spectrum: ArrayLike) -> FloatArray64:
        """Linear sRGB film value [3] of a radiance [bins] relative to D65."""
        return np.asarray(self.response @ np.asarray(spectrum, np.float64) / self.bins)

    def relative(self, nm: ArrayLike, values: ArrayLike) -> FloatArray64:
        """Radiance [bins] relative to D65 of a light of any unit, scaled to the luminance of D65 on the film.

        Zero everywhere where the light has nothing within the range.
        """
        ratio = self.over_d65(nm, values)
        luminance = self.luminance(ratio)
        return ratio / luminance if luminance > 0 else np.zeros(self.bins)

    def over_d65(self, nm: ArrayLike, values: ArrayLike) -> FloatArray64:
        """A spectrum over that of D65, [bins]."""
        return self.means(nm, values) / self.means(table("wavelength_nm"), table("d65"))

    def luminance(self, spectrum: ArrayLike) -> float:
        """Luminance on the film of a radiance [bins] relative to D65."""
        return float(SRGB.to_xyz[1] @ self.film_rgb(spectrum))

    def spectrum(self, rgb: tuple[float, float, float] | NDArray[np.floating]) -> FloatArray:
        """Spectrum [..., bins] of linear sRGB colours [..., 3]."""
        return (np.asarray(rgb, np.float64) @ self.basis).astype(np.float32)

    def refractive_index(self, n_d: float, v_d: float | None) -> FloatArray:
        """Index [bins], Cauchy's A + B / lambda^2 through n_d and n_F - n_C = (n_d - 1) / V_d; constant without V_d."""
        if v_d is None:
            return np.full(self.bins, n_d, np.float32)
        d, f, c = (1 / nm**2 for nm in _DFC_NM)
        b = (n_d - 1) / v_d / (f - c)
        return (n_d + b * (self.centres_nm**-2.0 - d)).astype(np.float32)


Index = NDArray[np.intp]


class Palette:
    """Spectra [rows, bins], looked up by row and wavelength bin; colours that occur twice share a row."""

    def __init__(
        self, spectral: SpectralRange, measured: Mapping[str, Spectrum], reflectances: Mapping[str, Spectrum]
    ) -> None:
        self._spectral, self._measured, self._reflectances = spectral, measured, reflectances
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

    def means(self, rows: list[int]) -> FloatArray:
        """Means of rows over the bins."""
        return np.array([self._rows[row].mean() for row in rows], np.float32)

    def freeze(self) -> None:
        """Lay the rows out for `look_up`."""
        rows = np.stack(self._rows) if self._rows else np.zeros((1, self._spectral.bins), np.float32)
        self._flat = self._spectral.rotated(rows).reshape(self._spectral.lanes, -1)

    def look_up(self, row: Index, bins: Index) -> FloatArray:
        """Values [lanes, N] of rows [N] at wavelength bins [N] of the first lane."""
        where = row * self._spectral.bins
        where += bins
        return self._flat.take(where, axis=-1)
