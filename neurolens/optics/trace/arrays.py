"""Rays traced as numpy arrays in float64, without torch: all that setting a lens and searching its pupil need.

Surfaces and their tests are those of the tracer (`surfaces`); only `rays` follows derivatives, power and paths.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.trace.arithmetic import NUMPY
from neurolens.optics.trace.shapes import traced_curve
from neurolens.optics.trace.surfaces import (
    UNIT_SLACK,
    Hit,
    Rays,
    Test,
    Towards,
    cross,
    media,
    nearest_approach,
    rim_tests,
)

Array = NDArray[np.float64]

_CHUNK = 32768  # rays at a time: many enough to hide the cost of calls
_FEWER = 0.8  # share of rays left, below which they are packed together


class Followed(NamedTuple):
    """Holds rays behind the last surface, their status, and where they met the stop.

    Of a lost ray only the status has a meaning.

    Attributes:
        rays: lens frame, unit directions.
        status: of each ray, as in `neurolens.base.status`.
        at_stop: x and y where each ray met the stop, mm.
    """

    rays: Rays
    status: NDArray[np.int32]
    at_stop: tuple[Array, Array]


@np.errstate(all="ignore")  # lost rays overflow and give NaN
def follow(lens: Lens, rays: Rays, wavelength_nm: Any, towards: Towards = "scene", *, prune: bool = False) -> Followed:
    """Follow rays [N] of one wavelength, or of [N], through the whole lens, as `rays.trace` does.

    With `prune` lost rays take no more work at later surfaces, which pays where most rays are lost, and only the status
    has a meaning.
    """
    to_film = towards == "film"
    sense, order = (1, range(len(lens.surfaces))) if to_film else (-1, range(len(lens.surfaces))[::-1])
    mediums, vertex, left = media(lens, wavelength_nm), 0.0, np.arange(len(rays.x))
    vertices = [float(z) for z in lens.vertices_mm]
    sound = np.abs(NUMPY.dot(rays[3:], rays[3:]) - 1) <= UNIT_SLACK
    status = np.where(sound, st.PASSED, st.blocked(order[0], st.MISSED)).astype(np.int32)
    start = nearest_approach(NUMPY, rays, 1.0) if to_film else rays[:3]  # light may start far away
    at_stop, r = (rays.x, rays.y), Rays(*start, *(d * mediums[0 if to_film else -1].n for d in rays[3:]))
    for k in order:
        surface, z = lens.surfaces[k], vertices[k]
        r, vertex = r._replace(z=r.z + (vertex - z)), z
        before, after = (mediums[k], mediums[k + 1]) if to_film else (mediums[k + 1], mediums[k])

        def rim(met: Hit, surface: Any = surface) -> list[Test]:
            tests = rim_tests(NUMPY, surface)(met)
            if lens.aperture is None or not surface.stop:
                return tests
            return [*tests, (0.5, lens.aperture.inside(met.x, met.y, surface.semi_diameter_mm))]

        _, bent, found, own = cross(
            NUMPY, surface, traced_curve(surface, float), r, sense, before, after, entering=k == order[0], rim=rim
        )
        here = status[left]
        for tests, reason in found:
            for low, high in tests:
                here = np.where((here == st.PASSED) & ~np.less_equal(low, high), st.blocked(k, reason), here)
        status[left], r = here, bent.rays
        at_stop = (own.x, own.y) if surface.stop else at_stop
        if prune and (here == st.PASSED).sum() < _FEWER * len(left):
            alive = here == st.PASSED
            left, r = left[alive], Rays(*(c[alive] for c in r))
    return Followed(Rays(*r[:2], r.z + vertex, *(d / mediums[-1 if to_film else 0].n for d in r[3:])), status, at_stop)


def passing(lens: Lens, rays: Rays, wavelength_nm: float, towards: Towards = "scene") -> NDArray[np.bool_]:
    """Test whether rays pass the whole lens, bool [N]: where the status of `rays.trace` is 0."""
    parts = [Rays(*(c[k : k + _CHUNK] for c in rays)) for k in range(0, len(rays.x), _CHUNK)]
    each = [follow(lens, part, wavelength_nm, towards, prune=True).status == st.PASSED for part in parts]
    return np.concatenate([np.zeros(0, bool), *each])
