"""The models that ship: each loads, stands for its lens and keeps on fresh rays what its index says."""

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from shipped import NAMED, NAMES, SOME, WHOLE
from vignetting_oracle import vignetting_errors

from neurolens.base.errors import ModelError
from neurolens.cameras.model import OnnxLens, load_model
from neurolens.cli import main, models as models_command
from neurolens.models.file import read_model
from neurolens.models.fitted import Domain, FilmRays
from neurolens.models.pairs import passing_rays, sample_domain
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens
from neurolens.studies.check import check_states, promises_of, space_of_card
from neurolens.studies.measure import FreshRays, fresh_rays, measure, onnx_predictor

ROOT = Path(__file__).parents[1]
MODELS = ROOT / "models"
INDEX: dict[str, Any] = json.loads((ROOT / "models" / "index.json").read_text(encoding="utf-8"))
ROWS: list[dict[str, Any]] = INDEX["models"]
# What is promised: file, figure, limit. Coefficients count A and B terms of one vector output. Polynomials of the
# double Gauss were promised 2, 1 and 0.25 um while its glasses had no partial dispersion: its colour takes more terms.
PROMISED = [
    ("laikin_double_gauss_50.ols-28.onnx", "rms_um", 2.5),
    ("laikin_double_gauss_50.ols-28.onnx", "coefficients_per_vector", 40),
    ("laikin_double_gauss_50.ols-60.onnx", "rms_um", 0.3),
    ("laikin_double_gauss_50.ols-60.onnx", "coefficients_per_vector", 100),
    ("laikin_double_gauss_50.ols-36.onnx", "rms_um", 1.2),
    ("laikin_double_gauss_50.mlp-10x1.onnx", "rms_um", 1.0),
    ("laikin_double_gauss_50.mlp-16x2.onnx", "rms_um", 0.1),
    ("laikin_double_gauss_50.mlp-32x2.onnx", "rms_um", 0.05),
    ("laikin_double_gauss_50.ols-60.onnx", "false_pass", 0.002),
    ("laikin_double_gauss_50.ols-60.onnx", "false_block", 0.002),
    ("muller_fisheye_100-14mm.ols-40.onnx", "direction_rms_deg", 0.001),
    ("muller_fisheye_100-14mm.mlp-16x2.onnx", "direction_rms_deg", 0.0003),
    ("ogawa_zoom_70_200-135mm.ols-60.onnx", "rms_um", 0.1),
    ("ogawa_zoom_70_200-135mm.mlp-8x1.onnx", "rms_um", 1.0),
]


# Of one state, of lenses at the ends of the library.
SOME_ROWS = [r for r in ROWS if not r.get("axes") and Path(r["lens_file"]).stem in SOME]


@cache
def model(file: str) -> OnnxLens:
    return load_model(ROOT / "models" / file)


@cache
def exact(lens_file: str, configuration: str | None, efl_mm: float | None) -> Lens:
    return set_lens(read_lens(ROOT / lens_file), zoom=configuration, focal_length_mm=efl_mm)


def rays_of(file: str) -> FreshRays:
    """Rays that no fit has seen, the same for all models of one lens and domain."""
    row = next(r for r in ROWS if r["file"] == file)
    return _rays_of(json.dumps(model(file).card["domain"]), row["lens_file"], row["configuration"], row["efl_mm"])


@cache
def _rays_of(domain: str, *state: Any) -> FreshRays:
    known, seed = Domain.from_dict(json.loads(domain)), 424_243
    lens = exact(*state).with_stop_radius(known.stop_radius_mm)
    held_out = passing_rays(lens, known, 4000, seed)
    return fresh_rays(lens, known, held_out, count=16_000, seed=seed)


@pytest.mark.parametrize(("file", "figure", "limit"), PROMISED)
def test_index_holds_what_is_promised(file: str, figure: str, limit: float) -> None:
    row = next(r for r in ROWS if r["file"] == file)
    assert row[figure] is not None and row[figure] <= limit


