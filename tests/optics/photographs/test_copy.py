"""What is off in a copy, from the sharpness of pictures that the copy's own camera takes."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.cameras.exact import ExactCamera
from neurolens.cli import main
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.lens.shot import Shot
from neurolens.optics.photographs.copy import read_measured
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.copies import Off, perturbed

ROOT = Path(__file__).parents[3]
NAME = "laikin_double_gauss_50"
LINES = (587.56, 486.13, 656.27)
PER_MM, PLACES = (10.0, 20.0, 40.0), [(0, 0), (-14, 9), (14, 9), (-14, -9), (14, -9)]
COLUMNS = "x_mm,y_mm,frequency_per_mm,tangential,sagittal"
Array = NDArray[np.float64]


def contrasts(lens: Lens, shot: Shot, factors: tuple[float, ...]) -> list[str]:
    """Rows of contrasts that the camera of a lens gives, in the light of three lines, on the film as it stands.

    The picture is the film turned by 180 degrees. Directions become places by how the camera's own rays move.
    """
    camera, side, rows = ExactCamera(lens, shot), np.arange(150, dtype=np.float32), list[str]()
    # A grid, in which each point has another colour than its neighbours.
    pupil = ((np.stack(np.meshgrid(side, side)).reshape(2, -1) + 0.5) / len(side)).astype(np.float32)
    nm = np.array(LINES, np.float32)[((side[:, None] + side).ravel() % 3).astype(int)]
    for place in PLACES:
        film = np.broadcast_to(-np.array(place, np.float32)[:, None], (2, len(nm)))
        rays = camera.sample_differentials(film, pupil, nm)
        weight = rays.weight / rays.weight.sum()
        assert rays.differentials is not None
        way, slopes = rays.direction[:2] / rays.direction[2], rays.differentials.direction
        moved = (slopes[:2] - way[:, None] * slopes[2]) / rays.direction[2]
        q = np.linalg.inv((moved * weight).sum(-1)) @ (way - (way * weight).sum(-1, keepdims=True))
        radial = -np.array(place) / max(np.hypot(*place), 1e-9) if any(place) else np.array([0.0, 1.0])
        for per_mm, factor in zip(PER_MM, factors, strict=True):
            both = [
                factor * abs((weight * np.exp(2j * np.pi * per_mm * (along @ q))).sum())
                for along in (radial, np.array([-radial[1], radial[0]]))
            ]
            rows.append(",".join(map(str, [*place, per_mm, *both])))
    return rows


@pytest.fixture(scope="module")
def words(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The command for pictures of a copy whose third element is off, on a film that leans."""
    lens, decentre = read_lens(ROOT / "lenses" / f"{NAME}.toml"), np.zeros((5, 2))
    decentre[2] = 0.06, -0.04
    copy = perturbed(lens, replace(Off.none(lens), decentre_mm=decentre))
    shot = Shot((36.0, 24.0), f_number=4.0, film_tilt_deg=0.1, film_swing_deg=-0.15, focus_mode="best")
    table = tmp_path_factory.mktemp("copy") / "sharpness.csv"
    table.write_text("\n".join([COLUMNS, *contrasts(copy, shot, (0.95, 0.85, 0.6))]))
    return ["rims", NAME, "--copy", str(table), "--f-number", "4", "--focus-mode", "best"]


def test_decentre_and_tilt_are_found_in_pictures_of_a_copy(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Within 10%; its file then has the decentre."""
    out = tmp_path / "copy.toml"
    assert main([*words, "--element", "6", "--json", "-o", str(out)]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["element"] == [6, 8] and data["rms"] < 0.02 * data["rms_before"]
    found = [data[k] for k in ("decentre_x_mm", "decentre_y_mm", "film_tilt_deg", "film_swing_deg")]
    np.testing.assert_allclose(found, [0.06, -0.04, 0.1, -0.15], rtol=0.1)
    np.testing.assert_allclose(list(data["factor"].values()), [0.95, 0.85, 0.6], rtol=0.01)
    moved = read_lens(out).surfaces[7].placement.moved_mm
    np.testing.assert_allclose(moved, [*found[:2], 0.0], atol=1e-9)


@pytest.mark.whole  # five elements
def test_the_element_is_found(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "element of surfaces 6-8" in said and "--film-tilt 0.1" in said and "Warning" not in said


def test_what_does_not_go_together_is_refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    for more, said in (
        ([*words, "--element", "5"], "expected the first surface of an element: [0, 2, 6, 9, 11]"),
        ([*words, "--unused", "4"], "only without --copy"),
        (["rims", NAME, "--f-number", "4"], "only with --copy"),
    ):
        assert main(more) == 2
        assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (["0,0,20,0.5,0.5"], "(1 places), expected five places or more"),
        (["0,0,20,0.5,1.5"], "row 1: got .*, expected a frequency above 0, and contrasts of 0 to 1"),
        (["0,0,20,0.5"], "row 1: .*expected numbers for x_mm"),
        (["0,0,inf,0.5,0.5"], "row 1"),
        ([*(f"{x},1,20,0.5,0.5" for x in range(5)), "0,1,40,0.5,0.5"], "each with all frequencies"),
    ],
)  # fmt: skip
def test_a_bad_table_is_one_line(rows: list[str], said: str, tmp_path: Path) -> None:
    path = tmp_path / "sharpness.csv"
    path.write_text("\n".join([COLUMNS, *rows]))
    with pytest.raises(InputError, match=said.replace("(", r"\(").replace(")", r"\)")):
        read_measured(path)
