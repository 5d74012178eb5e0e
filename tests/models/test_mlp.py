"""Networks: accuracy on a simple lens, exact symmetry, repeatability, and the optimiser against autograd."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from shipped import whole

from neurolens.base.status import OUTSIDE_DOMAIN
from neurolens.cameras.model import load_model
from neurolens.models import network as networks
from neurolens.models.cores import DIRECTION, POSITION, STOP, LightField, Network, Residual
from neurolens.models.export import export_onnx
from neurolens.models.model import LensModel
from neurolens.models.network import fit_network, with_boundary_terms
from neurolens.models.pairs import PairSettings, domain_of, make_pairs, sample_domain, trace_pairs
from neurolens.models.projection import (
    OptimiserState,
    Problem,
    activations,
    minimise,
    normal_equations,
    project,
)
from neurolens.models.targets import (
    ModelSettings,
    Prepared,
    choose_gates,
    film_equivalent_weights,
    fit_encoding,
    scales_of,
    targets_of,
    with_angle,
)
from neurolens.optics.readers.lensfile import read_lens
from neurolens.studies.measure import onnx_predictor

LENSES = Path(__file__).parents[2] / "lenses"
F64 = torch.float64


def _setup(name, **kwargs):
    lens = read_lens(LENSES / name)
    pairs = make_pairs(lens, domain_of(lens, **kwargs), PairSettings(train=2000, held_out=2000, rim=2000))
    gates = choose_gates(lens, pairs.rim.select(pairs.rim.status != 0))
    return Prepared(pairs, fit_encoding(pairs.domain, pairs.train), gates)


def fit(data, *, checkpoint=None, progress=lambda share: None, **numbers):
    return fit_network(data, ModelSettings("mlp", **numbers), checkpoint=checkpoint, progress=progress)


@pytest.fixture(scope="module")
def singlet():
    return _setup("thorlabs_lb1471_biconvex_50.toml", film_radius_mm=12.0, focus_m=(math.inf, 1.0))


@pytest.fixture(scope="module")
def network(singlet):
    return fit(singlet, units=8, steps=25, seed=3)


@pytest.mark.parametrize("dtype", [F64, torch.float32])
def test_held_out_rays_of_a_singlet(singlet, network, dtype):
    pairs, encoding = singlet.pairs, singlet.encoding
    targets = targets_of(pairs.lens, encoding, pairs.held_out)
    vectors, _ = network(LightField(*(c.to(dtype) for c in targets.field)))
    error = (vectors.to(F64) - targets.vectors).norm(dim=1).square().mean(1).sqrt()
    position_um, direction_um = film_equivalent_weights(pairs.lens, pairs.domain)
    assert math.hypot(error[POSITION] * position_um, error[DIRECTION] * direction_um) < 1.0
    assert error[STOP] * pairs.lens.stop_radius_mm < 5e-3


def test_rims_and_stop_block_what_the_exact_lens_blocks(singlet, network):
    pairs = singlet.pairs
    rays = sample_domain(pairs.domain, 50000, seed=77)
    exact = trace_pairs(pairs.lens, rays, pairs.domain.pupil_z_mm, power=False).status == 0
    passed = _model(singlet, network).predict(rays).status == 0
    assert (passed & ~exact).sum() < 0.003 * passed.sum()
    assert (exact & ~passed).sum() < 0.003 * exact.sum()


def test_terms_for_the_boundaries_change_only_what_clips_rays(singlet):
    """Checked against exact tracing: fewer rays are passed or blocked wrongly, and no ray goes elsewhere."""
    network = fit(singlet, units=6, steps=25, seed=3)  # which leaves the boundaries something to do
    core = with_boundary_terms(singlet, network)
    assert isinstance(core, Residual)
    rays = sample_domain(singlet.pairs.domain, 50000, seed=77)
    field = singlet.encoding(rays)
    for before, after, same in zip(network(field), core(field), ([POSITION, DIRECTION], [0]), strict=True):
        torch.testing.assert_close(before[same], after[same], rtol=0, atol=1e-13)
    exact = trace_pairs(singlet.pairs.lens, rays, singlet.pairs.domain.pupil_z_mm, power=False).status == 0
    wrong = [int((_model(singlet, c).predict(rays).status == 0).logical_xor(exact).sum()) for c in (network, core)]
    assert wrong[1] < 0.8 * wrong[0]
    again = with_boundary_terms(singlet, core.parts[1])  # from the hidden layers alone, as files hold them
    assert torch.equal(again(field)[1], core(field)[1])


def test_directions_that_no_ray_of_the_lens_has_lie_outside_the_domain(singlet, network, tmp_path):
    weight, bias = (a.copy() for a in network.output)
    for rows in (weight, bias):
        rows[2 * DIRECTION : 2 * STOP] *= 1.5
    wild = _model(singlet, replace(network, output=(weight, bias)))
    rays = sample_domain(singlet.pairs.domain, 20000, seed=78)
    good, found = _model(singlet, network).predict(rays), wild.predict(rays)
    angle = wild.core(wild.encoding(rays))[0][DIRECTION].norm(dim=0)
    limit = math.acos(-float(singlet.pairs.train.scene.dz.max()))  # of the exact lens
    assert (angle[found.status == 0] < 1.1 * limit).all() and (angle[good.status == 0] > 1.2 * limit).any()
    beyond = (good.status == 0) & (angle > 1.1 * limit)
    assert (found.status[beyond] == OUTSIDE_DOMAIN).all()
    assert torch.equal(found.status[good.status > 0], good.status[good.status > 0])  # rims and stop say what they said
    written = onnx_predictor(load_model(export_onnx(wild, tmp_path / "wild.onnx")))(rays)
    assert (written.status != found.status).sum() < 10  # rounding to float32


def _model(data, core) -> LensModel:
    pairs, scales = data.pairs, scales_of(data.pairs.lens)
    return with_angle(LensModel(pairs.lens, pairs.domain, data.encoding, scales, data.gates, core, "mlp"))


def _weights(network: Network) -> torch.Tensor:
    return torch.cat([torch.from_numpy(t).reshape(-1) for pair in (*network.hidden, network.output) for t in pair])


def test_the_seed_decides_every_bit_on_any_number_of_threads(singlet):
    threads = torch.get_num_threads()
    first = _weights(fit(singlet, units=4, steps=6, seed=5))
    try:
        torch.set_num_threads(2)
        assert torch.equal(first, _weights(fit(singlet, units=4, steps=6, seed=5)))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    assert not torch.equal(first, _weights(fit(singlet, units=4, steps=6, seed=6)))


def test_a_lens_without_dispersion_ignores_the_wavelength():
    data = _setup("muller_fisheye_100.toml")
    pairs, encoding = data.pairs, data.encoding
    network = fit(data, units=6, layers=1, steps=20)
    assert (network.hidden[0][0][:, 3] == 0).all()
    targets = targets_of(pairs.lens, encoding, pairs.held_out)
    error = (network(targets.field)[0] - targets.vectors)[DIRECTION].norm(dim=0)
    assert torch.rad2deg(error.square().mean().sqrt()) < 0.05


def _random_problem(rays: int = 60) -> Problem:
    g = torch.Generator().manual_seed(4)
    normal = lambda *shape: torch.randn(shape, generator=g, dtype=F64)  # noqa: E731
    return Problem(
        normal(rays, 4),
        normal(1, 2, rays),
        normal(1, 2, rays),
        normal(3, 2, rays),
        normal(3, rays).abs(),
        normal(2, rays),
        normal(2, rays).abs(),
    )


def _random_hidden(depth: int) -> list[torch.Tensor]:
    g = torch.Generator().manual_seed(9)
    widths = [4, 3, 4, 3][: depth + 1]
    return [0.5 * torch.randn((b, a + 1), generator=g, dtype=F64) for a, b in zip(widths[:-1], widths[1:], strict=True)]


def _residuals(problem: Problem, hidden: list[torch.Tensor], output: torch.Tensor) -> torch.Tensor:
    y = (activations(hidden, problem.inputs)[-1] @ output.T).T
    ab = y[:6].reshape(3, 2, 1, -1)
    vectors = (ab[:, 0] * problem.p + ab[:, 1] * problem.u - problem.vectors) * problem.vector_weights[:, None]
    return torch.cat([vectors.reshape(-1), ((y[6:] - problem.scalars) * problem.scalar_weights).reshape(-1)])


@pytest.mark.parametrize("depth", [1, 2, 3])
def test_normal_equations_are_those_of_the_jacobian_with_the_last_layer_eliminated(depth):
    problem = _random_problem()
    at = project(problem, _random_hidden(depth))
    sizes = [w.numel() for w in (*at.hidden, at.output)]

    def flat(v: torch.Tensor) -> torch.Tensor:
        parts = [t.reshape(w.shape) for t, w in zip(v.split(sizes), (*at.hidden, at.output), strict=True)]
        return _residuals(problem, parts[:-1], parts[-1])

    point = torch.cat([w.reshape(-1) for w in (*at.hidden, at.output)])
    jacobian = torch.func.jacrev(flat)(point)
    left, right = jacobian[:, : -sizes[-1]], jacobian[:, -sizes[-1] :]
    rest = left - right @ torch.linalg.lstsq(right, left).solution
    matrix, gradient, diagonal = normal_equations(problem, at)
    assert torch.allclose(matrix, rest.T @ rest, rtol=1e-6, atol=1e-6 * float(diagonal.max()))
    assert torch.allclose(gradient, left.T @ flat(point), rtol=1e-6, atol=1e-9 * float(diagonal.max()))
    assert torch.allclose(diagonal, left.square().sum(0), rtol=1e-9)
    assert at.loss * len(problem) == pytest.approx(float(flat(point).square().sum()), rel=1e-4)


def test_a_network_that_made_the_data_is_found_again():
    problem = _random_problem(400)
    truth = _random_hidden(1)
    y = (
        activations(truth, problem.inputs)[-1]
        @ torch.randn(8, 4, generator=torch.Generator().manual_seed(2), dtype=F64).T
    ).T
    vectors = y[:6].reshape(3, 2, 1, -1)[:, 0] * problem.p + y[:6].reshape(3, 2, 1, -1)[:, 1] * problem.u
    weights = problem.vector_weights, problem.scalar_weights
    made = Problem(problem.inputs, problem.p, problem.u, vectors, weights[0], y[6:], weights[1])
    start = [w + 0.2 * torch.ones_like(w) for w in truth]
    assert project(made, truth).loss < 1e-10
    assert minimise(made, OptimiserState(start), 40)[0].loss < 1e-8


class _Killed(Exception):
    pass


def _kill_after(calls: int):
    count = 0

    def progress(share: float) -> None:
        nonlocal count
        count += 1
        if count > calls:
            raise _Killed

    return progress


@pytest.mark.parametrize("calls", [15, 44])
def test_a_training_killed_anywhere_ends_with_the_very_same_weights(singlet, tmp_path, monkeypatch, calls):
    monkeypatch.setattr(networks, "EVERY_S", 0.0)
    monkeypatch.setattr(networks, "FEWEST_RAYS", 500)
    settings = {"units": 4, "steps": 60, "seed": 5}
    file, steps, again = tmp_path / "training.npz", list[float](), list[float]()
    whole = _weights(fit(singlet, **settings, progress=again.append))
    with pytest.raises(_Killed):
        fit(singlet, **settings, checkpoint=file, progress=_kill_after(calls))
    assert calls <= 10 or file.exists()
    resumed = fit(singlet, **settings, checkpoint=file, progress=steps.append)
    assert torch.equal(whole, _weights(resumed))
    # It went on from its last checkpoint; what is left is less than the whole by most of what was done.
    assert len(steps) <= len(again) - calls + 10
    assert [f.name for f in tmp_path.iterdir()] == ["training.npz"]


@pytest.mark.parametrize(
    "damage", [lambda b: b[: len(b) // 2], "other seed", *whole(lambda b: b"", lambda b: b"no zip at all")]
)
def test_a_checkpoint_that_is_damaged_or_of_another_fit_is_replaced(singlet, tmp_path, damage):
    file = tmp_path / "training.npz"
    settings = {"units": 4, "steps": 6, "seed": 5}
    fit(singlet, **(settings | {"seed": 6} if damage == "other seed" else settings), checkpoint=file)
    if damage != "other seed":
        file.write_bytes(damage(file.read_bytes()))
    weights = _weights(fit(singlet, **settings, checkpoint=file))
    assert torch.equal(weights, _weights(fit(singlet, **settings)))
