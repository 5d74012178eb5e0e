"""Ray-transfer functions, tables of rays, and cells of the light field: nodes, ellipses, who passes."""

import math
from functools import cache

import lens_models
import numpy as np
import pytest
import torch
from hypothesis import given, strategies as some
from torch import Tensor

from experiments.accuracy.published import PublishedSettings, fit_any
from experiments.accuracy.published.adaptive import Cells, fit_adaptive
from experiments.accuracy.published.data import RawData, RawPolynomial
from experiments.accuracy.published.neural import Layers
from experiments.accuracy.published.rtf import least_ellipse, meridian_variables, turn
from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.models.cores import LightField
from neurolens.models.fitted import FilmRays
from neurolens.models.model import LensModel
from neurolens.models.pairs import sample_domain, trace_pairs
from neurolens.studies.rays import ray_errors


@cache
def fitted() -> LensModel:
    return fit_any(lens_models.prepared(), PublishedSettings("rtf", degree=6))


def test_turning_is_a_rotation_onto_the_y_axis() -> None:
    generator = torch.Generator().manual_seed(0)
    p, u, w = (torch.randn(shape, generator=generator, dtype=torch.float64) for shape in ((2, 50), (2, 50), (50,)))
    p[:, 0] = 0  # on the axis
    variables, y = meridian_variables(LightField(p, u, w), 0.3)
    assert torch.allclose(torch.stack(turn(p, y)), torch.stack([torch.zeros(50).double(), p.norm(dim=0)]), atol=1e-14)
    assert torch.allclose(torch.hypot(*turn(u, y)), u.norm(dim=0))
    slopes = variables[1:3] / torch.sqrt(1 - variables[1] ** 2 - variables[2] ** 2)
    assert torch.allclose(slopes.norm(dim=0), 0.3 * u.norm(dim=0))


@given(some.floats(-3, 3), some.floats(0.2, 5), some.floats(0.2, 5), some.integers(0, 1000))
def test_least_ellipse_about_an_ellipse_is_that_ellipse(centre: float, rx: float, ry: float, seed: int) -> None:
    angle = np.linspace(0, 2 * math.pi, 60, endpoint=False) + seed
    inner = np.random.default_rng(seed).uniform(-0.5, 0.5, (20, 2)) * [rx, ry] + [0, centre]
    points = np.concatenate([np.stack([rx * np.cos(angle), centre + ry * np.sin(angle)], axis=1), inner])
    found = least_ellipse(points)
    assert found[0] == pytest.approx(rx, rel=0.01)
    assert found[1] == pytest.approx(ry, rel=0.01)
    assert found[2] == pytest.approx(centre, abs=0.01 * ry)


def test_least_ellipse_holds_all_points_and_no_smaller_one_near_by_does() -> None:
    points = np.random.default_rng(5).normal(size=(300, 2)) * [1.0, 2.0] + [0.0, 4.0]
    rx, ry, centre = least_ellipse(points)

    def reach(ratio: float, middle: float) -> float:
        """Area of the least ellipse of that ratio of radii and that centre."""
        return ratio * float(((points[:, 0] / ratio) ** 2 + (points[:, 1] - middle) ** 2).max())

    assert ((points[:, 0] / rx) ** 2 + ((points[:, 1] - centre) / ry) ** 2).max() <= 1 + 1e-9
    area = rx * ry
    for ratio in np.linspace(0.8, 1.25, 21) * rx / ry:
        for middle in centre + np.linspace(-0.3, 0.3, 21):
            assert reach(ratio, middle) > area * (1 - 2e-3)


def test_pass_function_holds_every_passing_ray_and_blocks_most_others() -> None:
    """The ellipse bounds the passing rays: hardly any of them is blocked; what it lets through is its known price."""
    model, pairs = fitted(), lens_models.prepared().pairs
    rays = trace_pairs(pairs.lens, sample_domain(pairs.domain, 20000, 3), pairs.domain.pupil_z_mm)
    passes, said = rays.status == st.PASSED, model.predict(rays.inputs).status == st.PASSED
    false_block = float((passes & ~said).sum() / passes.sum())
    false_pass = float((said & ~passes).sum() / said.sum())
    assert false_block < 0.01
    assert false_pass < 0.08


