"""`neurolens psf`: its file, resuming, orientation; blurred pictures, their adjoint and their noise."""

import json
import math
import os
import pickle
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import failure, run_json

from neurolens.base.errors import InputError
from neurolens.base.files import forget_parts, library, write_arrays
from neurolens.cameras.build import make_camera
from neurolens.cli import main
from neurolens.optics.analysis.diffraction import pupils_at, spread
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.lens.prescription import Lens, Placement
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens
from neurolens.pictures.defocus.diffraction import places_of
from neurolens.pictures.defocus.kernels import kernels_over
from neurolens.pictures.flare.exit_pupil import pupils_seen
from neurolens.pictures.render.pictures import read_channels
from neurolens.pictures.render.settings import SensorSettings
from neurolens.programs import psf as p
from neurolens.programs.blur import Blur, BlurredPairs

LENS = "laikin_double_gauss_50"
WORDS = ("psf", LENS, "--film", "30x20", "--pixel-um", "8", "--grid", "3x2", "--focus", "2", "--quiet")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("psf") / "gauss.npz"
    assert (
        main(
            [
                *WORDS,
                "--f-number",
                "4,8",
                "--distance",
                "2,inf",
                "--wavelengths",
                "620,540,460",
                "--side",
                "41",
                "-o",
                str(out),
            ]
        )
        == 0
    )
    return out


def test_the_file_says_what_it_holds(made: Path) -> None:
    about, arrays = p.read_psf(made)
    assert arrays["psf"].shape == (2, 2, 2, 3, 3, 41, 41) and list(about["channels"]) == ["nm620", "nm540", "nm460"]
    assert about["photographs"].keys() == {"match", "verdict"} and about["lens"] == LENS
    assert arrays["f_number"].tolist() == [4, 8] and arrays["distance_m"].tolist() == [2, math.inf]
    assert arrays["place_mm"][[0, 1], [0, 2]] == pytest.approx(np.array([[-10, 5], [10, -5]]))
    assert arrays["psf"].sum((-2, -1)) == pytest.approx(arrays["inside"], abs=1e-5)
    assert arrays["inside"][:, 0].min() > 0.97 and not made.with_name("gauss.npz.parts").exists()
    # In focus the narrower stop is sharper at the corner, far out of focus it blurs less.
    widths = (arrays["psf"].sum((4, -1)) > 0.02).sum(-1)[..., 0, 0]
    assert widths[1, 1] < widths[0, 1]
    assert (arrays["light"][0] < 1).all() and (arrays["light"][1] > arrays["light"][0]).all()
    assert np.abs(arrays["centre_mm"] - arrays["place_mm"])[:, 0].max() < 0.03


def test_an_image_out_of_focus_is_the_kernel_of_the_blur() -> None:
    """Whose rays a camera makes from the film, in the upright picture: cat's eyes lie as they lie there."""
    shot = Shot((30.0, 20.0), focus_m=2.0, f_number=2.0)
    [cells] = kernels_over(make_camera(LENS, shot), (3750, 2500), [math.inf], (3, 2), (540.0, 540.0, 540.0))
    lens = set_lens(read_lens(library() / "lenses" / f"{LENS}.toml"), replace(Shot.part(), focus_m=2.0, f_number=2.0))
    task = p.PsfTask(lens, math.inf, (*places_of((30.0, 20.0), (3, 2)), (0.0, 0.0)), ((540.0,),), 0.008, 91)
    for cell, image in zip(cells, p.point_spread(task)["psf"][:, 0], strict=True):
        assert cell.kernel is not None
        kernel = cell.kernel.centred(91, cell.place_px)[..., 1]
        other = [np.abs(kernel / kernel.sum() - each).sum() / 2 for each in (image, image[::-1], image[::-1, ::-1])]
        assert other[0] < 0.05 and other[1] > 1.3 * other[0] and other[2] > 1.3 * other[0]


