"""Polarised transmission against reference paths, closed forms (plates, Fresnel's rhomb), Jones calculus and fields."""

import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import tmm
import torch
from polarised_fields import Step, pass_surface, power, powers, transmittance, unpolarised
from torch import Tensor

from neurolens.optics.trace import transmission
from neurolens.optics.trace.films import Layers, coated_shares
from neurolens.optics.trace.transmission import Light, crossed, fresnel, turned

ROOT = Path(__file__).parents[3]
SHARED = ROOT.parent / "shared" / "data" / "oracle"
OWN = json.loads((ROOT / "tests" / "data" / "fresnel_paths.json").read_text())["lenses"]
WHOLE = ("full_double_gauss_n1691", "full_tessar", "full_even_asphere_50mm")
LAM_NM = 587.5618
FILMS: Layers = ((1.38, 100.0), (2.1, 120.0), (1.7, 80.0))


def fields_along(steps: list[Step]) -> tuple[Tensor, Tensor]:
    """Two orthogonal inputs of unit power before and after all steps, as real and imaginary parts, [2, 2, 3, N]."""
    entering = leaving = unpolarised(steps[0].before)
    for step in steps:
        leaving = pass_surface(leaving, step, LAM_NM)
    return entering, leaving


def dot(a: Any, b: Any) -> Any:
    return sum(p * q for p, q in zip(a, b, strict=True))


def polarised_transmittance(steps: list[Step]) -> Tensor:
    """By Stokes parameters."""
    light: Light | None = None
    last: Step | None = None
    for step in steps:
        signed = dot(step.normal, step.before)
        cos_i, cos_t = signed.abs(), dot(step.normal, step.after).abs()
        before, after = step.n_before, step.n_after
        shares = fresnel(before * cos_i, after * cos_t, after * cos_i + before * cos_t)
        if step.layers or step.reflected:
            shares = coated_shares(cos_i, before, after, step.layers, LAM_NM, step.sense, step.reflected)
        turn = None
        if last is not None:
            cosines = dot(last.normal, step.before) * signed
            turn = turned(last.normal, step.normal, cosines, crossed(step.before, last.normal, step.normal))
        light, last = transmission.pass_surface(light, turn, shares), step
    assert light is not None
    return light.power


def polarised_fields(steps: list[Step]) -> SimpleNamespace:
    entering, leaving = fields_along(steps)
    return SimpleNamespace(entering=entering[0], leaving=torch.complex(leaving[0], leaving[1]))


def normals(row: dict[str, Any], x: Tensor, y: Tensor) -> Tensor:
    """Unit normals [3, N] from the sag's own derivative."""
    x, y = x.clone().requires_grad_(), y.clone().requires_grad_()
    c, k, r2 = 1 / row["R"] if row["R"] else 0.0, row.get("k", 0.0), x * x + y * y
    sag = c * r2 / (1 + torch.sqrt(1 - (1 + k) * c * c * r2)) + 0 * r2
    for i, a in enumerate(row.get("even", ())):
        sag = sag + a * r2 ** (i + 1)
    dx, dy = torch.autograd.grad(sag.sum(), (x, y))
    n = torch.stack([-dx, -dy, torch.ones_like(dx)])
    return n / n.norm(dim=0)


def path_of(lens: dict[str, Any], dtype: torch.dtype = torch.float64) -> list[Step]:
    """Steps of all rays of a lens through its points and directions."""
    points = torch.tensor([r["points"] for r in lens["rays"]], dtype=torch.float64).permute(1, 2, 0)
    directions = torch.tensor([[r["direction"], *r["directions"]] for r in lens["rays"]], dtype=torch.float64)
    d = directions.permute(1, 2, 0).to(dtype)
    n = [1.0, *(row["n"] for row in lens["prescription"])]
    return [
        Step(tuple(normals(row, x, y).to(dtype)), tuple(d[k]), tuple(d[k + 1]), n[k], n[k + 1])
        for k, (row, (x, y, _)) in enumerate(zip(lens["prescription"], points, strict=True))
    ]


def column(lens: dict[str, Any], name: str) -> Tensor:
    return torch.tensor([r[name] for r in lens["rays"]], dtype=torch.float64)


