"""The optical path as one more output of models, fitted apart from where rays go.

A camera ray crosses the focal plane, the paraxial image of infinity, in a point P. An ideal lens makes of all rays
through P one plane wave, of the direction s(P). The output is the optical path from P to the plane across s(P) through
the front focal point F, less that of the ray along the axis at the same wavelength, in um: with R the point of the
scene ray nearest to F,

    path = [P to R] - (R - F) . s(P) - (the same on the axis).

So it is the aberration of the wave, some hundred waves at most where the path itself is 1e5, which float32 holds to a
thousandth of a wave. A plane wave of any direction before the film meets near F, whatever direction it takes behind:
therefore a small change of s changes the path by (F - R) . ds alone (to second order), and the path to any object point
follows, in focus or not (`models.wavefront`). s(P) is stated (`direction_at`); it is near the mean of the rays of P.

Path and rays belong together: at P, d path = dR . (d - s), with d the direction of the scene ray.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.models.cores import Array, Phased, angle_vector
from neurolens.models.fitted import FilmRays
from neurolens.models.model import LensModel
from neurolens.models.targets import STOPPED_DOWN
from neurolens.models.terms import (
    Exponents,
    Sweep,
    backward,
    forward,
    monomials,
    ordered,
    pinned_threads,
    powers,
    replace_terms,
    solve,
)
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.setting.pupils import camera_rays, on_plane
from neurolens.optics.trace.rays import optical_path, trace
from neurolens.optics.trace.surfaces import Rays

# At most so many terms, the RMS at which no term is added, and the RMS above which there may be more terms.
TERMS, FINE_WAVES, ENOUGH_WAVES, MORE_TERMS = 120, 0.0015, 0.005, 240
# Where they leave more than this, rays count by their blur on the film, half at the second: where there is no image, a
# small share of a large error is as large as all of it in the image.
_MOST_WAVES, _SHARP_UM = 1.0, 100.0
# Candidates: largest degrees for the powers of w, and of all, those with (i + 1) (j + 1) (k + 1) up to the last number.
# Over 380 to 780 nm the path bends by w^4 and w^5 more than by any high degree of the rays: with w^3 at most, 120 terms
# left 0.85 waves of a fisheye in place of 0.006.
_DEGREES, _CROSS = (16, 12, 10, 8, 7, 6, 5), 64
_SURPLUS, _PASSES = 1.5, 3  # terms before elimination over terms kept; of replacement
_CHOICE_RAYS, _RAYS = 8000, 16_000
_DIRECTION = 4  # coefficients of s(P): more make the path less smooth
_GREEN_NM = 546.0  # of the waves of a lens for visible light
_STEP = 1e-4  # of the pupil's radius, for slopes of the path


class Waves(NamedTuple):
    """N rays about the focal point: P [2, N], R - F and directions [3, N] (mm), the path to R from P (mm) [N]."""

    point: Array
    foot: Array
    direction: Array
    length: Array


def with_phase(model: LensModel, rays: FilmRays, most: int = MORE_TERMS) -> LensModel:
    """Return the model with the optical path as one more output, fitted to rays that its lens passes.

    The path has at most `TERMS` terms, or `most` where these leave more than `ENOUGH_WAVES` and less than one wave. A
    network beside 120 terms, of 745 weights and a minute of training, left two to three times as much of wide lenses.
    It left less of a phone lens, whose path has cusps (0.011 waves for 0.023), and of an f/1 asphere (0.009 for 0.012).

    Raises:
        InputError: a lens with cylinders or ideal surfaces, or a first-order model.
    """
    lens = model.lens
    lens.require_glass("optical path")
    if model.encoding.mirror or model.direction == "slope":
        found = "(cylinders)" if model.encoding.mirror else f"(with method {model.method})"
        raise InputError(lens.path, "phase", found, "a round lens, and a fit of its rays")
    first, unit = first_order(lens), unit_um(lens)
    front = float(first.front_principal_z_mm - first.front_efl_mm)
    empty = np.zeros((0, 4), np.int64), np.zeros(0)
    core, rays = Phased((model.core,), *empty, float(first.rear_focal_z_mm), front, ()), rays.select(slice(0, _RAYS))
    with pinned_threads():
        core = replace(core, direction=_mean_direction(traced(lens, core, model.domain.pupil_z_mm, rays)))
        fit = _known(model, core, rays)
        exponents, path, off = _polynomial(model, fit, TERMS)
        if off >= _MOST_WAVES * unit:
            exponents, path, _ = _polynomial(model, _known(model, core, _towards_axis(model, rays), _SHARP_UM), TERMS)
        elif off > ENOUGH_WAVES * unit:
            exponents, path, _ = _polynomial(model, fit, most)
    return replace(model, core=replace(core, exponents=exponents, path=path))


def _known(model: LensModel, core: Phased, rays: FilmRays, sharp_um: float = math.inf) -> tuple[Tensor, Tensor, Tensor]:
    """Return the invariants and w [4, N] of rays, their paths [1, N] in um, and weights [N].

    `sharp_um`: a ray that is so far aside on the film counts half.
    """
    waves, variables = traced(model.lens, core, model.domain.pupil_z_mm, rays), model.encoding(rays).invariants()
    aside = np.linalg.norm(waves.direction - direction_at(core, waves.point), axis=0)
    blur_um = torch.from_numpy(aside) * abs(float(first_order(model.lens).efl_mm)) * 1000
    return (
        variables,
        torch.from_numpy(path_um(core, waves))[None],
        _weights(variables) / (1 + (blur_um / sharp_um) ** 2),
    )


def _towards_axis(model: LensModel, rays: FilmRays) -> FilmRays:
    """Return rays with film and pupil points of every second moved towards the axis, those that the lens passes.

    A condenser forms an image in the middle of the film only, to which too few of all its rays go.
    """
    film, pupil = np.random.default_rng(0).random((2, len(rays)))
    film[::2] = pupil[::2] = 1.0
    shares = (film**2, film**2, 1.0, pupil, pupil, 1.0)
    moved = FilmRays(*(c * torch.as_tensor(share) for c, share in zip(rays.columns(), shares, strict=True)))
    points = moved.film_x, moved.film_y, moved.film_z, moved.pupil_x, moved.pupil_y
    toward = camera_rays(*points, model.domain.pupil_z_mm)
    return moved.select(trace(model.lens, toward, moved.wavelength_nm).status == st.PASSED)


def _polynomial(model: LensModel, fit: tuple[Tensor, Tensor, Tensor], terms: int) -> tuple[Exponents, Array, float]:
    """Return the exponents and coefficients of the best terms, at most so many, and the RMS that they leave, in um."""
    variables, wanted, weights = fit
    allowed = FINE_WAVES * unit_um(model.lens)
    exponents = _chosen(variables, wanted, weights, allowed, terms, dispersive=model.encoding.dispersive)
    columns = monomials(variables, exponents)
    path = solve(columns, wanted, weights)
    off = float(((wanted - path @ columns) * weights).norm() / weights.norm())
    return exponents, path[0].numpy(), off


def unit_um(lens: Lens) -> float:
    """Return the wavelength in which errors are counted: 546 nm, or the reference of a lens for other light."""
    return (_GREEN_NM if lens.visible else lens.reference_nm) / 1000


def traced(lens: Lens, core: Phased, pupil_z_mm: float, rays: FilmRays) -> Waves:
    """Trace rays that the lens passes, from the focal plane on; their paths are less that of the axis."""
    toward = camera_rays(rays.film_x, rays.film_y, rays.film_z, rays.pupil_x, rays.pupil_y, pupil_z_mm)
    start = on_plane(toward, core.focal_z_mm)
    zero = torch.zeros_like(start.x)
    axis = Rays(zero, zero, start.z, zero, zero, zero - 1)
    ended, on_axis = (_to_foot(lens, core, each, rays.wavelength_nm) for each in (start, axis))
    return Waves(torch.stack([start.x, start.y]).numpy(), ended[0], ended[1], ended[2] - on_axis[2])


def _to_foot(lens: Lens, core: Phased, rays: Rays, wavelength_nm: Tensor) -> tuple[Array, Array, Array]:
    with torch.no_grad():
        out = trace(lens, rays, wavelength_nm, path=True)
        length = optical_path(lens, [rays, *out.path], wavelength_nm, "scene")
    foot, direction, further = foot_of(core, torch.stack(list(out.rays)).numpy())
    return foot, direction, length.numpy() + further


def foot_of(core: Phased, scene_ray: Array) -> tuple[Array, Array, Array]:
    """Return R - F and the direction [3, N] of scene rays [6, N], and the way [N] from their points to R, in mm."""
    direction = scene_ray[3:]
    from_f = scene_ray[:3] - np.array([0.0, 0.0, core.front_z_mm])[:, None]
    further = -(from_f * direction).sum(0)
    return from_f + further * direction, direction, further


def path_um(core: Phased, waves: Waves) -> Array:
    """Return the path [N] as this module defines it."""
    return np.asarray(1000 * (waves.length - (waves.foot * direction_at(core, waves.point)).sum(0)))


def direction_at(core: Phased, point_mm: Array) -> Array:
    """Return the unit direction s [3, N] of points P [2, N] of the focal plane (mm)."""
    square = (point_mm * point_mm).sum(0)
    angle = point_mm * np.polynomial.polynomial.polyval(square, np.array(core.direction))
    theta = np.hypot(*angle)
    return np.concatenate([angle * np.sinc(theta / math.pi), -np.cos(theta)[None]])


def _mean_direction(waves: Waves) -> tuple[float, ...]:
    """Fit s(P): its angle vector is P times a polynomial in |P|^2."""
    scale = float(np.hypot(*waves.point).max())
    columns = [(waves.point / scale * ((waves.point / scale) ** 2).sum(0) ** k).reshape(-1) for k in range(_DIRECTION)]
    wanted = angle_vector(*torch.from_numpy(waves.direction))
    found = np.linalg.lstsq(np.stack(columns, 1), wanted.numpy().reshape(-1), rcond=None)[0]
    return tuple((found / scale ** (1 + 2.0 * np.arange(_DIRECTION))).tolist())


def _weights(variables: Tensor) -> Tensor:
    """Return weights [N] of rays: more for those that a closed stop leaves, and for the middle of the film.

    Most pictures are taken with these, and images with a high Strehl ratio suffer most. Of rays drawn by area, they are
    few.
    """
    rho, _, tau, _ = variables
    return (1 + STOPPED_DOWN) / (tau.sqrt() + STOPPED_DOWN) / (rho.sqrt() + STOPPED_DOWN).sqrt()


def _chosen(
    variables: Tensor, wanted: Tensor, weights: Tensor, allowed: float, terms: int, *, dispersive: bool
) -> Exponents:
    """Choose at most `terms` [M, 4] for the path [1, N], whose RMS error, by the weights, may be the one allowed.

    Slopes of the path, which the rays give, save no terms as further equations: with 50 terms they left 0.047 waves in
    place of 0.036 (double Gauss f/1.8), 0.064 for 0.049 (zoom 14-24), 0.45 for 0.25 (Canon 50 mm f/1.2, aspheric).
    """
    degrees = _DEGREES if dispersive else _DEGREES[:1]
    every = [(*p, w) for w, most in enumerate(degrees) for p in powers(3, most)]
    candidates = ordered([e for e in every if math.prod(k + 1 for k in e[:3]) <= _CROSS])
    variables, wanted, weights = variables[:, :_CHOICE_RAYS], wanted[:, :_CHOICE_RAYS], weights[:_CHOICE_RAYS]
    sweep = Sweep.of_columns(monomials(variables, candidates) * weights, wanted * weights)
    enough = allowed**2 * float((weights**2).sum())
    for count in range(1, math.ceil(_SURPLUS * terms) + 1):
        forward(sweep, count)
        if sweep.residual <= enough:
            break
    backward(sweep, terms)
    replace_terms(sweep, _PASSES)
    while len(sweep.chosen) > 1 and sweep.residual + (costs := sweep.costs()).min() <= enough:
        sweep.drop(sweep.chosen[int(costs.argmin())])
    return candidates[sorted(sweep.chosen)]


def path_errors(model: LensModel, rays: FilmRays) -> dict[str, float]:
    """Return the errors of the path, in float32, on rays that the lens passes; {} without a path.

    "phase_rms_waves" and "phase_max_waves" are in waves of `unit_um`. "phase_rays_um" is the median distance, on the
    film, between where the slopes of the path and where the model's own rays say that light goes.
    """
    core = model.core
    if not isinstance(core, Phased):
        return {}
    with torch.no_grad():
        exact = path_um(core, traced(model.lens, core, model.domain.pupil_z_mm, rays))
        found = model.predict(rays.to(torch.float32)).path_um
    assert found is not None
    off = (found.double().numpy() - exact) / unit_um(model.lens)
    by_slopes, direction = _directions(model, core, rays)
    apart = np.linalg.norm(by_slopes - direction, axis=0) * abs(float(first_order(model.lens).efl_mm)) * 1000
    return {
        "phase_rms_waves": float(np.sqrt((off**2).mean())), "phase_max_waves": float(np.abs(off).max()),
        "phase_rays_um": float(np.median(apart)),
    }  # fmt: skip


def _directions(model: LensModel, core: Phased, rays: FilmRays) -> tuple[Array, Array]:
    """Return the directions [3, N] of scene rays by the slopes of the path at P, and those of the model."""
    share = (core.focal_z_mm - rays.film_z) / (model.domain.pupil_z_mm - rays.film_z)
    step = _STEP * model.domain.pupil_radius_mm

    def moved(x: float, y: float) -> tuple[Array, Array, Array]:
        """Return path, foot and direction with the pupil point moved, and P where it was."""
        back = -share / (1 - share)
        there = FilmRays(
            rays.film_x + x * back, rays.film_y + y * back, rays.film_z, rays.pupil_x + x, rays.pupil_y + y,
            rays.wavelength_nm,
        )  # fmt: skip
        with torch.no_grad():
            out = model.predict(there)
        assert out.path_um is not None
        foot, direction, _ = foot_of(core, torch.stack(list(out.rays)).numpy())
        return out.path_um.numpy() / 1000, foot, direction

    _, _, direction = moved(0.0, 0.0)
    ends = [(moved(x, y), moved(-x, -y)) for x, y in ((step, 0.0), (0.0, step))]
    slopes = [high[0] - low[0] for high, low in ends]
    across = [high[1] - low[1] for high, low in ends]
    points = rays.film_x + (rays.pupil_x - rays.film_x) * share, rays.film_y + (rays.pupil_y - rays.film_y) * share
    s = direction_at(core, torch.stack(points).numpy())
    # d - s is across s + d, for both are unit vectors.
    rows = np.stack([*across, s + direction]).transpose(2, 0, 1)
    right = np.stack([*slopes, np.zeros_like(slopes[0])], 1)[..., None]
    return s + np.linalg.solve(rows, right)[..., 0].T, direction


def card_entry(core: Any) -> Mapping[str, Any]:
    """Return what a card says of the path of a model; {} without one."""
    if not isinstance(core, Phased):
        return {}
    return {"phase": {
        "about": __doc__.split("\n\n", 1)[1].strip(), "terms": len(core.path),
        "focal_z_mm": core.focal_z_mm,
        "front_z_mm": core.front_z_mm, "direction_rad_per_mm": list(core.direction),
    }}  # fmt: skip
