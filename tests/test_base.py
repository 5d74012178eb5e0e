"""The base: files that are whole or not there, settings, what progress says of the time left."""

import argparse
import io
import math
import os
import re
import subprocess
import sys
import time
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, strategies as st

from neurolens.base.errors import InputError
from neurolens.base.files import (
    Kept,
    atomic_path,
    atomic_write_text,
    check_writable,
    place_inside,
    read_arrays,
    read_kept,
    safe_name,
    write_arrays,
    write_kept,
)
from neurolens.base.progress import Progress
from neurolens.base.settings import (
    add_options,
    apply_overrides,
    between,
    changed,
    check_bounds,
    from_dict,
    from_options,
    read_config,
    setting,
    to_dict,
    to_toml,
)
from neurolens.base.tomlfile import format_toml, parse_toml
from neurolens.base.units import in_unit


def test_what_a_run_keeps_counts_only_while_it_is_whole(tmp_path: Path) -> None:
    kept, data = tmp_path / "folder" / "record.json", {"name": "a", "rms_um": 0.1, "notes": ["b", None, 1e-300]}
    assert read_kept(kept) is None
    write_kept(kept, data)
    assert read_kept(kept) == data
    text = kept.read_text()
    for damaged in (text[:-3], text.replace("0.1", "0.2"), text.replace("name", "nome"), "[1]", "[" * 100_000, "{}"):
        kept.write_text(damaged)
        assert read_kept(kept) is None
    kept.unlink()
    kept.symlink_to("/dev/zero")
    assert read_kept(kept) is None


def test_files_are_whole_or_as_before(tmp_path: Path) -> None:
    target = tmp_path / "film.exr"
    with atomic_path(target) as temporary:
        assert temporary.suffix == ".exr" and temporary.parent == tmp_path
        temporary.write_bytes(b"film")
        assert not target.exists()
    assert target.read_bytes() == b"film"
    for text in ("first", "zweite, größer: α"):
        atomic_write_text(target, text)
        assert target.read_text(encoding="utf-8") == text
    with pytest.raises(RuntimeError, match="stopped"), atomic_path(target) as temporary:
        temporary.write_bytes(b"half")
        raise RuntimeError("stopped")
    with pytest.raises(OSError, match="nothing was written"), atomic_path(tmp_path / "empty.png"):
        pass
    assert target.read_text(encoding="utf-8") == text and list(tmp_path.iterdir()) == [target]


def test_errors_name_the_target_not_the_temporary_file(tmp_path: Path) -> None:
    target = tmp_path / "gone" / "a.json"
    with pytest.raises(OSError) as error, atomic_path(target) as temporary:
        temporary.write_text("x")
    assert error.value.filename == str(target)
    with pytest.raises(OSError) as error:
        check_writable(target)
    assert error.value.filename == str(target)
    with pytest.raises(IsADirectoryError):
        check_writable(tmp_path)
    check_writable(tmp_path / "fine.exr")
    assert list(tmp_path.iterdir()) == []


