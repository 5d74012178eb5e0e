"""What the extension reads and refuses, without Blender; and how its zip and its user folder are written."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import sys
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from neurolens.base.errors import InputError
from neurolens.programs import blender
from neurolens.programs.blender import (
    Form,
    PackedLens,
    add_lens,
    extension_library,
    user_folders,
    write_pack,
)

library = extension_library()


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
    add_lens(out, lens("gauss", ("exact",)))
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


@pytest.mark.parametrize("suffix", ["", ".zip"])
def test_lenses_added_at_once_are_all_there(suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Eight threads that all read before any writes, were there no lock."""
    to, entries = tmp_path / f"own{suffix}", blender._merged
    if suffix:
        write_pack(to, [lens("first")])

    def slowly(*args: Any) -> Any:
        time.sleep(0.05)
        return entries(*args)

    monkeypatch.setattr(blender, "_merged", slowly)
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda k: add_lens(to, lens(f"lens_{k}")), range(8)))
    ids = {entry["id"] for entry in blender._contents(to)[1]}
    assert ids == {f"lens_{k}" for k in range(8)} | ({"first"} if suffix else set())


@pytest.mark.skipif(not Path("/proc/locks").exists(), reason="this system does not tell who locks a folder")
def test_a_lock_that_stays_is_named_and_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blender, "LONGEST_S", 0.2)
    with (
        blender.locked(tmp_path),
        pytest.raises(InputError, match=rf"lock: got \(held by process {os.getpid()}\), expected freed within 0.2 s"),
    ):
        add_lens(tmp_path, lens())
    assert not list(tmp_path.iterdir())
    add_lens(tmp_path, lens())


def test_user_folder_adds_to_the_lenses_that_ship(tmp_path: Path) -> None:
    shipped, own = tmp_path / "shipped", tmp_path / "own"
    add_lens(shipped, lens())
    add_lens(own, lens("gauss", ("exact",)))
    add_lens(own, lens("mine"))
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
        add_lens(tmp_path, lens())
    assert (tmp_path / "lenses.json").read_text() == facts


def test_files_outside_the_folder_are_not_read(tmp_path: Path) -> None:
    add_lens(tmp_path, lens())
    data = json.loads((tmp_path / "lenses.json").read_text())
    data["lenses"][0]["variants"][0]["file"] = "../secret.osl"
    (tmp_path / "lenses.json").write_text(json.dumps(data))
    found, wrong = library.read_library([tmp_path])
    assert not found and "leads out" in wrong[0]


def entry(**changed: Any) -> str:
    """Facts of one lens, some of its values changed."""
    facts = lens().facts() | changed
    return json.dumps({"schema": 1, "lenses": [facts]})


def test_facts_hold_what_people_call_a_lens(tmp_path: Path) -> None:
    (tmp_path / "shaders").mkdir()
    facts = dataclasses.replace(lens(), lens_id="merte_biotar_100").facts()
    assert "helios 44" in facts["said"] and lens().facts()["said"] == []
    assert "helios 44" in library.lens_of(tmp_path, facts).said


BAD_ZIPS: dict[str, Any] = {
    "empty": b"",
    "damaged at the start": b"PK",
    "no facts": {"other.txt": "x"},
    "facts nested too deeply": {"lenses.json": "[" * 100_000},
    "kind that is no text": {"lenses.json": entry(variants=[{"kind": {}}])},
    "variants that are no list": {"lenses.json": entry(variants=5)},
    "variants of texts": {"lenses.json": entry(variants=["kind"])},
    "a number that is none": {"lenses.json": entry(efl_mm=math.nan)},
    "an infinite number": {"lenses.json": entry(efl_mm=math.inf)},
    "a year beyond every number": {"lenses.json": entry(year="9" * 5000)},
    "a lens's file outside": {"lenses.json": entry(picture="../secret.png")},
    "an entry outside": {"lenses.json": entry(), "../escaped.osl": "x"},
    "an absolute entry": {"lenses.json": entry(), "/tmp/escaped.osl": "x"},
    "an entry outside on Windows": {"lenses.json": entry(), "..\\escaped.osl": "x"},
}


