"""Results of a run with every field that the report shows, in each of which a text may stand; a reader of pages."""

from html.parser import HTMLParser
from typing import Any

_VOID = {"meta", "img", "br", "hr", "link", "input"}


class Page(HTMLParser):
    """Checks that tags nest, and collects tags, text, pictures, links and rows of tables."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self.open, self.tags, self.sources, self.links = list[str](), list[str](), list[str](), list[str]()
        self.rows, self.text = list[dict[str, str | None]](), ""
        self.feed(source)
        self.close()
        assert not self.open, f"never closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        assert not any(name.startswith("on") for name in values), values
        self.tags.append(tag)
        self.open += [tag] * (tag not in _VOID)
        if tag == "img":
            self.sources.append(values["src"] or "")
            assert "alt" in values
        self.links += [str(values["href"])] if tag == "a" else []
        self.rows += [values] * (tag == "tr" and "tbody" in self.open)

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-1:]}"
        self.open.pop()

    def handle_data(self, data: str) -> None:
        if not {"style", "script"} & {*self.open}:
            self.text += data


def full_results(name: str = "Tessar 50 mm") -> dict[str, Any]:
    model = {
        "name": name, "family": "ols", "variables": "invariants", "rms_um": 1.84, "p99_um": 6.1, "max_um": 31.0,
        "direction_rms_deg": 0.00042, "position_rms_um": 3.3, "transmittance_rms": 0.0002, "false_pass": 0.0011,
        "false_block": 0.0013, "coefficients_per_vector": 40, "bytes": 18400, "fit_s": 7.2, "load_s": 0.1,
        "ns_per_ray": {"min": 13.1, "median": 14.0, "threads": 1}, "speedup": 3.66,
        "fused_ns_per_ray": {"min": 3.25}, "file": f"models/{name}.onnx", "break_even_rays": 2.1e8, "note": name,
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
        "images": [{
            "scene": "room", "camera": name, "file_png": "room.png", "file_exr": "room & co.exr", "flip": 0.081,
            "rel_mse": 0.0123, "noise_floor_flip": 0.08, "flip_paired": 0.004,
            "paired_share": 0.05, "pairs": 4, "caption": name,
        }],
        "image_settings": {"exposure": 1.0, "pixels_per_degree": 67.0},
        "figures": [{"file": "pareto.png", "title": name, "caption": name, "wide": True}],
        "versions": {"torch": "2.13.0", name: name},
        "seed": 7,
        "started": "2026-11-21T10:00:00",
        "wall_s": 183.2,
        "warnings": [name],
    }  # fmt: skip