def test_what_killed_runs_left_is_removed_after_a_day(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = (f".neurolens-{k:016x}.tmp{suffix}" for k, suffix in enumerate((".exr", "", ".so")))
    left, fresh, users = tmp_path / next(names), tmp_path / next(names), tmp_path / ".mine.tmp.so"
    for file in (left, fresh, users):
        file.touch()
    for file in (left, users):
        os.utime(file, (time.time() - 2 * 86400,) * 2)
    atomic_write_text(tmp_path / "a.txt", "a")
    assert sorted(tmp_path.iterdir()) == sorted([fresh, users, tmp_path / "a.txt"])
    os.utime(fresh, (time.time() - 2 * 86400,) * 2)
    atomic_write_text(tmp_path / "a.txt", "a")
    assert fresh.exists()  # looked for once an hour: thousands of files in a folder cost each as much as one
    monkeypatch.setattr("neurolens.base.files._cleaned", set())
    atomic_write_text(tmp_path / "a.txt", "a")
    assert not fresh.exists()


@dataclass(frozen=True)
class Fit:
    terms: int = 40
    method: Literal["ols", "omp"] = "ols"
    ridge: float = 0.0
    seed: int | None = None

    def __post_init__(self) -> None:
        if self.terms <= 0:
            raise InputError("settings", "terms", self.terms, "a positive integer")


@dataclass(frozen=True)
class Experiment:
    lens: Path
    focus_m: float = math.inf
    wavelength_nm: tuple[float, float] = (400.0, 700.0)
    f_numbers: tuple[float, ...] = ()
    names: tuple[str, ...] = ()
    dispersion: bool = True
    note: str = ""
    fit: Fit = Fit()
    extra_fits: tuple[Fit, ...] = ()
    limits: dict[str, float] = field(default_factory=dict)
    crop: float | str | None = "full"


FULL = """
lens = "lenses/a.toml"
focus_m = 2                # an integer where a number is wanted
wavelength_nm = [450, 650.5]
f_numbers = [1.8, 4]
names = ["a", "b"]
crop = "none"
extra_fits = [{ terms = 3 }, { method = "omp" }]
[fit]
terms = 20
seed = 1
[limits]
rms_um = 2
"""


def write(tmp_path: Path, text: str | bytes) -> Path:
    path = tmp_path / "experiment.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_reads_every_kind_of_field(tmp_path: Path) -> None:
    read = read_config(Experiment, write(tmp_path, FULL))
    assert read == Experiment(
        lens=Path("lenses/a.toml"), focus_m=2.0, wavelength_nm=(450.0, 650.5), f_numbers=(1.8, 4.0), names=("a", "b"),
        fit=Fit(terms=20, seed=1), extra_fits=(Fit(terms=3), Fit(method="omp")), limits={"rms_um": 2.0}, crop=None,
    )  # fmt: skip
    assert isinstance(read.focus_m, float) and isinstance(read.wavelength_nm[0], float)
    # What is left out takes its default; a byte order mark and Windows lines are read.
    marked = write(tmp_path, b"\xef\xbb\xbflens = 'x.toml'\r\nfocus_m = 3\r\n")
    assert read_config(Experiment, marked) == Experiment(lens=Path("x.toml"), focus_m=3.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("lens = 'a'\n[fit]\ntersm = 4", ["fit.tersm", "terms, method, ridge, seed", "did you mean 'terms'"]),
        ("lens = 'a'\nfocus = 4", ["focus:", "did you mean 'focus_m'"]),
        ("lens = 'a'\nzzz = 4", ["zzz", "known keys: lens"]),
        ("focus_m = 1", ["lens", "(missing)", "a path"]),
        ("lens = 3", ["lens", "got 3", "a path"]),
        ("lens = 'a'\nfocus_m = '2'", ["focus_m", "got '2'", "a number"]),
        ("lens = 'a'\nfocus_m = true", ["focus_m", "got True", "a number"]),
        ("lens = 'a'\nfocus_m = nan", ["focus_m", "got nan", "a number"]),
        ("lens = 'a'\nfocus_m = 1" + 400 * "0", ["focus_m", "a number"]),
        ("lens = 'a'\nfit.terms = 4.0", ["fit.terms", "an integer"]),
        ("lens = 'a'\nfit.terms = true", ["fit.terms", "an integer"]),
        ("lens = 'a'\nfit.terms = 0", ["fit.terms", "got 0", "a positive integer"]),
        ("lens = 'a'\nextra_fits = [{ terms = 1 }, { terms = -1 }]", ["extra_fits[1].terms", "got -1"]),
        ("lens = 'a'\nfit.method = 'sgd'", ["fit.method", "'sgd'", "one of: 'ols', 'omp'"]),
        ("lens = 'a'\nfit = 4", ["fit", "got 4", "a table with terms"]),
        ("lens = 'a'\nwavelength_nm = [400]", ["wavelength_nm", "a list of a number, a number"]),
        ("lens = 'a'\nwavelength_nm = 400", ["wavelength_nm", "a list"]),
        ("lens = 'a'\nf_numbers = [2, 'x']", ["f_numbers[1]", "'x'"]),
        ("lens = 'a'\nnames = 'x'", ["names", "a list"]),
        ("lens = 'a'\ndispersion = 1", ["dispersion", "true or false"]),
        ("lens = 'a'\nlimits = [1]", ["limits", "a table"]),
        ("lens = 'a'\ncrop = false", ["crop", "a number or a text"]),
        ("lens = 'a'\nnote = 1979-05-27", ["note", "a text"]),
        ("", ["no keys"]),
        ("# only a comment", ["no keys"]),
        ("lens = ", ["valid TOML", "Invalid value"]),
        ("lens = 'a'\nlens = 'b'", ["valid TOML"]),
        ("lens = " + 5000 * "1", ["valid TOML"]),
        ("lens = " + 5000 * "[", ["valid TOML"]),
        (b"lens = '\xff'", ["UTF-8"]),
        (1_000_001 * "#", ["1000000 bytes"]),
    ],
)
def test_a_mistake_is_one_error_that_names_file_and_field(tmp_path: Path, text: str | bytes, words: list[str]) -> None:
    path = write(tmp_path, text)
    with pytest.raises(InputError) as caught:
        read_config(Experiment, path)
    for word in [str(path), *words]:
        assert word in str(caught.value)
    for name, word in (("nothing.toml", "missing"), (".", "regular file")):
        with pytest.raises(InputError, match=word):
            read_config(Experiment, tmp_path / name)


