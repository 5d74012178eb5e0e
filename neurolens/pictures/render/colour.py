"""Colours and spectra: colour spaces, spectra of light, and the way from a colour to a spectrum and back.

The film gathers linear sRGB. Everything after that is one matrix: other primaries, another white, a white balance.
Whites are adapted by von Kries scaling in the Bradford space.

Of the spectra of lights (the CIE's illuminants, daylight, black bodies, measured ones) only the shape is used: the
emission of a light sets its brightness. Every spectrum is scaled as a whole, which keeps its chromaticity, so that
emission 1 has the luminance of daylight D65 of emission 1.

Surface and light colours are RGB, paths carry wavelengths. A colour becomes the spectrum r R(l) + g G(l) + b B(l) of
three basis functions that add up to 1. Radiance is counted relative to daylight D65, so white light is the number 1 at
every wavelength and D65 itself sits in the film's response.

Sources: IEC 61966-2-1 (sRGB), Academy S-2014-004 (ACEScg: primaries AP1, the white of ACES near D60), SMPTE RP 177-1993
(primaries to matrix), Lam 1985 and ICC.1 Annex E (Bradford), OpenEXR's standard attributes and the ids of the Color
Interop Forum, CIE 15:2018 (illuminants A, D50, D65, E), CODATA 2018 (second radiation constant), Mallett and Yuksel
2019, "Spectral primary decomposition for rendering with sRGB reflectance".
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base.errors import InputError
from neurolens.base.files import read_bytes
from neurolens.base.tomlfile import suggestion
from neurolens.cameras.contract import FloatArray
from neurolens.optics.lens.glass import index_at
from neurolens.pictures.render.scenetables import Vector

Matrix = NDArray[np.float64]

BRADFORD: Matrix = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
Array = NDArray[np.float64]
Spectrum = tuple[Array, Array]  # wavelengths in nm, increasing, and values there
CIE_NAMES = ("D65", "D50", "A", "E")
_KELVIN = re.compile(r"([0-9]{1,9}(?:\.[0-9]{0,9})?) ?K")
COLDEST_K, HOTTEST_K = 500.0, 1e5
_SECOND_RADIATION_CONSTANT = 1.438776877e-2  # h c / k, m K
_MOST_ROWS, _LARGEST_FILE = 10_000, 1_000_000
# Beyond this condition number the three responses are too similar: separating them would only amplify noise.
_LARGEST_CONDITION = 30.0
_DEFENSIVE = 0.1  # share of the wavelengths drawn uniformly, independent of the importance
_STEPS = 2048  # steps in which the importance is sampled
Index = NDArray[np.intp]


def xyz_of(xy: ArrayLike) -> Matrix:
    """Return CIE XYZ [3] of a chromaticity (x, y), with Y = 1."""
    x, y = np.asarray(xy, np.float64)
    return np.array([x / y, 1.0, (1 - x - y) / y])


def _solve(matrix: Matrix, right: Matrix) -> Matrix:
    return np.asarray(np.linalg.solve(matrix, right), np.float64)


def adaptation(xyz_from: ArrayLike, xyz_to: ArrayLike) -> Matrix:
    """Return the matrix on XYZ that turns one white into another (XYZ [3] each) at equal luminance (Bradford)."""
    source, target = (np.asarray(white, np.float64) / np.asarray(white)[1] for white in (xyz_from, xyz_to))
    return _solve(BRADFORD, np.diag(BRADFORD @ target / (BRADFORD @ source)) @ BRADFORD)


@dataclass(frozen=True)
class ColourSpace:
    """A linear RGB space.

    Attributes:
        name: for display and the command line. interop_id: value of the attribute colorInteropID of an EXR.
        primaries: chromaticities (x, y) of red, green and blue. white: that of RGB (1, 1, 1).
    """

    name: str
    interop_id: str
    primaries: tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
    white: tuple[float, float]

    @property
    def to_xyz(self) -> Matrix:
        """Matrix [3, 3] from RGB to XYZ; the white has Y = 1."""
        columns = np.column_stack([xyz_of(xy) for xy in self.primaries])
        return columns * np.linalg.solve(columns, xyz_of(self.white))

    @property
    def chromaticities(self) -> tuple[float, ...]:
        """Return the 8 numbers of OpenEXR's attribute `chromaticities`: the primaries, then the white."""
        return tuple(value for xy in (*self.primaries, self.white) for value in xy)

    @property
    def stated(self) -> dict[str, Any]:
        """Return what a picture's metadata say about its colours."""
        return {"space": self.name, "white_xy": list(self.white), "adaptation": "Bradford"}


