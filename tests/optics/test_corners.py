"""Sharpness at points of the picture: beside rays from the scene, of a lens that is turned whole, and of copies."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from neurolens.base.errors import InputError
from neurolens.cli import main
from neurolens.optics.analysis.corners import Corners, spread
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.analysis.spots import mtf, spots
from neurolens.optics.lens.placement import Placement
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.copies import Tolerances, draws_of
from neurolens.optics.setting.states import set_lens

TABLED = read_lens(Path(__file__).parents[2] / "lenses" / "laikin_double_gauss_50.toml")


@pytest.fixture(scope="module")
def corners() -> Corners:
    return Corners(Scene(set_lens(TABLED, f_number=4.0, focus_mode="best")))


@pytest.mark.parametrize("focus_m", [math.inf, 1.0])
def test_spots_and_mtf_are_those_of_rays_from_the_scene(focus_m: float) -> None:
    """The other way round, through the stop; first order in how far a spot is from its point is enough."""
    scene = Scene(set_lens(TABLED, f_number=4.0, focus_m=focus_m, focus_mode="best"), focus_m)
    corners = Corners(scene)
    spot = corners.spots(scene.lens)
    height = float(np.hypot(*corners.film_mm[:, 1]))
    fields = scene.fields_at([0.0, height])
    wanted, contrast = spots(scene, fields), mtf(scene, fields, frequency_per_mm=[20.0, 40.0])
    rms, shift = corners.sizes(spot)
    np.testing.assert_allclose(rms, wanted.rms_um[[0, 1, 1, 1, 1]], rtol=0.03)
    np.testing.assert_allclose(shift, wanted.best_shift_mm[[0, 1, 1, 1, 1]], rtol=0.02, atol=2e-3)
    found = corners.contrast(spot)
    np.testing.assert_allclose(found[0], contrast.tangential[[0, 1, 1, 1, 1]], atol=0.02)
    np.testing.assert_allclose(found[1], contrast.sagittal[[0, 1, 1, 1, 1]], atol=0.02)


def test_a_lens_that_is_turned_as_a_whole_turns_its_focal_plane(
    corners: Corners, monkeypatch: pytest.MonkeyPatch
) -> None:
    """About the middle of the film, with its curved field: the film that follows is tilted by as much."""
    lens = corners.scene.lens

    def turned(x: float, y: float) -> Lens:
        group = Placement(tilt_deg=(x, y, 0.0))
        rows = list(lens.surfaces)
        for k, surface in enumerate(rows):
            from_pivot_mm = float(lens.vertices_mm[k]) - corners.scene.film_z_mm
            rows[k] = replace(surface, placement=surface.placement.in_group(group, from_pivot_mm))
        return replace(lens, surfaces=tuple(rows))

    drawn = [(None, turned(0.2, 0.0)), (None, turned(0.0, 0.1))]
    monkeypatch.setattr("neurolens.optics.analysis.corners.draws_of", lambda *_: drawn)
    found = spread(corners.scene, Tolerances(), 2, 0)
    np.testing.assert_allclose(found.film_tilt_deg, [0.2, 0.0], atol=0.004)
    np.testing.assert_allclose(found.film_swing_deg, [0.0, -0.1], atol=0.004)


def test_the_picture_stands_upside_down_on_the_film(corners: Corners) -> None:
    left, up = corners.picture_mm[1]
    assert left < 0 < up and corners.film_mm[:, 1].tolist() == [-left, -up]
    with pytest.raises(InputError, match="points from which rays pass"):
        Corners(corners.scene, np.array([[0.0, 0.0], [60.0, 0.0]]))


def test_the_command_tells_of_the_copies_that_others_write(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["analyse", "laikin_double_gauss_50", "--copies", "3", "--seed", "4", "--f-number", "4"]
    pictures = ["-o", str(tmp_path / "a"), "--csv", str(tmp_path / "b")]
    assert main([*words, "--focus-mode", "best", "--json", *pictures]) == 0
    data = json.loads(capsys.readouterr().out)["copies"]
    assert (tmp_path / "a" / "laikin_double_gauss_50_copies.png").stat().st_size > 20_000
    assert len((tmp_path / "b" / "analyse.copies.copy-place-frequency.csv").read_text().splitlines()) == 1 + 3 * 5 * 2
    corners = Corners(Scene(set_lens(TABLED, f_number=4.0, focus_mode="best")))
    _, copy = list(draws_of(corners.scene.lens, Tolerances(), 2, 4))[1]
    assert data["copy_rms_um"][1] == pytest.approx(corners.sizes(corners.spots(copy))[0].tolist())
    assert data["copy"] == [1, 2, 3] and abs(data["film_tilt_deg"][0]) < 0.2
    assert main([*words, "--focus-mode", "best"]) == 0
    assert "softest: copy " in capsys.readouterr().out
    assert main(["analyse", "laikin_double_gauss_50", "--seed", "4"]) == 2
    assert "these options only with --copies" in capsys.readouterr().err
