"""JSON prescriptions: the reference set where it is there, DeepLens and ISET, what the forms may say or get wrong."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.readers.json_lens import read_json_lens
from neurolens.optics.readers.source import ReadOptions

SHARED = sorted((Path(__file__).parents[4] / "shared" / "data" / "lenses").glob("*.json"))


def row(radius: float, thickness: float | None, n_d: float | None = None, **more: Any) -> dict[str, Any]:
    return {"radius_mm": radius, "thickness_mm": thickness, "n_d": n_d, "diameter_mm": 16.0, **more}


def singlet(**changes: Any) -> dict[str, Any]:
    rows = [row(50, 5, 1.5, V_d=60, material="CROWN"), row(-50, 2.0), row(0, None, stop=True, diameter_mm=8)]
    return {"name": "singlet", "source": "a book, p. 1", "f_number": 6, "surfaces": rows, **changes}


def read(data: object, tmp_path: Path, options: ReadOptions | None = None) -> Lens:
    path = tmp_path / "lens.json"
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return read_json_lens(path, options)


@pytest.mark.skipif(not SHARED, reason="../shared/data is not here")
def test_reference_set_agrees_with_its_own_figures() -> None:
    """EFL and back focus to the digits printed, in both meridians of the anamorphic ones."""
    for path in SHARED:
        data = json.loads(path.read_text())
        lens = read_json_lens(path)
        lens = replace(lens, surfaces=tuple(replace(s, glass=None) for s in lens.surfaces))
        assert len(lens.surfaces) == len(data["surfaces"])
        for axis, suffix in (("y", ""), ("y", "_y"), ("x", "_x")):
            computed, found = data["computed_at_nd"], first_order(lens, meridian=axis)  # type: ignore[arg-type]
            for key, value in ((f"efl{suffix}_mm", found.efl_mm), (f"bfd{suffix}_mm", found.back_focus_mm)):
                assert value == pytest.approx(computed.get(key, value), abs=6e-6), (path.name, key)
        kept = [
            c for c in (data["configurations"] or {}).get("configs", []) if not c.get("interpolated_by_transcriber")
        ]
        assert [c.name for c in lens.configurations] == [c["name"] for c in kept]


def test_a_last_thickness_of_null_is_the_back_focus(tmp_path: Path) -> None:
    lens = read(singlet(), tmp_path)
    assert lens.surfaces[-1].thickness_mm == pytest.approx(first_order(lens).back_focus_mm)
    assert math.isinf(lens.surfaces[-1].radius_mm)


def test_states(tmp_path: Path) -> None:
    states = [
        {"name": "far", "efl_mm": None, "thickness_overrides": {"1": 2.0}},
        {"name": "mean", "efl_mm": 60, "interpolated_by_transcriber": True, "thickness_overrides": {"1": 1.0}},
        {"name": "near", "object_distance_mm": "0.5 m", "thickness_overrides": {"2": 55.0}, "stop_diameter_mm": 7},
        {"name": "wrong", "object_distance_mm": 9000.0, "thickness_overrides": {"2": 55.0}},
    ]
    with pytest.warns(NeurolensWarning) as told:
        lens = read(singlet(configurations={"configs": states}), tmp_path)
    texts = " / ".join(str(w.message) for w in told)
    assert '"mean" is left out' in texts and "'0.5 m'" in texts and "9000 is stated" in texts
    far, near, _ = lens.configurations
    assert far.efl_mm == pytest.approx(first_order(lens).efl_mm)
    # Newton: x x' = -f^2, with x' the film's distance from the focal point.
    data = first_order(lens)
    beyond = 55.0 - data.back_focus_mm
    assert near.object_distance_mm == pytest.approx(data.efl_mm**2 / beyond - data.front_focal_z_mm)
    assert near.stop_diameter_mm == 7


def test_figures_of_the_file_that_contradict_its_table_are_told(tmp_path: Path) -> None:
    with pytest.warns(NeurolensWarning, match="efl_mm computed from the table is 50.8475; the file says 58"):
        read(singlet(computed_at_nd={"efl_mm": 58.0}), tmp_path)


@pytest.mark.parametrize(
    ("text", "image_radius_mm", "half_field_deg"),
    [
        ("image radius 21.6 mm", 21.6, None),
        ("AOV 45.2 deg; image circle 43.2 mm", 21.6, 22.6),
        ("38 deg half field", None, 38.0),
        ("+-20 deg", None, 20.0),
        ("180 deg full field", None, 90.0),
        ('{"kind": "fisheye", "fullFieldDeg": 180, "imageCircleMm": 28.35}', 14.175, 90.0),
        ("60 deg", None, None),
        (None, None, None),
    ],
)
def test_field(text: str | None, image_radius_mm: float | None, half_field_deg: float | None, tmp_path: Path) -> None:
    lens = read(singlet(field_or_image_circle=text), tmp_path)
    assert lens.image_radius_mm == pytest.approx(image_radius_mm)
    assert lens.half_field_deg == pytest.approx(half_field_deg)


def test_a_named_glass_is_that_of_the_catalogue_where_the_figures_agree(tmp_path: Path) -> None:
    def glass(n_d: float, V_d: float) -> str | None:
        rows = [row(50, 5, n_d, V_d=V_d, material="N-BK7"), *singlet()["surfaces"][1:]]
        return read(singlet(surfaces=rows), tmp_path).surfaces[0].glass

    assert glass(1.5168, 64.17) == "N-BK7"
    assert glass(1.517, 64.2) is None and glass(1.5168, 60.0) is None


def test_rims_of_doubtful_origin_are_marked(tmp_path: Path) -> None:
    assert read(singlet(), tmp_path).rims == "source"
    assert read(singlet(diameters_estimated=True), tmp_path).rims == "estimated"
    assert read(singlet(notes="Clear diameters trimmed here."), tmp_path).rims == "estimated"


def test_an_f_number_that_is_not_stated(tmp_path: Path) -> None:
    data = first_order(read(singlet(), tmp_path))
    assert read(singlet(f_number=None), tmp_path).f_number == pytest.approx(data.f_number)
    assert read(singlet(f_number=None), tmp_path, ReadOptions(f_number=7.0)).f_number == 7.0
    assert read(singlet(), tmp_path, ReadOptions(f_number=7.0)).f_number == 6.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"colour": 1}, r"colour: got \(unknown key\)"),
        ({"name": None}, r"name: got None, expected a text"),
        ({"f_number": -1}, r"f_number: got -1"),
        ({"surfaces": []}, r"surfaces: got \(0 of them\)"),
        ({"surfaces": [3]}, r"surface 0: got 3"),
        ({"surfaces": [row(50, 5, 1.5)]}, r"stop: got \(none\)"),
        ({"surfaces": [row(50, 5, tilt=3)]}, r"surface 0, tilt: got \(unknown key\)"),
        ({"surfaces": [row(50, 5, shape="torus")]}, r"surface 0, shape: got 'torus', expected one of sphere"),
        ({"surfaces": [row(50, 5, stop=1)]}, r"surface 0, stop: got 1"),
        ({"surfaces": [row(50, 5, material="BK7")]}, r"surface 0, n_d: got \(null\)"),
        ({"surfaces": [row(50, 5, 1.5, diameter_mm=None)]}, r"surface 0, diameter_mm: got \(null\)"),
        ({"surfaces": [row(50, 5, aspheric_coefficients={"1": 1e-3}, stop=True)]}, r"got '1', expected a power from 2"),
        ({"configurations": [{"name": "a", "thickness_overrides": {"7": 1}}]}, r"got '7', expected a surface number"),
        ({"configurations": [{"name": "a", "thickness_overrides": {"0": -3}}]}, r"thickness_mm: got -3"),
        ({"configurations": [{"name": "a", "thickness_overrides": {}, "zoom": 1}]}, r"zoom: got \(unknown key\)"),
        ({"configurations": [{"name": "a", "efl_mm": 1, "thickness_overrides": {}}] * 2}, r"name: got 'a'"),
    ],
)
def test_refusals(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        read(singlet(**change), tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[1, 2]", r"file: got \(a list\)"),
        ('{"name": "a", "name": "b"}', r"the key 'name' is given twice"),
        ('{"surfaces": NaN}', r"NaN is no finite number"),
        ('{"name": -Infinity}', r"-Infinity is no finite number"),
        ('{"name": "a"}', r"format: got \(not known: JSON without the key surfaces\)"),
        ('{"name": "a"', r"file: got \(Expecting"),
        ("[" * 100_000, r"expected valid JSON, none of ray-optics or Optiland"),
        ('{"f_number": 1' + "0" * 5000 + "}", r"f_number|expected valid JSON"),
    ],
)
def test_text_that_is_no_prescription(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        read(text, tmp_path)


N, RADIUS = 1.5, 50.0
FOCAL = RADIUS / (N - 1)
STOP = {"type": "Aperture", "r": 5.0, "(d)": 0.0, "mat2": "air", "d_next": 4.0, "is_square": False}
FRONT = {"idx": 2, "type": "Spheric", "r": 9.0, "c": 0.02, "roc": RADIUS, "mat2": "1.5/60.0", "d_next": 6.0}
REAR = {"type": "Spheric", "r": 9.0, "c": 0.0, "(roc)": 0.0, "mat1": "1.5/60.0", "mat2": "air", "d_next": 95.0}
DEEPLENS: dict[str, Any] = {"info": "Made up", "foclen": FOCAL, "r_sensor": 12.0, "surfaces": [STOP, FRONT, REAR]}
ISET: dict[str, Any] = {
    "name": "singlet",
    "type": "multi element lens",
    "surfaces": [
        {"radius": 0, "thickness": 4.0, "ior": 0, "semi_aperture": 5.0},
        {"radius": RADIUS, "thickness": 6.0, "ior": N, "semi_aperture": 9.0},
        {"radius": 0, "thickness": 0, "ior": 1, "semi_aperture": 9.0},
    ],
}


def written(folder: Path, data: Any) -> Path:
    path = folder / "lens.json"
    path.write_text(json.dumps(data))
    return path


@pytest.mark.parametrize("data", [DEEPLENS, ISET])
def test_a_singlet_has_the_focal_length_of_its_figures(data: dict[str, Any], tmp_path: Path) -> None:
    lens = read_any(written(tmp_path, data))
    found = first_order(lens)
    assert found.efl_mm == pytest.approx(FOCAL, rel=1e-12) and found.back_focus_mm == pytest.approx(FOCAL - 6 / N)
    assert (lens.stop_index, lens.surfaces[1].diameter_mm) == (0, 18.0) and math.isinf(lens.surfaces[2].radius_mm)
    film = lens.surfaces[-1].thickness_mm
    assert film == 95.0 if data is DEEPLENS else film == pytest.approx(FOCAL - 6 / N)
    assert lens.image_radius_mm == (12.0 if data is DEEPLENS else None)


def test_terms_of_an_asphere_begin_with_the_square(tmp_path: Path) -> None:
    """A plane with a_1 r^2 is a parabola of radius 1 / (2 a_1); the terms said twice count once."""
    terms = [0.5 / RADIUS, 0.0, 1e-7]
    front = {**FRONT, "type": "Aspheric", "c": 0.0, "k": -1.0, "ai": terms, "ai2": terms[0], "ai6": terms[2]}
    del front["roc"]
    lens = read_any(written(tmp_path, {**DEEPLENS, "surfaces": [STOP, front, REAR]}))
    assert lens.surfaces[1].figure.asphere == ((2, 0.5 / RADIUS), (6, 1e-7)) and lens.surfaces[1].figure.conic == -1
    assert first_order(lens).efl_mm == pytest.approx(FOCAL, rel=1e-12)


def test_a_stop_without_a_medium_and_keys_of_the_program(tmp_path: Path) -> None:
    """DeepLens writes apertures without mat2; a key that it does not know is left out and named."""
    bare = {key: value for key, value in STOP.items() if key != "mat2"}
    expected = read_any(written(tmp_path, DEEPLENS))
    with pytest.warns(NeurolensWarning, match="left out, unknown or without effect on rays: squeeze"):
        lens = read_any(written(tmp_path, {**DEEPLENS, "surfaces": [{**bare, "squeeze": 1.5}, FRONT, REAR]}))
    assert lens.surfaces == expected.surfaces
    with pytest.raises(InputError, match="DOE: got .given., expected a lens without a diffractive element"):
        read_any(written(tmp_path, {**DEEPLENS, "DOE": {"type": "Binary2"}}))


def test_a_focal_length_that_is_not_that_of_the_surfaces_is_said(tmp_path: Path) -> None:
    with pytest.warns(NeurolensWarning, match="foclen says 90 mm, the first order of its surfaces 100 mm"):
        read_any(written(tmp_path, {**DEEPLENS, "foclen": 90.0}))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"type": "Diffractive"}, "surface 1, type: got 'Diffractive'"),
        ({"mat2": "glas"}, "surface 1, mat2"),
        ({"mat2": "1.5/x"}, "surface 1, mat2"),
        ({"mat2": None}, "surface 1, mat2"),
        ({"roc": "50"}, "surface 1, roc"),
        ({"type": "Aspheric", "ai": [None]}, r"surface 1, ai\[0\]"),
        ({"type": "Aspheric", "ai": 3}, "surface 1, ai"),
        ({"r": 0}, "surface 1, r"),
    ],
)
def test_bad_input_names_surface_and_field(change: dict[str, Any], words: str, tmp_path: Path) -> None:
    path = written(tmp_path, {**DEEPLENS, "surfaces": [STOP, {**FRONT, **change}, REAR]})
    with pytest.raises(InputError, match=words):
        read_any(path)


def test_spectral_indices_of_iset_are_refused(tmp_path: Path) -> None:
    rows = [{**row, "ior": [N, N]} if row["ior"] == N else row for row in ISET["surfaces"]]
    with pytest.raises(InputError, match="surface 1, ior"):
        read_any(written(tmp_path, {**ISET, "surfaces": rows}))
