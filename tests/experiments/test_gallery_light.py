"""Falloff, depth of field, bokeh, pinhole and fisheyes of the gallery, against closed forms and forward tracing."""

import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from experiments.pictures.gallery import bokeh
from experiments.pictures.gallery.bokeh import LightDisc, light_disc
from experiments.pictures.gallery.cameras import (
    CAMERAS,
    PostProcessed,
    View,
    illumination,
    post_process,
    shot_of,
    strength_for,
)
from experiments.pictures.gallery.measures import MEASURES, PROJECTIONS, blur_mm, exposure, field_angles, scale
from experiments.pictures.gallery.run import check
from experiments.pictures.gallery.settings import read_effect
from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.build import make_camera
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.ideal import Pinhole, ThinLens
from neurolens.cameras.model import OnnxCamera, load_model
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.shot import Shot, StopShape
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.rays import Rays, trace
from neurolens.pictures.render.images import make_aperture
from neurolens.pictures.render.scene import load_scene

ROOT = Path(__file__).parents[2]
GALLERY = ROOT / "experiments" / "gallery"
EFFECTS = (
    *("bokeh-anamorphic", "bokeh-blades", "bokeh-cats-eyes", "bokeh-masks", "depth-of-field", "fisheye-panorama"),
    *("pinhole", "series-f-number", "series-focal-length", "vignetting-card", "vignetting-post", "vignetting-stops"),
)
MEDIUM = (72.0, 48.0)  # film of the 100 mm lenses
pytestmark = pytest.mark.filterwarnings("ignore:.*V_d is not given")


@cache
def camera(name: str, f_number: float, film: tuple[float, float], focus_m: float, efl_mm: float | None = None) -> Any:
    folder = "models" if name.endswith(".onnx") else "lenses"
    shot = Shot(film_mm=film, focus_m=focus_m, f_number=f_number, focal_length_mm=efl_mm, wavelength_nm=(550.0, 550.0))
    return make_camera(name if name == "thin" else ROOT / folder / name, shot)


def relative(taken: Any, corner_mm: float) -> Any:
    curve = illumination(taken, np.linspace(0, corner_mm, 5))
    return curve / curve[0]


@pytest.mark.parametrize("name", EFFECTS)
def test_every_effect_reads_and_its_thin_lens_measures(name: str) -> None:
    """The null: rows of the table for the camera without a lens's faults."""
    effect = read_effect(GALLERY / f"{name}.toml")
    check(effect)
    panel = effect.panel[0]
    shot = shot_of(panel, load_scene(panel.scene))
    taken = CAMERAS["thin"](shot, None)
    found = MEASURES[effect.measure](View(shot, taken, "thin", np.zeros((4, 6, 3), np.float32)))
    assert found and all(np.isfinite(value) for value in found.values())
    nulls = {
        "disc_at_the_edge_over_middle_percent": 100,
        "axis_ratio_near_the_corner": 1,
        "squeeze_of_the_picture": 1,
        "disc_height_over_width_on_film": 1,
        "brighter_than_post_process_percent": 0,
        "radius_over_rectilinear_percent": 100,
    }
    for key, value in nulls.items():
        assert found.get(key, value) == pytest.approx(value, rel=0.01, abs=0.2)


@pytest.mark.parametrize(("lens", "least"), [("brendel_tessar_100", 0.08), ("hudson_double_gauss_100", 0.16)])
def test_no_post_process_has_the_falloff_of_a_lens(lens: str, least: float) -> None:
    """With centre and corner met, the lens is brighter in between, by what the cosine law cannot bend."""
    model = camera(f"{lens}.mlp-16x2.onnx", 4.0, MEDIUM, 10.0)
    thin = camera("thin", 4.0, MEDIUM, 10.0, 100.0)
    drawn = PostProcessed(thin, model)
    corner = 0.95 * math.hypot(*MEDIUM) / 2
    ours, theirs = relative(model, corner), relative(drawn, corner)
    assert theirs[-1] == pytest.approx(ours[-1], abs=1e-4)
    assert (ours - theirs)[1:-1].max() > least
    assert (ours - theirs).min() > -1e-3
    curve = relative(thin, corner)
    assert post_process(np.linspace(0, corner, 5), strength_for(corner, curve[-1])) == pytest.approx(curve, abs=1e-3)


