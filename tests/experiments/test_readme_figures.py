"""Figures of the README against the committed results that its commands write: each figure of the table, in order."""

import json
import re
import statistics
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from experiments.make_models import errors_by_kind
from experiments.surrogates import lens_page, summary_page
from neurolens.study.pages import recommended

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
NUMBER = r"(?<![\w.])\d[\d,]*(?:\.\d+)?"


@cache
def results(name: str) -> Any:
    return json.loads((ROOT / "experiments" / "results" / f"{name}.json").read_text(encoding="utf-8"))


def cells(start: str) -> list[str]:
    """Cells of the row of the README's table whose first cell starts so, up to its command."""
    (row,) = (line for line in README.splitlines() if line.startswith(f"| {start}"))
    return [cell.strip() for cell in row.strip("|").split("|")][:5]


def assert_printed(text: str, expected: Sequence[float]) -> None:
    """Every number of a text is the expected one, rounded to the digits that are printed."""
    printed = re.findall(NUMBER, text)
    assert len(printed) == len(expected), (text, expected)
    for number, value in zip(printed, expected, strict=True):
        digits = len(number.partition(".")[2])
        assert float(number.replace(",", "")) == pytest.approx(value, abs=0.5001 * 10.0**-digits), (
            f"{text}: {number}, not {value:.4g}"
        )


def exact_as_c(refractions: int) -> Any:
    rows = results("fused_speed")["rows"]
    (row,) = (r for r in rows if (r["refractions"], r["name"], r["work"]) == (refractions, "exact C", "whole"))
    return row


def fastest(refractions: int) -> Any:
    """The fastest model within 1 um."""
    rows = [r for r in results("fused_speed")["rows"] if r["refractions"] == refractions and r["work"] == "whole"]
    tried = [r for r in rows if re.fullmatch(r"(ols|mlp)-\w+, C", r["name"])]
    return min((r for r in tried if r["rms_um"] <= 1), key=lambda r: r["ns"]["min"])


def gain(refractions: int) -> float:
    return float(exact_as_c(refractions)["ns"]["min"] / fastest(refractions)["ns"]["min"])


@pytest.mark.parametrize("refractions", [2, 12, 33])
def test_speed_as_c(refractions: int) -> None:
    _, exact, model, times, error = cells(f"C, {refractions} refractions")
    best = fastest(refractions)
    assert_printed(exact, [exact_as_c(refractions)["ns"]["min"]])
    assert_printed(model, [best["ns"]["min"]])
    assert_printed(times, [gain(refractions), *([7, gain(7)] if refractions == 12 else [])])
    assert_printed(error, [best["rms_um"]])
    use = recommended([best], lambda r: r["ns"]["min"], exact_as_c(refractions))
    assert (use is best) == ("trace exactly" not in times)


def on_the_gpu(refractions: int, form: str, way: str) -> float:
    """Nanoseconds a ray in the language that is fastest there."""
    found = results("gpu_day")
    lens = next(r["lens"] for r in found["rows"] if r["refractions"] == refractions)
    kinds = (r for r in found["rows"] if r["lens"] == lens and r["kind"] == "lens" and r["form"].split(",")[0] == form)
    shaders = (r["ns"][way][0] for r in found["shaders"] if r["lens"] == lens and r["form"] == form)
    return min(*(1e9 * min(r["seconds"][way]) for r in kinds), *shaders)


@pytest.mark.parametrize(("start", "way"), [("an H200", "in place"), ("the same, rays read", "stored")])
def test_speed_on_a_gpu(start: str, way: str) -> None:
    keys = [(12, "ols-36"), (33, "ols-64")]
    _, exact, model, times, error = cells(start)
    assert_printed(exact, [on_the_gpu(k, "exact", way) for k, _ in keys])
    assert_printed(model, [on_the_gpu(*key, way) for key in keys])

    def gain(refractions: int, form: str) -> float:
        return on_the_gpu(refractions, "exact", way) / on_the_gpu(refractions, form, way)

    more = [2, gain(2, "ols-64"), 56, gain(56, "ols-64")] if way == "stored" else []
    assert_printed(times, [*(gain(*key) for key in keys), *more])
    errors = {(r["refractions"], r["form"]): r.get("rms_um") for r in results("gpu_day")["rows"] if r["kind"] == "lens"}
    assert_printed(error, [errors[key] for key in keys])


def test_frames_on_a_gpu() -> None:
    rows = [r for r in results("gpu_day")["rows"] if r["kind"] == "whole camera"]

    def ms(refractions: int, form: str) -> float:
        some = (r for r in rows if r["refractions"] == refractions and r["form"].split(",")[0] == form)
        return min(min(r["frames"]["4K, 16 samples"]["in place"]) for r in some)

    _, exact, model, times, _ = cells("whole cameras there")
    assert_printed(exact, [ms(12, "exact"), ms(33, "exact")])
    assert_printed(model, [ms(12, "ols-36"), ms(33, "ols-64")])
    assert_printed(times, [ms(12, "exact") / ms(12, "ols-36"), ms(33, "exact") / ms(33, "ols-64")])