SRGB = ColourSpace("sRGB", "lin_rec709_scene", ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06)), (0.3127, 0.3290))
ACESCG = ColourSpace("ACEScg", "lin_ap1_scene", ((0.713, 0.293), (0.165, 0.830), (0.128, 0.044)), (0.32168, 0.33767))
COLOUR_SPACES = {space.name: space for space in (SRGB, ACESCG)}


def conversion(source: ColourSpace, target: ColourSpace) -> Matrix:
    """Return the matrix [3, 3] from one linear RGB to another; white stays white."""
    return _solve(target.to_xyz, adaptation(xyz_of(source.white), xyz_of(target.white)) @ source.to_xyz)


def converted(colours: NDArray[np.floating], matrix: ArrayLike) -> NDArray[np.floating]:
    """Multiply colours [..., 3] by the rows of a matrix [n, 3]; the results [..., n] do not depend on the array.

    A product by BLAS rounds the last rows of an array differently, and a tile would not equal that part of its picture.
    """
    columns = np.asarray(matrix).T
    total = colours[..., :1] * columns[0]
    for k in (1, 2):
        total += colours[..., k : k + 1] * columns[k]
    return total


def balance(white_rgb: ArrayLike) -> Matrix:
    """Return the matrix [3, 3] on linear sRGB that makes the colour `white_rgb` [3] neutral and keeps its luminance."""
    white = SRGB.to_xyz @ np.asarray(white_rgb, np.float64)
    return _solve(SRGB.to_xyz, adaptation(white, xyz_of(SRGB.white)) @ SRGB.to_xyz)


def in_gamut(colours: NDArray[np.floating], space: ColourSpace = SRGB) -> FloatArray:
    """Move linear colours [..., 3] of a space into its gamut, so that no value is negative.

    Colours beyond the gamut, such as those of one wavelength, are mixed with grey of their luminance until they lie on
    its border; the others stay as they are.
    """
    grey = converted(colours, space.to_xyz[1:2].astype(np.float32)).clip(0)
    least = np.minimum(colours.min(-1, keepdims=True), 0)
    share = grey / np.maximum(grey - least, np.finfo(np.float32).tiny)
    return np.where(least < 0, np.maximum(grey + share * (colours - grey), 0), colours).astype(np.float32)


def srgb_to_linear(encoded: NDArray[np.floating]) -> FloatArray:
    """Return the linear light of sRGB-encoded values in [0, 1] (IEC 61966-2-1)."""
    encoded = np.asarray(encoded, np.float32)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_to_srgb(linear: NDArray[np.floating]) -> FloatArray:
    """Return the sRGB encoding of linear light, clipped to [0, 1] (IEC 61966-2-1)."""
    clipped = np.clip(np.nan_to_num(np.asarray(linear, np.float32), nan=0.0), 0.0, 1.0)
    return np.where(clipped <= 0.0031308, clipped * 12.92, 1.055 * clipped ** (1 / 2.4) - 0.055).astype(np.float32)


def _csv(name: str) -> list[list[str]]:
    text = resources.files("neurolens.pictures.render").joinpath(f"data/{name}.csv").read_text(encoding="utf-8")
    return [line.split(",") for line in text.splitlines()]


