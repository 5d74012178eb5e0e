"""Equal time and equal samples: error of each camera's picture after given seconds, against the exact lens."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

import neurolens
from experiments import lab
from experiments.equal_time_errors import (
    Estimate,
    FilmMap,
    Floats,
    Law,
    bias_and_variance,
    film_map,
    paired_bias,
    reference_variance,
    squared_error,
    weights,
)
from neurolens.base.files import atomic_path, fingerprint_of, sha256_of
from neurolens.base.records import plain
from neurolens.cameras.contract import Camera
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.onnxlens import load_model
from neurolens.lens.shot import Shot
from neurolens.readers.lensfile import read_lens
from neurolens.render.renderer import render
from neurolens.render.scene import CameraSettings, Scene, files_named, load_scene
from neurolens.render.settings import FilmSettings
from neurolens.study import scenes
from neurolens.study.image import EPS, flip, flip_map
from neurolens.surrogates.model import Domain

EXACT, THIN = "exact", "thin lens"
LENS = "laikin_double_gauss_50"
# Name in the tables to the file in models/.
MODELS = {"ols-28": f"{LENS}.ols-28.onnx", "mlp-16x2": f"{LENS}.mlp-16x2.onnx"}
FUSED_EXACT = "fused exact"
EXACTS = (EXACT, FUSED_EXACT)


def scene_cameras(shot: CameraSettings) -> tuple[dict[str, Camera], ExactCamera]:
    """The cameras of a scene by name, the exact one first, and the exact one in float64 for film-space errors.

    All cameras of the lens have the pupil bounds of the models' domain: the same random numbers are the same rays.
    """
    lens = read_lens(lab.LENSES / f"{LENS}.toml")
    files = {name: lab.MODELS / file for name, file in MODELS.items()}
    domain = Domain.from_dict(load_model(files["ols-28"]).card["domain"])
    plain = scenes.scene_cameras(lens, domain, files, shot)
    fused = scenes.scene_cameras(lens, domain, {"mlp-16x2": files["mlp-16x2"]}, shot, fused=True)
    cameras = {EXACT: plain[EXACT], **{name: plain[name] for name in files}}
    cameras |= {"fused mlp-16x2": fused["mlp-16x2"], FUSED_EXACT: fused[EXACT], THIN: plain[THIN]}
    focus_m, f_number = (plain[EXACT].settings[name] for name in ("focus_m", "f_number"))
    real = Shot(plain[EXACT].film_mm, focus_m, f_number, wavelength_nm=shot.wavelength_nm)
    truth = ExactCamera(lens, real, dtype="float64", bounds=domain.bounds)
    return cameras, truth


# Folders that a picture depends on.
_SOURCES = ("base", "graph", "lens", "trace", "setting", "readers", "surrogates", "cameras", "render")


class Shelf:
    """The renders of one scene through one camera, in a folder whose name has the hash of all that they depend on."""

    def __init__(
        self, run: Path, file: Path, scene: Scene, name: str, camera: Camera, film: FilmSettings, size: tuple[int, int]
    ) -> None:
        package, model = Path(neurolens.__file__).parent, camera.settings.get("model")
        read = [f for part in _SOURCES for f in sorted((package / part).rglob("*.py"))]
        read += [file, *(file.parent / named for named in files_named(scene.settings)), *([model] if model else [])]
        about = [[sha256_of(f) for f in read], plain(camera.settings), plain(film.__dict__), size]
        digest = fingerprint_of([neurolens.__version__, *about])
        self.folder = run / scene.name / f"{name.replace(' ', '-')}-{digest[:16]}"
        self.size = size
        self.render = partial(render, scene, camera, width=size[0], height=size[1], film=film)

    def file(self, samples: int, seed: int, threads: int) -> Path:
        return self.folder / f"{samples}-{seed}-{threads}.npz"

    def take(self, samples: int, seed: int, threads: int) -> tuple[NDArray[np.float32], float]:
        """The picture [H, W, 3] and the seconds that it took, rendered or as an earlier run left it.

        A file that is broken is made again. Raises what `render` does.
        """
        file = self.file(samples, seed, threads)
        kept = _read(file, (*self.size[::-1], 3))
        if kept is not None:
            return kept
        made = self.render(samples=samples, seed=seed, threads=threads)
        self.folder.mkdir(parents=True, exist_ok=True)
        with atomic_path(file) as temporary:
            np.savez(temporary, rgb=made.rgb, seconds=np.float64(made.stats["seconds"]))
        return made.rgb, float(made.stats["seconds"])

    def warm_up(self) -> None:
        """An untimed sample per pixel: the first render of a camera loads code and fills caches."""
        self.render(samples=1, threads=1)


def _read(file: Path, shape: tuple[int, ...]) -> tuple[NDArray[np.float32], float] | None:
    try:
        with np.load(file, allow_pickle=False) as kept:
            rgb, seconds = kept["rgb"], float(kept["seconds"])
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    good = rgb.shape == shape and rgb.dtype == np.float32 and np.isfinite(rgb).all() and seconds > 0
    return (rgb, seconds) if good else None


SCENES = ("grid", "lights", "room")
# Weight of a squared error: that of the RMSE, and of the relative MSE.
MEASURES: dict[str, float | None] = {"mse": None, "rel_mse": EPS}
_PASS_SEED, _SHORT_SEED, _REFERENCE_SEED = 100, 1000, 1_000_000


@dataclass(frozen=True)
class Counts:
    """The amount of rendering.

    Attributes:
        size: width and height in pixels.
        short: samples of the renders shorter than a pass, each `repeats` times. pass_samples, passes: of a pass, and
            how many. reference: samples of each half of the reference, rendered in `parts` with a seed each.
    """

    size: tuple[int, int] = (160, 90)
    short: tuple[int, ...] = (1, 2, 4, 8, 16, 32)
    repeats: int = 4
    pass_samples: int = 64
    passes: int = 8
    reference: int = 2048
    parts: int = 2

    @property
    def jobs(self) -> list[tuple[int, int]]:
        """(samples, seed) of the renders through each camera, passes last."""
        short = [(n, _SHORT_SEED * (i + 1) + k) for k in range(self.repeats) for i, n in enumerate(self.short)]
        return short + [(self.pass_samples, _PASS_SEED + k) for k in range(self.passes)]


QUICK = Counts((64, 36), (1, 2, 4, 8), 2, 16, 4, 256, 1)


@dataclass(frozen=True)
class Level:
    """Renders of one sample count: seconds best and median, mean squared errors and FLIP against the reference."""

    samples: int
    seconds_min: float
    seconds_median: float
    mse: float
    rel_mse: float
    flip: float


@dataclass(frozen=True)
class CameraResult:
    """One camera in one scene.

    Attributes:
        levels: by samples. pass_s: best and median seconds of a pass.
        bias2: by measure, against the exact camera with the same random numbers; the exact camera's is 0.
        extrapolated2: by measure, bias^2 from the camera's own passes and the reference.
        variance: by measure, of a pass. flip_same: FLIP of the mean picture against the exact camera's, same numbers.
        picture: [H, W, 3] mean of the passes. flip_map: [H, W] of it against the reference.
        film: where its rays land on the film.
    """

    name: str
    levels: tuple[Level, ...]
    pass_s: tuple[float, float]
    bias2: dict[str, Estimate]
    extrapolated2: dict[str, Estimate]
    variance: dict[str, Estimate]
    flip_same: float
    picture: Floats
    flip_map: Floats
    film: FilmMap

    def law(self, measure: str, bias2: float | None = None) -> Law:
        """Error over time of a measure; `bias2` stands in for the estimate, which is taken as 0 where negative."""
        known = max(self.bias2[measure].value, 0.0) if bias2 is None else bias2
        points = [(level.seconds_min, getattr(level, measure)) for level in self.levels]
        first = tuple(sorted((t, e) for t, e in points if t < self.pass_s[0] and e > 0))
        return Law(known, self.variance[measure].value, self.pass_s[0], first)


@dataclass(frozen=True)
class SceneResult:
    """All cameras in one scene; `noise2` is the reference's own variance by measure, `flip_halves` its halves' FLIP."""

    name: str
    settings: CameraSettings
    f_number: float
    counts: Counts
    threads: int
    reference: Floats
    noise2: dict[str, float]
    flip_halves: float
    cameras: dict[str, CameraResult]


def measure_scene(file: Path, run: Path, counts: Counts, threads: int, report: lab.Report) -> SceneResult:
    """Render and measure one scene; what an earlier run left in `run` is not rendered again."""
    torch.set_num_threads(1)  # in this process; workers do so themselves
    scene = load_scene(file)
    shot = scene.settings.camera
    cameras, truth = scene_cameras(shot)
    film = replace(scene.settings.film, wavelengths="one")  # for every camera: they share their random numbers
    shelves = {name: Shelf(run, file, scene, name, c, film, counts.size) for name, c in cameras.items()}
    halves, rendered = _render(shelves, counts, threads, report)
    maps = {name: film_map(truth, c, wavelengths_nm=shot.wavelength_nm) for name, c in cameras.items()}
    reference = (halves[0] + halves[1]) / 2
    by = {measure: weights(reference, eps) for measure, eps in MEASURES.items()}
    found = {
        name: camera_result(name, pictures, rendered[EXACT], halves, by, counts, maps[name])
        for name, pictures in rendered.items()
    }
    noise2 = {measure: reference_variance(halves, weight) for measure, weight in by.items()}
    f_number = float(cameras[EXACT].settings["f_number"])
    apart = flip(halves[0], halves[1])
    return SceneResult(scene.name, shot, f_number, counts, threads, reference, noise2, apart, found)


@dataclass(frozen=True)
class Rendered:
    """Pictures [H, W, 3] and seconds of one camera, in the order of `Counts.jobs`."""

    pictures: list[Floats]
    seconds: list[float]


def _render(
    shelves: Mapping[str, Shelf], counts: Counts, threads: int, report: lab.Report
) -> tuple[list[Floats], dict[str, Rendered]]:
    """The reference's halves, and every camera's renders; the cameras take turns, so that load affects all equally."""
    jobs = counts.jobs
    total = 2 * counts.reference + len(shelves) * sum(n for n, _ in jobs)
    done, halves = 0, []
    for half in range(2):
        pictures, part = [], counts.reference // counts.parts
        for k in range(counts.parts):
            seed = _REFERENCE_SEED + half * counts.parts + k
            pictures.append(shelves[EXACT].take(part, seed, threads=2)[0].astype(np.float64))
            done += part
            report(done / total)
        halves.append(np.mean(pictures, axis=0))
    rendered = {name: Rendered([], []) for name in shelves}
    for kept in shelves.values():
        if not all(kept.file(n, seed, threads).exists() for n, seed in jobs):
            kept.warm_up()
    for samples, seed in jobs:
        for name, kept in shelves.items():
            rgb, seconds = kept.take(samples, seed, threads)
            rendered[name].pictures.append(rgb.astype(np.float64))
            rendered[name].seconds.append(seconds)
            done += samples
            report(done / total)
    return halves, rendered


def camera_result(
    name: str,
    own: Rendered,
    exact: Rendered,
    halves: list[Floats],
    by: Mapping[str, Floats],
    counts: Counts,
    film: FilmMap,
) -> CameraResult:
    """The errors of a camera's renders against the exact lens's and the reference's halves; weights `by` measure."""
    passes, others = np.stack(own.pictures[-counts.passes :]), np.stack(exact.pictures[-counts.passes :])
    times = own.seconds[-counts.passes :]
    both = {measure: bias_and_variance(passes, halves, weight) for measure, weight in by.items()}
    picture, reference = passes.mean(axis=0), (halves[0] + halves[1]) / 2
    return CameraResult(
        name,
        tuple(_levels(own, halves, by, counts)),
        (min(times), float(np.median(times))),
        {measure: paired_bias(passes, others, weight) for measure, weight in by.items()},
        {measure: b for measure, (b, _) in both.items()},
        {measure: v for measure, (_, v) in both.items()},
        flip(picture, others.mean(axis=0)),
        picture,
        flip_map(picture, reference),
        film,
    )


