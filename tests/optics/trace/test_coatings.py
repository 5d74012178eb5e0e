"""Thin films against the package tmm, closed forms and conservation of energy; designs against what they promise."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import tmm
import torch
from polarised_fields import powers, transmittance
from torch import Tensor

from neurolens.base.errors import InputError
from neurolens.optics.lens import designs
from neurolens.optics.lens.glass import index_at
from neurolens.optics.lens.prescription import Coating, Lens, Surface
from neurolens.optics.trace.films import Layers, power_amplitudes, reflectance

LAM_NM = 550.0
FROM_AIR, FROM_GLASS = (1.0, 1.52), (1.52, 1.0)
STACKS: dict[str, Layers] = {
    "bare": (),
    "quarter-wave": ((1.38, 99.6),),
    "broadband": ((1.38, 99.6), (2.1, 131.0), (1.7, 80.9)),
    "air gap": ((1.0, 60.0),),
    "mirror": ((2.3, 60.0), (1.46, 94.0)) * 6,
    "thick": ((1.46, 5000.0), (2.1, 3.0)),
}
MEDIA = {"from air": FROM_AIR, "from glass": FROM_GLASS, "cemented": (1.62, 1.75), "to rarer glass": (1.9, 1.5)}


def cosines(*degrees: float, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.tensor([math.cos(math.radians(d)) for d in degrees], dtype=dtype)


def amplitudes(*arguments: Any) -> dict[str, Tensor]:
    """Complex amplitudes by name, those of transmission scaled to power."""
    pairs = zip("tr", (power_amplitudes(*arguments, reflected=reflected) for reflected in (False, True)), strict=True)
    return {f"{name}_{pol}": torch.complex(*part) for name, pair in pairs for pol, part in zip("sp", pair, strict=True)}


NORMAL = cosines(0.0)
FAN_DEG = (0.0, 1e-4, 20.0, 41.0, 42.0, 56.6, 75.0, 89.0)


@pytest.mark.parametrize("media", MEDIA.values(), ids=MEDIA)
@pytest.mark.parametrize("stack", STACKS.values(), ids=STACKS)
@pytest.mark.parametrize("sense", [1, -1])
@pytest.mark.parametrize("lam_nm", [400.0, 700.0])
def test_amplitudes_and_powers_agree_with_tmm(media: tuple[float, float], stack: Layers, sense: int, lam_nm: float):
    cos_i = cosines(*FAN_DEG)
    ours, power = amplitudes(cos_i, *media, stack, lam_nm, sense), powers(cos_i, *media, stack, lam_nm, sense)
    met = stack if sense > 0 else stack[::-1]
    indices = [media[0], *(n for n, _ in met), media[1]]
    thicknesses = [np.inf, *(d for _, d in met), np.inf]
    for k, degrees in enumerate(FAN_DEG):
        cos2_t = 1 - (media[0] / media[1] * math.sin(math.radians(degrees))) ** 2
        power_scale = math.sqrt(media[1] * math.sqrt(max(cos2_t, 0)) / (media[0] * math.cos(math.radians(degrees))))
        for pol in "sp":
            theirs: dict[str, Any] = tmm.coh_tmm(pol, indices, thicknesses, math.radians(degrees), lam_nm)
            t = theirs["t"] * power_scale
            assert abs(ours[f"r_{pol}"][k].item() - theirs["r"]) < 1e-12
            assert abs(ours[f"t_{pol}"][k].item() - t) < 1e-12
            assert abs(getattr(power, f"R_{pol}")[k].item() - theirs["R"]) < 1e-12
            assert abs(getattr(power, f"T_{pol}")[k].item() - theirs["T"]) < 1e-12


def random_stacks(count: int, rays: int, dtype: torch.dtype = torch.float64) -> list[tuple[Any, ...]]:
    """Arguments of `powers`: random angles, media and wavelengths of every ray, random films."""
    rng = np.random.default_rng(3)

    def column(low: float, high: float) -> Tensor:
        return torch.tensor(rng.uniform(low, high, rays), dtype=dtype)

    return [
        (
            *(column(0, 1), column(1, 2.2), column(1, 2.2)),
            tuple((rng.uniform(1, 2.5), rng.uniform(0, 600)) for _ in range(k % 7)),
            *(column(380, 780), 1 if k % 2 else -1),
        )
        for k in range(count)
    ]


def test_energy_is_conserved():
    for arguments in random_stacks(count=20, rays=500):
        p = powers(*arguments)
        for t, r in ((p.T_s, p.R_s), (p.T_p, p.R_p), (transmittance(*arguments), reflectance(*arguments))):
            assert (t + r - 1).abs().max() < 1e-12
            assert t.min() >= 0 and r.min() >= 0


def test_a_film_split_in_two_and_a_film_of_the_glass_itself_change_nothing():
    cos_i = cosines(0, 30, 60, 85)
    whole = amplitudes(cos_i, 1.0, 1.52, ((2.1, 131.0),), LAM_NM)
    split = amplitudes(cos_i, 1.0, 1.52, ((2.1, 100.0), (2.1, 31.0)), LAM_NM)
    for name, a in whole.items():
        torch.testing.assert_close(a, split[name], rtol=0, atol=1e-14)
    bare, film = (transmittance(cos_i, 1.0, 1.52, s, LAM_NM) for s in ((), ((1.52, 300.0),)))
    torch.testing.assert_close(bare, film, rtol=0, atol=1e-14)


def test_total_reflection_passes_nothing_and_stays_finite():
    cos_i = cosines(41.2, 60, 89.99, 90)
    for dtype in (torch.float32, torch.float64):
        for stack in STACKS.values():
            p = powers(cos_i.to(dtype), *FROM_GLASS, stack, LAM_NM)
            assert (p.T_s == 0).all() and (p.T_p == 0).all()
            for power in (p.R_s, p.R_p):
                torch.testing.assert_close(power, torch.ones_like(power), rtol=0, atol=8 * torch.finfo(dtype).eps)
            a = amplitudes(cos_i.to(dtype), *FROM_GLASS, stack, LAM_NM)
            for name in ("r_s", "r_p"):
                torch.testing.assert_close(a[name].abs(), torch.ones_like(a[name].abs()))
            assert all(torch.isfinite(torch.view_as_real(v)).all() for v in a.values())


def test_frustrated_total_reflection_by_an_air_gap():
    """Closed form for two equal glasses, s polarisation: 1 / T = 1 + (q^2 + k^2)^2 sinh^2 / (4 q^2 k^2)."""
    n, gap_nm, sine = 1.52, 200.0, math.sin(math.radians(60))
    q, k = n * math.sqrt(1 - sine**2), math.sqrt((n * sine) ** 2 - 1)
    sinh = math.sinh(2 * math.pi / LAM_NM * k * gap_nm)
    expected = 1 / (1 + (q * q + k * k) ** 2 * sinh**2 / (4 * q * q * k * k))
    p = powers(cosines(60), n, n, ((1.0, gap_nm),), LAM_NM)
    assert p.T_s.item() == pytest.approx(expected, rel=1e-12)
    assert p.R_s.item() == pytest.approx(1 - expected, rel=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_wide_gap_reflects_everything_without_overflow(dtype: torch.dtype):
    cos_i = cosines(50, 60, 89, dtype=dtype).requires_grad_()
    p = powers(cos_i, 1.52, 1.52, ((1.0, 1e6),), LAM_NM)
    assert (p.T_s == 0).all() and (p.T_p == 0).all()
    torch.testing.assert_close(p.R_s, torch.ones_like(p.R_s))
    torch.testing.assert_close(p.R_p, torch.ones_like(p.R_p))
    (p.T_s + p.R_p).sum().backward()
    assert torch.isfinite(cos_i.grad).all()


def test_grazing_light_is_reflected():
    for dtype in (torch.float32, torch.float64):
        for media in ((1.0, 1.5), (1.5, 1.0), (1.5, 1.5)):
            for stack in STACKS.values():
                cos_i = torch.tensor([0.0, 1e-30, 1e-12], dtype=dtype)
                p = powers(cos_i, *media, stack, LAM_NM)
                assert all(torch.isfinite(v).all() for v in p)
                assert p.T_s[0] == 0 and p.T_p[0] == 0
                rounding = 4 * torch.finfo(dtype).eps
                assert p.R_s[0] == pytest.approx(1, abs=rounding) and p.R_p[0] == pytest.approx(1, abs=rounding)
                a = amplitudes(cos_i, *media, stack, LAM_NM)
                assert all(torch.isfinite(torch.view_as_real(v)).all() for v in a.values())
                assert a["r_s"][0].abs() == pytest.approx(1) and a["r_p"][0].abs() == pytest.approx(1)


def test_what_is_no_number_passes_nothing():
    nan = torch.tensor([math.nan], dtype=torch.float64)
    for cos_i, n, lam in ((nan, 1.5, LAM_NM), (NORMAL, nan, LAM_NM), (NORMAL, 1.5, nan)):
        p = powers(cos_i, 1.0, n, STACKS["broadband"], lam)
        assert p.T_s.item() == 0 and p.T_p.item() == 0 and p.R_s.item() == 1 and p.R_p.item() == 1


def test_float32_is_good_to_a_millionth():
    for arguments in random_stacks(count=14, rays=500):
        single = tuple(a.float() if isinstance(a, Tensor) else a for a in arguments)
        t64, t32 = transmittance(*arguments), transmittance(*single)
        assert t32.dtype == torch.float32
        # Close to the critical angle the slope of T is infinite.
        cos_i, before, after = arguments[:3]
        away = ((before * cos_i) ** 2 + after**2 - before**2).abs() > 1e-2
        assert (t32 - t64).abs()[away].max() < 1e-5


@pytest.mark.parametrize("stack", STACKS.values(), ids=STACKS)
def test_gradients_equal_finite_differences(stack: Layers):
    """In angle, media, films and wavelength; through normal incidence and evanescent films as well."""
    cos_i = cosines(0, 1e-3, 25, 38, 55, 70).requires_grad_()
    media = [torch.tensor(n, dtype=torch.float64, requires_grad=True) for n in (1.62, 1.75)]
    films = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for layer in stack[:3] for v in layer]
    lam = torch.tensor(LAM_NM, dtype=torch.float64, requires_grad=True)

    def power(cos_i: Tensor, before: Tensor, after: Tensor, lam: Tensor, *films: Tensor) -> tuple[Tensor, ...]:
        layers = tuple(zip(films[::2], films[1::2], strict=True))
        p = powers(cos_i, before, after, layers, lam)
        return p.T_s, p.T_p, p.R_s, p.R_p

    assert torch.autograd.gradcheck(power, (cos_i, *media, lam, *films), eps=1e-7, atol=1e-6)


def test_no_kink_where_a_film_turns_evanescent():
    """Power and slope on both sides of the angle where light runs along an air film."""
    cos_c = math.sqrt(1 - 1 / 1.52**2)
    cos_i = torch.tensor([cos_c + d for d in (-1e-7, 0.0, 1e-7)], dtype=torch.float64, requires_grad=True)
    t = transmittance(cos_i, 1.52, 1.52, ((1.0, 60.0),), LAM_NM)
    t.sum().backward()
    assert (t[2] - t[0]).item() == pytest.approx(2e-7 * cos_i.grad[1].item(), rel=1e-5)
    assert cos_i.grad[0].item() == pytest.approx(cos_i.grad[2].item(), rel=1e-4)


# Designs


def normal_reflectance(coating: Any, n_before: float, n_after: float, lam_nm: float = LAM_NM) -> float:
    return reflectance(NORMAL, n_before, n_after, coating.layers, lam_nm).item()


@pytest.mark.parametrize("glass", [1.46, 1.52, 1.7, 1.904, 2.0])
def test_quarter_wave_closed_form(glass: float):
    coating = designs.design("quarter-wave 600", 1.0, glass)
    expected = ((glass - 1.38**2) / (glass + 1.38**2)) ** 2
    assert normal_reflectance(coating, 1.0, glass, 600.0) == pytest.approx(expected, abs=1e-15)
    assert normal_reflectance(coating, glass, 1.0, 600.0) == pytest.approx(expected, abs=1e-15)
    assert coating.layers[0][0] * coating.layers[0][1] == pytest.approx(150.0)


@pytest.mark.parametrize("glass", [1.35, 1.46, 1.52, 1.7, 1.85, 1.9, 1.95, 2.1])
@pytest.mark.parametrize("at_nm", [450.0, 550.0])
def test_v_coat_reflects_nothing_at_its_wavelength_from_either_side(glass: float, at_nm: float):
    for media in ((1.0, glass), (glass, 1.0)):
        coating = designs.design(f"v-coat {at_nm:g}", *media)
        assert normal_reflectance(coating, *media, at_nm) < 1e-28
        assert all(0 < thickness < at_nm / 2 for _, thickness in coating.layers)
        assert normal_reflectance(coating, *media, at_nm * 1.3) > 1e-3


def test_v_coat_between_glasses():
    assert normal_reflectance(designs.design("v-coat", 1.6, 1.7), 1.6, 1.7) < 1e-28
    with pytest.raises(InputError, match=r"v-coat: media: got \(1.5 to 1.52\).*1.38 over 2.1 or 1.38 over 1.63"):
        designs.design("v-coat", 1.5, 1.52)


@pytest.mark.parametrize("media", [(1.0, 1.52), (1.52, 1.0), (1.0, 1.75)])
def test_broadband_stays_low_over_the_visible(media: tuple[float, float]):
    broad, single = designs.design("broadband", *media), designs.design("quarter-wave", *media)
    assert normal_reflectance(broad, *media, 510.0) < 1e-28
    lam_nm = torch.linspace(420, 670, 26, dtype=torch.float64)
    r_broad, r_single = (reflectance(torch.ones_like(lam_nm), *media, c.layers, lam_nm) for c in (broad, single))
    assert r_broad.max() < 0.01
    assert r_broad.mean() < 0.0035
    assert r_broad.mean() < 0.5 * r_single.mean()


@pytest.mark.parametrize("glass", [1.434, 1.517, 1.62, 1.8, 2.0])
def test_eras_by_closed_forms(glass: float):
    """A quarter wave of the fluoride's index there; no reflection at 510 nm by three layers; from either side."""
    n = index_at(*designs.FLUORIDE, 550.0)
    assert 1.376 < n < 1.382
    for media in ((1.0, glass), (glass, 1.0)):
        single, three = designs.design("single-layer", *media), designs.design("three-layer", *media)
        assert normal_reflectance(single, *media) == pytest.approx(((glass - n * n) / (glass + n * n)) ** 2, rel=1e-12)
        assert normal_reflectance(three, *media, 510.0) < 1e-28
        assert normal_reflectance(three, *media, 400.0) > 5e-3


