"""Files are whole or not there."""

from pathlib import Path

import pytest

from neurolens.base.files import atomic_path, atomic_write_text


def test_writes_and_replaces(tmp_path: Path) -> None:
    target = tmp_path / "results.json"
    for text in ("first", "zweite, größer: α"):
        atomic_write_text(target, text)
        assert target.read_text(encoding="utf-8") == text
    assert list(tmp_path.iterdir()) == [target]


def test_a_failure_leaves_the_old_file_and_no_other(tmp_path: Path) -> None:
    target = tmp_path / "model.onnx"
    target.write_bytes(b"old")
    with pytest.raises(RuntimeError, match="stopped"), atomic_path(target) as temporary:
        temporary.write_bytes(b"half")
        raise RuntimeError("stopped")
    assert target.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [target]


def test_nothing_is_at_the_name_before_the_end(tmp_path: Path) -> None:
    target = tmp_path / "film.exr"
    with atomic_path(target) as temporary:
        assert temporary.suffix == ".exr" and temporary.parent == tmp_path
        temporary.write_bytes(b"film")
        assert not target.exists()
    assert target.read_bytes() == b"film"


def test_a_writer_that_wrote_nothing_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), atomic_path(tmp_path / "empty.png"):
        pass
    assert list(tmp_path.iterdir()) == []