def check(lens: dict[str, Any]) -> None:
    steps = path_of(lens)
    exact, product = column(lens, "exact"), column(lens, "product")
    torch.testing.assert_close(polarised_transmittance(steps), exact, rtol=0, atol=1e-13)
    single = polarised_transmittance(path_of(lens, torch.float32))
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), exact, rtol=0, atol=5e-6)
    averages = torch.ones_like(exact)
    for k, s in enumerate(steps):
        cos_i = sum(a * b for a, b in zip(s.normal, s.before, strict=True))
        averages = averages * transmittance(cos_i, s.n_before, s.n_after, (), LAM_NM)
        p = powers(cos_i, s.n_before, s.n_after, (), LAM_NM)
        torch.testing.assert_close(torch.stack([p.T_s, p.T_p], -1), column(lens, "s_p")[:, k], rtol=0, atol=1e-13)
    torch.testing.assert_close(averages, product, rtol=0, atol=1e-13)


@pytest.mark.parametrize("lens", OWN, ids=lambda lens: lens["name"])
def test_own_reference_paths(lens: dict[str, Any]):
    check(lens)


@pytest.mark.parametrize("name", WHOLE)
def test_reference_paths_of_the_whole_set(name: str):
    if not (SHARED / "fresnel_sequential.json").exists():
        pytest.skip("../shared/data/oracle is not here; a selection of it is tested above")
    data = json.loads((SHARED / f"{name}.json").read_text())
    paths = {r["label"]: r for r in data["rays"]}
    known = {"direction": "d", "exact": "T_unpolarised_exact", "product": "T_product_of_unpolarised_averages"}
    known["s_p"] = "T_per_surface_s_p"
    rays = [
        {ours: r[theirs] for ours, theirs in known.items()}
        | {"points": paths[r["label"]]["points"], "directions": paths[r["label"]]["dirs"]}
        for r in json.loads((SHARED / "fresnel_sequential.json").read_text())["rays"]
        if r["lens"] == name
    ]
    assert len(rays) > 40
    check({"prescription": data["prescription"], "rays": rays})


# Paths made by hand: N rays through surfaces of given normals.


def unit(*rows: tuple[float, float, float]) -> Tensor:
    t = torch.tensor(rows, dtype=torch.float64).T
    return t / t.norm(dim=0)


def bend(d: Tensor, normal: Tensor, mu: float) -> Tensor:
    """Snell's law; mu is n_before / n_after."""
    cos_i = (normal * d).sum(0)
    return mu * d + (torch.sqrt(1 - mu**2 * (1 - cos_i**2)) - mu * cos_i) * normal


def through(d: Tensor, *surfaces: tuple[Tensor, float, float, Layers]) -> list[Step]:
    """Steps through (normal along the light, n_before, n_after, layers)."""
    steps = []
    for normal, n_before, n_after, layers in surfaces:
        after = bend(d, normal, n_before / n_after)
        steps.append(Step(tuple(normal), tuple(d), tuple(after), n_before, n_after, layers))
        d = after
    return steps


def plate(d: Tensor, normal: Tensor, n: float, layers: Layers = ()) -> list[Step]:
    return through(d, (normal, 1.0, n, layers), (normal, n, 1.0, layers[::-1]))


AXIS = unit((0, 0, 1))
TILTED_X = unit((math.sin(1.0), 0, math.cos(1.0)))
TILTED_Y = unit((0, math.sin(1.0), math.cos(1.0)))


@pytest.mark.parametrize("films", [(), FILMS], ids=["bare", "coated"])
def test_parallel_and_crossed_tilted_plates(films: Layers):
    """Each plate has Ts^2 or Tp^2 for light of one polarisation; what is s for one is p for the crossed other."""
    p = powers(TILTED_X[2], 1.0, 1.6, films, LAM_NM)
    parallel = [*plate(AXIS, TILTED_X, 1.6, films), *plate(AXIS, TILTED_X, 1.6, films)]
    crossed = [*plate(AXIS, TILTED_X, 1.6, films), *plate(AXIS, TILTED_Y, 1.6, films)]
    exact = polarised_transmittance(parallel), polarised_transmittance(crossed)
    torch.testing.assert_close(exact[0], (p.T_s**4 + p.T_p**4) / 2, rtol=0, atol=1e-14)
    torch.testing.assert_close(exact[1], (p.T_s * p.T_p) ** 2, rtol=0, atol=1e-14)