def test_overrides_win_over_the_file(tmp_path: Path) -> None:
    path = write(tmp_path, FULL)
    given = ("fit.terms=7", "fit.method=omp", "focus_m = inf", "f_numbers=[2, 2.8]", "note=a=b", "limits.p99_um=1")
    read = read_config(Experiment, path, [*given, "names=[]"])
    assert (read.fit.terms, read.fit.method, read.fit.seed) == (7, "omp", 1)
    assert (read.focus_m, read.f_numbers, read.note, read.names) == (math.inf, (2.0, 2.8), "a=b", ())
    assert read.limits == {"rms_um": 2.0, "p99_um": 1.0}
    data: dict[str, Any] = {"fit": {"terms": 1}}
    assert apply_overrides(data, ["new.deep.key=word"]) == {**data, "new": {"deep": {"key": "word"}}}
    assert data == {"fit": {"terms": 1}}  # a copy


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("fit.terms", ["fit.terms", "key=value"]),
        ("=3", ["key=value"]),
        ("fit..terms=3", ["key=value"]),
        ("lens.x=3", ["lens is not a table"]),
        ("fit.terms=[1", ["fit.terms", "TOML value"]),
        ("fit.terms=", ["fit.terms", "TOML value"]),
        ("fit.terms=1\nlens='b'", ["fit.terms", "one TOML value"]),
        ("fit.terms=many", ["fit.terms", "'many'", "an integer"]),
        ("fit.tersm=1", ["fit.tersm", "did you mean 'terms'"]),
    ],
)
def test_a_bad_override_names_the_option(tmp_path: Path, override: str, words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        read_config(Experiment, write(tmp_path, FULL), [override])
    for word in ["--set", *words]:
        assert word in str(caught.value)
    # A mistake of the file stays the file's.
    with pytest.raises(InputError, match=r"experiment\.toml: focus_m"):
        read_config(Experiment, write(tmp_path, "lens = 'a'\nfocus_m = 'x'"), ["fit.terms=3"])


texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
numbers = st.floats(allow_nan=False)


@given(
    st.builds(
        Experiment,
        lens=st.just(Path("a b/é.toml")),
        focus_m=numbers,
        wavelength_nm=st.tuples(numbers, numbers),
        f_numbers=st.lists(numbers, max_size=3).map(tuple),
        names=st.lists(texts, max_size=3).map(tuple),
        dispersion=st.booleans(),
        note=texts,
        fit=st.builds(Fit, terms=st.integers(1, 10**20), seed=st.none() | st.integers(), ridge=numbers),
        extra_fits=st.lists(st.builds(Fit, ridge=numbers), max_size=2).map(tuple),
        limits=st.dictionaries(texts, numbers, max_size=3),
        crop=st.none() | numbers,
    )
)
def test_the_resolved_settings_read_back_bit_for_bit(settings: Experiment) -> None:
    assert from_dict(Experiment, tomllib.loads(to_toml(settings)), "memory") == settings
    assert from_dict(Experiment, to_dict(settings), "memory") == settings


@pytest.mark.parametrize("fraction", [-1.0, 0.0, 1.0, 7.0])
def test_any_fraction_is_taken_and_quiet_prints_nothing(fraction: float) -> None:
    for quiet in (False, True):
        stream = io.StringIO()
        progress = Progress({"a": 0, "b": 0}, quiet=quiet, stream=stream, interval_s=0)
        progress.note("hello")
        with progress.stage("a") as report:
            report(fraction)
        assert ("%" in stream.getvalue()) != quiet and bool(stream.getvalue()) != quiet


def test_names_of_files_are_safe_and_stay_apart() -> None:
    for text in ("a.zmx", "ols-64", "x+y_1"):
        assert safe_name(text) == text
    texts = [
        "../x", "/x", "x/", "x\\", "", ".", "..", ".hidden", "ä", "ö", "a\nb", "a" * 101, "a" * 102, "x\0", "\udc80",
    ]  # fmt: skip
    names = [safe_name(text) for text in texts]
    assert len(set(names)) == len(texts)
    assert all(re.fullmatch(r"(?!\.)[A-Za-z0-9._+-]{1,100}", name) for name in names)


def test_entries_of_archives_stay_inside(tmp_path: Path) -> None:
    assert place_inside(tmp_path, "a/b.c") == tmp_path / "a/b.c"
    for entry in ("../x", "/etc/x", "a/../../x", "", ".", "..\\x", "a\0"):
        with pytest.raises(ValueError):
            place_inside(tmp_path, entry)


KILLED = """
import os, signal, sys
from neurolens.base.files import TemporaryFolder
folder = TemporaryFolder()
print(folder.name, flush=True)
{end}
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no locks of files that end with a process")
def test_temporary_folders_of_killed_processes_go_with_the_next(tmp_path: Path) -> None:
    def process(end: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", KILLED.format(end=end)]
        env = os.environ | {"TMPDIR": str(tmp_path)}
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=env)

    def folder_of(started: subprocess.Popen[str]) -> Path:
        assert started.stdout is not None
        return Path(started.stdout.readline().strip())

    killed = process("os.kill(os.getpid(), signal.SIGKILL)")
    left = folder_of(killed)
    killed.communicate()
    assert left.is_dir() and left.parent == tmp_path and left.stat().st_mode & 0o077 == 0
    (tmp_path / "neurolens-of-others").mkdir()
    (tmp_path / "neurolens-linked").symlink_to(tmp_path / "neurolens-of-others")
    waiting = process("sys.stdin.read()")
    alive = folder_of(waiting)
    assert not left.exists()
    last = process("pass")
    last.communicate()
    assert alive.is_dir()  # another process's, which lives
    waiting.communicate()
    assert {path.name for path in tmp_path.iterdir()} == {"neurolens-of-others", "neurolens-linked"}


def test_torch_keeps_compiled_code_in_a_folder_of_this_user_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its own choice is a folder in the shared temporary one, whoever made it: planted code ran."""
    peers = pytest.importorskip("experiments.peers.rays")
    places = pytest.importorskip("torch._inductor.runtime.cache_dir_utils")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", "")
    monkeypatch.delenv("TORCHINDUCTOR_CACHE_DIR")
    peers.compile_tracing(lambda: None)
    folder = Path(places.cache_dir())
    assert folder == tmp_path / "neurolens" / "torch" and folder.stat().st_mode & 0o077 == 0
    folder.chmod(0o777)  # then anybody may have put code there
    monkeypatch.delenv("TORCHINDUCTOR_CACHE_DIR")
    peers.compile_tracing(lambda: None)
    assert not Path(places.cache_dir()).is_relative_to(tmp_path)


@dataclass(frozen=True)
class _Inner:
    share: float = setting(0.0, "of the light", within=(0, 1), metavar="SHARE")
    hidden: float = 0.25


@dataclass(frozen=True)
class _Options:
    cell_px: float = setting(8.0, "size of a cell", within=(1, 256), unit="pixels", old=("pixel-size",))
    count: int = setting(3, "rays", within=(1, 9), option="rays")
    name: str | None = setting(None, "of the lens")
    only: tuple[str, ...] = setting((), "a layer", metavar="LAYER")
    fast: bool = setting(False, "no check")
    kind: Literal["a", "b"] = setting("a", "of the fit")
    inner: _Inner = setting(_Inner(), "what is inside")

    def __post_init__(self) -> None:
        check_bounds(self, "blur")


def test_settings_are_options(capsys: pytest.CaptureFixture[str]) -> None:
    """One declaration gives options, help, and the bounds of values from the command line, TOML and Python."""
    parser = argparse.ArgumentParser()
    add_options(parser, _Options, kind="b")
    assert from_options(_Options, parser.parse_args([])) == _Options(kind="b")
    words = "--pixel-size 4 --rays 2 --name x --only p --only q --fast --kind a --share 0.5".split()
    found = from_options(_Options, parser.parse_args(words))
    assert found == _Options(4.0, 2, "x", ("p", "q"), True, "a", _Inner(0.5))
    assert from_dict(_Options, {"cell_px": 4, "inner": {"share": 0.5}}, "s.toml") == _Options(4.0, inner=_Inner(0.5))
    text = parser.format_help()
    assert "--cell PX" in text and "(default: 8)" in text and "(default: 0)" in text and "--hidden" not in text
    assert "pixel-size" not in text and "(default: b)" in text and "no check (" not in text
    refused = {
        "--cell nan": "--cell", "--cell 0.5": "pixels from 1 to 256", "--rays 2.5": "an integer from 1 to 9",
        "--share 2": "a number from 0 to 1", "--kind c": "choose from", "--hidden 1": "unrecognized",
    }  # fmt: skip
    for wrong, said in refused.items():
        with pytest.raises(SystemExit):
            parser.parse_args(wrong.split())
        assert said in capsys.readouterr().err
    with pytest.raises(InputError, match=r"s\.toml: cell_px: got 300.*pixels from 1 to 256"):
        from_dict(_Options, {"cell_px": 300}, "s.toml")
    with pytest.raises(InputError, match="an integer from 1 to 9"):
        _Options(count=0)
    group = argparse.ArgumentParser()
    add_options(group, _Options, ["count", "share"])
    assert vars(group.parse_args(["--rays", "9"])) == {"rays": 9, "share": 0.0}
    over = argparse.ArgumentParser()
    add_options(over, _Options, unset=True)
    assert set(vars(over.parse_args([])).values()) == {None}
    given = from_options(_Options, over.parse_args(["--share", "1", "--only", "q"]), unset=True)
    assert changed(given) == {"--share": 1.0, "--only": ("q",)} | dict.fromkeys(
        ["--cell", "--rays", "--fast", "--kind"]
    )
    assert "(default" not in over.format_help()


@pytest.mark.parametrize(
    ("unit", "typed", "value"),
    [
        ("m", "2m", "2"), ("m", "200cm", "2"), ("m", "6ft", "1.8288"), ("m", "6 FT", "1.8288"), ("m", "inf", "inf"),
        ("m", "1.5e3mm", "1.5"), ("m", "2", "2"), ("mm", "2in", "50.8"), ("mm", "-0.1mm", "-0.1"),
        ("deg", "30deg", "30"), ("nm", "0.55um,600nm,700", "550,600,700"), ("s", "2min", "120"),
        ("pixels", "3840px", "3840"), ("f", "f/2", "2"), ("f", "F2.8", "2.8"), ("f", "2.8", "2.8"),
        ("m", "2kg", "2kg"), ("m", "2deg", "2deg"), ("m", "1.2.3m", "1.2.3m"), ("m", "2M", "2"),
        ("m", "1e400m", "1e400m"), ("mm", "1e308m", "1e308m"), ("deg", "2m", "2m"), ("f", "2m", "2m"),
    ],
)  # fmt: skip
def test_numbers_take_the_units_of_their_dimension(unit: str, typed: str, value: str) -> None:
    """What is no quantity of the option's dimension is left for the option to refuse."""
    assert in_unit(unit, str)(typed) == value


@dataclass(frozen=True)
class _Focus:
    focus_m: float = 1.0
    size_mm: tuple[float, float] | None = None


def test_quantities_of_files_take_units_and_none_overflows() -> None:
    """Infinity is typed as "inf": digits beyond any float are a mistake."""
    assert from_dict(_Focus, {"focus_m": "6ft"}, "s.toml") == _Focus(1.8288)
    for wrong in ("2 kg", "6ft,3m", "1e400m", "far"):
        with pytest.raises(InputError, match=r"s\.toml: focus_m: got .*, expected a number"):
            from_dict(_Focus, {"focus_m": wrong}, "s.toml")
    focus = in_unit("m", between(0.01, math.inf, "m"))
    assert focus("inf") == math.inf and focus("1e300") == 1e300
    for wrong in ("1e400", "1e400m", "1" * 400):
        with pytest.raises(argparse.ArgumentTypeError, match="expected m from 0.01"):
            focus(wrong)
    assert parse_toml("a = [inf, -1e300]", "s.toml") == {"a": [math.inf, -1e300]}
    with pytest.raises(ValueError, match="-1e400 is too large"):
        parse_toml("a = -1e400", "s.toml")


def test_toml_refuses_names_that_it_could_not_read_again() -> None:
    for text in ("caf\udce9/lens.toml", "\ud800"):
        for data in ({"file": text}, {text: 1}, {"files": [text]}):
            with pytest.raises(InputError, match="rename the file or the folder"):
                format_toml(data)


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_time_left_follows_the_pace_of_the_stage_and_the_plan_of_the_rest() -> None:
    clock, stream = Clock(), io.StringIO()
    progress = Progress({"trace": 10, "fit": 60}, stream=stream, interval_s=5, clock=clock)
    with progress.stage("trace") as report:
        clock.now += 6
        report(0.25)
    assert stream.getvalue().splitlines()[0] == "trace:  25%, 6.0 s, 18 s left (in all 1 min 18 s left)"


def test_arrays_are_read_as_they_were_in_whatever_order_they_lay_in_memory(tmp_path: Path) -> None:
    array = np.arange(6.0).reshape(2, 3)
    write_arrays(tmp_path / "a", {}, {"c": array, "f": np.asfortranarray(array), "t": array.T})
    with read_arrays(tmp_path / "a") as (_, read):
        for name, expected in {"c": array, "f": array, "t": array.T}.items():
            assert np.array_equal(read(name), expected) and np.array_equal(read(name, mapped=True), expected)


def test_a_kept_state_with_an_integer_beyond_floats_is_none(tmp_path: Path) -> None:
    path = tmp_path / "kept"
    for spent, found in ((0, True), (10**400, False)):
        write_arrays(path, {"key": "k", "state": {"done": 1}, "spent_s": spent, "arrays": 1}, {"a0": np.zeros(3)})
        assert (Kept(path, "k", 0.0).load() is not None) == found
