"""How near the nearest thing in view is: a ball on the axis has it in closed form."""

from pathlib import Path

import pytest

from neurolens.render.scene import load_scene
from neurolens.study.scenes import nearest_depth_m

CAMERA = """
[camera]
position_m = [1.0, 2.0, 3.0]
look_at_m = [1.0, 2.0, 0.0]
focus_m = 2.0
[environment]
colour = [1.0, 1.0, 1.0]
[materials]
grey = { kind = "diffuse", reflectance = [0.5, 0.5, 0.5] }
"""
BALL = """
[[spheres]]
centre_m = [%s]
radius_m = 0.5
material = "grey"
"""


def depth(tmp_path: Path, *centres: str) -> float | None:
    (tmp_path / "scene.toml").write_text(CAMERA + "".join(BALL % c for c in centres))
    return nearest_depth_m(load_scene(tmp_path / "scene.toml"), 50.0)


def test_the_nearest_ball_in_view_counts_from_the_film(tmp_path: Path) -> None:
    assert depth(tmp_path, "1.0, 2.0, 0.0", "1.0, 2.0, -4.0") == pytest.approx(2.5, abs=1e-3)
    # The plane through the ball's front, not the distance to it; the second one is behind the camera.
    assert depth(tmp_path, "2.0, 2.0, -2.0", "1.0, 2.0, 5.0") == pytest.approx(4.5, abs=0.02)
    assert depth(tmp_path) is depth(tmp_path, "1.0, 2.0, 5.0") is None
