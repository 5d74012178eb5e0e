"""A render that ends early goes on to the same picture, bit for bit; a checkpoint of anything else is refused."""

import io
import json
import os
import zipfile
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from render_helpers import FILM, PINHOLE, SIZE, THIN, files_of_at_most, lit_scene, scene
from shipped import whole

from neurolens.base.errors import InputError, NeurolensError
from neurolens.cameras.contract import CameraRays
from neurolens.cameras.ideal import ThinLens
from neurolens.pictures.render import renderer
from neurolens.pictures.render.film import SPENT, digest
from neurolens.pictures.render.renderer import Keeper, RenderResult, Watch, render
from neurolens.pictures.render.settings import FilmSettings

PATHS_A_PASS = 16 * 64


class Failing(ThinLens):
    """Fails in the last pass, of 8 samples, of the last tile but one; whole again where `mended`."""

    mended = False

    def sample(self, film_mm: Any, pupil: Any, wavelength_nm: Any) -> CameraRays:
        if film_mm.shape[1] == PATHS_A_PASS // 2 and 8 < film_mm[1].min() < 11 and not self.mended:
            raise RuntimeError("no more film")
        return super().sample(film_mm, pupil, wavelength_nm)


def same(one: RenderResult, other: RenderResult) -> bool:
    layers = zip(asdict(one.layers).values(), asdict(other.layers).values(), strict=True)
    return np.array_equal(one.rgb, other.rgb) and all(np.array_equal(a, b) for a, b in layers)


@pytest.fixture
def small_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("neurolens.pictures.render.film.BATCH", PATHS_A_PASS)


@pytest.mark.usefixtures("small_tiles")
@pytest.mark.parametrize(("first", "then", "mode"), [(1, 2, "auto"), *whole((2, 1, "hero"), (2, 3, "one"))])
def test_what_a_failed_render_had_goes_on_to_the_same_picture(first: int, then: int, mode: Any, tmp_path: Path) -> None:
    part, camera = tmp_path / "a.exr.part", Failing(50.0, 2.0, 3.0, FILM)
    options: dict[str, Any] = SIZE | {"samples": 40, "film": FilmSettings(wavelengths=mode)}
    with pytest.raises(NeurolensError, match=r"no more film.*kept in .*a\.exr\.part"):
        render(lit_scene(), camera, threads=first, watch=Watch(checkpoint=part), **options)
    with np.load(part, allow_pickle=False) as kept:
        assert 14 * 2 <= kept["done"].sum() < 14 * 3 and kept["sums"].shape == (36 * 24, 8)
    camera.mended = True
    reports: list[float] = []
    watch = Watch(checkpoint=part)
    resumed = render(lit_scene(), camera, threads=then, watch=watch, progress=lambda f, s: reports.append(f), **options)
    assert resumed.stats.complete and all(2 / 3 < f <= 1 for f in reports)
    assert same(resumed, render(lit_scene(), camera, threads=1, **options))


@pytest.mark.usefixtures("small_tiles")
def test_a_render_that_is_asked_to_stop_gives_the_picture_so_far(tmp_path: Path) -> None:
    part = tmp_path / "a.exr.part"
    stopped = render(lit_scene(), THIN, samples=100_000, watch=Watch(checkpoint=part, stop=lambda: True), **SIZE)
    samples = stopped.layers.samples
    assert not stopped.stats.complete and stopped.stats.samples_done == pytest.approx(samples.mean())
    assert samples.max() - samples.min() <= 16 and not samples.max() % 16
    assert not part.exists() or stopped.stats.paths > 0
    enough = int(samples.max()) + 16
    resumed = render(lit_scene(), THIN, samples=enough, watch=Watch(checkpoint=part), **SIZE)
    assert same(resumed, render(lit_scene(), THIN, samples=enough, threads=1, **SIZE))


@pytest.mark.usefixtures("small_tiles")
def test_samples_are_added_to_a_kept_render(tmp_path: Path) -> None:
    part = tmp_path / "a.exr.part"

    def go(samples: int, **watch: Any) -> RenderResult:
        return render(lit_scene(), THIN, samples=samples, watch=Watch(checkpoint=part, keep=True, **watch), **SIZE)

    go(16)
    assert same(go(40), render(lit_scene(), THIN, samples=40, **SIZE))
    # 40 samples end in a pass of 8, which uninterrupted renders of more do not have.
    with pytest.raises(InputError, match=r"samples: got 40, expected a multiple of 16"):
        go(80)
    with pytest.raises(InputError, match=r"samples: got 40, expected 32 at most"):
        go(32)
    go(8, restart=True)
    with pytest.raises(InputError, match=r"samples: got 8, expected 64"):
        go(64)


