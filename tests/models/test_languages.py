"""Shading languages: models, exact lenses and cameras give the rays of numpy, also where nothing can come out.

CUDA and VEX are compiled as C++ here. Compilers of the others take seconds a shader: `make test-shading` runs them
(NEUROLENS_SHADING), and extremes of the library, bands and states in all languages.
"""

import os
import re
import shutil
import subprocess
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import lens_models
import numpy as np
import pytest
from command_line import failure
from writers import rays_of

from experiments.languages import RUN, Given, Missing, Rows
from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.base.settings import LIGHT_NM
from neurolens.cameras.model import load_model
from neurolens.cameras.shaders.lens_source import lens_program, pupil_planes_mm
from neurolens.cameras.shaders.source import camera_program
from neurolens.cli import main
from neurolens.graph.adjoint import adjoint
from neurolens.graph.program import _FOLDED, Program
from neurolens.graph.shading import LANGUAGES, REGISTERS, Cuda
from neurolens.models.axes import mixture_of
from neurolens.models.source import WRITERS, Fix, fixed_models, fused_program
from neurolens.optics.lens.paraxial import film_z_mm
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.setting.pupils import image_radius_mm, pupil_bounds
from neurolens.optics.setting.states import set_lens

ROOT = Path(__file__).parents[2]
WHOLE = "NEUROLENS_SHADING" in os.environ
COUNT = 20_000 if WHOLE else 4_000
LIGHT = ("cuda", "vex")  # compiled in a second
WILD = np.float32([np.nan, np.inf, -np.inf, 3.4e38, -3.4e38, 1e30, -1e30, 1e-40, 0.0, -0.0, 1e6])
Case = tuple[Program, dict[str, Any]]  # with rays


def rows(**values: Any) -> dict[str, Any]:
    return {name: np.float32(value) for name, value in values.items()}


def _disc(rng: np.random.Generator, radius: float, count: int) -> np.ndarray:
    angle, away = 2 * np.pi * rng.random(count), radius * np.sqrt(rng.random(count))
    return away * np.stack([np.cos(angle), np.sin(angle)])