def test_two_stops_halve_the_blur_and_quarter_the_light() -> None:
    for name in ("tronnier_double_gauss_100.mlp-16x2.onnx", "thin"):
        efl = 100.7163 if name == "thin" else None
        wide, closed = (camera(name, n, (24.0, 16.0), 1.5, efl) for n in (5.6, 11.2))
        assert blur_mm(wide, 2.5) / blur_mm(closed, 2.5) == pytest.approx(2, rel=0.03)
        assert exposure(wide) / exposure(closed) == pytest.approx(4, rel=0.03)
    with pytest.raises(InputError, match="a lens, a model or a thin lens"):
        exposure(Pinhole(36.0))


def test_a_pinhole_draws_itself_on_every_point() -> None:
    """2 a (1 + f / d) at a distance d before the hole, whatever the distance in focus."""
    hole = make_camera(GALLERY / "lenses" / "pinhole_36.toml", Shot(film_mm=(18.0, 12.0), focus_m=1.5, f_number=100.0))
    for distance in (0.3, 0.5, 2.0):
        before = 1e3 * distance - 36
        assert blur_mm(hole, distance) == pytest.approx(0.36 * (1 + 36 / before), rel=5e-3)
        assert scale(hole, distance) == pytest.approx(36 / before, rel=1e-3)
    assert blur_mm(ThinLens(36.0, 100.0, 1.5), 1.5) < 1e-3
    assert blur_mm(Pinhole(36.0), 0.5) == 0


@pytest.mark.whole
def test_fisheyes_bend_the_room_as_the_equisolid_projection() -> None:
    model = load_model(ROOT / "models" / "horimoto_fisheye_16.mlp-16x2.onnx")
    film = (36.4, 24.2667)
    exact, surrogate = (camera(f"horimoto_fisheye_16.{e}", 8.0, film, 2.0) for e in ("toml", "mlp-16x2.onnx"))
    radii = np.array([5.0, 10.0, 15.0, 20.0])
    angles = field_angles(exact, radii)
    assert field_angles(surrogate, radii) == pytest.approx(angles, abs=1e-3)
    focal = model.card["lens"]["efl_mm"]
    assert radii == pytest.approx(focal * PROJECTIONS["equisolid"](angles), rel=0.02)
    assert focal * PROJECTIONS["rectilinear"](angles[-1]) > 2 * radii[-1]
    assert 2 * math.degrees(field_angles(exact, np.array([21.8]))[0]) == pytest.approx(179, abs=3)
    thin = camera("thin", 8.0, film, 2.0, 16.0)
    seen = thin.image_distance_mm * np.tan(field_angles(thin, radii))
    assert seen == pytest.approx(radii, rel=5e-3)


TRONNIER, COOKE = "tronnier_double_gauss_100", "cooke_anamorphic_42"
FILM, FOCUS_M = (54.0, 36.0), 1.42
FAR_M, NEAR_M = 12.0, 0.85
SHAPES = {"4": {"blades": 4}, "6": {"blades": 6}, "50": {"blades": 50}} | {
    name: {"aperture_mask": GALLERY / "scenes" / f"{name}.png"} for name in ("star", "heart")
}


@cache
def shape(name: str) -> Aperture | None:
    return None if name == "round" else make_aperture(StopShape(**SHAPES[name]))  # type: ignore[arg-type]


@cache
def taken_by(kind: str, stop: str = "round", f_number: float = 2.0302) -> ExactCamera | OnnxCamera | ThinLens:
    """The double Gauss, its shipped model, or a thin lens of its focal length."""
    if kind == "thin":
        return ThinLens(100.7163, f_number, FOCUS_M, FILM, aperture=shape(stop))
    if kind == "surrogate":
        model = load_model(ROOT / "models" / f"{TRONNIER}.mlp-16x2.onnx")
        return OnnxCamera(model, Shot(FILM, FOCUS_M, f_number, aperture=shape(stop)))
    with pytest.warns(UserWarning, match="V_d"):
        lens = read_lens(ROOT / "lenses" / f"{TRONNIER}.toml")
    return ExactCamera(lens.with_aperture(shape(stop)), Shot(FILM, FOCUS_M, f_number))


@cache
def disc(kind: str, stop: str, place: str, f_number: float = 2.0302) -> LightDisc:
    taken = taken_by(kind, stop, f_number)
    share, distance = {"far": (0, FAR_M), "near": (0, NEAR_M), "half": (0.48, FAR_M), "edge": (0.93, FAR_M)}[place]
    return light_disc(taken, bokeh.light_towards(taken, share, distance), count=3000)


