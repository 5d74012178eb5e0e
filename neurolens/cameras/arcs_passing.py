"""How many of the samples of `pupil_arcs` pass a lens."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.cameras.pupil_arcs import PupilArcs
from neurolens.cameras.pupil_circles import PupilCircles
from neurolens.cameras.pupil_sight import Sight, Truths
from neurolens.graph.interpret import evaluate

Array = NDArray[np.float64]
_ASKED, _TRIED = 20_000, 64


def passing(
    sight: Sight, arcs: PupilArcs | PupilCircles, stops: Sequence[float] = (1.0, 0.5, 0.25)
) -> dict[float, float]:
    """Share of the points of the arcs through which rays pass, all over the film, by shares of the widest stop.

    Of film points that have light at that stop: of those whose ray is blocked, where any of `_TRIED` others passes.
    """
    rng, found = np.random.default_rng(3), {}
    for share in stops:
        angle, radius = 2 * np.pi * rng.random(_ASKED), 0.98 * arcs.film_radius_mm * np.sqrt(rng.random(_ASKED))
        film = radius * np.stack([np.cos(angle), np.sin(angle)])
        call = [rng.uniform(*span, _ASKED) for span in (sight.film_z_mm, sight.wavelength_nm)]
        call.append(np.full(_ASKED, share * sight.stop_radius_mm))
        passed = _sampled(sight, arcs, rng.random((2, _ASKED)), film, call)
        lit, tried = np.zeros((blocked := np.flatnonzero(~passed)).size, bool), 0
        while tried < _TRIED and not lit.all():
            # As many again of each at once, for few rays cost nearly as much as many.
            most = max(1, min(tried, _ASKED // int(np.count_nonzero(~lit))))
            tries = min(most, _TRIED - tried)
            dark, tried = np.repeat(blocked[~lit], tries), tried + tries
            found_light = _sampled(sight, arcs, rng.random((2, dark.size)), film[:, dark], [row[dark] for row in call])
            lit[~lit] = found_light.reshape(-1, tries).any(1)
        found[share] = float(passed.sum() / max(passed.sum() + lit.sum(), 1))
    return found


def _sampled(sight: Sight, arcs: PupilArcs | PupilCircles, square: Array, film: Array, call: Sequence[Array]) -> Truths:
    """[N] whether rays of points [2, N] of the unit square pass; film positions, wavelengths and stops."""
    film_z, nm, stop = call
    given = {"film_mm": film, "square": square}
    given |= {"film_z_mm": film_z[None], "wavelength_nm": nm[None], "stop_radius_mm": stop[None]}
    found = evaluate(arcs.graph, given)
    passed = sight.status(film, found["pupil_mm"], nm, film_z, stop) == st.PASSED
    return np.asarray(passed & (found["area_mm2"][0] > 0))
