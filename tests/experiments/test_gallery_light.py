"""Falloff, depth of field, the series, the pinhole and fisheyes of the gallery, against closed forms."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.gallery.cameras import CAMERAS, PostProcessed, View, illumination, post_process, shot_of, strength_for
from experiments.gallery.measures import MEASURES, PROJECTIONS, blur_mm, exposure, field_angles, scale
from experiments.gallery.run import check
from experiments.gallery.settings import read_effect
from neurolens.base.errors import InputError
from neurolens.cameras.build import Shot, make_camera
from neurolens.cameras.ideal import ThinLens
from neurolens.cameras.model import load_model
from neurolens.cameras.pinhole import Pinhole
from neurolens.cameras.vignetting import Vignetted
from neurolens.optics.lensfile import read_lens
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Lens
from neurolens.render.scene import load_scene

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
    shot = Shot(film_mm=film, focus_m=focus_m, f_number=f_number, efl_mm=efl_mm, wavelength_nm=(550.0, 550.0))
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


def test_light_falls_off_faster_the_wider_the_stop() -> None:
    """A Tessar: rims alone at f/1, stop and rims at f/4, at f/8 the cosine law of its exit pupil and no more."""
    wide, four = (relative(camera("brendel_tessar_100.toml", n, MEDIUM, 10.0), 41.0)[-1] for n in (1.0, 4.0))
    model_four, eight = (
        relative(camera("brendel_tessar_100.mlp-16x2.onnx", n, MEDIUM, 10.0), 41.0)[-1] for n in (4.0, 8.0)
    )
    assert (wide, four, eight) == pytest.approx((0.37, 0.63, 0.80), abs=0.02)
    assert model_four == pytest.approx(four, abs=2e-3)
    thin = camera("thin", 8.0, MEDIUM, 10.0, 100.0)
    law = (1 + (np.linspace(0, 41, 5) / thin.image_distance_mm) ** 2) ** -2
    assert relative(thin, 41.0) == pytest.approx(law, rel=2e-3)


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


def test_a_white_card_four_ways() -> None:
    """Of a fisheye: the two parts multiply to the whole; a thin lens has no aperture part."""
    fisheye = camera("muller_fisheye_100-14mm.mlp-16x2.onnx", 4.0, (36.0, 24.0), 10.0)
    ways = {kind: relative(Vignetted(fisheye, kind), 16.0) for kind in ("natural", "optical")}
    both = relative(fisheye, 16.0)
    assert ways["natural"] * ways["optical"] == pytest.approx(both, abs=4e-3)
    assert both[-1] < 0.5 and ways["natural"][-1] > ways["optical"][-1]
    thin = camera("thin", 4.0, (36.0, 24.0), 10.0, 14.0)
    assert relative(Vignetted(thin, "optical"), 16.0) == pytest.approx(np.ones(5), abs=4e-3)


def paraxial_blur_mm(lens: Lens, distance_m: float, wavelength_nm: float = 550.0) -> float:
    """First-order diameter of the disc of a light on the axis: D m |d - s| / d.

    D is the diameter of the entrance pupil, d and s the distances from it of the light and of what is in focus, m the
    magnification there: the pupil's cone cut by the plane in focus, and that plane's picture.

    Args:
        lens: focused, its film in place. distance_m: from film to light.
    """
    data: Any = first_order(lens, wavelength_nm)
    assert lens.film_z_mm is not None
    light_z = lens.film_z_mm - 1e3 * distance_m
    behind = lens.film_z_mm - float(data.rear_principal_z_mm)
    efl = float(data.efl_mm)
    focus_z = float(data.front_principal_z_mm) - 1 / (1 / efl - 1 / behind)
    to_light, to_focus = (float(data.entrance_pupil_z_mm) - z for z in (light_z, focus_z))
    magnification = (behind - efl) / efl
    return float(data.entrance_pupil_diameter_mm) * magnification * abs(to_light - to_focus) / to_light


def test_blur_of_near_and_far_signs_is_first_order_when_stopped_down() -> None:
    efl_mm = 75.0
    lens = read_lens(ROOT / "lenses" / "tronnier_double_gauss_100.toml").at(
        focal_length_mm=efl_mm, f_number=11.0, focus_m=1.4
    )
    exact = camera("tronnier_double_gauss_100.toml", 11.0, (24.0, 16.0), 1.4, efl_mm)
    thin = camera("thin", 11.0, (24.0, 16.0), 1.4, efl_mm)
    behind = thin.image_distance_mm
    s = 1400 - behind
    for distance in (1.0, 2.0):
        assert blur_mm(exact, distance) == pytest.approx(paraxial_blur_mm(lens, distance), rel=0.05)
        closed = efl_mm / 11 * behind / s * abs(1e3 * distance - 1400) / (1e3 * distance - behind)
        assert blur_mm(thin, distance) == pytest.approx(closed, rel=5e-3)
    assert blur_mm(exact, 1.4) < 0.1 * blur_mm(exact, 1.0)
    # Perspective is a matter of place: the ratio of sizes is that of the distances from the entrance pupil.
    ratio = scale(exact, 1.0) / scale(exact, 2.0)
    assert ratio == pytest.approx((2000 - 1.1 * efl_mm) / (1000 - 1.1 * efl_mm), rel=0.01)
    assert ratio == pytest.approx(scale(thin, 1.0) / scale(thin, 2.0), rel=0.01)


def test_open_blur_of_lens_and_surrogate_agree_and_leave_first_order() -> None:
    """A shipped model, focused at 1.5 m: wide open its blur in focus is what the thin lens does not have."""
    film = (24.0, 16.0)
    exact, model = (camera(f"tronnier_double_gauss_100.{e}", 2.0302, film, 1.5) for e in ("toml", "mlp-16x2.onnx"))
    for distance in (1.1, 1.5, 2.0):
        assert blur_mm(model, distance) == pytest.approx(blur_mm(exact, distance), rel=0.01)
    assert blur_mm(exact, 1.5) > 0.05 > 1e3 * blur_mm(camera("thin", 2.0302, film, 1.5, 100.7), 1.5)


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
