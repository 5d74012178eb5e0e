"""Models of many states: nodes, what lies between them, the graph's state input, and states out of range."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from operator import setitem
from pathlib import Path
from typing import Any

import lens_models
import numpy as np
import pytest
import torch
from shipped import whole
from vignetting_oracle import vignetting_errors

from experiments.data.refit import refitted
from experiments.hostile import outside
from neurolens.base import status as st
from neurolens.base.errors import InputError, ModelError
from neurolens.cameras.model import OnnxCamera
from neurolens.cameras.onnxlens import LensRays, OnnxLens, load_model
from neurolens.models.axes import Axis, product, weights
from neurolens.models.export import export_states
from neurolens.models.fit import StateModel, StateSettings, StateSpace, fit_states, focus_axis, zoom_axis
from neurolens.models.fitted import FilmRays
from neurolens.models.model import LensModel, mix
from neurolens.models.pairs import passing_rays, sample_domain
from neurolens.models.targets import TRANSMITTANCE_TERMS
from neurolens.optics.lens.designs import coated
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.focusing import best_focus_z_mm
from neurolens.optics.setting.states import set_lens
from neurolens.studies.check import check_states, space_of_card
from neurolens.studies.rays import ray_errors

ZOOM = Axis("zoom", "mm", (70.0, 135.0, 200.0), 3, reciprocal=True, stated=(("70mm", 70.0),))
FOCUS = Axis("focus", "1/m", (0.0, 1.0), 4)


@cache
def space() -> StateSpace:
    lens = read_lens(lens_models.LENSES / "nikon_zoom_80_200.toml")
    return StateSpace(lens, (zoom_axis(lens, 4),), focus_m=(math.inf, 4.0))


@cache
def model() -> StateModel:
    return fit_states(space(), StateSettings(terms=40, degree=5, rays=2500))


@cache
def bare() -> StateModel:
    """The same model with the transmittance of the zoom without coatings, of glass that absorbs nothing."""
    m, lens = model(), coated(space().lens, "bare")
    clear = tuple(replace(s, absorption_per_mm=0.0, absorbs_as=None) for s in lens.surfaces)
    plain = StateSpace(replace(lens, surfaces=clear), m.axes, focus_m=m.space.focus_m)
    lenses = [plain.lens_at((z,)) for z in m.axes[0].nodes]
    return StateModel(plain, tuple(refitted(m.nodes, lenses, TRANSMITTANCE_TERMS)))


@cache
def exported() -> Path:
    return export_states(model(), Path(lens_models._folder().name) / "states.onnx", {"rms_um": 1.0})


@cache
def loaded() -> OnnxLens:
    return load_model(exported())


def rays_of(part: LensModel, count: int = 20_000, seed: int = 3) -> tuple[FilmRays, float]:
    """Rays of a domain from one film plane, as float32 holds them."""
    rays = sample_domain(part.domain, count, seed)
    z = float(np.float32(np.mean(part.domain.film_z_mm)))
    columns = [c.float().double() for c in rays.columns()]
    columns[2] = torch.full_like(columns[2], z)
    return FilmRays(*columns), z


def run(lens: OnnxLens, rays: FilmRays, z: float, **more: Any) -> LensRays:
    fx, fy, _, px, py, wavelength = (c.float().numpy() for c in rays.columns())
    return lens.rays(np.stack([fx, fy]), np.stack([px, py]), wavelength, z, **more)


@pytest.mark.parametrize("axis", [ZOOM, FOCUS, replace(ZOOM, reciprocal=False, degree=1)])
def test_interpolation_is_exact_at_nodes_and_for_piecewise_polynomials(axis: Axis) -> None:
    low, high = axis.range
    assert axis.nodes[0] == low and axis.nodes[-1] == high and set(axis.knots) <= set(axis.nodes)
    assert len(axis.nodes) == (len(axis.knots) - 1) * axis.degree + 1
    assert np.array_equal([axis.weights(v) for v in axis.nodes], np.eye(len(axis.nodes)))

    def kinked(value: float) -> float:
        x = 1 / value if axis.reciprocal else value
        knot = 1 / axis.knots[1] if axis.reciprocal else axis.knots[1]
        return 3 - 2 * x + abs(x - knot) * (len(axis.knots) > 2) + 5 * x**axis.degree

    values = np.array([kinked(v) for v in axis.nodes])
    for value in np.linspace(low, high, 101):
        assert axis.weights(float(value)) @ values == pytest.approx(kinked(value), rel=1e-12)
        assert axis.weights(float(value)).sum() == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("value", [69.9, 200.1, math.nan, math.inf, -math.inf, 0.0])
def test_weights_refuse_states_out_of_range(value: float) -> None:
    with pytest.raises(InputError, match="zoom"):
        ZOOM.weights(value)


def test_two_axes_are_a_product() -> None:
    states = product((ZOOM, FOCUS))
    assert len(states) == len(ZOOM.nodes) * len(FOCUS.nodes)
    values = np.array([1 / z * (1 + f) for z, f in states])
    assert weights((ZOOM, FOCUS), (100.0, 0.3)) @ values == pytest.approx(1.3 / 100)
    with pytest.raises(InputError, match="2 numbers"):
        weights((ZOOM, FOCUS), (100.0,))


@pytest.mark.parametrize(
    ("change", "field"),
    [({"knots": (1.0,)}, "knots"), ({"knots": (2.0, 1.0)}, "knots"), ({"knots": (0.0, 1.0)}, "knots"),
     ({"knots": (1.0, math.inf)}, "knots"), ({"degree": 0}, "degree"), ({"degree": 40}, "degree")],
)  # fmt: skip
def test_axes_that_make_no_sense(change: dict[str, object], field: str) -> None:
    with pytest.raises(InputError, match=field):
        replace(ZOOM, **change)  # type: ignore[arg-type]


def test_axes_of_lens_files() -> None:
    zoom = read_lens(lens_models.LENSES / "nikon_zoom_70_200.toml")
    axis = zoom_axis(zoom)
    for (name, value), knot in zip(axis.stated, axis.knots, strict=True):
        assert value == knot == first_order(set_lens(zoom, zoom=name)).efl_mm
    focus = focus_axis(zoom, ("71mm",))
    near = set_lens(zoom, zoom="71mm near")
    assert near.film_z_mm is not None
    # The source gives the distance, and gaps to a thousandth of a millimetre.
    assert 1 / focus.range[1] == pytest.approx((753.2 + near.film_z_mm) / 1000, rel=2e-3)
    assert focus.range[0] == 0
    with pytest.raises(InputError, match="zoom"):
        zoom_axis(lens_models.lens())
    with pytest.raises(InputError, match="focus"):
        focus_axis(lens_models.lens())


def test_structures_that_differ_are_no_state_model() -> None:
    core = lens_models.model("invariants").core
    other = replace(core, exponents=core.exponents + 1)
    with pytest.raises(InputError, match="the same at every node"):
        mix([core, other], np.array([0.5, 0.5]))
    with pytest.raises(InputError, match="5, as many"):
        replace(model(), nodes=model().nodes[:-1])


def test_a_node_is_its_own_model() -> None:
    m = model()
    for state, node in zip(m.axes[0].nodes, m.nodes, strict=True):
        here = m.at(state)
        rays, _ = rays_of(node, 2000)
        assert here.domain.film_z_mm == node.domain.film_z_mm and here.domain.bounds == node.domain.bounds
        a, b = here.predict(rays), node.predict(rays)
        assert torch.equal(a.status, b.status)
        for x, y in zip((*a.rays, a.stop_x), (*b.rays, b.stop_x), strict=True):
            assert torch.allclose(x, y, rtol=1e-12, atol=1e-11)


@pytest.mark.parametrize("state", [91.7, *whole(112.3, 187.0)])
def test_errors_between_nodes(state: float) -> None:
    """No worse than twice the nodes and a micrometre, on the exact lens at states that no node has.

    The transmittance of bare, clear glass errs by 1e-4. Films and absorption change with the wavelength faster than 48
    terms follow, and leave 9e-4 at every node; between nodes it is no more.
    """
    part = model().at(state)
    (near, far), exact = part.domain.film_z_mm, set_lens(part.lens, zoom=state)
    assert near < exact.film_z_mm < far and near < best_focus_z_mm(exact) < far
    rays = passing_rays(part.lens, part.domain, 4000, 9)
    errors = ray_errors(part.lens, part.domain, rays, part.predict)
    assert errors.rms_um < 1.7 and errors.transmittance_rms < 1e-3
    node = model().nodes[2]
    at_node = ray_errors(node.lens, node.domain, passing_rays(node.lens, node.domain, 4000, 9), node.predict)
    assert errors.transmittance_rms < 1.05 * at_node.transmittance_rms
    plain = bare().at(state)
    without_films = passing_rays(plain.lens, plain.domain, 4000, 9)
    assert ray_errors(plain.lens, plain.domain, without_films, plain.predict).transmittance_rms < 1e-4
    shares = vignetting_errors(part.lens, part.domain, part.predict, count=30_000)
    assert shares["false_pass"] < 0.003 and shares["false_block"] < 0.003


@pytest.mark.parametrize("state", [None, 80.5, 97.31, 123.456, 199.99])
def test_graph_agrees_with_the_model(state: float | None) -> None:
    m, lens = model(), loaded()
    value = m.first_state[0] if state is None else float(np.float32(state))
    part = m.at(value)
    rays, z = rays_of(part)
    said, expected = run(lens if state is None else lens.at(value), rays, z), part.predict(rays)
    assert (said.status != expected.status.numpy()).mean() < 1e-3
    passed = (said.status == st.PASSED) & (expected.status.numpy() == st.PASSED)
    assert 0.2 < passed.mean() < 0.95
    off = np.abs(said.scene_ray - torch.stack(list(expected.rays)).numpy())[:, passed]
    assert off[:3].max() < 1e-4 and off[3:].max() < 5e-7
    again = run(lens, rays, z, state=value)
    assert np.array_equal(again.scene_ray, said.scene_ray)
    card = lens.at(value).card
    assert card["domain"]["pupil_z_mm"] == pytest.approx(part.domain.pupil_z_mm, abs=1e-9)
    assert card["domain"]["film_z_mm"] == pytest.approx(part.domain.film_z_mm, abs=1e-9)
    assert card["lens"]["efl_mm"] == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize("bad", [80.0, 79.0, 201.0, math.nan, math.inf, -math.inf, 0.0, -0.0, -100.0, 1e38, 1e-42])
def test_states_out_of_range_are_outside_the_domain(bad: float) -> None:
    rays, z = rays_of(model().at(100.0), 2000)
    said = run(loaded(), rays, z, state=bad)
    assert (said.status == st.OUTSIDE_DOMAIN).all()
    with pytest.raises(InputError):
        loaded().at(bad)


def test_random_states_and_rays_break_no_promise() -> None:
    found = outside.send(loaded(), 200_000, seed=3)
    assert found.broken == dict.fromkeys(found.broken, 0) and found.inside > 10_000 and found.passed > 3000


def test_wrong_numbers_of_states_are_refused() -> None:
    rays, z = rays_of(model().at(100.0), 10)
    for wrong in ((100.0, 1.0), (), "wide"):
        with pytest.raises(InputError, match="state"):
            run(loaded(), rays, z, state=wrong)
    plain = load_model(lens_models.exported("invariants"))
    with pytest.raises(InputError, match="one state"):
        run(plain, rays, z, state=1.0)
    assert plain.at().card == plain.card


DAMAGE: dict[str, Callable[[dict[str, Any]], object]] = {
    "axes": lambda states: states["axes"][0].update(knots=[1.0, "x"]),
    "nodes": lambda states: states["nodes"].pop(),
    "node": lambda states: states["nodes"][2]["domain"].update(pupil_z_mm=None),
    "no node": lambda states: states["nodes"].insert(0, states["nodes"].pop() and 1.0),
    "default": lambda states: states.update(default=[1.0]),
    "reference": lambda states: setitem(states["reference"][1]["scene_ray"][0], 0, 99.0),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_tables_of_states_are_refused(damage: str, tmp_path: Path) -> None:
    with pytest.raises(ModelError):
        load_model(lens_models.edited(exported(), tmp_path / "bad.onnx", lambda card: DAMAGE[damage](card["states"])))


class _Two(StateSpace):
    """The zoom's lens at every state of a second axis."""

    def lens_at(self, state: Sequence[float]) -> Lens:
        return space().lens_at(state[:1])


