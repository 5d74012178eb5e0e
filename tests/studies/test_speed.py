"""The timing harness: what it reports, never how fast. Thresholds belong to `make bench`."""

import math
from collections import Counter
from pathlib import Path

import pytest
import torch

from neurolens.base.errors import InputError
from neurolens.cameras.ideal import Pinhole, ThinLens
from neurolens.models.fitted import Domain, FilmRays
from neurolens.models.pairs import domain_of
from neurolens.models.terms import pinned_threads
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens
from neurolens.studies.speed import Call, Candidate, Race, Unavailable, camera_candidate, exact_candidate, race

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


def test_every_batch_covers_the_same_rays_and_threads_come_back_after_an_error(domain: Domain) -> None:
    done, before = Counter[int](), torch.get_num_threads()

    def prepare(rays: FilmRays) -> Call:
        done[len(rays)] += len(rays)
        return lambda: None

    race([Candidate("idle", prepare, (4096, 16384))], domain, rounds=1)
    assert done[4096] == done[16384] > 0
    with pytest.raises(RuntimeError), pinned_threads():
        assert torch.get_num_threads() == 1
        raise RuntimeError
    assert torch.get_num_threads() == before


def test_what_cannot_run_is_reported_with_its_reason(domain: Domain) -> None:
    def refuse(_: FilmRays) -> Call:
        raise Unavailable("no such thing here")

    result = race([Candidate("absent", refuse), camera_candidate(Pinhole(50.0), domain)], domain, rounds=1)
    record = {"name": "absent", "available": False, "reason": "no such thing here", "ns_per_ray": None}
    assert result.record("absent") == record and result.record("pinhole")["available"]
    assert result.timing("absent") is None and result.speedup("pinhole", "absent") is None


def test_bad_settings_are_refused(domain: Domain) -> None:
    pinhole = camera_candidate(Pinhole(50.0), domain)
    for words, candidates, rounds in (("differ", [pinhole] * 2, 1), ("round", [pinhole], 0)):
        with pytest.raises(InputError, match=words):
            race(candidates, domain, rounds=rounds)
