"""The report: well-formed, complete, offline, and safe against hostile names; missing figures stay missing."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest

from neurolens.base.errors import InputError
from neurolens.evaluate.report import DASH, local_url, write_report

HOSTILE = "<script>alert('x')</script>\"&'"
VOID = {"meta", "img", "br", "hr", "link", "input"}


class Page(HTMLParser):
    """Checks that tags nest, and collects text, pictures and links."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.sources: list[str] = []
        self.links: list[str] = []
        self.text = ""
        self.cells: list[str] = []
        self.feed(source)
        self.close()
        assert not self.open, f"never closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        values = dict(attrs)
        assert not any(name.startswith("on") for name in values), values
        if tag not in VOID:
            self.open.append(tag)
        if tag == "img":
            self.sources.append(values["src"] or "")
            assert "alt" in values
        if tag == "a":
            self.links.append(values["href"] or "")
        if tag == "td":
            self.cells.append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-1:]}"
        self.open.pop()

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.text += data
        if self.open and self.open[-1] == "td":
            self.cells[-1] += data


def full_results(name: str = "Tessar 50 mm") -> dict[str, Any]:
    model = {
        "name": name, "family": "ols", "variables": "invariants", "rms_um": 1.84, "p99_um": 6.1, "max_um": 31.0,
        "direction_rms_deg": 0.00042, "position_rms_um": 3.3, "transmittance_rms": 0.0002, "false_pass": 0.0011,
        "false_block": 0.0013, "coefficients_per_vector": 40, "bytes": 18400, "fit_s": 7.2, "load_s": 0.1,
        "ns_per_ray": {"min": 13.1, "median": 14.0, "threads": 1}, "speedup_over_compiled": 3.66,
        "break_even_rays": 2.1e8, "note": name,
    }  # fmt: skip
    return {
        "title": name,
        "command": "neurolens train experiments/quickstart.toml",
        "lens": {"name": name, "efl_mm": 49.64, "f_number": 1.8, "sha256": "ab12"},
        "domain": {"film_radius_mm": 21.6, "wavelength_nm": [400, 700]},
        "settings": {"fit": {"terms": 40, name: name}},
        "models": [model, {"name": "only a name"}],
        "exact": [
            {"name": "exact, eager", "available": True, "ns_per_ray": {"min": 160.0, "median": 171.0, "threads": 1}},
            {"name": "exact, compiled", "available": False, "reason": "no C++ compiler " + name},
        ],
        "cameras": [{"name": name, "scene": "room", "render_s": 12.5, "camera_s": 3.0, "camera_share": 0.24}],
        "images": [
            {
                "scene": "room",
                "camera": name,
                "file_png": "room.png",
                "file_exr": "room & co.exr",
                "flip": 0.081,
                "rel_mse": 0.0123,
                "noise_floor_flip": 0.08,
                "flip_ratio": 1.0125,
                "pairs": 4,
                "caption": name,
            }  # fmt: skip
        ],
        "image_settings": {"exposure": 1.0, "pixels_per_degree": 67.0},
        "domain_gain": {"scene": "room", "text": name, "rows": [{"domain": "scene", "name": "ols 40", "rms_um": 0.61}]},
        "figures": [{"file": "pareto.png", "title": name, "caption": name, "wide": True}],
        "versions": {"torch": "2.13.0", name: name},
        "seed": 7,
        "started": "2026-11-21T10:00:00",
        "wall_s": 183.2,
        "warnings": [name],
    }


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    for name in ("pareto.png", "room.png", "room & co.exr"):
        (tmp_path / name).write_bytes(b"any")
    return tmp_path


def read(path: Path) -> Page:
    return Page(path.read_text(encoding="utf-8"))


def test_every_picture_and_link_exists_and_nothing_needs_the_network(run_dir: Path) -> None:
    path = write_report(run_dir, full_results())
    page = read(path)
    assert {unquote(s) for s in page.sources} == {"./pareto.png", "./room.png"}
    assert "./room%20%26%20co.exr" in page.links
    for target in (*page.sources, *page.links):
        assert (run_dir / unquote(target)).is_file(), target
    assert "script" not in page.tags and "link" not in page.tags
    assert "http" not in path.read_text(encoding="utf-8")


def test_hostile_names_are_only_text(run_dir: Path) -> None:
    path = write_report(run_dir, full_results(HOSTILE))
    page = read(path)
    assert "script" not in page.tags
    assert HOSTILE in page.text  # shown as written, so nothing was swallowed either
    assert "<script" not in path.read_text(encoding="utf-8")


@pytest.mark.parametrize("file", ["../secret.png", "/etc/hostname", "javascript:alert(1)", "absent.png", "", "."])
def test_a_picture_outside_the_run_folder_is_not_shown(file: str, run_dir: Path) -> None:
    (run_dir.parent / "secret.png").write_bytes(b"any")
    results = {
        "figures": [{"file": file, "title": "a"}],
        "images": [{"camera": "c", "file_png": "room.png", "file_exr": file}],
    }
    page = read(write_report(run_dir, results))
    assert page.sources == ["./room.png"] and set(page.links) == {"./room.png"}
    assert "Picture missing" in page.text
    (run_dir.parent / "secret.png").unlink()


def test_what_was_not_measured_is_a_dash(run_dir: Path) -> None:
    results = {
        "models": [{"name": "a", "rms_um": 1.5, "fit_s": None, "max_um": float("nan")}, {"name": "b", "max_um": 9.0}]
    }
    page = read(write_report(run_dir, results))
    assert page.cells == ["1.5", DASH, DASH, "9"]  # columns: RMS, max; no record holds the others


def test_an_empty_run_still_makes_a_page(run_dir: Path) -> None:
    page = read(write_report(run_dir, {}))
    assert "neurolens run" in page.text and not page.sources and not page.cells
    assert not list(run_dir.glob(".*"))


def test_the_headline_leaves_out_fast_models_that_are_far_off(run_dir: Path) -> None:
    """A thin lens is fast and wrong: the best speed-up shown is that of a model within 2 um."""
    models = [
        {"name": "thin", "rms_um": 300.0, "speedup_over_compiled": 25.0, "ns_per_ray": {"min": 2.0}},
        {"name": "ols", "rms_um": 1.8, "speedup_over_compiled": 3.7, "ns_per_ray": {"min": 13.0}},
    ]
    images = [
        {"camera": c, "scene": s, "flip_ratio": r}
        for c, s, r in (("exact", "a", 1), ("ols", "a", 0.99), ("ols", "b", 1.04), ("t", "a", 3))
    ]
    page = read(write_report(run_dir, {"models": models, "images": images}))
    headline = page.text[page.text.index("Headline") : page.text.index("Models, on rays")]
    assert "3.7" in headline and "25" not in headline and "1.04" in headline and "0.99" not in headline


def test_bad_input_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="run folder"):
        write_report(tmp_path / "absent", {})
    with pytest.raises(InputError, match="modles"):
        write_report(tmp_path, {"modles": []})


def test_a_name_with_a_colon_is_a_file_not_a_scheme(tmp_path: Path) -> None:
    (tmp_path / "javascript:x").write_bytes(b"any")
    assert local_url(tmp_path, "javascript:x") == "./javascript%3Ax"
