"""Which share of a shader's samples pass the lens."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.graph.interpret import evaluate
from neurolens.shaders.pupil_circles import PupilCircles
from neurolens.shaders.pupil_disc import PupilDisc
from neurolens.shaders.shader_lens import ShaderLens

Array = NDArray[np.float64]
_SAMPLES, _TRIES = 20_000, 64  # film points; samples that decide whether one has light


def passing_share(
    lens: ShaderLens, pupil: PupilCircles | PupilDisc, stops: Sequence[float] = (1.0, 0.5, 0.25)
) -> dict[float, float]:
    """The share of samples that pass, all over the film, by shares of the widest stop.

    Film points without light do not count: those whose ray is blocked count where any of 64 more rays passes.
    """
    rng, shares = np.random.default_rng(3), {}
    for stop in stops:
        angle, radius = 2 * np.pi * rng.random(_SAMPLES), 0.98 * pupil.film_radius_mm * np.sqrt(rng.random(_SAMPLES))
        film = radius * np.stack([np.cos(angle), np.sin(angle)])
        call = np.stack([rng.uniform(*span, _SAMPLES) for span in (lens.film_z_mm, lens.wavelength_nm)])
        passed = _sampled(lens, pupil, rng.random((2, _SAMPLES)), film, call, stop)
        blocked = np.flatnonzero(~passed)
        lit, tries = np.zeros(blocked.size, bool), 0
        while tries < _TRIES and not lit.all():
            # Each round doubles the rays of a dark point: a call with few rays takes nearly as long as one with many.
            more = min(max(1, min(tries, _SAMPLES // int(np.count_nonzero(~lit)))), _TRIES - tries)
            dark, tries = np.repeat(blocked[~lit], more), tries + more
            again = _sampled(lens, pupil, rng.random((2, dark.size)), film[:, dark], call[:, dark], stop)
            lit[~lit] = again.reshape(-1, more).any(1)
        shares[stop] = float(passed.sum() / max(passed.sum() + lit.sum(), 1))
    return shares


def _sampled(
    lens: ShaderLens, pupil: PupilCircles | PupilDisc, square: Array, film: Array, call: Array, share: float
) -> NDArray[np.bool_]:
    """Whether rays [N] of points of the unit square pass, at film positions and wavelengths `call` [2, N]."""
    (film_z, nanometres), stop = call, np.array([[share * lens.stop_radius_mm]])
    inputs = {"film_mm": film, "square": square, "film_z_mm": film_z[None], "wavelength_nm": nanometres[None]}
    sample = evaluate(pupil.graph, inputs | {"stop_radius_mm": stop})
    passed = lens.status(film, sample["pupil_mm"], nanometres, film_z, stop) == st.PASSED
    return np.asarray(passed & (sample["area_mm2"][0] > 0))
