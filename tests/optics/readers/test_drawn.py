"""Formats of collections: they come back, and say what they lack, with what was assumed."""

import json
import math
import re
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
from lens_formats import DRAWN, optical_bench, plain, swapped
from shipped import tabled

from neurolens.base.errors import AssumedWarning, InputError
from neurolens.optics.lens.designs import coated
from neurolens.optics.lens.figures import Toroid
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.readers.any_format import kind_of, read_any
from neurolens.studies.survey import SurveySettings, Task, run_task

GAUSS = plain(tabled("laikin_double_gauss_50"))


def read_text(text: str, suffix: str, tmp_path: Path) -> tuple[Lens, list[str]]:
    """The lens and what was assumed."""
    path = tmp_path / f"lens{suffix}"
    path.write_text(text, encoding="utf-8")
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        lens = read_any(path)
    return lens, [str(w.message) for w in heard if issubclass(w.category, AssumedWarning)]


@pytest.mark.parametrize("suffix", DRAWN)
def test_rims_twice_too_wide_are_noticed_by_the_stop(suffix: str, tmp_path: Path) -> None:
    wide = replace(GAUSS, surfaces=tuple(replace(s, diameter_mm=2 * s.diameter_mm) for s in GAUSS.surfaces))
    text = DRAWN[suffix](wide)
    n = first_order(GAUSS).f_number
    if suffix == ".lens":
        text = f"# {len(GAUSS.surfaces)} surfaces, 6 glass elements, f/{n:.1f}\n" + text
    else:
        text = swapped(repr(first_order(wide).f_number), repr(n), text)
    found, assumed = read_text(text, suffix, tmp_path)
    assert len(assumed) == 1 and "half as wide" in assumed[0] and "f/0.904" in assumed[0]
    for a, b in zip(found.surfaces, GAUSS.surfaces, strict=True):
        assert a.diameter_mm == pytest.approx(b.diameter_mm, rel=1e-9)


def test_a_comment_of_thousands_of_digits_states_no_count(tmp_path: Path) -> None:
    found, assumed = read_text(f"# {'7' * 5000} surfaces, f/2\n" + DRAWN[".lens"](GAUSS), ".lens", tmp_path)
    assert len(found.surfaces) == len(GAUSS.surfaces) and not any("777" in text for text in assumed)


def test_rims_beyond_a_sphere_are_noticed_without_an_f_number(tmp_path: Path) -> None:
    wide = replace(GAUSS, surfaces=tuple(replace(s, diameter_mm=2 * s.diameter_mm) for s in GAUSS.surfaces))
    found, assumed = read_text(DRAWN[".lens"](wide), ".lens", tmp_path)
    assert "wider than its sphere" in assumed[0]
    assert found.surfaces[0].diameter_mm == pytest.approx(GAUSS.surfaces[0].diameter_mm)


def test_a_missing_stop_is_assumed_at_the_narrowest_rim(tmp_path: Path) -> None:
    text = optical_bench(GAUSS).replace("\tAS\t", "\tInfinity\t")
    found, assumed = read_text(text, ".bench.txt", tmp_path)
    assert "no stop is marked" in assumed[0]
    assert found.stop_index == min(range(len(GAUSS.surfaces)), key=lambda k: GAUSS.surfaces[k].diameter_mm)
    record = json.loads(run_task(Task("a.txt", text.encode(), SurveySettings(fit=False))))
    assert record["verdict"] == "doubtful" and "no stop is marked" in record["doubts"][0]


def test_rims_that_touch_are_narrowed_to_where_they_meet(tmp_path: Path) -> None:
    rows = [replace(s, diameter_mm=s.diameter_mm) for s in GAUSS.surfaces]
    k = next(k for k, s in enumerate(rows) if not math.isinf(s.radius_mm))
    rows[k] = replace(rows[k], diameter_mm=1.99 * abs(rows[k].radius_mm))
    rows[k + 1] = replace(rows[k + 1], diameter_mm=1.99 * abs(rows[k].radius_mm))
    found, _ = read_text(DRAWN[".lens"](replace(GAUSS, surfaces=tuple(rows))), ".lens", tmp_path)
    a, b = found.surfaces[k : k + 2]
    h = min(a.semi_diameter_mm, b.semi_diameter_mm)
    assert h < 0.99 * abs(a.radius_mm)
    gap = a.thickness_mm + (b.radius_mm - math.copysign(math.sqrt(b.radius_mm**2 - h * h), b.radius_mm))
    gap -= a.radius_mm - math.sqrt(a.radius_mm**2 - h * h)
    assert 0 <= gap < 0.01