@pytest.mark.parametrize("place", ["far", "near", "edge"])
def test_the_disc_of_a_thin_lens_has_its_closed_form(place: str) -> None:
    """Round everywhere, of diameter D (s' / s) |d - s| / d for a light d and a focus s before the lens.

    Its second moments make it 1% smaller: at f/2 the rim's rays weigh cos^4 = 0.89.
    """
    behind = taken_by("thin").image_distance_mm  # type: ignore[union-attr]
    s, d = 1e3 * FOCUS_M - behind, 1e3 * (NEAR_M if place == "near" else FAR_M) - behind
    expected = 100.7163 / 2.0302 * behind / s * abs(d - s) / d
    found = disc("thin", "round", place)
    if place != "edge":  # off the axis the rim's rays shift the centroid
        assert 2 * found.outline_mm(30) == pytest.approx(np.full(30, expected), rel=0.02)
    assert found.axes_mm == pytest.approx((0.99 * expected, 0.99 * expected), rel=3e-3)


@pytest.mark.parametrize("place", ["far", "edge"])
def test_the_disc_found_backwards_is_that_of_light_traced_forwards(place: str) -> None:
    """Of the exact camera: its film points of a light's rays, and the film points whose rays find the light."""
    taken, side = taken_by("exact"), 200
    middle = ((np.arange(side) + 0.5) / side).astype(np.float32)
    pupil = np.stack([a.ravel() for a in np.meshgrid(middle, middle)])
    light = np.array(bokeh.light_towards(taken, 0.93 if place == "edge" else 0, FAR_M), np.float32)
    out = taken.to_film(np.repeat(light[:, None], side**2, axis=1), pupil, np.full(side**2, 550, np.float32))
    lit = out.status == st.PASSED
    forwards = LightDisc(out.film_mm[:, lit].astype(float), out.weight[lit].astype(float) / side**2)
    backwards = disc("exact", "round", place)
    assert backwards.centre_mm == pytest.approx(forwards.centre_mm, abs=5e-3)
    assert backwards.axes_mm == pytest.approx(forwards.axes_mm, rel=5e-3)
    assert backwards.total == pytest.approx(forwards.total, rel=0.01)


@pytest.mark.parametrize("kind", ["exact", "surrogate"])
def test_rims_cut_cats_eyes_across_the_radius(kind: str) -> None:
    """Narrower, smaller and darker the nearer to the corner, long across the radius; a thin lens has none."""
    far, half, edge = (disc(kind, "round", place) for place in ("far", "half", "edge"))
    ratios = [d.axes_mm[1] / d.axes_mm[0] for d in (far, half, edge)]
    assert ratios[0] > 0.995 and 0.75 < ratios[1] < 0.9 and 0.6 < ratios[2] < 0.7
    assert 1 > half.area_mm2 / far.area_mm2 > 1.2 * edge.area_mm2 / far.area_mm2
    assert edge.total / far.total == pytest.approx(0.47, abs=0.03)
    radius = math.degrees(math.atan2(edge.centre_mm[1], edge.centre_mm[0]))
    assert (edge.long_axis_deg - radius) % 180 == pytest.approx(90, abs=2)
    null = disc("thin", "round", "edge")
    assert null.axes_mm[1] / null.axes_mm[0] > 0.995
    assert null.area_mm2 / disc("thin", "round", "far").area_mm2 > 0.99


def test_the_surrogate_draws_the_discs_of_the_lens() -> None:
    for place in ("far", "near", "edge"):
        exact, model = disc("exact", "round", place), disc("surrogate", "round", place)
        assert model.axes_mm == pytest.approx(exact.axes_mm, rel=0.01)
        assert model.centre_mm == pytest.approx(exact.centre_mm, abs=5e-3)


# One shape in the exact lens; the model, which shares the code that tests shapes, stands for the others.
@pytest.mark.parametrize(
    ("kind", "stop", "corners"), [("exact", "6", 6), ("surrogate", "6", 6), ("thin", "4", 4), ("surrogate", "star", 5)]
)
def test_a_disc_has_the_corners_of_the_stop_and_its_area_passes(kind: str, stop: str, corners: int) -> None:
    """The area exactly of a thin lens; a real lens's stop is not evenly seen from the film, by some hundredths."""
    waves, depth = bokeh.outline_waves(disc(kind, stop, "far"))
    assert waves == corners
    assert depth > 0.03 > 3 * bokeh.outline_waves(disc(kind, "round", "far"))[1]
    area = shape(stop).area_share  # type: ignore[union-attr]
    assert bokeh.passage(taken_by(kind, stop)) == pytest.approx(area, abs=0.003 if kind == "thin" else 0.025)