def test_images_on_both_sides_are_mirror_images(made: Path) -> None:
    images = p.read_psf(made)[1]["psf"][0, 0]
    assert images[0, 0] == pytest.approx(images[0, 2][..., ::-1], abs=1e-6)
    assert images[0, 0] == pytest.approx(images[1, 0][..., ::-1, :], abs=1e-6)
    assert np.abs(images[0, 0] - images[0, 2]).max() > 0.05 * images.max()


def test_parts_that_are_done_are_not_computed_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, computed, one = tmp_path / "a.npz", list[float](), p.point_spread

    def failing(task: p.PsfTask) -> p.Arrays:
        computed.append(task.distance_m)
        if len(computed) == 2:
            raise MemoryError("gone")
        return one(task)

    words = [*WORDS, "--distance", "1", "3", "--side", "9", "--f-number", "5.6", "--wavelengths", "550", "-o", str(out)]
    monkeypatch.setattr(p, "point_spread", failing)
    assert main(words) == 2 and not out.exists()
    assert len(list(out.with_name("a.npz.parts").iterdir())) == 1
    assert main(words) == 0
    assert computed == [1, 3, 3] and p.read_psf(out)[1]["psf"].shape == (1, 2, 2, 3, 1, 9, 9)


def test_runs_into_one_file_do_not_end_each_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another one that ends first removes all parts that are there."""
    out, one = tmp_path / "a.npz", p.point_spread

    def beside(task: p.PsfTask) -> p.Arrays:
        forget_parts(out.with_name("a.npz.parts"), "*.npz")
        return one(task)

    monkeypatch.setattr(p, "point_spread", beside)
    words = ("--distance", "1", "3", "--side", "9", "--f-number", "5.6", "--wavelengths", "550", "-o", str(out))
    assert main([*WORDS, *words]) == 0 and p.read_psf(out)[1]["distance_m"].tolist() == [1, 3]


def test_an_exr_holds_the_atlas_of_each_state(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = {"--wavelengths": "550", "--side": 15, "--f-number": 5.6, "--plot": tmp_path / "a.svg"}
    data = run_json(capsys, *WORDS, *(w for pair in words.items() for w in pair), "-o", tmp_path / "a.exr")
    planes, about = read_channels(tmp_path / "a.exr")
    assert planes["f5p6_2m.nm550"].shape == (30, 45) and about["pixel_um"] == 8
    assert data["psfs"] == 6 and data["side_px"] == 15 and (tmp_path / "a.svg").read_text().count("µm")
    assert json.loads(json.dumps(about))["channels"] == {"nm550": [550.0]}


def test_dark_places_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--film", "300x10", "--grid", "3x1", "--pixel-um", "8", "--side", "9", "--wavelengths", "550"]
    assert main(["psf", LENS, *words, "-o", str(tmp_path / "a.npz")]) == 0
    told = capsys.readouterr()
    assert "2 of 3 point spreads are dark: no light arrives\n" in told.err and "at least 9" in told.out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--pixel-um", "0"), "--pixel-um"), (("--f-number", "2,x"), "expected f-numbers"),
        (("--side", "8"), "an odd number"),
        (("--channels", "mono", "--wavelengths", "550"), "none beside --wavelengths"),
        (("--distance", "-1"), "a distance in metres above 0"), (("--grid", "0x3"), "COLUMNSxROWS"),
        (("-o", "a.safetensors"), ".npz or .exr"), (("--wavelengths", "5"), "wavelengths in nm"),
        (("--focus", "0.01"), "focus"), (("--distance", "2,0.07"), "the front of the lens"),
    ],
)  # fmt: skip
def test_bad_values_are_one_line(words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert said in failure(capsys, *WORDS[:-1], *words)


def gauss(focus_m: float) -> Lens:
    return set_lens(
        read_lens(library() / "lenses" / f"{LENS}.toml"), Shot(film_mm=(36, 24), f_number=4, focus_m=focus_m)
    )


def test_places_without_light_are_said_to_be_dark(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Not to have their light beyond the pixels: the film is larger than what the lens covers."""
    words = ["psf", LENS, "--film", "200x20", "--grid", "3x1", "--f-number", "8", "--wavelengths", "550"]
    assert main([*words, "-o", str(tmp_path / "a.npz")]) == 0
    told = capsys.readouterr()
    assert "2 of 3 point spreads are dark" in told.err and "beyond" not in told.err
    assert p.read_psf(tmp_path / "a.npz")[1]["light"].tolist() == [[[[0, 1, 0]]]]