def exact(name: str, sent: int = COUNT) -> Case:
    """A lens file, traced, focused at infinity: rays all over its picture and the disc of its pupils.

    Of those sent, as many are taken as pass, up to half of all: of a fisheye one in a hundred does.
    """
    lens = set_lens(read_any(ROOT / "lenses" / f"{name}.toml"))
    (plane,), rng = pupil_planes_mm([lens], ()), np.random.default_rng(0)
    radius, film_z = image_radius_mm(lens)[0], film_z_mm(lens, np.inf)
    disc = pupil_bounds(lens, radius, (film_z, film_z), LIGHT_NM, pupil_z_mm=plane, rows=9).disc_mm
    (film_x, film_y), (pupil_x, pupil_y) = _disc(rng, radius, sent), _disc(rng, disc, sent)
    rays = rows(
        film_x_mm=film_x, film_y_mm=film_y, pupil_x_mm=pupil_x, pupil_y_mm=pupil_y,
        wavelength_nm=rng.uniform(*LIGHT_NM, sent), film_z_mm=film_z, stop_radius_mm=lens.stop_radius_mm,
    )  # fmt: skip
    program = lens_program([lens], (), [plane])
    passed = program.evaluate(rays)["status"] == st.PASSED
    some = np.flatnonzero(passed)[: COUNT // 2 if sent > COUNT else COUNT]
    taken = np.concatenate([some, np.flatnonzero(~passed)[: COUNT - len(some)]])
    return program, {key: v[taken] if np.size(v) > 1 else v for key, v in rays.items()}


def fitted(kind: str) -> Case:
    model = lens_models.model(kind)
    rays = rays_of(model, COUNT, seed=0)
    at = rows(film_z_mm=np.mean(model.domain.film_z_mm), stop_radius_mm=0.8 * model.domain.stop_radius_mm)
    return fused_program([model]), rays | at


def camera() -> Case:
    """The whole camera of the traced lens with derivatives; its table is the caller's."""
    made, rng = lens_models.exact_camera(2.0, 4.0), np.random.default_rng(0)
    film = made.film
    program = camera_program(film, made.lens_graph(), derivatives=True, own_table=False)
    x, y, u, v, light = rng.random((5, COUNT))
    rays = rows(film_x_mm=36 * x - 18, film_y_mm=24 * y - 12, u=u, v=v, wavelength_nm=400 + 300 * light)
    return program, rays | rows(outline=film.outline.table)


CASES: dict[str, Callable[[], Case]] = {
    "model": lambda: fitted("invariants"),
    "exact": lambda: exact("laikin_double_gauss_50"),
    "camera": camera,
    "network": lambda: fitted("network"),
    "fisheye": lambda: exact("isshiki_fisheye_10", sent=12 * COUNT),
    "zoom of 33 refractions": lambda: exact("nikon_zoom_70_200"),
    "aspheres": lambda: exact("phone_lens_6"),
}
FIRST = ("model", "exact", "camera")


@cache
def case(name: str) -> Case:
    """Rays of a case, of which each fourth has some wild numbers in place of its own."""
    program, rays = CASES[name]()
    rng, count = np.random.default_rng(1), COUNT // 4
    for key, values in rays.items():
        if key != "outline":
            rays[key] = np.concatenate([np.broadcast_to(values, COUNT), np.broadcast_to(values, COUNT)[:count]])
            hit = COUNT + np.flatnonzero(rng.random(count) < 0.3)
            rays[key][hit] = rng.choice(WILD, len(hit))
    return program, rays


TWICE = ("vex", "wgsl", "hlsl")  # a b + c is rounded twice


@pytest.fixture
def rounded(monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict[str, np.ndarray]]:
    """The results of numpy, with the roundings of a language."""

    def evaluate(language: str, program: Program, rays: Mapping[str, Any], band: int = 0) -> dict[str, np.ndarray]:
        if language in TWICE:
            monkeypatch.setitem(_FOLDED, "fma", lambda a, b, c: (a * b).astype(np.float32) + c.astype(np.float32))
        return program.evaluate(rays, band)

    return evaluate


def run(language: str, given: Given) -> Rows:
    try:
        return RUN[language](given)
    except Missing as reason:
        pytest.skip(str(reason))


def check(found: Rows, wanted: Mapping[str, np.ndarray]) -> None:
    """Statuses are equal; rays that pass are those of numpy within 1e-5 of the largest of their vectors' components."""
    np.testing.assert_array_equal(found["status"], wanted["status"])
    passed = found["status"] == st.PASSED
    expected = {name: np.broadcast_to(wanted[name], passed.shape)[passed] for name in found if name != "status"}
    # Components of one vector have one name but for a letter.
    vector = {name: re.sub("_film_[xy]", "_film", re.sub(r"(^|^d|_)[xyz](_|$)", r"\1 \2", name)) for name in expected}
    largest = dict.fromkeys(vector.values(), 0.0)
    for name, values in expected.items():
        largest[vector[name]] = max(largest[vector[name]], float(np.abs(values).max()))
    for name, values in expected.items():
        assert np.isfinite(found[name][passed]).all(), name
        within = 1e-5 * largest[vector[name]]
        np.testing.assert_allclose(found[name][passed], values, rtol=0, atol=within, err_msg=name)
    if "weight" in found:
        assert not found["weight"][~passed].any()


HEAVY = pytest.mark.skipif(not WHOLE, reason="compilers take a minute: make test-shading (NEUROLENS_SHADING)")
PAIRS = [
    pytest.param(language, name, marks=[] if language in LIGHT and name in FIRST else [HEAVY, pytest.mark.slow])
    for name in CASES
    for language in RUN
]


@pytest.mark.parametrize(("language", "name"), PAIRS)
def test_rays_are_those_of_numpy(language: str, name: str, rounded: Callable[..., dict[str, np.ndarray]]) -> None:
    program, rays = case(name)
    found, wanted = run(language, Given(program, rays)), rounded(language, program, rays)
    assert 0.05 < (found["status"] == st.PASSED)[:COUNT].mean() and (found["status"][COUNT:] != st.PASSED).mean() > 0.3
    check(found, wanted)


@cache
def banded() -> Case:
    model, waves = lens_models.model("invariants"), (450.0, 550.0, 650.0)
    at = Fix(waves, float(np.mean(model.domain.film_z_mm)), 0.5 * model.domain.stop_radius_mm)
    return fused_program(fixed_models(model, at), fix=at), rays_of(model, 500, seed=6)


@pytest.mark.parametrize(
    "language", [pytest.param(k, marks=[] if k in LIGHT else [HEAVY, pytest.mark.slow]) for k in RUN]
)
def test_a_band_is_an_argument(language: str) -> None:
    program, rays = banded()
    for band in (0, 2, -1, 3) if WHOLE else (2, 3):
        found = run(language, Given(program, rays, band))
        if 0 <= band < 3:
            check(found, program.evaluate(rays, band))
        else:
            assert (found["status"] == st.OUTSIDE_DOMAIN).all()


@cache
def stated() -> Case:
    """A model of a zoom's range, with rays."""
    model = load_model(ROOT / "models" / "nikon_zoom_70_200-range.states-64.onnx")
    program, first = fused_program(model.file.nodes), model.file.nodes[0]
    program.mixture = mixture_of(model.axes)
    at = rows(film_z_mm=np.mean(first.domain.film_z_mm), stop_radius_mm=0.7 * first.domain.stop_radius_mm)
    return program, rays_of(first, 500, seed=6) | at


@pytest.mark.parametrize(
    "language", [pytest.param(k, marks=[] if k == "cuda" else [HEAVY, pytest.mark.slow]) for k in RUN if k != "vex"]
)
def test_a_state_is_an_argument(language: str) -> None:
    """Of a zoom's range; beyond it no ray passes."""
    program, rays = stated()
    for zoom, within in ((100.0, True), (300.0, False)):
        found = run(language, Given(program, rays, state=(zoom,)))
        if within:
            assert 0.2 < (found["status"] == st.PASSED).mean()
            check(found, program.evaluate(rays | {"zoom_mm": zoom}))
        else:
            assert (found["status"] == st.OUTSIDE_DOMAIN).all()


# A statement, and a header, of VEX as its reference has them.
_ATOM = r"(?:\w+(?:\.\d+)?(?:e[+-]?\d+)?|\(-\d[\d.e+-]*\)|-\(\w+\))"
_VEX_LINE = re.compile(
    r"[{}]|#define [A-Z0-9_]+ \S+|float \w+\([\w ;\[\]]*\)|void \w+\(|    (?:export )?(?:float|int) \w+(?:\[\])?[;)]"
    r"|    float t\d+ = [^={};,]*(?:<=[^={};,]*)?;|    float t\d+ = [^={};]*\b(?:max|min|sqrt|floor)\([^={};]*;"
    r"|    float t\d+ = [^={};]*\[[^={};]*\][^={};]*;|    (?:return )?\w+(?: = (?:int\()?\w+\)?)?;|"
)


@pytest.mark.parametrize("name", FIRST)
def test_vex_has_no_words_of_other_languages(name: str) -> None:
    text = WRITERS["vex"](case(name)[0], "lens", [])
    code = text.split("*/", 1)[1]
    assert not re.search(r"\d\.?f\b|\b(?:const|static|inline|struct|out|in)\b|[*&]\w+ *[;,)]|->", code)
    assert [line for line in code.splitlines() if not _VEX_LINE.fullmatch(line)] == []


@pytest.mark.skipif(not WHOLE or not shutil.which("nvcc"), reason="no nvcc, or not make test-shading")
def test_nvcc_takes_it(tmp_path: Path) -> None:
    (tmp_path / "lens.cuh").write_text(WRITERS["cuda"](case("camera")[0], "lens", []))
    (tmp_path / "rays.cu").write_text(
        '#include "lens.cuh"\n__global__ void rays(const float *a, const float *t, int cells, lens_ray *out)\n'
        "{ out[threadIdx.x] = lens(a[0], a[1], a[2], a[3], a[4], t, cells); }\n"
    )
    done = subprocess.run(["nvcc", "-cubin", "rays.cu"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(not WHOLE or not shutil.which("nvcc"), reason="no nvcc, or not make test-shading")
def test_nvcc_makes_one_function_of_the_gradients_of_56_refractions(tmp_path: Path) -> None:
    """A function of so many steps that it called stored and read 18 kB a ray for want of registers."""
    ours = pytest.importorskip("neurolens.programs.torch")
    lens = ours.LensCamera("panavision_anamorphic_zoom_21", Shot((24.9, 18.7), 5.0), dtype=ours.torch.float64)._lens
    back = adjoint(lens.program, ours._FOUND, ours._GIVEN[:-1], REGISTERS)
    (tmp_path / "lens.cu").write_text(Cuda(back, "lens").kernel())
    subprocess.run(["nvcc", "-ptx", "lens.cu"], cwd=tmp_path, check=True)
    assert re.findall(r"^(?:\.\w+ )*\.(entry|func)\b", (tmp_path / "lens.ptx").read_text(), re.MULTILINE) == ["entry"]


def test_the_command_writes_models_and_cameras(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, out, table = str(lens_models.exported("invariants")), tmp_path / "lens", tmp_path / "lens.outline.f32"
    for language in LANGUAGES if WHOLE else ("vex",):
        assert main(["export", file, "--to", language, "--name", "gauss", "-o", str(out)]) == 0
        text = out.read_text()
        assert "gauss_film_z_mm(" in text and "GAUSS_PUPIL_Z_MM" in text and "Status: 0 passed" in text
    words = ["--whole-camera", "--focus", "2", "--name", "cam", "-o", str(out)]
    for language in ("cuda", *LANGUAGES) if WHOLE else ("wgsl",):
        assert main(["export", file, "--to", language, *words]) == 0
        text = out.read_text()
        assert ("weight" in text and "CAM_EXPOSURE" in text) and table.exists() == (language != "cuda")
        table.unlink(missing_ok=language == "cuda")
    with pytest.raises(InputError, match="one state"):
        WRITERS["vex"](stated()[0], "lens", [])
    capsys.readouterr()
    for word in ("f32", "cvex", "let", "mad"):
        assert "no word of" in failure(capsys, "export", file, "--to", "wgsl", "--name", word, "-o", str(out))