def test_fifty_blades_are_round_and_masks_open_the_shares_that_the_page_gives() -> None:
    assert bokeh.passage(taken_by("thin", "50")) == pytest.approx(math.sin(math.pi / 25) * 25 / math.pi, abs=3e-3)
    assert bokeh.outline_waves(disc("thin", "50", "far"))[1] < 0.01
    for name, share in (("star", 0.452), ("heart", 0.470)):
        assert shape(name).area_share == pytest.approx(share, abs=2e-3)  # type: ignore[union-attr]


@pytest.mark.parametrize("kind", ["surrogate", "thin"])
def test_a_heart_stands_behind_the_focus_and_hangs_before_it(kind: str) -> None:
    far, near = disc(kind, "heart", "far"), disc(kind, "heart", "near")
    assert bokeh.overlap(far, near, turned=True) > bokeh.overlap(far, near) + 0.1
    # A heart's mass is above its tip: its third moment along y is below 0, and turned with the film above.
    y, x = np.mgrid[1:-1:256j, -1:1:256j]
    mask = shape("heart").inside(x, y, 1.0)  # type: ignore[union-attr]
    assert ((y[mask] - y[mask].mean()) ** 3).mean() < 0
    for found, sign in ((far, 1), (near, -1)):
        off = found.film_mm[1] - found.centre_mm[1]
        assert sign * (off**3 * found.flux).sum() > 0


def test_an_anamorphic_lens_draws_upright_ovals() -> None:
    """Blur grows with the square of the focal length: four to one on film where the picture is squeezed two to one."""
    model = load_model(ROOT / "models" / f"{COOKE}.mlp-16x2.onnx")
    taken = OnnxCamera(model, Shot((21.3, 17.8), math.inf, focus_mode="paraxial"))
    width, height = light_disc(taken, (0.0, 0.0, -2.0), count=4000).widths_mm
    squeeze = bokeh.squeeze_of(taken, 20.0)
    assert squeeze == pytest.approx(42.47 / 21.47, rel=0.01)
    assert height / width / squeeze == pytest.approx(squeeze, rel=0.06)
    traced = _forward_spread(COOKE, 2.0)
    assert (width, height) == pytest.approx(tuple(traced), rel=0.02)
    thin = light_disc(ThinLens(42.47, 2.4, math.inf, FILM), (0.0, 0.0, -2.0), count=4000).widths_mm
    assert thin[0] == pytest.approx(thin[1], rel=1e-3)


def _forward_spread(name: str, distance_m: float) -> NDArray[np.float64]:
    """Four standard deviations in x and y of the light of a point on the axis, traced through the exact lens."""
    lens = set_lens(read_lens(ROOT / "lenses" / f"{name}.toml"), focus_m=math.inf)
    assert lens.film_z_mm is not None
    start = lens.film_z_mm - 1e3 * distance_m
    places = torch.linspace(-1, 1, 151, dtype=torch.float64) * 20
    x, y = (a.reshape(-1) for a in torch.meshgrid(places, places, indexing="xy"))
    length = torch.sqrt(x**2 + y**2 + start**2)
    rays = Rays(0 * x, 0 * x, 0 * x + start, x / length, y / length, -start / length)
    done = trace(lens, rays, 550.0, towards="film", transmittance=True)
    assert done.transmittance is not None
    passed = done.status == st.PASSED
    out = done.rays
    gap = (lens.film_z_mm - out.z) / out.dz
    film = torch.stack([out.x + gap * out.dx, out.y + gap * out.dy])[:, passed]
    weight = (done.transmittance / length**3)[passed]
    off = film - (film * weight).sum(1, keepdim=True) / weight.sum()
    return (4 * torch.sqrt((off**2 * weight).sum(1) / weight.sum())).numpy()


def test_a_light_that_the_film_cannot_see_is_refused() -> None:
    with pytest.raises(InputError, match="light_m"):
        light_disc(taken_by("exact"), (0.0, 0.0, 5.0))
