"""Footprints against closed forms, the parts of what is put together from known ones, and plans of extreme scenes."""

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from shipped import whole

from experiments.pictures.plans import WarpedByTables
from neurolens.base.errors import InputError
from neurolens.base.lensname import resolve
from neurolens.base.tomlfile import format_toml
from neurolens.cameras.build import make_camera
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.field import spectrum_of
from neurolens.cameras.ideal import Pinhole
from neurolens.cameras.reduced import Warped
from neurolens.cli import main
from neurolens.cli.plan import Planned
from neurolens.models.pairs import domain_of
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting import focusing
from neurolens.optics.setting.states import set_lens
from neurolens.pictures.render.pictures import read_exr
from neurolens.pictures.render.scene import load_scene, scene_from_tables
from neurolens.studies.plan import candidates as tried, costs, effects_plot
from neurolens.studies.plan.candidates import Target, candidates
from neurolens.studies.plan.costs import ALONE, Work, noise
from neurolens.studies.plan.footprints import (
    Footprints,
    blur_mm,
    centroids,
    distance_mm,
    effects_mm,
    footprints,
    light_beside,
    places_of,
)
from neurolens.studies.plan.plan import Plan, decided, plan
from neurolens.studies.plan.probe import Probe, effects_of, probe

LENS = "lenses/cooke_triplet_50.toml"  # of glass that absorbs
GAUSS = "lenses/laikin_double_gauss_50.toml"
NM, SHARE = np.array([450.0, 550.0, 650.0]), np.array([0.2, 0.5, 0.3])
FILM = np.array([[0.0, 5.0, 12.0, -9.0], [0.0, 3.0, -7.0, 8.0]])


def wall(distance_m: float, f_number: float | None = None, **camera: object) -> dict:
    more = {} if f_number is None else {"f_number": f_number}
    shot = {"position_m": [0.0, 0.0, 0.0], "look_at_m": [0.0, 0.0, -1.0], "focus_m": 3.0, "width": 640, "height": 360}
    return {
        "camera": {**shot, **more, **camera},
        "environment": {"colour": [1.0, 1.0, 1.0]},
        "materials": {"grey": {"kind": "diffuse", "reflectance": [0.5, 0.5, 0.5]}},
        "planes": [{"point_m": [0.0, 0.0, -distance_m], "normal": [0.0, 0.0, 1.0], "material": "grey"}],
    }


@pytest.mark.parametrize("depth_m", [0.7, 2.0, 5.0, math.inf])
def test_blur_of_a_thin_lens_is_its_circle_of_confusion(depth_m: float) -> None:
    camera = make_camera("thin", Shot((36.0, 24.0), 2.0, f_number=4.0))
    places = places_of(camera, FILM, np.full(4, depth_m), NM, SHARE)
    seen = footprints(camera, places, samples=48)
    image = 50 / (1 - 50 / (2000 - camera.settings["lens_state"]["pinhole_focal_length_mm"]))
    # Rays at the pupil's edge weigh less, by cos^4: the mean of r^2 under (1 + r^2 / s^2)^-2 over the disc, by sums.
    r2 = (np.arange(4000) + 0.5) / 4000 * (50 / 8) ** 2
    rms = math.sqrt(np.average(r2, weights=(1 + r2 / image**2) ** -2))
    near = 0.0 if math.isinf(depth_m) else 1 / (1000 * depth_m - image)
    expected = 2 * rms * image * abs(near - 1 / (2000 - image))
    assert blur_mm(seen, SHARE)[0] == pytest.approx(expected, rel=2e-3, abs=1e-6)


def disc(radius: float, shift: tuple[float, float] = (0.0, 0.0), n: int = 4000) -> Footprints:
    turn, r = np.arange(n) * 2.399963, np.sqrt((np.arange(n) + 0.5) / n)
    unit = np.stack([r * np.cos(turn), r * np.sin(turn)])
    place = radius * unit + np.array(shift)[:, None]
    row = np.broadcast_to(place[:, None, None], (2, 1, 3, n))
    return Footprints(row, np.broadcast_to(unit[:, None, None], row.shape), np.ones((1, 3, n)))


def test_distance_is_that_of_closed_forms() -> None:
    one = disc(1.0)
    assert distance_mm(one, one, SHARE)[0] == 0
    assert distance_mm(one, disc(1.0, (0.3, -0.4)), SHARE)[0] == pytest.approx(0.5, rel=1e-3)
    # Of discs the least way is along the radius: R - r times r/R, RMS (R - r) / sqrt 2.
    assert distance_mm(one, disc(0.4), SHARE)[0] == pytest.approx(0.6 / math.sqrt(2), rel=5e-3)
    dark = replace(one, weight=np.zeros_like(one.weight))
    assert np.isnan(distance_mm(one, dark, SHARE)[0])


