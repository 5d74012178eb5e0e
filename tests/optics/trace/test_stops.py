"""Plates, hoods, pinholes and shapes of the stop: geometry, areas in closed form, what the tracer lets through."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from shipped import LENSES, before, pinhole, tabled

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.exact import ExactCamera
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Surface
from neurolens.optics.lens.shot import Shot, StopShape
from neurolens.optics.readers.lensfile import read_lens, write_lens
from neurolens.optics.setting.pupils import camera_rays, pupil_plane_z_mm
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.rays import Rays, trace
from neurolens.pictures.render.images import make_aperture, read_mask

PLATE_MM, N_D = 3.0, 1.5168


def plate(**fields: float) -> tuple[Surface, Surface]:
    """A plane plate and the air behind it, 1 mm."""
    return Surface(math.inf, PLATE_MM, 60.0, n_d=N_D, **fields), Surface(math.inf, 1.0, 60.0)


def test_a_hood_cuts_the_field_at_its_geometric_angle() -> None:
    """A hole 60 mm behind a ring of radius 20 sees 18.4 degrees, the hole's own radius more or less."""
    hooded = before(pinhole(40.0, 0.05), Surface(math.inf, 60.0, 40.0))
    angle = torch.linspace(0.0, 0.6, 6001, dtype=torch.float64)
    x, zero = 100.0 * torch.tan(angle), torch.zeros_like(angle)
    rays = Rays(x, zero, zero - 40.0, -torch.sin(angle), zero, torch.cos(angle))
    out = trace(hooded, rays, towards="film")
    limit = math.atan(20.0 / 60.0)
    assert float(angle[out.status == 0].max()) == pytest.approx(limit, abs=2e-4)
    assert set(out.status[angle > limit + 1e-3].tolist()) == {st.blocked(0, st.RIM)}


# --- The lens without glass


def test_a_pinhole_maps_tangents_and_knows_no_focus(tmp_path: Path) -> None:
    hole = pinhole(50.0, 0.25, image_radius_mm=20.0)
    data = first_order(hole)
    assert (data.efl_mm, data.f_number, data.exit_pupil_z_mm, data.entrance_pupil_z_mm) == (50.0, 100.0, 0.0, 0.0)
    for focus_m in (math.inf, 1.0, 0.01):
        for focus in ("paraxial", "best"):
            state = set_lens(hole, focus_m=focus_m, focus_mode=focus)  # type: ignore[arg-type]
            assert state.film_z_mm == 50.0
    assert set_lens(hole, f_number=200).stop_radius_mm == 0.125
    assert first_order(set_lens(hole, focal_length_mm=25)).efl_mm == pytest.approx(25, rel=1e-12)
    assert first_order(set_lens(hole, field_deg=60)).efl_mm == pytest.approx(20 / math.tan(math.radians(30)), rel=1e-9)
    with pytest.raises(InputError, match="no focus states"):
        set_lens(hole, focus_mode="internal", focus_m=2.0)
    write_lens(replace(hole, source="a tin"), tmp_path / "hole.toml")
    assert first_order(read_lens(tmp_path / "hole.toml")).efl_mm == 50.0


def test_plates_before_and_behind_a_pinhole_shorten_its_distances() -> None:
    """The film, seen through a plate, lies t (1 - 1/n) nearer to the hole; the plate pushes it as much away."""
    hole = pinhole(50.0, 0.25, image_radius_mm=20.0)
    film_z = 50.0 + PLATE_MM * (1 - 1 / N_D)
    glass, air = plate()
    rows = replace(hole.surfaces[0], thickness_mm=1.0), glass, replace(air, thickness_mm=film_z - 1.0 - PLATE_MM)
    rear = replace(hole, surfaces=rows)
    assert first_order(rear).efl_mm == pytest.approx(50.0, rel=1e-12)
    assert set_lens(rear).film_z_mm == pytest.approx(film_z, rel=1e-12)
    slope = 1e-4
    ray = Rays(*(torch.tensor([v], dtype=torch.float64) for v in (-slope, 0.0, -1.0, slope, 0.0, 1.0)))
    out = trace(rear, ray, towards="film").rays
    height = float(out.x + (set_lens(rear).film_z_mm - out.z) * out.dx / out.dz)  # type: ignore[operator]
    assert height == pytest.approx(50.0 * slope, rel=1e-6)


