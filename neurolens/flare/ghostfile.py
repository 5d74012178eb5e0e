"""Files of fitted ghosts: ONNX that any runtime evaluates, an output a ghost, with a card and the coefficients.

Inputs: entering [5, N] float32 (dx, dy of the light's unit direction towards the film; x, y in mm of its point on the
plane z = 0; wavelength in nm) and stop_radius_mm [1]. Outputs g07_03 and so on, [4, N]: film x, y (mm), power, and
worst, the largest r^2 / R^2 at the rims that are tested: light arrives where it is at most 1.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import neurolens
from neurolens.base.errors import ModelError
from neurolens.base.files import atomic_write_text
from neurolens.base.tomlfile import check_tree
from neurolens.flare.ghostmodel import GhostModel, GhostPolynomial, ghost_graph
from neurolens.flare.ghosts import Pair
from neurolens.graph.c import NOTHING
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph
from neurolens.graph.program import ARRIVING, ENTERING
from neurolens.graph.scalars import lower
from neurolens.surrogates.card import card_to_json
from neurolens.surrogates.cardkeys import CARD_KEY, MODEL_KEY
from neurolens.surrogates.file import deflated, inflated, pack, packed_lens, unpack, unpacked_lens
from neurolens.surrogates.metadata import card_in, read_metadata
from neurolens.surrogates.source import WRITERS, identifier

KIND, SCHEMA = "neurolens.ghost_model", 1
_FRAME = "Lens frame: z along the optical axis towards the film, front vertex at z = 0, x right and y up from behind."
_REFERENCE = 5  # rays
_OFF = 1e-4  # of reference values, relative and in mm: coefficients are rounded to float32
_MOST = 4096  # ghosts


def whole_graph(model: GhostModel) -> Graph:
    """All ghosts as one graph: see the module."""
    g = Graph()
    for pair, ghost in zip(model.pairs, model.ghosts, strict=True):
        ghost_graph(model, ghost, g, output_of(pair))
    return g


def output_of(pair: Pair) -> str:
    """Name of a ghost's output."""
    return pair.name.replace("-", "_")


def write_ghosts(model: GhostModel, path: str | Path) -> Path:
    """Write a model; its stop is round in the graph.

    Raises:
        InputError: numbers that float32 cannot hold.
    """
    from neurolens.graph.onnx import write_onnx
    from neurolens.surrogates.export import write_file

    rows = [
        [
            *pair,
            list(ghost.chief_mm),
            list(ghost.scale_mm),
            list(ghost.surfaces),
            *map(pack, (ghost.exponents, ghost.ab, ghost.power)),
        ]
        for pair, ghost in zip(model.pairs, model.ghosts, strict=True)
    ]
    graph = whole_graph(model)
    card = {
        "kind": KIND,
        "schema": SCHEMA,
        "lens": {**model.lens.identity, "stop_radius_mm": model.stop_radius_mm},
        "frame": _FRAME,
        "rays": ENTERING,
        "outputs": {output_of(pair): ARRIVING for pair in model.pairs},
        "domain": {"sine": model.sine, "wavelength_nm": model.wavelength_nm},
        "fit": model.report,
        "reference": _reference(model),
        "versions": {"neurolens": neurolens.__version__, "numpy": np.__version__},
    }
    coefficients = deflated({"schema": SCHEMA, "lens": packed_lens(model.lens), "ghosts": rows})
    return write_file(path, write_onnx(graph, {CARD_KEY: card_to_json(card), MODEL_KEY: coefficients}))


def write_ghost_source(model: GhostModel, path: str | Path) -> Path:
    """Write a model as source, a function a ghost: C99 to a name that ends in .h, else GLSL; stop and output as there.

    Raises:
        InputError: numbers that float32 cannot hold.
    """
    write = WRITERS["c" if Path(path).suffix == ".h" else "glsl"]
    own, parts = identifier(model.lens.lens_id), []
    comment = [
        f"Ghosts of {model.lens.name}, written by neurolens {neurolens.__version__}.", _FRAME,
        f"Given {', '.join(ENTERING)}: the light's direction towards the film, and its point on the plane z = 0.",
        f"Gives {', '.join(ARRIVING)}: light arrives where worst, the largest r^2 / R^2 at rims, is at most 1.",
        f"Directions up to {model.sine:.4g} for sqrt(dx^2 + dy^2), wavelengths {model.wavelength_nm} nm, stop radii up "
        f"to {model.stop_radius_mm:.6g} mm.",
    ]  # fmt: skip
    for pair, ghost in zip(model.pairs, model.ghosts, strict=True):
        parts.append(write(lower(ghost_graph(model, ghost)), f"{own}_{output_of(pair)}", comment, NOTHING))
    atomic_write_text(Path(path), "\n".join(parts))
    return Path(path)


