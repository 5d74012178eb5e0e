"""How cost grows: slopes of known powers, one real point, and clusters whose time follows by hand."""

import math
import sys

import pytest

from experiments import lab
from experiments.cluster import simulated_s
from experiments.growth import CURVES, PROBES, Curve, Found, measured


def found(power: float, memory: float = 0.0) -> Found:
    counts = (10, 100, 1000)
    rows = [{"count": n, "seconds": n**power, "mb": 100.0 * n**memory} for n in counts]
    return Found(Curve("lights", "made", counts, "points", memory_power=0.0), rows)


def test_slopes_are_the_powers() -> None:
    for power, words in ((0.0, "flat"), (0.5, "slower"), (1.0, "as the count"), (2.0, "faster")):
        curve = found(power)
        assert curve.slope("seconds", 0.02) == pytest.approx(power)
        told = curve.told("seconds", 0.02, 1.0)
        assert told.startswith(words) and ("MUST" in told) == (power > 1.1)
    assert "MUST" in found(1.0, memory=0.5).told("mb", 8.0, 0.0)
    assert found(1.0).slope("seconds", 1e9) is None


def test_every_curve_has_its_probe() -> None:
    assert {c.probe for c in CURVES} == PROBES.keys()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="it reads /proc")
def test_a_point_is_measured() -> None:
    row = lab.in_child(measured, "points", 3)
    assert 0 < row["seconds"] < 60 and 0 <= row["mb"] < 4000


def test_simulated_clusters() -> None:
    tasks = [2.0] * 12
    assert simulated_s(tasks, 1, 0.0, 0.0) == pytest.approx(24)
    assert simulated_s(tasks, 3, 0.0, 0.0) == pytest.approx(8)
    assert simulated_s(tasks, 1, 0.1, 0.2) == pytest.approx(12 * 2.3)
    # With more workers than the driver can serve, its time for the tasks is what counts.
    assert simulated_s(tasks, 1000, 0.5, 0.0) == pytest.approx(12 * 0.5 + 2)
    assert math.isclose(simulated_s([], 2, 1.0, 1.0), 0.0)