def test_parts_are_what_was_put_in() -> None:
    thin = disc(0.0)
    x, y = thin.pupil_mm
    square, by_wave = x * x + y * y, np.array([[-1.6], [-0.1], [1.2333333]])  # of mean 0 by share
    extra = {
        "defocus": None,
        "spherical aberration": 0.02 * np.stack([x, y]) * (square - 2 / 3),  # balanced: its mean slope is 0
        "coma": 0.03 * np.stack([3 * x * x + y * y - 1, 2 * x * y]),
        "astigmatism": 0.05 * np.stack([x, -y]),
        "field curvature": 0.04 * np.stack([x, y]),
        "lateral colour": 0.01 * by_wave * np.stack([1 + 0 * x, 0 * x]),
        "longitudinal colour": 0.02 * np.stack([x, y]) * by_wave,
    }  # fmt: skip
    both = replace(thin, place_mm=thin.place_mm + sum(v for v in extra.values() if v is not None) + 0.2)
    found = effects_mm(both, thin, SHARE)
    assert found["distortion"][0] == pytest.approx(0.2 * math.sqrt(2), rel=1e-3)
    for name, value in extra.items():
        expected = 0.0 if value is None else math.sqrt(float(((value**2).sum(0).mean(-1) * SHARE).sum()))
        assert found[name][0] == pytest.approx(expected, rel=4e-3, abs=1e-4), name
    assert found["higher orders"][0] < 1e-4


def test_exact_footprints_are_the_spots_of_the_lens() -> None:
    from neurolens.optics.analysis.fields import Scene
    from neurolens.optics.analysis.spots import spots

    camera = make_camera(LENS, Shot((36.0, 24.0), math.inf, focus_mode="paraxial"))
    places = places_of(camera, np.array([[0.0], [0.0]]), np.array([math.inf]), np.array([587.56]), np.ones(1))
    lens = set_lens(read_lens(LENS))
    found = blur_mm(footprints(camera, places, samples=48), np.ones(1))[0] / 2
    assert 1000 * found == pytest.approx(spots(Scene(lens), [0.0], [587.56]).rms_um[0], rel=0.03)


def test_a_pupil_s_outline_serves_any_plane_and_tells_what_passes_beside_it() -> None:
    lens, film = read_lens(LENS), (24.0, 16.0)
    shot = Shot(film, 2.0, 8.0)
    camera, waves = ExactCamera(lens, shot), np.full(FILM.shape[1], 550.0, np.float32)
    outline, film_z = camera.film.outline, camera.film.film_z_mm
    stopped, other = set_lens(lens, f_number=8.0, focus_m=2.0), outline.pupil_z_mm - 15.0
    bounds = domain_of(stopped, film_radius_mm=math.hypot(*film) / 2, focus_m=(2.0, 2.0), pupil_z_mm=other).bounds
    searched, moved = ExactCamera(lens, shot, bounds=bounds).film.outline, outline.on_plane(other, film_z)
    for square in (np.full(FILM.shape, 0.5), np.full(FILM.shape, 0.9)):
        (there, area), (own, size) = (o.sample(FILM.astype(np.float32), square, waves) for o in (moved, searched))
        assert np.abs(there - own).max() < 0.03 and area == pytest.approx(size, rel=0.005)  # of radii of 2 mm and more
    places = places_of(camera, FILM, np.full(4, 4.0), NM, SHARE)
    light = footprints(camera, places).light
    assert (light_beside(camera, places) < 1e-3 * light).all()  # the outline holds all that passes
    camera.film.outline = replace(outline, x=0.98 * outline.x, y=0.98 * outline.y)
    camera.start("onnxruntime")  # made of the outline
    narrow = footprints(camera, places).light
    assert light_beside(camera, places) == pytest.approx(0.01 * narrow, rel=0.02)  # 0.5% of the radius, all of it lit


def test_what_a_shot_needs_falls_with_its_stop() -> None:
    lens = set_lens(read_lens(LENS))
    wide, small = (
        {e.name: e.worth for e in effects_of(probe(scene_from_tables(wall(4.0, n)), lens, across=4), 0.25)}
        for n in (None, 16.0)
    )
    assert (
        small["defocus"] < 0.5 * wide["defocus"] and small["spherical aberration"] < 0.1 * wide["spherical aberration"]
    )
    assert small["diffraction"] > 3 * wide["diffraction"]