@pytest.mark.parametrize("content", BAD_ZIPS.values(), ids=BAD_ZIPS)
def test_no_extension_takes_no_lens(content: bytes | dict[str, str], tmp_path: Path) -> None:
    path = tmp_path / "n.zip"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        with zipfile.ZipFile(path, "w") as packed:
            for name, text in content.items():
                packed.writestr(name, text)
    before = path.read_bytes()
    with pytest.raises(InputError, match="neurolens blender build"):
        add_lens(path, lens())
    assert path.read_bytes() == before


@pytest.mark.parametrize("at", ["flags", "method", "data", "size"])
def test_zips_that_are_encrypted_packed_otherwise_damaged_or_lie_take_no_lens(at: str, tmp_path: Path) -> None:
    path = tmp_path / "n.zip"
    write_pack(path, [lens()])
    data = bytearray(path.read_bytes())
    local, listed = data.index(b"PK\3\4"), data.index(b"PK\1\2")  # headers of the first entry
    if at == "flags":
        data[local + 6] |= 1
        data[listed + 8] |= 1
    elif at == "method":
        data[local + 8] = data[listed + 10] = 99
    elif at == "data":
        data[local + 60 : local + 80] = b"\xff" * 20
    else:
        data[listed + 24 : listed + 28] = (4_000_000_000).to_bytes(4, "little")
    path.write_bytes(data)
    with pytest.raises(InputError, match="neurolens blender build"):
        add_lens(path, lens())


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no FIFOs")
def test_fifos_are_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "f.zip")
    with pytest.raises(InputError, match="not a regular file"):
        add_lens(tmp_path / "f.zip", lens())
    os.mkfifo(tmp_path / "lenses.json")
    with pytest.raises(InputError, match="not a regular file"):
        add_lens(tmp_path, lens())


@pytest.mark.parametrize("method", ["../../../escaped/evil", "/etc/evil", "a" * 300, "..\\evil", "x\0y", "\udc80"])
def test_no_text_of_a_card_leads_out_of_the_folder(method: str, tmp_path: Path) -> None:
    """The card's fit.method was a part of the shader's path: it wrote outside, or no file could have its name."""
    hostile = PackedLens("gauss", "Gauss", 50.0, 1.8, "", None, [Form("polynomial", method, "x", 1.0, 21.6, 1.8, 0.7)])
    folder, out = tmp_path / "a" / "b" / "c", tmp_path / "n.zip"
    add_lens(folder, hostile)
    write_pack(out, [hostile])
    found, wrong = library.read_library([folder])
    assert not wrong and found["gauss"].variants["polynomial"].path.read_text() == "x"
    assert {p.relative_to(tmp_path).parts[0] for p in tmp_path.rglob("*")} == {"a", "n.zip"}
    [name] = [n for n in zipfile.ZipFile(out).namelist() if n.endswith(".osl")]
    assert ".." not in name.split("/") and len(name) < 120 and name.isascii()


def test_shift_is_told_where_it_counts_another_side_or_leaves_the_picture() -> None:
    """As Cycles has it; `test_optics` holds that it does."""
    small = {"sensor_mm": (24.0, 12.0)}
    assert library.notes(variant(), setting(**small, shift=(0.1, 0.0), shift_side_mm=24.0)) == []
    [line] = library.notes(variant(), setting(**small, shift=(0.1, 0.1), shift_side_mm=24.0))
    assert line == "Shift Y counts heights here: for what 0.1 does in Blender's own camera, set 0.2"
    assert library.notes(variant(), setting(shift_side_mm=36.0)) == []
    assert library.outside(variant(), setting(**small, shift=(0.2, 0.1))) == []
    [line] = library.outside(variant(), setting(shift=(0.1, 0.0)))
    assert "The shift takes a corner to 24.71 mm from the axis; the lens's picture ends at 21.6 mm" in line
    assert math.hypot(0.6 * 36, 12) == pytest.approx(24.71, abs=0.005)


