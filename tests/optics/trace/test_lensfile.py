"""Lens files: each mistake is one error that names file, surface and field; what is written reads back the same."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, strategies as st
from shipped import PATHS, SOME

from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.optics.lens.designs import with_assumptions
from neurolens.optics.lens.figures import Cylinder, Figure, figure_of
from neurolens.optics.lens.prescription import Coating, Configuration, Lens, Surface
from neurolens.optics.readers.lensfile import format_lens, read_lens, write_lens
from neurolens.optics.trace.shapes import sag_mm

# A cemented doublet, the stop, a meniscus; surfaces 0 to 5.
GOOD = """
schema = 1
name = "test"
source = "nobody"
f_number = 4.0
rims = "source"
surfaces = [
  { radius_mm = 50.0, thickness_mm = 6.0, diameter_mm = 20.0, n_d = 1.5168, V_d = 64.2 },
  { radius_mm = -50.0, thickness_mm = 2.0, diameter_mm = 20.0, n_d = 1.62, V_d = 36.4, material = "F2" },
  { radius_mm = -200, thickness_mm = 2.0, diameter_mm = 20.0 },
  { radius_mm = inf, thickness_mm = 2.0, diameter_mm = 12.0, stop = true },
  { radius_mm = 40.0, thickness_mm = 3.0, diameter_mm = 18.0, n_d = 1.6, V_d = 50.0 },
  { radius_mm = 60.0, thickness_mm = 70.0, diameter_mm = 18.0 },
]