def test_normal_incidence_needs_no_plane_of_incidence():
    """Any direction in space, exactly along the normal or within rounding of it; slopes stay finite."""
    g = torch.Generator().manual_seed(0)
    normal = torch.nn.functional.normalize(torch.randn((3, 300), generator=g, dtype=torch.float64), dim=0)
    normal[:, :3] = torch.eye(3, dtype=torch.float64)
    offset = torch.randn((3, 300), generator=g, dtype=torch.float64) * torch.logspace(-17, -6, 300)
    offset[:, :50] = 0
    d = torch.nn.functional.normalize(normal + offset, dim=0).requires_grad_()
    n = normal.clone().requires_grad_()
    steps = through(d, (n, 1.0, 1.6, FILMS), (n, 1.6, 1.2, ()))
    t = polarised_transmittance(steps)
    one = torch.ones(300, dtype=torch.float64)
    expected = transmittance(one, 1.0, 1.6, FILMS, LAM_NM) * transmittance(one, 1.6, 1.2, (), LAM_NM)
    torch.testing.assert_close(t, expected, rtol=0, atol=1e-11)
    t.sum().backward()
    assert torch.isfinite(d.grad).all() and torch.isfinite(n.grad).all()


def skew_path(count: int = 40, films: Layers = FILMS) -> list[Step]:
    """Three surfaces tilted differently, the light to the film (+z)."""
    g = torch.Generator().manual_seed(1)

    def tilted() -> Tensor:
        t = 0.7 * (torch.rand((3, count), generator=g, dtype=torch.float64) - 0.5)
        t[2] = 1.0
        return torch.nn.functional.normalize(t, dim=0)

    d = tilted()
    return through(d, (tilted(), 1.0, 1.7, films), (tilted(), 1.7, 1.5, ((2.3, 70.0),)), (tilted(), 1.5, 1.0, films))


def test_skew_coated_path_equals_jones_calculus_with_tmm():
    """Two-by-two matrices of tmm's amplitudes, and a rotation by the angle between planes of incidence, ray by ray."""
    steps = skew_path(count=6)
    ours = polarised_transmittance(steps)
    for ray in range(6):
        jones = torch.eye(2, dtype=torch.complex128)
        s_last = None
        for step in steps:
            normal, before, after = (torch.stack([c[ray] for c in v]) for v in step[:3])
            s = torch.linalg.cross(before, normal)
            s = s / s.norm()
            if s_last is not None:
                p_last = torch.linalg.cross(before, s_last)
                cos, sin = (s @ s_last).item(), (s @ p_last).item()
                jones = torch.tensor([[cos, sin], [-sin, cos]], dtype=torch.complex128) @ jones
            cos_i, cos_t = (normal @ before).item(), (normal @ after).item()
            stack = [step.n_before, *(n for n, _ in step.layers), step.n_after]
            thick = [math.inf, *(t for _, t in step.layers), math.inf]
            power = step.n_after * cos_t / (step.n_before * cos_i)
            a = [tmm.coh_tmm(pol, stack, thick, math.acos(cos_i), LAM_NM)["t"] * math.sqrt(power) for pol in "sp"]
            jones = torch.diag(torch.tensor(a, dtype=torch.complex128)) @ jones
            s_last = s
        assert ours[ray].item() == pytest.approx(0.5 * (jones.abs() ** 2).sum().item(), abs=1e-12)


def test_turning_the_whole_path_changes_nothing():
    g = torch.Generator().manual_seed(4)
    steps, turn = skew_path(), torch.linalg.qr(torch.randn((3, 3), generator=g, dtype=torch.float64))[0]
    turned = [s._replace(**{f: tuple(turn @ torch.stack(getattr(s, f))) for f in s._fields[:3]}) for s in steps]
    flipped = [s._replace(normal=tuple(-c for c in s.normal)) for s in steps]
    expected = polarised_transmittance(steps)
    for other in (turned, flipped):
        torch.testing.assert_close(polarised_transmittance(other), expected, rtol=0, atol=1e-13)


def test_a_camera_ray_carries_as_much_as_the_light_it_stands_for():
    """Reciprocity: the path backwards, its films met in the other order."""
    steps = skew_path()
    back = [
        Step(s.normal, tuple(-c for c in s.after), tuple(-c for c in s.before), s.n_after, s.n_before, s.layers, -1)
        for s in reversed(steps)
    ]
    expected = polarised_transmittance(steps)
    torch.testing.assert_close(polarised_transmittance(back), expected, rtol=0, atol=1e-13)


def test_fields_stay_across_the_direction_and_carry_the_power():
    steps = skew_path()
    fields = polarised_fields(steps)
    first, last = torch.stack(list(steps[0].before)), torch.stack(list(steps[-1].after))
    assert (fields.entering * first).sum(1).abs().max() < 1e-14
    torch.testing.assert_close(torch.linalg.cross(fields.entering[0], fields.entering[1], dim=0), first)
    assert (fields.leaving * last).sum(1).abs().max() < 1e-14
    power = 0.5 * (fields.leaving.abs() ** 2).sum((0, 1))
    torch.testing.assert_close(power, polarised_transmittance(steps), rtol=0, atol=1e-14)