@pytest.mark.parametrize("distance_m", [2.0, math.inf])
def test_a_lens_moved_aside_as_a_whole_has_its_image_moved(distance_m: float) -> None:
    """It is no longer round: its object points are found another way. Far objects stay where they are."""
    lens, aside = gauss(distance_m), (0.4, -0.3)
    rows = [replace(s, placement=Placement((*aside, 0.0))) for s in lens.surfaces]
    moved = replace(lens, surfaces=tuple(rows))
    places = np.array([[0.0, 0.0], [11.0, -7.0]])
    found = pupils_seen(moved, distance_m, places + aside, (546.0,))
    for [was], [now] in zip(pupils_at(Scene(lens, distance_m), places, (546.0,)), found, strict=True):
        assert was is not None and now is not None
        assert now.centre_mm - aside == pytest.approx(was.centre_mm, abs=0.01)
        one, other = (spread([x], np.ones((1, 1)), 0.006, 31) for x in (was, now))
        assert 0.5 * np.abs(one.light - other.light).sum() < 0.01 * one.light.sum()
        assert other.pupil == pytest.approx(one.pupil, rel=2e-3)


def test_an_anamorphic_lens_has_both_symmetries(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = "schneider_anamorphic_31 --film 18x15 --grid 3x3 --pixel-um 6 --f-number 8 --wavelengths 550".split()
    run_json(capsys, "psf", *words, "-o", tmp_path / "a.npz")
    psf = p.read_psf(tmp_path / "a.npz")[1]["psf"][0, 0, :, :, 0]
    assert psf[0, 0] == pytest.approx(psf[2, 2, ::-1, ::-1]) and psf[0, 2] == pytest.approx(psf[0, 0, :, ::-1])
    assert np.abs(psf[0, 1] - psf[1, 0].T).max() > 0.05 * psf[0, 1].max()


def test_a_file_of_other_arrays_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", psf=np.zeros(3))
    with pytest.raises(InputError, match="a file of neurolens psf"):
        Blur(tmp_path / "a.npz", (8, 8))


def test_arrays_that_do_not_fit_each_other_are_refused(made: Path, tmp_path: Path) -> None:
    about, arrays = p.read_psf(made)
    for changed, facts in (
        ({"place_mm": arrays["place_mm"][:1]}, about),
        ({"psf": arrays["psf"][..., 1:]}, about),
        ({"light": arrays["light"][..., None]}, about),
        ({}, {"lens": LENS}),
    ):
        write_arrays(tmp_path / "a.npz", facts, arrays | changed)
        with pytest.raises(InputError, match="a file of neurolens psf"):
            Blur(tmp_path / "a.npz", (8, 8))


def noise(*shape: int) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(3).standard_normal(shape))


@pytest.mark.parametrize(("size", "at_mm"), [((60, 90), (0.0, 0.0)), ((40, 25), (9.0, -4.0)), ((8, 7), (14.0, 9.0))])
def test_the_adjoint_has_the_same_inner_products(made: Path, size: tuple[int, int], at_mm: tuple[float, float]) -> None:
    blur = Blur(made, size, at_mm, state=(0, 1))
    x, y = noise(3, *size), noise(4, 3, *size)[1]
    assert float((blur(x) * y).sum()) == pytest.approx(float((x * blur.adjoint(y)).sum()), rel=1e-12, abs=1e-12)
    x.requires_grad_(True)
    (gradient,) = torch.autograd.grad((blur(x) * y).sum(), x)
    torch.testing.assert_close(gradient, blur.adjoint(y))