@pytest.mark.parametrize("lens", ["canon_gauss_35", *whole("cooke_anamorphic_42")])
def test_a_warped_pinhole_shows_what_is_in_focus_where_the_lens_does(lens: str) -> None:
    shot = Shot((18.0, 10.0), 2.0, f_number=16.0)
    exact, hole = make_camera(f"lenses/{lens}.toml", shot), make_camera(f"pinhole:lenses/{lens}.toml", shot)
    assert isinstance(hole, Pinhole)
    flat, film = Warped(hole, exact, 2.0), 0.7 * FILM
    nanometres, light = spectrum_of(exact)
    share = light / light.sum()
    for depth_m, most in ((2.0, 5e-4), (0.5, math.inf)):  # what is nearer is seen from elsewhere
        places = places_of(exact, film, np.full(4, depth_m), nanometres, share)
        seen = footprints(exact, places)
        sharp = replace(seen, place_mm=np.broadcast_to(centroids(seen, share)[0][..., None, None], seen.place_mm.shape))
        apart, without = (distance_mm(sharp, footprints(c, places), share).max() for c in (flat, hole))
        assert apart < min(most, without)


def test_a_warped_picture_has_the_lens_s_light_in_its_corners() -> None:
    """The corners of a film of 16 to 9, which the distortion moves beyond what is seen within them."""
    shot = Shot((36.0, 20.25), 2.0, f_number=2.0)
    exact, flat = make_camera(GAUSS, shot), make_camera(f"thick:{GAUSS}", shot)
    warped = WarpedByTables(flat, exact, 2.0)
    square = np.random.default_rng(0).random((2, 20_000), np.float32)
    waves = np.linspace(420, 680, 20_000, dtype=np.float32)
    for x, y in ((17.97, 10.1), (-17.99, 10.12), (17.9, -10.0)):
        film = np.repeat(np.array([[x], [y]], np.float32), 20_000, axis=1)
        one, other = (c.sample(film, square, waves).weight.mean(dtype=np.float64) for c in (exact, warped))
        assert other == pytest.approx(one, rel=0.04)


@cache
def planned(budget: float, distance_m: float, f_number: float | None) -> Plan:
    film = {"film_width_mm": 28.0, "film_height_mm": 15.75}  # less than its circle of light, for the maps
    scene = scene_from_tables(wall(distance_m, f_number, **film))
    return plan(scene, set_lens(read_lens(LENS)), budget, target="c")


@pytest.mark.parametrize(
    ("budget", "distance_m", "f_number"), [(0.0, 4.0, None), (1e9, 0.12, 45.0), *whole((1e9, 4.0, 45.0))]
)
def test_budgets_at_the_extremes(budget: float, distance_m: float, f_number: float | None) -> None:
    """No budget leaves the exact lens; any budget, a point whose picture is warped, for it costs least as C. Where the
    rest of a path takes many times what a camera does, the exact lens stays, unless its dispersion adds noise."""
    found = planned(budget, distance_m, f_number)
    assert found.best is not None and found.best.light_error <= 0.01
    assert found.best.name in (("exact",) if budget == 0 else ("pinhole + ST map", "thick + ST map"))
    assert all(c.seconds >= found.best.seconds for c in found.choices if c.meets(budget))
    again = decided(found.probed, found.choices, budget, "render", Work((1e6, 1e6)))
    assert again.best is not None and again.best.name == "exact" and {found.best.name, "exact"} <= set(again.alike)
    parted = decided(found.probed, found.choices, budget, "render", Work((1e6, 1e6), noise=(1.0, 2.0)))
    assert parted.best is not None and parted.best.name == found.best.name
    assert budget == 0 or "exact" not in parted.alike


