"""The shipped prescriptions: first-order data next to what their sources state."""

from pathlib import Path

import pytest

from neurolens.optics.lensfile import read_lens
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Lens

pytestmark = pytest.mark.filterwarnings("ignore::neurolens.base.errors.NeurolensWarning")
LENSES = Path(__file__).parents[2] / "lenses"
# Stated focal length in mm; number of refracting surfaces.
STATED = {
    "laikin_double_gauss_50": (50.0, 12),
    "brendel_tessar_100": (100.0, 7),
    "tronnier_double_gauss_100": (100.0, 10),
    "muller_fisheye_100": (100.0, 11),
    "ogawa_zoom_70_200": (72.1, 33),
    "thorlabs_lb1471_biconvex_50": (50.0, 2),
    "shimizu_fisheye_220": (6.3, 23),
}


def lens(name: str) -> Lens:
    return read_lens(LENSES / f"{name}.toml")


def test_every_shipped_lens_is_checked() -> None:
    assert set(STATED) <= {path.stem for path in LENSES.glob("*.toml")}


@pytest.mark.parametrize("name", STATED)
def test_focal_length_and_f_number_are_those_of_the_source(name: str) -> None:
    efl_mm, refractions = STATED[name]
    data = first_order(lens(name))
    assert data.efl_mm == pytest.approx(efl_mm, rel=0.01)
    assert data.f_number == pytest.approx(lens(name).f_number, rel=0.03)
    assert sum(not s.stop for s in lens(name).surfaces) == refractions


# The tables of the zoom and of this fisheye stand 2 mm out of focus, as their notes say.
@pytest.mark.parametrize("name", sorted(STATED.keys() - {"ogawa_zoom_70_200", "shimizu_fisheye_220"}))
def test_tabled_film_lies_at_the_focus(name: str) -> None:
    table = lens(name)
    assert table.vertices_mm[-1] == pytest.approx(first_order(table).rear_focal_z_mm, abs=0.01 * table.vertices_mm[-1])


@pytest.mark.parametrize(
    ("configuration", "efl_mm", "half_field_deg"),
    [("72mm", 72.1, 17.0), ("135mm", 135.0, 9.15), ("194mm", 194.01, 6.0)],
)
def test_zoom_states(configuration: str, efl_mm: float, half_field_deg: float) -> None:
    zoomed = lens("ogawa_zoom_70_200").at(zoom=configuration)
    assert first_order(zoomed).efl_mm == pytest.approx(efl_mm, rel=0.001)
    assert first_order(zoomed).f_number == pytest.approx(2.8, rel=0.001)
    assert zoomed.half_field_deg == half_field_deg


@pytest.mark.parametrize(("name", "efl_mm"), [("brendel_tessar_100", 50), ("muller_fisheye_100", 14)])
def test_rescaling_keeps_angles_and_f_number(name: str, efl_mm: float) -> None:
    small = lens(name).at(focal_length_mm=efl_mm)
    assert first_order(small).efl_mm == pytest.approx(efl_mm, rel=1e-12)
    assert first_order(small).f_number == pytest.approx(first_order(lens(name)).f_number, rel=1e-12)
    assert small.half_field_deg == lens(name).half_field_deg
