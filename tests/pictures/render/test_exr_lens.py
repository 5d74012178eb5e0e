"""The lens in the header of a picture, as another reader finds it, against rays and the films of its surfaces."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from shipped import whole

from neurolens import __version__
from neurolens.cameras.build import make_camera
from neurolens.cameras.contract import Camera
from neurolens.cameras.sampling import stratified
from neurolens.optics.lens.glass import LINE_D_NM, absorption_of, index_of
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.trace.films import reflectance
from neurolens.pictures.render.pictures import read_exr, standard_attributes, write_exr

LENS = "lenses/laikin_double_gauss_50.toml"
MODEL = "models/laikin_double_gauss_50.ols-60.onnx"
ANAMORPHIC = "lenses/cooke_anamorphic_42.toml", "models/cooke_anamorphic_42.ols-64.onnx"
FILM = (36.0, 24.0)


def header(path: Path) -> dict[str, Any]:
    """What OpenImageIO finds."""
    oiio = pytest.importorskip("OpenImageIO", reason="OpenImageIO is not installed: no other reader of EXR headers")
    picture = oiio.ImageInput.open(str(path))
    assert picture, oiio.geterror()
    return {a.name: a.value for a in picture.spec().extra_attribs}


def camera(spec: str, focus_m: float, f_number: float | None = None) -> Camera:
    return make_camera(spec, Shot(film_mm=FILM, focus_m=focus_m, f_number=f_number))


def axial_power(lens: Lens, nm: float) -> float:
    """The share of light that the axial ray keeps, by the films of each surface and the absorption behind it."""
    power, before = torch.ones(1, dtype=torch.float64), 1.0
    for s in lens.surfaces:
        after, films = float(index_of(s, nm)), s.coating.layers if s.coating else ()
        power = power * (1 - reflectance(torch.ones(1, dtype=torch.float64), before, after, films, nm))
        power, before = power * math.exp(-(absorption_of(s, nm) or 0.0) * s.thickness_mm), after
    return power.item()


def seen(made: Camera, height_mm: float) -> tuple[float, float]:
    """Pinhole focal length and entrance pupil offset in mm, by the mean ray of a film point close to the axis."""
    square, wavelength = stratified(128, (LINE_D_NM, LINE_D_NM))
    film = np.zeros_like(square)
    film[0] = height_mm
    rays = made.sample(film, square, wavelength)
    place, way = rays.origin_m.astype(float), rays.direction.astype(float)
    slopes = way[0] / -way[2]
    slope, at_film = np.average([slopes, place[0] + slopes * place[2]], axis=1, weights=rays.weight)  # at z = 0
    return -height_mm / slope, -1e3 * at_film / slope


@pytest.mark.parametrize("focus_m", [1.0, *whole(math.inf)])
@pytest.mark.parametrize("spec", [LENS, MODEL])
def test_lens_state_is_what_rays_close_to_the_axis_do(spec: str, focus_m: float) -> None:
    made = camera(spec, focus_m, 32.0)
    state = made.settings["lens_state"]
    pinhole, offset = seen(made, 2.0)
    assert state["pinhole_focal_length_mm"] == pytest.approx(pinhole, rel=1e-3)
    assert state["entrance_pupil_offset_mm"] == pytest.approx(offset, abs=0.15)
    assert state["effective_focal_length_mm"] == pytest.approx(49.637, abs=1e-3)
    assert (state["nominal_focal_length_mm"], state["squeeze"]) == (50.0, 1.0)
    through = axial_power(read_lens(LENS), LINE_D_NM)
    assert state["t_stop"] == pytest.approx(32 / math.sqrt(through), rel=2e-4)


def test_pupil_moves_away_from_the_film_as_the_lens_is_focused_closer() -> None:
    far, near = (camera(LENS, focus_m).settings for focus_m in (math.inf, 1.0))
    moved = near["film_z_mm"] - far["film_z_mm"]
    states = far["lens_state"], near["lens_state"]
    assert moved > 2
    offsets, lengths = ([s[k] for s in states] for k in ("entrance_pupil_offset_mm", "pinhole_focal_length_mm"))
    assert offsets[1] - offsets[0] == pytest.approx(moved, abs=1e-6)
    assert lengths[1] > lengths[0] + 1


@pytest.mark.parametrize("spec", [ANAMORPHIC[1], *whole(ANAMORPHIC[0])])
def test_squeeze_is_measured_and_shapes_the_pixels(spec: str) -> None:
    made = make_camera(spec, Shot(film_mm=(20.0, 15.0), focus_m=math.inf))
    squeeze = made.settings["lens_state"]["squeeze"]
    assert squeeze == pytest.approx(42.47 / 21.47, rel=3e-3)  # as the patent states both
    assert standard_attributes(made.settings, 40, 30)["pixelAspectRatio"] == pytest.approx(squeeze)


def test_ideal_cameras_say_what_is_defined() -> None:
    thin = standard_attributes(camera("thin", 2.0, 4.0).settings, 36, 24)
    image = 1 / (1 / 50 - 1 / (thin["focus"] * 1000 - thin["pinholeFocalLength"]))
    assert thin["pinholeFocalLength"] == thin["entrancePupilOffset"] == pytest.approx(image)
    assert thin["effectiveFocalLength"] == 50 and thin["tStop"] == thin["aperture"] == 4
    assert not {"nominalFocalLength", "lensMake", "lensModel", "imageCounter"} & thin.keys()
    point = standard_attributes(camera("pinhole", 2.0).settings, 36, 24)
    assert "focus" not in point and point["pinholeFocalLength"] == 50


def test_pixels_that_are_not_square_have_no_pitch() -> None:
    found = standard_attributes({"camera": "thin", "film_mm": [36, 24]}, 36, 48)
    assert found["pixelAspectRatio"] == pytest.approx(2) and "sensorPhotositePitch" not in found
    assert standard_attributes({"camera": "other"}, 36, 48).keys() == {
        "cameraMake", "cameraModel", "cameraFirmwareVersion"
    }  # fmt: skip


@pytest.mark.parametrize("spec", [MODEL, *whole(LENS)])
def test_another_reader_finds_the_standard_attributes(spec: str, tmp_path: Path) -> None:
    made = camera(spec, 2.5, 2.8)
    given = standard_attributes(made.settings, 72, 48, frame=7)
    write_exr(tmp_path / "a.exr", np.ones((48, 72, 3)), metadata={"camera": 1}, attributes=given)
    found = header(tmp_path / "a.exr")
    texts = {
        "cameraMake": "neurolens",
        "cameraModel": made.settings["camera"],
        "cameraFirmwareVersion": __version__,
        "lensModel": "Double Gauss 50 mm f/1.8",
        "lensMake": "Laikin",
        "lensSerialNumber": read_lens(LENS).sha256,
    }
    assert {k: found[k] for k in texts} == texts
    numbers = {
        "nominalFocalLength": 50, "effectiveFocalLength": 49.637, "focus": 2.5, "FNumber": 2.8, "imageCounter": 7,
        "sensorPhotositePitch": 500.0, "PixelAspectRatio": 1.0,
    }  # fmt: skip
    assert {k: found[k] for k in numbers} == pytest.approx(numbers, rel=1e-4)
    state = made.settings["lens_state"]
    told = {"pinholeFocalLength": state["pinhole_focal_length_mm"], "tStop": state["t_stop"]}
    told["entrancePupilOffset"] = state["entrance_pupil_offset_mm"]
    assert {k: found[k] for k in told} == pytest.approx(told, rel=1e-6)
    assert tuple(found["sensorOverallDimensions"]) == FILM
    assert tuple(found["sensorAcquisitionRectangle"]) == (0, 0, 71, 47)
    assert read_exr(tmp_path / "a.exr")[1] == {"camera": 1}
