"""Model files: their nodes against the graph of their coefficients; cards, source code; damaged ones are refused."""

import base64
import json
import math
import subprocess
import zlib
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import lens_models
import numpy as np
import onnx
import onnxruntime
import pytest
from lens_models import edited
from numpy.typing import NDArray
from onnx import helper
from shipped import SOME
from writers import compiled, rays_of, written_rays

from experiments.speed.compiled_source import CompiledSource
from neurolens.base import status as st
from neurolens.base.errors import InputError, ModelError
from neurolens.cameras.onnxlens import OnnxLens, load_model
from neurolens.graph.c import literal
from neurolens.graph.compiler import FLAGS, find_compiler
from neurolens.graph.program import FILM_Z, RAY, SCENE_RAY, STOP_RADIUS, WAVELENGTH
from neurolens.graph.scalars import lower
from neurolens.models.assemble import ALL, RAY_ONLY, Parts
from neurolens.models.card import MODEL_KEY, card_to_json, read_metadata
from neurolens.models.export import card_of, export_onnx, lens_facts
from neurolens.models.file import onnx_of, read_model
from neurolens.models.fitted import Domain
from neurolens.models.pairs import domain_of
from neurolens.models.source import Fix, at_wavelength, export_source, fixed_models, fused_program, identifier
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens

ROOT = Path(__file__).parents[2]
SHIPPED = sorted(f for f in (ROOT / "models").glob("*.onnx") if f.name.partition(".")[0].partition("-")[0] in SOME)
ZOOM = ROOT / "models" / "nikon_zoom_80_200-range.states-64.onnx"


def feeds_of(file: Path, share: float) -> tuple[OnnxLens, dict[str, NDArray[np.float32]]]:
    """The model at a share of its states' range, and rays of its domain and beyond, as other programs feed them."""
    model = load_model(file)
    state = [low + share * (high - low) for low, high in (axis.range for axis in model.axes)]
    model, rng = model.at(*state), np.random.default_rng(2)
    domain = model.card["domain"]
    film, pupil = ((rng.random((2, 5000)) - 0.5) * 1.6 * domain[k] for k in ("film_radius_mm", "pupil_radius_mm"))
    call = {"film_z_mm": domain["film_z_mm"][:1], "stop_radius_mm": [0.8 * domain["stop_radius_mm"]]}
    call |= {"rays": np.stack([*film, *pupil, rng.uniform(390, 720, 5000)])} | ({"state": state} if state else {})
    return model, {name: np.asarray(value, np.float32) for name, value in call.items()}


def outputs_of(nodes: bytes, feeds: dict[str, NDArray[np.float32]]) -> list[NDArray]:
    """scene_ray, transmittance and status, as onnxruntime computes them."""
    session = onnxruntime.InferenceSession(nodes, providers=["CPUExecutionProvider"])
    return session.run(["scene_ray", "transmittance", "status"], feeds)


def agree(model: OnnxLens, one: list[NDArray], other: list[NDArray], differ: float) -> None:
    """To what float32 costs, as the card says; rays near grazing keep fewer digits."""
    (scene, power, status), (wanted, through, code) = one, other
    ok = (status == code) & (code == st.PASSED)
    assert (status != code).mean() <= differ and ok.mean() > 0.003 and len(np.unique(code)) > 2
    off, rounding = np.abs(scene - wanted)[:, ok], model.file.card["reference"]["rounding"]
    groups = {"position_mm": (off[:3], 1e-4), "direction": (off[3:], 2e-6)}
    groups["transmittance"] = np.abs(power - through)[ok], 1e-5
    for name, (values, least) in groups.items():
        most = max(least, rounding[name])
        assert np.quantile(values, 0.99) < most and values.max() < 50 * most


@pytest.mark.parametrize("share", [0.0, 0.37, 1.0])
def test_the_nodes_of_a_zooms_file_follow_its_state(share: float) -> None:
    """As another program runs them, against the graph that this package builds for the state."""
    model, feeds = feeds_of(ZOOM, share)
    inputs = dict(zip((*RAY, WAVELENGTH), feeds["rays"], strict=True))
    inputs |= {FILM_Z: feeds["film_z_mm"][0], STOP_RADIUS: feeds["stop_radius_mm"][0]}
    found = lower(model.graph()).evaluate(inputs)
    built = [np.stack([found[name] for name in SCENE_RAY]), found["transmittance"], found["status"]]
    agree(model, built, outputs_of(ZOOM.read_bytes(), feeds), 1e-3)


