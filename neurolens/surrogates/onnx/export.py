"""Complete ONNX graphs of surrogates: raw mm and nm in; scene ray, transmittance, stop crossing and status out.

Written node by node in float32. The speed comes from few passes over the rays: linear steps (planes, centring,
scaling, the two coefficients of every vector, tests) are rows of a few matrix products.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.base.files import atomic_path
from neurolens.modelfile import CARD_KEY, MODEL_KEY
from neurolens.surrogates.card import card_of, card_to_json
from neurolens.surrogates.domain import sample_domain
from neurolens.surrogates.model import DIRECTION, POSITION, LensModel
from neurolens.surrogates.onnx.cores import add_core
from neurolens.surrogates.onnx.derivatives import add_core_slopes, add_ray_derivatives, film_and_pupil
from neurolens.surrogates.onnx.graph import FLOAT, INT32, Graph
from neurolens.surrogates.onnx.light import TEST_SCALE, DirectionSeries, add_decoder, add_light_field, add_status
from neurolens.surrogates.stored import model_to_text, storable

# Names and shapes; "N" stands for the number of rays.
INPUTS: list[tuple[str, list[int | str]]] = [("rays", [5, "N"]), ("film_z_mm", [1]), ("stop_radius_mm", [1])]
OUTPUTS: list[tuple[str, int, list[int | str]]] = [
    ("scene_ray", FLOAT, [6, "N"]),
    ("transmittance", FLOAT, ["N"]),
    ("stop_xy_mm", FLOAT, [2, "N"]),
    ("status", INT32, ["N"]),
]


# Optional outputs: derivatives of the scene ray per mm of the film point's (of the pupil point's) x, then y.
DERIVATIVES: list[tuple[str, int, list[int | str]]] = [
    ("scene_ray_d_film", FLOAT, [2, 6, "N"]),
    ("scene_ray_d_pupil", FLOAT, [2, 6, "N"]),
]


def export_onnx(
    model: LensModel, path: str | Path, errors: dict[str, Any] | None = None, *, derivatives: bool = False
) -> Path:
    """Write a model with its card.

    Inputs: rays [5, N] float32 (film_x_mm, film_y_mm, pupil_x_mm, pupil_y_mm, wavelength_nm), film_z_mm [1],
    stop_radius_mm [1]. Outputs, as `LensModel.predict`: scene_ray [6, N] (x, y, z mm, unit direction; lens frame),
    transmittance [N], stop_xy_mm [2, N], status [N] int32.

    Args:
        errors: held-out errors for the card, JSON-able.
        derivatives: whether the graph gives `DERIVATIVES` too, to those who ask for them.

    Returns the path.

    Raises:
        InputError: weights or errors that are not finite; two gates for one reason on one surface, or one on the stop.
    """
    check_gates(model)
    g = Graph()
    add_model(g, model, DirectionSeries(largest_angle(model)), derivatives)
    proto = g.model(INPUTS, OUTPUTS + DERIVATIVES * derivatives, model_metadata(model, errors or {}))
    target = Path(path)
    with atomic_path(target) as temporary:
        temporary.write_bytes(proto.SerializeToString())
    return target


def model_metadata(model: LensModel, errors: dict[str, Any]) -> dict[str, str]:
    """The card, and the coefficients where their core has a form for files."""
    card = {CARD_KEY: card_to_json(card_of(model, errors))}
    return {**card, MODEL_KEY: model_to_text(model)} if storable(model.core) else card


def check_gates(model: LensModel) -> None:
    """Refuse gates whose codes could not be told apart.

    Raises:
        InputError: two gates for one reason on one surface, or one on the stop.
    """
    codes = [gate.status for gate in model.gates]
    if len({*codes, st.blocked(model.lens.stop_index, st.RIM)}) <= len(codes):
        raise InputError("export", "gates", codes, "one gate a surface and reason, and none on the rim of the stop")


def add_model(g: Graph, model: LensModel, series: DirectionSeries, derivatives: bool = False) -> None:
    """Append a whole model, from `INPUTS` to `OUTPUTS` and, on demand, `DERIVATIVES`."""
    field, inside = add_light_field(g, model)
    kappa = series.kappa if model.direction == "angle" else 1.0
    scale = np.array([model.scales.position_mm, kappa, model.scales.stop_mm])
    if derivatives:
        chain, wanted = film_and_pupil(g, model.encoding), (POSITION, DIRECTION)
        rows, columns = add_core_slopes(g, model.core, field, scale, TEST_SCALE, chain, wanted)
        add_ray_derivatives(g, model, rows, columns, series)
    else:
        rows = add_core(g, model.core, field, scale, TEST_SCALE)
    stop_square = add_decoder(g, model, rows, series)
    add_status(g, model, rows, stop_square, inside)
    g.reshape(rows.transmittance, [-1], out="transmittance")


def largest_angle(model: LensModel, count: int = 32768) -> float:
    """Largest angle (rad) from the axis of the model's passing rays, a little enlarged. Sets the length of series."""
    rays = sample_domain(model.domain, count, seed=5)
    with torch.no_grad():
        out = model.predict(rays)
    passed = out.status == st.PASSED
    angle = torch.atan2(torch.hypot(out.rays.dx, out.rays.dy), -out.rays.dz)
    return 1.03 * float(angle[passed].max()) if bool(passed.any()) else math.pi / 2
