"""Fitted ghosts: against the exact ones, in every form they are written in, and what their files may not hold."""

import ctypes
import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest

from neurolens.base.errors import InputError, ModelError
from neurolens.cli import main
from neurolens.flare import ghostfit
from neurolens.flare.canvas import Raster
from neurolens.flare.ghostfit import GhostSettings, fit_ghosts
from neurolens.flare.ghostmodel import GhostModel, output_of, read_ghosts, write_ghost_source, write_ghosts
from neurolens.flare.ghosts import GhostTracer, Pair
from neurolens.flare.lights import Light, light_rays
from neurolens.flare.picture import ghost_picture
from neurolens.graph.compiler import compile_c
from neurolens.lens.apertures import Aperture
from neurolens.lens.prescription import Lens
from neurolens.readers.lensfile import read_lens
from neurolens.render.pictures import read_exr
from neurolens.setting.states import set_lens
from neurolens.surrogates.card import CARD_KEY, MODEL_KEY
from neurolens.surrogates.source import identifier

LENS = Path(__file__).parents[2] / "lenses" / "brendel_tessar_100.toml"
SETTINGS = GhostSettings(angle_deg=25.0, keep=0.8, rays=2000, target_um=60.0)


def tessar(**state: float) -> Lens:
    return set_lens(read_lens(LENS), focus_m=math.inf, **state)


@pytest.fixture(scope="module")
def model() -> GhostModel:
    return fit_ghosts(tessar(), SETTINGS)


