"""The medium after a surface: its index by catalogue name, or by (n_d, V_d), and its absorption.

Without a catalogue glass the dispersion is Cauchy's, A + B / lambda^2 + C / lambda^4, from n_d and the Abbe number V_d:
two figures leave the partial dispersion open, and it is that of a mean glass of the same V_d.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.lens import catalogue
from neurolens.lens.catalogue import LINE_C_NM, LINE_D_NM, LINE_F_NM, LINE_G_NM, Glass
from neurolens.lens.prescription import VISIBLE_NM, Medium, Surface

# How far a stated n_d or V_d may be from the catalogue's: rounding to three decimals and one, and other melts.
TOLERANCE_N_D = 5e-4
TOLERANCE_V_D = 0.5

# P_gF of the catalogue's glasses by powers of V_d (tests/trace/test_catalogue.py fits it again), and the range of V_d.
P_GF = (0.7186, -0.004859, 3.169e-5)
_GLASSES_V_D = (15.0, 100.0)

# Glasses looked up so far. A plain dictionary, because torch.compile can trace through it to the coefficients.
_FOUND: dict[str, Glass] = {}


def inverse_square_um(wavelength_nm: Any) -> Any:
    """1 / lambda^2 in 1/um^2 for a wavelength in nm (number or tensor)."""
    inverse = 1000.0 / wavelength_nm
    return inverse * inverse


def cauchy(n_d: Any, V_d: float) -> tuple[Any, Any, Any]:
    """A, B (um^2) and C (um^4) of Cauchy's A + B / lambda^2 + C / lambda^4 for an index and an Abbe number.

    n(d) = n_d, n_F - n_C = (n_d - 1) / V_d, and n_g - n_F = P_gF (n_F - n_C). P_gF is a parabola in V_d, by least
    squares through the catalogue's glasses up to n_d = 2.1: its residual is 0.004, that of a straight "normal line"
    0.011, that of A + B / lambda^2 up to 0.09. All three are linear in n_d.
    """
    d, f, c, g = (inverse_square_um(nm) for nm in (LINE_D_NM, LINE_F_NM, LINE_C_NM, LINE_G_NM))
    within = min(max(V_d, _GLASSES_V_D[0]), _GLASSES_V_D[1])
    partial = P_GF[0] + within * (P_GF[1] + within * P_GF[2])
    # (u - f) (u - c) is 0 at both lines, which leaves n_F - n_C as it is.
    bend = (partial - (g - f) / (f - c)) / ((g - f) * (g - c))
    slope, spread = 1 / (f - c) - bend * (f + c), (n_d - 1.0) / V_d
    return n_d - spread * d * (slope + bend * d), spread * slope, spread * bend


def index_at(n_d: Any, V_d: float | None, wavelength_nm: Any) -> Any:
    """`cauchy`'s index at a wavelength in nm (number, array or tensor); the constant n_d where V_d is unknown."""
    if V_d is None:
        return n_d
    a, b, c = cauchy(n_d, V_d)
    u = inverse_square_um(wavelength_nm)
    return a + u * (b + u * c)


def glass_of(name: str) -> Glass:
    """`catalogue.find`, cached. Before using a glass under torch.compile, look it up once."""
    found = _FOUND.get(name)
    if found is None:
        found = _FOUND[name] = catalogue.find(name)
    return found


def forget() -> None:
    """Look every glass up again: the catalogue has changed."""
    _FOUND.clear()


def by_figures(name: str, n_d: float, V_d: float, place: str) -> dict[str, Any]:
    """Fields of a surface whose glass the catalogue does not know, by its n_d and V_d; the name stays for people.

    Warns:
        NeurolensWarning: always, with the dispersion taken; `place` is the file and the field.
    """
    message = f"glass {name} is not in the catalogue: taken by n_d {n_d:g} and V_d {V_d:g}"
    message += ", and the partial dispersion of a mean glass (Cauchy), without absorption"
    warnings.warn(f"{place}: {message}", NeurolensWarning, stacklevel=3)
    return {"n_d": n_d, "V_d": V_d, "material": name}


