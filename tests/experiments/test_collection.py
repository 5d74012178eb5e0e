"""The comparison of a collection with ray-optics: what counts as agreement, as a named cause, and as neither."""

from __future__ import annotations

from typing import Any

import pytest

from experiments.collection import PARAXIAL, judged, kind_of

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
