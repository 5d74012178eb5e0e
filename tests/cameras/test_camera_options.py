"""The cameras by their names on the command line, on white surroundings; a model whose directions are no directions."""

from __future__ import annotations

from copy import copy
from pathlib import Path

import numpy as np
import pytest
from camera_helpers import GAUSS, ROOT, camera, film_rays

from neurolens.base import status as st
from neurolens.cli import main
from neurolens.render.pictures import read_exr

SCENE = ROOT / "experiments" / "scenes" / "white.toml"


def white(tmp_path: Path, camera_name: str, *options: str) -> np.ndarray:
    out = tmp_path / "a.exr"
    small = ("--width", "12", "--samples", "64", "--threads", "1", "--quiet", "--json", "-o", str(out))
    assert main(["render", str(SCENE), "--camera", camera_name, *small, *options]) == 0
    picture: np.ndarray = read_exr(out)[0]
    return picture


@pytest.mark.parametrize("name", ["thin", f"thick:{GAUSS}"])
def test_a_white_card_without_vignetting_is_white(name: str, tmp_path: Path) -> None:
    flat, card = (white(tmp_path, name, "--efl", "35", "--vignetting", left) for left in ("none", "natural"))
    assert flat.mean() == pytest.approx(1, abs=0.02) and np.ptp(flat.mean(2)) < 0.25  # noise of the spectrum
    assert card[0, 0].mean() < card[4, 6].mean() - 0.04


def test_the_field_of_a_fisheye_is_a_circle(tmp_path: Path) -> None:
    picture = white(tmp_path, "fisheye-equisolid", "--field", "180")
    assert (picture[:, :1] == 0).all() and picture[3:5, 4:8].mean() == pytest.approx(1, abs=0.03)


def test_the_film_moves_away_from_the_lens(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # Irradiance through a thin lens goes with the inverse square of its distance to the film; exposure is for the film
    # where it stands, so it is the angles that tell: the field of 36 mm shrinks, and so does what cos^4 takes.
    near, far = (white(tmp_path, "thin", "--vignetting", "natural", "--film-offset", mm) for mm in ("0", "40"))
    corner, place = (near[0, 0] / near[3:5, 5:7].mean((0, 1))).mean(), (far[0, 0] / far[3:5, 5:7].mean((0, 1))).mean()
    assert place > corner + 0.04
    out = ("-o", str(tmp_path / "b.exr"), "--quiet")
    assert main(["render", str(SCENE), "--camera", "pinhole", "--film-offset", "1", *out]) != 0
    assert "film_offset_mm" in capsys.readouterr().err and not (tmp_path / "b.exr").exists()


def test_options_of_other_cameras_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ("-o", str(tmp_path / "a.exr"), "--quiet")
    assert main(["render", str(SCENE), "--camera", "thin", "--pupil", "boxes", *out]) != 0
    assert "pupil" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_directions_of_another_length_pass_nothing() -> None:
    """What a poor network makes of a few rays in a thousand million, here of every third."""
    lens = copy(camera("network"))

    class Poor:
        card = lens.model.card

        @staticmethod
        def rays(*inputs: object) -> object:
            out = lens.model.rays(*inputs)  # type: ignore[arg-type]
            ray = out.scene_ray.copy()
            ray[3:, ::3] *= np.float32(0.9)
            ray[3:, 1::9] = np.nan
            return out._replace(scene_ray=ray)

    film, square, wavelength = film_rays(lens, 900)
    before = lens.film.sample(film, square, wavelength)
    lens.film = copy(lens.film)
    scene = copy(lens.film.scene)
    object.__setattr__(scene, "model", Poor)
    lens.film.scene = scene
    after = lens.film.sample(film, square, wavelength)
    bad = np.zeros(900, bool)
    bad[::3] = bad[1::9] = True
    bad &= before.status == st.PASSED
    assert bad.any() and (after.status[bad] == st.OUTSIDE_DOMAIN).all() and (after.weight[bad] == 0).all()
    assert np.array_equal(after.status[~bad], before.status[~bad])
    assert np.linalg.norm(after.direction, axis=0) == pytest.approx(1, abs=1e-5)
