"""JSON of DeepLens and ISET: a made-up singlet whose focal length and sag are known in closed form."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.optics.paraxial import first_order
from neurolens.readers.any_format import read_any

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
    assert lens.surfaces[1].asphere == ((2, 0.5 / RADIUS), (6, 1e-7)) and lens.surfaces[1].conic == -1
    assert first_order(lens).efl_mm == pytest.approx(FOCAL, rel=1e-12)


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
        ({"squeeze": 1.5}, "surface 1, squeeze"),
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
