"""Compiled libraries: kept for the next time, never taken from a folder that others can write to."""

import functools
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import pytest

from neurolens.base import files
from neurolens.base.errors import InputError
from neurolens.graph import compiler

SOURCE = "int answer(void) { return 42; }\n"


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    try:
        compiler.find_compiler()
    except InputError as reason:
        pytest.skip(f"nothing is compiled here: {reason}")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def test_compiled_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert compiler.load_compiled(SOURCE).answer() == 42
    (library,) = (tmp_path / "neurolens").glob("*.so")
    assert (tmp_path / "neurolens").stat().st_mode & 0o077 == 0 and library.stat().st_mode & 0o077 == 0
    monkeypatch.setattr(compiler, "compile_c", None)  # not called again
    assert compiler.load_compiled(SOURCE).answer() == 42


def test_what_was_compiled_is_said_once_with_the_time_of_all(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    compiler.compiled_so_far()
    times = iter([1.0, 2.5, 10.0, 12.5])
    monkeypatch.setattr(compiler.time, "monotonic", lambda: next(times, 12.5))
    for source in (SOURCE, SOURCE.replace("42", "43"), SOURCE):
        compiler.load_compiled(source)
    said = compiler.compiled_so_far()
    assert said == f"compiled 2 programs in 4.0 s, kept for the next time in {tmp_path / 'neurolens'}"
    assert compiler.compiled_so_far() == ""


def test_other_sources_flags_and_compilers_make_other_libraries(monkeypatch: pytest.MonkeyPatch) -> None:
    compiler.load_compiled(SOURCE)
    assert compiler.load_compiled(SOURCE.replace("42", "43")).answer() == 43
    first = compiler._key(SOURCE)
    monkeypatch.setattr(compiler, "FLAGS", ("-std=c99", "-O1"))
    assert compiler._key(SOURCE) != first


def test_a_folder_open_to_others_is_not_used(tmp_path: Path) -> None:
    folder = tmp_path / "neurolens"
    folder.mkdir()
    folder.chmod(0o777)
    assert compiler.load_compiled(SOURCE).answer() == 42
    assert not list(folder.iterdir())


def test_libraries_that_are_damaged_or_of_others_are_made_anew(tmp_path: Path) -> None:
    compiler.load_compiled(SOURCE)
    (library,) = (tmp_path / "neurolens").glob("*.so")
    kept, good = tmp_path / "kept.so", library.read_bytes()
    library.unlink()  # in use: a new file, not new bytes
    library.write_bytes(good[:100])
    assert compiler.load_compiled(SOURCE).answer() == 42
    kept.write_bytes(good)
    library.unlink()
    library.symlink_to(kept)
    assert compiler.load_compiled(SOURCE).answer() == 42 and not library.is_symlink()
    library.unlink()
    library.write_bytes(good[:-1000] + bytes(1000))  # would load, and crash
    assert compiler.load_compiled(SOURCE).answer() == 42 and library.read_bytes() == good


@pytest.mark.parametrize("text", ["not a program", "#!/bin/sh\nexit 0\n", "#!/bin/sh\nprintf '\\377' >&2\nexit 1\n"])
def test_what_is_no_compiler(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, text: str) -> None:
    odd = tmp_path / "odd"
    odd.write_text(text)
    odd.chmod(0o700)
    monkeypatch.setenv("CC", str(odd))
    with pytest.raises(InputError, match="a C compiler"):
        compiler.load_compiled(SOURCE)
    assert not list((tmp_path / "neurolens").iterdir())


def test_a_compiler_without_end_is_ended_with_its_children(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Compilers are drivers: what works is a child of theirs, which holds the pipes, too."""
    endless, told = tmp_path / "endless", tmp_path / "child"
    endless.write_text(f"#!/bin/sh\nsleep 600 & echo $! > {told}\nwait\n")
    endless.chmod(0o700)
    monkeypatch.setenv("CC", str(endless))
    monkeypatch.setattr(compiler, "_SECONDS", 2)
    with pytest.raises(InputError, match="no end after 2 s"):
        compiler.compile_c(SOURCE, tmp_path / "a.so")
    ended, child = time.monotonic() + 30, Path(f"/proc/{told.read_text().strip()}/stat")
    while child.exists() and child.read_text().split()[2] != "Z":
        assert time.monotonic() < ended
        time.sleep(0.01)


def test_a_full_disk_is_no_missing_compiler(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    odd = tmp_path / "odd"
    odd.write_text("#!/bin/sh\necho 'ld: final link failed: No space left on device' >&2\nexit 1\n")
    odd.chmod(0o700)
    monkeypatch.setenv("CC", str(odd))
    with pytest.raises(OSError, match="No space left") as error:
        compiler.load_compiled(SOURCE)
    assert str(tmp_path / "neurolens") in error.value.filename


@pytest.mark.parametrize("full", ["cache", "temporary", "both"])
def test_a_full_disk_is_left_for_another_or_named(full: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The compiler writes where there is room: its own temporary files, too."""
    temporary, cache = tmp_path / "temporary", compiler.cache_folder()
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    monkeypatch.setattr(files, "folder_of_process", functools.cache(files.TemporaryFolder))
    monkeypatch.setattr(compiler, "folder_of_process", files.folder_of_process)
    seen = tmp_path / "seen"
    odd = tmp_path / "odd"
    odd.write_text(f'#!/bin/sh\necho "$TMPDIR" >> {seen}\nexec {compiler.find_compiler()} "$@"\n')
    odd.chmod(0o700)
    monkeypatch.setenv("CC", str(odd))
    usage = shutil.disk_usage

    def disk_usage(path: Path) -> Any:
        of_cache = Path(path).is_relative_to(cache)
        return usage(path)._replace(free=0) if full in ("both", "cache" if of_cache else "temporary") else usage(path)

    monkeypatch.setattr(shutil, "disk_usage", disk_usage)
    if full != "both":
        assert compiler.load_compiled(SOURCE)
        assert str(temporary if full == "cache" else cache) == seen.read_text().splitlines()[-1]
        assert bool(list(cache.glob("*.so"))) == (full == "temporary")
        return
    odd.write_text("#!/bin/sh\nexit 1\n")
    with pytest.raises(OSError, match="No space left") as error:
        compiler.load_compiled(SOURCE)
    assert str(cache) in error.value.filename and str(temporary) in error.value.filename


def test_no_compiler_and_one_that_fails(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="error"):
        compiler.load_compiled("this is no C\n")
    assert not list((tmp_path / "neurolens").iterdir())
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("CC", "")
    with pytest.raises(InputError, match="a C compiler"):
        compiler.load_compiled(SOURCE)
