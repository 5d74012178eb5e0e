"""The character of a lens against closed forms: ideal lenses, holes in front of them, even and uneven discs."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.integrate import quad
from shipped import whole

from neurolens.base.errors import InputError
from neurolens.base.files import sha256_of
from neurolens.base.find import INDEX
from neurolens.cli import lens as lens_list, main
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.lens.figures import Ideal
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.readers.any_format import lens_files, read_any
from neurolens.studies import describe as char
from neurolens.studies.describe import library_row

FOCAL_MM, RADIUS_MM, FIELD_DEG = 50.0, 8.0, 20.0
ALIKE = 1e-4  # of two samplings of a pupil's outline


def ideal(*front: Surface) -> Lens:
    stop = Surface(math.inf, FOCAL_MM, 2 * RADIUS_MM, stop=True, figure=Ideal(focal_mm=FOCAL_MM))
    return Lens("ideal", "", (*front, stop), FOCAL_MM / (2 * RADIUS_MM), half_field_deg=FIELD_DEG)


def test_an_ideal_lens_has_no_character() -> None:
    """Every disc is the stop's circle, evenly lit; no surface reflects."""
    found, discs = char.character(ideal())
    assert found.cats_eye == pytest.approx(1, abs=ALIKE) and found.swirl == pytest.approx(0, abs=ALIKE)
    assert found.bubble == pytest.approx(1, abs=ALIKE)
    assert found.softness_um < 1e-6 and math.isnan(found.flare)
    # A light at infinity meets at f; the film lies at the image of 30 f, f / 29 behind: the disc is a 29th of the stop.
    radius = np.sqrt((discs.place_mm**2).sum(1)).max(1)
    assert radius == pytest.approx(RADIUS_MM / (char.FOCUS - 1), rel=0.05)  # 30 f from the film, not from the lens


@pytest.mark.parametrize("ahead_mm", [5.0, 15.0, 30.0])
def test_a_hole_ahead_of_the_lens_cuts_the_overlap_of_two_circles(ahead_mm: float) -> None:
    """A hole as wide as the stop, whose edge moves by ahead * tan(field): area, and standard deviations along both."""
    discs = char.discs_of(ideal(Surface(math.inf, ahead_mm, 2 * RADIUS_MM)), [0.0, FIELD_DEG])
    half = ahead_mm * math.tan(math.radians(FIELD_DEG)) / 2 / RADIUS_MM  # of the circles' distance, in radii
    overlap = (2 * math.acos(half) - 2 * half * math.sqrt(1 - half**2)) / math.pi
    deviation = np.sqrt((discs.place_mm[0] ** 2).sum(0)).max() / 2  # of an even disc
    assert char.cats_eye(discs, 100 * deviation) == pytest.approx(overlap, rel=ALIKE)
    assert char.cats_eye(discs, 400 * deviation) == pytest.approx(1 - (1 - overlap) / 4, rel=10 * ALIKE)

    def moment(of: str) -> float:
        """Over half of the overlap: x from half to 1 in the right circle's mirror image, y within the circle."""
        width = {"radial": lambda x: 2 * (x - half) ** 2, "across": lambda x: 2 * (1 - x * x) / 3}[of]
        return float(quad(lambda x: width(x) * math.sqrt(1 - x * x), half, 1)[0])

    swirl = 1 - math.sqrt(moment("radial") / moment("across"))
    for radius_mm, seen in ((10.0, 1.0), (100 * deviation, 1.0), (400 * deviation, 0.25)):
        assert char.swirl(discs, radius_mm) == pytest.approx(seen * swirl, abs=5 * ALIKE)


def indexed(figure: str, falling: bool = True) -> dict[str, float]:
    """A figure of the library's lenses that have it, the strongest first."""
    lines = (Path(__file__).parents[2] / "lenses" / "index.jsonl").read_text(encoding="utf-8").splitlines()
    rows = ((row["file"].removesuffix(".toml"), row["row"]["character"][figure]) for row in map(json.loads, lines))
    return dict(sorted(((n, v) for n, v in rows if v is not None), key=lambda row: row[1], reverse=falling))