@pytest.mark.parametrize("glass", [1.43, 1.517, 1.57, 1.68, 1.85, 2.0])
def test_eras_reflect_what_makers_state(glass: float):
    """On crown: 4.2% bare; below 1.75% on average from 400 to 700 nm by one layer, 0.4% from 425 to 675 by three, and
    0.25% by today's (data sheets of Edmund Optics and others); each better than the one before on any other glass."""
    means = []
    for name in ("bare", "single-layer", "three-layer", "multi-layer"):
        lam_nm = torch.linspace(425, 675, 51, dtype=torch.float64)
        both = [
            reflectance(torch.ones_like(lam_nm), *media, designs.design(name, *media).layers, lam_nm)
            for media in ((1.0, glass), (glass, 1.0))
        ]
        torch.testing.assert_close(*both, rtol=1e-10, atol=1e-14)
        means.append(both[0].mean().item())
    assert means[0] == pytest.approx(((glass - 1) / (glass + 1)) ** 2)
    assert means[3] < 1.4e-3 and both[0].max() < 4e-3
    assert means[3] < means[2] < means[1] < means[0]
    if glass == 1.517:
        assert 0.012 < means[1] < 0.0175 and 0.001 < means[2] < 0.004


@pytest.mark.parametrize("glass", [1.32, 1.4, 2.1, 2.2])
def test_todays_films_lie_on_rarer_and_denser_glass_too(glass: float):
    """They reflect less than bare glass does from 400 to 700 nm, and by less than a percent on average."""
    layers, lam_nm = designs.design("multi-layer", 1.0, glass).layers, torch.linspace(400, 700, 61, dtype=torch.float64)
    found = reflectance(torch.ones_like(lam_nm), 1.0, glass, layers, lam_nm)
    assert found.max() < ((glass - 1) / (glass + 1)) ** 2 and found.mean() < 0.01


