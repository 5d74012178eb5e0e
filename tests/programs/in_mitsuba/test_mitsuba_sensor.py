"""The sensor inside Mitsuba 3: white furnace, Mitsuba's own cameras, our renderer, wavelengths, files and mistakes.

Skipped where the extra "mitsuba", or for its compiled variants libLLVM, is not installed. (The folder is not called
mitsuba, which Python would then take for the package.)
"""

import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from experiments.peers.mitsuba_scenes import our_scene, with_our_spectra
from neurolens.base.errors import InputError, NeurolensError
from neurolens.cameras.build import make_camera
from neurolens.cameras.contract import Camera, FloatArray
from neurolens.cameras.ideal import Pinhole, ThinLens
from neurolens.cli import main
from neurolens.optics.lens.shot import Shot
from neurolens.pictures.render.pictures import read_exr
from neurolens.pictures.render.renderer import render as our_render
from neurolens.pictures.render.scene import scene_from_tables
from neurolens.programs.mitsuba import load_scene, register, render, require_mitsuba

pytest.importorskip("mitsuba", reason='needs the extra "mitsuba"')

MODEL = Path(__file__).parents[3] / "models" / "laikin_double_gauss_50.mlp-10x1.onnx"
LLVM = ("llvm_ad_rgb", "llvm_ad_spectral")
SIZE = 32


def variant(name: str) -> Any:
    try:
        return require_mitsuba(name)
    except NeurolensError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def lens() -> Camera:
    """A real lens, wide open, on a film that it vignettes."""
    return make_camera(MODEL, Shot((26.0, 26.0), 3.9, 2.0))


def furnace(mi: Any, size: int) -> dict[str, Any]:
    """A uniform white environment."""
    return {
        "type": "scene",
        "integrator": {"type": "path"},
        "sensor": {"type": "perspective", "film": box_film(size), "sampler": {"type": "independent"}},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}},
    }


def box_film(size: int, **more: Any) -> dict[str, Any]:
    return {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, **more}


def cornell(mi: Any, *, grey: bool) -> dict[str, Any]:
    """Mitsuba's own Cornell box, small, its colours made grey where two ways to mix them would differ."""
    scene = mi.cornell_box()
    scene["sensor"]["film"] = box_film(SIZE)
    scene["integrator"]["max_depth"] = 3
    if grey:
        for item in scene.values():
            if isinstance(item, dict) and item["type"] == "diffuse":
                item["reflectance"]["value"] = float(np.mean(item["reflectance"]["value"]))
        scene["light"]["emitter"]["radiance"]["value"] = 14.0
    return scene