@pytest.mark.parametrize("row", SOME_ROWS, ids=lambda r: r["file"])
def test_model_keeps_its_card_and_index_on_fresh_rays(row: dict[str, Any]) -> None:
    card, fresh = model(row["file"]).card, rays_of(row["file"])
    assert card["lens"]["sha256"] == fresh.lens.sha256
    assert all(row[figure] == card["errors"][figure] for figure in ("rms_um", "direction_rms_deg", "false_pass"))
    promises = promises_of(card["errors"], fresh, measure(fresh, onnx_predictor(model(row["file"]))))
    assert len(promises) > 10 and not [p for p in promises if not p.holds]
    assert read_model(ROOT / "models" / row["file"]).at().domain == fresh.domain  # for source code of it


@pytest.mark.parametrize("row", SOME_ROWS, ids=lambda r: r["file"])
def test_no_ray_that_passes_points_backwards_or_is_not_finite(row: dict[str, Any]) -> None:
    """In float32, over the whole domain and the ends of every coordinate; forwards is as the exact lens has it."""
    d, fresh = Domain.from_dict(model(row["file"]).card["domain"]), rays_of(row["file"])
    inner, ends = sample_domain(d, 60_000, seed=31), sample_domain(d, 4000, seed=32)
    film, pupil = torch.hypot(ends.film_x, ends.film_y), torch.hypot(ends.pupil_x, ends.pupil_y)
    to_film, to_pupil = d.film_radius_mm / film, d.pupil_radius_mm / pupil
    far = torch.tensor([d.film_z_mm, d.wavelength_nm])[:, torch.arange(len(ends)) % 2]
    at_ends = FilmRays(
        ends.film_x * to_film, ends.film_y * to_film, far[0], ends.pupil_x * to_pupil, ends.pupil_y * to_pupil, far[1]
    )
    widest = math.acos(-float(fresh.held_out.scene.dz.max()))
    limit = 0.0 if widest < math.pi / 2 else -math.cos(1.1 * widest)
    predict, passed = onnx_predictor(model(row["file"])), 0
    for rays in (
        inner,
        at_ends,
        replace(ends, film_z=far[0]),
        replace(at_ends, pupil_x=ends.pupil_x, pupil_y=ends.pupil_y),
    ):
        for stop in (None, 1e-3 * d.stop_radius_mm):
            out = predict(rays, stop)
            found = torch.stack([*out.rays, out.transmittance, out.stop_x, out.stop_y])[:, out.status == 0]
            assert torch.isfinite(found).all() and (found[5] < limit).all()
            assert (((found[3:6] ** 2).sum(0) - 1).abs() < 1e-5).all()
            passed += found.shape[1]
    assert passed > 10_000


def test_networks_clip_rays_as_well_as_polynomials() -> None:
    """Of every lens in its default state, in the median and in the worst case."""
    shares = {
        kind: np.array([[r["false_pass"], r["false_block"]] for r in ROWS if r["model"] == kind])
        for kind in ("ols-64", "mlp-16x2")
    }
    for choose, slack in ((np.median, 1.3), (np.max, 1.0)):
        worse, limit = (choose(shares[kind], 0) for kind in ("mlp-16x2", "ols-64"))
        assert (worse <= slack * limit).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "row", [r for r in ROWS if r.get("axes") and (WHOLE or "80_200" in r["file"])], ids=lambda r: r["file"]
)
def test_a_model_of_many_states_keeps_its_card_at_others(row: dict[str, Any]) -> None:
    known = model(row["file"])
    space = space_of_card(known.card, known.axes, ROOT / row["lens_file"], ROOT / "models" / row["file"])
    promises = check_states(known, space, rays=4000, count=2)[1]
    assert promises and all(p.holds for p in promises)


@pytest.mark.parametrize("closed", [1, 2, 4])
def test_stopped_down_needs_no_new_fit(closed: int) -> None:
    """Against the exact lens traced with that stop; the card tells of two stops and four."""
    file = "laikin_double_gauss_50.ols-60.onnx"
    fresh, predict = rays_of(file), onnx_predictor(model(file))
    radius = fresh.domain.stop_radius_mm / 2 ** (closed / 2)
    traced = vignetting_errors(fresh.lens, fresh.domain, predict, stop_radius_mm=radius, count=60_000)
    told = model(file).card["errors"]["stopped_down"].get(f"{closed}_stops", traced)
    assert all(shares[key] <= 0.002 for shares in (traced, told) for key in ("false_pass", "false_block"))


