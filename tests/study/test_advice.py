"""One decision for every command and the README: when a model is worth its error, and when to trace exactly."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from neurolens.plan import plan as planned
from neurolens.plan.candidates import Choice
from neurolens.plan.costs import Work
from neurolens.plan.plan import decided
from neurolens.study.advice import PATH_NS, SAVING, advice, recommended, to_use

ROOT = Path(__file__).parents[2]
FUSED = json.loads((ROOT / "experiments" / "results" / "fused_speed.json").read_text(encoding="utf-8"))["rows"]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def timed(refractions: int) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Models and the exact lens as C, of the committed measurement, as records of a run."""
    rows = [r for r in FUSED if r["refractions"] == refractions and r["work"] == "whole"]
    models = [
        {
            "name": r["name"],
            "family": r["name"][:3],
            "rms_um": r["rms_um"],
            "fused_ns_per_ray": r["ns"],
            "file": "m.onnx",
        }
        for r in rows
        if r["name"].endswith(", C") and not r["name"].startswith("exact")
    ]
    (exact,) = (r for r in rows if r["name"] == "exact C")
    return models, {"name": "exact C", "available": True, "ns_per_ray": exact["ns"]}


def by_plan(models: list[dict[str, Any]], exact: dict[str, Any], rest: float, monkeypatch: pytest.MonkeyPatch) -> str:
    """The camera that a plan chooses by the same costs."""
    tried = [Choice(m["name"], "", 0.01, 0.0, m["fused_ns_per_ray"]["min"], 1.0) for m in models]
    tried.append(Choice("exact", "", 0.0, 0.0, exact["ns_per_ray"]["min"], 1.0))
    monkeypatch.setattr(planned, "effects_of", lambda found, budget: ())
    monkeypatch.setattr(planned, "shot_domain", lambda found: None)
    best = decided(SimpleNamespace(asked=None), tried, 0.25, "c", Work((rest, rest))).best  # type: ignore[arg-type]
    assert best is not None
    return best.name


@pytest.mark.parametrize(("refractions", "use"), [(2, "the exact lens"), (12, "ols-40, C"), (33, "ols-28, C")])
def test_commands_and_readme_agree(refractions: int, use: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The singlet, the double Gauss and the zoom of the README: in our renderer always the exact lens."""
    models, exact = timed(refractions)
    results = {"models": models, "exact": [exact], "lens": {"file": "lens.toml"}, "settings": {}}
    renderer, elsewhere = advice(results, Path("run"))
    assert (renderer.name, elsewhere.name) == ("the exact lens", use)
    assert "--camera fused:run/lenses/lens.toml" in renderer.command
    traced = use == "the exact lens"
    (row,) = (line for line in README.splitlines() if line.startswith(f"| C, {refractions} refractions"))
    assert ("trace exactly" in row) == traced
    (row,) = (line for line in README.splitlines() if line.startswith("| a picture of our renderer"))
    assert "use the exact lens" in row
    assert by_plan(models, exact, 0.0, monkeypatch) == ("exact" if traced else use)
    # A plan measures the scene: where a whole picture takes more than 1.2 times as long, it takes the model.
    assert by_plan(models, exact, PATH_NS, monkeypatch) == (use if refractions > 20 else "exact")


def test_the_rule_at_its_edge() -> None:
    for cost, rest, use in ((1.0, 0.0, 1.0), (1.001, 0.0, 1.5), (0.9, 0.3, 0.9), (0.95, 0.3, 1.5), (0.0, 3.1, 1.5)):
        assert recommended([cost, 2.0], float, 1.5, rest) == use == recommended([2.0, cost], float, SAVING, rest)
    assert recommended([], float, None) is None and recommended([], float, 3.0) == 3.0
    assert recommended([2.0, 1.0], float, None) == 1.0


def test_without_times_the_smallest_close_model_is_taken_and_else_the_closest() -> None:
    models = [{"name": n, "rms_um": e, "bytes": b} for n, e, b in (("a", 1.0, 9), ("b", 0.1, 20), ("c", 5.0, 1))]
    assert to_use(models) is models[0] and to_use(models, 0.5) is models[1] and to_use(models, 0.01) is models[1]
    assert to_use([]) is None
    poor = [{**models[0], "poor": ["false pass 3%"]}]
    exact = {"name": "exact C", "ns_per_ray": {"min": 50.0}}
    assert to_use(poor) is poor[0] and to_use(poor, exact=exact) is exact
