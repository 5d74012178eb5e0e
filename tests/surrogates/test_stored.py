"""Coefficients inside exported files: exact in float32, checked on reading, refused when damaged."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lens_models
import numpy as np
import onnx
import pytest

from neurolens.base.errors import ModelError
from neurolens.modelfile import CARD_KEY, MODEL_KEY
from neurolens.surrogates.cores import Partitioned
from neurolens.surrogates.export import export_onnx
from neurolens.surrogates.source import fused_program
from neurolens.surrogates.stored import load_fitted, model_to_text


def tables(core: Any) -> list[np.ndarray]:
    """Every coefficient of a core, in order."""
    if isinstance(core, Partitioned):
        return [t for part in core.parts for t in tables(part)]
    if hasattr(core, "hidden"):
        return [*(t for pair in core.hidden for t in pair), *core.output, core.shift, core.scale]
    return [getattr(core, "ab", getattr(core, "components", None)), core.scalars]


@pytest.mark.parametrize("kind", [*lens_models.KINDS, "zones"])
def test_round_trip_is_exact_in_float32(kind: str, tmp_path: Path) -> None:
    model = lens_models.model(kind)
    path = export_onnx(model, tmp_path / "model.onnx", {})
    read = load_fitted(path)
    for a, b in zip(tables(model.core), tables(read.core), strict=True):
        assert np.array_equal(a.astype(np.float32), b.astype(np.float32))
    same = ("domain", "encoding", "scales", "gates", "direction", "method")
    assert all(getattr(read, name) == getattr(model, name) for name in same)
    assert read.lens.sha256 == model.lens.sha256 and read.lens.stop_radius_mm == model.lens.stop_radius_mm
    # What is read and written again is the same file, and the same source.
    again = load_fitted(export_onnx(read, tmp_path / "again.onnx", {}))
    assert model_to_text(again) == model_to_text(read)
    assert fused_program([again]).steps == fused_program([read]).steps
    assert len(model_to_text(model)) < 10_000


def rewrite(source: Path, target: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """A model file whose stored coefficients were changed."""
    proto = onnx.load(str(source))
    entry = next(e for e in proto.metadata_props if e.key == MODEL_KEY)
    data = json.loads(zlib.decompress(base64.b64decode(entry.value)))
    change(data)
    entry.value = base64.b64encode(zlib.compress(json.dumps(data).encode())).decode()
    target.write_bytes(proto.SerializeToString())
    return target


def set_scalar(data: dict[str, Any]) -> None:
    raw = bytearray(base64.b64decode(data["core"]["ab"]["f4"]))
    raw[:4] = b"\x00\x00\xc0\x7f"  # NaN
    data["core"]["ab"]["f4"] = base64.b64encode(raw).decode()


def double_scale(data: dict[str, Any]) -> None:
    data["scales"]["position_mm"] *= 1.001


def bend(data: dict[str, Any]) -> None:
    data["lens"]["surfaces"][0]["radius_mm"] *= 1.001


def shorten(data: dict[str, Any]) -> None:
    data["core"]["ab"]["shape"] = [3, 2, 10**9]


def lengthen(data: dict[str, Any]) -> None:
    """Terms that evaluation takes memory for before their coefficients, too few, are looked at."""
    count = 200_000
    data["core"]["exponents"] = {"u1": base64.b64encode(bytes(4 * count)).decode(), "shape": [count, 4]}


def raise_degree(data: dict[str, Any]) -> None:
    raw = bytearray(base64.b64decode(data["core"]["exponents"]["u1"]))
    raw[-4:] = b"\xff\xff\xff\xff"
    data["core"]["exponents"]["u1"] = base64.b64encode(raw).decode()


def rename(data: dict[str, Any]) -> None:
    data["core"]["kind"] = "eval"


def nest(data: dict[str, Any]) -> None:
    core = data["core"]
    for _ in range(20):
        core = {"kind": "partitioned", "edges": [], "parts": [core]}
    data["core"] = core


@pytest.mark.parametrize("change", [set_scalar, double_scale, bend, shorten, lengthen, raise_degree, rename, nest])
def test_damaged_coefficients_are_refused(change: Callable[[dict[str, Any]], None], tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="damaged|prescription"):
        load_fitted(rewrite(lens_models.exported("invariants"), tmp_path / "bad.onnx", change))


def test_more_reference_rays_than_any_card_has_are_refused(tmp_path: Path) -> None:
    proto = onnx.load(str(lens_models.exported("invariants")))
    entry = next(e for e in proto.metadata_props if e.key == CARD_KEY)
    card = json.loads(entry.value)
    card["reference"]["rays"] = [row * 100 for row in card["reference"]["rays"]]
    entry.value = json.dumps(card)
    (tmp_path / "many.onnx").write_bytes(proto.SerializeToString())
    with pytest.raises(ModelError, match="reference rays"):
        load_fitted(tmp_path / "many.onnx")


def test_files_that_hold_none(tmp_path: Path) -> None:
    good = lens_models.exported("invariants").read_bytes()
    for name, data, words in (
        ("missing.onnx", None, "no such file"),
        ("short.onnx", good[: len(good) // 2], "truncated"),
        ("text.onnx", b"not a model at all", "truncated|no card"),
    ):
        path = tmp_path / name
        if data is not None:
            path.write_bytes(data)
        with pytest.raises(ModelError, match=words):
            load_fitted(path)
    proto = onnx.load_model_from_string(good)
    kept = [e for e in proto.metadata_props if e.key != MODEL_KEY]
    del proto.metadata_props[:]
    proto.metadata_props.extend(kept)
    (tmp_path / "old.onnx").write_bytes(proto.SerializeToString())
    with pytest.raises(ModelError, match="holds no coefficients"):
        load_fitted(tmp_path / "old.onnx")


def test_a_text_that_inflates_without_end_is_refused(tmp_path: Path) -> None:
    proto = onnx.load(str(lens_models.exported("invariants")))
    entry = next(e for e in proto.metadata_props if e.key == MODEL_KEY)
    entry.value = base64.b64encode(zlib.compress(b" " * (64 * 2**20), 9)).decode()
    (tmp_path / "bomb.onnx").write_bytes(proto.SerializeToString())
    with pytest.raises(ModelError, match="more than"):
        load_fitted(tmp_path / "bomb.onnx")