def test_a_point_becomes_the_point_spread_of_its_place(made: Path) -> None:
    """At a place of the file, and half way to the next, where it is the mean of both."""
    _, arrays = p.read_psf(made)
    x = torch.zeros(3, 81, 81, dtype=torch.float64)
    x[:, 40, 40] = 1
    at, beside = arrays["psf"][0, 0, 0, 0].astype(float), arrays["psf"][0, 0, 0, 1].astype(float)
    at, beside = (k / k.sum((-2, -1), keepdims=True) for k in (at, beside))
    found = Blur(made, (81, 81), (-10.0, 5.0), vignetting=False)(x).numpy()[:, 20:61, 20:61]
    assert found == pytest.approx(at, abs=1e-12)
    found = Blur(made, (81, 81), (-5.0, 5.0), vignetting=False)(x).numpy()[:, 20:61, 20:61]
    assert found == pytest.approx((at + beside) / 2, abs=1e-12)
    dark = Blur(made, (81, 81), (-10.0, 5.0))(x).sum((1, 2)).numpy()
    assert dark == pytest.approx(arrays["light"][0, 0, 0, 0], rel=1e-9)


def test_pairs_have_the_blur_and_the_noise_of_the_sensor(made: Path) -> None:
    """Light is kept, so that lateral colour, which is another scale, changes grey by its 0.1%."""
    flat = np.full((90, 70, 3), 0.4, np.float32)
    clean = BlurredPairs([flat], [made], patch=32, length=3, vignetting=False)
    sharp, blurred = clean[1]
    assert len(clean) == 3 and sharp.shape == blurred.shape == (3, 32, 32)
    assert blurred.numpy() == pytest.approx(0.4, rel=1e-3)
    noisy = BlurredPairs([flat], [made], 32, SensorSettings(electrons=1000, read_noise=5), vignetting=False)
    _, read = noisy[0]
    assert read.shape == (1, 32, 32)
    assert float(read.mean()) == pytest.approx(0.4, abs=5 * 0.02 / 32)
    assert float(read.std()) == pytest.approx(math.sqrt(400 + 25) / 1000, rel=0.1)
    assert torch.equal(read, noisy[0][1]) and not torch.equal(read, BlurredPairs([flat, flat], [made], 32)[1][1][:1])
    with pytest.raises(InputError, match="at least 96 pixels"):
        BlurredPairs([flat], [made], 96)[0]


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"pictures": []}, "pictures.*at least one"),
        ({"pictures": "a.png"}, "pictures.*a list"),
        ({"files": "library.npz"}, "files.*a list"),
        ({"patch": 0}, "patch.*at least 1"),
        ({"patch": 9.5}, "patch.*whole number"),
        ({"length": 0}, "length.*at least 1"),
        ({"seed": -1}, "seed.*at least 0"),
        ({"pictures": [np.full((40, 40, 3), 128, np.uint8)]}, "uint8.*floats"),  # sRGB, or light? nobody can tell
        ({"pictures": [np.zeros((40, 40))]}, "float64 .40, 40.*floats"),
        ({"pictures": [np.zeros((40, 40, 4))]}, "40, 40, 4.*floats"),
        ({"pictures": [np.full((40, 40, 3), np.nan)]}, "not finite"),
    ],
)
def test_what_gives_no_pairs_is_one_line(made: Path, wrong: dict[str, Any], said: str) -> None:
    given: dict[str, Any] = {"pictures": [np.zeros((40, 40, 3))], "files": [made], "patch": 32}
    with pytest.raises(InputError, match=said):
        BlurredPairs(**(given | wrong))[0]