def test_films_that_disperse_are_films_of_their_index():
    lam_nm = torch.tensor([420.0, 550.0, 690.0], dtype=torch.float64)
    cos_i = cosines(0, 35, 60)
    layers = designs.design("multi-layer", 1.0, 1.62).layers
    at_once = powers(cos_i, 1.0, 1.62, layers, lam_nm)
    for k, nm in enumerate(lam_nm.tolist()):
        plain = tuple((index_at(n_d, V_d, nm), thickness) for n_d, thickness, V_d in layers)
        for found, number, expected in zip(
            at_once, powers(cos_i, 1.0, 1.62, layers, nm), powers(cos_i, 1.0, 1.62, plain, nm), strict=True
        ):
            torch.testing.assert_close(number, expected, rtol=0, atol=1e-15)
            torch.testing.assert_close(found[k], expected[k], rtol=0, atol=1e-13)


def test_designs_by_name():
    assert designs.design("bare", 1.52, 1.52).layers == ()
    for name, usual in (("quarter-wave", 550), ("v-coat", 550), ("broadband", 510)):
        here, there = designs.design(name, 1.0, 1.52), designs.design(f"{name} {usual}", 1.0, 1.52)
        assert here.layers == there.layers != designs.design(f"{name} 500", 1.0, 1.52).layers
        assert (here.name, there.name) == (name, f"{name} {usual}")


