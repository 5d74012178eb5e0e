"""Model files: the graph built from a file's coefficients against the file's own nodes, run by onnxruntime."""

import base64
from collections.abc import Callable
from pathlib import Path

import lens_models
import numpy as np
import onnx
import onnxruntime
import pytest
from numpy.typing import NDArray
from onnx import ModelProto, helper

from neurolens.base import status as st
from neurolens.base.errors import ModelError
from neurolens.cameras.model import load_model
from neurolens.graph.interpret import evaluate
from neurolens.graph.program import FILM_Z, RAY, SCENE_RAY, STOP_RADIUS, WAVELENGTH
from neurolens.graph.scalars import lower
from neurolens.readers.lensfile import read_lens
from neurolens.setting.states import set_lens
from neurolens.surrogates.cardkeys import MODEL_KEY
from neurolens.surrogates.file import onnx_of, read_model
from neurolens.surrogates.metadata import read_metadata

ROOT = Path(__file__).parents[2]
SHIPPED = sorted((ROOT / "models").glob("*.onnx"))
ZOOM = ROOT / "models" / "nikon_zoom_80_200-range.states-64.onnx"


def as_another_program_runs_it(file: Path, feeds: dict[str, NDArray[np.float32]]) -> dict[str, NDArray]:
    session = onnxruntime.InferenceSession(file.read_bytes(), providers=["CPUExecutionProvider"])
    names = [o.name for o in session.get_outputs()]
    return dict(zip(names, session.run(names, feeds), strict=True))


def agrees_with_its_nodes(
    file: Path, state: tuple[float, ...] = (), differ: float = 2e-4, grazing: bool = False
) -> None:
    """The graph of a file's coefficients, and its program, in numpy, against the nodes that other programs run.

    Args:
        grazing: rays leave the front at grazing angles, where Snell's law makes more of a direction's rounding inside
            the glass, by the cosine outside.
    """
    model = load_model(file)
    model = model.at(*state) if state else model
    domain, rng = model.card["domain"], np.random.default_rng(2)
    film, pupil = ((rng.random((2, 5000)) - 0.5) * 1.6 * domain[k] for k in ("film_radius_mm", "pupil_radius_mm"))
    wavelength, z, stop = rng.uniform(390, 720, 5000), domain["film_z_mm"][0], 0.8 * domain["stop_radius_mm"]
    rays = np.stack([*film, *pupil, wavelength]).astype(np.float32)
    feeds = {"rays": rays, "film_z_mm": np.float32([z]), "stop_radius_mm": np.float32([stop])}
    wanted = as_another_program_runs_it(file, feeds | ({"state": np.float32(state)} if state else {}))
    inputs = dict(zip((*RAY, WAVELENGTH), rays, strict=True)) | {FILM_Z: z, STOP_RADIUS: stop}
    graph = model.graph()
    found = lower(graph).evaluate(inputs)
    same = found["status"] == wanted["status"]
    stepwise = evaluate(graph, {"rays": rays, "film_z_mm": np.float32([[z]]), "stop_radius_mm": np.float32([[stop]])})
    assert np.mean(stepwise["status"][0] != found["status"]) <= differ
    ok = same & (wanted["status"] == st.PASSED)
    assert same.mean() >= 1 - differ and ok.mean() > 0.05 and len(np.unique(wanted["status"])) > 2
    outside = _cosine_at_front(wanted["scene_ray"]) if grazing else 1.0
    for name, row, other in zip(SCENE_RAY, wanted["scene_ray"], stepwise["scene_ray"], strict=True):
        for values in (found[name], other):
            off = np.abs(values - row) * (1.0 if name.endswith("mm") else outside)
            assert off[ok].max() < (1e-4 if name.endswith("mm") else 2e-6)
    assert np.abs(found["transmittance"] - wanted["transmittance"])[ok].max() < 1e-5


def _cosine_at_front(ray: NDArray[np.float32]) -> NDArray[np.float32]:
    """The cosine between rays [6, N] of the fisheye and the normal of its front sphere."""
    c = float(set_lens(read_lens(lens_models.LENSES / f"{lens_models.FISHEYE}.toml")).surfaces[0].curvature)
    x, y = c * ray[:2]
    return np.abs(ray[3] * x + ray[4] * y - ray[5] * np.sqrt(1 - x * x - y * y))