def test_bad_budgets_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="budget_px"):
        plan(scene_from_tables(wall(4.0)), set_lens(read_lens(LENS)), math.nan)
    for word in ("-1px", "nan", "1um", "1e99"):
        with pytest.raises(SystemExit) as ended:
            main(["plan", "experiments/scenes/room.toml", "--lens", LENS, "--budget", word, "-o", str(tmp_path)])
        assert ended.value.code == 2 and "pixels" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_noise_of_weights_is_how_many_times_the_rays_it_takes() -> None:
    rng, share = np.random.default_rng(5), np.array([0.3, 0.7])
    for passes in (1.0, 0.25):
        rays = 3.0 * (rng.random((2, 2, 200_000)) < passes)
        assert noise(rays, share) == pytest.approx(1 / passes, rel=0.01)
    assert noise(rng.random((3, 2, 200_000)), share) == pytest.approx(4 / 3, rel=0.01)  # mean 1/2, square 1/3
    # The mean of n rays of much varied light has the error of n / noise rays of even weight.
    weight, light = (rng.random((4000, 400)) < 0.2) / 0.2, rng.random((4000, 400)) ** -0.4
    plain, noisy = light.mean(1).var(), (weight * light).mean(1).var()
    deviation = light.var() / light.mean() ** 2
    assert noisy / plain == pytest.approx((5.0 * (1 + deviation) - 1) / deviation, rel=0.1)
    assert math.isinf(noise(np.zeros((2, 2, 8)), share))


@pytest.fixture(autouse=True, scope="module")
def quick() -> Iterator[None]:
    """Focus is found by fewer rays. Flare and glare are those of test_probe_light."""

    def unknown(*_: object) -> None:
        raise InputError("lens", "flare", "(not asked)", "another test")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("neurolens.studies.plan.probe.stray_light", unknown)
        patch.setattr(focusing, "_RINGS", 96)
        yield


@cache
def garden() -> Probe:
    return probe(load_scene(Path("experiments/scenes/garden.toml")), set_lens(read_lens(GAUSS)), across=4)


def test_a_thick_lens_whose_picture_is_warped_is_cheapest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As C it costs less than any polynomial; onnxruntime runs polynomials alone."""
    found = garden()
    monkeypatch.setattr(tried, "TERMS", (8,))
    targets: tuple[Target, ...] = ("c", "onnx")
    best = {t: decided(found, candidates(found, 1.0, t, folder=tmp_path), 1.0, t, ALONE).best for t in targets}
    assert best["c"] is not None and best["c"].name == "thick + ST map" and best["c"].error_px < 1
    assert best["onnx"] is not None and best["onnx"].name.endswith("shot-ols-8") and best["onnx"].error_px < 1


def test_a_warped_pinhole_lacks_the_blur_alone() -> None:
    """A wall in focus: places and light are right, so that its error is the RMS radius of the lens's footprints."""
    scene, lens = scene_from_tables(wall(3.0)), set_lens(read_lens(GAUSS))
    found = probe(scene, lens, across=8)
    choices = {c.name: c for c in candidates(found, 0.0, "render")}
    blur = np.percentile(blur_mm(found.seen, found.places.share) / 2, 95) / found.asked.pixel_mm
    assert choices["pinhole + ST map"].error_px == pytest.approx(blur, rel=0.02)
    assert choices["thick + ST map"].error_px == pytest.approx(blur, rel=0.02)  # in focus it is a point
    assert choices["pinhole"].error_px > 3 * blur
    # Exposure counts all wavelengths of light alike, and glass absorbs most at the violet end, where the eye sees
    # next to nothing: the rest is brighter than an ideal lens's by the same factor all over the film.
    nm, square = found.places.wavelength_nm, (np.stack(np.meshgrid(*2 * [np.arange(16)])).reshape(2, -1) + 0.5) / 16
    rays = np.zeros((2, 256 * nm.size)), np.tile(square, nm.size), np.repeat(nm, 256)
    brighter = found.exact.sample(*(v.astype(np.float32) for v in rays)).weight.mean() - 1
    assert 0 < brighter < 0.01
    assert abs(choices["pinhole + ST map"].light_error - brighter) < 0.0045 < choices["pinhole"].light_error / 8


