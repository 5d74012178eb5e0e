"""Glass catalogues of Zemax, and glasses that no catalogue has."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from command_line import failure, run_json

import neurolens as nl
from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.optics.lens import glass as catalogue
from neurolens.optics.lens.glass import index_at, index_of
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.readers.glasses import more_glasses, read_agf
from neurolens.optics.readers.lensfile import read_lens

TRIPLET = Path(__file__).parents[3] / "lenses" / "cooke_triplet_50.toml"
BK7 = catalogue.find("Schott:N-BK7")


def agf(tmp_path: Path, *glasses: str, name: str = "mine.agf") -> Path:
    path = tmp_path / name
    path.write_text("CC made up\n" + "".join(glasses), encoding="latin-1")
    return path


def entry(name: str, formula: int, coefficients: tuple[float, ...], n_d: float, more: str = "") -> str:
    cd = " ".join(f"{c:.12E}" for c in coefficients)
    return f"NM {name} {formula} 517642.251 {n_d} 64.17 0 1\nED 7.1 8.3 2.51 -0.0009 0\nCD {cd}\nLD 0.3 2.5\n{more}"


@pytest.fixture
def mine(tmp_path: Path) -> Iterator[None]:
    with more_glasses([agf(tmp_path, entry("XY1", 2, BK7.coefficients, BK7.n_d, "IT 0.5 0.99 10\nIT 0.6 0.98 10\n"))]):
        yield


L = (0.45, 0.5875618, 0.7)
A, S = (2.2718929, -0.010108077, 0.010592509, 2.0816965e-4, -7.6472538e-6, 4.9240991e-7), (0.6961663, 0.0046791, 0.4)
# Index by Zemax's manual, written out, for each formula that is read.
FORMULAS = {
    1: (A, lambda q: A[0] + A[1] * q + sum(a / q**k for k, a in enumerate(A[2:], 1))),
    2: (BK7.coefficients, lambda q: BK7.index(1000 * math.sqrt(q)) ** 2),
    6: ((*BK7.coefficients, 0.01, 0.02), lambda q: BK7.index(1000 * math.sqrt(q)) ** 2 + 0.01 * q / (q - 0.02)),
    9: ((1.9, 0.35, 0.01, 0.9, 100.0), lambda q: 1.9 + 0.35 * q / (q - 0.01) + 0.9 * q / (q - 100)),
    10: ((*A, 1e-8, 1e-9), lambda q: A[0] + A[1] * q + sum(a / q**k for k, a in enumerate((*A[2:], 1e-8, 1e-9), 1))),
    12: ((*A, 2e-4), lambda q: A[0] + A[1] * q + 2e-4 * q * q + sum(a / q**k for k, a in enumerate(A[2:], 1))),
    13: (
        (A[0], A[1], 2e-4, *A[2:]),
        lambda q: A[0] + A[1] * q + 2e-4 * q * q + sum(a / q**k for k, a in enumerate(A[2:], 1)),
    ),
}


@pytest.mark.parametrize("formula", FORMULAS)
def test_indices_are_those_of_the_formula(formula: int, tmp_path: Path) -> None:
    coefficients, square = FORMULAS[formula]
    (glass,), refused = read_agf(agf(tmp_path, entry("G", formula, coefficients, math.sqrt(square(L[1] ** 2)))))
    assert not refused and glass.range_um == (0.3, 2.5)
    for um in L:
        assert glass.index(1000 * um) == pytest.approx(math.sqrt(square(um * um)), rel=1e-11)


def test_what_is_not_read_is_named_where_it_is_asked_for(tmp_path: Path) -> None:
    glasses = (entry("H1", 3, A, 1.5), entry("T6", 12, (*A, 0.0, 1e-9), 1.5), entry("WRONG", 1, A, 1.6))
    with more_glasses([agf(tmp_path, *glasses)]):
        for name, words in (("H1", r"line 2: formula 3 \(Herzberger\)"), ("T6", "sixth power"), ("WRONG", "n_d = 1.5")):
            with pytest.raises(InputError, match=words):
                catalogue.find(name)
    for text in ("ENPD 10\n", "NM X\n", "NM X 2 1 a b\n", entry("X", 2, (), 1.5)):
        (tmp_path / "bad.agf").write_text(text)
        with pytest.raises(InputError, match=r"bad\.agf: line "):
            read_agf(tmp_path / "bad.agf")


def test_added_glasses_come_first_and_go_again(mine: None, tmp_path: Path) -> None:
    found = catalogue.find("xy-1")
    assert found is catalogue.find("mine:XY1") and found.n_d == BK7.n_d
    assert found.absorption_per_mm(500) == pytest.approx(-math.log(0.99) / 10)
    with more_glasses([agf(tmp_path, entry("N-BK7", 1, A, 1.5168), name="own.agf")]):
        assert catalogue.find("N-BK7").maker == "own"
    assert catalogue.find("N-BK7") is BK7 and catalogue.find("XY1") is found


def test_a_lens_is_traced_with_its_own_catalogue_or_by_its_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without the catalogue the two terms of Cauchy through n_d and V_d; without those either, an error."""
    file, lens = agf(tmp_path, entry("XY1", 2, BK7.coefficients, BK7.n_d)), tmp_path / "lens.toml"
    row = '  { radius_mm = 50.0, thickness_mm = 4.0, diameter_mm = 20.0, glass = "XY1"%s },'
    back = "  { radius_mm = -50.0, thickness_mm = 48.0, diameter_mm = 10.0, stop = true },"
    head = 'schema = 1\nname = "n"\nsource = "s"\nf_number = 5\nrims = "source"\nhalf_field_deg = 5\nsurfaces = [\n'
    lens.write_text(head + row % "" + "\n" + back + "\n]\n")
    assert "XY1" in failure(capsys, "lens", lens)
    assert run_json(capsys, "lens", lens, "--glass", file)["efl_mm"] == pytest.approx(49.0, abs=0.2)
    assert run_json(capsys, "glass", "XY1", "--glass", file)["glasses"][0]["glass"] == "mine:XY1"
    own = nl.lens(lens, glass=file)
    assert own.focal_length_mm == pytest.approx(49.0, abs=0.2) and own.set(f_number=8).focus_m == math.inf
    ray = own.trace(np.array([[0.0], [1.0], [30.0], [0.0], [0.0], [-1.0]]), 450.0)
    assert ray.status[0] == 0 and own.describe()["efl_mm"] == pytest.approx(own.focal_length_mm)
    lens.write_text(head + row % ", n_d = 1.62, V_d = 36.4" + "\n" + back + "\n]\n")
    with pytest.warns(NeurolensWarning, match=r"surface 0, glass: glass XY1 is not in the catalogue.*Cauchy"):
        front = read_lens(lens).surfaces[0]
    assert (front.glass, front.material) == (None, "XY1") and index_of(front, 450.0) == index_at(1.62, 36.4, 450.0)


def test_a_lens_of_a_glass_without_dispersion_has_one_focal_length(tmp_path: Path) -> None:
    """A plano-convex lens, f = r / (n - 1) in every colour."""
    rows = "{ radius_mm = 50, thickness_mm = 2, diameter_mm = 12, n_d = 1.5, glass = 'FLAT', stop = true }"
    rows += ", { radius_mm = inf, thickness_mm = 98, diameter_mm = 12 }"
    file, made = tmp_path / "flat.toml", agf(tmp_path, entry("FLAT", 2, (1.25, 0, 0, 0, 0, 0), 1.5))
    head = "schema = 1\nname = 'flat'\nf_number = 8\nimage_radius_mm = 9\nrims = 'source'\nsource = 'x'\n"
    file.write_text(f"{head}surfaces = [{rows}]\n")
    with more_glasses([made]):
        lens = read_lens(file)
        assert math.isinf(catalogue.find("FLAT").V_d)
        for nm in (400.0, 700.0):
            assert first_order(lens, wavelength_nm=nm).efl_mm == pytest.approx(100, rel=1e-12)
