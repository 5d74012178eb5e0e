"""What is measured of each effect, by the name that its file gives: a number or more for every camera of a panel."""

from __future__ import annotations

from collections.abc import Callable

from neurolens.evaluate.gallery.measures import aberrations
from neurolens.evaluate.gallery.measures.view import View

# A measure takes what one camera saw and gives numbers; their names carry the unit.
MEASURES: dict[str, Callable[[View], dict[str, float]]] = {
    "light_profile": aberrations.light_profile,
}
