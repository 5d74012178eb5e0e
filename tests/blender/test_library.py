"""What the extension reads and refuses, without Blender; and how its zip and its user folder are written."""

from __future__ import annotations

import importlib.util
import json
import math
import sys
import zipfile
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from neurolens.base.errors import InputError
from neurolens.blender import pack
from neurolens.blender.pack import Form, PackedLens, add_to_folder, add_to_zip, user_folders, write_pack, year_of


def _library() -> ModuleType:
    """The module by itself: its package starts with Blender."""
    spec = importlib.util.spec_from_file_location("neurolens_library", pack.EXTENSION / "library.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look their module up
    spec.loader.exec_module(module)
    return module


library = _library()


def lens(lens_id: str = "gauss", kinds: tuple[str, ...] = ("polynomial",), efl_mm: float = 49.6) -> PackedLens:
    forms = [Form(k, "" if k == "exact" else k, "shader", 0.5, 21.6, 1.8, 0.7) for k in kinds]
    return PackedLens(lens_id, "Gauss", efl_mm, 1.8, "Laikin (1995), p. 77", b"png", forms)


def variant(**changed: Any) -> Any:
    values = {"kind": "polynomial", "model": "", "path": Path("x"), "rms_um": 0.5, "film_radius_mm": 21.6}
    return library.Variant(**{**values, "f_number": 1.8, "nearest_m": 0.7, **changed})


def setting(**changed: Any) -> Any:
    return library.Setting(**{"sensor_mm": (36.0, 24.0), "pixels": 3600, "focus_m": 2.0, **changed})


def test_zip_is_read_as_it_was_written_and_takes_more(tmp_path: Path) -> None:
    out, folder = tmp_path / "n.zip", tmp_path / "unpacked"
    write_pack(out, [lens(), lens("wide", ("network",), 20.0)])
    first = out.read_bytes()
    write_pack(out, [lens(), lens("wide", ("network",), 20.0)])
    assert out.read_bytes() == first
    add_to_zip(out, lens("gauss", ("exact",)))
    with zipfile.ZipFile(out) as packed:
        packed.extractall(folder)
    found, wrong = library.read_library([folder])
    assert not wrong and list(found) == ["wide", "gauss"]  # by focal length
    assert found["gauss"].variants.keys() == {"exact", "polynomial"} and found["gauss"].year == 1995
    assert found["gauss"].line == "49.6 mm f/1.8, 1995"
    assert all(v.path.read_text() == "shader" for f in found.values() for v in f.variants.values())
    assert found["gauss"].picture.read_bytes() == b"png"
    assert len({f.number for f in found.values()}) == 2
    with pytest.raises(InputError, match="each id once"):
        write_pack(out, [lens(), lens()])


def test_user_folder_adds_to_the_lenses_that_ship(tmp_path: Path) -> None:
    shipped, own = tmp_path / "shipped", tmp_path / "own"
    add_to_folder(shipped, lens())
    add_to_folder(own, lens("gauss", ("exact",)))
    add_to_folder(own, lens("mine"))
    found, wrong = library.read_library([shipped, own, tmp_path / "none"])
    assert not wrong and found["gauss"].variants.keys() == {"polynomial", "exact"} and "mine" in found


@pytest.mark.parametrize(
    "facts",
    ["{", "[]", '{"schema": 2, "lenses": []}', '{"schema": 1, "lenses": [{"id": "a"}]}', '{"schema": 1, "lenses": 3}'],
)
def test_facts_that_are_none_are_named_and_left(facts: str, tmp_path: Path) -> None:
    (tmp_path / "lenses.json").write_text(facts)
    found, wrong = library.read_library([tmp_path])
    assert not found and len(wrong) == 1 and str(tmp_path) in wrong[0]
    with pytest.raises(InputError):
        add_to_folder(tmp_path, lens())
    assert (tmp_path / "lenses.json").read_text() == facts


def test_files_outside_the_folder_are_not_read(tmp_path: Path) -> None:
    add_to_folder(tmp_path, lens())
    data = json.loads((tmp_path / "lenses.json").read_text())
    data["lenses"][0]["variants"][0]["file"] = "../secret.osl"
    (tmp_path / "lenses.json").write_text(json.dumps(data))
    found, wrong = library.read_library([tmp_path])
    assert not found and "leads out" in wrong[0]


@pytest.mark.parametrize("content", [b"", b"PK", None])
def test_no_extension_takes_no_lens(content: bytes | None, tmp_path: Path) -> None:
    path = tmp_path / "n.zip"
    if content is None:
        with zipfile.ZipFile(path, "w") as packed:
            packed.writestr("other.txt", "x")
    else:
        path.write_bytes(content)
    with pytest.raises(InputError, match="neurolens blender build"):
        add_to_zip(path, lens())


def test_refusals_and_notes_are_sentences() -> None:
    assert library.refusals(variant(), setting()) == [] == library.notes(variant(), setting())
    assert library.refusals(variant(), setting(focus_m=0.6999)) == []
    [near] = library.refusals(variant(), setting(focus_m=0.3, focus_object="nose"))
    assert near == "The focus object 'nose' is 0.3 m away, nearer than the lens focuses: 0.7 m"
    [large] = library.refusals(variant(film_radius_mm=10.0), setting())
    assert "36 x 24 mm" in large and "at most 16.64 mm wide" in large
    fitted = library.fitting_width_mm(variant(film_radius_mm=10.0), setting())
    assert not library.refusals(variant(film_radius_mm=10.0), setting(sensor_mm=(fitted, fitted * 2 / 3)))
    said = library.notes(
        variant(rms_um=25.0, poor=("pixels",), notes=("no coatings",)),
        setting(f_number=1.2, focus_m=None, unit_m=0.01, on_gpu=True),
    )
    assert len(said) == 7 and said[0] == "The lens opens to f/1.8: f/1.2 renders as that" and said[-1] == "no coatings"
    assert "2.5 pixels" in said[4]
    assert library.refusals(variant(nearest_m=None), setting(focus_m=0.01)) == []
    assert library.refusals(variant(), setting(focus_m=math.inf)) == []


def test_shift_is_told_where_it_counts_another_side_or_leaves_the_picture() -> None:
    """As Cycles has it; `test_optics` holds that it does."""
    small = {"sensor_mm": (24.0, 12.0)}
    assert library.notes(variant(), setting(**small, shift=(0.1, 0.0), shift_side_mm=24.0)) == []
    [line] = library.notes(variant(), setting(**small, shift=(0.1, 0.1), shift_side_mm=24.0))
    assert line == "Shift Y counts heights here: for what 0.1 does in Blender's own camera, set 0.2"
    assert library.notes(variant(), setting(shift_side_mm=36.0)) == []
    [line] = library.notes(variant(), setting(shift=(0.1, 0.0), shift_side_mm=36.0))
    assert "24.71 mm from the axis; the lens's picture ends at 21.6 mm" in line  # hypot(0.6 * 36, 12)


def test_error_in_pixels_of_the_render() -> None:
    assert library.error_px(variant(rms_um=5.0), setting()) == pytest.approx(0.5)
    assert library.error_px(variant(rms_um=None), setting()) is None


def test_blenders_that_cannot_run_lenses() -> None:
    assert library.refused((4, 4, 3)).startswith("This is Blender 4.4.3: cameras written in OSL need 4.5")
    assert library.refused((4, 5, 0)) is None and library.refused((5, 1, 0, "alpha")) is None
    assert "Open Shading Language" in library.refused((5, 0, 0), False)


def test_years_of_sources() -> None:
    assert year_of("US 2,854,889 (Brendel, 1958); table as in Smith, Modern Lens Design (1992)") == 1958
    assert year_of("US 2,019,982") is None and year_of("DE 485,798 (1927)") == 1927
    assert year_of("Japanese patent S.53-131852; table in Smith, 2nd ed. (2005)") == 1978
    assert year_of("US 2014/0300973 A1, tables 1 and 2") == 2014 and year_of("a textbook") is None


def test_user_folder_is_where_blender_keeps_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("BLENDER_USER_RESOURCES", raising=False)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert user_folders() == []
    for version in ("4.5", "5.0", "10.1"):
        place = tmp_path / "blender" / version / "extensions" / "user_default" / "neurolens"
        place.mkdir(parents=True)
        (place / "blender_manifest.toml").touch()
    assert [p.relative_to(tmp_path).parts[1] for p in user_folders()] == ["10.1", "5.0", "4.5"]
    assert user_folders()[0].parts[-3:] == (".user", "user_default", "neurolens")