def test_cost_in_our_renderer() -> None:
    page = (ROOT / "experiments" / "results" / "render_times" / "README.md").read_text(encoding="utf-8")

    def goal(text: str) -> float:
        (line,) = (line for line in page.splitlines() if line.startswith(f"| {text}"))
        return float(line.split("|")[3].strip().rstrip("%"))

    _, exact, models, _, _ = cells("a picture of our renderer")
    assert_printed(exact, [goal("exact, C: overhead a refraction")])
    camera = "{}, C: camera above the thin lens's, of the {} pinhole"
    assert_printed(models, [goal(camera.format(m, s)) for m in ("polynomial", "network") for s in ("cheap", "dear")])


def test_cost_in_cycles_is_that_of_the_same_lens() -> None:
    rows = {r["camera"]: r for r in results("osl_speed")["rows"] if r["scene"] == "sky"}
    both = (
        ("Cycles by OSL, 12", "exact, 12 refractions", ("ols-36", "mlp-10x1")),
        ("the same, 33", "exact, 33 refractions", ("ols-64 of 33 refractions",)),
    )
    for start, lens, models in both:
        _, exact, model, times, error = cells(start)
        assert_printed(exact, [rows[lens]["over"]])
        assert_printed(model, [rows[m]["over"] for m in models])
        assert_printed(times, [rows[lens]["ns_min"] / rows[m]["ns_min"] for m in models])
        assert_printed(error, [rows[m]["error_um"] for m in models])


def test_errors_of_zooms_and_of_inverse_maps() -> None:
    zooms = [c for c in results("zoom")["cases"] if [a["name"] for a in c["axes"]] == ["zoom"]]
    assert len(zooms) == 5
    assert_printed(cells("a whole zoom")[4], [25, *(c["rms_um"] for c in zooms)])
    lenses = results("inverse")["lenses"]
    solved = [min(r["ours"]["float64"][k]["converged"] for k in ("stop", "scene")) for r in lenses]
    assert_printed(cells("scene point to film")[3], [99.99, sum(s >= 0.9999 for s in solved), 100 * min(solved)])
    assert cells("scene point to film")[0].endswith(f"; {len(lenses)} lenses")


def test_errors_of_the_networks_that_ship() -> None:
    rows = json.loads((ROOT / "models" / "index.json").read_text(encoding="utf-8"))["models"]
    kinds = errors_by_kind(rows, "mlp-16x2")
    round_, anamorphic, single, named = kinds.values()
    text = README.partition("the shipped 16x2 networks")[2].partition("poor as their cards")[0]
    said = re.sub(r"\s+", " ", text).replace("f/2", "")
    expected = [statistics.median(round_), len(round_), min(round_), max(round_), min(anamorphic), max(anamorphic)]
    assert_printed(said, [*expected, *sorted(single)])
    polynomials = errors_by_kind(rows, "ols-64")["lenses by name"]
    text = README.partition("Polynomials of the lenses by name")[2].partition(" [Every")[0]
    both = [[statistics.median(some), len(some), min(some), max(some)] for some in (polynomials, named)]
    assert_printed(text, both[0] + both[1])


def test_speed_up_on_dask() -> None:
    rows = [r for r in results("dask")["rows"] if r["part"] == "speed-up"]
    seconds = {(r["what"].partition(",")[0], r["how"]): r["seconds"] for r in rows}
    text = README.partition("`python -m experiments dask`")[2].partition("\n")[0]
    times = [seconds[what, "plain"] / seconds[what, "2 workers"] for what in ("survey", "render")]
    assert_printed(text, [times[0], 8, times[1]])


def test_light_of_averaged_polarisation() -> None:
    worst = [r["bare"]["relative"] for r in results("transmittance")["lenses"]]
    text = README.partition("averaging it at every surface")[2].partition("(`python")[0]
    assert_printed(text, [100 * max(worst), len(worst), 100 * statistics.median(worst)])


LIMITS = {"neurolens2017-128x3": "not converged", **dict.fromkeys(("ray-lut-8", "ray-lut-32"), "judged on a CPU")}


def test_tables_of_methods_say_what_limits_a_figure_in_its_cell() -> None:
    """As the benchmark writes them today, and as they are committed."""
    records = [
        {"method": name, "lens": "any", "group": "published", "source": "", "failed": "not run", "rms_px": None}
        for name in (*LIMITS, "hanika-d5")
    ]
    folder = ROOT / "experiments" / "results" / "surrogates"
    pages = [lens_page("any", records, ""), summary_page({"any": records}, "")]
    for page in [*pages, *(file.read_text(encoding="utf-8") for file in sorted(folder.glob("*.md")))]:
        found = re.findall(r"\| ((?:neurolens2017-128x3|ray-lut-8|ray-lut-32|hanika-d5)[^|]*) (?=\|)", page)
        assert set(found) == {*(f"{name}, {limit}" for name, limit in LIMITS.items()), "hanika-d5"}