def _levels(own: Rendered, halves: list[Floats], by: Mapping[str, Floats], counts: Counts) -> Iterator[Level]:
    """Errors by sample count: of the short renders, then of as many passes as fit, in groups that share none."""
    reference = (halves[0] + halves[1]) / 2

    def level(samples: int, pictures: list[Floats], seconds: list[float]) -> Level:
        errors = {m: float(np.mean([squared_error(p, halves, w) for p in pictures])) for m, w in by.items()}
        seen = float(np.mean([flip(p, reference) for p in pictures]))
        return Level(samples, min(seconds), float(np.median(seconds)), errors["mse"], errors["rel_mse"], seen)

    order = [n for n, _ in counts.jobs]
    for samples in counts.short:
        mine = [k for k, n in enumerate(order) if n == samples]
        yield level(samples, [own.pictures[k] for k in mine], [own.seconds[k] for k in mine])
    passes, times = own.pictures[-counts.passes :], own.seconds[-counts.passes :]
    for together in (2**k for k in range(int(math.log2(counts.passes)) + 1)):
        groups = [passes[k : k + together] for k in range(0, counts.passes - together + 1, together)]
        pictures = [np.mean(group, axis=0) for group in groups]
        yield level(together * counts.pass_samples, pictures, [together * t for t in times])


def scene_file(name: str) -> Path:
    """The file of a scene of the project by name, or of any by its path; read, so that mistakes are found before the
    work.

    Raises:
        InputError: as `load_scene`.
    """
    file = lab.SCENES / f"{name}.toml" if name in SCENES else Path(name)
    load_scene(file)
    return file