@pytest.mark.parametrize("kind", lens_models.KINDS)
def test_graphs_of_every_kind_of_model(kind: str) -> None:
    agrees_with_its_nodes(lens_models.exported(kind), grazing=kind == "fisheye")


def test_graphs_of_many_states() -> None:
    for share in (0.0, 0.37, 1.0):
        state = tuple(a.range[0] + share * (a.range[1] - a.range[0]) for a in load_model(ZOOM).axes)
        agrees_with_its_nodes(ZOOM, state, differ=1e-3)


@pytest.mark.parametrize("file", [*map(lens_models.exported, ("network", "cylinders")), *SHIPPED], ids=lambda f: f.stem)
def test_the_nodes_in_a_file_are_those_that_its_coefficients_give(file: Path) -> None:
    """Byte for byte: what another program runs is what this package runs."""
    model = read_model(file)
    assert onnx_of(model.nodes, model.axes, read_metadata(file)) == file.read_bytes()


def test_files_are_valid_onnx(tmp_path: Path) -> None:
    for file in (lens_models.exported("fisheye"), lens_models.exported("network"), ZOOM):
        onnx.checker.check_model(onnx.load(file), full_check=True)


def other_nodes(proto: ModelProto) -> None:
    del proto.graph.node[:]
    proto.graph.node.append(helper.make_node("Loop", ["rays"], ["scene_ray"]))


def a_library(proto: ModelProto) -> None:
    proto.graph.node.append(helper.make_node("Mul", ["rays"], ["q"], domain="evil"))


def another_file(proto: ModelProto) -> None:
    tensor = proto.graph.initializer[0]
    tensor.data_location = onnx.TensorProto.EXTERNAL
    entry = tensor.external_data.add()
    entry.key, entry.value = "location", "/etc/passwd"


@pytest.mark.parametrize("change", [other_nodes, a_library, another_file])
def test_nodes_of_a_strangers_file_are_never_run(change: Callable[[ModelProto], None], tmp_path: Path) -> None:
    whole, file = load_model(lens_models.exported("invariants")), tmp_path / "strange.onnx"
    proto = onnx.load(whole.path)
    change(proto)
    file.write_bytes(proto.SerializeToString())
    film, pupil = np.zeros((2, 50)), np.random.default_rng(0).uniform(-4, 4, (2, 50))
    for a, b in zip(whole.rays(film, pupil, 550.0), load_model(file).rays(film, pupil, 550.0), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_file_of_the_first_schema_is_read_and_its_angle_traced(tmp_path: Path) -> None:
    whole = read_model(lens_models.exported("invariants"))

    def as_before(data: dict) -> None:
        data.update(data.pop("nodes")[0], schema=1)
        del data["angle"]

    old = read_model(lens_models.edited(whole.path, tmp_path / "old.onnx", as_before, MODEL_KEY))
    assert old.nodes[0].angle == pytest.approx(whole.nodes[0].angle, rel=1e-12)


@pytest.mark.parametrize(("many", "degree"), [(20_000, 8), (200, 64)])
def test_hostile_terms_end_soon(many: int, degree: int, tmp_path: Path) -> None:
    """Many terms take memory for every ray, and a writer compares all products that a term of high degree may be."""
    exponents = np.random.default_rng(0).multinomial(degree, [0.25] * 4, many).astype("u1")
    zeros = {name: np.zeros(shape, "<f4") for name, shape in (("ab", (3, 2, many)), ("scalars", (1, many)))}

    def widen(data: dict) -> None:
        core = data["nodes"][0]["core"]
        core["exponents"] = {"u1": base64.b64encode(exponents.tobytes()).decode(), "shape": [many, 4]}
        for name, array in zeros.items():
            core[name] = {"f4": base64.b64encode(array.tobytes()).decode(), "shape": list(array.shape)}

    file = lens_models.edited(lens_models.exported("invariants"), tmp_path / "many.onnx", widen, MODEL_KEY)
    with pytest.raises(ModelError, match=f"{many} terms"):
        read_model(file)
