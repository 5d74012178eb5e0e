"""Every lens of the library, written in each format that can say it, is read back to the same lens and rays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from lens_formats import WRITERS, CannotSay, plain
from shipped import PATHS

from neurolens.optics.lensfile import read_lens
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Lens
from neurolens.optics.trace import Rays, trace
from neurolens.readers.any_format import read_any

NO_DISPERSION = (".len", ".dat", ".txt")


def beam(lens: Lens, count: int = 60) -> Rays:
    """Light from the scene at up to 6 degrees to each side, over the entrance pupil and a little beyond it."""
    g = torch.Generator().manual_seed(1)
    u = 2 * torch.rand((4, count), generator=g, dtype=torch.float64) - 1
    d = torch.stack([0.1 * u[0], 0.1 * u[1], torch.ones(count, dtype=torch.float64)])
    d = d / d.norm(dim=0)
    pupil = first_order(lens)
    semi = 0.55 * pupil.entrance_pupil_diameter_mm
    start = torch.stack([semi * u[2], semi * u[3], torch.full_like(u[0], pupil.entrance_pupil_z_mm)])
    # Back to well in front of the lens.
    travel = (pupil.entrance_pupil_z_mm + lens.surfaces[0].diameter_mm) / d[2]
    return Rays(*(start - travel * d), *d)


def assert_same_optics(found: Lens, expected: Lens) -> None:
    """Paraxial figures in both meridians to 1e-9, and real rays to 1e-9 mm of a 50 mm lens with the same endings."""
    for axis in ("x", "y"):
        a, b = (first_order(lens, meridian=axis) for lens in (found, expected))
        for key in ("efl_mm", "back_focus_mm", "entrance_pupil_diameter_mm", "front_focal_z_mm"):
            assert getattr(a, key) == pytest.approx(getattr(b, key), rel=1e-9, abs=1e-9), key
    rays = beam(expected)
    for wavelength_nm in (587.5618, 450.0):
        there, here = (trace(lens, rays, wavelength_nm, towards="film") for lens in (found, expected))
        assert torch.equal(there.status, here.status)
        tolerance = 2e-11 * abs(first_order(expected).efl_mm)
        for p, q in zip(there.rays, here.rays, strict=True):
            assert (p - q).abs().max() < tolerance + 1e-12
        assert (here.status == 0).any()


@pytest.mark.parametrize("suffix", WRITERS)
@pytest.mark.parametrize("path", PATHS, ids=lambda p: p.stem)
def test_library_lens_comes_back(path: Path, suffix: str, tmp_path: Path) -> None:
    lens = plain(read_lens(path))
    if suffix in NO_DISPERSION:
        lens = replace(lens, surfaces=tuple(replace(s, V_d=None) for s in lens.surfaces))
    file = tmp_path / f"lens{suffix}"
    try:
        file.write_text(WRITERS[suffix](lens), encoding="utf-16" if suffix == ".zmx" else "utf-8")
    except CannotSay:
        return  # counted below
    found = read_any(file)
    assert found.name == lens.name
    assert len(found.surfaces) == len(lens.surfaces)
    for a, b in zip(found.surfaces, lens.surfaces, strict=True):
        assert (a.stop, a.cylinder) == (b.stop, b.cylinder)
        assert a.n_d == b.n_d and a.V_d == b.V_d
        assert a.diameter_mm == pytest.approx(b.diameter_mm, rel=1e-12)
        assert a.thickness_mm == pytest.approx(b.thickness_mm, rel=1e-12)
        assert a.conic == b.conic and dict(a.asphere) == {p: c for p, c in b.asphere if c}
    assert_same_optics(found, lens)
    if suffix in (".zmx", ".seq", ".json"):
        assert_same_states(found, lens)


def assert_same_states(found: Lens, expected: Lens) -> None:
    assert [c.name for c in found.configurations] == [c.name for c in expected.configurations]
    for a, b in zip(found.configurations, expected.configurations, strict=True):
        gaps = {k: s.thickness_mm for k, s in enumerate(expected.surfaces)}
        assert {**gaps, **dict(a.thickness_mm)} == pytest.approx({**gaps, **dict(b.thickness_mm)})
        assert a.object_distance_mm == pytest.approx(b.object_distance_mm)
        if b.stop_diameter_mm:
            assert a.stop_diameter_mm == pytest.approx(b.stop_diameter_mm)
        if b.efl_mm and b.object_distance_mm is None:
            assert a.efl_mm == pytest.approx(b.efl_mm, rel=0.02)  # what is stated is rounded


def test_every_format_is_met_by_some_lens() -> None:
    said = dict.fromkeys(WRITERS, 0)
    for path in PATHS:
        lens = plain(read_lens(path))
        for suffix, write in WRITERS.items():
            rows = tuple(replace(s, V_d=None) for s in lens.surfaces) if suffix in NO_DISPERSION else lens.surfaces
            try:
                write(replace(lens, surfaces=rows))
                said[suffix] += 1
            except CannotSay:
                pass
    assert said[".zmx"] >= 37 and said[".seq"] >= 35 and said[".len"] >= 20 and said[".dat"] >= 15, said