def regions(pictures: list[FloatArray]) -> np.ndarray:
    """Means of 4 x 4 parts of each picture: [runs, 4, 4, 3]."""
    whole = np.stack(pictures)
    return whole.reshape(len(whole), 4, SIZE // 4, 4, SIZE // 4, 3).mean(axis=(2, 4))


def assert_same(a: list[FloatArray], b: list[FloatArray], *, share: float = 0.01) -> None:
    """Every part of the picture and every channel agrees within five standard errors and `share` of its brightness."""
    x, y = regions(a), regions(b)
    error = np.sqrt(x.var(axis=0, ddof=1) / len(x) + y.var(axis=0, ddof=1) / len(y))
    brightness = y.mean(axis=0).max(axis=-1, keepdims=True)
    assert (error < 0.08 * brightness).all(), "too noisy to say"
    off = np.abs(x.mean(axis=0) - y.mean(axis=0))
    assert (off < 5 * error + share * brightness).all(), (off / brightness).max()


def our_white(size: int, film_mm: float, lens: Camera, samples: int) -> FloatArray:
    camera = {"position_m": [0, 0, 0], "look_at_m": [0, 0, 1], "focus_m": 3.9, "width": size, "height": size}
    white = {"camera": camera | {"film_width_mm": film_mm, "film_height_mm": film_mm}}
    white |= {"environment": {"colour": [1.0, 1.0, 1.0]}}
    return our_render(scene_from_tables(white), lens, samples=samples, threads=1).rgb


@pytest.mark.parametrize("name", LLVM)
def test_white_stays_white_and_falls_off_as_ours(name: str, lens: Camera) -> None:
    mi = variant(name)
    seen = render(load_scene(furnace(mi, SIZE)), lens, spp=64)
    ours = our_white(SIZE, 26.0, lens, 64)
    # A sample of one wavelength spreads by about 1.5 in each channel; a region has 4096, the picture 65536.
    np.testing.assert_allclose(regions([seen])[0], regions([ours])[0], atol=0.1)
    np.testing.assert_allclose(seen.mean(axis=(0, 1)), ours.mean(axis=(0, 1)), atol=0.02)
    assert seen[0, 0].mean() < 0.85  # vignetted


def test_white_has_the_tint_of_the_coatings_where_the_lens_disperses(lens: Camera) -> None:
    # On a fine film the four lanes are one wavelength; a crop around the axis.
    mi = variant("llvm_ad_spectral")
    scene = furnace(mi, 1024)
    scene["sensor"]["film"] |= {"crop_width": 32, "crop_height": 32, "crop_offset_x": 496, "crop_offset_y": 496}
    seen = render(load_scene(scene), lens, spp=64)
    axis = make_camera(MODEL, Shot((26.0 / 32, 26.0 / 32), 3.9, 2.0))
    tint = our_white(32, 26.0 / 32, axis, 256).mean(axis=(0, 1))
    np.testing.assert_allclose(seen.mean(axis=(0, 1)), tint, atol=0.004)
    assert tint[1] - tint[2] > 0.02  # blue is dimmed more than green
    assert seen.std() < 0.1  # independent wavelengths leave colour noise of 0.19


@pytest.mark.parametrize("name", ["scalar_rgb", "scalar_spectral"])
def test_scalar_variants_see_the_same_white(name: str) -> None:
    mi = variant(name)
    seen = render(load_scene(furnace(mi, 2)), ThinLens(50.0, 2.0, 3.9, (26.0, 26.0)), spp=16)
    np.testing.assert_allclose(seen.mean(), 0.92, atol=0.1)  # cos^4 over the film
    chosen = make_camera(MODEL, Shot((2.0, 2.0), 3.9, 2.0))
    seen = render(load_scene(furnace(mi, 2)), chosen, spp=32)
    np.testing.assert_allclose(seen.mean(), 1, atol=0.2)


@pytest.mark.parametrize("name", LLVM)
def test_the_picture_is_that_of_our_renderer(name: str, lens: Camera) -> None:
    mi = variant(name)
    spectral = "spectral" in name
    box = cornell(mi, grey=not spectral)
    scene, ours = load_scene(with_our_spectra(box) if spectral else box), our_scene(box, lens.film_mm)
    theirs = [render(scene, lens, spp=48, seed=k) for k in range(4)]
    assert_same(theirs, [our_render(ours, lens, samples=32, seed=k, threads=1).rgb for k in range(4)])


def test_thin_lens_and_pinhole_are_mitsubas_own() -> None:
    mi = variant("llvm_ad_rgb")
    film, focus = 24.0, 3.0
    box = cornell(mi, grey=True)
    fov = 2 * math.degrees(math.atan(film / 2 / 50))
    place = box["sensor"]["to_world"]
    for ideal in (Pinhole(50.0, (film, film)), ThinLens(50.0, 0.5, focus, (film, film))):
        behind = getattr(ideal, "image_distance_mm", 50.0)
        if isinstance(ideal, ThinLens):
            fov = 2 * math.degrees(math.atan(film / 2 / behind))
            more = {"type": "thinlens", "aperture_radius": 1e-3 * ideal.radius_mm}
            more["focus_distance"] = focus - 1e-3 * behind
        else:
            more = {"type": "perspective"}
        own = {"to_world": place, "fov": fov, "film": box_film(SIZE), **more}
        scene = load_scene({**box, "sensor": own})
        back = place @ mi.ScalarTransform4f().translate([0, 0, -1e-3 * behind])
        ours = [render(scene, ideal, spp=48, seed=k, to_world=back) for k in range(4)]
        # Mitsuba's cameras know no natural vignetting: what our white card has is put on their pictures.
        white = render(load_scene(furnace(mi, SIZE)), ideal, spp=64)
        assert_same(ours, [white * np.array(mi.render(scene, spp=48, seed=k)) for k in range(4)], share=0.02)


def test_lanes_share_a_wavelength_only_where_the_lens_disperses(lens: Camera) -> None:
    mi = variant("llvm_ad_spectral")
    made, scene = register(), load_scene(furnace(mi, 1024))
    props = mi.Properties("neurolens")
    props["film"] = scene.sensors()[0].film()
    points = mi.Point2f(mi.Float([0.5, 0.4]), mi.Float([0.5, 0.6]))
    for ideal, alike in ((lens, True), (ThinLens(50, 2, 3.9, (26.0, 26.0)), False)):
        ray, weight = made(props, ideal).sample_ray(0.0, mi.Float([0.1, 0.9]), points, points)
        nm, worth = np.array(ray.wavelengths), np.array(weight)
        assert nm.shape == worth.shape == (4, 2) and (worth > 0).all()
        assert bool(np.all(nm == nm[0])) is alike
        np.testing.assert_allclose(np.linalg.norm(np.array(ray.d), axis=0), 1, atol=1e-5)


def test_crops_and_units_show_the_same_scene(lens: Camera) -> None:
    mi = variant("llvm_ad_rgb")
    box = cornell(mi, grey=True)
    whole = render(load_scene(box), lens, spp=64)
    corner = {"crop_width": 8, "crop_height": 16, "crop_offset_x": 20, "crop_offset_y": 4}
    part = render(load_scene({**box, "sensor": {**box["sensor"], "film": box_film(SIZE, **corner)}}), lens, spp=64)
    assert part.shape == (16, 8, 3)
    np.testing.assert_allclose(part.mean(), whole[4:20, 20:28].mean(), rtol=0.05)
    large = {**box, "sensor": dict(box["sensor"])}
    grown = mi.ScalarTransform4f().scale(1000)
    for name, item in large.items():
        if isinstance(item, dict) and "to_world" in item and name != "sensor":
            large[name] = {**item, "to_world": grown @ item["to_world"]}
    large["sensor"]["to_world"] = mi.ScalarTransform4f().look_at([0, 0, 3900], [0, 0, 0], [0, 1, 0])
    again = render(load_scene(large), lens, spp=64, units_per_m=1000)
    np.testing.assert_allclose(again.mean(axis=(0, 1)), whole.mean(axis=(0, 1)), rtol=0.03)
    assert np.abs(regions([again]) - regions([whole])).max() < 0.1 * whole.mean()


XML = """<scene version="3.0.0">
<integrator type="path"/>
<emitter type="constant"><rgb name="radiance" value="1"/></emitter>
<sensor type="neurolens">
  <string name="camera" value="{camera}"/> <float name="focus_m" value="2"/> <integer name="blades" value="6"/>
  <float name="film_width_mm" value="{width}"/> {more}
  <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="4"/></film>
</sensor></scene>"""


def test_a_scene_file_names_its_camera(tmp_path: Path) -> None:
    mi = variant("llvm_ad_rgb")
    file = tmp_path / "scene.xml"
    shutil.copy(MODEL, tmp_path / "lens.onnx")  # found beside the scene
    Image.new("L", (8, 8), 255).save(tmp_path / "open.png")  # and so is its mask
    mask = '<string name="aperture_mask" value="open.png"/>'
    file.write_text(
        XML.replace('<integer name="blades" value="6"/>', mask).format(width=12, more="", camera="lens.onnx")
    )
    picture = np.array(mi.render(load_scene(file), spp=64))
    assert picture.shape == (4, 8, 3)
    np.testing.assert_allclose(picture[1:3, 2:6].mean(), 1, atol=0.1)


def test_the_command_renders_a_scene_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    variant("llvm_ad_rgb")
    (tmp_path / "scene.xml").write_text(XML.format(width=12, more="", camera="thin"))
    out = tmp_path / "out.exr"
    words = (
        f"mitsuba {tmp_path}/scene.xml --camera {MODEL} --film 8x4 --samples 64 --variant llvm_ad_rgb -o {out} --quiet"
    )
    assert main(words.split()) == 0
    assert "8 x 4" in capsys.readouterr().out
    picture, metadata = read_exr(out)
    np.testing.assert_allclose(picture.mean(), 1, atol=0.1)
    assert metadata["camera"]["camera"] == "model" and metadata["render"]["variant"] == "llvm_ad_rgb"
    assert out.with_suffix(".png").is_file()


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ('<float name="f_nmber" value="2"/>', "f_nmber"),
        ('<float name="units_per_m" value="0"/>', "units_per_m: got 0.0, expected a finite number above 0"),
        ('<float name="film_height_mm" value="12"/>', "expected the shape of the film, 12 x 12 mm"),
        ('<transform name="to_world"><scale value="2"/></transform>', "to_world: got .*set units_per_m"),
        ('<string name="zoom" value="35"/>', "zoom: got '35'"),
        ('<string name="film_height_mm" value="high"/>', "film_height_mm: got 'high', expected a number"),
    ],
)
def test_mistakes_in_a_scene_are_one_line(tmp_path: Path, more: str, words: str) -> None:
    variant("scalar_rgb")
    file = tmp_path / "scene.xml"
    file.write_text(XML.format(width=12, more=more, camera="thin"))
    with pytest.raises(NeurolensError, match=words) as caught:
        load_scene(file)
    assert "\n" not in str(caught.value) and "scene.xml" in str(caught.value)


def test_other_mistakes(tmp_path: Path, lens: Camera) -> None:
    mi = variant("scalar_rgb")
    with pytest.raises(InputError, match=r"expected a scene of Mitsuba \(.xml\)"):
        load_scene(tmp_path / "none.xml")
    with pytest.raises(InputError, match="variant: got 'scalar_mono'"):
        require_mitsuba("scalar_mono")
    for part in ("sensor", "integrator"):
        with pytest.raises(InputError, match=rf"{part}: got \(missing\)"):
            load_scene({k: v for k, v in furnace(mi, 4).items() if k != part})
    scene = load_scene(furnace(mi, 4))
    with pytest.raises(InputError, match="spp: got 0"):
        render(scene, lens, spp=0)
    with pytest.raises(InputError, match="sensor: got 3, expected from 0 to 0"):
        render(scene, lens, sensor=3)
    with pytest.raises(InputError, match="the shape of the film, 36 x 24 mm"):
        render(scene, Pinhole(50.0))
