"""One glass of a catalogue: its refractive index and its absorption against wavelength."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

# Fraunhofer lines, nm (helium d; hydrogen F and C).
LINE_D_NM = 587.5618
LINE_F_NM = 486.1327
LINE_C_NM = 656.2725


@dataclass(frozen=True, eq=False)  # compared as the one object that the catalogue gives
class Glass:
    """Dispersion and absorption of one optical material.

    Attributes:
        maker, name: as in the catalogue.
        form: "sellmeier", n^2 = 1 + sum of B L^2 / (L^2 - C), or "power", n^2 = sum of a_p L^p; L in um.
        coefficients: B, C (um^2), B, C, ... of Sellmeier's form; a_4, a_2, a_0, a_-2, a_-4, ... of the other.
        range_um: wavelengths from and to which the source states the formula for.
        absorption: (wavelength in nm, Napierian absorption in 1/mm) at increasing wavelengths; empty where unknown.
    """

    maker: str
    name: str
    form: str
    coefficients: tuple[float, ...]
    range_um: tuple[float, float]
    absorption: tuple[tuple[float, float], ...] = ()

    def __str__(self) -> str:
        return f"{self.maker}:{self.name}"

    def index(self, wavelength_nm: Any) -> Any:
        """Refractive index relative to air at a wavelength in nm (number, or tensor of any shape, of its dtype).

        Outside `range_um` the formula is extrapolated; it is finite for 380-780 nm in every glass of the catalogue,
        and meaningless or NaN beyond the poles in the ultraviolet (below 300 nm).
        """
        square = (wavelength_nm * 1e-3) ** 2
        c = self.coefficients
        if self.form == "sellmeier":
            terms = [c[k] * square / (square - c[k + 1]) for k in range(0, len(c), 2)]
            return _root(sum(terms[1:], terms[0]) + 1.0)
        # Horner's scheme in 1 / L^2 for the negative powers; the catalogues have none above the fourth.
        inverse = 1.0 / square
        total = inverse * c[-1]
        for a in c[-2:2:-1]:
            total = (total + a) * inverse
        return _root(total + c[2] + square * (c[1] + square * c[0]))

    def absorption_per_mm(self, wavelength_nm: Any) -> Any:
        """Napierian absorption, 4 pi k / wavelength, in 1/mm, at a wavelength in nm; None where the source has none.

        Internal transmittance of t mm is exp(-absorption t). Linear between the source's wavelengths, and constant
        outside them (350-1060 nm at the most): there, on the ultraviolet side, glass is darker than this says.
        """
        if not self.absorption:
            return None
        if not isinstance(wavelength_nm, Tensor):
            value = np.interp(wavelength_nm, *np.transpose(self.absorption))
            return float(value) if np.ndim(value) == 0 else value
        total = torch.full_like(wavelength_nm, self.absorption[-1][1])
        for nm, bend in self._bends():
            total = total + bend * (nm - wavelength_nm).clamp(min=0)
        return total

    def _bends(self) -> list[tuple[float, float]]:
        """The broken line of the absorption as hinges: wavelength, and by how much the slope changes there.

        Several times faster than a search in a table, and torch fuses it. Counted from the red end, where absorption
        is least, so that float32 does not lose it in the far larger values of the blue.
        """
        points = self.absorption
        steps = [(a - b) / (right - left) for (left, a), (right, b) in zip(points[:-1], points[1:], strict=True)]
        changes = zip([0.0, *steps], [*steps, 0.0], strict=True)
        return [(nm, red - blue) for (nm, _), (red, blue) in zip(points, changes, strict=True)]

    @property
    def n_d(self) -> float:
        """Index at the helium line, 587.5618 nm."""
        return self.index(LINE_D_NM)

    @property
    def V_d(self) -> float:
        """Abbe number (n_d - 1) / (n_F - n_C)."""
        return (self.n_d - 1.0) / (self.index(LINE_F_NM) - self.index(LINE_C_NM))

    def covers(self, wavelength_nm: float) -> bool:
        """Whether the source states the formula for this wavelength."""
        low, high = self.range_um
        return low - 1e-9 <= wavelength_nm * 1e-3 <= high + 1e-9  # 700 * 1e-3 is a digit more than 0.7


def _root(square: Any) -> Any:
    """Square root; a negative number gives NaN as a tensor's does, where Python's own power gives a complex one."""
    return math.nan if isinstance(square, float) and square < 0 else square**0.5