@pytest.mark.parametrize("name", ["network", "cylinders", *(file.stem for file in SHIPPED)])
def test_the_nodes_in_a_file_are_those_that_its_coefficients_give(name: str) -> None:
    """What another program runs is what this package runs: to the byte, or where nodes are newer, to rounding."""
    file = lens_models.exported(name) if "." not in name else ROOT / "models" / f"{name}.onnx"
    model = read_model(file)
    written = onnx_of(model.nodes, model.axes, read_metadata(file))
    if written != file.read_bytes():
        lens, feeds = feeds_of(file, 0.37)
        agree(lens, outputs_of(written, feeds), outputs_of(file.read_bytes(), feeds), 1e-3 if model.axes else 4e-4)


def test_files_are_valid_onnx(tmp_path: Path) -> None:
    for file in (lens_models.exported("fisheye"), lens_models.exported("network"), ZOOM):
        onnx.checker.check_model(onnx.load(file), full_check=True)


def test_nodes_of_a_strangers_file_are_never_run(tmp_path: Path) -> None:
    whole, file = load_model(lens_models.exported("invariants")), tmp_path / "strange.onnx"
    proto = onnx.load(whole.path)
    del proto.graph.node[:]
    proto.graph.node.append(helper.make_node("Loop", ["rays"], ["scene_ray"], domain="evil"))
    tensor = proto.graph.initializer[0]
    tensor.data_location = onnx.TensorProto.EXTERNAL
    entry = tensor.external_data.add()
    entry.key, entry.value = "location", "/etc/passwd"
    file.write_bytes(proto.SerializeToString())
    film, pupil = np.zeros((2, 50)), np.random.default_rng(0).uniform(-4, 4, (2, 50))
    for a, b in zip(whole.rays(film, pupil, 550.0), load_model(file).rays(film, pupil, 550.0), strict=True):
        np.testing.assert_array_equal(a, b)


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


# ---- cards, coefficients, source code ----


def test_card_is_strict_json_and_says_what_the_model_is(tmp_path: Path) -> None:
    model = lens_models.model("invariants")
    session = onnxruntime.InferenceSession(str(lens_models.exported("invariants")), providers=["CPUExecutionProvider"])

    def refuse(name: str) -> None:
        raise AssertionError(name)

    card = json.loads(session.get_modelmeta().custom_metadata_map["neurolens"], parse_constant=refuse)
    assert card["lens"]["sha256"] == model.lens.sha256
    assert card["lens"]["efl_mm"] == pytest.approx(first_order(model.lens).efl_mm)
    assert Domain.from_dict(card["domain"]) == model.domain
    assert card["errors"] == {"rms_um": 1.0}
    assert set(card["status_codes"]) == {"0", "1", *(str(g.status) for g in model.gates), str(4 * 6 + 2)}
    with pytest.raises(InputError, match="errors.p99_um"):
        card_to_json(card_of(model, {"p99_um": math.nan}))
    with pytest.raises(InputError, match="errors"):
        export_onnx(model, tmp_path / "bad.onnx", {"rms_um": math.inf})
    assert list(tmp_path.iterdir()) == []


def test_weights_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    model = lens_models.model("invariants")
    core = replace(model.core, scalars=model.core.scalars * math.nan)  # type: ignore[type-var, attr-defined]
    with pytest.raises(InputError, match="finite"):
        export_onnx(replace(model, core=core), tmp_path / "bad.onnx", {})


def test_the_card_says_what_float32_costs(tmp_path: Path) -> None:
    """Within it reference rays come out; beyond it, and where it is no number, the file is refused."""
    file = lens_models.exported("fisheye")
    rounding = load_model(file).card["reference"]["rounding"]
    assert set(rounding) == {"position_mm", "direction", "transmittance", "stop_mm"}
    assert all(0 <= v < 1e-3 for v in rounding.values())
    for stated in (1e-3, "inf", "much", None):
        new = edited(file, tmp_path / "x.onnx", lambda card, v=stated: card["reference"]["rounding"].update(stop_mm=v))
        with nullcontext() if stated == 1e-3 else pytest.raises(ModelError, match="rounding"):
            load_model(new)


def test_a_card_without_the_film_place_at_infinity_is_refused(tmp_path: Path) -> None:
    """Shaders and cameras focus from it."""
    cut = edited(
        lens_models.exported("fisheye"), tmp_path / "x.onnx", lambda card: card["lens"].pop("infinity_film_z_mm")
    )
    with pytest.raises(ModelError, match="infinity_film_z_mm"):
        load_model(cut)


def put(array: dict[str, Any], form: str, at: slice, raw: bytes) -> None:
    """Other bytes in a stored array."""
    data = bytearray(base64.b64decode(array[form]))
    data[at] = raw
    array[form] = base64.b64encode(data).decode()


