"""The script for a GPU, in software: every program compiles, its rays are those of float64, every table full."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

from experiments.__main__ import main
from experiments.speed import gpu_day

RESULTS = Path(__file__).parents[2] / "experiments" / "results"


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("g++"), reason="no C++ compiler")
def test_it_runs_without_a_gpu(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gpu_day, "MODELS", {"thorlabs_lb1471_biconvex_50": ("ols-64",)})  # the others take a minute
    assert not main(["gpu-day", "--only", "thorlabs", "--rays", "4096", "--seconds", "0", "-o", str(tmp_path)])
    page, found = capsys.readouterr().out, json.loads((tmp_path / "gpu_day.json").read_text(encoding="utf-8"))
    assert "In software, without a GPU" in page and "failed" not in found and (tmp_path / "gpu_day.png").exists()
    forms = ["exact", *gpu_day.MODELS["thorlabs_lb1471_biconvex_50"]]
    lenses, cameras = ([r for r in found["rows"] if r["kind"] == kind] for kind in (gpu_day.LENS, gpu_day.CAMERA))
    assert [r["form"] for r in lenses] == [r["form"] for r in cameras] == forms
    assert [r["form"] for r in found["gradients"]] == forms
    assert lenses[0]["rms_um"] < 0.05 and lenses[0]["wrong"] < 1e-3  # um on the film: float32
    for row in cameras:
        assert row["direction_urad"] < 10 and row["weight"] < 1e-3 and row["wrong"] < 1e-3
        assert set(row["frames"]) == set(gpu_day.FRAMES)
    assert all(r["off"] < 0.01 for r in found["gradients"])
    assert [set(r["seconds"]) for r in found["torch"]] == [{"eager", "tracer"}, {"eager"}]
    assert "exact as CUDA C++" in [r["program"] for r in found["peers"] if r.get("seconds")]


def test_the_page_of_the_gpu_that_is_kept_is_of_its_rows() -> None:
    """No figure was written by hand."""
    found = json.loads((RESULTS / "gpu_day.json").read_text(encoding="utf-8"))
    page = gpu_day.page_of(found)
    assert page == (RESULTS / "gpu_day.md").read_text(encoding="utf-8")
    assert not found["software"] and re.search(r"exact double Gauss.*reached", page)