@cache
def _tables() -> dict[str, Array]:
    """Columns wavelength_nm, x, y, z, d65, d50, red, green, blue; made by experiments/data/make_spectral_tables.py."""
    names, *rows = _csv("spectra")
    columns = np.array(rows, np.float64).T
    columns.flags.writeable = False
    return dict(zip(names, columns, strict=True))


def table(name: str) -> Array:
    """Return a column of the shipped table, one value every 5 nm from 380 to 780 nm."""
    return _tables()[name]


@cache
def daylight_table() -> tuple[Array, Array]:
    """Wavelengths [41] in nm, and the CIE's components S0, S1, S2 of daylight [3, 41] there (CIE 15:2018)."""
    rows = np.array(_csv("daylight")[1:], np.float64).T
    return rows[0], rows[1:]


def daylight_weights(x: Array, y: Array) -> Array:
    """Weights 1, M1, M2 [3, N] of S0, S1, S2 of daylight of chromaticities (x, y) (Wyszecki and Stiles 1982)."""
    below = 0.0241 + 0.2562 * x - 0.7341 * y
    m1 = (-1.3515 - 1.7703 * x + 5.9114 * y) / below
    m2 = (0.0300 - 31.4424 * x + 30.0717 * y) / below
    return np.stack([np.ones_like(m1), m1, m2])


def check_spectrum(file: Path, field: str, rows: Sequence[Sequence[float]], most: float | None = None) -> Spectrum:
    """Turn rows (nm, value) into two arrays, scaled to a largest value of 1.

    With `most` values are not scaled, and at most that. An InputError names the row at fault.
    """
    if not 2 <= len(rows) <= _MOST_ROWS:
        raise InputError(file, field, f"({len(rows)} rows)", f"2 to {_MOST_ROWS} rows of nm, value")
    last = 0.0
    for k, (nm, value) in enumerate(rows):
        if not last < nm < math.inf:
            raise InputError(file, f"{field}[{k}]", nm, "wavelengths in nm that increase")
        if not 0 <= value < math.inf:
            raise InputError(file, f"{field}[{k}]", value, "a finite value of 0 or more")
        if most is not None and value > most:
            raise InputError(file, f"{field}[{k}]", value, f"a value from 0 to {most:g}")
        last = nm
    wavelengths, values = np.array(rows, np.float64).T
    if most is not None:
        return wavelengths, values
    if not values.any():
        raise InputError(file, field, "(all 0)", "a value above 0")
    return wavelengths, values / values.max()


def read_spectrum(scene: Path, field: str, path: Path, most: float | None = None) -> Spectrum:
    """Read a CSV file of rows "nm, value"; a header may come first, and lines that start with # are skipped.

    Raises:
        InputError: missing, too large, not numbers, or refused by `check_spectrum`.
    """
    try:
        lines = read_bytes(path, _LARGEST_FILE, "a CSV file", (scene, field)).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise InputError(scene, field, str(path), f"a readable CSV file ({error})") from None
    rows: list[tuple[float, float]] = []
    for number, line in enumerate(lines, 1):
        cells = line.split(",")
        if not line.strip() or line.startswith("#"):
            continue
        try:
            nm, value = (float(cell) for cell in cells)
        except ValueError:
            if not rows and not any(character.isdigit() for character in cells[0]):
                continue  # the names of the columns
            raise InputError(path, f"line {number}", line[:60], "wavelength in nm, value") from None
        rows.append((nm, value))
    return check_spectrum(path, "row", rows, most)


def planck(wavelength_nm: ArrayLike, kelvin: float) -> Array:
    """Return the spectral radiance of a black body by Planck's law, 1 at 560 nm."""
    nm = np.asarray(wavelength_nm, np.float64)

    def exponent(length_nm: ArrayLike) -> Array:
        return _SECOND_RADIATION_CONSTANT / (np.asarray(length_nm) * 1e-9 * kelvin)

    # expm1(b) / expm1(a) without overflow where a black body is cold.
    a, b = exponent(nm), exponent(560.0)
    return (560.0 / nm) ** 5 * np.exp(b - a) * np.expm1(-b) / np.expm1(-a)