@pytest.fixture(scope="module")
def file(model: GhostModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_ghosts(model, tmp_path_factory.mktemp("ghosts") / "tessar.onnx")


def lit_rays(model: GhostModel, number: int, count: int = 500) -> np.ndarray:
    """Directions and places [4, N] where a ghost has its light; light from everywhere."""
    rng, ghost = np.random.default_rng(number), model.ghosts[number]
    p = rng.uniform(-0.6, 0.6, (2, count))
    place = ghost.chief_mm[:, None] * p + 0.9 * ghost.scale_mm[:, None] * rng.uniform(-1, 1, (2, count))
    return np.concatenate([model.sine * p, place])


def in_glsl(model: GhostModel, number: int, rays: np.ndarray, folder: Path) -> np.ndarray | None:
    """Results [4, N] of a ghost's function for rays [6, N], by a software OpenGL; None where there is none."""
    text = write_ghost_source(model, folder / "ghosts.glsl").read_text()
    called = f"{identifier(model.lens.lens_id)}_{output_of(model.pairs[number])}"
    given = ", ".join([*(f"rays[{k}u * n + i]" for k in range(6)), *(f"o[{k}]" for k in range(4))])
    (folder / "ghost.comp").write_text(
        "#version 430\nlayout(local_size_x = 64) in;\n"
        "layout(std430, binding = 0) readonly buffer A { float rays[]; };\n"
        f"layout(std430, binding = 1) writeonly buffer B {{ float found[]; }};\n{text}\nvoid main() {{\n"
        "    uint i = gl_GlobalInvocationID.x, n = uint(rays.length()) / 6u;\n    if (i >= n) return;\n"
        f"    float o[4];\n    {called}({given});\n    for (uint k = 0u; k < 4u; k++) found[k * n + i] = o[k];\n}}\n"
    )
    np.save(folder / "rays.npy", rays.astype(np.float32))
    runner = Path(__file__).parents[2] / "experiments" / "gl_compute.py"
    words = [runner, folder / "ghost.comp", folder / "rays.npy", folder / "found.npy", "4"]
    ran = subprocess.run([sys.executable, *map(str, words)], capture_output=True, text=True)
    assert ran.returncode in (0, 3), ran.stderr
    return None if ran.returncode else np.load(folder / "found.npy")


def test_the_fit_is_what_it_says(model: GhostModel) -> None:
    """On rays of a light that the fit never saw: places, energy and who passes, of every ghost; and at a smaller stop
    with blades, for which nothing was fitted."""
    assert 2 < model.report["kept"] < model.report["pairs"] == 21 and 0.8 <= model.report["kept_energy"] < 1
    light = Light(9.0, -7.0)
    for lens in (tessar(), replace(tessar(f_number=8.0), aperture=Aperture(blades=5, rotation_deg=10.0))):
        tracer, fitted = GhostTracer(lens, model.pairs), replace(model, lens=lens)
        rays, _ = light_rays(lens, light, 0, 40_000)
        exact, found = tracer.trace(rays, 520.0), fitted.trace(rays, 520.0)
        on_film = np.hypot(*np.moveaxis(exact.film_xy_mm, 1, 0)) < SETTINGS.film_radius_mm
        both = on_film & (exact.power > 0) & (found.power > 0)
        off = np.where(both, np.hypot(*np.moveaxis(found.film_xy_mm - exact.film_xy_mm, 1, 0)), 0)
        weight = np.where(both, exact.power, 0).astype(np.float64)
        assert 1e3 * math.sqrt((weight * off**2).sum() / weight.sum()) < 3 * model.report["film_rms_um"]
        light_there = [np.where(on_film, r.power, 0).sum(dtype=np.float64) for r in (exact, found)]
        assert light_there[1] == pytest.approx(light_there[0], rel=0.03)
        wrong = ((exact.power > 0) != (found.power > 0)) & on_film
        assert wrong.sum() < 0.03 * both.sum()


def test_all_forms_agree(model: GhostModel, file: Path, tmp_path: Path) -> None:
    """Compiled for one direction, for any direction, from the file, in onnxruntime, as C99 source; GLSL is written."""
    stored = read_ghosts(file)
    assert stored.pairs == model.pairs and stored.lens.sha256 == model.lens.sha256
    session = onnxruntime.InferenceSession(str(file))
    header = write_ghost_source(model, tmp_path / "ghosts.h")
    library, first = tmp_path / "ghosts.so", f"brendel_tessar_100_{output_of(model.pairs[0])}"
    call = f"{first}_ray v = {first}(r[0], r[1], r[2], r[3], r[4], stop);"
    gives = "o[0] = v.film_x_mm; o[1] = v.film_y_mm; o[2] = v.power; o[3] = v.worst;"
    assert not compile_c(
        f"{header.read_text()}\nvoid one(const float *r, float stop, float *o) {{ {call} {gives} }}", library
    )
    radius = np.array([0.8 * model.stop_radius_mm], np.float32)
    lens = replace(model.lens, surfaces=tuple(
        replace(s, diameter_mm=0.8 * s.diameter_mm) if s.stop else s for s in model.lens.surfaces
    ))  # fmt: skip
    for number, pair in enumerate(model.pairs[:3]):
        start = lit_rays(model, number)
        closed, again = replace(model, lens=lens), replace(stored, lens=lens)
        general = closed.follow_each(start, [480.0, 610.0], pair)
        lit = general[:, 3] < 1
        assert 0.05 < lit.mean() < 1
        alike = np.stack(
            [closed.follow_each(one[:, None], [480.0, 610.0], pair)[..., 0] for one in start[:, :60].T], -1
        )
        given = {
            "entering": np.concatenate([start, np.full((1, 500), 480.0)]).astype(np.float32),
            "stop_radius_mm": radius,
        }
        onnx_found = session.run([output_of(pair)], given)[0]
        drawn = in_glsl(model, number, np.concatenate([given["entering"], np.full((1, 500), radius[0])]), tmp_path)
        for found, wanted in (
            (alike, general[..., :60]),
            (again.follow_each(start, [480.0, 610.0], pair), general),
            (onnx_found[None], general[:1]),
            (onnx_found[None] if drawn is None else drawn[None], general[:1]),
        ):
            here = lit[: len(found), : found.shape[-1]]
            for row, least in enumerate((2e-3, 2e-3, 1e-7, 1e-5)):  # mm, share, r^2 / R^2
                np.testing.assert_allclose(found[:, row][here], wanted[:, row][here], rtol=1e-4, atol=least)
        if number == 0:
            one = ctypes.CDLL(str(library)).one
            one.argtypes = [ctypes.c_void_p, ctypes.c_float, ctypes.c_void_p]
            row = np.empty(4, np.float32)
            for ray, wanted in zip(given["entering"].T.copy()[:40], general[0].T, strict=False):
                one(ray.ctypes.data, radius[0], row.ctypes.data)
                if wanted[3] < 1:
                    np.testing.assert_allclose(row, wanted, rtol=1e-4, atol=2e-3)


def test_ghosts_of_one_term_compile() -> None:
    """Their four results need more room than their terms: rays of one direction, compiled, and of many agree."""
    lens = set_lens(read_lens(LENS.with_name("laikin_double_gauss_50.toml")), focus_m=math.inf)
    model = fit_ghosts(lens, replace(SETTINGS, keep=0.3, rays=1000, target_um=1000.0))
    constant = [(g.exponents == 0).all(1) for g in model.ghosts]
    pairs = zip(model.ghosts, constant, strict=True)
    ghosts = tuple(replace(g, exponents=g.exponents[k], ab=g.ab[..., k], power=g.power[k]) for g, k in pairs)
    places = np.random.default_rng(1).uniform(-12, 12, (2, 500))
    start = np.concatenate([np.broadcast_to([[0.2], [0.1]], places.shape), places])
    alone = np.concatenate([start, start[:, :1] * [[0.9], [1], [1], [1]]], axis=1)  # one ray of another direction
    first_order = replace(model, ghosts=ghosts)
    for pair in model.pairs:
        compiled, other = (first_order.follow_each(s, [550.0], pair)[0][:, :500] for s in (start, alone))
        here = (compiled[3] < 4) & (other[3] < 4)
        assert here.sum() > 300 and np.abs(compiled - other)[:, here].max() < 1e-4, pair


def test_ghosts_that_too_few_rays_show_are_left_out_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a zoom at one state: light of some ghosts comes through a part of all directions that hardly a ray meets."""
    lens = set_lens(set_lens(read_lens(LENS.with_name("ogawa_zoom_70_200.toml")), zoom=100.0), focus_m=math.inf)
    monkeypatch.setattr(ghostfit, "ghost_pairs", lambda lens: (Pair(14, 15), Pair(10, 22)))
    found = fit_ghosts(lens, GhostSettings(keep=1.0, rays=1000, target_um=100.0))
    assert found.pairs == (Pair(14, 15),) and found.report["pairs"] == 2
    assert 0.99 < found.report["kept_energy"] < 1


def test_symmetry_is_exact(model: GhostModel) -> None:
    """A turned light is a turned ghost."""
    start, turn = lit_rays(model, 0, 50), 2.1
    matrix = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    turned = np.concatenate([matrix @ start[:2], matrix @ start[2:]])
    a, b = (model.follow_each(rays, [550.0], model.pairs[0])[0] for rays in (start, turned))
    np.testing.assert_allclose(b[:2], matrix @ a[:2], atol=1e-4)
    np.testing.assert_allclose(b[2:], a[2:], rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("distance_m", [math.inf, 4.0])
def test_pictures_are_those_of_traced_ghosts(model: GhostModel, distance_m: float) -> None:
    light, raster = [Light(9.0, 4.0, distance_m=distance_m)], Raster((36.0, 24.0), 72, 48)
    pictures = [
        ghost_picture(t, light, raster, wavelengths=2, threads=1)[0]
        for t in (GhostTracer(tessar(), model.pairs), model)
    ]
    assert pictures[1].sum() == pytest.approx(pictures[0].sum(), rel=0.02)
    blocks = [p.reshape(8, 6, 9, 8, 3).sum((1, 3)) for p in pictures]
    assert np.abs(blocks[1] - blocks[0]).sum() < 0.04 * blocks[0].sum()


@pytest.mark.whole  # another kind of lens
def test_lenses_with_cylinders(tmp_path: Path) -> None:
    """Against the exact ghosts of a light that the fit never saw, also stopped down; compiled for one direction and for
    any, from the file and in onnxruntime; mirrored light is a mirrored ghost, light turned by 90 degrees another."""
    lens = set_lens(read_lens(LENS.with_name("schneider_anamorphic_31.toml")), focus_m=math.inf)
    settings = replace(SETTINGS, angle_deg=15.0, keep=0.15, film_radius_mm=12.0)
    fitted = fit_ghosts(lens, settings)
    stored = read_ghosts(write_ghosts(fitted, tmp_path / "anamorphic.onnx"))
    session = onnxruntime.InferenceSession(str(tmp_path / "anamorphic.onnx"))
    assert len(fitted.pairs) >= 3 and fitted.report["film_rms_um"] < 120
    for f_number in (None, 8.0):
        closed = replace(fitted, lens=lens if f_number is None else set_lens(lens, f_number=f_number))
        tracer = GhostTracer(closed.lens, fitted.pairs)
        rays, _ = light_rays(lens, Light(7.0, -5.0), 0, 20_000)
        exact, found = tracer.trace(rays, 520.0), closed.trace(rays, 520.0)
        there = np.hypot(*np.moveaxis(exact.film_xy_mm, 1, 0)) < settings.film_radius_mm
        light = [np.where(there, r.power, 0).sum(1, dtype=np.float64) for r in (exact, found)]
        assert light[1] == pytest.approx(light[0], rel=0.06, abs=0.01 * light[0].max())
        both = there & (exact.power > 0) & (found.power > 0)
        off = np.hypot(*np.moveaxis(found.film_xy_mm - exact.film_xy_mm, 1, 0))[both]
        assert np.sqrt((off**2).mean()) < 0.3
    for number, pair in enumerate(fitted.pairs[:2]):
        start = lit_rays(fitted, number, 200)
        general = fitted.follow_each(start, [480.0], pair)[0]
        lit = general[3] < 1
        alike = np.stack([fitted.follow_each(one[:, None], [480.0], pair)[0, :, 0] for one in start[:, :60].T], -1)
        given = np.concatenate([start, np.full((1, 200), 480.0)]).astype(np.float32)
        radius = np.array([fitted.stop_radius_mm], np.float32)
        onnx_found = session.run([output_of(pair)], {"entering": given, "stop_radius_mm": radius})[0]
        assert 0.05 < lit.mean() < 1
        drawn = in_glsl(fitted, number, np.concatenate([given, np.full((1, 200), radius[0])]), tmp_path)
        more = [] if drawn is None else [drawn]
        for other in (alike, stored.follow_each(start, [480.0], pair)[0], onnx_found, *more):
            here = lit[: other.shape[1]]
            np.testing.assert_allclose(other[:2, here], general[:2, : len(here)][:, here], rtol=1e-4, atol=5e-3)
            np.testing.assert_allclose(other[2, here], general[2, : len(here)][here], rtol=1e-3, atol=1e-7)
        for flip in ([-1, 1], [1, -1]):
            mirrored = fitted.follow_each(start * np.array(flip * 2)[:, None], [480.0], pair)[0]
            np.testing.assert_allclose(mirrored[:2], general[:2] * np.array(flip)[:, None], rtol=1e-5, atol=1e-4)
        turned = fitted.follow_each(start[[1, 0, 3, 2]], [480.0], pair)[0]
        assert np.abs(turned[[1, 0]] - general[:2])[:, lit].max() > 0.1


def test_command(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "flare.exr"
    small = ["--light", "9,4", "--width", "36", "--bins", "2", "--blades", "6", "--f-number", "8", "--json"]
    assert main(["flare", str(file), *small, "-o", str(out)]) == 0
    assert json.loads(capsys.readouterr().out)["lens"] == tessar().name and out.is_file()
    # The table is the model's own: its ghosts, and their light as it has it.
    assert main(["flare", str(file), "--light", "9,4,1", "--json"]) == 0  # a point
    (rows,) = json.loads(capsys.readouterr().out)["ghosts"]
    fitted = read_ghosts(file)
    rays, _ = light_rays(fitted.lens, Light(9.0, 4.0), 0, 4096)
    image = GhostTracer(fitted.lens, []).trace(rays, 550.0, direct=True).power.astype(float).sum()
    light = fitted.trace(rays, 550.0).power.astype(float).sum(1) / image
    energies = {p.name: float(v) for p, v in zip(fitted.pairs, light, strict=True) if v > 0}
    assert {r["name"]: r["energy"] for r in rows} == pytest.approx(energies)
    # Frames, stars and glare go with it; of each frame the stop is its own. A film beyond the fit is told.
    (keys := tmp_path / "sun.csv").write_text("light,frame,azimuth_deg,elevation_deg\na,1,-9,4\na,2,9,4\n")
    words = ["--lights", str(keys), "--frames", "1:2", "--key", "f-number=1:8,2:16", "--width", "24"]
    more = ["--bins", "2", "--starburst", "--glare", "500", "--gain", "ghosts=2", "--film", "45x30"]
    assert main(["flare", str(file), *words, *more, "-o", str(out)]) == 0
    assert "fitted up to 21.64 mm" in capsys.readouterr().err
    open_stop, closed = (read_exr(tmp_path / f"flare.000{k}.exr")[0].sum() for k in (1, 2))
    assert min(open_stop, closed) > 0 and closed != pytest.approx(open_stop, rel=0.01)
    assert main(["flare", str(file), "--light", "9,4"]) == 0
    assert "21 pairs of surfaces" in (said := capsys.readouterr().out) and "the table is of the fit" in said
    assert main(["flare", str(file), "--fit", str(tmp_path / "g.h")]) == 0
    assert "um RMS on the film" in capsys.readouterr().out
    for words, said in (
        (["--light", "40,0"], "at most 25"),
        (["--light", "1,0", "--coating", "v-coat"], "--coating"),
        (["--light", "1,0", "--focus", "1"], "--focus"),
        (["--light", "1,0", "--frames", "1:2", "--key", "focus=1:1,2:2"], "--key focus"),
        (["--light", "1,0", "--frames", "1:2", "--key", "zoom=1:90,2:100"], "--key zoom"),
        (["--light", "1,0", "--f-number", "1"], "stop_radius_mm"),
        (["--fit", "x.onnx"], "--fit"),
        (["--fit", "x.h", "--light", "1,0"], "no --light beside it"),
        (["--fit", "x.h", "--frames", "1:2"], "beside it"),
    ):
        assert main(["flare", str(file), *words, "-o", str(out), "--width", "24"]) == 2
        assert said in capsys.readouterr().err


def test_what_files_may_not_hold(file: Path, tmp_path: Path) -> None:
    """Changed coefficients, another kind of model, a card without domain, no ONNX at all."""
    bad = tmp_path / "bad.onnx"

    def changed(key: str, change: object) -> None:
        proto = onnx.load(file)
        for entry in proto.metadata_props:
            if entry.key == key:
                entry.value = change(entry.value)  # type: ignore[operator]
        onnx.save(proto, bad)
        with pytest.raises(ModelError, match="bad.onnx"):
            read_ghosts(bad)

    def card(place: str, value: object) -> object:
        return lambda text: json.dumps({**json.loads(text), place: value})

    changed(CARD_KEY, card("kind", "neurolens.lens_model"))
    changed(CARD_KEY, card("domain", {"sine": 0.4}))
    changed(CARD_KEY, card("domain", {"sine": 0.3, "wavelength_nm": [400, 700]}))
    changed(MODEL_KEY, lambda text: text[:-40])
    changed(MODEL_KEY, lambda text: "")
    bad.write_bytes(b"no model")
    with pytest.raises(ModelError, match="bad.onnx"):
        read_ghosts(bad)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (replace(SETTINGS, angle_deg=90.0), "angle_deg"),
        (replace(SETTINGS, keep=1.5), "keep"),
        (replace(SETTINGS, rays=10), "rays"),
        (replace(SETTINGS, film_radius_mm=1e-9), "reaches the film"),
    ],
)
def test_refused_settings(settings: GhostSettings, said: str) -> None:
    with pytest.raises(InputError, match=said):
        fit_ghosts(tessar(), settings)


def test_refused_lenses_and_light(model: GhostModel) -> None:
    masked = replace(tessar(), aperture=Aperture(mask=np.eye(8)))
    for call in (lambda: fit_ghosts(masked, SETTINGS), lambda: replace(model, lens=masked)):
        with pytest.raises(InputError, match="mask"):
            call()
    rays, _ = light_rays(model.lens, Light(3.0, 0.0), 0, 10)
    with pytest.raises(InputError, match="wavelength_nm"):
        model.trace(rays, 380.0)
    rays, _ = light_rays(model.lens, Light(30.0, 0.0), 0, 10)
    with pytest.raises(InputError, match="off the axis"):
        model.trace(rays, 550.0)
