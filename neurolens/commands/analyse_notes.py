"""What a user of `neurolens analyse` should know of the lens before believing a figure: doubts, derived states."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from neurolens.base.errors import NeurolensWarning

if TYPE_CHECKING:
    from neurolens.optics.prescription import Lens


def read_told(path: str | Path) -> tuple[Lens, list[str]]:
    """A lens file, and what its reader warns of: glasses that contradict the catalogue, indices taken as constant."""
    from neurolens.optics.lensfile import read_lens

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", NeurolensWarning)
        lens = read_lens(path)
    return lens, [str(w.message).removeprefix(f"{lens.path}: ") for w in caught]


def table_warnings(tabled: Lens, lens: Lens, zoom: str | None) -> list[str]:
    """Doubts about the table and, where one of its states is used, about them; see `neurolens.optics.lenscheck`.

    Args:
        tabled: as the file has it.
        lens: the state that is analysed.
        zoom: the name or focal length in mm of a state, if one was asked for.
    """
    from neurolens.optics.lenscheck import check_lens, doubts

    found = {
        "estimated": ["rim diameters are estimated, not the source's: vignetting is a guess"],
        "derived": ["rim diameters are derived by a rule, the source has none: vignetting follows that rule"],
    }.get(lens.rims, [])
    # A stop that is smaller than stated is a choice, not a doubt; `neurolens lens` says so too.
    checks = [c for c in check_lens(tabled) if c.quantity != "f-number" or (c.computed or 0.0) > (c.stated or 0.0)]
    return found + doubts([c for c in checks if zoom or not c.state])


def state_notes(lens: Lens) -> list[str]:
    """What of this state does not stand in the source."""
    return [f"derived: {lens.derived}"] if lens.derived else []


def wavelength_warnings(lens: Lens, wavelength_nm: Iterable[float]) -> list[str]:
    """Glasses of a lens that their source does not state at a wavelength in use."""
    from neurolens.optics.glass import glass_of

    waves, found = list(wavelength_nm), {}
    for name in {s.glass: None for s in lens.surfaces if s.glass is not None}:
        glass = glass_of(name)
        outside = ", ".join(f"{nm:g}" for nm in waves if not glass.covers(nm))
        if outside:
            low, high = (round(1000 * v) for v in glass.range_um)
            found[name] = f"the index of {glass} is stated for {low}-{high} nm: extrapolated at {outside} nm"
    if any(s.n_d != 1 and s.glass is None for s in lens.surfaces):
        far = ", ".join(f"{nm:g}" for nm in waves if not 365 <= nm <= 1014)
        if far:
            found[""] = f"glasses known by n_d and V_d alone are a guess at {far} nm, outside 365-1014 nm"
    return list(found.values())