def test_graph_of_two_axes_agrees_with_the_model(tmp_path: Path) -> None:
    """Nodes of the second axis are the zoom's with another core: whatever varies, the graph must follow it.

    Coefficients that are 0 stay so: a node whose gates take more terms than those of others has another structure.
    """

    def bent(node: LensModel) -> LensModel:
        core = node.core
        scalars = np.where(core.scalars != 0, core.scalars - 0.05, 0.0)  # type: ignore
        return replace(node, core=replace(core, ab=1.01 * core.ab, scalars=scalars))  # type: ignore

    zoom, focus = space().axes[0], Axis("focus", "1/m", (0.0, 0.5), 1)
    nodes = [n for node in model().nodes for n in (node, bent(node))]
    both = StateModel(_Two(space().lens, (zoom, focus)), tuple(nodes))
    lens = load_model(export_states(both, tmp_path / "two.onnx"))
    assert [a.name for a in lens.axes] == ["zoom", "focus"] and lens.state == (zoom.range[0], 0.0)
    for state in ((100.25, 0.0), (100.25, 0.375), (zoom.range[1], 0.5)):
        rays, z = rays_of(both.at(*state), 4000)
        said, expected = run(lens.at(*state), rays, z), both.at(*state).predict(rays)
        assert (said.status != expected.status.numpy()).mean() < 2e-3
        passed = (said.status == st.PASSED) & (expected.status.numpy() == st.PASSED)
        off = np.abs(said.scene_ray - torch.stack(list(expected.rays)).numpy())[:, passed]
        assert off[:3].max() < 1e-4 and off[3:].max() < 5e-7
    for bad in ((100.0, 0.6), (300.0, 0.2), (math.nan, 0.2), (100.0, math.nan), (100.0, -0.1)):
        said = run(lens, rays, z, state=bad)
        assert (said.status == st.OUTSIDE_DOMAIN).all()


