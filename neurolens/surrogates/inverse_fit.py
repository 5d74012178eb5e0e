"""Fits of the first guesses of both inverse maps, and how often three Newton steps from them converge."""

from __future__ import annotations

import time
from typing import Any

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.graph.interpret import monomials
from neurolens.surrogates.cores import DIRECTION, POSITION, STOP, Refracted
from neurolens.surrogates.domain import FilmRays
from neurolens.surrogates.inverse import STEPS, TOLERANCE, Guess, InverseModel, InverseRays, scaled_film_z
from neurolens.surrogates.lightfield import LightField
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.pairs import RayPairs, join_pairs
from neurolens.surrogates.targets import inside_front, targets_of
from neurolens.surrogates.terms import Exponents, Sweep, forward, kept, ordered, pinned_threads, powers, solve
from neurolens.trace.surfaces import Rays

# Rays beyond the rims show the fit how the map goes on; passing rays count more.
_BEYOND_WEIGHT = 0.3
# Rays are fitted where the model errs by no more than this share of the largest value of each output, ...
_AWAY = 0.02
# ... and the guess of the stop where the stop's image has at least this share of its usual area.
_FOLD = 0.1
# Terms and degree of the guesses: first, and where too few rays converge.
_SIZES = ((40, 6), (80, 7))
_WANTED, _CHECKED = 0.9999, 20_000
_OTHER = 0.02
# Rays of the choice of terms: the Gram matrix of all candidates takes a second.
_MOST_RAYS = 12_000


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
        rays, weight = _fit_rays(model, pairs)
        checked = pairs.train.inputs.select(slice(0, _CHECKED))
        guesses: dict[str, Guess] = {}
        report: dict[str, Any] = {}
        for terms, degree in _SIZES:
            inverse = _fit(model, rays, weight, terms, degree)
            for name, figures in convergence(inverse, checked).items():
                if name not in guesses or figures["converged"] > report[name]["converged"]:
                    guess: Guess = getattr(inverse, name)
                    guesses[name], report[name] = guess, {**figures, "coefficients": guess.coefficients}
            if min(figures["converged"] for figures in report.values()) >= _WANTED:
                break
    report |= {"rays": len(rays), "seconds": time.perf_counter() - start}
    return InverseModel(model, guesses["stop"], guesses["scene"], report)


def convergence(inverse: InverseModel, rays: FilmRays, steps: int = STEPS) -> dict[str, Any]:
    """How often the inverse maps find the model's own passing rays, in the dtype of `rays`.

    Returns for "stop" and "scene": converged (share with a residual below TOLERANCE) and other (share that converged to
    another ray of the same stop point, or scene ray, because the map is folded there).
    """
    forward = inverse.model.predict(rays)
    passed = forward.status == st.PASSED
    rays, x, y = rays.select(passed), forward.stop_x[passed], forward.stop_y[passed]
    scene = Rays(*(c[passed] for c in forward.rays))
    stop = inverse.through_stop(rays.film_x, rays.film_y, rays.film_z, x, y, rays.wavelength_nm, steps=steps)
    back = inverse.from_scene(scene, rays.film_z, rays.wavelength_nm, steps=steps)
    return {"stop": _shares(inverse.model, rays, stop), "scene": _shares(inverse.model, rays, back)}


def _shares(model: LensModel, rays: FilmRays, out: InverseRays) -> dict[str, Any]:
    solved = out.residual < TOLERANCE
    away = torch.hypot(out.rays.pupil_x - rays.pupil_x, out.rays.pupil_y - rays.pupil_y)
    other = solved & (away > _OTHER * model.domain.pupil_radius_mm)
    count = max(len(rays), 1)
    return {"converged": float(solved.double().sum()) / count, "other": float(other.double().sum()) / count}


def _fit(model: LensModel, rays: FilmRays, weight: Tensor, terms: int, degree: int) -> InverseModel:
    light, e = model.encoding(rays), model.encoding
    vectors, _ = model.core(light)
    film, pupil = torch.stack([rays.film_x, rays.film_y]), torch.stack([rays.pupil_x, rays.pupil_y])
    chief, scale = (torch.tensor(v, dtype=torch.float64)[:, None] for v in (e.chiefs, e.pupil_scales_mm))
    # Through a caustic two rays cross the stop at one point: the guess follows the sheet of the axis.
    d = model.differentiate(rays)[2][:, 2:4]
    turned = d[0, 0] * d[1, 1] - d[0, 1] * d[1, 0]
    weight_stop = weight * (turned > _FOLD * turned.median())
    size: dict[str, Any] = {"mirror": e.mirror, "terms": terms, "degree": degree}
    none = torch.zeros_like(weight)
    z = scaled_film_z(model, rays.film_z)
    stop_field = LightField(film / e.film_scale_mm, vectors[STOP], light.w)
    u = (pupil - chief * film) / scale
    stop = fit_guess(stop_field, none if z is None else z, u[None], weight_stop, **size)
    scene_field = LightField(vectors[POSITION], vectors[DIRECTION], light.w)
    return InverseModel(model, stop, fit_guess(scene_field, none, torch.stack([light.u, light.p]), weight, **size))


