"""Records of a run: break-even, the Pareto front, and results.json read back as written."""

from __future__ import annotations

import itertools
import json
import math
import random
from pathlib import Path

import numpy as np
import pytest

from neurolens.base.errors import InputError
from neurolens.evaluate import records
from neurolens.evaluate.records import break_even_rays, pareto_front


def test_break_even_is_where_the_total_times_meet() -> None:
    fit_s, load_s, ns_exact, ns_model = 8.0, 0.5, 48.0, 14.0
    rays = break_even_rays(fit_s, load_s, ns_exact, ns_model)
    assert rays is not None
    assert rays * ns_exact * 1e-9 == pytest.approx(fit_s + load_s + rays * ns_model * 1e-9, rel=1e-12)
    assert break_even_rays(1.0, 0.0, 11.0, 10.0) == pytest.approx(1e9)


@pytest.mark.parametrize(
    "times", [(8, 0.5, 20, 20), (8, 0.5, 20, 30), (None, 0, 9, 1), (8, 0, None, 1), (8, 0, 9, None)]
)
def test_break_even_is_none_where_it_never_pays_or_is_not_known(times: tuple[float | None, ...]) -> None:
    assert break_even_rays(*times) is None


@pytest.mark.parametrize("times", [(-1, 0, 20, 10), (1, 0, math.nan, 10), (math.inf, 0, 20, 10)])
def test_break_even_refuses_times_that_cannot_be(times: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="break_even_rays"):
        break_even_rays(*times)


def test_pareto_front_by_hand() -> None:
    points = [(10, 5.0), (12, 1.0), (11, 6.0), (20, 1.0), (30, 0.2), (12, 2.0), (math.nan, 0.0)]
    assert pareto_front(points) == [0, 1, 4]
    assert pareto_front([]) == []
    assert pareto_front([(1, 1), (1, 1), (2, 1)]) == [0, 1]


def test_pareto_front_agrees_with_its_definition() -> None:
    draw = random.Random(3)
    points = [(draw.randint(0, 12), draw.randint(0, 12)) for _ in range(120)]

    def bettered(p: tuple[int, int]) -> bool:
        return any(q[0] <= p[0] and q[1] <= p[1] and q != p for q in points)

    front = pareto_front(points)
    assert sorted(front) == [i for i, p in enumerate(points) if not bettered(p)]
    assert all(points[i][0] <= points[j][0] for i, j in itertools.pairwise(front))


def test_results_come_back_as_written(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    results = {
        "lens": {"name": "Tessar", "efl_mm": np.float32(50.0)},
        "models": [{"name": "a", "rms_um": math.nan, "ns_per_ray": {"min": np.float64(12.5), "threads": np.int64(1)}}],
        "domain": {"wavelength_nm": np.array([400.0, 700.0]), "focus_m": (2.0, math.inf)},
        "seed": 3,
    }
    records.write_results(path, results)
    text = path.read_text()
    assert "NaN" not in text and "Infinity" not in text  # which JSON does not know
    back = json.loads(text)
    assert back["lens"]["efl_mm"] == 50.0 and back["domain"]["wavelength_nm"] == [400.0, 700.0]
    assert back["models"] == [{"name": "a", "rms_um": None, "ns_per_ray": {"min": 12.5, "threads": 1}}]
    assert back["domain"]["focus_m"] == [2.0, "infinity"] and back["schema_version"] == records.SCHEMA_VERSION
    assert [p.name for p in tmp_path.iterdir()] == ["results.json"]


@pytest.mark.parametrize(
    ("results", "words"),
    [
        ({"modles": []}, "modles"),
        ({"models": {}}, "models.*a list"),
        ({"lens": []}, "lens.*a table"),
        ({"models": [{"rms_um": 1.0}]}, "models 0, name"),
        ({"exact": ["eager"]}, "exact 0, name"),
        ([], "top level"),
    ],
)
def test_results_of_another_shape_are_refused(results: object, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        records.write_results(tmp_path / "results.json", results)  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_number_takes_only_finite_numbers() -> None:
    record = {"a": 1, "b": math.nan, "c": "3", "d": True, "e": {"min": 2.5}, "f": None}
    assert [records.number(record, key) for key in ("a", "b", "c", "d", "e.min", "e.max", "f", "f.min", "g")] == [
        1.0, None, None, None, 2.5, None, None, None, None,
    ]  # fmt: skip
