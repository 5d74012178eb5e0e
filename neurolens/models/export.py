"""Writes models with their cards as ONNX files: of one state, of a range of zoom or focus, and inverse maps.

A card is one JSON string: what the model is, where it holds and how well. `models.card` reads and checks it.
"""

from __future__ import annotations

import math
import platform
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

import neurolens
from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.base.files import atomic_path
from neurolens.graph.onnx import write_onnx
from neurolens.models.assemble import ONNX
from neurolens.models.axes import STATE
from neurolens.models.card import CARD_KEY, CARD_KIND, CARD_SCHEMA, MODEL_KEY, POLARISED, card_to_json
from neurolens.models.copied import copy_inputs
from neurolens.models.file import as_stored, coefficients_text, onnx_of
from neurolens.models.fitted import Domain, FilmRays
from neurolens.models.inverse import (
    STEPS,
    TOLERANCE,
    InverseModel,
    convergence,
    front_index,
    passing_rays,
    scene_graph,
    stop_graph,
)  # fmt: skip
from neurolens.models.model import LensModel, Prediction
from neurolens.models.pairs import sample_domain
from neurolens.models.phase import card_entry
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.setting.focusing import at_infinity

if TYPE_CHECKING:
    from neurolens.models.fit import StateModel

UNITS = {
    "rays": ["film_x mm", "film_y mm", "pupil_x mm", "pupil_y mm", "wavelength nm"],
    "film_z_mm": "mm",
    "stop_radius_mm": "mm",
    "scene_ray": ["x mm", "y mm", "z mm", "dx", "dy", "dz"],
    "transmittance": "share of the power, 0 to 1",
    "stop_xy_mm": "mm",
    "status": "integer, see status_codes",
}
LENSFUN = (
    "rims fitted to photographs and the table measured are made from lensfun's database (https://lensfun.github.io), "
    "CC BY-SA 3.0 (https://creativecommons.org/licenses/by-sa/3.0/): see lenses/LICENSE"
)
_CHECKED = 20_000  # rays that inverse maps are to find
FRAME = (
    "Lens frame: z along the optical axis, front vertex at z = 0, film at z > 0, x right and y up seen from behind the "
    "camera; rays leave the film point towards the pupil point on the plane domain.pupil_z_mm; scene_ray is a point on "
    "{place} and a unit direction towards -z."
)


def export_onnx(
    model: LensModel, path: str | Path, errors: dict[str, Any] | None = None, *, derivatives: bool = False
) -> Path:
    """Write a model with its card.

    Inputs: rays [5, N] float32 (film_x_mm, film_y_mm, pupil_x_mm, pupil_y_mm, wavelength_nm), film_z_mm [1],
    stop_radius_mm [1]. Outputs, as `LensModel.predict`: scene_ray [6, N] (x, y, z mm, unit direction; lens frame),
    transmittance [N], stop_xy_mm [2, N], status [N] int32.

    Args:
        errors: held-out errors for the card, JSON-able.
        derivatives: whether to write two more outputs, scene_ray_d_film and scene_ray_d_pupil [2, 6, N]: the
            derivatives of the scene ray by x and by y of the film point, and of the pupil point, per mm; where there is
            an optical path, path_um_d_film and path_um_d_pupil [2, N], too.

    Returns the path.

    Raises:
        InputError: weights or errors are not finite; two gates have one reason on one surface; a gate is on the stop.
    """
    _check_gates(model)
    coefficients = coefficients_text([model])  # finite, or no ray of the card would be
    metadata = {CARD_KEY: card_to_json(card_of(model, errors or {})), MODEL_KEY: coefficients}
    return write_file(path, onnx_of(as_stored([model]), metadata=metadata, derivatives=derivatives))


def write_file(path: str | Path, data: bytes) -> Path:
    """Write an ONNX model, whole or not at all."""
    target = Path(path)
    with atomic_path(target) as temporary:
        temporary.write_bytes(data)
    return target