def test_cameras_zoom() -> None:
    """A camera set to a zoom position sends the rays of the model there; names and rounded ends of the source count."""
    film = (12.0, 8.0)
    camera = OnnxCamera(loaded(), Shot(film, 10.0, zoom=120.0))
    assert camera.settings["state"] == {"zoom": 120.0} and camera.settings["efl_mm"] == pytest.approx(120.0)
    assert "states" not in camera.settings["card"]
    low, high = loaded().axes[0].range
    assert OnnxCamera(loaded(), Shot(film, 10.0)).settings["state"] == {"zoom": low}
    assert OnnxCamera(loaded(), Shot(film, 10.0, zoom="200mm")).settings["state"] == {"zoom": high}
    assert OnnxCamera(loaded(), Shot(film, 10.0, zoom=80.0)).settings["state"] == {"zoom": low}
    square = np.random.default_rng(0).random((2, 500), np.float32)
    point = np.zeros((2, 500), np.float32)
    wavelength = np.full(500, 550, np.float32)
    assert (camera.sample(point, square, wavelength).weight > 0).mean() > 0.9
    # Through a small stop, rays of the film's centre meet where the camera is focused: 10 m from the film.
    rays = OnnxCamera(loaded(), Shot(film, 10.0, zoom=120.0, f_number=11)).sample(point, square, wavelength)
    t = (-10.0 - rays.origin_m[2]) / rays.direction[2]
    at = rays.origin_m[:2] + t * rays.direction[:2]
    assert np.abs(at[:, rays.weight > 0]).max() < 0.001
    for wrong in (60.0, "wide", 250.0):
        with pytest.raises(InputError, match="zoom"):
            OnnxCamera(loaded(), Shot(film, 10.0, zoom=wrong))  # type: ignore[arg-type]