def read_ghosts(path: str | Path) -> GhostModel:
    """The model of a file, coefficients rounded to float32.

    Raises:
        ModelError: a file that is missing, too large, no model of ghosts, or damaged.
    """
    metadata = read_metadata(path)
    card = card_in(path, metadata, KIND)
    try:
        data = json.loads(inflated(metadata[MODEL_KEY]))
        check_tree(data, "coefficients")
        if data["schema"] != SCHEMA or len(data["ghosts"]) > _MOST:
            raise ValueError(f"schema {data['schema']!r}, {len(data['ghosts'])} ghosts")
        low, high = map(float, card["domain"]["wavelength_nm"])
        lens = unpacked_lens(data["lens"])
        model = GhostModel(
            lens,
            tuple(Pair(int(first), int(second)) for first, second, *_ in data["ghosts"]),
            tuple(_ghost(5 if lens.anamorphic else 4, *row[2:]) for row in data["ghosts"]),
            float(card["domain"]["sine"]),
            (low, high),
            float(card["lens"]["stop_radius_mm"]),
            dict(card["fit"]),
        )
        if not (0 < low < high < math.inf and 0 < model.sine <= 1) or model.lens.sha256 != card["lens"]["sha256"]:
            raise ValueError("its domain or prescription is not that of its card")
        for pair, ghost in zip(model.pairs, model.ghosts, strict=True):
            known = card["reference"][output_of(pair)]
            rays = np.array(known["rays"], np.float64).reshape(5, _REFERENCE)
            if not np.allclose(_light(model, ghost, rays), known["light"], rtol=_OFF, atol=_OFF):
                raise ValueError("its coefficients do not give the reference rays of its card")
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, RuntimeError, ArithmeticError) as error:
        if isinstance(error, ModelError):
            raise
        raise ModelError(f"{path}: its coefficients are damaged ({type(error).__name__}: {error})") from error
    return model


def _ghost(
    variables: int, chief: Any, scale: Any, surfaces: Any, exponents: Any, ab: Any, power: Any
) -> GhostPolynomial:
    middle, size = (np.array(v, np.float64).reshape(2) for v in (chief, scale))
    ghost = GhostPolynomial(middle, size, tuple(map(int, surfaces)), unpack(exponents), unpack(ab), unpack(power))
    terms = len(ghost.exponents)
    if ghost.exponents.shape != (terms, variables) or ghost.ab.shape != (1 + len(ghost.surfaces), 2, terms):
        raise ValueError(f"tables of {ghost.exponents.shape}, {ghost.ab.shape}")
    if ghost.power.shape != (terms,) or not (ghost.scale_mm > 0).all():
        raise ValueError(f"tables of {ghost.power.shape}, scale {ghost.scale_mm}")
    return ghost


def _reference(model: GhostModel) -> dict[str, Any]:
    """Rays near the middle of each ghost's light, and what it gives for them."""
    share, found = np.linspace(0, 0.5, _REFERENCE), {}
    for pair, ghost in zip(model.pairs, model.ghosts, strict=True):
        p = np.stack([share, -0.5 * share])
        place = ghost.chief_mm[:, None] * p + ghost.scale_mm[:, None] * np.stack([0.3 * share, 0.1 * share])
        rays = np.stack([*(model.sine * p), *place, np.linspace(*model.wavelength_nm, _REFERENCE)])
        rays = rays.astype(np.float32).astype(np.float64)
        found[output_of(pair)] = {"rays": rays.tolist(), "light": _light(model, ghost, rays).tolist()}
    return found


def _light(model: GhostModel, ghost: GhostPolynomial, rays: NDArray[np.float64]) -> NDArray[np.float64]:
    radius = np.full((1, 1), model.stop_radius_mm)
    return np.asarray(evaluate(ghost_graph(model, ghost), {"entering": rays, "stop_radius_mm": radius})["arriving"])