[[configuration]]
name = "near"
efl_mm = 80.0
thickness_mm = { 2 = 3.0, 5 = 75.0 }
"""

PLATE, AIR = Surface(math.inf, 2.0, 9.0, 1.5, 60.0), Surface(math.inf, 1.0, 9.0)


def replaced(old: str, new: str) -> str:
    assert GOOD.count(old) == 1, f"{old!r} must occur once"
    return GOOD.replace(old, new)


def write(tmp_path: Path, text: str | bytes) -> Path:
    path = tmp_path / "lens.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_reads_what_is_there(tmp_path: Path) -> None:
    path = write(tmp_path, GOOD)
    lens = read_lens(path)
    assert (lens.name, lens.source, lens.f_number, lens.path) == ("test", "nobody", 4.0, str(path))
    assert (lens.image_radius_mm, lens.half_field_deg, lens.film_z_mm) == (None, None, None)
    assert replace(lens.surfaces[1], absorbs_as=None) == Surface(-50.0, 2.0, 20.0, 1.62, 36.4, "F2")
    assert lens.surfaces[3] == Surface(math.inf, 2.0, 12.0, stop=True)
    assert lens.stop_index == 3
    assert lens.configurations == (Configuration("near", 80.0, ((2, 3.0), (5, 75.0))),)


ROW_3 = "{ radius_mm = inf, thickness_mm = 2.0, diameter_mm = 12.0, stop = true }"
POWERS = ", ".join(f"{power} = 0.0" for power in range(3, 41))
ASPHERE = f"{{ radius_mm = inf, thickness_mm = 2.0, diameter_mm = 12.0, asphere = {{ {POWERS} }} }}, "
ROW_5 = "radius_mm = 60.0, thickness_mm = 70.0, diameter_mm = 18.0"
BAD_ROWS = [
    # keys
    (", V_d = 64.2", ", abbe = 64.2", ["surface 0, abbe", "unknown key", "radius_mm, thickness_mm"]),
    ("radius_mm = 50.0", "radius = 50.0", ["surface 0, radius", "unknown key", "did you mean 'radius_mm'?"]),
    ("radius_mm = 50.0, ", "", ["surface 0, radius_mm", "(missing)"]),
    ("thickness_mm = 6.0, ", "", ["surface 0, thickness_mm", "(missing)", "a finite number in mm"]),
    ("n_d = 1.5168, ", "", ["surface 0, n_d", "(missing)", "V_d is given"]),
    (ROW_3, "3.0", ["surface 3", "got 3.0", "a table"]),
    # the stop
    (", stop = true", "", ["surfaces", "no stop", "exactly one"]),
    (ROW_5, ROW_5 + ", stop = true", ["surfaces", "surfaces 3, 5", "exactly one"]),
    ("stop = true", "stop = 1", ["surface 3, stop", "got 1", "true or false"]),
    # figures
    ("diameter_mm = 12.0", "diameter_mm = -12.0", ["surface 3, diameter_mm", "got -12.0", "above 0"]),
    ("radius_mm = 40.0", "radius_mm = 0.0", ["surface 4, radius_mm", "got 0.0", "a plane is inf"]),
    ("thickness_mm = 6.0", "thickness_mm = inf", ["surface 0, thickness_mm", "got inf", "finite"]),
    ("thickness_mm = 6.0", "thickness_mm = 1" + 400 * "0", ["surfaces[0].thickness_mm", "64 bits"]),
    ("n_d = 1.6,", "n_d = 0.99,", ["surface 4, n_d", "got 0.99", "from 1"]),
    ("V_d = 50.0", "V_d = -50.0", ["surface 4, V_d", "got -50.0", "above 0"]),
    ('rims = "source"', 'rims = "source"\nobject_medium = { n = 1.3 }', ["object_medium, n", "did you mean 'n_d'?"]),
    ('rims = "source"', 'rims = "source"\nobject_medium = { n_d = 0.5 }', ["object_medium, n_d", "got 0.5", "from 1"]),
    ('rims = "source"', 'rims = "source"\nwavelengths_nm = [0.55]', ["wavelengths_nm", "got 0.55", "100 to 20000 nm"]),
    # types
    ("radius_mm = 40.0", 'radius_mm = "40.0"', ["surface 4, radius_mm", "got '40.0'", "a number"]),
    ('material = "F2"', "material = 2", ["surface 1, material", "got 2", "a text"]),
    # shapes, media, coatings
    ("n_d = 1.6,", "n_d = 1.6, asphere = {},", ["surface 4, asphere", "{ 4 = 1e-6"]),
    ("n_d = 1.6,", "n_d = 1.6, asphere = { 1 = 1e-6 },", ["surface 4, asphere", "'1'", "from 2 to 42"]),
    ("n_d = 1.6,", 'n_d = 1.6, cylinder = "z",', ["surface 4, cylinder", "'z'", '"x" or "y"']),
    ("n_d = 1.6,", "n_d = 1.6, absorption_per_mm = -1,", ["surface 4, absorption_per_mm", "got -1", "at least 0"]),
    (ROW_5, ROW_5 + ", absorption_per_mm = 0.1", ["surface 5, n_d", "(missing)", "absorption_per_mm is given"]),
    # what cannot be built
    ("thickness_mm = 6.0", "thickness_mm = -1.0", ["surface 0, thickness_mm", "got -1.0", "at least 0"]),
    ("thickness_mm = 6.0", "thickness_mm = 1.0", ["surface 0, thickness_mm", "overlap of 1.02 mm with surface 1"]),
    ("radius_mm = -200", "radius_mm = -11", ["surface 1, thickness_mm", "overlap", "10 mm from the axis"]),
    ("thickness_mm = 2.0, diameter_mm = 12.0", "thickness_mm = -6.0, diameter_mm = 12.0", ["surface 2", "got -4.0"]),
    ("radius_mm = 40.0", "radius_mm = 8.9", ["surface 4, diameter_mm", "got 18.0", "17.8 mm"]),
]
BAD_HEADS = [
    ("schema = 1", "schema = 1\ncoating = 3", ["coating", "got 3", "[[coating]]"]),
    *(
        ("schema = 1", f"schema = 1\ncoating = [{{ {given} }}]", said)
        for given, said in (
            ("name = 'a', layers = []", ["coating 0, layers", "1 to 200 layers"]),
            ("name = 'a', layers = [[1.38]]", ["coating 0, layers", "[1.38]"]),
            ("name = 'a', layers = [[1.38, 90, 0]]", ["coating 0, layer 0, V_d", "above 0"]),
            ("name = 'a', layers = [[1.38, nan]]", ["coating 0, layer 0, thickness_nm", "got nan", "finite"]),
            ("name = 'a', layers = [[2.1, 9], [1.38, '99']]", ["coating 0, layer 1, thickness_nm", "got '99'"]),
            ("name = 'a', layers = [[1.38, 90, 0.3]]", ["coating 0, layer 0, V_d", "got 0.3", "780 nm"]),
            ("name = 'a', layers = [[1.38, 90], []]", ["coating 0, layers", "got []", "thickness in nm"]),
            ("name = 'a'", ["coating 0, layers", "(missing)"]),
            ("layers = [[1.38, 90]]", ["coating 0, name", "(missing)"]),
            ("name = 'a', layers = [[1.38, 90]], waves = [4]", ["coating 0, waves", "unknown"]),
        )
    ),
    ("schema = 1", "", ["schema", "(missing)", "1"]),
    ("schema = 1", "schema = 2", ["schema", "got 2", "expected 1"]),
    ("schema = 1", "schema = 1\nmaker = 'K'", ["maker", "unknown key", "schema, name"]),
    ("schema = 1", "schema = 1\nhalf_field = 20", ["half_field", "did you mean 'half_field_deg'?"]),
    ("schema = 1", "schema = 1\nhalf_field_deg = 200", ["half_field_deg", "got 200", "180"]),
    ("schema = 1", "schema = 1\nimage_radius_mm = -1", ["image_radius_mm", "got -1", "above 0"]),
    ('name = "test"', "", ["name", "(missing)"]),
    ('source = "nobody"', 'source = " "', ["source", "a text"]),
    ("f_number = 4.0", "f_number = 0", ["f_number", "got 0", "above 0"]),
    ('rims = "source"', 'rims = "guessed"', ["rims", "'guessed'", '"estimated"']),
    ('rims = "source"', "", ["rims", "(missing)", '"source", "estimated", "derived" or "photographs"']),
    ("surfaces = [", "rows = [", ["rows", "unknown key"]),
    # zoom states
    ('name = "near"', "", ["configuration 0, name", "(missing)"]),
    ("efl_mm = 80.0", "efl = 80.0", ["configuration 0, efl", "did you mean 'efl_mm'?"]),
    ("2 = 3.0", "6 = 3.0", ['configuration "near", thickness_mm', "got '6'", "from 0 to 5"]),
    ("2 = 3.0", "-1 = 3.0", ['configuration "near", thickness_mm', "got '-1'"]),
    ("2 = 3.0", "2 = inf", ['configuration "near", thickness_mm, surface 2', "got inf"]),
    ("2 = 3.0", "0 = 1.0", ['configuration "near", surface 0, thickness_mm', "overlap"]),
    ("[[configuration]]", "[configuration]", ["configuration", "[[configuration]]"]),
    ("thickness_mm = { 2 = 3.0, 5 = 75.0 }", "thickness_mm = 3.0", ['configuration "near", thickness_mm', "a table"]),
]
BAD_FILES = [
    ("", ["no keys"]),
    ("\n# a comment\n", ["no keys"]),
    (GOOD.replace("]\n\n[[", "\n\n[["), ["valid TOML"]),
    (GOOD.encode("utf-16"), ["UTF-8"]),
    (b"\x00\xff\x00", ["UTF-8"]),
    (GOOD + "#" * 1_000_000, ["1000000 bytes"]),
    (GOOD.replace("surfaces = [", "surfaces = []\nrows = ["), ["rows", "unknown key"]),
    (GOOD[: GOOD.index("surfaces")], ["surfaces", "(missing)"]),
    (GOOD[: GOOD.index("surfaces")] + "surfaces = []", ["surfaces", "got []"]),
    (GOOD[: GOOD.index("surfaces")] + "surfaces = 6", ["surfaces", "got 6"]),
    (GOOD.replace("surfaces = [", f"surfaces = [{27 * ASPHERE}"), ["surfaces", "1026 aspheric", "at most 1000"]),
    (GOOD[: GOOD.index("surfaces")] + f"surfaces = [{501 * (ROW_3 + ', ')}]", ["surfaces", "501", "at most 500"]),
    (GOOD + GOOD[GOOD.index("[[") :], ["configuration 1, name", "'near'", "no other"]),
]


@pytest.mark.parametrize(("old", "new", "words"), BAD_ROWS + BAD_HEADS)
def test_a_mistake_names_file_surface_and_field(tmp_path: Path, old: str, new: str, words: list[str]) -> None:
    refuses(write(tmp_path, replaced(old, new)), words)


@pytest.mark.parametrize(("text", "words"), BAD_FILES)
def test_a_file_that_is_no_lens(tmp_path: Path, text: str | bytes, words: list[str]) -> None:
    refuses(write(tmp_path, text), words)


def test_no_file_and_a_directory(tmp_path: Path) -> None:
    refuses(tmp_path / "nothing.toml", ["missing"])
    refuses(tmp_path, ["not a regular file"])


def refuses(path: Path, words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        read_lens(path)
    message = str(caught.value)
    assert "\n" not in message
    for word in [str(path), *words]:
        assert word in message


@pytest.mark.parametrize("cut", range(0, len(GOOD), 97))
def test_a_truncated_file_is_refused(tmp_path: Path, cut: int) -> None:
    path = write(tmp_path, GOOD[:cut])
    with pytest.raises(InputError, match="lens.toml"):
        read_lens(path)


# What must be accepted, though it looks like a mistake
TOUCHING = 2 * sag_mm(Surface(50.0, 0.0, 20.0), 10.0, 0.0)
BESIDE_STOP = "thickness_mm = 2.0, diameter_mm = 12.0"
ACCEPTED = [
    ({"thickness_mm = 6.0": f"thickness_mm = {TOUCHING!r}"}, (0, "thickness_mm", TOUCHING)),
    ({BESIDE_STOP: BESIDE_STOP.replace("2.0", "-1.5", 1)}, (3, "thickness_mm", -1.5)),  # inside the next element
    # A half ball is a rim of the whole radius.
    ({ROW_5: ROW_5.replace("60.0", "-9.0"), "thickness_mm = 3.0, d": "thickness_mm = 11.0, d"}, (5, "radius_mm", -9.0)),
    *(({"radius_mm = inf": f"radius_mm = {sign}inf"}, (3, "radius_mm", math.inf)) for sign in ("", "+", "-")),
]


@pytest.mark.parametrize(("changes", "kept"), ACCEPTED)
def test_what_looks_like_a_mistake_and_is_none(
    changes: dict[str, str], kept: tuple[int, str, float], tmp_path: Path
) -> None:
    text = GOOD
    for old, new in changes.items():
        assert text.count(old) == 1
        text = text.replace(old, new)
    assert getattr(read_lens(write(tmp_path, text)).surfaces[kept[0]], kept[1]) == kept[2]


def test_a_stop_on_a_glass_surface_may_not_lie_inside_its_neighbours(tmp_path: Path) -> None:
    text = replaced(ROW_3, ROW_3.replace(", stop = true", "")).replace(
        "diameter_mm = 18.0, n_d", "diameter_mm = 18.0, stop = true, n_d"
    )
    assert read_lens(write(tmp_path, text)).stop_index == 4
    for old, new in (
        ("thickness_mm = 3.0, d", "thickness_mm = -3.0, d"),
        ("2.0, diameter_mm = 12.0", "-2.0, diameter_mm = 12.0"),
    ):
        refuses(write(tmp_path, text.replace(old, new)), ["thickness_mm", "same medium before and behind"])


def test_elements_on_both_sides_of_the_stop_must_clear_each_other(tmp_path: Path) -> None:
    text = replaced("radius_mm = -200, thickness_mm = 2.0", "radius_mm = -40, thickness_mm = -0.4")
    text = text.replace("thickness_mm = 2.0, diameter_mm = 12.0", "thickness_mm = -0.4, diameter_mm = 12.0")
    refuses(write(tmp_path, text.replace("2 = 3.0, ", "")), ["surface 2, thickness_mm", "at least 0"])


def test_unknown_dispersion_is_a_warning(tmp_path: Path) -> None:
    path = write(tmp_path, replaced("n_d = 1.6, V_d = 50.0", "n_d = 1.6"))
    with pytest.warns(NeurolensWarning, match=r"lens\.toml.*surface 4: .*constant") as seen:
        assert read_lens(path).surfaces[4].V_d is None
    assert len(seen) == 1


# Round trip
@pytest.mark.parametrize("path", [p for p in PATHS if p.stem in SOME], ids=lambda p: p.stem)
def test_every_shipped_lens_reads_and_comes_back_exactly(path: Path, tmp_path: Path) -> None:
    lens = read_lens(path)
    assert lens.source and lens.lens_id == path.stem
    for state, change in states(lens).items():
        copy = tmp_path / f"{state}.toml"
        write_lens(change, copy)
        again = read_lens(copy)
        assert replace(again, path=change.path) == change
        assert again.sha256 == change.sha256


def states(lens: Lens) -> dict[str, Lens]:
    return {"tabled": lens, "scaled": lens.scaled(1 / 3)}


def test_a_focused_lens_keeps_its_film(tmp_path: Path) -> None:
    lens = replace(read_lens(write(tmp_path, GOOD)), film_z_mm=88.25)
    write_lens(lens, tmp_path / "focused.toml")
    assert read_lens(tmp_path / "focused.toml").vertices_mm[-1] == 88.25


def test_every_kind_of_surface_comes_back(tmp_path: Path) -> None:
    film = Coating("mine", ((1.38, 99.6), (2.1, 12.5, 22.0)))
    asphere = replace(PLATE, radius_mm=40.0, figure=Figure(conic=-1.5, asphere=((3, -1e-5), (4, 1e-7))), coating=film)
    cylinder = replace(PLATE, radius_mm=-80.0, figure=Cylinder(cylinder="x", conic=0.25))
    grey = replace(PLATE, absorption_per_mm=0.23)
    back = Surface(math.inf, 40.0, 9.0, stop=True)
    focus = Configuration("near", None, ((0, 2.5),), f_number=2.9, stop_diameter_mm=8.5, object_distance_mm=750.0)
    lens = Lens("n", "s", (asphere, AIR, cylinder, AIR, grey, back), 2.0, rims="derived", configurations=(focus,))
    for change in (lens, lens.scaled(0.5)):
        write_lens(change, tmp_path / "shapes.toml")
        again = read_lens(tmp_path / "shapes.toml")
        assert replace(again, path=change.path) == with_assumptions(change)
        assert again.sha256 == change.sha256


@pytest.mark.parametrize("name", ["bare", "broadband 500", "three-layer", "multi-layer"])
def test_a_design_on_two_glasses_comes_back(tmp_path: Path, name: str) -> None:
    """Its films differ by the glass: the name alone is written."""
    text = GOOD
    for n_d in ("n_d = 1.6,", "n_d = 1.5168,"):
        text = text.replace(n_d, f'{n_d} coating = "{name}",')
    lens = read_lens(write(tmp_path, text))
    write_lens(lens, tmp_path / "again.toml")
    assert read_lens(tmp_path / "again.toml").surfaces == lens.surfaces
    assert sum(s.coating is not None and s.coating.origin == "source" for s in lens.surfaces) == 2


def test_hashes_of_lens_files_stay() -> None:
    """Cards of models name the hash of their lens: that of every figure is what it was when figures were six fields."""
    shapes: list[tuple[float, dict[str, Any]]] = [
        (30.0, {}),
        (-30.0, {"conic": 1.2, "asphere": [(3, 1e-4), (4, 1e-5)]}),
        (25.0, {"conic": -0.7, "cylinder": "y"}),
        (-18.0, {"cylinder": "x", "conic": -0.6, "asphere": [(2, 1e-3)], "across": (30.0, None)}),
        (25.0, {"cylinder": "y", "across": (14.0, 0.4)}),
        (math.inf, {"focal_mm": 40.0}),
    ]
    rows = tuple(Surface(radius, 5.0, 20.0, 1.5, figure=figure_of(shape)) for radius, shape in shapes)
    known = "bb920500f3b2d54865066b2e1159186796a8a30d0ab0c7c7914ac0ef79af60eb"
    assert Lens("n", "s", rows, 2.0).sha256 == known


@pytest.mark.parametrize(
    "change",
    [
        {"figure": Figure(0.1)},
        {"figure": Figure(asphere=((4, 1e-9),))},
        {"figure": Cylinder(cylinder="y")},
        {"absorption_per_mm": 0.01},
        {"coating": Coating("c", ((1.38, 100.0),))},
    ],
)
def test_whatever_bends_or_weakens_rays_is_in_the_hash(change: dict[str, Any]) -> None:
    surfaces = (replace(PLATE, radius_mm=50.0), replace(AIR, stop=True))
    changed = (replace(surfaces[0], **change), surfaces[1])
    assert Lens("n", "s", surfaces, 2.0).sha256 != Lens("n", "s", changed, 2.0).sha256


texts = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=300)


@given(name=texts, notes=texts | st.text(" \\\"'\n\tab", max_size=400), material=texts.filter(str.strip))
def test_any_text_comes_back(tmp_path_factory: pytest.TempPathFactory, name: str, notes: str, material: str) -> None:
    glass, back = Surface(50.0, 3.0, 9.0, 1.5, 60.0, material), Surface(math.inf, 40.0, 9.0, stop=True)
    lens = Lens("n" + name, "s", (glass, back), 2.0, notes=notes)
    path = tmp_path_factory.getbasetemp() / "text.toml"
    path.write_text(format_lens(lens), encoding="utf-8", newline="")
    assert replace(read_lens(path), path=lens.path) == with_assumptions(lens)


positive = st.floats(1e-3, 1e6)


@given(
    radius=positive, thickness=positive, diameter=st.floats(1e-6, 1e-3), n_d=st.floats(1.0001, 4), V_d=st.floats(1, 1e4)
)
def test_any_figure_comes_back_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory, radius: float, thickness: float, diameter: float, n_d: float, V_d: float
) -> None:
    glass, back = Surface(radius, thickness, diameter, n_d, V_d), Surface(-radius, thickness, diameter, stop=True)
    lens = Lens("n", "s", (glass, back), 2.0)
    path = tmp_path_factory.getbasetemp() / "figures.toml"
    write_lens(lens, path)
    assert replace(read_lens(path), path=lens.path) == with_assumptions(lens)


@pytest.mark.parametrize("radius_mm", [12.0, -12.0, 300.0, -300.0])
def test_sag_of_a_sphere(radius_mm: float) -> None:
    centre_to_rim = math.copysign(math.sqrt(radius_mm**2 - 81), radius_mm)
    assert sag_mm(Surface(radius_mm, 0.0, 20.0), 9.0, 0.0) == pytest.approx(radius_mm - centre_to_rim, rel=1e-12)


def test_an_asphere_may_not_cross_its_neighbour_between_axis_and_rim(tmp_path: Path) -> None:
    # Its sag h^4 / 100 - h^6 / 1500 is 0 on the axis, 0.33 mm at 3.2 mm, and below 0 again at 4 mm.
    bump = replace(PLATE, figure=Figure(asphere=((4, 1e-2), (6, -1e-2 / 15))), thickness_mm=0.25, diameter_mm=8.0)
    lens = Lens("n", "s", (bump, replace(AIR, diameter_mm=8.0), replace(AIR, stop=True)), 2.0)
    write_lens(lens, tmp_path / "bump.toml")
    with pytest.raises(InputError, match="overlap"):
        read_lens(tmp_path / "bump.toml")


def test_a_rim_beyond_the_end_of_a_conic(tmp_path: Path) -> None:
    # The ellipsoid K = 3 of radius 10 mm ends 5 mm from its axis.
    lens = Lens(
        "n",
        "s",
        (replace(PLATE, radius_mm=10.0, figure=Figure(conic=3.0), diameter_mm=10.1), replace(AIR, stop=True)),
        2.0,
    )
    write_lens(lens, tmp_path / "end.toml")
    with pytest.raises(InputError, match="surface 0, diameter_mm"):
        read_lens(tmp_path / "end.toml")


def test_sag_of_a_plane_and_of_nearly_one() -> None:
    assert sag_mm(Surface(math.inf, 0.0, 20.0), 9.0, 0.0) == 0
    assert sag_mm(Surface(1e9, 0.0, 20.0), 1.0, 0.0) == pytest.approx(0.5e-9, rel=1e-12)
