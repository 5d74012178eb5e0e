"""Networks stored in float16 and int8: what the file holds, what it computes, and what the loader still refuses."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from lens_models import prepared
from onnx import TensorProto, helper, numpy_helper

from neurolens.base.errors import InputError, ModelError
from neurolens.cameras.model import load_model
from neurolens.surrogates.cores import Residual
from neurolens.surrogates.export import export_onnx
from neurolens.surrogates.fit import ModelSettings, fit_model
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.precision import store_weights

KINDS = ("float16", "int8")


@pytest.fixture(scope="module")
def model() -> LensModel:
    fitted = fit_model(prepared(), ModelSettings("mlp", units=10, layers=2, steps=40))
    core: Any = fitted.core  # the network alone, without terms for the boundaries
    return replace(fitted, core=core.parts[1] if isinstance(core, Residual) else core)


@pytest.fixture(scope="module")
def files(model: LensModel, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("precision")
    whole = export_onnx(model, folder / "float32.onnx", errors={"rms_um": 1.0})
    return {"float32": whole} | {k: store_weights(whole, folder / f"{k}.onnx", k, {"rms_um": 2.0}) for k in KINDS}


def _rays(file: Path) -> tuple[np.ndarray, np.ndarray]:
    inputs = prepared().pairs.held_out.inputs.select(slice(0, 800))
    columns = [c.numpy().astype(np.float32) for c in inputs.columns()]
    out = load_model(file).rays(np.stack(columns[:2]), np.stack(columns[3:5]), columns[5], columns[2])
    return out.scene_ray, out.status


def _rounded(matrix: np.ndarray, kind: str) -> np.ndarray:
    """The definition, written again: each row in units of its largest entry, to 11 bits or to whole 127ths."""
    most = np.abs(matrix).max(1, keepdims=True)
    if kind == "int8":
        return np.round(matrix / most * 127) / 127 * most
    return (matrix / most).astype(np.float16).astype(np.float64) * most


@pytest.mark.parametrize("kind", KINDS)
def test_the_stored_numbers_are_the_weights_rounded(files: dict[str, Path], kind: str) -> None:
    before = {t.name: numpy_helper.to_array(t) for t in onnx.load(files["float32"]).graph.initializer}
    after = {t.name: numpy_helper.to_array(t) for t in onnx.load(files[kind]).graph.initializer}
    names = [n.removesuffix(f"_{kind}") for n in after if n.endswith(f"_{kind}")]
    assert len(names) == 3  # two tanh layers and the outputs
    for name in names:
        packed, scale = after[f"{name}_{kind}"], after[f"{name}_scale"].reshape(-1, 1)
        assert packed.dtype == kind
        wanted = _rounded(before[name].astype(np.float64), kind)
        assert np.allclose(packed.astype(np.float64) * scale, wanted, rtol=1e-6, atol=0)
        assert name not in after


def test_fewer_bits_cost_error_and_save_bytes(files: dict[str, Path]) -> None:
    exact, _ = _rays(files["float32"])
    angle = {k: np.abs(_rays(files[k])[0][3:] - exact[3:]).max() for k in KINDS}
    assert 1e-6 < angle["float16"] < 2e-3
    assert 3 * angle["float16"] < angle["int8"] < 0.1
    sizes = [sum(len(t.raw_data) for t in onnx.load(files[k]).graph.initializer) for k in ("float32", *KINDS)]
    assert sizes == sorted(sizes, reverse=True) and sizes[-1] < 0.7 * sizes[0]


@pytest.mark.parametrize("kind", KINDS)
def test_the_card_says_so_and_the_loader_checks_the_new_graph(files: dict[str, Path], kind: str, tmp_path) -> None:
    card = load_model(files[kind]).card
    assert card["fit"]["precision"] == kind and card["errors"] == {"rms_um": 2.0}
    proto = onnx.load(files[kind])
    for tensor in proto.graph.initializer:
        if tensor.name.endswith("_scale"):
            tensor.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(tensor) * np.float32(1.02), tensor.name))
    onnx.save(proto, tmp_path / "x.onnx")
    with pytest.raises(ModelError, match="reference rays"):
        load_model(tmp_path / "x.onnx")


def _not_finite(proto: onnx.ModelProto) -> None:
    at = next(t for t in proto.graph.initializer if t.data_type == TensorProto.FLOAT16)
    at.CopyFrom(numpy_helper.from_array(np.full_like(numpy_helper.to_array(at), np.inf), at.name))


def _as_integers(proto: onnx.ModelProto) -> None:
    at = next(t for t in proto.graph.initializer if t.data_type == TensorProto.FLOAT16)
    bits = np.full(numpy_helper.to_array(at).size, 0x7C00)
    at.ClearField("raw_data")
    at.int32_data.extend(int(b) for b in bits)


def _too_many(proto: onnx.ModelProto) -> None:
    big = numpy_helper.from_array(np.zeros((30_000, 1), np.int8), "big")
    proto.graph.initializer.extend([big, numpy_helper.from_array(np.float32(1.0), "one")])
    proto.graph.initializer.append(numpy_helper.from_array(np.zeros((1, 5), np.float32), "first"))
    proto.graph.node.append(helper.make_node("DequantizeLinear", ["big", "one"], ["wide"]))
    proto.graph.node.append(helper.make_node("MatMul", ["first", "rays"], ["row"]))
    proto.graph.node.append(helper.make_node("Mul", ["wide", "row"], ["product"]))


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        ("float16", _not_finite, "infinite"),
        ("float16", _as_integers, "raw bytes"),
        ("int8", _too_many, "operator Mul has shape"),
        ("int8", lambda p: p.graph.node.append(helper.make_node("QuantizeLinear", [], ["q"])), "QuantizeLinear"),
    ],
)
def test_what_a_model_never_holds_is_refused(files: dict[str, Path], tmp_path: Path, kind, change, message) -> None:
    proto = onnx.load(files[kind])
    change(proto)
    onnx.save(proto, tmp_path / "x.onnx")
    with pytest.raises(ModelError, match=message):
        load_model(tmp_path / "x.onnx")


def test_what_it_refuses(files: dict[str, Path], model: LensModel, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="precision"):
        store_weights(files["float32"], tmp_path / "x.onnx", "float8")  # type: ignore[arg-type]
    thin = fit_model(prepared(), ModelSettings("thick"))
    with pytest.raises(InputError, match="network"):
        store_weights(export_onnx(thin, tmp_path / "thin.onnx"), tmp_path / "x.onnx", "int8")
    assert not (tmp_path / "x.onnx").exists()


def test_rows_of_zeros_stay_zeros(model: LensModel, tmp_path: Path) -> None:
    core = model.core
    (first, bias), *rest = core.hidden  # type: ignore[attr-defined]
    still = replace(core, hidden=((np.concatenate([np.zeros_like(first[:1]), first[1:]]), bias), *rest))  # type: ignore[type-var]
    whole = export_onnx(replace(model, core=still), tmp_path / "a.onnx")
    for kind in KINDS:
        assert np.isfinite(_rays(store_weights(whole, tmp_path / "b.onnx", kind))[0]).all()
