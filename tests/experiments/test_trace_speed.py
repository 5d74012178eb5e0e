"""What the bench of the tracer prepares; no clock is judged."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from experiments import lab
from experiments.__main__ import main
from experiments.trace_speed import (
    ASPHERIC_SURFACES,
    LENSES,
    MAIN,
    chosen_lenses,
    film_rays,
    goals,
    launched,
    memory_of,
    with_aspheres,
)
from neurolens.evaluate.candidates import COMPILED_BATCHES
from neurolens.evaluate.describe import refractions
from neurolens.optics.trace import trace

pytestmark = pytest.mark.filterwarnings("ignore::neurolens.base.errors.NeurolensWarning")
FOLDER = Path(__file__).parents[2] / "lenses"


def timed(kind: str, ns: float, **more: Any) -> dict[str, Any]:
    return {
        "lens": "laikin",
        "refractions": MAIN,
        "surfaces": 13,
        "aspheres": 0,
        "cylinders": 0,
        "kind": kind,
        "dtype": "float32",
        "threads": 1,
        "passing_share": 0.5,
        "load": [0.1, None],
        "reason": None,
        "ns_min": ns,
        "ns_median": 1.1 * ns,
        "batch": COMPILED_BATCHES[0],
        **more,
    }


ROWS = [
    timed("eager", 90.0),
    timed("compiled", 50.0),
    timed("eager", 150.0, aspheres=2, over_spheres={"min": 1.6667, "median": 1.7}),
]


def test_lenses_have_the_refractions_that_the_table_says() -> None:
    lenses, missing = chosen_lenses(FOLDER)
    assert missing == []
    assert set(lenses) == set(LENSES)
    for count, lens in lenses.items():
        # The anamorphic zoom's table leaves its last plane to the reader.
        assert refractions(lens) in (count, count - 1)
    assert refractions(lenses[MAIN]) == MAIN
    assert sum(s.cylinder is not None for s in lenses[57].surfaces) > 2


def test_two_aspheres_change_the_rays_and_little_else() -> None:
    plain = chosen_lenses(FOLDER)[0][MAIN]
    aspheric = with_aspheres(plain)
    changed = [k for k, s in enumerate(aspheric.surfaces) if s.asphere]
    assert changed == list(ASPHERIC_SURFACES)
    assert [p for p, _ in aspheric.surfaces[changed[0]].asphere] == [4, 6, 8, 10]
    rays = launched(plain, film_rays(plain, 4096), torch.float64)
    a, b = trace(plain, *rays), trace(aspheric, *rays)
    both = (a.status == 0) & (b.status == 0)
    assert both.sum() > 0.7 * (a.status == 0).sum() > 100
    assert 1e-2 < (a.rays.x - b.rays.x)[both].abs().max() < 3.0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rays_have_wavelengths_of_their_own(dtype: torch.dtype) -> None:
    lens = chosen_lenses(FOLDER)[0][MAIN]
    rays, wavelength = launched(lens, film_rays(lens, 1000), dtype)
    assert {c.dtype for c in (*rays, wavelength)} == {dtype}
    assert all(c.is_contiguous() for c in rays)
    assert 400 <= wavelength.min() < 410 and 690 < wavelength.max() <= 700


def test_goals_reached_missed_and_not_measured() -> None:
    verdicts = {g.text: g.verdict for g in goals(ROWS)}
    assert verdicts == {
        "Mray/s per core, eager": "reached",
        "Mray/s per core, compiled": "missed",
        "times slower with two aspheres, eager": "reached",
        "times slower with two aspheres, compiled": "not measured",
    }
    assert goals([]) and all(g.verdict == "not measured" for g in goals([]))


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_memory_is_measured_in_a_child() -> None:
    found = lab.in_child(memory_of, str(FOLDER / "laikin_double_gauss_50.toml"), 100_000)
    assert found["rays"] == 100_000
    assert found["results_mb"] == pytest.approx(2.8)


@pytest.mark.slow
def test_a_child_that_fails_says_why() -> None:
    with pytest.raises(lab.Unmeasured, match="none.toml"):
        lab.in_child(memory_of, str(FOLDER / "none.toml"), 10)


def test_a_lens_that_is_not_there_is_one_clear_error(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["trace", "--quick", "--only", "zeiss", "--out", str(tmp_path)]) == 2
    shown = capsys.readouterr().err.strip()
    assert "--only" in shown and "laikin" in shown and "\n" not in shown
    assert list(tmp_path.iterdir()) == []