def _check_gates(model: LensModel) -> None:
    """Refuse gates whose status codes could not be told apart."""
    codes = [gate.status for gate in model.gates]
    if len({*codes, st.blocked(model.lens.stop_index, st.RIM)}) <= len(codes):
        raise InputError("export", "gates", codes, "one gate a surface and reason, and none on the rim of the stop")


def export_inverse(
    inverse: InverseModel, path: str | Path, errors: dict[str, Any] | None = None
) -> dict[str, dict[str, float | str]]:
    """Write both inverse maps beside a model's file, for other programs: NAME.stop.onnx and NAME.scene.onnx.

    Both give rays [5, N] (film x, y, pupil x, y, wavelength), scene_ray, transmittance, stop_xy_mm and status as the
    model does for those rays (NO_SOLUTION where they are not what was asked for), and density [N]. Inputs: see
    `stop_graph` and `scene_graph`; per-call ones have the shape [1].

    Args:
        path: of the model's file. errors: for the card, as of `export_onnx`.

    Returns for "stop" and "scene" the file, and how often the map finds fresh rays (see `convergence`).

    Raises:
        InputError: as `export_onnx`.
    """
    model = inverse.model
    _check_gates(model)
    base, card, front = Path(path).with_suffix(""), card_of(model, errors or {}), model.front
    shape = front and {
        "curvature": float(front.curvature),
        **{"conic": 0.0, "asphere": [], "cylinder": None, "across": None},
        **front.figure.record(),
        "index": front_index(model),
    }
    facts = {"steps": STEPS, "tolerance": TOLERANCE, "direction": model.direction, "front": shape}
    found, told = convergence(inverse, *passing_rays(model, _CHECKED, seed=1)), dict[str, dict[str, float | str]]()
    for name, guess, build in (("stop", inverse.stop, stop_graph), ("scene", inverse.scene, scene_graph)):
        text = card_to_json({**card, "inverse": {"map": name, **facts, "fit": found[name]}})
        data = write_onnx(build(model, guess, ONNX), {CARD_KEY: text})
        told[name] = {**found[name], "file": str(write_file(base.with_name(f"{base.name}.{name}.onnx"), data))}
    return told


def export_states(model: StateModel, path: str | Path, errors: dict[str, Any] | None = None) -> Path:
    """Write a model of many states with its card.

    It differs from `export_onnx` by one more input: state [A], a number for every axis, in its unit. A state out of
    range puts every ray outside the domain.

    Args:
        errors: held-out errors for the card, JSON-able.

    Raises:
        InputError: what `export_onnx` refuses, and nodes whose graphs differ in more than numbers.
    """
    _check_gates(model.nodes[0])
    model = replace(model, nodes=as_stored(model.nodes))
    card = card_of(model.at(*model.first_state), errors or {})
    facts = [lens_facts(node.lens, node.domain) for node in model.nodes]
    for fact, node in zip(facts, model.nodes, strict=True):  # at infinity focus, as photographers count
        fact["f_number"] = float(first_order(at_infinity(node.lens)).f_number)
    if any(a.name == "focus" for a in model.axes):
        for fact in (card["lens"], *facts):
            fact["focusing"] = "groups"
    card["units"] = {**card["units"], STATE: [f"{a.name} {a.unit}" for a in model.axes]}
    card["states"] = {
        "axes": [a.to_dict() for a in model.axes],
        "default": list(model.first_state),
        "zoom": model.space.zoom,
        "f_number": model.space.f_number,
        "nodes": [{"lens": fact, "domain": n.domain.to_dict()} for fact, n in zip(facts, model.nodes, strict=True)],
        "reference": [{"state": list(s), **reference_rays(model.at(*s), 8, 1)} for s in _between_nodes(model)],
    }
    metadata = {CARD_KEY: card_to_json(card), MODEL_KEY: coefficients_text(model.nodes)}
    return write_file(path, onnx_of(model.nodes, model.axes, metadata))


