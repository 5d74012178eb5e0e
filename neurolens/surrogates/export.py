"""Models as ONNX files with their cards: of one state, or of a zoom's (and internal focus's) whole range."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.base.files import atomic_path
from neurolens.graph.onnx import write_onnx
from neurolens.lens.paraxial import first_order
from neurolens.setting.focusing import at_infinity
from neurolens.surrogates.assemble import ONNX
from neurolens.surrogates.card import card_of, card_to_json, lens_facts, reference_rays
from neurolens.surrogates.cardkeys import CARD_KEY, MODEL_KEY
from neurolens.surrogates.cardstates import STATE
from neurolens.surrogates.file import as_stored, coefficients_text, onnx_of
from neurolens.surrogates.inverse import STEPS, TOLERANCE, Guess, InverseModel, front_index, scene_graph, stop_graph
from neurolens.surrogates.model import LensModel

if TYPE_CHECKING:
    from neurolens.surrogates.states import StateModel


def export_onnx(
    model: LensModel, path: str | Path, errors: dict[str, Any] | None = None, *, derivatives: bool = False
) -> Path:
    """Write a model with its card.

    Inputs: rays [5, N] float32 (film_x_mm, film_y_mm, pupil_x_mm, pupil_y_mm, wavelength_nm), film_z_mm [1],
    stop_radius_mm [1]. Outputs, as `LensModel.predict`: scene_ray [6, N] (x, y, z mm, unit direction; lens frame),
    transmittance [N], stop_xy_mm [2, N], status [N] int32.

    Args:
        errors: held-out errors for the card, JSON-able.
        derivatives: further outputs, scene_ray_d_film and scene_ray_d_pupil [2, 6, N]: of the scene ray per mm of the
            film point's (of the pupil point's) x, then y.

    Returns the path.

    Raises:
        InputError: weights or errors that are not finite; two gates for one reason on one surface, or one on the stop.
    """
    check_gates(model)
    metadata = {CARD_KEY: card_to_json(card_of(model, errors or {})), MODEL_KEY: coefficients_text([model])}
    return write_file(path, onnx_of(as_stored([model]), metadata=metadata, derivatives=derivatives))


def write_file(path: str | Path, data: bytes) -> Path:
    """Write an ONNX model, whole or not at all."""
    target = Path(path)
    with atomic_path(target) as temporary:
        temporary.write_bytes(data)
    return target


def check_gates(model: LensModel) -> None:
    """Refuse gates whose codes could not be told apart.

    Raises:
        InputError: two gates for one reason on one surface, or one on the stop.
    """
    codes = [gate.status for gate in model.gates]
    if len({*codes, st.blocked(model.lens.stop_index, st.RIM)}) <= len(codes):
        raise InputError("export", "gates", codes, "one gate a surface and reason, and none on the rim of the stop")


def export_inverse(inverse: InverseModel, path: str | Path, errors: dict[str, Any] | None = None) -> tuple[Path, Path]:
    """Write both inverse maps beside a model's file: NAME.stop.onnx and NAME.scene.onnx for NAME.onnx.

    Both give rays [5, N] (film x, y, pupil x, y, wavelength), scene_ray, transmittance, stop_xy_mm and status as the
    model does for those rays (NO_SOLUTION where they are not what was asked for), and density [N]. Inputs: see
    `stop_graph` and `scene_graph`; per-call ones have the shape [1].

    Args:
        path: of the model's file. errors: for the card, as of `export_onnx`.

    Raises:
        InputError: as `export_onnx`.
    """
    model = inverse.model
    check_gates(model)
    base, card, front = Path(path).with_suffix(""), card_of(model, errors or {}), model.front
    shape = front and {
        "curvature": float(front.curvature),
        "conic": float(front.conic),
        "asphere": [[int(p), float(a)] for p, a in front.asphere],
        "cylinder": front.cylinder,
        "across": front.across,
        "index": front_index(model),
    }
    written = []
    (stored,) = as_stored([model])
    for name, guess, build in (("stop", inverse.stop, stop_graph), ("scene", inverse.scene, scene_graph)):
        known = {
            "map": name,
            "steps": STEPS,
            "tolerance": TOLERANCE,
            "direction": model.direction,
            "front": shape,
            "fit": inverse.report,
        }
        metadata = {
            CARD_KEY: card_to_json({**card, "inverse": known}),
            MODEL_KEY: coefficients_text([model], guess=guess.packed()),
        }
        data = write_onnx(build(stored, Guess.unpacked(guess.packed()), ONNX), metadata)
        written.append(write_file(base.with_name(f"{base.name}.{name}.onnx"), data))
    return written[0], written[1]


def export_states(model: StateModel, path: str | Path, errors: dict[str, Any] | None = None) -> Path:
    """Write a model of many states with its card.

    As `export_onnx`, with one more input: state [A], a number for every axis, in its unit. A state out of range puts
    every ray outside the domain.

    Args:
        errors: held-out errors for the card, JSON-able.

    Raises:
        InputError: what `export_onnx` refuses, and nodes whose graphs differ in more than numbers.
    """
    check_gates(model.nodes[0])
    card = card_to_json(state_card(model, errors or {}))
    metadata = {CARD_KEY: card, MODEL_KEY: coefficients_text(model.nodes)}
    return write_file(path, onnx_of(as_stored(model.nodes), model.axes, metadata))


def state_card(model: StateModel, errors: dict[str, Any]) -> dict[str, Any]:
    """The card of the model at its first state, with axes, nodes' lenses and domains, and more rays."""
    first = model.at(*model.first_state)
    card = card_of(first, errors)
    card["units"] = {**card["units"], STATE: [f"{a.name} {a.unit}" for a in model.axes]}
    card["states"] = {
        "axes": [a.to_dict() for a in model.axes],
        "default": list(model.first_state),
        "zoom": model.space.zoom,
        "f_number": model.space.f_number,
        "nodes": [{"lens": _node_facts(node), "domain": node.domain.to_dict()} for node in model.nodes],
        "reference": [{"state": list(s), **reference_rays(model.at(*s), 8, 1)} for s in _between_nodes(model)],
    }
    return card


def _node_facts(node: LensModel) -> dict[str, Any]:
    """The card's table of a node's lens; the f-number is that at infinity focus, as photographers count."""
    facts = lens_facts(node.lens, node.domain)
    return {**facts, "f_number": float(first_order(at_infinity(node.lens)).f_number)}


def _between_nodes(model: StateModel) -> list[tuple[float, ...]]:
    """States at which a client may check itself: the far end, and two where no node is."""
    shares = ((0.31, 0.62), (0.77, 0.38))
    ends = [a.range for a in model.axes]
    inner = [tuple(lo + (hi - lo) * s for (lo, hi), s in zip(ends, share, strict=False)) for share in shares]
    return [tuple(hi for _, hi in ends), *(tuple(float(np.float32(v)) for v in s) for s in inner)]
