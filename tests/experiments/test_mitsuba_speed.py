"""The bench beside Mitsuba, without Mitsuba: figures of known times, a known profile, memory that grows."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.mitsuba_speed import STAGES, Found, Row, Settings, film_mm, page, profile, record
from neurolens.cameras.contract import CameraRays, FloatArray
from neurolens.cameras.pinhole import Pinhole
from neurolens.render.scene import scene_from_tables

SETTINGS = Settings(size=100, samples=4, threads=2, repeats=3)


def row(seconds: list[float], pictures: list[FloatArray]) -> Row:
    return Row(
        "name", "RGB", "pinhole", lambda seed: pictures[0], np.ones((1, 1, 1), np.float32), 9.0, seconds, pictures
    )


def test_figures_of_known_times_and_pictures() -> None:
    base = row([0.4, 0.2, 0.3], [np.full((2, 2, 3), v, np.float32) for v in (1, 2, 3)])
    found = record(row([0.5, 0.6, 0.7], base.pictures), SETTINGS, base)
    assert found["mpaths_per_s"] == pytest.approx(40_000 / 0.5 * 1e-6)
    assert found["mpaths_per_s_median"] == pytest.approx(40_000 / 0.6 * 1e-6)
    assert found["time_over_ours"] == pytest.approx(0.6 / 0.3)
    assert found["mean_rgb"] == pytest.approx([2, 2, 2])
    assert found["noise"] == pytest.approx(1 / np.mean([1, 4, 9]))  # variance 1 over the mean square


def test_the_first_picture_is_kept_apart_and_white_is_taken_out() -> None:
    made = Row("name", "RGB", "pinhole", lambda seed: np.full((2, 2, 3), seed, np.float32), np.float32(0.5))  # type: ignore[arg-type]
    for seed in range(3):
        made.run(seed)
    assert len(made.seconds) == 2 and made.first_s > 0
    assert [p.mean() for p in made.pictures] == [2, 4]


def test_the_film_sees_what_a_field_of_90_degrees_does() -> None:
    assert film_mm({"sensor": {"fov": 90}}) == pytest.approx((100, 100))  # 50 mm behind the hole


class Slow(Pinhole):
    """A camera that takes longer than all the rest."""

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        np.linalg.svd(np.ones((600, 600)))
        return super().sample(film_mm, pupil, wavelength_nm)


def test_a_slow_camera_is_what_takes_the_time() -> None:
    camera = {"position_m": [0, 1, 0], "look_at_m": [0, 1, -1], "focus_m": 2, "film_width_mm": 32, "film_height_mm": 18}
    tables = {"camera": camera, "materials": {"grey": {"kind": "diffuse", "reflectance": [0.5, 0.5, 0.5]}}}
    tables |= {"planes": [{"point_m": [0, 0, 0], "normal": [0, 1, 0], "material": "grey"}]}
    tables |= {"environment": {"colour": [1, 1, 1]}}
    scene = scene_from_tables(tables)
    fast, slow = (profile(scene, kind(20, (32, 18)), 32, 18, 4) for kind in (Pinhole, Slow))
    for shares in (fast, slow):
        assert set(shares) == set(STAGES) and min(shares.values()) >= 0
        assert sum(shares.values()) == pytest.approx(1)
    assert fast["camera"] < 0.3 and fast["intersection"] > 0 and fast["random numbers"] > 0
    assert slow["camera"] > 0.6


def test_memory_is_split_into_what_grows_with_the_picture_and_what_does_not() -> None:
    found = Found(SETTINGS, {"numpy": "2"})
    sizes = [(200, 100), (2000, 1000), (4000, 1000)]
    found.memory = [
        {"width": w, "height": h, "samples": 1, "growth_mb": 24 + 60e-6 * w * h if w > 200 else 5} for w, h in sizes
    ]
    found.memory.append({"width": 200, "height": 100, "samples": 64, "growth_mb": 25})
    text = page(found)
    assert "60 bytes a pixel" in text and "take 24 MB" in text
