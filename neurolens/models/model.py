"""A complete surrogate: millimetres and nanometres in; scene ray, transmittance, stop crossing and status out.

A `LensModel` is plain data (`fitted`), of which `assemble` writes a graph; onnxruntime, compiled C and numpy run that
without torch. Methods that take or give tensors import torch when they run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from neurolens.base.errors import InputError
from neurolens.base.status import DOMAIN_SLACK
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph
from neurolens.models.assemble import EXACT, model_graph
from neurolens.models.card import mix_domain
from neurolens.models.cores import Array
from neurolens.models.fitted import Domain, Encoding, FilmRays, Fitted

if TYPE_CHECKING:
    from torch import Tensor

    from neurolens.optics.trace.surfaces import Rays

OUTPUTS = ("scene_ray", "transmittance", "stop_xy_mm", "status")


class Prediction(NamedTuple):
    """What a model answers for N rays; lens frame, mm. The ray is meaningful where the status is 0.

    `path_um` is the optical path, of models that have it (`models.phase`).
    """

    rays: Rays
    transmittance: Tensor
    stop_x: Tensor
    stop_y: Tensor
    status: Tensor
    path_um: Tensor | None = None


def prediction_of(out: Mapping[str, Tensor], count: int) -> Prediction:
    """Make the prediction for `count` rays from the outputs of a model's graph."""
    from neurolens.optics.trace.surfaces import Rays

    scene, power, stop, status = (out[n].expand(-1, count) for n in OUTPUTS)
    path = out["path_um"].expand(-1, count)[0] if "path_um" in out else None
    return Prediction(Rays(*scene), power[0], stop[0], stop[1], status[0], path)


@dataclass(frozen=True)
class LensModel(Fitted):
    """A fitted surrogate of one lens over one domain, which answers rays.

    Attributes:
        method: name of the fit, for tables ("ols invariants", "mlp 16x2").
        settings: JSON-able settings of the fit.
        fit_s: seconds that the fit took.
    """

    method: str
    settings: dict[str, Any] = field(default_factory=dict)
    fit_s: float = 0.0

    def predict(self, rays: FilmRays, stop_radius_mm: float | None = None) -> Prediction:
        """Evaluate the model in the dtype of `rays`.

        Args:
            rays: film point, pupil point and wavelength, [N] each.
            stop_radius_mm: any radius up to that of the domain; None takes the domain's.

        Raises:
            InputError: a stop wider than the model was fitted for.
        """
        return prediction_of(evaluate(self.graph, self._inputs(rays, stop_radius_mm)), len(rays))

    def _inputs(self, rays: FilmRays, stop_radius_mm: float | None) -> dict[str, Tensor]:
        radius = rays.film_z.new_full((1, 1), self.checked_radius_mm(stop_radius_mm))
        return {"rays": rays.rows, "film_z_mm": rays.film_z[None], "stop_radius_mm": radius}

    def checked_radius_mm(self, stop_radius_mm: float | None) -> float:
        """Return the stop radius asked for, or the domain's. Raises InputError: one wider than that of the fit."""
        if stop_radius_mm is not None and not 0 <= stop_radius_mm <= DOMAIN_SLACK * self.domain.stop_radius_mm:
            expected = f"0 to {self.domain.stop_radius_mm:.6g} mm, the widest stop of the fit"
            raise InputError(self.method, "stop_radius_mm", stop_radius_mm, expected)
        return self.domain.stop_radius_mm if stop_radius_mm is None else stop_radius_mm

    @cached_property
    def graph(self) -> Graph:
        """Write the graph for evaluation in float64: inputs and outputs as `assemble` says."""
        return model_graph(self, EXACT)


def with_one_angle(models: Sequence[LensModel]) -> list[LensModel]:
    """Give models of one structure the largest angle of them all, so that their graphs are of one structure, too."""
    angle = max(model.angle for model in models)
    return [replace(model, angle=angle) for model in models]


def mixed(nodes: Sequence[LensModel], weights: Array) -> LensModel:
    """Mix nodes [K] of one structure by weights [K] into the model of a state; its lens is the first node's.

    Raises:
        InputError: nodes that differ in more than numbers.
    """
    return replace(
        nodes[0],
        domain=Domain.from_dict(mix_domain([n.domain.to_dict() for n in nodes], weights)),
        encoding=Encoding.mixed([n.encoding for n in nodes], weights),
        core=mix([n.core for n in nodes], weights),
    )


def mix(values: Sequence[Any], weights: Array) -> Any:
    """Return the weighted sum of float arrays, wherever they stand in equal structures of dataclasses and tuples.

    Raises:
        InputError: structures that differ in anything but those numbers.
    """
    first = values[0]
    if isinstance(first, np.ndarray) and first.dtype.kind == "f":
        if any(v.shape != first.shape for v in values):
            raise InputError("state model", "nodes", [v.shape for v in values], "arrays of one shape")
        return np.einsum("k,k...->...", weights, np.stack(values))
    if is_dataclass(first) and not isinstance(first, type):
        names = [f.name for f in fields(first)]
        return replace(first, **{n: mix([getattr(v, n) for v in values], weights) for n in names})
    if isinstance(first, tuple):
        if any(len(v) != len(first) for v in values):
            raise InputError("state model", "nodes", [len(v) for v in values], "tuples of one length")
        return tuple(mix([v[i] for v in values], weights) for i in range(len(first)))
    if not all(np.array_equal(v, first) for v in values):
        raise InputError("state model", "nodes", f"({type(first).__name__})", "the same at every node")
    return first
