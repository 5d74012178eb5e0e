"""The defaults of `neurolens train --lens FILE` suit lenses that nobody has tried: promises hold on fresh rays."""

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from lens_models import LENSES
from shipped import PATHS, whole

from neurolens.base.errors import InputError
from neurolens.cameras.model import load_model
from neurolens.cli import main
from neurolens.models.export import export_onnx
from neurolens.models.fit import ModelSettings, fit_model, prepare
from neurolens.models.pairs import PairSettings, domain_of, make_pairs
from neurolens.optics.lens.glass import LINE_D_NM
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.focusing import near_limit_m
from neurolens.optics.setting.states import set_lens
from neurolens.studies.check import check_model
from neurolens.studies.experiment import default_experiment, wavelengths_nm
from neurolens.studies.measure import measure_on, shared_rays

AIR: dict[str, float] = {}
BK7, SK16, F2 = {"n_d": 1.5168, "V_d": 64.17}, {"n_d": 1.62041, "V_d": 60.32}, {"n_d": 1.62004, "V_d": 36.37}
STOP = {"stop": "true"}
Surfaces = list[tuple[float, float, float, dict[str, Any]]]
# radius_mm, thickness_mm, diameter_mm, the rest.
ODD: dict[str, tuple[float, Surfaces]] = {
    "ball": (8, [(math.inf, 0.5, 0.9, STOP), (5, 10, 8, BK7), (-5, 2.3, 8, AIR)]),
    "triplet_5mm": (
        5,
        [
            (2.201359, 0.325896, 1.3888, SK16), (-43.576, 0.600755, 1.2391, AIR), (-2.221328, 0.099997, 0.7767, F2),
            (2.029192, 0.475041, 0.76124, STOP), (7.96836, 0.295208, 0.9531, SK16), (-1.839533, 4.220778, 1.0756, AIR),
        ],
    ),
    "reversed_telephoto": (
        4, [(-40, 2, 24, BK7), (60, 30, 22, AIR), (math.inf, 1, 12, STOP), (40, 5, 20, SK16), (-45, 60, 20, AIR)],
    ),
    "monocentric": (
        3,
        [
            (10, 4, 16, {"n_d": 1.8, "V_d": 46}), (6, 6, 10, {"n_d": 1.6, "V_d": 60}),
            (math.inf, 6, 5, {"n_d": 1.6, "V_d": 60, **STOP}), (-6, 4, 10, {"n_d": 1.8, "V_d": 46}), (-10, 6, 16, AIR),
        ],
    ),
    "no_dispersion": (
        8, [(60, 6, 25, {"n_d": 1.6}), (-45, 2, 25, {"n_d": 1.72}), (-200, 5, 24, AIR), (math.inf, 95, 15, STOP)],
    ),
    "pinhole": (60, [(math.inf, 2, 6, AIR), (math.inf, 30, 0.5, STOP)]),
}  # fmt: skip


def written(folder: Path, name: str, f_number: float, surfaces: Surfaces) -> Path:
    rows = []
    for radius, thickness, diameter, rest in surfaces:
        table = {"radius_mm": radius, "thickness_mm": thickness, "diameter_mm": diameter, **rest}
        rows.append("  { " + ", ".join(f"{k} = {v}" for k, v in table.items()) + " },")
    head = f'schema = 1\nname = "{name}"\nsource = "made up"\nrims = "estimated"\nf_number = {f_number}\n'
    path = folder / f"{name}.toml"
    path.write_text(head + "surfaces = [\n" + "\n".join(rows) + "\n]\n")
    return path