def test_point_spread_stays_in_its_file(made: Path, tmp_path: Path) -> None:
    """Other processes get its place in the file, from where they make the very same pairs."""
    with np.load(made) as file:
        arrays = {name: file[name] for name in p.read_psf(made)[1]}
    about, mapped = p.read_psf(made)
    assert isinstance(mapped["psf"], np.memmap) and np.array_equal(mapped["psf"], arrays["psf"])
    x = noise(3, 50, 60)
    assert torch.equal(Blur(made, (50, 60), (7.0, 2.0))(x), Blur((about, arrays), (50, 60), (7.0, 2.0))(x))
    by_columns = tmp_path / "f.npz"
    np.savez(by_columns, **(arrays | {"psf": np.asfortranarray(arrays["psf"])}))
    with zipfile.ZipFile(by_columns, "a") as archive:
        archive.writestr("about.json", json.dumps(about))
    pairs, other = (BlurredPairs([noise(60, 60, 3).numpy()], [file], 16, length=9) for file in (made, by_columns))
    sent = pickle.dumps(pairs)
    assert len(sent) < arrays["psf"].nbytes / 4
    for one, same, third in zip(pairs, pickle.loads(sent), other, strict=True):  # noqa: S301
        assert torch.equal(one[1], same[1]) and torch.equal(one[1], third[1])


def test_damaged_missing_and_changed_files_are_told(made: Path, tmp_path: Path) -> None:
    (about, arrays), picture, file = p.read_psf(made), np.zeros((40, 40, 3)), tmp_path / "a.npz"
    with pytest.raises(InputError, match=r"a\.npz: file: got \(No such file"):
        BlurredPairs([picture], [made, file], 16)
    data = bytearray(made.read_bytes())
    at = data.index(arrays["psf"][1, 1, 1, 1, 1].tobytes())
    data[at] ^= 1  # the last bit of a number
    file.write_bytes(data)
    with pytest.raises(InputError, match=r"a\.npz.*Bad CRC-32.*psf"):
        BlurredPairs([picture], [file], 16)
    for shape in (b"(2, 2, 2, 3, 3, 41, 40)", b"(2, 2, 2, 3, 3, 41, 42)"):  # less and more than there is
        with zipfile.ZipFile(made) as old, zipfile.ZipFile(file, "w") as new:
            new.comment = bytes(60000)  # so that the file is long enough
            for name in old.namelist():
                new.writestr(name, old.read(name).replace(b"(2, 2, 2, 3, 3, 41, 41)", shape))
        with pytest.raises(InputError, match=r"psf\.npy has .* not as many as its header says"):
            BlurredPairs([picture], [file], 16)
    psf = np.array(arrays["psf"])
    psf[1, 1, 1, 1, 1, 3, 3] = np.nan
    write_arrays(file, about, arrays | {"psf": psf})
    with pytest.raises(InputError, match=r"a\.npz.*psf.*not finite"):
        BlurredPairs([picture], [file], 16)
    write_arrays(file, about, arrays)
    pairs = BlurredPairs([picture], [file], 16)
    assert pairs[0][1].isfinite().all()
    os.utime(file, ns=(1, 1))
    with pytest.raises(InputError, match=r"a\.npz.*changed since"):
        pairs[0]


def test_a_loop_over_pairs_ends_and_takes_tensors(made: Path) -> None:
    pairs: Any = BlurredPairs([torch.full((40, 40, 3), 0.4)], [made], patch=32, length=2, vignetting=False)
    assert [float(blurred.mean()) for _, blurred in pairs] == pytest.approx([0.4, 0.4], rel=1e-3)


def test_a_state_or_a_place_that_is_not_there_is_refused(made: Path) -> None:
    with pytest.raises(InputError, match="at_mm.*30 x 20 mm"):
        Blur(made, (8, 8), at_mm=(4.0, 10.5))
    with pytest.raises(InputError, match="the file's states"):
        Blur(made, (8, 8), state=(2, 0))
    with pytest.raises(InputError, match="at_mm"):
        Blur(made, (8, 8), at_mm=(math.nan, 0.0))
    for picture in (torch.zeros(3, 8, 9), torch.zeros(3, 8, 8, dtype=torch.int64)):
        with pytest.raises(InputError, match="picture"):
            Blur(made, (8, 8))(picture)
