"""The optical path of models: rays stay to the bit, a collimator has none, path and rays agree; files and pupils."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

from neurolens.base.errors import InputError, ModelError
from neurolens.cameras.model import load_model
from neurolens.graph.interpret import evaluate
from neurolens.graph.program import RAY, WAVELENGTH
from neurolens.models import phase
from neurolens.models.assemble import Parts
from neurolens.models.card import CARD_KEY, MODEL_KEY, read_metadata
from neurolens.models.cores import POSITION, Phased
from neurolens.models.export import card_of, export_onnx
from neurolens.models.file import as_stored, coefficients_text, onnx_of, read_model
from neurolens.models.fit import ModelSettings
from neurolens.models.fitted import FilmRays
from neurolens.models.model import LensModel
from neurolens.models.pairs import passing_rays, sample_domain
from neurolens.models.phase import direction_at, path_errors, path_um, traced, unit_um, with_phase
from neurolens.models.source import at_wavelength, fused_program
from neurolens.models.wavefront import model_pupils
from neurolens.optics.analysis.diffraction import cells_of, irradiance, perfect_peak, pupils_at
from neurolens.optics.analysis.exit_pupil import ExitPupil, open_shares
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.lens.shot import Shot
from neurolens.optics.setting.states import set_lens
from neurolens.programs.psf import PsfTask, point_spread
from neurolens.studies.experiment import default_experiment
from neurolens.studies.train import state_settings

MODELS = Path(__file__).parents[2] / "models"


@pytest.fixture(scope="module")
def both() -> tuple[LensModel, LensModel]:
    """A model that ships, and the same with its path."""
    plain = load_model(MODELS / "laikin_double_gauss_50.ols-60.onnx").fitted
    rays = passing_rays(plain.lens, plain.domain, 12_000, seed=5, batch=8192).inputs
    return plain, as_stored([with_phase(plain, rays)])[0]


@pytest.fixture(scope="module")
def fresh(both: tuple[LensModel, LensModel]) -> FilmRays:
    return passing_rays(both[0].lens, both[0].domain, 3000, seed=99, batch=8192).inputs


def test_rays_stay_as_they_are(both: tuple[LensModel, LensModel]) -> None:
    """Outputs to the bit, in both precisions and blocked or not; and without the path the same program."""
    rays = sample_domain(both[0].domain, 2000, seed=3)
    for dtype in (torch.float32, torch.float64):
        a, b = (model.predict(rays.to(dtype)) for model in both)
        assert a.path_um is None and b.path_um is not None
        for x, y in zip((*a.rays, *a[1:5]), (*b.rays, *b[1:5]), strict=True):
            assert torch.equal(x, y)
    programs = [fused_program([model], Parts(path=False)) for model in both]
    assert programs[0].outputs.keys() == programs[1].outputs.keys()
    assert programs[0].count() == programs[1].count()
    assert "phase" not in card_of(both[0], {}) and "path_um" not in card_of(both[0], {})["units"]


def test_fresh_rays_have_the_exact_path(both: tuple[LensModel, LensModel], fresh: FilmRays) -> None:
    errors = path_errors(both[1], fresh)
    assert errors["phase_rms_waves"] < 0.02 and errors["phase_max_waves"] < 0.2
    assert errors["phase_rays_um"] < 1.0  # as the rays themselves err
    assert path_errors(both[0], fresh) == {}


def test_float32_holds_a_hundredth_of_a_wave_at_the_extremes(
    both: tuple[LensModel, LensModel], fresh: FilmRays
) -> None:
    """Rays of the film's edge, of the pupil's edge, and of both ends of light and of focus."""
    x, domain = fresh, both[1].domain
    (shortest, longest), (near, far) = domain.wavelength_nm, domain.film_z_mm
    edge = torch.hypot(x.film_x, x.film_y) > 0.97 * domain.film_radius_mm
    ends = (x.wavelength_nm < shortest + 9) | (x.wavelength_nm > longest - 9) | (x.film_z == near) | (x.film_z == far)
    wide = torch.hypot(x.pupil_x, x.pupil_y) > 0.8 * domain.pupil_radius_mm
    some = fresh.select(edge | ends | wide)
    some = some.to(torch.float32).to(torch.float64)  # the same rays for both
    fine, rough = both[1].predict(some).path_um, both[1].predict(some.to(torch.float32)).path_um
    assert fine is not None and rough is not None and len(some) > 500
    assert float((fine - rough).abs().max()) < 0.01 * unit_um(both[1].lens)
    assert float(fine.max() - fine.min()) > 50  # um, of which float32 leaves this


def test_a_perfect_collimator_makes_plane_waves() -> None:
    """Light of a point in air is plane behind a hyperboloid of the conic -n^2 (Descartes), however wide the beam."""
    n = 1.5
    stop = Surface(radius_mm=math.inf, thickness_mm=1.0, diameter_mm=24.0, n_d=1.0, V_d=None, stop=True)
    flat = Surface(radius_mm=math.inf, thickness_mm=5.0, diameter_mm=30.0, n_d=n, V_d=None)
    bent = Surface(radius_mm=-25.0, thickness_mm=0.0, diameter_mm=30.0, n_d=1.0, V_d=None)
    bent = replace(bent, figure=replace(bent.figure, conic=-(n**2)))
    lens = Lens("Collimator", "closed form", (stop, flat, bent), 2.0)
    core = Phased((None,), np.zeros((0, 4), np.int64), np.zeros(0), 6.0 + 50.0, 0.0, (-0.02,))
    zero = torch.zeros(5, dtype=torch.float64)
    rays = FilmRays(zero, zero, zero + 56.0, torch.linspace(0.0, 12.0, 5).double(), zero, zero + 550.0)
    waves = traced(lens, core, 6.0, rays)
    assert waves.direction[2] == pytest.approx(-1.0) and waves.foot[0, -1] > 10
    assert np.abs(path_um(core, waves)).max() < 1e-9


def test_path_and_rays_are_one(both: tuple[LensModel, LensModel], fresh: FilmRays) -> None:
    """At a point of the focal plane d path = dR . (d - s), for exact rays by central differences."""
    model = both[1]
    core, rays, step = model.core, fresh.select(slice(0, 200)), 1e-3
    assert isinstance(core, Phased)
    rays = replace(rays, film_z=torch.full_like(rays.film_z, core.focal_z_mm))
    here = traced(model.lens, core, model.domain.pupil_z_mm, rays)
    off = here.direction - direction_at(core, here.point)
    for name in ("pupil_x", "pupil_y"):
        a, b = (
            traced(model.lens, core, model.domain.pupil_z_mm, replace(rays, **{name: getattr(rays, name) + h}))
            for h in (step, -step)
        )
        slope = (path_um(core, a) - path_um(core, b)) / (2 * step)
        said = 1000 * ((a.foot - b.foot) * off).sum(0) / (2 * step)
        assert slope == pytest.approx(said, abs=1e-4) and np.abs(said).max() > 0.5


def test_files_keep_it_and_every_form_gives_it(
    both: tuple[LensModel, LensModel], fresh: FilmRays, tmp_path: Path
) -> None:
    model, file = both[1], tmp_path / "gauss.onnx"
    export_onnx(model, file, path_errors(model, fresh))
    read = read_model(file)
    assert read.card["phase"]["terms"] <= 120 and read.card["errors"]["phase_rms_waves"] < 0.02
    rays = replace(fresh, film_z=torch.full_like(fresh.film_z, model.domain.film_z_mm[0]))
    inputs = {
        "rays": rays.rows.numpy(), "film_z_mm": rays.film_z[None, :1].numpy(),
        "stop_radius_mm": np.full((1, 1), model.domain.stop_radius_mm),
    }  # fmt: skip
    wanted = evaluate(model.graph, inputs)["path_um"]
    assert np.array_equal(evaluate(read.at().graph, inputs)["path_um"], wanted)
    session = onnxruntime.InferenceSession(file.read_bytes(), providers=["CPUExecutionProvider"])
    feeds = {name: a.astype(np.float32).reshape(-1 if len(a) == 1 else a.shape) for name, a in inputs.items()}
    assert session.run(["path_um"], feeds)[0] == pytest.approx(wanted[0], abs=0.01 * unit_um(model.lens))
    calls = {"film_z_mm": feeds["film_z_mm"][0], "stop_radius_mm": feeds["stop_radius_mm"][0]}
    columns = dict(zip((*RAY, WAVELENGTH), feeds["rays"], strict=True))
    found = fused_program([model]).evaluate({**columns, **calls})["path_um"]
    assert found == pytest.approx(wanted[0], abs=0.01 * unit_um(model.lens))
    one = at_wavelength(model, 550.0)
    inputs["rays"][4] = 550.0
    assert evaluate(one.graph, inputs)["path_um"] == pytest.approx(evaluate(model.graph, inputs)["path_um"], abs=1e-6)
    step = 1e-4 * np.eye(5)[2][:, None]
    a, b = (evaluate(model.graph, {**inputs, "rays": inputs["rays"] + h})["path_um"][0] for h in (step, -step))
    whole = onnxruntime.InferenceSession(onnx_of([model], derivatives=True), providers=["CPUExecutionProvider"])
    feeds["rays"] = inputs["rays"].astype(np.float32)
    assert whole.run(["path_um_d_pupil"], feeds)[0][0] == pytest.approx((a - b) / 2e-4, abs=1e-3)
    assert isinstance(model.core, Phased)
    broken = replace(model.core, path=model.core.path * 1.01)
    with pytest.raises(ModelError, match="path_um is off"):
        _swap(file, replace(model, core=broken))


def test_more_terms_take_what_few_leave(
    both: tuple[LensModel, LensModel], fresh: FilmRays, monkeypatch: pytest.MonkeyPatch
) -> None:
    rays = passing_rays(both[0].lens, both[0].domain, 4000, seed=5, batch=8192).inputs
    monkeypatch.setattr(phase, "TERMS", 12)
    monkeypatch.setattr(phase, "_MOST_WAVES", math.inf)
    few, more = (with_phase(both[0], rays, most) for most in (12, 24))
    assert isinstance(few.core, Phased) and isinstance(more.core, Phased)
    assert len(few.core.path) == 12 and 12 < len(more.core.path) <= 24
    errors = [path_errors(model, fresh)["phase_rms_waves"] for model in (few, more)]
    assert errors[0] > 0.3 and errors[1] < 0.4 * errors[0]


def _swap(file: Path, model: LensModel) -> None:
    """Put the coefficients of another model in a file, and read it."""
    text = read_metadata(file)[CARD_KEY]
    file.write_bytes(onnx_of([model], metadata={CARD_KEY: text, MODEL_KEY: coefficients_text([model])}))
    read_model(file)


def test_what_has_no_path_is_refused_by_name() -> None:
    plain = load_model(MODELS / "laikin_double_gauss_50.ols-36.onnx").fitted
    cylinders = load_model(MODELS / "cooke_anamorphic_42.ols-64.onnx").fitted
    for model, found in (
        (replace(plain, direction="slope", method="thick"), "with method thick"),
        (cylinders, "cylin"),
    ):
        with pytest.raises(InputError, match=rf"phase: got \({found}"):
            with_phase(model, sample_domain(model.domain, 10, seed=1))
    with pytest.raises(InputError, match="model.phase: got 'true'"):
        state_settings(ModelSettings(phase=True), 1000, 1)
    asked = default_experiment(MODELS.parent / "lenses" / "cooke_triplet_50.toml", ["model.phase=true"])
    assert all(settings.phase for settings in asked.model) and len(asked.model) == 2
    with pytest.raises(InputError, match=r"a model with optical path"):
        model_pupils(plain, Scene(plain.lens), np.zeros((1, 2)), (550.0,))


def _strehl(pupil: ExitPupil, cells: int = 192) -> float:
    field = cells_of(pupil, (cells, cells))
    reach = max(4e-6 * pupil.wavelength_nm / float(pupil.half.max()), pupil.blur_mm)
    line = np.linspace(-reach, reach, 101)
    return float(irradiance(pupil, line, line, field).max()) / perfect_peak(pupil, field)


@pytest.mark.parametrize(
    ("f_number", "focus_m", "distance_m"), [(5.6, math.inf, math.inf), (8.0, 2.0, 1.9), (32.0, math.inf, math.inf)]
)
def test_pupils_are_those_of_traced_rays(
    both: tuple[LensModel, LensModel], f_number: float, focus_m: float, distance_m: float
) -> None:
    lens = set_lens(both[1].lens, Shot(film_mm=(36.0, 24.0), f_number=f_number, focus_m=focus_m))
    scene, places, waves = Scene(lens, distance_m), np.array([[0.0, 0.0], [9.0, 12.1]]), (546.0, 450.0)
    for exact, found in zip(pupils_at(scene, places, waves), model_pupils(both[1], scene, places, waves), strict=True):
        for a, b in zip(exact, found, strict=True):
            assert a is not None and b is not None
            assert _strehl(b) == pytest.approx(_strehl(a), abs=0.01)
            areas = [float(open_shares([p], (192, 192))[0].sum() * p.half.prod()) for p in (a, b)]
            assert areas[1] == pytest.approx(areas[0], rel=2e-3)
            assert b.centre_mm == pytest.approx(a.centre_mm, abs=0.01)
    beyond = model_pupils(both[1], scene, np.array([[40.0, 0.0]]), waves)
    assert beyond == [[None, None]]
    with pytest.raises(InputError, match="wavelength_nm: got 900"):
        model_pupils(both[1], scene, places, (900.0,))


def test_errors_of_rays_do_not_reach_the_waves(both: tuple[LensModel, LensModel]) -> None:
    """By Fermat's principle: rays that leave 0.2 % too far from the axis would move the wave by 0.013 waves."""
    model, core = both[1], both[1].core
    lens = set_lens(model.lens, Shot(film_mm=(36.0, 24.0), f_number=2.0))
    assert isinstance(core, Phased)
    (rays,) = core.parts
    ab = rays.ab.copy()
    ab[POSITION] *= 1.002
    off = replace(model, core=replace(core, parts=(replace(rays, ab=ab),)))
    [[a]], [[b]] = (model_pupils(each, Scene(lens), np.array([[15.0, 0.0]]), (546.0,)) for each in (model, off))
    assert a is not None and b is not None
    u, v = np.meshgrid(*[np.linspace(-0.6, 0.6, 15)] * 2)
    cosines = np.stack([u, v]).reshape(2, -1) * a.half[:, None]
    waves = [p.field((cosines + a.middle[:, None] - p.middle[:, None]) / p.half[:, None]) for p in (a, b)]
    assert np.unwrap(np.angle(waves[1] / waves[0])).std() / (2 * math.pi) < 0.0005