def kept_render(part: Path, **options: Any) -> RenderResult:
    given: dict[str, Any] = SIZE | {"samples": 16, "threads": 1, "watch": Watch(checkpoint=part, keep=True)}
    return render(**({"scene": lit_scene(), "camera": THIN} | given | options))


class Bent(ThinLens):
    """Has the settings of a thin lens, and other rays."""

    def sample(self, film_mm: Any, pupil: Any, wavelength_nm: Any) -> CameraRays:
        return super().sample(film_mm * np.float32(1.0001), pupil, wavelength_nm)


def test_a_checkpoint_of_another_render_is_refused_and_what_differs_is_named(tmp_path: Path) -> None:
    part = tmp_path / "a.exr.part"
    kept_render(part)
    before = part.read_bytes()
    changes: list[tuple[dict[str, Any], str]] = [
        ({"seed": 5}, "seed: got 0, expected 5 as asked now"),
        ({"max_depth": 2}, "max_depth: got 6, expected 2"),
        ({"width": 48, "height": 32}, "width: got 36, expected 48"),
        ({"camera": ThinLens(50.0, 4.0, 3.0, FILM)}, r"camera\.f_number: got 2\.0, expected 4\.0"),
        ({"camera": ThinLens(50.0, 2.0, 2.0, FILM)}, r"camera\.focus_m: got 3\.0, expected 2\.0"),
        ({"camera": PINHOLE}, "camera.name: got 'thin', expected 'pinhole'"),
        ({"camera": Bent(50.0, 2.0, 3.0, FILM)}, r"camera\.rays: got '[0-9a-f]{16}'"),
        ({"film": FilmSettings(white_balance="A")}, "white_balance: got None, expected 'A'"),
        ({"scene": lit_scene(0.71)}, "scene: got '[0-9a-f]{16}'"),
    ]
    for change, said in changes:
        with pytest.raises(InputError, match=said) as refused:
            kept_render(part, **change)
        assert str(refused.value).startswith(str(part)) and "--restart" in str(refused.value)
    assert part.read_bytes() == before


def test_the_digest_of_a_scene_sees_every_part_and_nothing_else() -> None:
    assert digest(lit_scene()) == digest(lit_scene()) != digest(lit_scene(0.7000001))
    differ: list[tuple[Any, Any]] = [
        *((("ab", "c"), ("a", "bc")), ((1, (2, 3)), (1, 2, 3)), ({"a": None}, {}), (1, "1")),
        *((np.zeros(2), np.zeros((2, 1))), (np.zeros(1, np.float32), np.zeros(1, np.int32))),
    ]
    assert all(digest(a) != digest(b) for a, b in differ)
    turned = np.arange(6).reshape(2, 3).T
    assert digest({"a": turned, "b": 2}) == digest({"b": 2, "a": np.ascontiguousarray(turned)})


class Spoilt(ThinLens):
    """Some rays weigh what no number can, among them the last that a float can hold."""

    def __init__(self, *given: Any, spoilt: bool = True) -> None:
        super().__init__(*given)
        self.spoilt = spoilt

    def sample(self, film_mm: Any, pupil: Any, wavelength_nm: Any) -> CameraRays:
        rays = super().sample(film_mm, pupil, wavelength_nm)
        which = (pupil[0] < 0.2) & (pupil[1] < 0.2)
        values = np.array([np.nan, np.inf, 3e38, 0.0], np.float32)[np.arange(len(which)) % 4 if self.spoilt else 3]
        weight = np.where(which, values, rays.weight)
        return replace(rays, weight=weight.astype(np.float32))


@pytest.mark.parametrize("mode", ["one", "hero"])
def test_samples_that_are_not_finite_are_dropped_counted_and_remembered(mode: Any, tmp_path: Path) -> None:
    part, camera = tmp_path / "a.exr.part", Spoilt(50.0, 2.0, 3.0, FILM)
    film = FilmSettings(wavelengths=mode)
    bright = scene(environment={"colour": [1e4, 1e4, 1e4]})
    for samples in (16, 32):  # the second goes on from the first
        found = kept_render(part, scene=bright, camera=camera, film=film, samples=samples)
    # They count as black: the same picture as where their rays do not pass.
    black = render(bright, Spoilt(50.0, 2.0, 3.0, FILM, spoilt=False), samples=32, threads=1, film=film, **SIZE)
    assert np.all(np.isfinite(found.rgb)) and np.all(np.isfinite(found.layers.variance))
    assert black.stats.dropped_samples == 0 and np.array_equal(found.rgb, black.rgb)
    spoilt = (found.stats.passed_fraction - black.stats.passed_fraction) * 32 * 36 * 24
    assert found.stats.dropped_samples == round(spoilt) > 100
    assert np.array_equal(found.layers.variance, black.layers.variance)


