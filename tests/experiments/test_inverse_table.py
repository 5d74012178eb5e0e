"""The benchmark of inverse maps: its counts are what they say."""

from __future__ import annotations

from pathlib import Path

import pytest

from experiments.inverse import measure_lens, page

LENSES = Path(__file__).parents[2] / "lenses"


@pytest.mark.slow
def test_a_lens_is_measured_and_shown() -> None:
    record = measure_lens(LENSES / "cooke_triplet_50.toml", rays=2000, uniform=500, terms=24)
    for dtype in ("float64", "float32"):
        assert record["ours"][dtype]["stop"]["converged"] == record["ours"][dtype]["scene"]["converged"] == 1
    uniform = record["uniform"]
    shares = [uniform[k] for k in ("passed", "blocked", "outside", "unsolved")]
    assert sum(shares) == pytest.approx(1) and uniform["missed"] <= uniform["unsolved"]
    missed = list(record["published"]["scene"]["missed"].values())
    assert missed == sorted(missed, reverse=True)  # more steps miss no more, where the map is tame
    refused = {"lens": "other", "refused": "a reason"}
    text = page([record, refused])
    assert "cooke_triplet_50" in text and "a reason" in text