def illuminant(name: str, measured: Mapping[str, Spectrum] | None = None) -> Spectrum | None:
    """The spectrum that a name stands for: a CIE illuminant, "3200 K", or a measured one; None if it is unknown."""
    nm = table("wavelength_nm")
    if measured and name in measured:
        return measured[name]
    if name in ("D65", "D50"):
        return nm, table(name.lower())
    if name == "A":
        # CIE 15: Planck's law at 2848 K with the constant of its day, 0.01435 m K, which is the law at 2855.5 K today.
        return nm, planck(nm, 2848 * _SECOND_RADIATION_CONSTANT / 1.435e-2)
    if name == "E":
        return nm, np.ones_like(nm)
    if (kelvin := _KELVIN.fullmatch(name)) and COLDEST_K <= float(kelvin[1]) <= HOTTEST_K:
        return nm, planck(nm, float(kelvin[1]))
    return None


def check_name(file: str | Path, field: str, name: str, measured: Mapping[str, object]) -> None:
    """Refuse an unknown name of a spectrum; the InputError lists the known names."""
    if name in measured or illuminant(name) is not None:
        return
    known = [*CIE_NAMES, *measured]
    kelvin = f"or a black body from {COLDEST_K:g} K to {HOTTEST_K:g} K such as '3200 K'"
    raise InputError(file, field, name, f"one of: {', '.join(known)}, {kelvin}{suggestion(name, known)}")