@pytest.mark.parametrize("name", ["ball", *whole(*(name for name in ODD if name != "ball"))])
def test_promises_of_the_default_domain_hold(name: str, tmp_path: Path) -> None:
    experiment = default_experiment(written(tmp_path, name, *ODD[name]))
    lens = experiment.lens.read()
    domain = experiment.domain.of(lens)
    if name == "no_dispersion":
        assert domain.wavelength_nm == (LINE_D_NM, LINE_D_NM)
    prepared = prepare(make_pairs(lens, domain, PairSettings(4000, 1000, 4000)))
    model = fit_model(prepared, ModelSettings("ols", terms=32))
    file = export_onnx(model, tmp_path / "model.onnx")
    file = export_onnx(model, file, measure_on(shared_rays(prepared, 20_000), load_model(file)))
    figures, promises = check_model(load_model(file), lens, rays=1000)
    assert len(promises) > 25 and [p for p in promises if not p.holds] == []
    # A model worth having: a tenth of a millirad, and boundaries good to a per cent.
    assert figures["direction_rms_deg"] < 0.01 and figures["false_pass"] < 0.01 and figures["false_block"] < 0.01


def test_defaults_of_the_whole_library() -> None:
    """Every lens: visible light, or the d line; an object in focus that lies before the front surface."""
    for file in PATHS:
        lens = set_lens(read_lens(file))
        low, high = wavelengths_nm(lens)
        assert 380 <= low <= 400 and 700 <= high <= 780, file.name
        near_mm, data = 1000 * near_limit_m(lens), first_order(lens)
        assert near_mm - data.rear_focal_z_mm >= 4 * abs(data.efl_mm), file.name
    assert default_experiment(LENSES / "nakamura_wide_22.toml").lens.read().dispersive is False


def test_a_lens_without_a_real_focus_is_refused_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    diverging: Surfaces = [(math.inf, 2, 10, STOP), (-50, 2, 20, BK7), (50, 40, 20, AIR)]
    path = written(tmp_path, "diverging", 5, diverging)
    assert main(["train", "--lens", str(path), "--quiet"]) == 2
    line = capsys.readouterr().err
    assert "diverging.toml" in line and "behind its last surface" in line
    assert not (tmp_path / "runs").exists()
    with pytest.raises(InputError, match="surfaces"):
        default_experiment(path).domain.of(read_lens(path))


@pytest.mark.usefixtures("no_plots")
def test_a_run_folder_is_all_that_evaluate_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A table of another program, read by train; another lens of that name in ./lenses misleads nobody."""
    table = tmp_path / "singlet.dat"
    table.write_text("# Plano-convex\n0 8 0 10\n0 5 1.5168 30\n-31 0 1 30\n")
    small = "pairs.train=1500", "pairs.held_out=1000", "pairs.rim=500", "evaluation.vignetting_rays=4000"
    settings = *small, "evaluation.rounds=0", 'model=[{method="ols", terms=12}]'
    folder = tmp_path / "run"
    options = [word for setting in settings for word in ("--set", setting)]
    assert main(["train", "--lens", str(table), "--output", str(folder), "--quiet", *options]) == 0
    table.unlink()
    (tmp_path / "lenses").mkdir()
    written(tmp_path / "lenses", "singlet", *ODD["ball"])
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    assert main(["evaluate", str(folder / "models/ols-12.onnx"), "--rays", "1000", "--quiet"]) == 0
    assert "All promises hold" in capsys.readouterr().out


def test_a_film_stated_beyond_the_light_ends_with_it(tmp_path: Path) -> None:
    """A stated image circle wider than the rims leave light: models are of the lit film, and load."""
    path = written(tmp_path, "triplet", *ODD["triplet_5mm"])
    path.write_text(path.read_text().replace("rims =", "image_radius_mm = 8.3\nrims ="))
    experiment = default_experiment(path)
    lens = experiment.lens.read()
    with pytest.warns(match="dark beyond .* mm: models are of what is lit"):
        domain = experiment.domain.of(lens)
    wide = domain_of(lens)
    assert domain.film_radius_mm < 0.9 * wide.film_radius_mm
    assert domain.bounds.lit_radius_mm > 0.8 * domain.film_radius_mm
    passing = make_pairs(lens, wide, PairSettings(3000, 1, 1)).train.inputs
    assert float(torch.hypot(passing.film_x, passing.film_y).max()) <= domain.film_radius_mm
    with pytest.warns(match="is dark beyond"):
        asked = default_experiment(path, ["domain.film_radius_mm=9"]).domain.of(lens)
    assert asked.film_radius_mm == 9
