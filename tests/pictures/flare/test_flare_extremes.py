"""Flare of lights and lenses at the edges: finite pictures or clear errors, bounded memory, an end when asked."""

import math
import os
import signal
import threading
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from neurolens.cameras.build import make_camera
from neurolens.cameras.field import field_of
from neurolens.cli import main
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens
from neurolens.pictures.flare import layers, lights
from neurolens.pictures.flare.canvas import Raster
from neurolens.pictures.flare.ghosts import GhostTracer
from neurolens.pictures.flare.job import FlareJob
from neurolens.pictures.flare.layers import photon_picture
from neurolens.pictures.flare.lights import Light, flat_shape, highlights, sides_across
from neurolens.pictures.flare.photons import PhotonTracer
from neurolens.pictures.render.pictures import read_exr, write_exr
from neurolens.pictures.render.settings import FlareSettings

COOKE = ["flare", "cooke_triplet_50", "--film", "36x24", "--bins", "2", "--cell", "4", "--width", "36", "--quiet"]


@pytest.mark.parametrize(
    "light", ["0,0", "89,0", "0,-89.9", "60,60", "0,0,1,0.1", "5,3,1,0.05", "3,2,0", "3,2,1e19", "3,2,1e-20"]
)
def test_any_light_before_the_lens(tmp_path: Path, light: str) -> None:
    """On the axis, far beside it, inside the near focus, dark and dazzling: finite, of no negative luminance."""
    out = tmp_path / "a.exr"
    assert main([*COOKE, "--light", light, "-o", str(out)]) == 0
    picture = read_exr(out)[0]
    assert picture.shape == (24, 36, 3) and np.isfinite(picture).all()
    assert (picture @ [0.2126, 0.7152, 0.0722] >= -1e-6 * picture.max()).all()
    assert picture.any() == (light not in ("89,0", "0,-89.9", "60,60", "3,2,0"))


def test_no_light_is_a_black_picture_and_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A list behind the lens, a plate without highlights."""
    behind = tmp_path / "behind.csv"
    behind.write_text("azimuth_deg,elevation_deg\n180,0\n")
    plate, out = tmp_path / "plate.exr", tmp_path / "a.exr"
    write_exr(plate, np.full((24, 36, 3), 1.9))
    for words, said in (
        (["--lights", str(behind)], "1 lights of lists stand behind the lens"),
        (["--image", str(plate)], "no light"),
    ):
        assert main([*COOKE[:-1], *words, "--layers", "2", "-o", str(out)]) == 0
        assert said in capsys.readouterr().err
        assert not read_exr(out)[0].any()


def test_a_lamp_so_far_that_nothing_arrives_leaves_nothing() -> None:
    """A disc of 0.2 m, 1,000 km away: each of its patches sends less than floats hold."""
    lens, ahead = set_lens(read_lens("lenses/cooke_triplet_50.toml")), np.array([0.0, 0.0, -1.0])
    for far_m in (1e6, 1e9):
        lamp = replace(Light(0, 0, (6e-19, 6e-19, 2e-19), far_m), shape=flat_shape(ahead, 1e-12 * sides_across(ahead)))
        job = FlareJob(lens, [lamp], Raster((36.0, 24.0), 24, 16), FlareSettings(bins=2, cell_px=64.0))
        assert all(np.isfinite(v).all() and v.max() < 1e-12 for v in layers.flare_layers(job).values())


def test_as_many_lights_as_pixels_take_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bright pixels, each a region of its own, took 550 bytes each; their sums alone take 128."""
    monkeypatch.setattr(lights, "_AT_ONCE", 1 << 14)
    n, film = 1600, (24.0, 24.0)
    camera = make_camera("pinhole", Shot(film_mm=film, focus_m=math.inf, focal_length_mm=50.0))
    field = field_of(camera, math.inf, "equidistant")
    picture = np.zeros((n, n, 3), np.float32)
    picture[::2, ::2] = 10.0
    picture[100, 100] = 1000.0
    tracemalloc.start()
    found = highlights(picture, field, film, 2.0, 2)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found.of == n * n // 4 and max(found.lights[0].rgb) > 50 * max(found.lights[1].rgb)
    assert peak < 300 * found.of


