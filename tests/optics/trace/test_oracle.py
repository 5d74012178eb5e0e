"""Rays traced with 50 decimal digits: points, directions, blocked rays, Fresnel products, first-order data.

The project's own selection (tests/data) is always checked; the whole reference set (../shared/data) where it is there.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from shipped import tabled

from experiments.accuracy.extreme_cases import from_film, from_scene, generator
from experiments.accuracy.extremes import both_precisions
from neurolens.base import status as st
from neurolens.optics.lens.figures import Figure
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.rays import Rays, Traced, trace

ROOT = Path(__file__).parents[3]
SHARED = ROOT.parent / "shared" / "data"
OWN = json.loads((ROOT / "tests" / "data" / "oracle_rays.json").read_text())["lenses"]
REASONS = {"miss": st.MISSED, "clipped": st.RIM, "tir": st.TOTAL_REFLECTION}
TOLERANCE_MM = {torch.float64: 1e-11, torch.float32: 5e-5}
# Image points lie tens of millimetres behind the last surface, where the rounding of a float32 direction (5e-6 allowed)
# moves a ray by more than that of its point: 5e-6 times 200 mm.
IMAGE_TOLERANCE_MM = {torch.float64: 1e-11, torch.float32: 1e-3}
# The lenses of ../shared: prescription in the file itself, or in data/lenses.
WHOLE = (
    *("full_even_asphere_50mm", "full_phone_odd_asphere", "ikemori_retrofocus_14mm_us4310222_ex2"),
    *("nikkor_z14_24_f2.8_wo2021-117563",),
    *("full_double_gauss_n1691", "full_double_gauss_n1961", "full_tessar", "ogawa_canon_70_200_us5537259"),
    *("laikin_double_gauss_50_f1.8", "shimizu_fisheye_220deg_us3737214"),
)


@dataclass(frozen=True)
class Case:
    """A lens with constant indices, and reference rays in one form."""

    lens: Lens
    first_order: dict[str, float]
    rays: list[dict[str, Any]]


def constant_index(rows: list[dict[str, Any]]) -> Lens:
    """A lens of the glasses' n_d, which is what the reference rays were traced with."""

    def number(row: dict[str, Any], *names: str, default: float) -> float:
        return float(next((row[n] for n in names if row.get(n) is not None), default))

    def asphere(row: dict[str, Any]) -> tuple[tuple[int, float], ...]:
        terms = row.get("odd") or row.get("aspheric_coefficients") or {}
        terms = dict(terms) | {str(2 * i + 2): a for i, a in enumerate(row.get("even", []))}
        return tuple(sorted((int(p), float(a)) for p, a in terms.items() if a))

    surfaces = tuple(
        Surface(
            number(r, "R", "radius_mm", default=0.0) or math.inf,
            number(r, "t", "thickness_mm", default=0.0),
            2 * number(r, "sd", "semi_diameter_mm", default=number(r, "diameter_mm", default=0.0) / 2),
            number(r, "n", "n_d", default=1.0),
            stop=r["stop"],
            figure=Figure(conic=number(r, "k", "conic", default=0.0), asphere=asphere(r)),
        )
        for r in rows
    )
    return Lens("reference", "", surfaces, 2.0)


def own(entry: dict[str, Any]) -> Case:
    if "prescription" in entry:
        return Case(constant_index(entry["prescription"]), entry["first_order"], entry["rays"])
    return Case(read_lens(ROOT / entry["lens_file"]), entry["first_order"], entry["rays"])


def whole(name: str) -> Case:
    path = SHARED / "oracle" / f"{name}.json"
    if not path.exists():
        pytest.skip(
            "the whole reference set (../shared/data/oracle) is not here; the project's own selection is tested"
        )
    data = json.loads(path.read_text())
    rows = data.get("prescription") or json.loads((SHARED / "lenses" / data["lens"]).read_text())["surfaces"]
    rays = [
        {
            "origin": r.get("o", r.get("origin")),
            "direction": r.get("d", r.get("direction")),
            "status": r["status"],
            "surface": r.get("surf", r.get("surface")),
            "last_point": r["points"][-1] if "points" in r else r.get("last_point"),
            "last_direction": r["dirs"][-1] if "dirs" in r else r.get("last_direction"),
            "image_point": r.get("image_point"),
            "points": r.get("points"),
        }
        for r in data["rays"]
    ]
    return Case(constant_index(rows), data["first_order"], rays)


def launched(rays: list[dict[str, Any]], dtype: torch.dtype) -> Rays:
    rows = torch.tensor([[*r["origin"], *r["direction"]] for r in rays], dtype=torch.float64)
    return Rays(*rows.T.to(dtype).contiguous())


def check(case: Case, dtype: torch.dtype) -> Traced:
    """Points, directions and image points of passing rays; the surface and the reason of the others."""
    out = trace(case.lens, launched(case.rays, dtype), towards="film", record=range(len(case.lens.surfaces)))
    assert out.rays.x.dtype == dtype
    worst, worst_image = 0.0, 0.0
    for i, ray in enumerate(case.rays):
        status = int(out.status[i])
        if ray["status"] != "ok":
            assert st.surface_of(status) == ray["surface"], (i, st.describe(status), ray)
            # Beyond a sphere's edge a solver may call a ray that misses blocked by the rim, and the other way round.
            ends = {REASONS[ray["status"]]} if ray["status"] == "tir" else {st.MISSED, st.RIM}
            assert status % 4 in ends
            continue
        assert status == st.PASSED, (i, st.describe(status))
        point = [float(c[i]) for c in out.rays]
        worst = max([worst, *(abs(a - b) for a, b in zip(point[:3], ray["last_point"], strict=True))])
        errors = [abs(a - b) for a, b in zip(point[3:], ray["last_direction"], strict=True)]
        assert max(errors) < (1e-13 if dtype == torch.float64 else 5e-6)
        if ray["image_point"]:
            reach = (case.first_order["image_z"] - point[2]) / point[5]
            for axis in (0, 1):
                at_image = point[axis] + reach * point[3 + axis]
                worst_image = max(worst_image, abs(at_image - ray["image_point"][axis]))
    assert worst < TOLERANCE_MM[dtype] and worst_image < IMAGE_TOLERANCE_MM[dtype]
    return out