@pytest.mark.parametrize("point", [(0.0, 0.0), (12.0, 5.0)])
def test_the_exact_camera_takes_a_pinhole(point: tuple[float, float]) -> None:
    """Its falloff is cos^4, and its rays leave from the hole, opposite to the film point."""
    hole = pinhole(30.0, 0.2, image_radius_mm=21.6)
    camera = ExactCamera(hole, Shot((36.0, 24.0), math.inf))
    rng = np.random.default_rng(0)
    film = np.repeat(np.array([point], np.float32).T, 20_000, axis=1)
    out = camera.sample(film, rng.random((2, 20_000), np.float32), np.full(20_000, 550, np.float32))
    cos2 = 1 / (1 + (point[0] ** 2 + point[1] ** 2) / 30**2)
    assert out.weight.mean() == pytest.approx(cos2**2, rel=0.01)
    assert (out.status == 0).mean() > 0.97
    passed = out.status == 0
    assert np.hypot(*out.origin_m[:2, passed]).max() <= 0.2001e-3
    slope = out.direction[:2, passed] / out.direction[2, passed]
    assert slope.mean(axis=1) == pytest.approx([point[0] / 30, point[1] / 30], abs=1e-3)


STAR = np.array([[0, 0, 1, 0, 0], [0, 0, 1, 0, 0], [1, 1, 1, 1, 1], [0, 1, 1, 1, 0], [0, 1, 0, 1, 0]])
SHAPES = [
    *(Aperture(n, 13.0) for n in (3, 4, 5, 6, 8, 9, 50)),
    *(Aperture(7, 20.0, c) for c in (0.25, 0.5, 1.0)),
    *(Aperture(mask=STAR), Aperture(mask=STAR, rotation_deg=30.0), Aperture(mask=np.ones((3, 8)))),
]


def name(shape: Aperture) -> str:
    return f"{shape.blades} blades {shape.curvature}" if shape.blades else f"mask at {shape.rotation_deg:g}"


