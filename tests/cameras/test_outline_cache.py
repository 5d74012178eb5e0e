"""Outlines kept between runs: found again bit for bit, made anew when damaged, never taken for another lens's."""

import io
from dataclasses import replace
from pathlib import Path

import lens_models
import numpy as np
import pytest

from neurolens.base.files import cache_folder
from neurolens.base.progress import Progress
from neurolens.cameras import exact
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.exact import ExactCamera, kept_outline, search_key
from neurolens.cameras.model import OnnxCamera, load_model
from neurolens.cameras.pupil_outline import PupilOutline
from neurolens.optics.lens.figures import Cylinder, Figure
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.lens.shot import Shot
from neurolens.optics.setting.states import set_lens

KEY = "0123456789abcdef" * 4


@pytest.fixture(autouse=True)
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return cache_folder()


def outline(size: float = 1.0) -> PupilOutline:
    sides = np.float32(size) * np.arange(2 * 3 * 4, dtype=np.float32).reshape(2, 3, 4)
    return PupilOutline(-50.0, 20.0, (400.0, 700.0), np.arange(3, dtype=np.float32), sides, sides + 1)


def parts(found: PupilOutline | None) -> tuple[object, ...]:
    assert found is not None
    arrays: tuple[FloatArray, ...] = (found.centre, found.x, found.y)
    return (found.pupil_z_mm, found.film_radius_mm, found.wavelength_nm, *(a.tobytes() for a in arrays))


def never(*given: object) -> PupilOutline:
    raise AssertionError("searched again")


def test_a_camera_starts_from_the_outline_of_the_run_before(monkeypatch: pytest.MonkeyPatch) -> None:
    def camera(focus_m: float, shown: Progress | None = None) -> ExactCamera:
        return ExactCamera(lens, Shot((36, 24), focus_m), progress=shown)

    lens, written = lens_models.lens("tronnier_double_gauss_100"), io.StringIO()
    first = camera(2.0, Progress(stream=written))
    assert written.getvalue().startswith(f"search the pupil of {lens.name}: ")
    monkeypatch.setattr(exact, "outline_of", never)
    assert parts(camera(2.0).film.outline) == parts(first.film.outline)
    with pytest.raises(AssertionError, match="searched"):
        camera(2.1)


def test_a_models_outline_is_kept_for_its_coefficients_focus_and_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    def camera(kind: str, focus_m: float = 2.0, f_number: float = 4.0) -> OnnxCamera:
        return OnnxCamera(load_model(lens_models.exported(kind)), Shot((36, 24), focus_m, f_number))

    first = camera("invariants")
    monkeypatch.setattr("neurolens.cameras.model.outline_of", never)
    assert parts(camera("invariants").film.outline) == parts(first.film.outline)
    for others in (("thick",), ("invariants", 3.0), ("invariants", 2.0, 5.6)):
        with pytest.raises(AssertionError, match="searched"):
            camera(*others)


def test_whatever_the_search_reads_is_in_the_key() -> None:
    lens = set_lens(lens_models.lens(), focus_m=2.0)

    def key(lens: Lens, waves: tuple[float, float] = (400.0, 700.0), *settings: object) -> str:
        return search_key(lens, waves, (0.0, 0.5, 1.0), *settings)

    def changed(k: int, **fields: object) -> Lens:
        rows = [replace(s, **fields) if i == k else s for i, s in enumerate(lens.surfaces)]
        return replace(lens, surfaces=tuple(rows))

    others = [
        changed(0, radius_mm=float(lens.surfaces[0].radius_mm) * (1 + 1e-15)),
        changed(3, thickness_mm=1.0), changed(2, diameter_mm=9.0), changed(0, figure=Figure(0.1)),
        changed(0, figure=Figure(asphere=((4, 1e-9),))), changed(1, figure=Cylinder(cylinder="x")),
        changed(0, n_d=1.7, glass=None), changed(0, V_d=30.0, glass=None),
        changed(0, glass="N-BK7"), set_lens(lens, f_number=4.0), replace(lens, film_z_mm=90.0),
    ]  # fmt: skip
    keys = [key(lens), *map(key, others), key(lens, (400.0, 650.0)), key(lens, (400.0, 700.0), "float64")]
    assert len(set(keys)) == len(keys) and key(lens) == keys[0]


@pytest.mark.parametrize("harm", ["cut", "flipped", "empty"])
def test_damaged_files_are_made_again(folder: Path, harm: str) -> None:
    kept_outline(KEY, outline)
    (file,) = folder.iterdir()
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes({"cut": data[:-40], "flipped": data, "empty": b""}[harm])
    assert parts(kept_outline(KEY, lambda: outline(2.0))) == parts(outline(2.0))
    assert parts(kept_outline(KEY, never)) == parts(outline(2.0))