@pytest.mark.parametrize("dtype", TOLERANCE_MM, ids=str)
@pytest.mark.parametrize("entry", OWN, ids=lambda e: e["name"])
def test_own_selection(entry: dict[str, Any], dtype: torch.dtype) -> None:
    check(own(entry), dtype)


@pytest.mark.parametrize("dtype", TOLERANCE_MM, ids=str)
@pytest.mark.parametrize("name", WHOLE)
def test_whole_reference_set(name: str, dtype: torch.dtype) -> None:
    case = whole(name)
    out = check(case, dtype)
    # Where every point on the way is given, so is every recorded crossing.
    for i, ray in enumerate(case.rays):
        if ray["status"] == "ok" and ray["points"]:
            for k, point in enumerate(ray["points"]):
                assert abs(float(out.crossings[k].x[i]) - point[0]) < TOLERANCE_MM[dtype]
                assert abs(float(out.crossings[k].y[i]) - point[1]) < TOLERANCE_MM[dtype]


@pytest.mark.parametrize("entry", [e for e in OWN if "transmittance" in e], ids=lambda e: e["name"])
def test_transmittance_of_own_selection(entry: dict[str, Any]) -> None:
    rays = launched(entry["transmittance"], torch.float64)
    expected = torch.tensor([r["unpolarised_exact"] for r in entry["transmittance"]], dtype=torch.float64)
    lens = own(entry).lens
    forward = trace(lens, rays, towards="film", transmittance=True)
    assert forward.transmittance is not None and (forward.status == 0).all()
    torch.testing.assert_close(forward.transmittance, expected, rtol=0, atol=1e-12)
    # Transmittance is reciprocal: the same ray backwards loses the same.
    back = forward.rays._replace(dx=-forward.rays.dx, dy=-forward.rays.dy, dz=-forward.rays.dz)
    reverse = trace(lens, back, towards="scene", transmittance=True)
    torch.testing.assert_close(reverse.transmittance, expected, rtol=0, atol=1e-12)


def test_transmittance_of_the_whole_set() -> None:
    path = SHARED / "oracle" / "fresnel_sequential.json"
    if not path.exists():
        pytest.skip("../shared/data/oracle is not here")
    by_lens: dict[str, list[dict[str, Any]]] = {}
    for ray in json.loads(path.read_text())["rays"]:
        by_lens.setdefault(ray["lens"], []).append({**ray, "origin": ray["o"], "direction": ray["d"]})
    compared = 0
    for name, rays in by_lens.items():
        exact = trace(whole(name).lens, launched(rays, torch.float64), towards="film", transmittance=True)
        expected = torch.tensor([r["T_unpolarised_exact"] for r in rays], dtype=torch.float64)
        torch.testing.assert_close(exact.transmittance, expected, rtol=0, atol=1e-12)
        compared += len(rays)
    assert compared > 50


def same_first_order(case: Case) -> None:
    data, wanted = first_order(case.lens), case.first_order
    found = {
        "efl": data.efl_mm,
        "bfl": data.back_focus_mm,
        "enp_z": data.entrance_pupil_z_mm,
        "enp_diam": data.entrance_pupil_diameter_mm,
        "exp_z": data.exit_pupil_z_mm,
        "exp_diam": data.exit_pupil_diameter_mm,
    }
    assert found == pytest.approx({k: wanted[k] for k in found}, rel=1e-11, abs=1e-11)


@pytest.mark.parametrize("entry", OWN, ids=lambda e: e["name"])
def test_first_order_of_own_selection(entry: dict[str, Any]) -> None:
    same_first_order(own(entry))


@pytest.mark.parametrize("name", WHOLE)
def test_first_order_of_the_whole_set(name: str) -> None:
    same_first_order(whole(name))


@pytest.mark.parametrize("towards", ["film", "scene"])
def test_float32_of_a_fast_lens_holds_a_twentieth_of_a_micrometre(towards: str) -> None:
    """35 mm f/1.2, two aspheres, 21 surfaces. The difference of two rounded roots at each surface gave 0.070 um."""
    lens, g = set_lens(tabled("canon_aspheric_50").scaled(0.7), f_number=1.2), generator()
    start = from_scene(lens, 40_000, g, slope=0.2) if towards == "film" else from_film(lens, 40_000, g)
    small, large = (trace(lens, r, 550.0, towards=towards) for r in both_precisions(start))  # type: ignore[arg-type]
    passed = (small.status == st.PASSED) & (large.status == st.PASSED)
    off = torch.stack([(a - b)[passed] for a, b in zip(small.rays[:3], large.rays[:3], strict=True)]).norm(dim=0)
    assert passed.sum() > 10_000
    assert off.max() < TOLERANCE_MM[torch.float32] and off.square().mean().sqrt() < TOLERANCE_MM[torch.float32] / 5
