"""The models that ship: an index that is whole at any time, entries made once, failures that are said."""

import json
from pathlib import Path
from typing import Any

import pytest
from lens_models import LENSES

from experiments.data import make_models
from experiments.data.make_models import Entry, Library, fingerprint, read_list
from experiments.speed.promises import read_index
from neurolens.base.errors import InputError
from neurolens.base.files import sha256_of
from neurolens.base.progress import Progress
from neurolens.optics.lens.prescription import Lens

QUIET = Progress(quiet=True)


@pytest.fixture
def library(tmp_path: Path) -> Library:
    """Three lenses of a folder, one of them named with a model of its own."""
    (tmp_path / "lenses").mkdir()
    for name in ("one", "three", "two"):
        text = (LENSES / "cooke_triplet_50.toml").read_text()
        (tmp_path / "lenses" / f"{name}.toml").write_text(text)
    (tmp_path / "list.toml").write_text(
        '[lenses]\nfolder = "lenses"\nmodels = [{ terms = 6 }]\n'
        '[[entry]]\nlens = { file = "lenses/two.toml" }\nmodels = [{ terms = 4 }, { terms = 5 }]\n'
    )
    return read_list(tmp_path / "list.toml")


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """`made["order"]`: entries in the order in which they were made; `made["broken"]`: what those named do instead."""
    told: dict[str, Any] = {"order": [], "broken": {}}

    def make_entry(entry: Entry, library: Library, out: Path, *_: object) -> list[dict[str, Any]]:
        if entry.state in told["broken"]:
            raise told["broken"][entry.state]
        told["order"].append(entry.state)
        rows = []
        for settings in entry.models:
            (out / entry.file(settings)).write_bytes(b"a model")
            rows.append(row(entry.file(settings), entry.state, fingerprint(entry, library.pairs)))
            rows[-1]["sha256"] = sha256_of(out / entry.file(settings))
        return rows

    monkeypatch.setattr(make_models, "make_entry", make_entry)
    return told


def row(file: str, entry: str, mark: str = "", rms_um: float = 2.0) -> dict[str, Any]:
    figures = dict.fromkeys((*make_models._KEPT, "position_rms_um_at_21_6"), 1.0)
    timed = {"ns_per_ray": {"min": 20.0}, "speedup_as_c": 2.0}
    return {
        "file": file,
        "entry": entry,
        "fingerprint": mark,
        "lens_file": "a",
        "model": "a",
        **figures,
        **timed,
        "rms_um": rms_um,
    }


def files(folder: Path) -> list[str]:
    return [r["file"] for r in read_index(folder)]


def test_an_interrupted_run_goes_on_where_it_stopped(tmp_path: Path, library: Library, made: dict[str, Any]) -> None:
    make_models.write_index([row("one.old.onnx", "one", rms_um=9.0), row("gone.x.onnx", "gone")], {}, tmp_path)
    for name in ("one.old.onnx", "gone.x.onnx"):
        (tmp_path / name).write_bytes(b"")
    made["broken"]["one"] = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        make_models.make_models(library, library.entry, tmp_path, QUIET)
    assert files(tmp_path) == ["two.ols-4.onnx", "two.ols-5.onnx", "one.old.onnx", "gone.x.onnx"]
    made["broken"].clear()
    assert make_models.make_models(library, library.entry, tmp_path, QUIET) == []
    assert made["order"] == ["two", "one", "three"]  # two was not made again
    assert files(tmp_path) == ["two.ols-4.onnx", "two.ols-5.onnx", "one.ols-6.onnx", "three.ols-6.onnx"]
    assert {f.name for f in tmp_path.glob("*.onnx")} == set(files(tmp_path))  # no file without a row
    assert "gone" not in (tmp_path / "README.md").read_text()


def test_a_lens_that_cannot_be_done_is_said_and_the_others_go_on(
    tmp_path: Path, library: Library, made: dict[str, Any]
) -> None:
    made["broken"]["one"] = InputError("one.toml", "domain", 0, "a domain")
    failed = make_models.make_models(library, library.entry, tmp_path, QUIET)
    assert len(failed) == 1 and failed[0].startswith("one: left out: one.toml: domain")
    assert "- one: one.toml: domain" in (tmp_path / "README.md").read_text() and len(files(tmp_path)) == 3
    made["broken"].clear()
    assert make_models.make_models(library, library.entry, tmp_path, QUIET) == []
    assert json.loads((tmp_path / "index.json").read_text())["left_out"] == {}


def test_models_are_fitted_again_where_coatings_or_glass_are_others(
    tmp_path: Path, library: Library, made: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    make_models.make_models(library, library.entry, tmp_path, QUIET)
    done = []

    def refit_transmittance(file: Path, lens: Lens) -> dict[str, Any]:
        if file.stem in made["broken"]:
            raise InputError(lens.path, "surfaces", "(another)", "its own")
        done.append(file.stem)
        file.write_bytes(b"another model")
        return {"transmittance_rms": 0.5, "parameters": 7}

    def run() -> list[str]:
        done.clear()
        return make_models.refit(library.entry, library, tmp_path, QUIET, again=False)

    monkeypatch.setattr(make_models, "refit_transmittance", refit_transmittance)
    made["broken"]["one.ols-6"] = True
    assert [line[:32] for line in run()] == ["one.ols-6.onnx: to be made again"]
    made["broken"].clear()
    assert run() == [] and done == ["one.ols-6"]
    rows = {r["file"]: r for r in read_index(tmp_path)}
    assert rows["two.ols-4.onnx"]["sha256"] == sha256_of(tmp_path / "two.ols-4.onnx")
    assert {r["transmittance_rms"] for r in rows.values()} == {0.5} and rows["two.ols-4.onnx"]["rms_um"] == 2.0
    for line in ('coating = "single-layer"', "absorption_per_mm = 0.001"):
        file = tmp_path / "lenses" / "two.toml"
        text = file.read_text()
        file.write_text(text.replace("n_d = 1.62041", f"{line}, n_d = 1.62041", 1))
        assert file.read_text() != text and run() == [] and done == ["two.ols-4", "two.ols-5"]
