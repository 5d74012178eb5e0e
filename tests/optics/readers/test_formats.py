"""Library lenses in every format come back, by command too; whatever else a file holds is a lens or one clear error."""

import json
import random
import re
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
from command_line import failure
from lens_formats import DRAWN, WRITERS, CannotSay, assert_same_optics, plain
from shipped import NAMES, PATHS, SOME, tabled

from neurolens.base.errors import AssumedWarning, InputError
from neurolens.cli import main
from neurolens.optics.lens.paraxial import system_of
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.readers.source import MAX_BYTES, ReadOptions

NO_DISPERSION = (".len", ".dat", ".txt")


ALL = WRITERS | DRAWN


@cache
def text_of(name: str, suffix: str) -> tuple[Lens, str] | None:
    """A shipped lens as a format can have it, and the text; None where the format has no words for it."""
    lens = plain(tabled(name))
    if suffix in NO_DISPERSION:
        lens = replace(lens, surfaces=tuple(replace(s, V_d=None) for s in lens.surfaces))
    try:
        return lens, ALL[suffix](lens)
    except CannotSay:
        return None


@pytest.mark.parametrize("suffix", ALL)
@pytest.mark.parametrize("name", SOME)
def test_library_lens_comes_back(name: str, suffix: str, tmp_path: Path) -> None:
    if (both := text_of(name, suffix)) is None:
        return  # counted below
    lens, text = both
    file, drawn = tmp_path / f"lens{suffix}", suffix in DRAWN
    file.write_text(text, encoding="utf-16" if suffix == ".zmx" else "utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("error", AssumedWarning)
        found = read_any(file)
    assert found.name == lens.name and len(found.surfaces) == len(lens.surfaces)
    for a, b in zip(found.surfaces, lens.surfaces, strict=True):
        assert (a.stop, a.figure.axis, a.n_d, a.V_d, a.figure.conic) == (
            b.stop,
            b.figure.axis,
            b.n_d,
            b.V_d,
            b.figure.conic,
        )
        assert a.diameter_mm == pytest.approx(b.diameter_mm, rel=1e-9 if drawn else 1e-12)
        assert a.thickness_mm == pytest.approx(b.thickness_mm, rel=0 if drawn else 1e-12, abs=0)
        assert dict(a.figure.asphere) == {p: c for p, c in b.figure.asphere if c}
    assert found.rims == "estimated" or not drawn
    assert_same_optics(found.with_stop_radius(lens.stop_radius_mm) if drawn else found, lens)
    if suffix in (".zmx", ".seq", ".json"):
        assert_same_states(found, lens)


def assert_same_states(found: Lens, expected: Lens) -> None:
    assert [c.name for c in found.configurations] == [c.name for c in expected.configurations]
    for a, b in zip(found.configurations, expected.configurations, strict=True):
        gaps = {k: s.thickness_mm for k, s in enumerate(expected.surfaces)}
        assert {**gaps, **dict(a.thickness_mm)} == pytest.approx({**gaps, **dict(b.thickness_mm)})
        assert a.object_distance_mm == pytest.approx(b.object_distance_mm)
        if b.stop_diameter_mm:
            assert a.stop_diameter_mm == pytest.approx(b.stop_diameter_mm)
        if b.efl_mm and b.object_distance_mm is None:
            assert a.efl_mm == pytest.approx(b.efl_mm, rel=0.02)  # what is stated is rounded


def test_every_format_is_met_by_some_lens() -> None:
    said = {suffix: sum(text_of(name, suffix) is not None for name in NAMES) for suffix in ALL}
    least = {".zmx": 37, ".seq": 35, ".len": 20, ".dat": 15, ".bench.txt": 28, ".lens": 20, ".camera.toml": 28}
    assert all(said[suffix] >= count for suffix, count in least.items()), said


GAUSS = plain(tabled("laikin_double_gauss_50"))
CONSTANT = replace(GAUSS, surfaces=tuple(replace(s, V_d=None) for s in GAUSS.surfaces))
TEXTS = {suffix: write(CONSTANT if suffix in NO_DISPERSION else GAUSS) for suffix, write in ALL.items()}
THICKNESS = repr(GAUSS.surfaces[0].thickness_mm)


def read_text(text: str | bytes, suffix: str, tmp_path: Path, options: ReadOptions | None = None) -> Lens:
    path = tmp_path / f"lens{suffix}"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_any(path, options)


@pytest.mark.parametrize("suffix", WRITERS)
@pytest.mark.parametrize("word", ["nan", "inf", "-inf", "1e999", "5,8", "5.8mm", "0x1F", "1_0", "--5", "five"])
def test_bad_number(word: str, suffix: str, tmp_path: Path) -> None:
    text = TEXTS[suffix]
    assert THICKNESS in text
    with pytest.raises(InputError) as caught:
        read_text(text.replace(THICKNESS, word, 1), suffix, tmp_path)
    line = text[: text.index(THICKNESS)].count("\n") + 1
    assert f"lens{suffix}" in str(caught.value)
    assert suffix == ".json" or f"line {line}" in str(caught.value)


@pytest.mark.parametrize("suffix", WRITERS)
@pytest.mark.parametrize(
    "content",
    [b"", b"  \n\n", b"\0\1\2" * 500, b"\xff\xfe\0", b"\x89PNG\r\n\x1a\n" + bytes(range(256)), b"hello world\n"],
    ids=["empty", "blank", "zeros", "half a letter", "picture", "prose"],
)
def test_content_that_is_no_lens(content: bytes, suffix: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=re.escape(f"lens{suffix}")):
        read_text(content, suffix, tmp_path)


@pytest.mark.parametrize("suffix", WRITERS)
def test_huge_file_is_refused_unread(suffix: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"more than {MAX_BYTES} bytes"):
        read_text(TEXTS[suffix].encode() + b" " * MAX_BYTES, suffix, tmp_path)


@pytest.mark.parametrize("suffix", WRITERS)
def test_too_many_surfaces_are_refused(suffix: str, tmp_path: Path) -> None:
    first = next(s for s in CONSTANT.surfaces if s.n_d == 1 and not s.stop)
    many = replace(CONSTANT, surfaces=(*CONSTANT.surfaces, *(replace(first, thickness_mm=1.0),) * 600))
    with pytest.raises(InputError, match="at most 500|1 to 500"):
        read_text(WRITERS[suffix](many), suffix, tmp_path)


@pytest.mark.parametrize("suffix", WRITERS)
def test_two_stops(suffix: str, tmp_path: Path) -> None:
    rows = list(CONSTANT.surfaces)
    rows.insert(6, rows[CONSTANT.stop_index])
    with pytest.raises(InputError, match="stop"):
        read_text(WRITERS[suffix](replace(CONSTANT, surfaces=tuple(rows))), suffix, tmp_path)


@pytest.mark.parametrize("suffix", WRITERS)
def test_without_a_stop_the_rim_that_limits_the_axial_beam_is_taken(suffix: str, tmp_path: Path) -> None:
    text = _without_stop(suffix)
    if suffix == ".json":  # our own transcriptions say where the stop is
        with pytest.raises(InputError, match="stop"):
            read_text(text, suffix, tmp_path)
        return
    with pytest.warns(AssumedWarning, match="no stop is marked: surface [0-9]+.*limits the beam of the axis"):
        lens = read_text(text, suffix, tmp_path)
    heights = system_of(lens).march(1.0, 0.0).y
    shares = [s.semi_diameter_mm / abs(y) for s, y in zip(lens.surfaces, heights, strict=True)]
    assert shares[lens.stop_index] == pytest.approx(min(shares))
    first = "1" if suffix in (".zmx", ".seq", ".len") else "0"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert read_text(text, suffix, tmp_path, ReadOptions(stop=first)).stop_index == 0
    with pytest.raises(InputError, match="--stop: got '99', expected the number of a surface in the file"):
        read_text(text, suffix, tmp_path, ReadOptions(stop="99"))


def _without_stop(suffix: str) -> str:
    marks = {".zmx": ("  STOP\n", ""), ".seq": ("  STO\n", ""), ".len": ("AST\n", ""), ".json": ("true", "false")}
    if suffix in marks:
        return TEXTS[suffix].replace(*marks[suffix])
    lines = TEXTS[suffix].splitlines(keepends=True)
    flat = next(k for k, line in enumerate(lines) if line.startswith("0.0\t"))
    count = [line.replace(str(len(CONSTANT.surfaces)), str(len(CONSTANT.surfaces) - 1)) for line in lines[:flat]]
    return "".join([*count, *lines[flat + 1 :]])


@pytest.mark.parametrize("suffix", [".zmx", ".seq", ".len", ".json"])
def test_a_file_cut_off_anywhere_is_noticed(suffix: str, tmp_path: Path) -> None:
    text = TEXTS[suffix]
    last = {".zmx": "BLNK", ".seq": "SI 0.0", ".len": "END ", ".json": "}"}[suffix]
    end = text.rindex(last)
    for cut in range(10, end, max(1, end // 60)):
        with pytest.raises(InputError, match=re.escape(f"lens{suffix}")):
            read_text(text[:cut], suffix, tmp_path)


@pytest.mark.parametrize("suffix", ALL)
def test_mangled_files_never_raise_anything_else(suffix: str, tmp_path: Path) -> None:
    chance, text = random.Random(1), TEXTS[suffix]
    for _ in range(60):
        letters = list(text)
        for _ in range(chance.randint(1, 4)):
            letters[chance.randrange(len(letters))] = chance.choice("0123456789.-+eE \n'\"&;!#/:SZ\x00\u00e9")
        try:
            lens = read_text("".join(letters), suffix, tmp_path)
        except InputError as error:
            assert f"lens{suffix}" in str(error) and "\n" not in str(error)
        else:
            assert lens.surfaces


@pytest.mark.parametrize("suffix", [".zmx", ".seq", ".len"])
def test_an_unknown_keyword_is_left_out_and_named(suffix: str, tmp_path: Path) -> None:
    lines, plain_lens = TEXTS[suffix].splitlines(), read_text(TEXTS[suffix], suffix, tmp_path)
    for place in range(4, len(lines) - 4, 7):
        broken = [*lines[:place], "QXW 1 2 3", *lines[place:]]
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                lens = read_text("\n".join(broken), suffix, tmp_path)
            except InputError as error:  # in a command that the next line continues
                assert re.search(r"QXW|CONSTANT|&", "\n".join(broken[place - 1 : place + 1]) + str(error))
                continue
        assert lens.surfaces == plain_lens.surfaces
        told = [str(w.message) for w in caught if "left out, unknown or without effect on rays" in str(w.message)]
        assert len(told) == 1 and ("QXW" in told[0] or "lines " in told[0])


def test_a_format_that_nobody_knows_lists_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"Zemax \(.zmx\).*CODE V.*OSLO|Zemax \(.zmx\).*OSLO.*CODE V"):
        read_text("what is this", ".abc", tmp_path)


TABLE = "# Singlet\n0 4.0 0 10\n50 5.0 1.5 20\n-50.0 0 1 20\n"


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "singlet.dat"
    path.write_text(TABLE)
    return path


def test_json_has_units_in_its_keys(table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["convert", str(table), "-o", str(tmp_path / "lens.toml"), "--units", "in", "--json"]) == 0
    captured = capsys.readouterr()
    data = json.loads(captured.out)
    assert captured.err == ""
    assert data["efl_mm"] == pytest.approx(25.4 / (0.5 * (2 / 50 - 0.5 * 5 / (1.5 * 2500))))
    assert data["efl_x_mm"] is None and data["configurations"] == [] and data["surfaces"] == 3
    assert any("no f-number is stated" in text for text in data["warnings"])


def test_a_file_that_is_there_stays_without_force(
    table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "lens.toml"
    out.write_text("mine")
    assert "--force" in failure(capsys, "convert", table, "-o", out)
    assert out.read_text() == "mine"
    assert main(["convert", str(table), "-o", str(out), "--force"]) == 0
    assert read_lens(out).name == "Singlet"


def test_nothing_is_written_for_a_bad_file(table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table.write_text(TABLE + "1 2 3\n")
    assert "singlet.dat: line 5, row: got '1 2 3'" in failure(capsys, "convert", table, "-o", tmp_path / "lens.toml")
    assert list(tmp_path.iterdir()) == [table]


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("-o", "lens.json"), "--output: got '.json', expected .toml"),
        (("-o", "nowhere/lens.toml"), "a folder that exists"),
        (("-o", "lens.toml", "--f-number", "0"), "an f-number above 0"),
        (("-o", "lens.toml", "--units", "ell"), "invalid choice: 'ell'"),
        (("-o", "lens.toml", "--half-field", "200"), "from 0.001 to 179"),
    ],
)
def test_wrong_command_lines(
    args: tuple[str, ...],
    message: str,
    table: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(table.parent)
    assert message in failure(capsys, "convert", table, *args)


def test_options_for_tables_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "lens.zmx"
    path.write_text(WRITERS[".zmx"](plain(read_lens(PATHS[0]))))
    assert "--gap-before" in failure(capsys, "convert", path, "-o", tmp_path / "lens.toml", "--gap-before")


@pytest.mark.parametrize("path", PATHS[::6], ids=lambda p: p.stem)
def test_round_trip(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Other program -> lens file -> the same lens, bit for bit."""
    lens = plain(read_lens(path))
    for suffix in (".zmx", ".seq", ".json"):
        foreign, out = tmp_path / f"lens{suffix}", tmp_path / f"{suffix[1:]}.toml"
        try:
            foreign.write_text(WRITERS[suffix](lens))
        except CannotSay:
            continue
        assert main(["convert", str(foreign), "-o", str(out)]) == 0
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            expected = read_any(foreign)
        written = read_lens(out)
        assert replace(written, path=str(foreign), notes=expected.notes) == expected
        for warning in caught:  # the converted file says what was left out and assumed
            assert str(warning.message).removeprefix(f"{foreign}: ") in written.notes
    assert "written to" in capsys.readouterr().out


def test_a_lens_file_of_our_own_is_read_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "lens.toml"
    assert main(["convert", str(PATHS[2]), "-o", str(out)]) == 0
    assert replace(read_lens(out), path=str(PATHS[2])) == read_lens(PATHS[2])
    capsys.readouterr()
    assert "--name and --source only" in failure(capsys, "convert", PATHS[2], "-o", out, "--force", "--units", "in")
    assert main(["convert", str(PATHS[2]), "-o", str(out), "--force", "--name", "mine"]) == 0
    assert read_lens(out).name == "mine"
