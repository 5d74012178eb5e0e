"""The card of an exported model: one JSON string that says what the model is, where it holds and how well."""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

import neurolens
from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.lens.paraxial import first_order
from neurolens.lens.prescription import Lens
from neurolens.surrogates.cardkeys import CARD_KIND, CARD_SCHEMA, MAX_CARD
from neurolens.surrogates.domain import FilmRays, sample_domain
from neurolens.surrogates.model import Domain, LensModel, Prediction

UNITS = {
    "rays": ["film_x mm", "film_y mm", "pupil_x mm", "pupil_y mm", "wavelength nm"],
    "film_z_mm": "mm",
    "stop_radius_mm": "mm",
    "scene_ray": ["x mm", "y mm", "z mm", "dx", "dy", "dz"],
    "transmittance": "share of the power, 0 to 1",
    "stop_xy_mm": "mm",
    "status": "integer, see status_codes",
}
FRAME = (
    "Lens frame: z along the optical axis, front vertex at z = 0, film at z > 0, x right and y up seen from behind the "
    "camera; rays leave the film point towards the pupil point on the plane domain.pupil_z_mm; scene_ray is a point on "
    "{place} and a unit direction towards -z."
)


def card_of(model: LensModel, errors: dict[str, Any]) -> dict[str, Any]:
    """The card of a model, JSON-able.

    Args:
        errors: held-out errors, as the evaluation gives them.
    """
    return {
        "kind": CARD_KIND,
        "schema": CARD_SCHEMA,
        "lens": lens_facts(model.lens, model.domain),
        "units": UNITS,
        "transmittance": model.transmittance,
        "frame": FRAME.format(place="the front surface" if model.direction == "angle" else "the plane z = 0"),
        "domain": model.domain.to_dict(),
        "status_codes": _status_codes(model),
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
        "errors": errors,
        "reference": reference_rays(model),
        "versions": {
            "neurolens": neurolens.__version__,
            "torch": str(torch.__version__),
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
    }


def card_to_json(card: dict[str, Any]) -> str:
    """Strict JSON: a number that is not finite is an error, never the word NaN.

    Raises:
        InputError: a value that JSON cannot hold, with its place in the card; more than `MAX_CARD` characters, which no
            reader takes.
    """
    try:
        text = json.dumps(card, allow_nan=False)
    except (TypeError, ValueError) as error:
        field, value = _culprit(card, "")
        raise InputError("model card", field, value, "finite numbers, text, lists and dictionaries") from error
    if len(text) > MAX_CARD:
        raise InputError("model card", "length", f"({len(text)} characters)", f"at most {MAX_CARD}")
    return text


def _culprit(value: Any, place: str) -> tuple[str, Any]:
    """First value that JSON cannot hold, and where it is."""
    items: Any = ()
    if isinstance(value, dict):
        items = value.items()
    elif isinstance(value, (list, tuple)):
        items = enumerate(value)
    for key, inner in items:
        try:
            json.dumps(inner, allow_nan=False)
        except (TypeError, ValueError):
            return _culprit(inner, f"{place}.{key}" if place else str(key))
    return place, value


def lens_facts(lens: Lens, domain: Domain) -> dict[str, Any]:
    """The card's table of the lens; its film is that of the domain nearest to where the lens has it."""
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
        **({} if data.front_efl_mm == data.efl_mm else {"index_ratio": float(data.front_efl_mm / data.efl_mm)}),
    }


def _status_codes(model: LensModel) -> dict[str, str]:
    """Every status that the model can give, in words."""
    codes = {st.PASSED, st.OUTSIDE_DOMAIN, st.blocked(model.lens.stop_index, st.RIM), *(g.status for g in model.gates)}
    words = {str(code): st.describe(code) for code in sorted(codes)}
    words[str(st.blocked(model.lens.stop_index, st.RIM))] = f"blocked by the stop, surface {model.lens.stop_index}"
    return words


def reference_rays(model: LensModel, passing: int = 24, others: int = 4) -> dict[str, Any]:
    """Rays with what the float64 model makes of them, so that a client can check its own evaluation.

    Rays within 0.01 of any boundary (relative; 0.001 where none that passes is further from all), or whose status
    float32 changes, are left out. For every status the model gives there are up to `others` rays. `rounding` is what
    float32 may cost: of position and stop crossing in mm, of direction and transmittance; eight times what it costs
    the reference evaluator on these rays.
    """
    # Of some domains few rays pass, and of some that are far wider all of those near the boundaries.
    for count, least in ((20_000, 0.01), (600_000, 0.01), (600_000, 0.001)):
        rays, out, clear = _clear_rays(model, count, least)
        if bool((clear & (out.status == st.PASSED)).any()):
            break
    picked = [
        torch.nonzero(clear & (out.status == s))[: passing if s == st.PASSED else others, 0]
        for s in out.status.unique()
    ]
    index = torch.cat(picked)
    inputs = rays.select(index)
    columns = {
        "rays": inputs.rows,
        "film_z_mm": inputs.film_z,
        "scene_ray": torch.stack([c[index] for c in out.rays]),
        "transmittance": out.transmittance[index],
        "stop_xy_mm": torch.stack([out.stop_x[index], out.stop_y[index]]),
    }
    lists = {name: _rounded(value.tolist()) for name, value in columns.items()}
    passes = index[out.status[index] == st.PASSED]
    return {
        **lists,
        "stop_radius_mm": model.domain.stop_radius_mm,
        "status": out.status[index].tolist(),
        "rounding": _rounding(model, rays.select(passes)),
    }


def _clear_rays(model: LensModel, count: int, least: float) -> tuple[FilmRays, Prediction, Tensor]:
    """Rays of the domain, what the float64 model makes of them, and which of them are clear of every boundary."""
    rays = _float32(sample_domain(model.domain, count, seed=11))
    with torch.no_grad():
        out = model.predict(rays)
        rough = model.predict(_single(rays))
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
        fine, rough = model.predict(rays), model.predict(_single(rays))

    def off(a: Sequence[Tensor], b: Sequence[Tensor]) -> float:
        most = max(float((x - y.double()).abs().max()) if len(x) else 0.0 for x, y in zip(a, b, strict=True))
        return float(f"{8 * most:.2g}")

    return {
        "position_mm": off(fine.rays[:3], rough.rays[:3]),
        "direction": off(fine.rays[3:], rough.rays[3:]),
        "transmittance": off([fine.transmittance], [rough.transmittance]),
        "stop_mm": off([fine.stop_x, fine.stop_y], [rough.stop_x, rough.stop_y]),
    }


def _single(rays: FilmRays) -> FilmRays:
    return FilmRays(*(c.float() for c in rays.columns()))


def _float32(rays: FilmRays) -> FilmRays:
    """The rays as float32 holds them, so that the file's nine digits are the input itself."""
    # One film plane for all: a graph takes one film position a call.
    film_z = torch.full_like(rays.film_z, float(rays.film_z.mean()))
    columns = (*rays.columns()[:2], film_z, *rays.columns()[3:])
    return FilmRays(*(c.float().double() for c in columns))


def _rounded(values: Any) -> Any:
    return [_rounded(v) for v in values] if isinstance(values, list) else float(f"{values:.9g}")