def test_exposure_is_for_the_wavelengths_of_the_light() -> None:
    """White light of narrow range on the axis: the mean weight is 1 for that light, whatever range the model knows."""
    square = np.random.default_rng(0).random((2, 4000), np.float32)
    for nm in (420.0, 680.0):
        camera = OnnxCamera(loaded(), Shot((12, 8), 10.0, zoom=120.0, wavelength_nm=(nm, nm)))
        rays = camera.sample(np.zeros((2, 4000), np.float32), square, np.full(4000, nm, np.float32))
        assert rays.weight.mean() == pytest.approx(1.0, abs=2e-3)


def test_promises_are_checked_at_fresh_states(tmp_path: Path) -> None:
    lens_file = lens_models.LENSES / "nikon_zoom_80_200.toml"
    card = loaded().card
    space_again = space_of_card(card, loaded().axes, lens_file, exported())
    _, promises = check_states(loaded(), space_again, rays=1500, count=2)
    assert [p.key for p in promises] == ["rms_um"] and promises[0].holds
    too_good = load_model(export_states(model(), tmp_path / "boast.onnx", {"rms_um": 1e-3}))
    _, promises = check_states(too_good, space_again, rays=1500, count=2)
    assert not promises[0].holds
    with pytest.raises(InputError, match="sha256"):
        space_of_card(card, loaded().axes, lens_models.LENSES / "ogawa_zoom_70_200.toml", exported())


def test_lenses_with_cylinders_are_refused() -> None:
    lens = read_lens(lens_models.LENSES / "panavision_anamorphic_zoom_21.toml")
    with pytest.raises(InputError, match="cylinders"):
        fit_states(StateSpace(lens, (ZOOM,)))
