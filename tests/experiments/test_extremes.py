"""The table of numerics: what it may never show, on every case with few rays; its reference against closed forms."""

import json
import math
from dataclasses import replace
from itertools import takewhile
from pathlib import Path

import mpmath
import pytest
import torch
from shipped import PATHS

from experiments.__main__ import main
from experiments.accuracy import extreme_cases as cases, extremes
from experiments.accuracy.extremes import failures, measure, trace_reference
from neurolens.base import status as st
from neurolens.optics.lens.figures import Cylinder, Figure
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.trace.rays import trace

COUNT = 300
ALL = list(takewhile(lambda case: case.group != "library", cases.all_cases(COUNT)))


@pytest.mark.parametrize("case", ALL, ids=lambda c: f"{c.group}: {c.name}")
def test_no_nan_and_no_status_that_depends_on_the_precision(case: cases.Case) -> None:
    row = measure(case)
    assert failures([row]) == []
    assert row.rays >= COUNT and row.passed + row.within > 0
    # float32 keeps five digits of the largest coordinate at the worst; float64 thirteen.
    assert row.relative < 2e-5
    assert row.exact_mm < 1e-11


@pytest.mark.whole
def test_the_whole_library_once() -> None:
    rows = [measure(c, exact_rays=2) for c in cases.library(60)]
    assert len(rows) >= 2 * len(PATHS)
    assert failures(rows) == []
    assert max(r.relative for r in rows) < 1e-5


def test_a_status_that_is_wrong_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A tracer that loses float32 rays in the middle of the lens is caught, and the command fails."""

    def broken(lens: Lens, rays: object, *args: object, **options: object) -> object:
        out = trace(lens, rays, *args, **options)  # type: ignore[arg-type]
        lost = out.status.clone()
        if out.rays.x.dtype == torch.float32:
            lost[:5] = st.blocked(0, st.MISSED)
        return out._replace(status=lost)

    monkeypatch.setattr(extremes, "all_cases", lambda count: [next(cases.near_equal_indices(count))])
    command = ["extremes", "--rays", "100", "--output", str(tmp_path), "--quiet"]
    assert main(command) == 0 and "FAILED" not in (tmp_path / "extremes.md").read_text()
    monkeypatch.setattr(extremes, "trace", broken)
    assert main(command) == 1 and json.loads((tmp_path / "extremes.json").read_text())[0]["beyond"] == 5
    row = measure(next(cases.near_equal_indices(COUNT)))
    assert row.beyond == 5 and "away from any edge" in failures([row])[0]


# ---- the reference ----


def one(surface: Surface) -> Lens:
    return Lens("one", "", (replace(surface, stop=True),), 1.0)


def test_reference_images_the_points_of_cartesian_ovals() -> None:
    """A hyperboloid of K = -n^2 sends rays from within the glass, parallel to the axis, to one point (Descartes)."""
    n, r = 1.5, -20.0
    lens = one(Surface(r, 1.0, 40.0, figure=Figure(conic=-(n**2))))
    focus = -r / (n - 1)
    for height in (0.0, 3.0, 19.0):
        out = trace_reference(lens, [0.6 * height, 0.8 * height, -30.0, 0, 0, 1], [n, 1.0], "film")
        assert out.status == st.PASSED and out.point is not None and out.direction is not None
        with mpmath.mp.workdps(50):
            reach = (focus - out.point[2]) / out.direction[2]
            assert all(abs(p + reach * d) < 1e-40 for p, d in zip(out.point[:2], out.direction[:2], strict=True))


def test_reference_meets_aspheres_and_cylinders_where_they_are() -> None:
    shapes = [
        Surface(-20.0, 1.0, 20.0, 1.5, figure=Figure(asphere=((3, 1e-3), (4, 2e-5)))),
        Surface(math.inf, 1.0, 20.0, 1.5, figure=Figure(asphere=((2, 0.01),))),
        Surface(15.0, 1.0, 20.0, 1.5, figure=Cylinder(conic=-0.7, cylinder="x")),
    ]
    for s in shapes:
        out = trace_reference(one(s), [1.0, 2.0, -5.0, 0.3, -0.2, 1.0], [1.0, 1.5], "film")
        assert out.point is not None
        x, y, z = (mpmath.mpf(v) for v in out.point)
        h = abs(x) if s.figure.axis else mpmath.sqrt(x * x + y * y)
        c = 0 if math.isinf(s.radius_mm) else 1 / mpmath.mpf(s.radius_mm)
        sag = c * h**2 / (1 + mpmath.sqrt(1 - (1 + mpmath.mpf(s.figure.conic)) * c**2 * h**2))
        assert abs(sag + sum(mpmath.mpf(a) * h**p for p, a in s.figure.asphere) - z) < 1e-13


def test_reference_names_what_ends_a_ray() -> None:
    ball = Lens("ball", "", (Surface(10.0, 20.0, 19.0, 1.6), Surface(-10.0, 1.0, 19.0, stop=True)), 1.0)
    media = [1.0, 1.6, 1.0]
    ends = [trace_reference(ball, [x, 0, -5, 0, 0, 1], media, "film").status for x in (0.0, 9.8, 11.0)]
    assert ends == [st.PASSED, st.blocked(0, st.RIM), st.blocked(0, st.MISSED)]
    plate = Lens("plate", "", (Surface(math.inf, 1.0, 100.0, stop=True),), 1.0)
    assert trace_reference(plate, [0, 0, -1, 1, 0, 1], [1.6, 1.0], "film").status == st.blocked(0, st.TOTAL_REFLECTION)