def test_a_plan_s_file_is_taken_by_render_and_export(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The pictures of the file and of the model that it names agree."""
    drawn = list[object]()
    monkeypatch.setattr(effects_plot, "plot_effects", lambda made, path, title: drawn.append(path.name))
    monkeypatch.setattr(tried, "TERMS", (6,))
    scene, folder = tmp_path / "scene.toml", tmp_path / "plan"
    film = {"film_width_mm": 18.0, "film_height_mm": 10.125, "width": 64, "height": 36, "samples": 2}
    scene.write_text(format_toml(wall(4.0, 4.0, **film)))
    lens = tmp_path / "own.toml"  # no model of it ships
    lens.write_bytes(Path(LENS).read_bytes())
    asked = ["--lens", str(lens), "--budget", "0.03px", "--for", "onnx", "-o", str(folder), "--quiet"]
    assert main(["plan", str(scene), *asked]) == 0 and drawn == ["effects.png"]
    record = json.loads((folder / "plan.json").read_text())
    assert record["best"] in record["choices"]
    assert (
        record["asked"]["f_number"] == pytest.approx(5, rel=1e-3)
        and record["best"]["error_px"] <= record["budget_px"] == 0.03
    )
    file, model = folder / "plan.toml", next((folder / "models").glob("*.onnx"))
    pictures = [tmp_path / f"{k}.exr" for k in range(2)]
    for camera, picture in zip((file, model), pictures, strict=True):
        assert main(["render", str(scene), "--camera", str(camera), "-o", str(picture), "--quiet"]) == 0
    np.testing.assert_allclose(*(read_exr(p)[0] for p in pictures), rtol=1e-3, atol=1e-4)
    assert main(["export", str(file), "--to", "c", "-o", str(tmp_path / "lens.h")]) == 0
    assert "film radius 10.3" in (tmp_path / "lens.h").read_text().lower()  # of the shot


def test_a_plan_s_file_names_cameras_that_nothing_is_fitted_for(tmp_path: Path) -> None:
    found = planned(0.0, 4.0, None)
    file = tmp_path / "plan.toml"
    file.write_text(found.to_toml(tmp_path))
    assert Path(str(resolve(file)).removeprefix("fused:")).resolve() == Path(LENS).resolve()
    assert str(resolve("experiments/quickstart.toml")) == "experiments/quickstart.toml"


def test_models_have_the_blades_of_the_lens_file() -> None:
    shaped = read_lens(GAUSS).with_aperture(Aperture(blades=5, rotation_deg=20.0))
    found = probe(scene_from_tables(wall(1.0, 4.0)), shaped, across=3)
    model = Path("models/laikin_double_gauss_50.ols-60.onnx")
    shot = replace(found.shot, aperture=None)
    own, bare = (
        next(c for c in tried.candidates(seen, 0.01, "onnx", models=[model]) if c.camera == str(model))
        for seen in (found, replace(found, shot=shot))
    )
    assert own.error_px < 0.05 and own.light_error < 0.01 and bare.error_px > 0.3


def test_a_plan_prints_one_price_and_says_first_where_it_took_more_than_a_tenth_of_it() -> None:
    found = planned(0.0, 4.0, None)
    assert found.best is not None
    work = Work((10.0, 10.0), (1.0, 1.0))
    told = Planned("", "", replace(found, work=work, best=replace(found.best, seconds=20.0)), 1.9, "", True, Path())
    text = told.text()
    assert text.count("about 20 s") == 1 and " ns" not in text and text.startswith("f/")
    assert replace(told, plan_s=300.0).text().startswith("This plan took 300 CPU seconds, 15 times its picture")
    alone = replace(told, plan_s=300.0, plan=found)
    assert alone.text().startswith("f/")  # the time of the picture is not known


@pytest.mark.parametrize("shot", [(96, 54, 16), (640, 360, 16), (640, 360, 256), (1920, 1080, 1024), (8, 1, 1)])
def test_strips_are_a_little_of_the_picture_and_apart(shot: tuple[int, int, int]) -> None:
    width, height, samples = shot
    film = {"film_width_mm": 36.0, "film_height_mm": 36.0 * height / width}
    paths, used = width * height * samples // costs._PART, min(samples, 16)
    strips = costs.strips_of(scene_from_tables(wall(4.0, width=width, height=height, **film)), paths, used)
    rows = [row for first, stop in strips for row in range(first, stop)]
    assert rows and len({*rows}) == len(rows) and 0 <= min(rows) <= max(rows) < height
    assert len(rows) == 1 or len(rows) * width * used <= paths


def test_light_that_the_lens_adds_is_looked_for_where_a_tenth_of_the_picture_has_room_for_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = planned(0.0, 4.0, None)
    seen = list[object]()

    def known(*_: object) -> dict[str, np.ndarray]:
        seen.append(1)
        return {"flare": np.full((2, 3), 0.5)}

    monkeypatch.setattr("neurolens.studies.plan.probe.stray_light", known)
    for ns, looked in ((1.0, False), (1e6, True)):
        made = decided(found.probed, found.choices, 0.0, "render", Work((ns, ns)), explain=False)
        assert made.best is not None and (0.1 * made.best.seconds > 20) == looked == bool(seen)
        assert [e.worth for e in made.effects if e.name == "flare"] == [0.5] * looked
        text = Planned("", "", made, 0.0, "", False, Path()).text()
        assert ("--explain looks for it" in text) != looked and ("No camera makes flare" in text) == looked
