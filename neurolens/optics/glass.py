"""Refractive index against wavelength: Cauchy A + B / lambda^2 through n_d and the Abbe number V_d."""

from __future__ import annotations

from typing import Any

# Fraunhofer lines, nm (helium d; hydrogen F and C).
LINE_D_NM = 587.5618
LINE_F_NM = 486.1327
LINE_C_NM = 656.2725


def inverse_square_um(wavelength_nm: Any) -> Any:
    """1 / lambda^2 in 1/um^2 for a wavelength in nm (number or tensor of any shape)."""
    return (1000.0 / wavelength_nm) ** 2


def cauchy_coefficients(n_d: Any, V_d: float | None) -> tuple[Any, Any]:
    """A and B (um^2) of n = A + B / lambda^2, so that n(d) = n_d and n_F - n_C = (n_d - 1) / V_d.

    V_d None (unknown) gives the constant index n_d.
    """
    if V_d is None:
        return n_d, 0.0
    b = (n_d - 1.0) / V_d / (inverse_square_um(LINE_F_NM) - inverse_square_um(LINE_C_NM))
    return n_d - b * inverse_square_um(LINE_D_NM), b


def index_at(n_d: Any, V_d: float | None, wavelength_nm: Any) -> Any:
    """Refractive index at a wavelength in nm (number, or tensor [N]); the constant n_d where V_d is unknown."""
    a, b = cauchy_coefficients(n_d, V_d)
    return a if V_d is None else a + b * inverse_square_um(wavelength_nm)