def square_of_points(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Even points over the square round a circle of radius 1."""
    places = (np.arange(side) + 0.5) / side * 2 - 1
    x, y = np.meshgrid(places, places)
    return x.ravel(), y.ravel()


@pytest.mark.parametrize("shape", SHAPES, ids=name)
def test_counted_points_agree_with_the_area(shape: Aperture) -> None:
    """Of straight blades that is n / (2 pi) sin(2 pi / n) of the circle: 75.7% for five, 82.7% for six."""
    x, y = square_of_points(1501)
    share = shape.inside(2.5 * x, 2.5 * y, 2.5).sum() / (x * x + y * y <= 1).sum()
    straight = bool(shape.blades) and not shape.curvature
    assert share == pytest.approx(shape.area_share, abs=1e-3 if straight else 2e-3)
    if straight:
        expected = shape.blades / (2 * math.pi) * math.sin(2 * math.pi / shape.blades)
        assert shape.area_share == pytest.approx(expected, abs=1e-12)


def test_blades_curve_from_a_polygon_to_the_circle() -> None:
    shares = [Aperture(5, curvature=c).area_share for c in (0.0, 0.2, 0.5, 0.8, 1.0)]
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1, abs=1e-12)
    x, y = square_of_points(301)
    assert (Aperture(5, curvature=1.0).inside(x, y, 1.0) == (x * x + y * y <= 1)).all()


def test_corners_lie_on_the_circle_and_turn_with_the_rotation() -> None:
    """The first corner lies at the rotation, from x towards y; between two corners the edge lies cos(pi / n) in."""
    shape, radius = Aperture(6, 20.0), 4.0
    for k in range(6):
        corner, edge = (math.radians(20 + 60 * k + a) for a in (0, 30))
        for angle, reach in ((corner, radius), (edge, radius * math.cos(math.pi / 6))):
            c, s = np.array([math.cos(angle)]), np.array([math.sin(angle)])
            assert shape.inside(0.999 * reach * c, 0.999 * reach * s, radius).all()
            assert not shape.inside(1.001 * reach * c, 1.001 * reach * s, radius).any()


def test_a_mask_is_seen_from_the_film_with_its_first_row_on_top() -> None:
    mask = np.zeros((4, 4))
    mask[0, 2] = mask[3, 0] = 1.0  # above, just right of the middle; and the lower left corner
    shape = Aperture(mask=mask)
    x, y = np.array([0.3, -0.3, 0.3, -0.7, 0.3]), np.array([0.8, 0.8, -0.8, -0.7, 0.4])
    assert shape.inside(2 * x, 2 * y, 2.0).tolist() == [True, False, False, True, False]
    # What lies beyond the stop's circle stays shut, whatever the mask says.
    assert not shape.inside(np.array([-1.9]), np.array([-1.9]), 2.0).any()
    quarter = Aperture(mask=mask, rotation_deg=90.0)
    assert quarter.inside(-2 * y, 2 * x, 2.0).tolist() == [True, False, False, True, False]


@pytest.mark.parametrize("shape", SHAPES, ids=name)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_torch_and_numpy_agree_and_nan_is_outside(shape: Aperture, dtype: torch.dtype) -> None:
    points = (torch.rand(2, 20_000, generator=torch.Generator().manual_seed(1), dtype=dtype) * 2 - 1) * 3.1
    points[0, 0], points[1, 1] = math.nan, math.nan
    x, y = points
    opened = shape.inside(x, y, 3.0)
    assert opened.numpy().tolist() == shape.inside(x.numpy(), y.numpy(), 3.0).tolist()
    assert not opened[:2].any()


@pytest.mark.parametrize("shape", [Aperture(5), Aperture(8, 10.0, 0.5), Aperture(mask=STAR)], ids=name)
@pytest.mark.parametrize("towards", ["scene", "film"])
def test_the_tracer_passes_the_share_of_the_round_stop(shape: Aperture, towards: str) -> None:
    """Near the axis the stop's image is sharp, so that even points of the pupil are even points of the stop."""
    lens = set_lens(tabled("laikin_double_gauss_50"), f_number=11)
    x, y = (torch.tensor(v) for v in square_of_points(400))
    plane, film_z, reach = pupil_plane_z_mm(lens), lens.film_z_mm, 0.55 * first_order(lens).exit_pupil_diameter_mm
    rays = camera_rays(torch.zeros_like(x), torch.zeros_like(x), film_z, reach * x, reach * y, plane)
    passed = trace(lens, rays).status == 0
    if towards == "film":
        out = trace(lens, rays).rays
        # Turned round, a millimetre before the front surface.
        turned = (out.x + out.dx, out.y + out.dy, out.z + out.dz, -out.dx, -out.dy, -out.dz)
        rays = Rays(*(c[passed] for c in turned))
        passed = trace(lens, rays, towards="film").status == 0
    shaped = trace(lens.with_aperture(shape), rays, towards=towards)  # type: ignore[arg-type]
    assert float((shaped.status == 0).sum() / passed.sum()) == pytest.approx(shape.area_share, abs=0.01)
    # Who is stopped, is stopped by the stop; and shapes only ever take away.
    assert not ((shaped.status == 0) & ~passed).any()
    stopped = shaped.status[passed & (shaped.status != 0)]
    assert set(stopped.tolist()) == {4 * (lens.stop_index + 1) + 2}


def test_round_stops_and_scale_know_nothing_of_blades() -> None:
    lens = tabled("brendel_tessar_100")
    bladed = lens.with_aperture(Aperture(5))
    assert bladed.sha256 == lens.sha256
    assert set_lens(bladed, focal_length_mm=50).aperture == Aperture(5)
    assert bladed.with_aperture(None) == lens


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({}, "blades"),
        ({"blades": 5, "mask": STAR}, "blades"),
        ({"blades": 2}, "3 to 100"),
        ({"blades": 5.0}, "integer"),
        ({"blades": 5, "rotation_deg": math.nan}, "rotation_deg"),
        ({"blades": 5, "curvature": 1.1}, "curvature"),
        ({"mask": np.zeros((4, 4))}, "shut everywhere"),
        ({"mask": np.ones(4)}, "mask"),
        ({"mask": np.ones((2, 5000))}, "4096"),
        ({"mask": np.array([["a"]])}, "mask"),
    ],
)
def test_shapes_that_are_none(fields: dict, expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        Aperture(**fields)


# --- Files


def test_blades_in_a_lens_file(tmp_path: Path) -> None:
    lens = tabled("brendel_tessar_100").with_aperture(Aperture(7, 10.0, 0.25))
    write_lens(lens, tmp_path / "bladed.toml")
    assert read_lens(tmp_path / "bladed.toml").aperture == Aperture(7, 10.0, 0.25)
    with pytest.raises(InputError, match="mask"):
        write_lens(lens.with_aperture(Aperture(mask=STAR)), tmp_path / "mask.toml")


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ("[aperture]\nblades = 1", "aperture, blades"),
        ("[aperture]\nblades = 5\ncurvature = 2.0", "aperture, curvature"),
        ("[aperture]\nblades = 5\nrotation = 3", "rotation_deg"),
        ("aperture = 5", "aperture"),
    ],
)
def test_bad_blades_in_a_lens_file(tmp_path: Path, table: str, expected: str) -> None:
    text = (LENSES / "brendel_tessar_100.toml").read_text()
    path = tmp_path / "bad.toml"
    path.write_text(table + "\n" + text if table.startswith("aperture") else text + "\n" + table + "\n")
    with pytest.raises(InputError, match=expected):
        read_lens(path)


