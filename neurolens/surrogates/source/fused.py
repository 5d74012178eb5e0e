"""A whole model as one program of float steps: raw mm and nm in; scene ray, transmittance, stop crossing, status out.

The same contract as the ONNX graph, status codes in the same order, ray by ray instead of row by row.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.modelfile import DOMAIN_SLACK
from neurolens.programs.contract import FILM_Z, RAY, SCENE_RAY, STOP_RADIUS, WAVELENGTH
from neurolens.programs.expressions import Expr, Program
from neurolens.surrogates.front import sag_mm
from neurolens.surrogates.model import DIRECTION, POSITION, STOP, LensModel
from neurolens.surrogates.onnx.export import largest_angle
from neurolens.surrogates.onnx.series import fit_series
from neurolens.surrogates.source.cores import Field, Results, Wanted, add_core

_T = TypeVar("_T")
# Passing rays cross the front surface within its rim; a little more, for the model's own error.
_FRONT_REACH = 1.02
_SAG_MM = 1e-6
_MOST_SAG_TERMS = 12


@dataclass(frozen=True)
class Parts:
    """What of a model's work is wanted besides the scene ray and the domain guard.

    Attributes:
        transmittance: the transmittance.
        stop: the crossing with the stop as an output.
        vignetting: status of the stop and of the rims.
    """

    transmittance: bool = True
    stop: bool = True
    vignetting: bool = True


ALL, RAY_ONLY = Parts(), Parts(False, False, False)


@dataclass(frozen=True)
class Fixed:
    """Call arguments that a scene fixes; None leaves them to the caller.

    A wavelength is fixed in the models themselves (`specialise.at_wavelength`), one model a table.
    """

    film_z_mm: float | None = None
    stop_radius_mm: float | None = None


FREE = Fixed()


def fused_program(models: Sequence[LensModel], parts: Parts = ALL, fixed: Fixed = FREE) -> Program:
    """The program of a model, or of several that differ only in their coefficients (one for each wavelength).

    Inputs: `RAY`, then wavelength_nm where rays depend on it, film_z_mm unless fixed, and stop_radius_mm unless fixed
    or without vignetting. Outputs: `SCENE_RAY`; transmittance, stop_x_mm and stop_y_mm as asked for; status, a float.

    Raises:
        InputError: weights that float32 cannot hold; a fixed film position or stop outside the domain.
        TypeError: a core that has no form here.
    """
    model = models[0]
    _check_fixed(model, fixed)
    program = Program(tables=len(models))
    guards: list[tuple[Expr, Expr]] = []  # inside the domain where each first is at most its second
    field = _light_field(program, model, fixed, guards)
    gates = tuple(parts.vignetting for _ in model.gates)
    wanted = Wanted((True, True, parts.stop or parts.vignetting), (parts.transmittance, *gates))
    scale = np.array([model.scales.position_mm, 1.0, model.scales.stop_mm])
    results = add_core(program, [m.core for m in models], field, scale, wanted)
    _scene_ray(program, models, results)
    if parts.transmittance:
        program.outputs["transmittance"] = _there(results.scalars[0])
    if parts.stop:
        program.outputs["stop_x_mm"], program.outputs["stop_y_mm"] = _there(results.vectors[STOP])
    status = program.literal(float(st.PASSED))
    if parts.vignetting:
        status = _vignetting(program, model, results, fixed, guards)
    for low, high in guards:
        status = program.select(low, high, status, float(st.OUTSIDE_DOMAIN))
    program.outputs["status"] = status
    return program


def _there(value: _T | None) -> _T:
    assert value is not None  # it was asked for
    return value


def _check_fixed(model: LensModel, fixed: Fixed) -> None:
    (near, far), stop = model.domain.film_z_mm, model.domain.stop_radius_mm
    z, radius = fixed.film_z_mm, fixed.stop_radius_mm
    if z is not None and not near / DOMAIN_SLACK <= z <= far * DOMAIN_SLACK:
        raise InputError("fix", "film_z", z, f"{near:.6g} to {far:.6g} mm, the film positions of the fit")
    if radius is not None and not 0 <= radius <= stop * DOMAIN_SLACK:
        raise InputError("fix", "stop", radius, f"0 to {stop:.6g} mm, the widest stop of the fit")


def _light_field(program: Program, model: LensModel, fixed: Fixed, guards: list[tuple[Expr, Expr]]) -> Field:
    """Planes and wavelength, centred and scaled, and the limits of what comes in."""
    e, d = model.encoding, model.domain
    film_x, film_y, pupil_x, pupil_y = (program.input(name) for name in RAY)
    for x, y, radius in ((film_x, film_y, d.film_radius_mm), (pupil_x, pupil_y, d.pupil_radius_mm)):
        guards.append((program.fma(x, x, y * y), program.literal((radius * DOMAIN_SLACK) ** 2)))
    w = program.literal(0.0)
    if e.w_half:
        wavelength = program.input(WAVELENGTH)
        low, high = model.wavelength_limits_nm
        guards += [(program.literal(low), wavelength), (wavelength, program.literal(high))]
        # v = 1000 / (lambda sqrt(half)), so that w = v^2 - middle / half.
        v = program.literal(1000 / math.sqrt(e.w_half)) / wavelength
        w = program.fma(v, v, -e.w_middle / e.w_half)
    z = program.literal(fixed.film_z_mm) if fixed.film_z_mm is not None else program.input(FILM_Z)
    if fixed.film_z_mm is None:
        near, far = d.film_z_mm
        guards += [(program.literal(near / DOMAIN_SLACK), z), (z, program.literal(far * DOMAIN_SLACK))]
    along = program.literal(e.film_plane_z_mm - e.pupil_plane_z_mm) / (z - e.pupil_plane_z_mm)
    rest = program.literal(1.0) - along
    p, u = [], []
    for film, pupil, chief, spread in zip(
        (film_x, film_y), (pupil_x, pupil_y), e.chiefs, e.pupil_scales_mm, strict=True
    ):
        # p = u + (film - u) along and u - k p: two products of the raw points each.
        p.append(program.fma(film, along * (1 / e.film_scale_mm), pupil * (rest * (1 / e.film_scale_mm))))
        own = program.fma(rest, -chief / spread, 1 / spread)
        u.append(program.fma(pupil, own, film * (along * (-chief / spread))))
    return Field((p[0], p[1]), (u[0], u[1]), w)


def _scene_ray(program: Program, models: Sequence[LensModel], results: Results) -> None:
    model = models[0]
    x, y = _there(results.vectors[POSITION])
    vx, vy = _there(results.vectors[DIRECTION])
    t = program.fma(vx, vx, vy * vy)
    if model.direction == "slope":
        # (dx, dy) = slope / sqrt(1 + slope^2); the position lies in the plane of the front vertex.
        factor = program.literal(1.0) / program.op("sqrt", t + 1.0)
        z, dz = program.literal(0.0), -factor
    else:
        angle = max(largest_angle(m) for m in models)
        sinc = fit_series(lambda s: np.sinc(np.sqrt(s) / np.pi), angle**2, 3e-8 / max(angle, 0.1))
        minus_cos = fit_series(lambda s: -np.cos(np.sqrt(s)), angle**2, 3e-8)
        factor, dz = program.horner(t, list(sinc)), program.horner(t, list(minus_cos))
        z = _sag(program, model, x, y)
    for name, value in zip(SCENE_RAY, (x, y, z, vx * factor, vy * factor, dz), strict=True):
        program.outputs[name] = value


def _sag(program: Program, model: LensModel, x: Expr, y: Expr) -> Expr:
    """z on the front surface: a polynomial in the squared height where few terms hold it, else with a square root."""
    front = model.lens.surfaces[0]
    h2 = {None: program.fma(x, x, y * y), "x": x * x, "y": y * y}[front.cylinder]
    reach = (_FRONT_REACH * front.semi_diameter_mm) ** 2

    def sag(square: NDArray[np.float64]) -> NDArray[np.float64]:
        h = torch.from_numpy(np.sqrt(square))
        none = torch.zeros_like(h)
        return sag_mm(front, none if front.cylinder == "y" else h, h if front.cylinder == "y" else none).numpy()

    # In units of the rim, so that high powers stay within float32.
    series = fit_series(lambda s: sag(s * reach), 1.0, _SAG_MM)
    t = np.linspace(0, 1, 1000)
    held = np.abs(np.polynomial.Polynomial(series)(t) - sag(t * reach)).max() < 2 * _SAG_MM
    if held and len(series) <= _MOST_SAG_TERMS:
        return program.horner(h2, list(series / reach ** np.arange(len(series))))
    c, conic = float(front.curvature), float(front.conic)
    root = program.op("sqrt", program.op("max", program.fma(h2, -(1 + conic) * c * c, 1.0), 0.0))
    z = h2 * c / (root + 1.0)
    for power, a in front.asphere:
        z = program.fma(_power(program, h2, power), float(a), z)
    return z


def _power(program: Program, square: Expr, power: int) -> Expr:
    """h^power from h^2."""
    value = program.op("sqrt", square) if power % 2 else program.literal(1.0)
    for _ in range(power // 2):
        value = value * square
    return value


def _vignetting(
    program: Program, model: LensModel, results: Results, fixed: Fixed, guards: list[tuple[Expr, Expr]]
) -> Expr:
    """First failure in the order of travel: the code written last; NaN fails. The stop's limits join the guards."""
    x, y = _there(results.vectors[STOP])
    if fixed.stop_radius_mm is None:
        radius = program.input(STOP_RADIUS)
        guards.append((program.literal(0.0), radius))
        guards.append((radius, program.literal(model.domain.stop_radius_mm * DOMAIN_SLACK)))
        limit = radius * radius
    else:
        limit = program.literal(fixed.stop_radius_mm**2)
    zero = program.literal(0.0)
    tests = [(program.fma(x, x, y * y), limit, st.blocked(model.lens.stop_index, st.RIM))]
    tests += [(_there(v), zero, g.status) for v, g in zip(results.scalars[1:], model.gates, strict=True)]
    status = program.literal(float(st.PASSED))
    for value, most, code in sorted(tests, key=lambda test: (test[2] // 4, -(test[2] % 4))):
        status = program.select(value, most, status, float(code))
    return status