def _fit_rays(model: LensModel, pairs: RayPairs) -> tuple[FilmRays, Tensor]:
    """Rays of the fits and their weights [N]: passing ones, and some beyond the rims where the model is near the lens.

    The model is inverted, not the lens: rays where it has run away from the lens would mislead the fit.
    """
    size = min(len(pairs.train), len(pairs.rim))
    sets = join_pairs([pairs.train.select(slice(0, 2 * size)), pairs.rim.select(slice(0, size))])
    truth = inside_front(model.lens, sets) if isinstance(model.core, Refracted) else sets
    exact = targets_of(model.lens, model.encoding, truth).vectors
    away = (model.core(model.encoding(sets.inputs))[0] - exact).norm(dim=1)  # [3, N]
    near = (away < _AWAY * exact.norm(dim=1).amax(1, keepdim=True)).all(0)
    weight = torch.ones(len(sets), dtype=torch.float64)
    weight[-size:] = _BEYOND_WEIGHT
    order = torch.randperm(len(sets), generator=torch.Generator().manual_seed(0))
    order = order[near[order]]
    return sets.inputs.select(order), weight[order]


def fit_guess(
    field: LightField, z: Tensor, outputs: Tensor, weight: Tensor, *, mirror: bool, terms: int, degree: int
) -> Guess:
    """Choose terms by orthogonal least squares and fit them.

    Args:
        field, z: inputs as of `Guess`, [.., N]. outputs: [K, 2, N], of unit order. weight: [N].
        terms: columns (of A and B together) that the K vectors share. degree: largest total degree of the invariants.
    """
    exponents = _candidates(degree, mirror, bool(field.w.any()), bool(z.any()))
    part = slice(0, _MOST_RAYS)
    columns = _columns(field, z, exponents, mirror, part) * weight[part]  # [2 M, 2, n]
    count = len(exponents)
    wanted = outputs[..., part] * weight[part]
    supports = []
    for axes in ([0], [1]) if mirror else ([0, 1],):
        d, o = columns[:, axes].flatten(1), wanted[:, axes].flatten(1)
        sweep = Sweep.of_columns(d, o)
        forward(sweep, min(terms, 2 * count))
        supports.append(sorted(sweep.chosen))
    exponents, rows = kept(exponents, [k for support in supports for k in support])
    all_columns = _columns(field, z, exponents, mirror, slice(None)) * weight
    ab = torch.zeros((len(outputs), len(supports), 2 * len(exponents)), dtype=torch.float64)
    for i, support in enumerate(supports):
        axes, (own, rows) = [i] if mirror else [0, 1], (rows[: len(support)], rows[len(support) :])
        ab[:, i, own] = solve(all_columns[own][:, axes].flatten(1), (outputs * weight)[:, axes].flatten(1))
    return Guess(exponents, ab.reshape(*ab.shape[:2], 2, -1).transpose(1, 2).numpy())


def _candidates(degree: int, mirror: bool, dispersive: bool, moves: bool) -> Exponents:
    """Exponents up to a total degree; w and z multiply lower degrees only."""
    most = min(degree, 3) if mirror else degree
    return ordered(
        [
            (*p, w, z)
            for w in range(3 if dispersive else 1)
            for z in range(3 if moves else 1)
            for p in powers(6 if mirror else 3, most)
            if sum(p) + 2 * w + z + w * z <= most or (sum(p) == 0 and w + z <= 2)
        ]
    )


def _columns(field: LightField, z: Tensor, exponents: Exponents, mirror: bool, part: slice) -> Tensor:
    """[2 M, 2, n] candidate columns m a and m b."""
    f = LightField(field.p[:, part], field.u[:, part], field.w[part])
    m = monomials(torch.cat([f.invariants(mirror), z[None, part]]), exponents)[:, None]
    return torch.cat([m * f.p, m * f.u])