@pytest.mark.parametrize("dtype, off", [(torch.float64, 1e-13), (torch.float32, 2e-6)], ids=["float64", "float32"])
def test_light_reflected_totally_and_in_part_equals_fields(dtype: torch.dtype, off: float):
    """Into glass, around in it by two reflections of skew planes of incidence (the first total), and out of it."""
    steps = skew_path(200)[:1]
    d = torch.stack(list(steps[0].after))
    for near, n, films in ((0.0, (0.9, 0.1, 0.4), ()), (2.0, (-0.3, 0.5, -0.9), FILMS)):
        normal = torch.nn.functional.normalize(near * d + unit(n), dim=0)
        bounced = d - 2 * (d * normal).sum(0) * normal
        steps.append(Step(tuple(normal), tuple(d), tuple(bounced), 1.7, 1.0, films, reflected=True))
        d = bounced
    normal = torch.nn.functional.normalize(d + 0.2 * unit((1, -1, 0.5)), dim=0)
    steps += through(d, (normal, 1.7, 1.0, FILMS))
    steps = [s._replace(**{f: tuple(c.to(dtype) for c in getattr(s, f)) for f in s._fields[:3]}) for s in steps]
    found, wanted = polarised_transmittance(steps), power(fields_along(steps)[1])
    assert found.dtype == dtype and 1e-3 < float(wanted.min()) and float(wanted.max()) < 0.5
    torch.testing.assert_close(found, wanted, rtol=0, atol=off)
    # The light is elliptic on the way: without its circular part it would come out otherwise.
    assert fields_along(steps[:2])[1][1].abs().max() > 0.1


def test_single_ray_gradients_equal_finite_differences():
    g = torch.Generator().manual_seed(2)
    parts = torch.rand((4, 3, 1), generator=g, dtype=torch.float64) * 0.3
    parts[:, 2] = 1.0
    parts.requires_grad_()

    def power(parts: Tensor) -> Tensor:
        d, *n = torch.nn.functional.normalize(parts, dim=1)
        return polarised_transmittance(
            through(d, (n[0], 1.0, 1.7, FILMS), (n[1], 1.7, 1.5, ()), (n[2], 1.5, 1.0, FILMS))
        )

    assert torch.autograd.gradcheck(power, (parts,))


def test_fresnels_rhomb_turns_linear_into_circular_light():
    """Two total reflections, tan(delta / 2) = cos sqrt(sin^2 - 1 / n^2) / sin^2 each (Born and Wolf, 1.5.4)."""
    n, slope = 1.51, math.tan(math.pi / 8)
    # An eighth of a wave at each: a quadratic equation in sin^2.
    a, b, c = 1 + slope**2, -(1 + n**-2), n**-2
    angle = math.asin(math.sqrt((-b + math.sqrt(b * b - 4 * a * c)) / (2 * a)))
    assert math.degrees(angle) == pytest.approx(54 + 37 / 60, abs=0.01)
    normal = unit((math.sin(angle), 0, math.cos(angle)))
    bounced = AXIS - 2 * (AXIS * normal).sum(0) * normal
    steps = [
        Step(tuple(normal), tuple(AXIS), tuple(bounced), n, 1.0, reflected=True),
        Step(tuple(-normal), tuple(bounced), tuple(AXIS), n, 1.0, reflected=True),
    ]
    torch.testing.assert_close(polarised_transmittance(steps), torch.ones(1, dtype=torch.float64))
    fields = polarised_fields(steps)
    diagonal = torch.tensor([math.sqrt(0.5), math.sqrt(0.5), 0], dtype=torch.float64)
    share = (fields.entering[:, :, 0] * diagonal).sum(1)
    x, y, z = (share[:, None] * fields.leaving[:, :, 0]).sum(0)
    assert abs(x) == pytest.approx(abs(y).item()) and abs(z) < 1e-15
    assert (x / y).real.item() == pytest.approx(0, abs=1e-12)


def test_total_reflection_transmits_nothing():
    d = unit((math.sin(0.9), 0, math.cos(0.9)))
    steps = [
        Step(tuple(AXIS), tuple(d), tuple(AXIS), 1.5, 1.0, FILMS),
        Step(tuple(AXIS), tuple(AXIS), tuple(AXIS), 1, 1.5),
    ]
    assert polarised_transmittance(steps).item() == 0
