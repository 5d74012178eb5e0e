"""Copies of a lens: what is drawn stays within its limits, elements move as bodies, and files hold the copies."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from neurolens.base.errors import InputError
from neurolens.cli import main
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.copies import Tolerances, copies_of, elements_of

ROOT = Path(__file__).parents[2]
NONE = Tolerances(0, 0, 0, 0, 0, 0)


@pytest.fixture(scope="module")
def lens() -> Lens:
    return read_lens(ROOT / "lenses" / "laikin_double_gauss_50.toml")


def test_elements_are_the_glass_between_gaps(lens: Lens) -> None:
    assert [(e[0], e[-1]) for e in elements_of(lens)] == [(0, 1), (2, 4), (6, 8), (9, 10), (11, 12)]


def test_without_tolerances_a_copy_is_its_lens(lens: Lens) -> None:
    (copy,) = copies_of(lens, NONE, 1, 7)
    assert copy.surfaces == lens.surfaces and copy.name == f"{lens.name}, copy 1"


def test_figures_are_drawn_as_stated(lens: Lens) -> None:
    """A normal distribution of half the limit, cut off at the limit, has 0.44 of the limit as its deviation."""
    limits = Tolerances(0.05, 0.0, 0.04, 0.03, 0.2, 1e-3)
    copies = list(copies_of(lens, limits, 300, 1))
    assert copies[:3] == list(copies_of(lens, limits, 3, 1)) != list(copies_of(lens, limits, 3, 2))
    plain = lens.surfaces

    def drawn(what: str, k: int) -> np.ndarray:
        return np.array([getattr(c.surfaces[k], what) for c in copies], float)

    stop = lens.stop_index
    found = {
        0.05: np.array([[c.surfaces[k].placement.moved_mm[i] for c in copies] for k in (0, 9) for i in (0, 1)]),
        0.04: np.array([drawn("thickness_mm", k) - plain[k].thickness_mm for k in (1, stop)]),
        0.03: np.array([drawn("thickness_mm", k) - plain[k].thickness_mm for k in (0, 2, 3)]),
        0.2e-2: np.array([drawn("radius_mm", k) / plain[k].radius_mm - 1 for k in (0, 3, 12)]),
        1e-3: np.array([drawn("n_d", k) - plain[k].n_d for k in (0, 2)]),
    }
    for limit, off in found.items():
        assert np.abs(off).max() <= limit * (1 + 1e-9)
        assert off.std() / limit == pytest.approx(0.44, abs=0.04) and abs(off.mean()) < 0.1 * limit
        assert np.abs(np.corrcoef(off)[np.triu_indices(len(off), 1)]).max() < 0.2  # each on its own
    assert all(c.surfaces[1].n_d == 1 and not c.surfaces[stop].placement for c in copies)


def test_an_element_moves_as_a_body(lens: Lens) -> None:
    """Distances between the vertices of cemented surfaces stay, and their axes stay parallel."""
    vertices = np.array(lens.vertices_mm, float)
    for copy in copies_of(lens, replace(NONE, decentre_mm=0.5, tilt_deg=2.0), 5, 3):
        for element in elements_of(lens):
            placed = [copy.surfaces[k].placement for k in element]
            places = np.array([p.moved_mm for p in placed]) + vertices[list(element)][:, None] * [0, 0, 1]
            for p, place in zip(placed[1:], places[1:], strict=True):
                np.testing.assert_allclose(p.axes, placed[0].axes, atol=1e-12)
                length = vertices[element[0] + len(placed) - 1] - vertices[element[0]]
                assert np.linalg.norm(place - places[0]) <= length + 1e-9
            np.testing.assert_allclose(
                places[-1] - places[0],
                placed[0].axes[:, 2] * (vertices[element[-1]] - vertices[element[0]]),
                atol=1e-12,
            )


def test_the_command_writes_files_that_read_back(
    lens: Lens, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "limits.toml"
    table.write_text("decentre_mm = 0.1\ngap_mm = 0\n")
    words = ["copies", "laikin_double_gauss_50", "--number", "2", "--seed", "4", "--tolerances", str(table)]
    assert main([*words, "--gap", "0.01", "-o", str(tmp_path / "made"), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["tolerances"]["decentre_mm"] == 0.1 and data["tolerances"]["gap_mm"] == 0.01
    limits = Tolerances(decentre_mm=0.1, gap_mm=0.01)
    for path, copy in zip(data["files"], copies_of(lens, limits, 2, 4), strict=True):
        assert read_lens(path).surfaces == copy.surfaces
    assert Tolerances.read(Path("default")) == Tolerances()
    table.write_text("decentre_mm = -1\n")
    assert main([*words, "-o", str(tmp_path / "made")]) == 2
    assert "limits.toml: decentre_mm: got -1" in capsys.readouterr().err


def test_surfaces_that_always_overlap_are_an_error(lens: Lens) -> None:
    thin = replace(lens, surfaces=(replace(lens.surfaces[0], thickness_mm=1.0), *lens.surfaces[1:]))
    with pytest.raises(InputError, match="in one of 50 draws"):
        list(copies_of(thin, NONE, 1, 0))
