"""Graphs read from model files against onnxruntime."""

from pathlib import Path

import lens_models
import numpy as np
import onnx
import pytest
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError, ModelError
from neurolens.cameras.model import load_model
from neurolens.graph.interpret import evaluate
from neurolens.graph.program import FILM_Z, RAY, SCENE_RAY, STOP_RADIUS, WAVELENGTH
from neurolens.graph.scalars import lower
from neurolens.modelfile.graph import graph_of
from neurolens.modelfile.onnxfile import read_checked
from neurolens.modelfile.protobuf import message, walk
from neurolens.optics.lensfile import read_lens
from neurolens.optics.states import set_lens
from neurolens.surrogates.precision import store_weights

ROOT = Path(__file__).parents[2]


def evaluated_as_onnxruntime(
    file: Path, state: tuple[float, ...] = (), differ: float = 2e-4, grazing: bool = False
) -> None:
    """A graph, and its program, evaluated in numpy against onnxruntime.

    Args:
        grazing: rays leave the front at grazing angles, where Snell's law makes more of a direction's rounding inside
            the glass, by the cosine outside.
    """
    model = load_model(file)
    model = model.at(*state) if state else model
    domain, rng = model.card["domain"], np.random.default_rng(2)
    film, pupil = ((rng.random((2, 5000)) - 0.5) * 1.6 * domain[k] for k in ("film_radius_mm", "pupil_radius_mm"))
    wavelength, z, stop = rng.uniform(390, 720, 5000), domain["film_z_mm"][0], 0.8 * domain["stop_radius_mm"]
    wanted = model.rays(film, pupil, wavelength, z, stop)
    rays = np.stack([*film, *pupil, wavelength]).astype(np.float32)
    inputs = dict(zip((*RAY, WAVELENGTH), rays, strict=True)) | {FILM_Z: z, STOP_RADIUS: stop}
    graph = graph_of(file, model.data, state)
    found = lower(graph).evaluate(inputs)
    same = found["status"] == wanted.status
    stepwise = evaluate(graph, {"rays": rays, "film_z_mm": np.float32([[z]]), "stop_radius_mm": np.float32([[stop]])})
    assert np.mean(stepwise["status"][0] != found["status"]) <= differ
    ok = same & (wanted.status == st.PASSED)
    assert same.mean() >= 1 - differ and ok.mean() > 0.05 and len(np.unique(wanted.status)) > 2
    outside = _cosine_at_front(wanted.scene_ray) if grazing else 1.0
    for name, row, other in zip(SCENE_RAY, wanted.scene_ray, stepwise["scene_ray"], strict=True):
        for values in (found[name], other):
            off = np.abs(values - row) * (1.0 if name.endswith("mm") else outside)
            assert off[ok].max() < (1e-4 if name.endswith("mm") else 2e-6)
    assert np.abs(found["transmittance"] - wanted.transmittance)[ok].max() < 1e-5


def _cosine_at_front(ray: NDArray[np.float32]) -> NDArray[np.float32]:
    """Of rays [6, N] of the fisheye, with the normal of its front sphere."""
    c = float(set_lens(read_lens(lens_models.LENSES / f"{lens_models.FISHEYE}.toml")).surfaces[0].curvature)
    x, y = c * ray[:2]
    return np.abs(ray[3] * x + ray[4] * y - ray[5] * np.sqrt(1 - x * x - y * y))


@pytest.mark.parametrize("kind", lens_models.KINDS)
def test_graphs_of_every_kind_of_model(kind: str) -> None:
    evaluated_as_onnxruntime(lens_models.exported(kind), grazing=kind == "fisheye")


@pytest.mark.parametrize("precision", ["int8", "float16"])
def test_graphs_of_rounded_weights(precision: str, tmp_path: Path) -> None:
    file = store_weights(lens_models.exported("network"), tmp_path / "rounded.onnx", precision)  # type: ignore[arg-type]
    evaluated_as_onnxruntime(file)


def test_graphs_of_many_states() -> None:
    file = ROOT / "models" / "nikon_zoom_80_200-range.states-64.onnx"
    for share in (0.0, 0.37, 1.0):
        state = tuple(a.range[0] + share * (a.range[1] - a.range[0]) for a in load_model(file).axes)
        evaluated_as_onnxruntime(file, state, differ=1e-3)


def test_an_operator_without_a_fused_form(tmp_path: Path) -> None:
    proto = onnx.load(lens_models.exported("network"))
    next(n for n in proto.graph.node if n.op_type == "Tanh").op_type = "Sin"
    with pytest.raises(InputError, match="Sin"):
        graph_of(tmp_path / "model.onnx", proto.SerializeToString())


ONES = {(5000, 1), (1, 5000), (100, 5), (100, 100)}


@pytest.mark.parametrize(
    "products",
    [
        [("Mul", "1x5000", "5000x1")],
        [("MatMul", "5000x1", "1x5000")],
        [("Reshape", "film_z_mm", "shape")],  # fits as many rays as the check has
        [("MatMul", "100x5", "rays"), ("MatMul", "100x100", "x0")],  # gcc takes 94 s
        [("Max", *["rays"] * 2000)],
    ],
)
def test_graphs_that_ask_for_too_much(products: list[tuple[str, ...]], tmp_path: Path) -> None:
    """Numbers that meet as rows and columns, and what a compiler would take minutes for."""
    helper, tensor = onnx.helper, onnx.numpy_helper.from_array
    constants = [tensor(np.ones(shape, np.float32), "x".join(map(str, shape))) for shape in ONES]
    constants.append(tensor(np.array([1, 16400]), "shape"))
    nodes = [helper.make_node(p, given, [f"x{k}"]) for k, (p, *given) in enumerate(products)]
    graph = helper.make_graph(nodes, "g", [], [], constants)
    with pytest.raises(InputError, match="graph"):
        graph_of(tmp_path / "model.onnx", helper.make_model(graph).SerializeToString())


def test_a_number_where_bytes_belong_takes_no_memory(tmp_path: Path) -> None:
    """A float tensor whose data are one number: as a count of bytes it would be 32 TiB."""
    tensor = message(iter([(1, 0, 1), (2, 0, 1), (8, 2, b"odd"), (4, 0, 2**45)]))
    fields = list(walk(memoryview(lens_models.exported("network").read_bytes())))
    whole = ((n, wire, message(iter([*walk(v), (5, 2, tensor)])) if n == 7 else v) for n, wire, v in fields)
    (tmp_path / "odd.onnx").write_bytes(message(whole))
    with pytest.raises(ModelError, match="damaged"):
        read_checked(tmp_path / "odd.onnx")