def test_masks_from_pictures(tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    grey = np.array([[0, 100, 140, 255], [255, 0, 0, 0]], np.uint8)
    image.fromarray(grey).save(tmp_path / "grey.png")
    assert read_mask(tmp_path / "grey.png").tolist() == [[False, False, True, True], [True, False, False, False]]
    clear = np.full((2, 2, 4), 255, np.uint8)
    clear[0, 0, 3] = 0  # transparent is shut
    image.fromarray(clear).save(tmp_path / "clear.png")
    assert read_mask(tmp_path / "clear.png").tolist() == [[False, True], [True, True]]
    shape = make_aperture(StopShape(aperture_mask=tmp_path / "grey.png", blade_rotation_deg=5.0))
    assert shape is not None and shape.rotation_deg == 5.0


def test_bad_masks(tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    image.fromarray(np.zeros((2, 2), np.uint8)).save(tmp_path / "dark.png")
    image.fromarray(np.ones((1, 4097), np.uint8)).save(tmp_path / "large.png")
    (tmp_path / "text.png").write_text("no picture")
    (tmp_path / "cut.png").write_bytes((tmp_path / "dark.png").read_bytes()[:40])
    for file, expected in (("dark", "dark"), ("large", "4096"), ("text", "read"), ("cut", "read"), ("none", "exists")):
        with pytest.raises(InputError, match=expected):
            read_mask(tmp_path / f"{file}.png")
    with pytest.raises(InputError, match="not both"):
        make_aperture(StopShape(blades=5, aperture_mask=tmp_path / "dark.png"))
    with pytest.raises(InputError, match="blades"):
        make_aperture(StopShape(blade_rotation_deg=5.0))
    with pytest.raises(InputError, match="curvature"):
        make_aperture(StopShape(aperture_mask=tmp_path / "dark.png", blade_curvature=0.5))
    assert make_aperture(StopShape()) is None
