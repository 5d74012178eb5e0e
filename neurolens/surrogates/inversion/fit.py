"""Fitting the inverse of a surrogate: first guesses of both maps, and how often three Newton steps from them arrive."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.optics.surfaces import Rays
from neurolens.surrogates.bases import pinned_threads
from neurolens.surrogates.cores import DIRECTION, POSITION, STOP
from neurolens.surrogates.domain import FilmRays
from neurolens.surrogates.inversion.guess import fit_guess
from neurolens.surrogates.inversion.maps import STEPS, TOLERANCE, FilmSide, InverseModel, StopRays, StopSystem
from neurolens.surrogates.inversion.newton import determinant
from neurolens.surrogates.lightfield import LightField
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.pairs import RayPairs, join_pairs
from neurolens.surrogates.targets import targets_of

# Rays beyond the rims teach the guess how the map goes on; those that pass count more.
_BEYOND_WEIGHT = 0.3
# Rays teach where the model is within this of the lens, of the largest value of each output, ...
_AWAY = 0.02
# ... and the guess of the stop where the stop is seen at least at this share of its usual area.
_FOLD = 0.1
# Terms and degree of the guesses: first, and where too few rays converge.
_SIZES = ((40, 6), (80, 7))
_WANTED, _CHECKED = 0.9999, 20_000
_OTHER = 0.02


def fit_inverse(model: LensModel, pairs: RayPairs) -> InverseModel:
    """Fit the first guesses of both inverse maps on rays that pass and on rays a little beyond the rims.

    Guesses get more terms where three Newton steps from them do not reach 99.99% of the model's passing rays.

    Args:
        pairs: of the model's lens and domain.

    Raises:
        InputError: pairs of another lens.
    """
    if pairs.lens.sha256 != model.lens.sha256:
        raise InputError("fit_inverse", "pairs", pairs.lens.name, f"ray pairs of {model.lens.name}")
    start = time.perf_counter()
    with pinned_threads(), torch.no_grad():
        rays, weight = _teaching(model, pairs)
        rounds = [_fit(model, rays, weight, *_SIZES[0])]
        report = convergence(rounds[0], pairs.train.inputs.select(slice(0, _CHECKED)))
        if min(report["stop"]["converged"], report["scene"]["converged"]) < _WANTED:
            rounds.append(_fit(model, rays, weight, *_SIZES[1]))
            other = convergence(rounds[1], pairs.train.inputs.select(slice(0, _CHECKED)))
            best = {n: int(other[n]["converged"] > report[n]["converged"]) for n in ("stop", "scene")}
            rounds[0] = InverseModel(model, rounds[best["stop"]].stop, rounds[best["scene"]].scene)
            report = {n: (report, other)[best[n]][n] for n in ("stop", "scene")}
    found = rounds[0]
    report["stop"]["coefficients"], report["scene"]["coefficients"] = found.stop.coefficients, found.scene.coefficients
    report |= {"rays": len(rays), "seconds": time.perf_counter() - start}
    return replace(found, report=report)


def convergence(inverse: InverseModel, rays: FilmRays, steps: int = STEPS) -> dict[str, Any]:
    """How often the inverse maps find the model's own passing rays, in the dtype of `rays`.

    Returns for "stop" and "scene": converged (share with a residual below TOLERANCE) and other (share that came to
    another ray of the same stop point, or scene ray: the map is folded there, and that ray is not found).
    """
    forward = inverse.model.predict(rays)
    passed = forward.status == st.PASSED
    rays, x, y = rays.select(passed), forward.stop_x[passed], forward.stop_y[passed]
    scene = Rays(*(c[passed] for c in forward.rays))
    stop = inverse.through_stop(rays.film_x, rays.film_y, rays.film_z, x, y, rays.wavelength_nm, steps=steps)
    back = inverse.from_scene(scene, rays.film_z, rays.wavelength_nm, steps=steps)
    return {"stop": _found(inverse.model, rays, stop), "scene": _found(inverse.model, rays, back)}


def _found(model: LensModel, rays: FilmRays, out: StopRays | FilmSide) -> dict[str, Any]:
    solved = out.residual < TOLERANCE
    away = torch.hypot(out.rays.pupil_x - rays.pupil_x, out.rays.pupil_y - rays.pupil_y)
    other = solved & (away > _OTHER * model.domain.pupil_radius_mm)
    count = max(len(rays), 1)
    return {"converged": float(solved.double().sum()) / count, "other": float(other.double().sum()) / count}


def _fit(model: LensModel, rays: FilmRays, weight: Tensor, terms: int, degree: int) -> InverseModel:
    light = model.encoding(rays)
    vectors, _ = model.core(light)
    x, y = vectors[STOP] * model.scales.stop_mm
    system = StopSystem(model, rays.film_x, rays.film_y, rays.film_z, x, y, rays.wavelength_nm)
    u = (torch.stack([rays.pupil_x, rays.pupil_y]) - system.chief * system.film) / system.scale
    # Where the stop is seen through a caustic two rays cross it in one point: the guess follows the sheet of the axis.
    turned = determinant(system(u)[1])
    weight_stop = weight * (turned > _FOLD * turned.median())
    known: dict[str, Any] = {"mirror": model.encoding.mirror, "terms": terms, "degree": degree}
    stop = fit_guess(system.guess_field, system.guess_z, u[None], weight_stop, **known)
    scene_field = LightField(vectors[POSITION], vectors[DIRECTION], light.w)
    both = torch.stack([light.u, light.p])
    return InverseModel(model, stop, fit_guess(scene_field, torch.zeros_like(weight), both, weight, **known))


def _teaching(model: LensModel, pairs: RayPairs) -> tuple[FilmRays, Tensor]:
    """Rays of the fits and their weights [N]: those that pass, and those a little beyond the rims that the model knows.

    What is inverted is the model, not the lens: rays where it has run away from the lens would teach nonsense.
    """
    size = min(len(pairs.train), len(pairs.rim))
    sets = join_pairs([pairs.train.select(slice(0, 2 * size)), pairs.rim.select(slice(0, size))])
    exact = targets_of(model.lens, model.encoding, sets).vectors
    away = (model.core(model.encoding(sets.inputs))[0] - exact).norm(dim=1)  # [3, N]
    known = (away < _AWAY * exact.norm(dim=1).amax(1, keepdim=True)).all(0)
    weight = torch.ones(len(sets), dtype=torch.float64)
    weight[-size:] = _BEYOND_WEIGHT
    order = torch.randperm(len(sets), generator=torch.Generator().manual_seed(0))
    order = order[known[order]]
    return sets.inputs.select(order), weight[order]