def test_the_eye_whose_picture_leaves_the_image_circle_is_told() -> None:
    """A film of 33 x 16 mm reaches 18.3 of 21.6 mm; an eye that is shifted by a fifth of the width, 24.5 mm."""
    film = {"sensor_mm": (33.0, 16.0)}
    assert library.outside(variant(), setting(**film, stereo=(0.05, -0.05))) == []
    for shift, stereo in ((0.0, (0.1, -0.2)), (0.1, (0.1, -0.1)), (-0.1, (0.0, -0.1))):
        [line] = library.outside(variant(), setting(**film, shift=(shift, 0.0), stereo=stereo))
        assert line.startswith("Off-axis stereo takes a corner to 24.45 mm") and "Parallel" in line
    assert math.hypot(0.7 * 33, 8) == pytest.approx(24.45, abs=0.005)
    assert library.outside(variant(), setting(**film, shift=(0.2, 0.0), stereo=(-0.18, -0.2))) == []


def test_blenders_that_cannot_run_lenses() -> None:
    assert library.refused((4, 4, 3)).startswith("This is Blender 4.4.3: cameras written in OSL need 4.5")
    assert library.refused((4, 5, 0)) is None and library.refused((5, 1, 0, "alpha")) is None
    assert "Open Shading Language" in library.refused((5, 0, 0), False)


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


def facts(lens_id: str, **more: Any) -> Any:
    """The facts of a lens as the extension has them."""
    values = {"name": lens_id, "efl_mm": 50.0, "f_number": 2.0, "year": None, "source": "", "picture": None}
    return library.LensFacts(lens_id=lens_id, variants={}, **{**values, **more})


def test_menus_are_sorted_by_each_order() -> None:
    """By data rising, by character the strongest first, what is not known last; equal lenses keep their order."""
    some = [
        facts("a", efl_mm=100.0, f_number=1.4, maker="Zeiss", year=1950, character={"swirl": 0.2, "cats_eye": 0.5}),
        facts("b", efl_mm=35.0, maker="canon", year=2001, character={"swirl": 0.6, "cats_eye": 0.9}),
        facts("c", f_number=1.2),
    ]
    expected = {
        "focal_length": "bca", "speed": "cab", "year": "abc", "maker": "bac", "swirl": "bac", "cats_eye": "abc",
        "bubble": "abc", "softness_um": "abc", "flare": "abc",
    }  # fmt: skip
    assert expected.keys() == library.ORDERS.keys()
    assert {o: "".join(f.lens_id for f in library.ordered(some, o)) for o in library.ORDERS} == expected
    assert some[1].entry("maker") == "canon: b (35 mm f/2, 2001)" and some[2].entry("maker") == "c (50 mm f/1.2)"
    assert some[1].entry("swirl") == "b (35 mm f/2, 2001), swirl 0.6"
    assert some[2].entry("swirl") == some[2].entry("year")


def test_maker_character_and_bokeh_go_into_the_zip(tmp_path: Path) -> None:
    told = dataclasses.replace(lens(), maker="Laikin", character={"swirl": 0.4, "flare": None}, bokeh=b"discs")
    add_lens(tmp_path, told)
    found = library.read_library([tmp_path])[0]["gauss"]
    assert (found.maker, found.character, found.bokeh.read_bytes()) == ("Laikin", {"swirl": 0.4}, b"discs")
    add_lens(tmp_path, lens("gauss", ("exact",)))  # another form keeps what it does not bring
    assert library.read_library([tmp_path])[0]["gauss"].bokeh == found.bokeh


def test_characters_are_those_of_the_table() -> None:
    from neurolens.cli.lens import CHARACTER  # no module of Blender's environment needs more than this file

    assert {figure for figure, _ in CHARACTER.values()} == library.CHARACTER.keys()