def index_of(surface: Surface | Medium, wavelength_nm: Any) -> Any:
    """Refractive index of a medium, or of that after a surface, at a wavelength in nm (number, or tensor of any shape).

    The catalogue's where it names a glass; else by its n_d and V_d, constant where V_d is unknown.

    Raises:
        InputError: a glass that the catalogue does not have, or one beside an n_d whose gradient is wanted.
    """
    if surface.glass is not None:
        if getattr(surface.n_d, "requires_grad", False):
            expected = "no catalogue glass beside an index to be optimised"
            raise InputError(f"glass {surface.glass}", "n_d", "(a tensor)", expected)
        return glass_of(surface.glass).index(wavelength_nm)
    return index_at(surface.n_d, surface.V_d, wavelength_nm)


def absorption_of(surface: Surface, wavelength_nm: Any) -> Any:
    """Napierian absorption in 1/mm of the medium after a surface: the glass's plus the surface's own; None without any.

    Beer-Lambert: t mm transmit exp(-absorption t). An InputError for a glass that the catalogue does not have.
    """
    own = surface.absorption_per_mm or None
    glass = None if surface.glass is None else glass_of(surface.glass).absorption_per_mm(wavelength_nm)
    if glass is None or own is None:
        return own if glass is None else glass
    return glass + own


def check_against_table(surface: Surface, file: str | Path, where: str) -> None:
    """Look a surface's glass up when a lens is read; nothing to do for a surface without one.

    `file` and `where`, for example "surface 3, ", are the place that messages name.

    Warns:
        NeurolensWarning: the stated n_d or V_d (n_d = 1 and None count as not stated) is not the catalogue's within
            5e-4 and 0.5, or the catalogue's formula does not reach over 400-700 nm and is extrapolated.

    Raises:
        InputError: a glass that the catalogue does not have.
    """
    if surface.glass is None:
        return
    _FOUND[surface.glass] = catalogue.find(surface.glass, file, f"{where}glass")
    for text in table_notes(surface):
        warnings.warn(f"{file}: {where}{text}", NeurolensWarning, stacklevel=2)


def table_notes(surface: Surface) -> list[str]:
    """List the warnings of `check_against_table` without their place; empty if the stated values agree."""
    if surface.glass is None:
        return []
    glass, notes = glass_of(surface.glass), []
    stated = _contradiction(surface, glass)
    if stated:
        others = [str(g) for g in catalogue.same_name(surface.glass) if not _contradiction(surface, g)]
        hint = f"; {others[0]} would agree" if others else ""
        notes.append(
            f"{stated} is stated, but {glass} has n_d = {glass.n_d:.6g}, V_d = {glass.V_d:.4g}, which rules{hint}"
        )
    if not all(glass.covers(nm) for nm in VISIBLE_NM):
        low, high = (round(1000 * v) for v in glass.range_um)
        notes.append(f"the index of {glass} is stated for {low}-{high} nm and extrapolated outside")
    if len(glass.coefficients) == 2:
        # Plastics of which the source has one term of Sellmeier's: E48R comes out with V_d = 51.8, its maker says 56.
        notes.append(f"the index of {glass} is a fit with one term: good to 0.002, and V_d is up to a tenth too low")
    return notes


def _contradiction(surface: Surface, glass: Glass) -> str:
    """Name the stated values that differ from this glass's; empty where they agree."""
    n_d, V_d = float(surface.n_d), surface.V_d
    wrong = [f"n_d = {n_d:.6g}"] if n_d != 1 and abs(glass.n_d - n_d) > TOLERANCE_N_D else []
    if V_d is not None and abs(glass.V_d - V_d) > TOLERANCE_V_D:
        wrong.append(f"V_d = {V_d:.4g}")
    return ", ".join(wrong)
