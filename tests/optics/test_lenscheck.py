"""The check of a lens finds the mistakes that circulate in tables, and names them."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from shipped import tabled

from neurolens.optics.lenscheck import (
    axial_beam,
    axial_blur_mm,
    check_lens,
    corner_illumination,
    doubts,
    film_edge_mm,
    verdict,
)
from neurolens.optics.prescription import Lens, Surface

INF = math.inf


def changed(name: str, surface: int, **figures: object) -> Lens:
    lens = tabled(name)
    rows = list(lens.surfaces)
    rows[surface] = replace(rows[surface], **figures)  # type: ignore[arg-type]
    return replace(lens, surfaces=tuple(rows))


def said(lens: Lens) -> str:
    checks = check_lens(lens)
    assert verdict(checks) == "doubtful"
    return "\n".join(doubts(checks))


def test_mistakes_that_circulated_are_found() -> None:
    # The printed index of a glass that does not exist.
    assert "the focal length is" in said(changed("laikin_double_gauss_50", 7, n_d=1.961))
    # A transposed digit in the first radius.
    assert "the focal length is 104" in said(changed("takahashi_retrofocus_100", 0, radius_mm=169.25))
    # The sign of a radius.
    assert "the focal length is" in said(changed("ikemori_retrofocus_14", 15, radius_mm=12.614))
    # Crown and flint exchanged.
    swapped = changed("petzval_portrait_100", 4, n_d=1.517, V_d=62.0)
    rows = list(swapped.surfaces)
    rows[6] = replace(rows[6], n_d=1.576, V_d=42.5)
    assert "the focal length is 86" in said(replace(swapped, surfaces=tuple(rows)))
    # A dropped asphere: here the power goes with it.
    assert "the focal length is" in said(changed("canon_aspheric_50", 4, asphere=()))
    # Semi-diameters in the column of diameters.
    lens = tabled("laikin_double_gauss_50")
    half = replace(
        lens, surfaces=tuple(s if s.stop else replace(s, diameter_mm=s.diameter_mm / 2) for s in lens.surfaces)
    )
    assert "limits the axial beam" in said(half)


def test_each_doubt_has_its_reason() -> None:
    assert "puts the film at z = " in said(changed("laikin_double_gauss_50", 12, thickness_mm=39.0))
    assert "the stop gives f/1.2, the source says f/1.8" in said(tabled("laikin_double_gauss_50").at(f_number=1.2))
    assert "negative thickness" in said(changed("cooke_triplet_50", 0, thickness_mm=0.5, diameter_mm=24.0))
    assert "no light comes from 45 degrees" in said(replace(tabled("cooke_triplet_50"), half_field_deg=45.0))
    dark = replace(tabled("brendel_tessar_100"), image_radius_mm=75.0)
    assert "the corner of the film gets" in said(dark)
    singlet = (Surface(INF, 1.0, 30.0, stop=True), Surface(30.0, 8.0, 34.0, 1.5), Surface(-30.0, 30.0, 34.0))
    window = (*singlet[:-1], replace(singlet[-1], thickness_mm=1.0), Surface(INF, 1.0, 34.0, 1.5), Surface(INF, 20, 34))
    assert "blurred" in said(Lens("simple lens behind a window", "", window, 1.0))
    diverging = (Surface(INF, 1.0, 5.0, stop=True), Surface(-30.0, 2.0, 20.0, 1.5), Surface(30.0, 30.0, 20.0))
    assert "diverging" in said(Lens("diverging", "", diverging, 4.0))


def test_states_are_checked_too() -> None:
    lens = tabled("nikon_zoom_70_200")
    bad = replace(lens.configurations[1], efl_mm=120.0)
    near = replace(lens.configurations[3], object_distance_mm=500.0)
    found = said(replace(lens, configurations=(lens.configurations[0], bad, near)))
    assert "135mm: the focal length is 135 mm, the source says 120 mm" in found
    assert "71mm near: the table's last thickness puts the film" in found


def test_axial_beam_and_blur_of_a_parabolic_front() -> None:
    """An ellipsoid of eccentricity 1/n focuses a parallel beam in its glass without aberration (Descartes)."""
    n = 1.5
    rows = (Surface(20.0, 60.0 + 1e-9, 24.0, n, conic=-1 / n**2, stop=True), Surface(INF, 1e-9, 24.0))
    lens = Lens("ellipsoid", "", rows, 2.0)
    assert axial_blur_mm(lens) < 1e-9  # the focus lies n R / (n - 1) = 60 mm behind the vertex
    assert axial_beam(lens) == (pytest.approx(12.0), None)
    assert axial_beam(lens.with_stop_radius(5.0))[0] == pytest.approx(5.0)


def test_the_corner_of_a_stop_alone_falls_by_the_fourth_power_of_the_cosine() -> None:
    """A thin lens at its stop, field 30 degrees; far from the f-number, so that the pupil is a point."""
    rows = (Surface(INF, 0.001, 0.5, stop=True), Surface(100.0, 0.001, 200.0, 1.5), Surface(-100.0, 100.0, 200.0))
    lens = Lens("thin", "", rows, 200.0, half_field_deg=30.0)
    assert film_edge_mm(lens) == pytest.approx(100 * math.tan(math.radians(30)), rel=1e-3)
    share = corner_illumination(lens, 100 * math.tan(math.radians(30)))
    assert share == pytest.approx(math.cos(math.radians(30)) ** 4, rel=0.02)