@pytest.mark.parametrize("turned", (0.0, 2.0))
def test_rays_of_nodes_are_exact(turned: float) -> None:
    model = fit_any(lens_models.prepared(), PublishedSettings("ray-lut", units=5))
    e, pairs = model.encoding, lens_models.prepared().pairs
    radius, across, along = (
        torch.tensor(v, dtype=torch.float64) for v in ((0.25, 0.5, 1.0), (0.5, -0.5, 0), (0.5, 0, 0))
    )
    film = torch.stack([0 * radius, radius * e.film_scale_mm])
    pupil = torch.stack([across, along]) * e.pupil_scale_mm + e.chief * film
    turn = torch.tensor([[np.cos(turned), -np.sin(turned)], [np.sin(turned), np.cos(turned)]], dtype=torch.float64)
    wavelength = 1000 / (e.w_middle + torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64) * e.w_half) ** 0.5
    rays = FilmRays(*(turn @ film), 0 * radius + e.film_plane_z_mm, *(turn @ pupil), wavelength)
    exact, found = trace_pairs(pairs.lens, rays, pairs.domain.pupil_z_mm), model.predict(rays)
    assert found.status.tolist() == [0, 0, 0] == exact.status.tolist()
    assert torch.allclose(torch.stack(list(found.rays)), torch.stack(list(exact.scene)), rtol=0, atol=1e-9)
    assert torch.allclose(found.transmittance, exact.transmittance, rtol=0, atol=1e-12)


def test_half_the_step_leaves_a_quarter_of_the_error() -> None:
    pairs = lens_models.prepared().pairs
    errors = [
        ray_errors(
            pairs.lens,
            pairs.domain,
            pairs.held_out,
            fit_any(lens_models.prepared(), PublishedSettings("ray-lut", units=n)).predict,
        ).rms_um
        for n in (9, 17)
    ]
    assert 3 < errors[0] / errors[1] < 5


def leaves(core: RawPolynomial | Cells) -> list[RawPolynomial]:
    return [leaf for half in core.parts for leaf in leaves(half)] if isinstance(core, Cells) else [core]


def rays_of(count: int = 400) -> LightField:
    generator = torch.Generator().manual_seed(1)
    p, u = (torch.rand((2, count), generator=generator, dtype=torch.float64) - 0.5 for _ in range(2))
    return LightField(p, u, torch.zeros(count, dtype=torch.float64))


def test_cells_give_each_ray_the_polynomial_of_its_cell() -> None:
    data = RawData.of(lens_models.prepared())
    core = fit_adaptive(data, 6, 3)
    assert isinstance(core, Cells)
    assert len(leaves(core)) == 3
    field = rays_of()

    def by_hand(node: RawPolynomial | Cells, at: Tensor) -> Tensor:
        one = LightField(field.p[:, at], field.u[:, at], field.w[at])
        if isinstance(node, RawPolynomial):
            return node(one)[0]
        above = float(one.invariants()[node.variable]) > node.threshold
        return by_hand(node.parts[int(above)], at)

    vectors, _ = core(field)
    for k in range(0, 400, 13):
        assert torch.allclose(vectors[..., k : k + 1], by_hand(core, torch.tensor([k])), atol=1e-13)


@pytest.mark.parametrize("method", ("zheng-adaptive", "neurolens2017"))
def test_more_cells_than_rays_allow_are_refused(method: str) -> None:
    settings = PublishedSettings(method, terms=4, partitions=64)
    with pytest.raises(InputError, match="partitions"):
        fit_any(lens_models.prepared(), settings)


def by_hand(layers: Layers, h: np.ndarray) -> np.ndarray:
    """[7, N] of one network."""
    for k, (weight, bias) in enumerate(layers):
        h = weight @ h + bias[:, None]
        h = h if k == len(layers) - 1 else np.maximum(h, 0)
    return h
