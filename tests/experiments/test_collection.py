"""The comparison of a collection with ray-optics: what counts as agreement, as a named cause, and as neither."""

from __future__ import annotations

from typing import Any

import pytest

from experiments.collection import PARAXIAL, judged, kind_of
from experiments.collection_tables import source_of, table_of
from neurolens.readers.any_format import read_any

OWN: dict[str, Any] = {
    "efl_mm": 50.0, "back_mm": 30.0, "film_mm": 30.0, "states": [[50.0, 30.0], [80.0, 30.0]],
    "heights_mm": [1.0, 2.0, 3.0, 4.0, 5.0, None],
}  # fmt: skip
THEIRS = OWN | {"rays": [50.0, 30.0], "mended": [], "heights_mm": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]}


def test_files_agree_within_the_limit_at_the_fields_that_both_reach() -> None:
    found = judged(OWN, THEIRS | {"efl_mm": 50.004}, None)
    assert found["cause"] == "" and found["differences"]["efl"] == pytest.approx(8e-5, rel=1e-3)
    assert found["reach"] == [5, 6] and found["differences"]["height 1"] == 0
    assert judged(OWN, THEIRS | {"heights_mm": [1.0, 2.0, 3.0, 4.0, 5.001, 6.0]}, None)["cause"] is None
    assert judged(OWN, THEIRS | {"states": [[50.0, 30.0], [80.0, 30.1]]}, None)["cause"] is None
    assert judged(OWN, THEIRS | {"states": [[50.0, 30.0]]}, None)["cause"] is None


def test_a_cause_is_named_where_the_mended_answer_agrees() -> None:
    wrong = THEIRS | {"efl_mm": 60.0}
    assert judged(OWN, wrong, None)["cause"] == PARAXIAL
    wrong |= {"rays": [60.0, 30.0]}
    assert judged(OWN, wrong, None)["cause"] is None
    assert judged(OWN, wrong, THEIRS | {"mended": ["XASPHERE"]})["cause"] == "XASPHERE"
    assert judged(OWN, wrong, wrong | {"mended": ["XASPHERE"]})["cause"] is None
    assert judged(OWN, {"error": "no"}, THEIRS | {"mended": ["no object"]})["cause"] == "no object"
    assert "does not read" in judged(OWN, {"error": "no"}, {"error": "no"})["cause"]


def test_reasons_of_one_kind_are_one() -> None:
    first = "line 12, SURF: got '3.5', expected surface 0, as they are numbered in order"
    second = "line 7, SURF: got '1', expected surface 11, as they are numbered in order"
    assert kind_of(first) == kind_of(second) != kind_of("line 7, GLAS: got '?', expected a finite number")


def test_a_table_keeps_figures_and_patent_and_no_words_of_its_author(tmp_path: Any) -> None:
    text = "VERS 1\nMODE SEQ\nNAME US 2018/0074300 Example 2 (Some 50mm f/2)\nNOTE 0 By somebody.\nUNIT MM X W\n"
    text += "FNUM 5 0\nFTYP 3 0 2 1\nYFLN 0 9.5 0 0\nWAVM 1 0.5875618 1\nWAVM 2 0.55 1\nPWAV 1\nSURF 0\n  CURV 0 0 0\n"
    text += "  DISZ INFINITY\n  DIAM 0 1 0 0\nSURF 1\n  STOP\n  COMM of somebody\n  TYPE EVENASPH\n  CURV 0.02 0 0 0\n"
    text += "  CONI -1\n  PARM 1 0\n  PARM 2 1e-6\n  DISZ 3\n  GLAS ___BLANK 1 0 1.5 60 0 0\n  DIAM 6 1 0 0\nSURF 2\n"
    text += "  CURV 0 0\n  DISZ 98\n  DIAM 6 1 0\nSURF 3\n  DISZ 0\n  DIAM 9.5 1\nTOL TOFF 0\nMNUM 1 1\n"
    source = source_of(text, "Some 50mm.zmx")
    assert source == "US 2018/0074300, example 2"
    assert source_of("NAME\n", "Microscope USP3893752.zmx") == "US 3893752"
    assert source_of("NAME a lens\n", "a lens.zmx") is None
    table = table_of(text, source)
    assert "ody" not in table and "Some" not in table and "WAVM 2" not in table and "PARM 1" not in table
    (tmp_path / "a.zmx").write_text(text)
    (tmp_path / "b.zmx").write_text(table)
    one, other = read_any(tmp_path / "a.zmx"), read_any(tmp_path / "b.zmx")
    assert other.surfaces == one.surfaces and other.image_radius_mm == one.image_radius_mm
    assert (other.f_number, other.wavelengths_nm) == (one.f_number, one.wavelengths_nm)