def _between_nodes(model: StateModel) -> list[tuple[float, ...]]:
    """Return states at which a client may check itself: the far end, and two where no node is."""
    shares = ((0.31, 0.62), (0.77, 0.38))
    ends = [a.range for a in model.axes]
    inner = [tuple(lo + (hi - lo) * s for (lo, hi), s in zip(ends, share, strict=False)) for share in shares]
    return [tuple(hi for _, hi in ends), *(tuple(float(np.float32(v)) for v in s) for s in inner)]


# ---- the card ----


def card_of(model: LensModel, errors: dict[str, Any]) -> dict[str, Any]:
    """Return the card of a model, JSON-able; `errors` are those on held-out rays, as the evaluation gives them."""
    stop, stopped = st.blocked(model.lens.stop_index, st.RIM), f"blocked by the stop, surface {model.lens.stop_index}"
    phase, copies = card_entry(model.core), copy_inputs(model)
    codes = {st.PASSED, st.OUTSIDE_DOMAIN, stop, *(g.status for g in model.gates)}
    return {
        "kind": CARD_KIND,
        "schema": CARD_SCHEMA,
        "lens": lens_facts(model.lens, model.domain),
        "units": UNITS | ({"path_um": "um, see phase"} if phase else {}) | ({STATE: list(copies)} if copies else {}),
        "transmittance": POLARISED,
        "frame": FRAME.format(place="the front surface" if model.direction == "angle" else "the plane z = 0"),
        "domain": model.domain.to_dict(),
        "status_codes": {str(code): st.describe(code) for code in sorted(codes)} | {str(stop): stopped},
        "gates": [{"surface": g.surface, "reason": g.reason, "status": g.status} for g in model.gates],
        "fit": {
            "method": model.method,
            "settings": model.settings,
            "basis": getattr(model.core, "basis", ""),
            "coefficients_per_vector": model.core.coefficients_per_vector,
            "coefficients": model.core.coefficients,
            "seed": model.settings.get("seed"),
            "seconds": model.fit_s,
        },
        **phase,
        **({"copies": copies} if copies else {}),
        "errors": errors,
        "reference": reference_rays(as_stored([model])[0]),
        "versions": {
            "neurolens": neurolens.__version__,
            "torch": str(torch.__version__),
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
    }


def lens_facts(lens: Lens, domain: Domain) -> dict[str, Any]:
    """Return the card's table of the lens; its film is the domain's film plane nearest to the lens's own."""
    near, far = domain.film_z_mm
    data = first_order(lens)
    curvature = float(lens.surfaces[0].curvature)
    return {
        **lens.identity,
        "surfaces": len(lens.surfaces),
        "refractions": sum(not s.stop for s in lens.surfaces),
        "efl_mm": float(data.efl_mm),
        "f_number": float(data.f_number),
        "stop_radius_mm": float(lens.stop_radius_mm),
        "stop_surface": lens.stop_index,
        "front_radius_mm": 1 / curvature if curvature else "inf",
        "infinity_film_z_mm": float(data.rear_principal_z_mm + data.efl_mm),
        "front_principal_z_mm": float(data.front_principal_z_mm),
        "rear_principal_z_mm": float(data.rear_principal_z_mm),
        "exit_pupil_z_mm": float(data.exit_pupil_z_mm) if math.isfinite(data.exit_pupil_z_mm) else "inf",
        "film_z_mm": near if lens.film_z_mm is None else min(max(float(lens.film_z_mm), near), far),
        "dispersive": lens.dispersive,
        "coatings": lens.coatings,
        "focusing": "whole lens",  # `export_states` knows better
        **({"believed_to_be": lens.believed_to_be} if lens.believed_to_be else {}),
        **({"measured": dict(lens.measured)} if lens.measured else {}),
        **({"licence": LENSFUN} if lens.measured or lens.rims == "photographs" else {}),
        **({} if data.front_efl_mm == data.efl_mm else {"index_ratio": float(data.front_efl_mm / data.efl_mm)}),
    }


def reference_rays(model: LensModel, passing: int = 24, others: int = 4) -> dict[str, Any]:
    """Return rays with the answers of a model as its file stores it, in float64, by which clients check their own.

    Rays near a boundary are left out: within 0.01 of it (relative), or within 0.001 where no passing ray lies farther
    away. Rays whose status float32 changes are left out, too. For every status that the model gives there are up to
    `others` rays. `rounding` is the error that float32 may cause, of each output in its unit: eight times the reference
    evaluator's error on these rays.
    """
    # In some domains few rays pass; some are so wide that all passing rays lie near the boundaries.
    for count, least in ((20_000, 0.01), (600_000, 0.01), (600_000, 0.001)):
        rays, out, clear = _clear_rays(model, count, least)
        if bool((clear & (out.status == st.PASSED)).any()):
            break
    index = torch.cat(
        [
            torch.nonzero(clear & (out.status == s))[: passing if s == st.PASSED else others, 0]
            for s in out.status.unique()
        ]
    )
    inputs = rays.select(index)
    columns = {
        "rays": inputs.rows,
        "film_z_mm": inputs.film_z,
        "scene_ray": torch.stack([c[index] for c in out.rays]),
        "transmittance": out.transmittance[index],
        "stop_xy_mm": torch.stack([out.stop_x[index], out.stop_y[index]]),
        **({} if out.path_um is None else {"path_um": out.path_um[index]}),
    }
    return {
        **{name: _rounded(value.tolist()) for name, value in columns.items()},
        "stop_radius_mm": model.domain.stop_radius_mm,
        "status": out.status[index].tolist(),
        "rounding": _rounding(model, rays.select(index[out.status[index] == st.PASSED])),
    }


def _clear_rays(model: LensModel, count: int, least: float) -> tuple[FilmRays, Prediction, Tensor]:
    """Return rays of the domain, the float64 model's answers, and which of the rays are clear of every boundary."""
    rays = sample_domain(model.domain, count, seed=11)
    # One film plane for all: a graph takes one film position a call. In float32, which the file's nine digits hold.
    rays = replace(rays, film_z=torch.full_like(rays.film_z, float(rays.film_z.mean()))).to(torch.float32)
    rays = rays.to(torch.float64)
    with torch.no_grad():
        out = model.predict(rays)
        rough = model.predict(rays.to(torch.float32))
        _, scalars = model.core(model.encoding(rays))
    stop = (out.stop_x**2 + out.stop_y**2) / model.domain.stop_radius_mm**2 - 1
    margin = torch.cat([scalars[1:], stop[None]]).abs().min(0).values
    radius = torch.stack(
        [torch.hypot(rays.film_x, rays.film_y) / model.domain.film_radius_mm]
        + [torch.hypot(rays.pupil_x, rays.pupil_y) / model.domain.pupil_radius_mm]
    )
    return rays, out, (margin > least) & (radius < 0.999).all(0) & (rough.status == out.status)


def _rounding(model: LensModel, rays: FilmRays) -> dict[str, float]:
    with torch.no_grad():
        fine, rough = model.predict(rays), model.predict(rays.to(torch.float32))

    def off(a: Sequence[Tensor], b: Sequence[Tensor]) -> float:
        most = max(float((x - y.double()).abs().max()) if len(x) else 0.0 for x, y in zip(a, b, strict=True))
        return float(f"{8 * most:.2g}")

    return {
        "position_mm": off(fine.rays[:3], rough.rays[:3]),
        "direction": off(fine.rays[3:], rough.rays[3:]),
        "transmittance": off([fine.transmittance], [rough.transmittance]),
        "stop_mm": off([fine.stop_x, fine.stop_y], [rough.stop_x, rough.stop_y]),
        **({} if fine.path_um is None or rough.path_um is None else {"path_um": off([fine.path_um], [rough.path_um])}),
    }


def _rounded(values: Any) -> Any:
    return [_rounded(v) for v in values] if isinstance(values, list) else float(f"{values:.9g}")
