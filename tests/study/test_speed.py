"""The timing harness: what it reports, never how fast. Thresholds belong to `make bench`."""

import math
from pathlib import Path

import pytest

from neurolens.cameras.ideal import Pinhole, ThinLens
from neurolens.readers.lensfile import read_lens
from neurolens.setting.states import set_lens
from neurolens.study.speed import Race, camera_candidate, exact_candidate, race
from neurolens.surrogates.model import Domain
from neurolens.surrogates.pairs import domain_of

LENSES = Path(__file__).parents[2] / "lenses"


LENS = set_lens(read_lens(LENSES / "thorlabs_lb1471_biconvex_50.toml"))


@pytest.fixture(scope="module")
def domain() -> Domain:
    return domain_of(LENS, film_radius_mm=10.0)


def test_a_race_of_cameras_and_the_eager_tracer(domain: Domain) -> None:
    eager = [exact_candidate(LENS, domain)]
    cameras = [camera_candidate(c, domain) for c in (Pinhole(50.0), ThinLens(50.0, 2.0, math.inf))]
    result = race([*eager, *cameras], domain, rounds=3)
    assert list(result.ns) == ["exact eager", "pinhole", "thin"]
    for name in result.ns:
        timing = result.timing(name)
        assert timing is not None and 0 < timing["min"] <= timing["median"] and timing["repeats"] == 3
    there, back = result.speedup("thin", "exact eager"), result.speedup("exact eager", "thin")
    assert there is not None and back is not None
    assert there["min"] * back["min"] == pytest.approx(1)
    assert result.speedup("thin", "thin") == {"min": 1.0, "median": 1.0}


def test_ratios_are_taken_within_rounds() -> None:
    """A machine that slows down tenfold half way changes both times and no ratio."""
    drifting = Race({"model": [1.0, 10.0, 10.0], "exact": [4.0, 40.0, 40.0]}, {"model": 1, "exact": 1})
    assert drifting.speedup("model", "exact") == {"min": 4.0, "median": 4.0}
    assert drifting.speedup("model", "absent") is None
