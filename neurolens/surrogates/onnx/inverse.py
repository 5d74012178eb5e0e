"""Inverse maps as ONNX graphs: the first guess, the Newton steps written out, then the model itself at the solution.

Written out, the steps are one call without traffic between numpy and the graph: 5 to 8 (stop) and 7 to 14 (scene)
times the time of the model. A loop in numpy over a model with derivatives takes 1.6 times as long as that, its guess
not counted (measured: 3 calls with derivatives, 3 solutions of 4 x 4 systems), and few rays could leave it early.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.files import atomic_path
from neurolens.modelfile import CARD_KEY
from neurolens.surrogates.card import card_of, card_to_json
from neurolens.surrogates.cores import DIRECTION, POSITION, STOP
from neurolens.surrogates.export import check_gates, largest_angle
from neurolens.surrogates.inversion.guess import Guess
from neurolens.surrogates.inversion.maps import LIMIT, STEPS, TOLERANCE, InverseModel
from neurolens.surrogates.inversion.newton import REACH, SHORTER
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.onnx.cores import CoreRows, Field
from neurolens.surrogates.onnx.derivatives import Chain, Columns, add_core_slopes, film_and_pupil
from neurolens.surrogates.onnx.graph import FLOAT, INT32, Graph
from neurolens.surrogates.onnx.light import (
    TEST_SCALE,
    DirectionSeries,
    add_decoder,
    add_light_field,
    add_status,
    invariant_weights,
)
from neurolens.surrogates.onnx.monomials import add_polynomial, without_constants
from neurolens.surrogates.onnx.solve import absolute, add_determinant, add_solve, square_length

Array = NDArray[np.float64]
# Unknowns [K, N] to residual [K, N] and Jacobian columns [K, N] each.
AddEvaluate = Callable[[str], tuple[str, list[str]]]
_HUGE = 3e38


def export_inverse(inverse: InverseModel, path: str | Path, errors: dict[str, Any] | None = None) -> tuple[Path, Path]:
    """Write both inverse maps beside a model's file: NAME.stop.onnx and NAME.scene.onnx for NAME.onnx.

    Both take film_z_mm [1] and stop_radius_mm [1], and give rays [5, N] (film x, y, pupil x, y, wavelength), scene_ray,
    transmittance, stop_xy_mm and status as the model does for those rays (NO_SOLUTION where they are not what was asked
    for), and density [N]. The stop map takes stop_rays [5, N]: film x, y, stop x, y in mm, wavelength in nm; the scene
    map front_rays [5, N]: x and y on the front surface in mm, the direction vector of the model (angle vector in rad,
    or slope), wavelength. Densities are those of `InverseModel`, but that of the scene map is per area of direction
    vectors instead of steradian.

    Args:
        path: of the model's file. errors: for the card, as of `export_onnx`.

    Raises:
        InputError, TypeError: as `export_onnx`.
    """
    check_gates(inverse.model)
    base = Path(path).with_suffix("")
    card = card_of(inverse.model, errors or {})
    front = inverse.model.lens.surfaces[0]
    shape = {
        "curvature": float(front.curvature),
        "conic": float(front.conic),
        "asphere": [[int(p), float(a)] for p, a in front.asphere],
        "cylinder": front.cylinder,
    }
    written = []
    for name, add, given in (("stop", _add_stop, "stop_rays"), ("scene", _add_scene, "front_rays")):
        g = Graph()
        add(g, inverse)
        known = {
            "map": name,
            "steps": STEPS,
            "tolerance": TOLERANCE,
            "direction": inverse.model.direction,
            "front": shape if inverse.model.direction == "angle" else None,
            "fit": inverse.report,
        }
        proto = g.model(
            [(given, [5, "N"]), ("film_z_mm", [1]), ("stop_radius_mm", [1])],
            [
                ("rays", FLOAT, [5, "N"]),
                ("scene_ray", FLOAT, [6, "N"]),
                ("transmittance", FLOAT, ["N"]),
                ("stop_xy_mm", FLOAT, [2, "N"]),
                ("density", FLOAT, ["N"]),
                ("status", INT32, ["N"]),
            ],
            {CARD_KEY: card_to_json({**card, "inverse": known})},
        )
        target = base.with_name(f"{base.name}.{name}.onnx")
        with atomic_path(target) as temporary:
            temporary.write_bytes(proto.SerializeToString())
        written.append(target)
    return written[0], written[1]


def _add_stop(g: Graph, inverse: InverseModel) -> None:
    model, e = inverse.model, inverse.model.encoding
    film, stop, wavelength = g.split("stop_rays", [2, 2, 1])
    wanted = g.op("Mul", stop, g.const(1 / model.scales.stop_mm))
    guess_field = _field(g, model, g.op("Mul", film, g.const(1 / e.film_scale_mm)), wanted, wavelength)
    near, far = model.domain.film_z_mm
    z = ""
    if far > near:
        z = g.op("Mul", g.op("Sub", "film_z_mm", g.const([(near + far) / 2])), g.const([2 / (far - near)]))
        z = g.op("Add", g.op("Mul", wavelength, g.const(0.0)), z)
    chief, scale = (np.array(v)[:, None] for v in (e.chiefs, e.pupil_scales_mm))
    centre = g.op("Mul", film, g.const(chief))
    whole = film_and_pupil(g, e)
    chain = Chain(whole.base[:, 2:] * scale.T, whole.slope[:, 2:] * scale.T, whole.along)

    def rays(u: str, out: str | None = None) -> str:
        return g.concat(film, g.op("Add", centre, g.op("Mul", u, g.const(scale))), wavelength, out=out)

    def evaluate(u: str) -> tuple[str, list[str]]:
        field, _ = add_light_field(g, model, rays(u))
        rows, columns = add_core_slopes(g, model.core, field, np.ones(3), None, chain, (STOP,))
        return g.op("Sub", rows.stop, wanted), columns[STOP]

    u = _newton(g, evaluate, _guess(g, inverse.stop, guess_field, z)[0])
    rays(u, "rays")
    judged = _Judged(g, model, chain, (STOP,))
    off = g.op("Sub", g.op("Mul", judged.rows.stop, g.const(1 / model.scales.stop_mm)), wanted)
    judged.finish(off)
    # Columns are mm on the stop per scaled unit on the pupil.
    area = add_determinant(g, judged.columns[STOP])
    g.reshape(g.op("Mul", absolute(g, area), g.const(1 / float(scale.prod()))), [-1], out="density")


def _add_scene(g: Graph, inverse: InverseModel) -> None:
    model, e = inverse.model, inverse.model.encoding
    position, direction, wavelength = g.split("front_rays", [2, 2, 1])
    position = g.op("Mul", position, g.const(1 / model.scales.position_mm))
    wanted = g.concat(position, direction)
    guess = _guess(g, inverse.scene, _field(g, model, position, direction, wavelength), "")
    # Unknowns u, then p.
    chain = Chain(np.roll(np.eye(4), 2, axis=0), np.zeros((4, 4)))

    def evaluate(unknown: str) -> tuple[str, list[str]]:
        u, p = g.split(unknown, [2, 2])
        field = _field(g, model, p, u, wavelength)
        rows, columns = add_core_slopes(g, model.core, field, np.ones(3), None, chain, (POSITION, DIRECTION))
        stacked = [g.concat(a, b) for a, b in zip(columns[POSITION], columns[DIRECTION], strict=True)]
        return g.op("Sub", g.concat(rows.position, rows.direction), wanted), stacked

    u, p = g.split(_newton(g, evaluate, g.concat(*guess)), [2, 2])
    chief, scale = (np.array(v)[:, None] for v in (e.chiefs, e.pupil_scales_mm))
    p = g.op("Mul", p, g.const(e.film_scale_mm))
    pupil = g.op("Add", g.op("Mul", p, g.const(chief)), g.op("Mul", u, g.const(scale)))
    # F = U + (P - U) / along.
    gap = g.op("Sub", "film_z_mm", g.const([e.pupil_plane_z_mm]))
    back = g.op("Mul", gap, g.const([1 / (e.film_plane_z_mm - e.pupil_plane_z_mm)]))
    film = g.op("Add", pupil, g.op("Mul", g.op("Sub", p, pupil), back))
    g.concat(film, pupil, wavelength, out="rays")
    judged = _Judged(g, model, chain, (POSITION, DIRECTION))
    units = np.array([1 / model.scales.position_mm] * 2 + [1 / judged.kappa] * 2)[:, None]
    found = g.op("Mul", g.concat(judged.rows.position, judged.rows.direction), g.const(units))
    judged.finish(g.op("Sub", found, wanted))
    columns = [g.concat(a, b) for a, b in zip(judged.columns[POSITION], judged.columns[DIRECTION], strict=True)]
    area = absolute(g, add_determinant(g, columns))  # mm^2 times (kappa rad)^2 per scaled unit
    factor = e.film_scale_mm**2 * float(scale.prod()) * judged.kappa**2
    film_area = g.op("Mul", g.op("Mul", back, back), g.const([factor]))
    g.reshape(g.op("Div", film_area, area), [-1], out="density")


class _Judged:
    """The model at "rays", with derivatives of some vectors, and its outputs."""

    def __init__(self, g: Graph, model: LensModel, chain: Chain, wanted: tuple[int, ...]) -> None:
        self.g, self.model = g, model
        series = DirectionSeries(largest_angle(model))
        self.kappa = series.kappa if model.direction == "angle" else 1.0
        field, inside = add_light_field(g, model)
        scale = np.array([model.scales.position_mm, self.kappa, model.scales.stop_mm])
        made: tuple[CoreRows, Columns] = add_core_slopes(g, model.core, field, scale, TEST_SCALE, chain, wanted)
        self.rows, self.columns = made
        add_status(g, model, self.rows, add_decoder(g, model, self.rows, series), inside, "model_status")
        g.reshape(self.rows.transmittance, [-1], out="transmittance")

    def finish(self, off: str) -> None:
        """Output status, from the residual [K, N]."""
        g = self.g
        solved = g.op("LessOrEqual", g.reshape(square_length(g, off), [-1]), g.const([TOLERANCE**2]))
        g.op("Where", solved, "model_status", g.const([st.NO_SOLUTION], np.int32), out="status")


def _field(g: Graph, model: LensModel, p: str, u: str, wavelength: str) -> Field:
    """A light field of p and u, scaled, as `add_light_field` makes it of rays."""
    e = model.encoding
    planes = [p, u, g.op("Add", p, u)]
    if e.w_half:
        planes.append(g.once("Div", g.const(1000 / math.sqrt(e.w_half)), wavelength))
    stacked = g.concat(*planes)
    weight, bias = invariant_weights(e)
    return Field(p, u, g.op("Mul", stacked, stacked), weight, bias, e.w_half != 0)


def _guess(g: Graph, guess: Guess, field: Field, z: str) -> list[str]:
    """The vectors [2, N] of a first guess; `z` may be "" where it is 0."""
    k, wide = len(guess.ab), guess.ab.shape[2]
    weight = np.asarray(guess.ab.double().numpy()).reshape(2 * k * wide, -1)
    last = guess.exponents.shape[1] - 1  # z; before it w
    variables = [v for v in range(last) if v < last - 1 or field.dispersive]
    first = g.affine(field.weight[variables], field.squares, field.bias[variables])
    if z:
        variables, first = [*variables, last], g.concat(first, z)
    exponents, weight = without_constants(guess.exponents, weight, variables)
    rows = g.split(add_polynomial(g, first, exponents, weight), [wide] * (2 * k))
    return [
        g.op("Add", g.op("Mul", a, field.p), g.op("Mul", b, field.u))
        for a, b in zip(rows[::2], rows[1::2], strict=True)
    ]


def _newton(g: Graph, evaluate: AddEvaluate, start: str) -> str:
    """`limited_newton` written out: unknowns [K, N] after STEPS steps."""

    def inside(x: str) -> str:
        return g.op("Clip", x, g.const(-REACH), g.const(REACH))

    best = inside(start)
    size = step = ""
    x = best
    for _ in range(STEPS):
        residual, columns = evaluate(x)
        found = square_length(g, residual)
        newton = _limited(g, add_solve(g, columns, residual))
        if not size:
            best, size, step = x, found, newton
        else:
            better = g.op("Greater", size, found)
            best = g.op("Where", better, x, best)
            step = g.op("Where", better, newton, g.op("Mul", step, g.const(SHORTER)))
            size = g.op("Where", better, found, size)
        x = inside(g.op("Sub", best, step))
    return x


def _limited(g: Graph, step: str) -> str:
    """A step no longer than LIMIT, and none where it is not finite."""
    square = square_length(g, step)
    length = g.op("Max", g.op("Sqrt", square), g.const(LIMIT))
    shorter = g.op("Mul", step, g.op("Div", g.const(LIMIT), length))
    return g.op("Where", g.op("LessOrEqual", square, g.const(_HUGE)), shorter, g.const(0.0))
