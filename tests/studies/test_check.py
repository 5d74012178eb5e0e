"""Promises of a card on fresh rays: true ones hold, whatever the seed; each one that is not true fails by itself."""

import copy
import math
from collections.abc import Iterator
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from lens_models import domain, exported, lens, model
from scipy.stats import poisson
from shipped import whole
from vignetting_oracle import vignetting_errors

from neurolens.cameras.model import load_model
from neurolens.models.pairs import passing_rays
from neurolens.studies import check
from neurolens.studies.check import check_model, promises_of, share_promise
from neurolens.studies.measure import (
    STOPS,
    ZONED,
    fresh_rays,
    measure,
    measure_on,
    onnx_predictor,
    with_more,
)
from neurolens.studies.rays import ZONES

RAYS = 6000


@pytest.fixture(autouse=True, scope="module")
def traced_once() -> Iterator[None]:
    """Fresh rays of one lens and domain, by their number and seed: tracing them takes most of a check's time."""
    passing = cache(lambda count, seed: passing_rays(lens(), domain(), count, seed))
    fresh = cache(lambda known, count, seed: fresh_rays(lens(), domain(), passing(known, seed), count=count, seed=seed))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(check, "passing_rays", lambda _, __, count, seed: count)
        patch.setattr(check, "fresh_rays", lambda _, __, known, count, seed: fresh(known, count, seed))
        yield


@pytest.fixture(scope="module")
def errors() -> dict[str, Any]:
    """The errors that the exported polynomial's card would promise."""
    held_out = passing_rays(lens(), domain(), RAYS, 3)
    return measure_on(
        fresh_rays(lens(), domain(), held_out, count=4 * RAYS, seed=55), load_model(exported("invariants"))
    )


def broken(errors: dict[str, Any], seed: int | None = None, rays: Any = None) -> set[str]:
    """Promises of a card with these errors that do not hold for the model, or for one that gives other rays."""
    known = load_model(exported("invariants"))
    promising = SimpleNamespace(card={**known.card, "errors": errors}, rays=rays or known.rays)
    return {p.key for p in check_model(promising, lens(), rays=RAYS, seed=seed)[1] if not p.holds}  # type: ignore[arg-type]