def test_a_folded_table_is_refused_by_its_thickness(tmp_path: Path) -> None:
    """Of a mirror lens: light goes back, which the format cannot say."""
    rows = [replace(s, thickness_mm=-s.thickness_mm) if k == 3 else s for k, s in enumerate(GAUSS.surfaces)]
    with pytest.raises(InputError, match="surface 3, thickness_mm: got -.*expected at least 0"):
        read_text(DRAWN[".lens"](replace(GAUSS, surfaces=tuple(rows))), ".lens", tmp_path)


ZOOM = """[descriptive data]
title\tA zoom
[variable distances]
Focal Length\t50.0\t50.0\tundefined
F-Number\t4\t4.4\tundefined
Angle of View\t40\t38\tundefined
Image Height\t36
d0\tInfinity\t1000\tInfinity
d2\t2.0\t3.0\tundefined
[lens data]
1\t60\t6\t1.6\t30\t50
2\t-80\td2\t\t30
3\tAS\t4\t\t14
4\tInfinity\t2\t1.5\t24\t60\tNBK9
5\tInfinity\tBf\t\t24
[aspherical data]
1\t60\t-0.5\t1E-06\t\t2e-10
"""


@pytest.mark.parametrize("row", ["4\t362.913\t{}\t", "13\t-1178.029\t{}\t"])
@pytest.mark.parametrize("gap", ["nan", "inf"])
def test_a_thickness_that_is_no_length_is_refused(row: str, gap: str, tmp_path: Path) -> None:
    thickness = {"4": "2.032", "13": "35.509"}[row.partition("\t")[0]]
    text = swapped(row.format(thickness), row.format(gap), optical_bench(GAUSS))
    with pytest.raises(InputError, match=rf"surface {row.partition(chr(9))[0]} of the file, thickness: got {gap}"):
        read_text(text, ".bench.txt", tmp_path)


def test_optical_bench_states_field_and_aspheres(tmp_path: Path) -> None:
    lens, assumed = read_text(ZOOM, ".txt", tmp_path)
    assert assumed == [] and kind_of(tmp_path / "lens.txt") == "Optical Bench"
    assert [(c.name, c.object_distance_mm) for c in lens.configurations] == [
        ("50 mm", None),
        ("50 mm at 1000 mm", 1000),
    ]
    assert dict(lens.configurations[1].thickness_mm)[1] == 3.0 and lens.surfaces[1].thickness_mm == 2.0
    assert lens.half_field_deg == 20 and lens.image_radius_mm == 18 and lens.f_number == 4
    assert lens.surfaces[0].figure.conic == -0.5 and lens.surfaces[0].figure.asphere == ((4, 1e-6), (8, 2e-10))
    assert lens.surfaces[-1].thickness_mm == pytest.approx(first_order(lens).back_focus_mm)


def test_the_stop_s_diameter_of_an_optical_bench_file_is_kept(tmp_path: Path) -> None:
    """It rules over the f-number, of which a contradiction is told; without it the f-number sizes the stop."""
    plain_lens, _ = read_text(ZOOM, ".txt", tmp_path)
    for opening_mm, doubted in ((plain_lens.surfaces[2].diameter_mm, False), (9.0, True)):
        path = tmp_path / "lens.txt"
        path.write_text(swapped("d0\t", f"Aperture Diameter\t{opening_mm!r}\t{opening_mm!r}\nd0\t", ZOOM))
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always")
            lens = read_any(path)
        assert lens.surfaces[2].diameter_mm == opening_mm and lens.f_number == 4
        assert any("the diameter is kept" in str(w.message) for w in heard) == doubted