@pytest.mark.parametrize(
    "name", ["", "quarterwave", "bare 500", "v-coat nm", "v-coat -5", "v-coat 0", "v-coat inf", "broadband nan", "T*"]
)
def test_unknown_designs_are_refused_with_those_known(name: str):
    with pytest.raises(InputError, match=r'a\.toml: surface 3, coating: got .*"bare", "quarter-wave", "v-coat"'):
        designs.design(name, 1.0, 1.52, file="a.toml", where="surface 3, coating")


def test_designs_that_the_media_do_not_allow():
    with pytest.raises(InputError, match=r"a\.toml: surface 3, coating: .*two different media"):
        designs.design("broadband", 1.5, 1.5, file="a.toml", where="surface 3, coating")
    with pytest.raises(
        InputError, match=r"a\.toml: surface 3, coating: got 'multi-layer', .*1.5 to 1.52.*air on one side"
    ):
        designs.design("multi-layer", 1.5, 1.52, file="a.toml", where="surface 3, coating")
    with pytest.raises(InputError, match=r"a\.toml: surface 3, coating: got 'v-coat 500', .*1.5 to 1.52"):
        designs.design("v-coat 500", 1.5, 1.52, file="a.toml", where="surface 3, coating")


def plates(*coatings: Coating | None) -> Lens:
    """A plate of crown, a cemented pair of crown and flint, and a stop in air between them."""
    indices = (1.5, 1.0, 1.0, 1.5, 1.8, 1.0)
    rows = [Surface(math.inf, 1.0, 9.0, n_d=n, stop=k == 2) for k, n in enumerate(indices)]
    return Lens("plates", "made up", tuple(replace(s, coating=c) for s, c in zip(rows, coatings, strict=True)), 4.0)