def nest(data: dict[str, Any]) -> None:
    node = data["nodes"][0]
    for _ in range(20):
        node["core"] = {"kind": "residual", "parts": [node["core"]]}


DAMAGE: dict[str, Callable[[dict[str, Any]], object]] = {
    "NaN": lambda d: put(d["nodes"][0]["core"]["ab"], "f4", slice(4), b"\x00\x00\xc0\x7f"),
    "another scale": lambda d: d["scales"].update(position_mm=1.001 * d["scales"]["position_mm"]),
    "another lens": lambda d: d["lens"]["surfaces"][0].update(radius_mm=1.001 * d["lens"]["surfaces"][0]["radius_mm"]),
    "a shape too large": lambda d: d["nodes"][0]["core"]["ab"].update(shape=[3, 2, 10**9]),
    "a high degree": lambda d: put(d["nodes"][0]["core"]["exponents"], "u1", slice(-4, None), b"\xff" * 4),
    "a high power": lambda d: d["lens"]["surfaces"][0].update(asphere=[[10**9, 1e-9]]),
    "no angle": lambda d: d.update(angle=0.0),
    "more nodes than states": lambda d: d["nodes"].append(d["nodes"][0]),
    "no such kind": lambda d: d["nodes"][0]["core"].update(kind="eval"),
    "nested": nest,
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_damaged_coefficients_are_refused(kind: str, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="damaged|prescription|reference rays"):
        read_model(edited(lens_models.exported("invariants"), tmp_path / "bad.onnx", DAMAGE[kind], MODEL_KEY))


def test_more_reference_rays_than_any_card_has_are_refused(tmp_path: Path) -> None:
    def repeat(card: dict[str, Any]) -> None:
        card["reference"]["rays"] = [row * 100 for row in card["reference"]["rays"]]

    with pytest.raises(ModelError, match="reference"):
        read_model(edited(lens_models.exported("invariants"), tmp_path / "many.onnx", repeat))


def test_files_that_hold_none(tmp_path: Path) -> None:
    good = lens_models.exported("invariants").read_bytes()
    for name, data, words in (
        ("missing.onnx", None, "missing"),
        ("short.onnx", good[: len(good) // 2], "truncated"),
        ("text.onnx", b"not a model at all", "truncated|no card"),
    ):
        path = tmp_path / name
        if data is not None:
            path.write_bytes(data)
        with pytest.raises(ModelError, match=words):
            read_model(path)
    proto = onnx.load_model_from_string(good)
    kept = [e for e in proto.metadata_props if e.key != MODEL_KEY]
    del proto.metadata_props[:]
    proto.metadata_props.extend(kept)
    (tmp_path / "old.onnx").write_bytes(proto.SerializeToString())
    with pytest.raises(ModelError, match="holds no coefficients"):
        read_model(tmp_path / "old.onnx")


@pytest.mark.parametrize(
    ("text", "words"), [(b" " * (64 * 2**20), "more than"), (b"[" * 10**5 + b"]" * 10**5, "damaged"), (b"{}", "schema")]
)
def test_coefficients_without_end_are_refused(text: bytes, words: str, tmp_path: Path) -> None:
    """What inflates to any size, lists in lists, and a table of nothing."""
    proto = onnx.load(str(lens_models.exported("invariants")))
    entry = next(e for e in proto.metadata_props if e.key == MODEL_KEY)
    entry.value = base64.b64encode(zlib.compress(text, 9)).decode()
    (tmp_path / "bomb.onnx").write_bytes(proto.SerializeToString())
    with pytest.raises(ModelError, match=words):
        read_model(tmp_path / "bomb.onnx")


def test_the_compiler_makes_vectors_and_loses_nothing() -> None:
    model = lens_models.model("invariants")
    program = fused_program([model])
    rays = {**rays_of(model, 4099, 5), "film_z_mm": model.domain.film_z_mm[0], "stop_radius_mm": 4.0}
    slow, fast = compiled(program).rays(rays), CompiledSource(program, FLAGS).rays(rays)
    for name, column in slow.items():
        np.testing.assert_allclose(fast[name], column, rtol=0, atol=2e-5)
    asked = [*find_compiler().split(), "--version"]
    if "gcc" in subprocess.run(asked, capture_output=True, text=True, check=True).stdout:
        assert "loop vectorized" in CompiledSource(program, (*FLAGS, "-fopt-info-vec")).warnings


def test_only_what_is_wanted() -> None:
    model = lens_models.model("invariants")
    rays = {**rays_of(model, 5000, seed=6), "film_z_mm": model.domain.film_z_mm[0], "stop_radius_mm": 5.0}
    ray, whole = compiled(fused_program([model], RAY_ONLY)), written_rays("c", "invariants", rays)
    found = ray.rays(rays)
    assert set(found) == {*SCENE_RAY, "status"} and "stop_radius_mm" not in ray.signature.inputs
    assert set(np.unique(found["status"])) <= {st.PASSED, st.OUTSIDE_DOMAIN}
    for name in SCENE_RAY:
        np.testing.assert_allclose(found[name], whole[name], rtol=0, atol=2e-5)
    gates = compiled(fused_program([model], Parts(transmittance=False, stop=False, vignetting=True))).rays(rays)
    assert set(gates) == set(found) and np.mean(gates["status"] != whole["status"]) < 1e-3


def test_fixed_values_outside_the_domain_are_refused() -> None:
    model = lens_models.model("invariants")
    for fix, field in (
        (Fix(film_z_mm=1.0), "film_z"),
        (Fix(stop_radius_mm=99.0), "stop"),
        (Fix(wavelengths_nm=(200.0,)), "wavelength_nm"),
        (Fix(wavelengths_nm=(500.0, 500.0)), "wavelengths"),
    ):
        with pytest.raises(InputError, match=field):
            fixed_models(model, fix)
    with pytest.raises(InputError, match="depend on the wavelength"):
        at_wavelength(lens_models.model("laser"), 550.0)
    with pytest.raises(InputError, match="film_z"):
        fused_program([model], ALL, Fix(film_z_mm=1.0))
    with pytest.raises(InputError, match="published method"):
        fixed_models(lens_models.model("rtf"), Fix(wavelengths_nm=(500.0,)))


def test_networks_that_a_compiler_would_not_end_with_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("neurolens.graph.scalars.MOST_WEIGHTS", 100)
    with pytest.raises(InputError, match="onnxruntime"):
        fused_program([lens_models.model("network")])


def test_literals_keep_every_bit() -> None:
    numbers = np.random.default_rng(1).integers(0, 2**32, 20_000, dtype=np.uint32).view(np.float32)
    numbers = numbers[np.isfinite(numbers)]
    read = np.array([np.float32(literal(float(v)).strip("()").removesuffix("f")) for v in numbers])
    assert np.array_equal(read.view(np.uint32), numbers.view(np.uint32))


@pytest.mark.parametrize(
    "word",
    ["int", "class", "status", "ray", "t12", "vec3", "sampler2D", "sqrtf", "clamp", "size_t", "film_x_mm", "gl_a"],
)
def test_words_of_the_languages_and_of_the_code_are_no_names(word: str, tmp_path: Path) -> None:
    """With most of these a file would not compile."""
    for language in ("c", "glsl"):
        with pytest.raises(InputError, match=f"name: got '{word}'"):
            export_source([lens_models.model("invariants")], tmp_path / "a", language, {}, name=word)
    assert identifier(f"{word}!") == f"lens_{word}" and identifier("half-lens 2") == "half_lens_2"


def test_the_card_stands_on_top(tmp_path: Path) -> None:
    model = lens_models.model("invariants")
    card = card_of(model, {"rms_um": 1.25})
    card["lens"]["source"] = "A book */ #include <stdlib.h>\nand a second line"
    text = export_source([model], tmp_path / "lens.h", "c", card).path.read_text(encoding="utf-8")
    head = text[: text.index("#ifndef")]
    assert head.startswith("/*") and head.count("*/") == 1 and "\n#include" not in head
    for word in ("rms_um 1.25", "Double Gauss", "film radius", "26 blocked by the stop", "A book"):
        assert word in " ".join(head.split())
    with pytest.raises(InputError, match="name"):
        export_source([model], tmp_path / "x.h", "c", card, name="a b")
    with pytest.raises(InputError, match="to"):
        export_source([model], tmp_path / "x.h", "fortran", card)
    assert [p.name for p in tmp_path.iterdir()] == ["lens.h"]


@pytest.mark.parametrize(
    ("name", "bound"),
    [("canon_ef_20mm_f2_8_usm", True), ("canon_ef_16_35mm_f2_8l_usm", True), ("laikin_double_gauss_50", False)],
)
def test_a_card_names_the_licence_of_rims_and_tables_made_from_lensfun_and_no_other(name: str, bound: bool) -> None:
    """Rims fitted to photographs, a table of what they measured, and a lens of a book, which owes lensfun nothing."""
    lens = set_lens(read_lens(ROOT / "lenses" / f"{name}.toml"))
    for one in (lens, replace(lens, measured=())):
        said = lens_facts(one, domain_of(one)).get("licence", "")
        owes = bound and (bool(one.measured) or one.rims == "photographs")
        assert ("lensfun" in said and "CC BY-SA 3.0" in said) == owes == bool(said)