def test_historical_lenses_and_100_by_name_ship_a_polynomial_and_many_a_network() -> None:
    """A network of every historical lens, and of thirty by name; models of other lenses are fitted on demand."""
    kinds: dict[str, set[bool]] = {}
    for row in ROWS:
        kinds.setdefault(Path(row["lens_file"]).stem, set()).add("mlp" in row["model"])
    assert set(kinds) | set(INDEX["left_out"]) >= {*NAMES} and len(INDEX["left_out"]) <= 3
    assert len(kinds.keys() & {*NAMED}) >= 100 and len(kinds) <= 150
    assert all(False in found for found in kinds.values())
    assert all(True in kinds[name] for name in NAMES if name in kinds)
    assert sum(True in kinds[name] for name in NAMED if name in kinds) >= 30


def test_the_folder_is_small_and_holds_what_the_index_says() -> None:
    files = {f.name for f in (ROOT / "models").glob("*.onnx")}
    assert files == {row["file"] for row in ROWS}
    assert sum(f.stat().st_size for f in (ROOT / "models").iterdir()) < 12e6
    assert not [row["file"] for row in ROWS if row.get("broken")]


def test_models_are_listed_with_the_one_to_use(tmp_path, monkeypatch, capsys) -> None:
    """Of a working folder with runs, where the package ships no models."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(models_command, "library", lambda: tmp_path / "site")
    assert main(["models"]) == 2
    assert "models/, runs/*/models/" in capsys.readouterr().err
    own = tmp_path / "runs" / "mine" / "models"
    own.mkdir(parents=True)
    sizes, times = ("ols-36", "ols-60", "mlp-16x2"), (3.0, 4.0, 9.0)
    for size in sizes:
        (own / f"{size}.onnx").write_bytes((MODELS / f"laikin_double_gauss_50.{size}.onnx").read_bytes())
    (own / "cut.onnx").write_bytes((own / "ols-36.onnx").read_bytes()[:900])
    timed = [{"file": f"models/{n}.onnx", "fused_ns_per_ray": {"min": t}} for n, t in zip(sizes, times, strict=True)]
    (own.parent / "results.json").write_text(json.dumps({"models": timed}))
    for within, use in ((None, "ols-36"), ("1um", "ols-60"), ("0.01px", "mlp-16x2")):
        more = [] if within is None else ["--within", within]
        assert main(["models", "double gauss", "--json", *more]) == 0
        out = capsys.readouterr()
        rows = json.loads(out.out)["models"]
        assert [Path(r["file"]).stem for r in rows if r.get("use")] == [use], within
        assert len(rows) == 3 - [None, "1um", "0.01px"].index(within) and "cut.onnx: left out" in out.err
    shot, stated = tmp_path / "runs" / "a_plan" / "models" / "shot.onnx", b'"focus_m": ["inf", 0.7]'
    shot.parent.mkdir(parents=True)
    shot.write_bytes((own / "mlp-16x2.onnx").read_bytes().replace(stated, b'"focus_m": [  0.7, 0.7]'))
    (shot.parents[1] / "results.json").write_text(json.dumps({"models": [timed[0] | {"file": "models/shot.onnx"}]}))
    assert main(["models", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["models"]
    assert Path(rows[-1]["file"]).stem == "shot" and [Path(r["file"]).stem for r in rows if r.get("use")] == ["ols-36"]


def test_a_card_that_states_no_polarised_transmittance_is_refused(tmp_path: Path) -> None:
    shipped, stated = MODELS / "petzval_portrait_100.ols-64.onnx", b'"transmittance": "polarised"'
    data, file = shipped.read_bytes(), tmp_path / "old.onnx"
    assert data.count(stated) == 1
    for other, found in ((b'"transmittancX": "polarised"', "missing"), (b'"transmittance": "averaged_"', "averaged_")):
        file.write_bytes(data.replace(stated, other))
        with pytest.raises(ModelError, match=f'transmittance.*{found}.*"polarised"'):
            load_model(file)