def leaves(table: dict[str, Any], place: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    for key, value in table.items():
        if isinstance(value, dict):
            yield from leaves(value, (*place, key))
        elif key in ("rms_um", "direction_rms_deg", "p99_um", "position_rms_um", "transmittance_rms"):
            yield (*place, key)


@pytest.mark.parametrize("seed", [None, *whole(11, 12)])
def test_what_was_measured_holds_on_other_rays(errors: dict[str, Any], seed: int | None) -> None:
    assert broken(errors, seed) == set()


def test_a_card_has_every_zone_open_and_stopped_down(errors: dict[str, Any]) -> None:
    assert set(errors["zones"]) == set(ZONED) and set(errors["stopped_down"]) == set(STOPS) - {"full"}
    for zones in errors["zones"].values():
        assert set(zones) == set(ZONES)
    zones = errors["zones"]["full"]
    total = sum(z["rays"] * z["rms_um"] ** 2 for z in zones.values()) / sum(z["rays"] for z in zones.values())
    assert total == pytest.approx(errors["rms_um"] ** 2, rel=2e-3)


def test_every_figure_that_promises_too_much_fails_and_no_other(errors: dict[str, Any]) -> None:
    corrupted, every = copy.deepcopy(errors), list(leaves(errors))
    for place in every:
        table = corrupted
        for key in place[:-1]:
            table = table[key]
        table[place[-1]] *= 0.5
    assert broken(corrupted) == {".".join(p for p in place if p != "zones") for place in every}
    alone = copy.deepcopy(errors)
    alone["zones"]["full"]["mid"]["direction_rms_deg"] *= 0.6
    assert broken(alone) == {"full.mid.direction_rms_deg"}


@pytest.mark.slow
def test_an_error_that_few_rays_decide_is_found_again_on_others() -> None:
    """One ray in five hundred, in a narrow band of colour, is off by far more than all others: the RMS is theirs."""
    known, (low, high) = load_model(exported("invariants")), domain().wavelength_nm

    def rays(film: Any, pupil: Any, wavelength: Any, *rest: Any) -> Any:
        out = known.rays(film, pupil, wavelength, *rest)
        out.scene_ray[3] += 1e-3 * (np.abs(wavelength - (low + high) / 2) < 0.001 * (high - low))
        return out

    model_ = SimpleNamespace(card=known.card, rays=rays)
    held_out = passing_rays(lens(), domain(), RAYS // 8, 3)
    few = fresh_rays(lens(), domain(), held_out, count=RAYS, seed=55)
    rms = []
    for seed in (4, 5):
        many = with_more(few, 100 * seed)
        model_.card = {**known.card, "errors": measure_on(many, model_)}  # type: ignore[arg-type]
        figures, promises = check_model(model_, lens(), rays=RAYS // 8, seed=seed)  # type: ignore[arg-type]
        assert [p for p in promises if not p.holds] == []
        assert figures["rays"] == len(many.held_out) == RAYS
        rms.append(figures["rms_um"])
    assert max(rms) < 1.5 * min(rms) and min(rms) > 2 * measure_on(few, known)["rms_um"]


@pytest.mark.parametrize("counted", [0.1, 1.0, 5.0, 50.0, 500.0])
@pytest.mark.parametrize("ratio", [0.1, 0.6, 3.0])
def test_a_share_holds_on_other_rays_however_few_it_counts(counted: float, ratio: float) -> None:
    """Exact sums over Poisson counts: a true promise breaks less than once in 5000; a double one of many is found."""
    n, fresh = 50_000.0, 50_000.0 * ratio

    def breaks(times: float) -> float:
        def law(mean: float) -> Any:
            return poisson.pmf(np.arange(int(mean + 12 * math.sqrt(mean) + 40)), mean)

        return sum(
            float(p) * float(poisson.sf(math.floor(promised.allowed * fresh + 1e-9), times * counted * ratio))
            for k, p in enumerate(law(counted))
            if (promised := share_promise("false_pass", k / n, 0.0, fresh, n)).allowed is not None
        )

    assert breaks(1.0) < 2e-4
    if counted * ratio >= 50:
        assert breaks(2.0 + 8 / math.sqrt(counted * min(ratio, 1.0))) > 0.99


def test_a_model_that_blocks_what_the_card_says_it_passes_fails(errors: dict[str, Any]) -> None:
    """Its stop is 3% too small: 6% of the light is lost wherever the stop decides, the middle of the film above all."""
    known = load_model(exported("invariants"))

    def rays(film: Any, pupil: Any, wavelength: Any, film_z: Any, stop_radius_mm: float | None = None) -> Any:
        radius = stop_radius_mm or domain().stop_radius_mm
        return known.rays(film, pupil, wavelength, film_z, 0.97 * radius)

    missed = broken(errors, rays=rays)
    assert missed >= {"false_block", "2_stops.false_block", "full.centre.false_block", "2_stops.edge.false_block"}
    assert all(key.endswith("false_block") for key in missed)


@pytest.mark.parametrize("state", ["4_stops", *whole("full", "2_stops")])
def test_one_trace_serves_every_stop(state: str) -> None:
    """The shares of a stopped-down lens, traced by itself, are those that the crossings with the stop tell."""
    held_out = passing_rays(lens(), domain(), 500, 9)
    fresh = fresh_rays(lens(), domain(), held_out, count=30_000, seed=21)
    found = measure(fresh, model("invariants").predict)
    apart = vignetting_errors(
        lens(), domain(), model("invariants").predict, stop_radius_mm=fresh.stop_radius_mm(state), count=30_000, seed=21
    )
    mine = found.figures if state == "full" else found.stopped_down[state]
    for key in ("false_pass", "false_block"):
        assert mine[key] == apart[key]
        if state in ZONED:
            assert {z: found.zones[state][z][key] for z in ZONES} == {z: apart["zones"][z][key] for z in ZONES}


def test_promises_of_another_shape_promise_nothing(errors: dict[str, Any]) -> None:
    fresh = fresh_rays(lens(), domain(), passing_rays(lens(), domain(), 500, 7), count=2000, seed=7)
    found = measure(fresh, onnx_predictor(load_model(exported("invariants"))))
    for strange in ("text", {"2_stops": 3, "full": [1], "new": {"edge": 1}}):
        promised = promises_of({**errors, "stopped_down": strange, "zones": strange}, fresh, found)
        assert promised and not [p.key for p in promised if "." in p.key]
    promised = promises_of({**errors, "stopped_down": {"2_stops": {"what": 0.1}}}, fresh, found)
    assert [p.key for p in promised if not p.holds] == ["2_stops.what"]
