"""The media between surfaces at a wavelength: index, and absorption where there is any."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from neurolens.optics import glass
from neurolens.optics.prescription import Lens, Surface
from neurolens.optics.surfaces import AIR, Medium, medium


def media(lens: Lens, wavelength_nm: Tensor | float) -> list[Medium]:
    """Media from the scene to the film; media(...)[k] lies before surface k. The same object where it does not change.

    `wavelength_nm` is a number or a tensor [N]; a dispersive medium has the shape of the wavelength.
    """
    known: dict[Any, Medium] = {_key(None): AIR}
    found = [AIR]
    for s in lens.surfaces:
        key = _key(s)
        if key not in known:
            known[key] = medium(glass.index_of(s, wavelength_nm))
        found.append(known[key])
    return found


def absorption_per_mm(lens: Lens, wavelength_nm: Tensor | float) -> list[Any]:
    """Napierian absorption of the media from the scene to the film, in 1/mm; None where there is none."""
    return [None, *(_absorption(s, wavelength_nm) for s in lens.surfaces)]


def _absorption(s: Surface, wavelength_nm: Tensor | float) -> Any:
    if s.glass is None and not s.absorption_per_mm:
        return None
    return glass.absorption_of(s, wavelength_nm)


def _key(s: Surface | None) -> Any:
    if s is None or (s.glass is None and s.V_d is None and not isinstance(s.n_d, Tensor) and s.n_d == 1):
        return "air"
    return (s.glass, None if s.glass else (id(s.n_d) if isinstance(s.n_d, Tensor) else float(s.n_d), s.V_d))