def test_nested_rings_take_memory_and_time_by_their_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thousand regions whose boxes hold each other: they took the boxes' areas, 1.7 GB and 11 s at 2000 pixels."""
    n, film = 400, (24.0, 24.0)
    camera = make_camera("pinhole", Shot(film_mm=film, focus_m=math.inf, focal_length_mm=50.0))
    field = field_of(camera, math.inf, "equidistant")
    y, x = np.mgrid[:n, :n]
    ring = np.minimum(np.minimum(x, y), n - 1 - np.maximum(x, y))
    picture = np.repeat((10.0 * (ring % 2 == 0)).astype(np.float32)[..., None], 3, 2)
    monkeypatch.setattr(lights, "_AT_ONCE", 5000)
    found = highlights(picture, field, film, 2.0, 10_000)
    # Of each ring: the cells of 8 pixels that it crosses, counted from its corner.
    cells = 0
    for k in range(0, n // 2, 2):
        side = n - 2 * k
        across = -(-side // round(n / 48)) if side > 2 * round(n / 48) else 1
        cells += 1 if across == 1 else 4 * across - 4
    assert found.of == cells and found.dropped == 0
    alone = highlights(picture, field, film, 2.0, 1)
    assert alone.lights == found.lights[:1] and 0.99 < alone.dropped < 1
    # Radiance is 10 / cos^4, a pixel's solid angle cos^3 times its area: the sum over the rings of area / cos.
    place = (np.stack([x, y]) + 0.5) * 24.0 / n - 12
    to = np.sqrt(50.0**2 + (place**2).sum(0))
    expected = 10 * (24.0 / n) ** 2 * (to / 50.0 / 50.0**2)[ring % 2 == 0].sum()
    assert sum(light.rgb[0] for light in found.lights) == pytest.approx(expected, rel=1e-3)


def cooke() -> Lens:
    return set_lens(read_lens(Path(__file__).parents[3] / "lenses" / "cooke_triplet_50.toml"), focus_m=math.inf)


def interrupted_after(seconds: float, words: list[str], made: Path | None = None) -> int:
    """The exit code of a command that is interrupted so long after its start, or once this file is there."""

    def interrupt() -> None:
        while made is not None and not made.exists() and threading.main_thread().is_alive():
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    timer = threading.Timer(seconds, interrupt)
    timer.daemon = True
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # tests in the background of a shell ignore it
    timer.start()
    try:
        return main(words)
    finally:
        timer.cancel()
        signal.signal(signal.SIGINT, before)


def test_a_thousand_million_photons_end_when_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "a.exr"
    words = [*COOKE, "--light", "5,3", "--photons", "1000000000", "-o", str(out)]
    assert interrupted_after(1.5, words) == 130
    assert "nothing is written" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_photons_go_on_where_they_were_interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same picture to the bit, without the wavelengths that were done; of a damaged file or another seed nothing is
    taken."""
    beside, keep, started = tmp_path / "a.exr", tmp_path / "a.exr.flare.part", list[float]()
    plain = FlareJob(cooke(), [Light(5.0, 3.0)], Raster((36.0, 24.0), 36, 24), threads=1)
    monkeypatch.setattr(layers, "_KEEP_S", -1.0)
    monkeypatch.setattr(layers, "_KNOWN", 1)  # six wavelengths, not thirty
    trace = PhotonTracer.trace
    monkeypatch.setattr(
        PhotonTracer, "trace", lambda self, r, nm, **k: (started.append(nm), trace(self, r, nm, **k))[1]
    )

    def drawn(seed: int = 0, keep: Path | None = beside, end: float = 2.0) -> np.ndarray:
        def done(share: float) -> None:
            if share >= end:
                raise KeyboardInterrupt

        started.clear()
        return photon_picture(replace(plain, settings=FlareSettings(bins=6, seed=seed), keep=keep), "flare", 2000, done)

    wanted, other = drawn(keep=None), drawn(seed=1, keep=None)
    with pytest.raises(KeyboardInterrupt):
        drawn(end=0.6)
    saved = keep.read_bytes()
    assert 4 <= len(started) <= 5 and np.array_equal(drawn(), wanted) and len(started) == 3  # three were kept
    keep.write_bytes(saved)
    assert np.array_equal(drawn(seed=1), other) and len(started) == 6
    for bad in (saved[:-1], saved[:100] + b"x" + saved[101:], b"", bytes(len(saved))):
        keep.write_bytes(bad)
        assert np.array_equal(drawn(), wanted) and len(started) == 6


def test_frames_end_when_asked_and_are_whole(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "a.exr"
    assert main([*COOKE, "--light", "5,3", "--frames", "1:1", "-o", str(out)]) == 0
    words = [*COOKE, "--light", "5,3", "--frames", "1:2000", "-o", str(out)]
    assert interrupted_after(0.0, words, tmp_path / "a.0003.png") == 130
    assert "goes on" in capsys.readouterr().err
    files = sorted(tmp_path.glob("*.exr"))
    assert [file.name for file in files] == [f"a.{k + 1:04d}.exr" for k in range(len(files))]
    assert all(file.with_suffix(".png").is_file() for file in files)
    assert all(read_exr(file)[0].any() for file in files)


def test_total_reflection_inside() -> None:
    """A plano-convex glass, its dome behind: beyond R / n light is totally reflected, and no book loses it."""
    n, radius, gap = 1.8, 10.5, 30.0
    rows = Surface(math.inf, 12.0, 20.0, n), Surface(-radius, gap, 20.0, stop=True)
    lens = Lens("dome", "", rows, 2.0, film_z_mm=12.0 + gap)
    height = np.linspace(0, 9.9, 1000)
    rays = np.stack([height, 0 * height, 0 * height - 1, 0 * height, 0 * height, 1 + 0 * height])
    found = GhostTracer(lens).trace(rays, 550.0, direct=True)
    through = found.power[-1] > 0
    assert through[height < radius / n - 0.02].all() and not through[height > radius / n + 0.02].any()
    assert np.isfinite(found.power).all() and np.all((found.power >= 0) & (found.power <= 1))
    books = PhotonTracer(lens).trace(np.repeat(rays, 20, 1), 550.0, most_reflections=1000)
    assert books.reflections.size + books.left + books.stopped + books.absorbed + books.cut == books.cast == 20_000