def rewritten(part: Path, change: Callable[[dict[str, bytes]], None], compression: int = zipfile.ZIP_STORED) -> None:
    with zipfile.ZipFile(part) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    with zipfile.ZipFile(part, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def about(**changes: Any) -> Callable[[dict[str, bytes]], None]:
    def change(members: dict[str, bytes]) -> None:
        members["about.json"] = json.dumps(json.loads(members["about.json"]) | changes).encode()

    return change


def array(name: str, values: Any, **options: Any) -> Callable[[dict[str, bytes]], None]:
    out = io.BytesIO()
    np.save(out, values, **options)
    return lambda members: members.update({name: out.getvalue()})


WRONG: dict[str, Callable[[Path], Any]] = {
    "empty": lambda p: p.write_bytes(b""),
    "half": lambda p: p.write_bytes(p.read_bytes()[: p.stat().st_size // 2]),
    "one bit of the sums": lambda p: p.write_bytes(flipped(p.read_bytes(), p.stat().st_size // 2)),
    "a directory far away": lambda p: p.write_bytes(p.read_bytes()[:-3] + b"\x7f" + p.read_bytes()[-2:]),
    "compressed": lambda p: rewritten(p, lambda _: None, zipfile.ZIP_DEFLATED),
    "a member less": lambda p: rewritten(p, lambda m: m.pop("done.npy")),
    "sums of another type": lambda p: rewritten(p, array("sums.npy", np.zeros((36 * 24, 8), np.int64))),
    "sums beyond float32": lambda p: rewritten(p, array("sums.npy", np.full((36 * 24, 8), 1e39))),
    "sums that are not finite": lambda p: rewritten(p, array("sums.npy", np.full((36 * 24, 8), np.nan))),
    "pickled": lambda p: rewritten(p, array("done.npy", np.array([print], object), allow_pickle=True)),
    "too many passes": lambda p: rewritten(p, array("done.npy", np.array([2**60]))),
    "deep JSON": lambda p: rewritten(p, lambda m: m.update({"about.json": b"[" * 100_000})),
    "long settings": lambda p: rewritten(p, about(more="x" * (8 << 20))),
    "another format": lambda p: rewritten(p, about(format=2)),
    "huge number of samples": lambda p: rewritten(p, about(samples=10**30)),
    "a time beyond floats": lambda p: rewritten(p, about(spent=dict.fromkeys(SPENT, 10**400))),
    "a time of an age": lambda p: rewritten(p, about(spent=dict.fromkeys(SPENT, 1e308))),
    "a time before the start": lambda p: rewritten(p, about(spent=dict.fromkeys(SPENT, -1.0))),
    "impossible time": lambda p: rewritten(p, about(spent={"seconds": float("inf")})),
}


def flipped(content: bytes, at: int) -> bytes:
    return content[:at] + bytes([content[at] ^ 4]) + content[at + 1 :]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    part = tmp_path_factory.mktemp("kept") / "a.exr.part"
    kept_render(part)
    return part.read_bytes()


@pytest.mark.parametrize("wrong", WRONG)
def test_a_checkpoint_that_is_not_whole_is_one_error(wrong: str, whole: bytes, tmp_path: Path) -> None:
    part = tmp_path / "a.exr.part"
    part.write_bytes(whole)
    WRONG[wrong](part)
    with pytest.raises(InputError) as refused:
        kept_render(part)
    assert str(refused.value).startswith(f"{part}: ") and "--restart" in str(refused.value)
    assert len(str(refused.value)) < 400


def test_a_checkpoint_that_does_not_fit_the_disk_leaves_the_older_one_and_the_render_goes_on(tmp_path: Path) -> None:
    part, told = tmp_path / "a.exr.part", []  # type: ignore[var-annotated]
    kept_render(part)
    before = part.read_bytes()
    with files_of_at_most(20_000):
        found = kept_render(part, samples=32, watch=Watch(checkpoint=part, keep=True, note=told.append))
    assert found.stats.complete and told == [f"checkpoint not written: {part}: File too large"]
    assert part.read_bytes() == before and os.listdir(tmp_path) == [part.name]


def test_time_left_does_not_count_what_only_the_first_rays_wait_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """12 s of compiling, then 1% of the work every half second: 98% take 49 s, not the 20 minutes of 1% in 12 s."""
    film, seen, clock = SimpleNamespace(fraction=0.0, seconds=[0.0, 0.0]), list[float | None](), [0.0]
    monkeypatch.setattr(renderer.time, "perf_counter", lambda: clock[0])
    keeper = Keeper(cast(Any, SimpleNamespace(film=film)), Watch(), lambda _, left=None: seen.append(left))
    for clock[0], film.fraction in ((12.0, 0.0), (12.0, 0.01), (12.5, 0.02)):
        keeper()
    assert seen == [None, pytest.approx(49)]