class SpectralRange:
    """A wavelength range cut into bins of equal probability, with the tables of basis and film response by bin.

    Wavelengths are continuous: they are drawn by inverting the piecewise linear distribution function of the bins.
    Spectra are means over bins.

    Args:
        low_nm, high_nm: the range; equal for light of one wavelength.
        bins: table length.
        lanes: how many wavelengths a path carries; they lie a whole number of bins apart.
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
        """Return whether another range has the same tables."""
        tables = ("edges_nm", "basis", "response")
        return self.lanes == other.lanes and all(np.array_equal(getattr(self, n), getattr(other, n)) for n in tables)

    def _set_edges(self, edges: Array) -> None:
        self.edges_nm, self.centres_nm = edges, 0.5 * (edges[1:] + edges[:-1])
        self._edges, self._widths = (self.rotated(t.astype(np.float32)) for t in (edges[:-1], np.diff(edges)))
        nm = table("wavelength_nm")
        basis = np.stack([self.means(nm, table(name)) for name in ("red", "green", "blue")])
        self.basis = basis / basis.sum(axis=0)
        # The share of the range that a bin stands for, in units of the mean.
        share = np.diff(edges) * self.bins / (self.high_nm - self.low_nm) if self.low_nm < self.high_nm else 1.0
        observer = np.stack([self.means(nm, table(name) * table("d65")) for name in "xyz"]) * share
        mixing = observer @ self.basis.T / self.bins  # [3 XYZ, 3 basis], of each basis colour in white light
        self.colours = bool(np.linalg.cond(np.linalg.solve(SRGB.to_xyz, mixing)) < _LARGEST_CONDITION)
        response = np.linalg.solve(mixing, observer) if self.colours else np.ones((3, self.bins)) * share
        self.response = response.astype(np.float32)

    def _quantiles(self, light_nm: Array, light: Array) -> Array:
        """Return edges [bins + 1] between which wavelengths are equally probable."""
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

    def means(self, nm: ArrayLike, values: ArrayLike) -> Array:
        """Return the mean [bins] over each bin of a spectrum given at wavelengths and linear in between."""
        nm, values = np.asarray(nm, np.float64), np.asarray(values, np.float64)
        if self.low_nm == self.high_nm:
            return np.interp(self.centres_nm, nm, values)
        x = np.union1d(nm, self.edges_nm)
        y = np.interp(x, nm, values)
        integral = np.concatenate([[0.0], np.cumsum(0.5 * (y[1:] + y[:-1]) * np.diff(x))])
        return np.diff(integral[np.searchsorted(x, self.edges_nm)]) / np.diff(self.edges_nm)

    def wavelengths_nm(self, sample: FloatArray, lanes: int = 1) -> FloatArray:
        """Return wavelengths [lanes, N] in nm of the first lanes, for uniform samples [N] in [0, 1)."""
        place = sample * np.float32(self.bins)
        number = place.astype(np.intp)
        place -= number
        wavelengths = self._widths[:lanes].take(number, axis=1)
        wavelengths *= place
        wavelengths += self._edges[:lanes].take(number, axis=1)
        return wavelengths

    def bin_of(self, sample: FloatArray) -> NDArray[np.intp]:
        """Return the bins [N] of uniform samples [N] in [0, 1)."""
        return (sample * np.float32(self.bins)).astype(np.intp)

    def rotated(self, table: NDArray[Any]) -> NDArray[Any]:
        """Return a table [..., bins] as [lanes, ..., bins], where each lane is turned to its own bin.

        If the hero is in bin b, lane k is in bin b + k bins / lanes, counted round. It is as probable as the hero's,
        for all bins are equally probable (Wilkie et al. 2014).
        """
        step = self.bins // self.lanes
        return np.stack([np.roll(table, -lane * step, axis=-1) for lane in range(self.lanes)])

    def film_rgb(self, spectrum: ArrayLike) -> Array:
        """Return the linear sRGB film value [3] of a radiance [bins] relative to D65."""
        return np.asarray(self.response @ np.asarray(spectrum, np.float64) / self.bins)

    def relative(self, nm: ArrayLike, values: ArrayLike) -> Array:
        """Scale a light of any unit to the luminance of D65 on the film, as radiance [bins] relative to D65.

        It is 0 everywhere where the light has nothing within the range.
        """
        ratio = self.over_d65(nm, values)
        luminance = self.luminance(ratio)
        return ratio / luminance if luminance > 0 else np.zeros(self.bins)

    def over_d65(self, nm: ArrayLike, values: ArrayLike) -> Array:
        """Divide a spectrum by that of D65; returns [bins]."""
        return self.means(nm, values) / self.means(table("wavelength_nm"), table("d65"))

    def luminance(self, spectrum: ArrayLike) -> float:
        """Return the luminance on the film of a radiance [bins] relative to D65."""
        return float(SRGB.to_xyz[1] @ self.film_rgb(spectrum))

    def spectrum(self, rgb: tuple[float, float, float] | NDArray[np.floating]) -> FloatArray:
        """Return the spectra [..., bins] of linear sRGB colours [..., 3]."""
        return (np.asarray(rgb, np.float64) @ self.basis).astype(np.float32)

    def refractive_index(self, n_d: float, v_d: float | None) -> FloatArray:
        """Return the index [bins] of a glass (`glass.index_at`)."""
        return np.full(self.bins, index_at(n_d, v_d, self.centres_nm), np.float32)


class ChannelWavelengths:
    """Draws wavelengths over a range and weighs them for R, G and B.

    Args:
        low_nm, high_nm: the range, within 380 to 780 nm. In a range too narrow to tell colours apart all weights are 1.
    """

    def __init__(self, low_nm: float, high_nm: float) -> None:
        self._range = SpectralRange(low_nm, high_nm, light=(np.array([low_nm, high_nm]), np.ones(2)))
        diagonal = np.maximum(self._range.response * self._range.basis, 0)
        weights = diagonal / diagonal.mean(axis=1, keepdims=True)
        self._weights = (weights if self._range.colours else np.ones_like(weights)).astype(np.float32)

    def draw(self, sample: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Draw wavelengths [N] in nm, with weights [3, N], by uniform samples [N] in [0, 1)."""
        return self._range.wavelengths_nm(sample)[0], self._weights.take(self._range.bin_of(sample), axis=1)


