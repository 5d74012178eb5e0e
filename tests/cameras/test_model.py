"""Exported models: loading checks, rays in batches, the camera; without torch."""

import json
import math
import os
import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import lens_models
import numpy as np
import onnx
import pytest
from onnx import ModelProto

from neurolens.base import status as st
from neurolens.base.errors import InputError, ModelError, NeurolensWarning
from neurolens.cameras.model import (
    ModelScene,
    OnnxCamera,
    OnnxLens,
    best_focus_of_stops_mm,
    best_focus_z_mm,
    load_model,
)
from neurolens.cameras.pupil_outline import PupilTable, pass_test, tightened
from neurolens.models import card as cards
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.paraxial import film_z_mm, first_order
from neurolens.optics.lens.shot import Shot
from neurolens.optics.setting import focusing
from neurolens.optics.setting.states import set_lens

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def path() -> Path:
    return lens_models.exported("invariants")


@pytest.fixture(scope="module")
def model(path: Path) -> OnnxLens:
    return load_model(path, lens_models.lens().sha256)


def some_rays(model: OnnxLens, count: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    domain = model.card["domain"]
    film, pupil = ((rng.random((2, count)) - 0.5) * 1.4 * domain[k] for k in ("film_radius_mm", "pupil_radius_mm"))
    return film, pupil, rng.uniform(*domain["wavelength_nm"], count)


def damaged(path: Path, tmp_path: Path, change: Callable[[ModelProto], object]) -> Path:
    proto = onnx.load(path)
    change(proto)
    target = tmp_path / "damaged.onnx"
    target.write_bytes(proto.SerializeToString())
    return target


def change_card(change: Callable[[dict], object]) -> Callable[[ModelProto], None]:
    def apply(proto: ModelProto) -> None:
        card = json.loads(proto.metadata_props[0].value)
        change(card)
        proto.metadata_props[0].value = json.dumps(card)

    return apply


def change_text(old: str, new: str) -> Callable[[ModelProto], object]:
    return lambda p: setattr(p.metadata_props[0], "value", p.metadata_props[0].value.replace(old, new))


def with_value(key: str, value: object) -> Callable[[dict], None]:
    """Change a card's value by its dotted key; `LEFT_OUT` removes it."""

    def change(card: dict) -> None:
        *parts, last = key.split(".")
        for part in parts:
            card = card[part]
        card.pop(last) if value is LEFT_OUT else card.update({last: value})

    return change


LEFT_OUT = object()
# A key of the card, a value that it must not have, and words of the message: the key itself where there are none.
CARD: list[tuple[str, object, str]] = [
    ("kind", "x", ""), ("schema", 2, "schema: got 2, expected 1"), ("lens", "lens", "lens: got 'lens'"),
    ("lens.efl_mm", LEFT_OUT, ""), ("lens.efl_mm", 10**400, ""), ("lens.id", LEFT_OUT, ""),
    ("lens.stop_radius_mm", 0, ""), ("domain.film_radius_mm", "20", ""), ("domain.film_radius_mm", -20, ""),
    ("domain.bounds.film_radius_mm", 1e-308, ""), ("domain.film_z_mm", [90.0, 80.0], ""),
    ("domain.focus_m", ["far", 1.0], ""), ("domain.focus_m", LEFT_OUT, ""), ("domain.nearest_m", -1, ""),
    ("domain.bounds", LEFT_OUT, ""), ("domain.bounds.low_mm", ["1", "2"], ""),
    ("domain.bounds.low_mm", [1.0], "bounds"),
    ("fit.settings", LEFT_OUT, ""), ("fit.settings.rays_seed", "x", ""),
    ("fit.note", "x" * 2**20, "card: .* characters"),
    ("errors", [1], ""), ("errors.false_pass", -0.1, "errors: got"), ("errors.poor", 5, ""),
    ("errors.zones", {"full": {"edge": {"rays": -3}}}, "errors: got"),
    ("errors.rms_um", 10**400, "errors.rms_um: got"),
    ("reference.stop_radius_mm", 10**400, "reference"), ("reference", LEFT_OUT, ""),
]  # fmt: skip
DAMAGE: dict[str, tuple[Callable[[ModelProto], object], str]] = {
    **{f"{n} {key}": (change_card(with_value(key, value)), words or key) for n, (key, value, words) in enumerate(CARD)},
    "no card": (lambda p: p.ClearField("metadata_props"), "no card"),
    "card cut": (lambda p: setattr(p.metadata_props[0], "value", p.metadata_props[0].value[:-9]), "JSON"),
    "card with NaN": (change_text('{"rms_um": 1.0}', "NaN"), "NaN"),
    "card a list": (lambda p: setattr(p.metadata_props[0], "value", "[1]"), "kind"),
    "card too deep": (
        lambda p: setattr(p.metadata_props[0], "value", '{"kind":' + "[" * 200_000 + "]" * 200_000 + "}"),
        "JSON",
    ),
    "infinite by its digits": (change_text('"wavelength_nm": [400.0', '"wavelength_nm": [1e400'), "1e400 is no finite"),
    "no graph": (lambda p: p.ClearField("graph"), "0 graphs"),
    "two cards": (lambda p: p.metadata_props.append(p.metadata_props[0]), "stands twice"),
    "much metadata": (
        lambda p: p.metadata_props.extend(onnx.StringStringEntryProto(key=str(k), value="") for k in range(101)),
        "more than 100 entries",
    ),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_models_are_refused(name: str, path: Path, tmp_path: Path) -> None:
    change, message = DAMAGE[name]
    with pytest.raises(ModelError, match=message) as error:
        load_model(damaged(path, tmp_path, change))
    assert "damaged.onnx" in str(error.value) and "\n" not in str(error.value)


def test_files_that_are_no_models(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = path.read_bytes()
    file = tmp_path / "x.onnx"
    with pytest.raises(ModelError, match="missing"):
        load_model(file)
    with pytest.raises(ModelError, match="not a regular file"):
        load_model(tmp_path)
    for content in (b"", b"hello world\n" * 9, bytes(1000), np.random.default_rng(0).bytes(5000)):
        file.write_bytes(content)
        with pytest.raises(ModelError):
            load_model(file)
    for cut in (1, 2, 50, *(len(data) * k // 23 for k in range(1, 23)), len(data) - 1):
        file.write_bytes(data[:cut])
        with pytest.raises(ModelError):
            load_model(file)
    monkeypatch.setattr(cards, "_MAX_BYTES", 1000)
    with pytest.raises(ModelError, match="at most 1000"):
        load_model(path)


def test_flipped_bytes_never_crash(path: Path, tmp_path: Path) -> None:
    data, rng, file = path.read_bytes(), np.random.default_rng(2), tmp_path / "x.onnx"
    refused = 0
    for _ in range(150):
        broken = bytearray(data)
        broken[rng.integers(len(data))] ^= 1 << rng.integers(8)
        file.write_bytes(broken)
        try:
            load_model(file)
        except ModelError:
            refused += 1
    assert refused > 10


def test_model_of_another_lens(path: Path) -> None:
    with pytest.raises(ModelError, match="another lens"):
        load_model(path, lens_models.lens("muller_fisheye_100").sha256)


def test_rays_do_not_depend_on_batches(model: OnnxLens) -> None:
    film, pupil, wavelength = some_rays(model, 20_000)
    whole = model.rays(film, pupil, wavelength, model.card["domain"]["film_z_mm"][1], 5.0)
    assert [a.shape for a in whole] == [(6, 20_000), (20_000,), (2, 20_000), (20_000,)]
    for part in (slice(0, 1), slice(5, 2000), slice(1024, 2048)):
        piece = model.rays(film[:, part], pupil[:, part], wavelength[part], model.card["domain"]["film_z_mm"][1], 5.0)
        for a, b in zip(whole, piece, strict=True):
            assert np.allclose(a[..., part], b, rtol=0, atol=2e-5)
    nothing = model.rays(np.empty((2, 0)), np.empty((2, 0)), np.empty(0))
    assert nothing.scene_ray.shape == (6, 0) and nothing.status.shape == (0,)


def test_numbers_beyond_float32_are_outside_or_refused_without_a_warning(
    path: Path, model: OnnxLens, tmp_path: Path
) -> None:
    def bounds(card: dict) -> None:
        card["domain"]["bounds"]["low_mm"][0] = -1e300

    def reference(card: dict) -> None:
        card["reference"]["scene_ray"][0] = [1e300] * len(card["reference"]["scene_ray"][0])

    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        for film, plane in ((1e300, None), (1.0, 1e300)):
            rays = model.rays(np.full((2, 1), film), np.zeros((2, 1)), 550.0, plane)
            assert rays.status == st.OUTSIDE_DOMAIN
        for change in (bounds, reference):
            with pytest.raises(ModelError):
                load_model(damaged(path, tmp_path, change_card(change)))
        wide = PupilTable(0.0, 20.0, np.array([[-3e38] * 3, [3e38] * 3, [3e38] * 3], np.float32))
        nothing = pass_test(lambda film, pupil, nm: np.zeros(film.shape[1], bool), [550.0])
        assert (tightened(wide, nothing).rows[0] == 1).all()


def test_film_position_of_every_ray(model: OnnxLens) -> None:
    film, pupil, wavelength = some_rays(model, 600)
    near, far = model.card["domain"]["film_z_mm"]
    planes = np.resize([near, far, math.nan], 600)
    mixed = model.rays(film, pupil, wavelength, planes)
    for z in (near, far):
        one = model.rays(film, pupil, wavelength, z)
        assert np.allclose(mixed.scene_ray[:, planes == z], one.scene_ray[:, planes == z], atol=2e-5)
    assert np.all(mixed.status[np.isnan(planes)] == st.OUTSIDE_DOMAIN)


@pytest.mark.parametrize(
    ("film", "pupil", "wavelength", "field"),
    [
        (np.zeros((3, 5)), np.zeros((2, 5)), 550.0, "film_xy_mm"),
        (np.zeros((2, 5)), np.zeros((2, 4)), 550.0, "pupil_xy_mm"),
        ("film", np.zeros((2, 5)), 550.0, "film_xy_mm"),
    ],
)
def test_shapes_are_checked(model: OnnxLens, film: object, pupil: object, wavelength: object, field: str) -> None:
    with pytest.raises(InputError, match=field):
        model.rays(film, pupil, wavelength)  # type: ignore[arg-type]


def test_camera_settings_outside_the_domain(model: OnnxLens) -> None:
    with pytest.raises(InputError, match="0.7 m"):
        OnnxCamera(model, Shot((36.0, 24.0), 0.5))
    with pytest.raises(InputError, match="four focal lengths"):
        OnnxCamera(model, Shot((36.0, 24.0), 0.1))
    with pytest.raises(InputError, match="widest stop"):
        OnnxCamera(model, Shot((36.0, 24.0), 2.0, 1.2))
    for bad in (0.0, -1.0, math.nan):
        with pytest.raises(InputError):
            OnnxCamera(model, Shot((36.0, 24.0), bad))


@pytest.mark.parametrize("focus_m", [math.inf, 1.5])
@pytest.mark.parametrize(
    "name", ["canon_aspheric_50.ols-64", "laikin_double_gauss_50.mlp-16x2", "schneider_anamorphic_31.mlp-16x2",
             "shimizu_fisheye_220.mlp-16x2"],
)  # fmt: skip
def test_the_best_focus_of_a_model_is_that_of_its_lens(name: str, focus_m: float) -> None:
    """At every stop; by its own rays the first of these models would stand 0.04 mm away in small ones."""
    model = load_model(ROOT / "models" / f"{name}.onnx")
    lens, widest = lens_models.lens(name.split(".")[0]), model.card["domain"]["stop_radius_mm"]
    stops = widest * np.array([1.0, 0.4, 0.1])
    scenes = [ModelScene(model, film_z_mm(lens, focus_m), stop) for stop in stops]
    exact = [focusing.best_focus_z_mm(lens.with_stop_radius(stop), focus_m) for stop in stops]
    assert [best_focus_z_mm(s, focus_m, lens.light_nm) for s in scenes] == pytest.approx(exact, abs=1e-6)
    shader = best_focus_of_stops_mm(scenes[0], focus_m, lens.light_nm, stops)
    assert shader == pytest.approx(focusing.best_focus_of_stops_mm(lens, focus_m, stops.tolist()), abs=1e-6)


@pytest.mark.parametrize("focus_m", [math.inf, 3.0])
def test_a_model_between_the_states_of_its_zoom_is_focused_by_its_own_rays(focus_m: float) -> None:
    """To what the model's error on the film allows: an error e of a spot at f/N is 2 N e of focus."""
    model = load_model(ROOT / "models" / "nikon_zoom_70_200-range.states-64.onnx").at(102.6)
    lens = set_lens(lens_models.lens("nikon_zoom_70_200"), zoom=102.6, focus_m=focus_m, focus_mode="best")
    widest, paraxial = model.card["domain"]["stop_radius_mm"], film_z_mm(lens, focus_m)
    for share in (1.0, 0.4, 0.15):
        stopped = lens.with_stop_radius(widest * share)
        found = best_focus_z_mm(ModelScene(model, paraxial, widest * share), focus_m, lens.light_nm)
        exact = focusing.best_focus_z_mm(stopped, focus_m)
        allowed = 2 * first_order(stopped).f_number * 1e-3 * model.card["errors"]["rms_um"] + 0.002
        assert found == pytest.approx(exact, abs=allowed)


def test_an_aperture_s_blades_count_in_the_focus_of_both() -> None:
    shape = Aperture(3)
    lens, path = lens_models.lens().with_aperture(shape), ROOT / "models" / "laikin_double_gauss_50.ols-60.onnx"
    model = load_model(path)
    scene = ModelScene(model, film_z_mm(lens, 2.0), lens.stop_radius_mm, shape)
    found = [best_focus_z_mm(s, 2.0, (400.0, 700.0)) for s in (scene, replace(scene, aperture=None))]
    exact = [focusing.best_focus_z_mm(each, 2.0) for each in (lens, lens.with_aperture(None))]
    assert found == pytest.approx(exact, abs=0.006) and exact[0] > exact[1] + 0.05  # the triangle has no far edge


def test_cameras_are_in_best_focus_by_default(model: OnnxLens) -> None:
    best, paraxial = (OnnxCamera(model, Shot((36.0, 24.0), math.inf, focus_mode=f)) for f in ("best", "paraxial"))
    exact = lens_models.exact_camera(math.inf, None).settings["film_z_mm"]
    assert paraxial.settings["film_z_mm"] == pytest.approx(film_z_mm(lens_models.lens(), math.inf))
    assert best.settings["film_z_mm"] == pytest.approx(exact, abs=1e-6)
    assert exact < paraxial.settings["film_z_mm"] - 0.25
    assert OnnxCamera(model, Shot((36.0, 24.0), math.inf)).settings == best.settings


def test_a_film_range_that_ends_before_best_focus_is_said_and_held(path: Path) -> None:
    """Older models end at the paraxial image of infinity."""
    older = load_model(path)
    end = older.card["domain"]["film_z_mm"][0] = film_z_mm(lens_models.lens(), math.inf)
    with pytest.warns(NeurolensWarning, match=rf"{path.name}: best focus needs its film at 91.3.* ends at {end:.6g}"):
        camera = OnnxCamera(older, Shot((36.0, 24.0), math.inf))
    assert camera.settings["film_z_mm"] == end
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        OnnxCamera(older, Shot((36.0, 24.0), math.inf, focus_mode="paraxial"))
        OnnxCamera(older, Shot((36.0, 24.0), 2.0))


def test_films_of_a_domain_may_lie_beside_the_paraxial_image(path: Path) -> None:
    """A model of one focus whose films are all nearer to the lens: best focus lies there, or an offset leads there."""
    model = load_model(path)
    paraxial, far = film_z_mm(lens_models.lens(), 2.0), film_z_mm(lens_models.lens(), 2.0) - 0.1
    model.card["domain"] |= {"film_z_mm": [far - 1, far], "focus_m": [2.0, 2.0]}
    assert OnnxCamera(model, Shot((36.0, 24.0), 2.0)).settings["film_z_mm"] < far
    moved = OnnxCamera(model, Shot((36.0, 24.0), 2.0, focus_mode="paraxial", film_offset_mm=-0.5))
    assert moved.settings["film_z_mm"] == pytest.approx(paraxial - 0.5)
    with pytest.raises(InputError, match="focus_m"):
        OnnxCamera(model, Shot((36.0, 24.0), 3.0e3))


def test_film_beyond_the_model_is_dark(model: OnnxLens) -> None:
    camera = OnnxCamera(model, Shot((60.0, 60.0), 2.0))
    film = np.array([[25.0, 0.0, np.nan], [25.0, 0.0, 1.0]], np.float32)
    rays = camera.sample(film, np.full((2, 3), 0.4, np.float32), np.full(3, 550, np.float32))
    assert rays.weight[0] == rays.weight[2] == 0 and rays.status[0] == rays.status[2] == st.OUTSIDE_DOMAIN
    assert rays.weight[1] > 0 and rays.status[1] == 0


def test_models_need_no_torch_and_write_nothing_but_their_outline(path: Path, tmp_path: Path) -> None:
    """Nothing else in the home and cache folders: onnxruntime records what it does unless told not to."""
    code = (
        "import sys\n"
        "sys.modules.update(dict.fromkeys(['torch', 'sklearn', 'matplotlib']))\n"
        "from neurolens.cameras.model import OnnxCamera, load_model\n"
        "from neurolens.optics.lens.shot import Shot\n"
        f"camera = OnnxCamera(load_model({str(path)!r}), Shot((36, 24), 2, runtime='onnxruntime'))\n"
        "import numpy as np\n"
        "rays = camera.sample(np.zeros((2, 9), 'f4'), np.full((2, 9), .5, 'f4'), np.full(9, 550, 'f4'))\n"
        "assert (rays.status == 0).all() and (rays.direction[2] < -.9).all()\n"
    )
    env = {k: v for k, v in os.environ.items() if k != "ORT_DISABLE_TELEMETRY"}
    env |= {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, env=env, check=False)
    assert done.returncode == 0, done.stderr
    assert [file.suffix for file in tmp_path.rglob("*") if file.is_file()] == [".outline"]
