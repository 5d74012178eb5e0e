"""What the extension says that a shot needs, and the field of a lens that it says so from."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import Any

import pytest

from neurolens.programs import blender as pack

library = pack.extension_library()
FIELD = library.Field((0.0, 10.0, 21.0), 1.0, ((0.0, 40.0, 200.0),) * 2, ((20.0,) * 3,) * 2, ((1.0, 0.9, 0.5),) * 2)


def lens(field: Any = FIELD, **kinds: float | None) -> Any:
    variants = {
        kind: library.Variant(kind, "", Path("x"), error, 21.6, 1.8, 0.7)
        for kind, error in (kinds or {"polynomial": 0.5, "exact": None}).items()
    }
    return library.LensFacts("gauss", "Gauss", 50.0, 1.8, None, "", None, variants, field)


def setting(**changed: Any) -> Any:
    return library.Setting(**{"sensor_mm": (36.0, 24.0), "pixels": 3600, "focus_m": 2.0, **changed})  # 10 um a pixel


def test_confusion_is_that_of_the_thin_lens() -> None:
    for focus, depth in ((2.0, 5.0), (2.0, 0.8), (2.0, math.inf), (math.inf, 3.0)):
        film, there = (
            50.0 if math.isinf(d) else (1e3 * d - math.sqrt(1e3 * d * (1e3 * d - 200))) / 2 for d in (focus, depth)
        )
        # The conjugates: 1 / f = 1 / object + 1 / image, from the lens.
        if not math.isinf(depth):
            assert 1 / (1e3 * depth - there) + 1 / there == pytest.approx(1 / 50)
        expected = 50 / 2 * abs(there - film) / there
        assert library.confusion_mm(50.0, 2.0, focus, depth) == pytest.approx(expected)
    assert library.confusion_mm(50.0, 2.0, 2.0, 2.0) == 0


@pytest.mark.parametrize(
    ("tolerance", "depths", "use"),
    [
        (30.0, [2.0], "pinhole"),
        (30.0, [2.0, 0.6], "depth of field"),
        (1.0, [2.0], "polynomial"),
        (0.01, [2.0], "exact"),
    ],
)
def test_the_cheapest_that_holds_is_advised(tolerance: float, depths: list[float], use: str) -> None:
    told = library.needs(lens(), setting(), depths, 2.0, tolerance)
    assert told.use == use and len(told.why) == 2 and all(line.endswith(".") for line in told.why)
    assert "20 px" in told.why[1]  # of distortion at the corner, of 200 um
    turned = library.needs(lens(), setting(turned=True), depths, 2.0, tolerance)
    assert turned.use == ("polynomial" if tolerance > 1 else use)  # Blender's own camera has no film to turn


def test_what_keeps_no_tolerance_names_the_best() -> None:
    told = library.needs(lens(polynomial=3.0, network=2.0), setting(), [2.0], 2.0, 0.01)
    assert told.use == "" and "the best is network with 0.2 px" in told.why[0]
    assert "none takes" in library.needs(lens(), setting(sensor_mm=(90.0, 60.0)), [], 2.0, 0.01).why[0]
    assert "not known" in library.needs(lens(field=None), setting(), [], 2.0, 1e6).why[1]


def test_field_is_that_of_the_lens_and_goes_through_the_zip(tmp_path: Path) -> None:
    """A stopped and scaled form of the same lens has the field scaled; the facts are read as they were written."""
    pytest.importorskip("torch")
    from neurolens.cli.blender import field_table
    from neurolens.optics.readers.lensfile import read_lens
    from neurolens.optics.setting.states import set_lens

    path = "lenses/cooke_triplet_50.toml"
    once, twice = (
        field_table(set_lens(read_lens(path), focal_length_mm=f), r) for f, r in ((50.0, 18.0), (100.0, 36.0))
    )
    assert once is not None and twice is not None
    for name in ("distortion_um", "blur_um"):
        for a, b in zip(once[name], twice[name], strict=True):
            assert b == pytest.approx([2 * v for v in a], rel=0.02, abs=0.2)
    assert once["light"][0] == sorted(once["light"][0], reverse=True) and once["light"][0][0] == 1
    form = pack.Form("polynomial", "ols", "shader", 0.5, 18.0, 5.0, 0.7)
    pack.write_pack(tmp_path / "n.zip", [pack.PackedLens("a", "A", 50.0, 5.0, "", None, [form], once)])
    with zipfile.ZipFile(tmp_path / "n.zip") as packed:
        packed.extractall(tmp_path)
    found, wrong = library.read_library([tmp_path])
    assert not wrong and found["a"].field.light[0] == tuple(once["light"][0])
    field = found["a"].field
    assert field.at(field.distortion_um, 1e9, math.inf) == max(once["distortion_um"][0])
    assert field.at(field.light, 1e9, 0.1) == min(once["light"][1])