def test_a_coating_is_chosen_for_glass_against_air_that_the_source_leaves_open():
    """Films of the source stay, and glass that it calls bare; the stop and cemented surfaces have none."""
    own, bare = Coating("own", ((1.7, 50.0),)), Coating("bare", ())
    lens = plates(own, bare, None, None, None, None)

    def names(lens: Lens) -> list[str | None]:
        return [s.coating and s.coating.name for s in lens.surfaces]

    chosen = designs.coated(lens, "single-layer")
    assert names(chosen) == ["own", "bare", None, "single-layer", None, "single-layer"]
    assert chosen.coatings == "own, bare, single-layer" and lens.coatings == "own, bare"
    assert names(designs.coated(chosen, "multi-layer")) == ["own", "bare", None, "multi-layer", None, "multi-layer"]
    assert designs.coated(chosen, "stated") == lens
    assert names(designs.coated(chosen, "bare,s03=v-coat")) == [None, None, None, "v-coat", None, None]
    assert names(designs.coated(lens, "s00=bare")) == ["bare", "bare", None, None, None, None]


@pytest.mark.parametrize(
    ("names", "said"),
    [("velvet", "velvet"), ("bare,stated", "one design"), ("s09=bare", "s00=NAME to s05=NAME"), ("s02=v-coat", "both")],
)
def test_a_coating_that_a_lens_cannot_have_is_refused(names: str, said: str):
    with pytest.raises(InputError, match=said):
        designs.coated(plates(*[None] * 6), names)