CONDENSERS = {"edmund_asphere_30", "thorlabs_acl5040u_asphere_40", "thorlabs_lb1471_biconvex_50"}


def test_known_lenses_swirl_and_slow_wide_or_clean_ones_do_not() -> None:
    """Petzval's portrait lens, Meyer's Primoplan and Zeiss's Biotar are known for it."""
    order = list(indexed("swirl"))
    known = {"petzval_portrait_100", "schaefter_primoplan_100", "merte_biotar_100"}
    few = len(order) // 100  # one in a hundred
    assert known < set(order[:few]) and "schneider_xenon_50mm_f2" in order[: 5 * few]
    for clean in ("canon_rf_50mm_f1_8_stm", "nikon_nikkor_z_50mm_f1_8_s", "sony_fe_90mm_f2_8_macro_g_oss"):
        assert order.index(clean) > 35
    assert order.index("pentax_smc_m_28mm_f3_5") > 100


def test_known_lenses_make_bubbles_and_soft_or_slow_wide_ones_do_not() -> None:
    """Meyer's lenses and the Biotar are sold for it; Minolta's STF and Pentax's Soft fade, as they were made to. The
    Angenieux, a slow 28 mm, led before discs were weighed by their size."""
    bubble = indexed("bubble")
    known = {"schaefter_primoplan_100", "merte_biotar_100", "meyer_optik_gorlitz_135mm_f2_8_orestor"}
    assert known < set(list(bubble)[: len(bubble) // 20]) and list(bubble).index("angenieux_28mm_f3_5_r11") > 30
    assert bubble["minolta_135mm_f2_8_t4_5_stf"] < 0.95 and bubble["pentax_smc_f_85mm_f2_8_soft"] < 0.5


def test_lenses_made_for_round_discs_or_softness_have_them_and_condensers_no_cats_eyes() -> None:
    """Minolta's STF keeps its discs round, fast 50 mm lenses do not; Pentax's Soft is the softest of picture lenses."""
    eyes = indexed("cats_eye", falling=False)
    assert not CONDENSERS & eyes.keys() and 0.1 < min(eyes.values()) and max(eyes.values()) < 1.1
    assert "minolta_135mm_f2_8_t4_5_stf" in list(eyes)[-3:]
    assert {"nikon_nikkor_50mm_f1_2", "canon_ef_50mm_f1_4_usm"} < set(list(eyes)[:10])
    assert list(eyes).index("pentax_smc_m_28mm_f3_5") > 100
    assert [name for name in indexed("softness_um") if name not in CONDENSERS][0] == "pentax_smc_f_85mm_f2_8_soft"


def uneven(cubic: float) -> char.Discs:
    """An evenly lit stop whose rays meet the film at r + cubic * r^3."""
    share, angle = np.sqrt([*(np.arange(400) + 0.5) / 400, 1.0]), 2 * math.pi * np.arange(60) / 60
    radius, weight = (share + cubic * share**3)[:, None], np.repeat(share < 1, 60)[None].astype(float)
    place = np.stack([(radius * f(angle)).ravel() for f in (np.cos, np.sin)])
    return char.Discs(place[None], place[None], weight, np.ones(weight.shape, bool))


@pytest.mark.parametrize("cubic", [-0.3, -0.1, 0.0, 0.4])
def test_spherical_aberration_brightens_or_dims_the_rim(cubic: float) -> None:
    def even(share: float) -> float:
        return 5 * 2 * share * ((share + cubic * share**3) / (1 + cubic)) ** 8

    expected = quad(even, 0, 1)[0]
    assert char.bubble(uneven(cubic), 1.0) == pytest.approx(expected, rel=1e-3)
    assert np.sign(expected - 1) == pytest.approx(-np.sign(cubic)) or cubic == 0


def test_discs_of_one_size_are_compared() -> None:
    """Rays h + z (1 + h^2) h of the pupil's height h, at the film z: wherever the film stands, the disc that counts has
    one deviation; of a sharpest disc that is larger there is none."""
    share, angle = np.sqrt([*(np.arange(400) + 0.5) / 400, 1.0]), 2 * math.pi * np.arange(60) / 60
    weight = np.repeat(share < 1, 60)[None].astype(float)

    def disc(z: float) -> char.Discs:
        slope = share + 0.2 * share**3
        both = (
            np.stack([(v[:, None] * f(angle)).ravel() for f in (np.cos, np.sin)])[None]
            for v in (z * slope - share, slope)
        )
        return char.Discs(*both, weight, np.ones(weight.shape, bool))

    near, far = (char.bubble(disc(z), 20.0) for z in (1.5, 4.0))
    assert near == pytest.approx(far, rel=1e-9) and near != pytest.approx(1, abs=0.05)
    assert math.isnan(char.bubble(disc(1.5), 0.1))


def test_an_undercorrected_singlet_has_soft_discs_behind_the_focus() -> None:
    """Its edge rays meet first: behind the focus they go far out, and the rim is dim."""
    found, _ = char.character(read_any("lenses/thorlabs_lb1471_biconvex_50.toml"))
    assert 0 < found.bubble < 0.9 and found.softness_um > 10


def singlet(n: float) -> Lens:
    """A weak biconvex lens, open f/50."""
    front, back = Surface(1000.0, 2.0, 40.0, n_d=n), Surface(-1000.0, 900.0, 20.0, stop=True)
    return Lens("weak", "", (front, back), 50.0, half_field_deg=2.0)


@pytest.mark.parametrize("n", [1.5, 1.8])
def test_the_ghost_of_a_weak_singlet_has_the_square_of_its_reflectance(n: float) -> None:
    found, _ = char.character(singlet(n))
    assert found.flare == pytest.approx(((n - 1) / (n + 1)) ** 4, rel=0.1)


def test_shapes_do_not_depend_on_the_scale_of_the_lens_and_blur_is_of_the_picture() -> None:
    lens = read_any("lenses/brendel_tessar_100.toml")
    (one, _), (two, _) = char.character(lens), char.character(lens.scaled(0.5))
    assert two.to_dict() == pytest.approx(one.to_dict(), rel=1e-2)


def test_a_picture_is_small_and_shows_the_cut() -> None:
    discs = char.discs_of(ideal(Surface(math.inf, 20.0, 2 * RADIUS_MM)), [0.0, 12.0, FIELD_DEG])
    data = char.picture(discs)
    grey = np.asarray(Image.open(io.BytesIO(data)), float)
    assert grey.shape == (32, 96) and len(data) < 2048
    lit = [(grey[:, k : k + 32] > 100).sum() for k in (0, 32, 64)]
    assert lit[0] > lit[1] > lit[2] > 0
    assert lit[2] / lit[0] == pytest.approx(char.cats_eye(discs, 1.0), abs=0.05)
    axis = grey[12:20, 12:20]
    assert np.ptp(axis) < 0.2 * axis.mean()  # evenly lit
    wide = char.Discs(discs.place_mm * np.array([1, 1, 50])[:, None, None], discs.slope, discs.weight, discs.passed)
    assert (np.asarray(Image.open(io.BytesIO(char.picture(wide))))[:, :32] > 100).sum() > 0.4 * lit[0]


def test_no_image_no_character() -> None:
    flat = Lens("flat", "", (Surface(math.inf, 50.0, 10.0, stop=True),), 5.0)
    with pytest.raises(InputError):
        char.character(flat)
    assert char.character_or_none(flat) == (None, None)
    spread = Lens("diverging", "", (Surface(math.inf, 50.0, 10.0, stop=True, figure=Ideal(focal_mm=-50.0)),), 5.0)
    assert char.character_or_none(spread) == (None, None)


def test_the_index_holds_the_library_as_it_is() -> None:
    """Every file by its checksum, and rows that are computed again agree."""
    files, index = lens_files(Path("lenses")), lens_list.read_index()
    wrong = [f.name for f in files if index.get(f.name, {}).get("sha256") != sha256_of(f)]
    assert not wrong and len(index) == len(files), f"{wrong}: run `python -m experiments lens-index`"
    for file in (Path("lenses/laikin_double_gauss_50.toml"), Path("lenses/sigler_telephoto_100.toml")):
        kept, again = lens_list.kept_row(file, index), library_row(file, characters=True)
        assert kept is not None and kept.keys() == again.keys()
        for row in (kept, again):
            row["checks"] = {(c["state"], c["quantity"]): c["computed"] for c in row["checks"]}
        assert kept.pop("checks") == pytest.approx(again.pop("checks"), rel=1e-3, abs=1e-3)
        assert kept.pop("character") == pytest.approx(again.pop("character"), rel=0.02)
        assert {k: pytest.approx(v, rel=1e-5) if isinstance(v, float) else v for k, v in again.items()} == kept
    assert Scene(read_any(files[0])).first_order.efl_mm == pytest.approx(kept_efl(index, files[0]), rel=1e-4)


def kept_efl(index: dict[str, dict[str, object]], file: Path) -> float:
    row = lens_list.kept_row(file, index)  # type: ignore[arg-type]
    assert row is not None
    return float(row["efl_mm"])


@pytest.mark.parametrize(
    "sort", ["speed", *whole(*(key for key in (*lens_list._SORTS, *lens_list.CHARACTER) if key != "speed"))]
)
def test_the_library_is_sorted_by_each_key(sort: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["lens", "list", "--sort", sort, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["lenses"]
    if sort in lens_list.CHARACTER:
        found = [row["character"][lens_list.CHARACTER[sort][0]] for row in rows]
    else:
        found = [row[lens_list._SORTS[sort]] or None for row in rows]
    known = [v.casefold() if isinstance(v, str) else v for v in found if v is not None]
    rising = sort in lens_list._SORTS or sort == "cats-eye"
    assert known == sorted(known, reverse=not rising) and len(known) > 30
    assert found[len(known) :] == [None] * (len(rows) - len(known))


def test_a_changed_file_is_not_the_index_s(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "lenses").mkdir()
    file = tmp_path / "lenses" / "a.toml"
    file.write_text("name = 1\n")
    entry = {"file": "a.toml", "sha256": sha256_of(file), "row": {"efl_mm": 5.0}}
    (tmp_path / "lenses" / INDEX).write_text(json.dumps(entry) + "\n")
    monkeypatch.setattr(lens_list, "library", lambda: tmp_path)
    monkeypatch.setattr("neurolens.base.find.library", lambda: tmp_path)
    index = lens_list.read_index()
    assert lens_list.kept_row(file, index) == {"lens": "a", "file": str(file), "efl_mm": 5.0}
    (tmp_path / "a.toml").write_text("name = 1\n")
    assert lens_list.kept_row(tmp_path / "a.toml", index) is None  # another folder's
    file.write_text("name = 2\n")
    assert lens_list.kept_row(file, index) is None


def test_a_folder_of_ones_own_is_sorted_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A lens whose rims are a guess says so; one that cannot be read stands last."""
    for name, words in (("a", ('rims = "source"',)), ("b", ('rims = "derived"', "diameter_mm = 12.0"))):
        text = Path("lenses/smith_double_gauss_100.toml").read_text()
        (tmp_path / f"{name}.toml").write_text(text if name == "a" else _renamed(text, words))
    (tmp_path / "broken.toml").write_text("schema = 1\n")
    assert main(["lens", str(tmp_path), "--sort", "swirl"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert "cat's eye" in out[0] and out[3].startswith("broken")
    assert [line.count("~") for line in out[1:3] if line.startswith("b ")] == [2]
    assert main(["lens", "laikin_double_gauss_50", "--sort", "swirl"]) == 2


def _renamed(text: str, words: tuple[str, ...]) -> str:
    assert 'rims = "' in text
    start = text.index('rims = "')
    return text[:start] + words[0] + text[text.index("\n", start) :]