@pytest.mark.parametrize(
    ("constant", "powers"),
    [("", (4, 6, 8, 10)), ("AsphericalA2", (2, 4, 6, 8)), ("AsphericalOddCount\t1", (3, 4, 6, 8)),
     ("AsphericalOddCount\t2", (3, 4, 5, 6))],
)  # fmt: skip
def test_optical_bench_powers(constant: str, powers: tuple[int, ...], tmp_path: Path) -> None:
    """With one odd power A3, A4, A6, ...: so does Table 1 of US 7,663,816, whose file has the constant 1."""
    text = swapped("[variable", f"[constants]\n{constant}\n[variable", ZOOM)
    text = swapped("-0.5\t1E-06\t\t2e-10", "0\t1e-9\t2e-9\t3e-9\t4e-11", text)
    lens, _ = read_text(text, ".txt", tmp_path)
    assert tuple(p for p, _ in lens.surfaces[0].figure.asphere) == powers


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("\td2\t", "\td3\t", "d3"),
        ("1\t60\t-0.5", "1\t61\t-0.5", "61"),
        ("1\t60\t-0.5", "9\t60\t-0.5", "the number of a surface"),
        ("2\t-80", "1\t-80", "a number of its own"),
        ("1.6\t30\t50", "0.6\t30\t50", "index"),
        ("1.6\t30\t50", "0.0\t30\t50", "surface 1 of the file, index"),
        ("1\t60\t6", "1 60 6", "between tabs"),
        ("1E-06", "1E-0x", "coefficient"),
        ("[constants]", "[constants]\nAsphericalOddCount\t-1", "how many odd powers"),
    ],
)
def test_optical_bench_mistakes(old: str, new: str, said: str, tmp_path: Path) -> None:
    text = swapped("[variable", "[constants]\n[variable", ZOOM)
    with pytest.raises(InputError, match=re.escape(said)):
        read_text(swapped(old, new, text), ".txt", tmp_path)


@pytest.mark.parametrize(
    ("suffix", "old", "new", "said"),
    [
        (".lens", "surfaces:", "surfaces", "format: got (not known)"),
        (".lens", " 1  # row", " 1 torus # row", "one of spherical"),
        (".lens", " 1  # row", " 1 toric # row", "toric with a radius other than 0"),
        (".lens", " 1  # row", " # row", "6 figures"),
        (".camera.toml", "ior = 1.0", "iro = 1.0", "iro"),
        (".camera.toml", 'type = "spherical"', 'type = "round"', "one of spherical"),
        (".camera.toml", 'type = "spherical"', 'type = "spherical"\nconic = 1.0', "aspheric"),
        (".camera.toml", "aperture = ", "aperture = -", "above 0"),
        (".camera.toml", "[lens]", "[focus]\nclose_distance = 300.0\n[lens]", "focus, variable"),
    ],
)
def test_collection_mistakes(suffix: str, old: str, new: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=re.escape(said)):
        read_text(swapped(old, new, DRAWN[suffix](GAUSS)), suffix, tmp_path)


def test_a_toric_row_is_a_circle_along_y_turned_about_y(tmp_path: Path) -> None:
    lens, _ = read_text(swapped(" 1  # row", " 1 toric 95.5 # row", DRAWN[".lens"](GAUSS)), ".lens", tmp_path)
    first, plain_first = coated(lens, "stated").surfaces[0], GAUSS.surfaces[0]  # without the assumed coating
    assert first == replace(plain_first, radius_mm=95.5, figure=Toroid(cylinder="y", across_mm=plain_first.radius_mm))


def test_optical_bench_oddities(tmp_path: Path) -> None:
    text = swapped("d2\t2.0", "d2\t2.0 // a word", swapped("4\tInfinity", "4\t-Infinity", ZOOM))
    text = swapped("5\tInfinity\tBf\t\t24\n", "", text) + "1(WX)\t60\t0\t1\n"
    lens, assumed = read_text(text, ".txt", tmp_path)
    assert len(assumed) == 1 and "the last medium is glass" in assumed[0]
    assert [s.radius_mm for s in lens.surfaces[3:]] == [math.inf, math.inf] and lens.surfaces[-1].n_d == 1
    assert lens.surfaces[0].figure.conic == -0.5


def test_near_state_of_a_camera_file(tmp_path: Path) -> None:
    text = DRAWN[".camera.toml"](GAUSS)
    text += "[focus]\nclose_distance = 500.0\n[[focus.variable]]\nsurface = 1\nthickness_close = 0.5\n"
    lens, _ = read_text(text, ".camera.toml", tmp_path)
    (near,) = lens.configurations
    assert near.object_distance_mm == 500 and dict(near.thickness_mm)[1] == 0.5