class Palette:
    """Spectra [rows, bins], looked up by row and wavelength bin; equal colours share a row."""

    def __init__(
        self, spectral: SpectralRange, measured: Mapping[str, Spectrum], reflectances: Mapping[str, Spectrum]
    ) -> None:
        self._spectral, self._measured, self._reflectances = spectral, measured, reflectances
        self._rows: list[FloatArray] = []
        self._numbers: dict[object, int] = {}
        self._flat: FloatArray = np.zeros(0, np.float32)

    def colour(self, rgb: Vector) -> int:
        """Return the row of a colour."""
        return self._row(rgb, lambda: self._spectral.spectrum(rgb))

    def reflectance(self, value: Vector | str) -> int:
        """Return the row of a colour, or of a measured reflectance."""
        if not isinstance(value, str):
            return self.colour(value)
        return self._row(("reflectance", value), lambda: self._spectral.means(*self._reflectances[value]))

    def absorption(self, transmittance: Vector, depth_m: float) -> int:
        """Return the row of the absorption coefficient (1/m) that leaves `transmittance` after `depth_m`."""
        return self._row(
            ("absorption", transmittance, depth_m), lambda: -np.log(self._spectral.spectrum(transmittance)) / depth_m
        )

    def light(self, rgb: Vector, name: str) -> int:
        """Return the row of an illuminant's light, tinted by a colour; relative to D65."""
        if name == "D65" or not any(rgb):
            return self.colour(rgb)
        return self._row((*rgb, name), lambda: self._spectral.spectrum(rgb) * self.illuminant(name))

    def illuminant(self, name: str) -> FloatArray:
        """Return the radiance [bins] relative to D65 of an illuminant whose luminance on the film is 1."""
        found = illuminant(name, self._measured)
        assert found is not None  # names are checked where scenes are read
        return self._spectral.relative(*found).astype(np.float32)

    def measured_light(self, key: object, spectrum: Spectrum, luminance: float) -> int:
        """Return the row of a spectrum in any unit, scaled to a luminance (1 is that of D65)."""
        return self._row(("light", key), lambda: self._spectral.relative(*spectrum) * luminance)

    def daylight(self, component: int) -> tuple[int, float]:
        """Return the row of daylight's component S0, S1 or S2 over D65, and the component's luminance on the film."""
        nm, components = daylight_table()
        ratio = self._spectral.over_d65(nm, components[component])
        return self._row(("daylight", component), lambda: ratio), self._spectral.luminance(ratio)

    def index(self, n_d: float, v_d: float | None) -> int:
        """Return the row of a refractive index."""
        return self._row(("index", n_d, v_d), lambda: self._spectral.refractive_index(n_d, v_d))

    def _row(self, key: object, make: Callable[[], NDArray[np.floating]]) -> int:
        if key not in self._numbers:
            self._numbers[key] = len(self._rows)
            self._rows.append(np.asarray(make(), np.float32))
        return self._numbers[key]

    def means(self, rows: list[int]) -> FloatArray:
        """Return the means of rows over the bins."""
        return np.array([self._rows[row].mean() for row in rows], np.float32)

    def freeze(self) -> None:
        """Lay the rows out for `look_up`."""
        rows = np.stack(self._rows) if self._rows else np.zeros((1, self._spectral.bins), np.float32)
        self._flat = self._spectral.rotated(rows).reshape(self._spectral.lanes, -1)

    def look_up(self, row: Index, bins: Index) -> FloatArray:
        """Return the values [lanes, N] of spectra by their row numbers [N], at a bin of wavelength [N] each.

        The first lane is at that bin, the others at its companions.
        """
        where = row * self._spectral.bins
        where += bins
        return self._flat.take(where, axis=-1)