def test_a_condenser_has_the_strehl_ratio_of_its_middle(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its path errs by waves where there is no image; on its axis, stopped down, it is that of traced rays."""
    monkeypatch.setattr(phase, "TERMS", 50)
    plain = load_model(MODELS / "thorlabs_lb1471_biconvex_50.ols-64.onnx").fitted
    model = with_phase(plain, passing_rays(plain.lens, plain.domain, 4000, seed=5, batch=8192).inputs)
    scene = Scene(set_lens(plain.lens, Shot(film_mm=(60.0, 60.0), f_number=8.0)))
    [[exact]], [[found]] = (
        pupils_at(scene, (place := np.zeros((1, 2))), (546.0,)), model_pupils(model, scene, place, (546.0,))
    )  # fmt: skip
    assert exact is not None and found is not None and _strehl(exact) > 0.8
    assert _strehl(found) == pytest.approx(_strehl(exact), abs=0.01)
    # Wide open and far from the axis its path sends light beyond the film: no image, rather than a wrong one.
    wide = Scene(set_lens(plain.lens, Shot(film_mm=(60.0, 60.0), f_number=2.0)))
    place = np.array([[0.7 * plain.domain.film_radius_mm, 0.0]])
    assert model_pupils(model, wide, place, (546.0,)) == [[None]]


def test_a_model_that_folds_beyond_its_rims_keeps_its_chief_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rays that no rim would pass meet the middle of this model's stop, too, at 0.7 of the film."""
    monkeypatch.setattr(phase, "TERMS", 10)
    monkeypatch.setattr(phase, "ENOUGH_WAVES", math.inf)
    plain = load_model(MODELS / "sony_sonnar_55.ols-64.onnx").fitted
    model = with_phase(plain, passing_rays(plain.lens, plain.domain, 1500, seed=5, batch=8192).inputs)
    scene = Scene(set_lens(plain.lens, Shot(film_mm=(36.0, 24.0))))
    [[found]] = model_pupils(model, scene, np.array([[0.7 * plain.domain.film_radius_mm, 0.0]]), (546.0,))
    assert found is not None and open_shares([found], (64, 64))[0].mean() > 0.5


def test_a_model_gives_the_point_spread_of_its_lens(both: tuple[LensModel, LensModel]) -> None:
    """Light that lies in other pixels; the place of its middle; relative illumination."""
    lens = set_lens(both[1].lens, Shot(film_mm=(36.0, 24.0), f_number=4.0))
    task = PsfTask(lens, 20.0, ((-9.0, 8.0), (0.0, 0.0)), ((546.0,),), 0.004, 31)
    exact, found = (point_spread(replace(task, model=model)) for model in (None, both[1]))
    assert 0.5 * np.abs(exact["psf"] - found["psf"]).sum() < 0.02
    assert found["centre_mm"] == pytest.approx(exact["centre_mm"], abs=0.01)
    assert found["light"] == pytest.approx(exact["light"], rel=2e-3)
    with pytest.raises(InputError, match="stop_radius_mm: got 17"):
        wider = set_lens(both[1].lens, Shot(film_mm=(36.0, 24.0), f_number=1.0))
        replace(task, lens=wider, model=both[1])
