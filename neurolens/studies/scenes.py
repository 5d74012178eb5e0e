"""Scenes of an experiment, rendered through every camera, compared with the exact lens's and put side by side.

The image error is the relative MSE on linear radiance and FLIP on a display, each beside its noise floor.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base.errors import InputError, NeurolensError, pip_install
from neurolens.base.progress import Report
from neurolens.base.report import plain
from neurolens.base.status import DOMAIN_SLACK
from neurolens.cameras.build import ideal_as
from neurolens.cameras.contract import Camera, FloatArray
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.model import OnnxCamera, load_model
from neurolens.graph.compiler import has_compiler
from neurolens.models.fitted import Domain
from neurolens.optics.analysis.plots import drawing, plain_log_ticks
from neurolens.optics.lens.paraxial import film_z_mm, first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.lens.shot import Shot
from neurolens.pictures.render.colour import SpectralRange, linear_to_srgb
from neurolens.pictures.render.job import camera_axes
from neurolens.pictures.render.pictures import standard_attributes, write_exr, write_png
from neurolens.pictures.render.primitives import Rays
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.scene import CameraSettings, Scene, load_scene
from neurolens.pictures.render.world import world_of
from neurolens.studies.experiment import Pictures, RenderChoice
from neurolens.studies.plots import error_scale, log_norm

Image = NDArray[np.float64]

MIN_PAIRS = 4  # with fewer pairs the noise floor is too noisy to divide by
EPS = 1e-2  # squared radiance in the denominator of the relative MSE, so that dark pixels do not dominate the mean
PIXELS_PER_DEGREE = 67.0  # for FLIP, its authors' default: 0.7 m from a 4K display of 0.7 m width
# Settings of the comparison for a run's results; the exposure is a factor before the sRGB curve.
SETTINGS = {"exposure": 1.0, "pixels_per_degree": PIXELS_PER_DEGREE, "eps": EPS}


def checked_image(image: ArrayLike, name: str) -> Image:
    """Return `image` as float64 [H, W, 3].

    Raises:
        InputError: the picture has another shape, no pixels, or values that are not finite; `name` names it.
    """
    array = np.asarray(image)
    if array.ndim != 3 or array.shape[2] != 3 or array.size == 0:
        raise InputError("image", f"{name}, shape", f"({array.shape})", "[height, width, 3] linear RGB")
    if not np.issubdtype(array.dtype, np.floating):
        raise InputError("image", f"{name}, type", str(array.dtype), "floating-point linear radiance, not 8-bit values")
    array = array.astype(np.float64)
    bad = int(np.count_nonzero(~np.isfinite(array)))
    if bad:
        raise InputError("image", f"{name}, values", f"({bad} values not finite)", "finite linear RGB")
    return array


def _checked_pair(test: ArrayLike, reference: ArrayLike) -> tuple[Image, Image]:
    a, b = checked_image(test, "test"), checked_image(reference, "reference")
    if a.shape != b.shape:
        raise InputError("image", "test, shape", f"({a.shape})", f"the shape of the reference, {b.shape}")
    return a, b


def rel_mse(test: ArrayLike, reference: ArrayLike) -> float:
    """Return the relative mean squared error of linear radiance: the mean of (a - b)^2 / (b^2 + eps).

    It is over pixels and channels. Rousselle, Knaus, Zwicker 2011, "Adaptive sampling and reconstruction using greedy
    error minimization", with their eps = 0.01.

    Args:
        test, reference: [H, W, 3] linear RGB.
    Raises:
        InputError: shapes differ or are not [H, W, 3]; values are not finite.
    """
    a, b = _checked_pair(test, reference)
    return float(np.mean((a - b) ** 2 / (b**2 + EPS)))


def flip_map(test: ArrayLike, reference: ArrayLike) -> Image:
    """Return LDR-FLIP for each pixel, [H, W] in [0, 1]: what an observer sees when flipping between the two pictures.

    Andersson et al. 2020, "FLIP: a difference evaluator for alternating images", through their `flip-evaluator`.
    Linear RGB goes through `linear_to_srgb`; the viewing distance is that of `PIXELS_PER_DEGREE`.

    Raises:
        InputError: as `rel_mse`.
        NeurolensError: flip-evaluator is not installed.
    """
    a, b = _checked_pair(test, reference)
    try:
        import flip_evaluator
    except ImportError as error:
        raise NeurolensError(f"FLIP needs flip-evaluator: {pip_install('train')}") from error
    pictures = (np.ascontiguousarray(linear_to_srgb(x)) for x in (b, a))
    options = {"applyMagma": False, "computeMeanError": False, "parameters": {"ppd": PIXELS_PER_DEGREE}}
    errors, _, _ = flip_evaluator.evaluate(*pictures, "LDR", **options)
    return np.asarray(errors, dtype=np.float64).reshape(a.shape[:2])


def flip(test: ArrayLike, reference: ArrayLike) -> float:
    """Return the mean of `flip_map`: 0 for equal pictures, 1 at most."""
    return float(flip_map(test, reference).mean())


@dataclass(frozen=True)
class ImageErrors:
    """Errors of a camera's renders: means over `pairs` pairs; the noise floor is over all pairs of exact renders.

    Attributes:
        flip_paired: against the exact render with the same random numbers, where most noise cancels. It is what the
            camera itself changes, by which it should be judged.
        flip, rel_mse: against an exact render of another seed, noise included.
        paired_share: flip_paired over the noise floor; None where that is 0.
    """

    flip_paired: float
    paired_share: float | None
    flip: float
    rel_mse: float
    noise_floor_flip: float
    noise_floor_rel_mse: float
    pairs: int


def compare(renders: Sequence[ArrayLike], exact_renders: Sequence[ArrayLike]) -> ImageErrors:
    """Compare a surrogate's renders with exact ones, and with the noise floor.

    Render i of the surrogate is compared with exact render i, whose random numbers it shares (paired), and with exact
    render i + 1 (the last with the first), as two independent renders. The noise floor compares exact render i with
    that one.

    Args:
        renders: one or more [H, W, 3] linear renders; number i has the seed of exact render i.
        exact_renders: at least four, and at least as many as `renders`.

    Raises:
        InputError: there are too few renders, or pictures that do not fit each other.
    """
    count = len(exact_renders)
    if count < MIN_PAIRS:
        raise InputError("image", "renders of different seeds", count, f"at least {MIN_PAIRS}, for {MIN_PAIRS} pairs")
    if not (1 <= len(renders) <= count):
        raise InputError("image", "surrogate renders", len(renders), f"1 to {count}, one for each exact render")
    others = [*exact_renders[1:], exact_renders[0]]

    def mean(measure: Callable[..., float], tests: Sequence[ArrayLike], references: Sequence[ArrayLike]) -> float:
        return float(np.mean([measure(a, b) for a, b in zip(tests, references, strict=False)]))

    floor, paired = mean(flip, exact_renders, others), mean(flip, renders, exact_renders)
    return ImageErrors(
        flip_paired=paired,
        paired_share=paired / floor if floor > 0 else None,
        flip=mean(flip, renders, others),
        rel_mse=mean(rel_mse, renders, others),
        noise_floor_flip=floor,
        noise_floor_rel_mse=mean(rel_mse, exact_renders, others),
        pairs=len(renders),
    )


_COLUMNS = 4  # with more, each picture would be too small


def side_by_side(
    images: Mapping[str, ArrayLike], error_maps: Mapping[str, ArrayLike], path: str | Path,
    captions: Mapping[str, str] | None = None, title: str = "",
) -> Path:  # fmt: skip
    """Draw renders in rows of four, each with its FLIP error image below; one colour bar serves all of them.

    Args:
        images: linear RGB [H, W, 3] by name, shown through `linear_to_srgb`; all of one shape.
        error_maps: errors [H, W] by name; a name without one (the reference) keeps its place below for its caption. All
            share one logarithmic scale (`error_scale`), so that small errors show beside large ones.
        path: PNG, PDF or SVG to write.
        captions: by name, one or two lines shown below its picture.
    Raises:
        InputError: values are not finite.
    """
    pictures = {name: checked_image(image, name) for name, image in images.items()}
    maps = {name: np.asarray(error, dtype=np.float64) for name, error in error_maps.items()}
    low, high = error_scale(maps.values(), 99.5)
    height, width = next(iter(pictures.values())).shape[:2]
    rows, each = math.ceil(len(pictures) / _COLUMNS), 2 if maps else 1
    columns = math.ceil(len(pictures) / rows)
    wide = max(2.45, 7.6 / columns)
    note = {"xycoords": "axes fraction", "xytext": (0, -5), "textcoords": "offset points", "ha": "center", "va": "top"}
    with drawing(path, columns * wide + 1, rows * (each * wide * height / width + 1), title) as figure:
        figure.set_layout_engine("compressed", h_pad=0.06)  # for pictures, which keep their aspect
        grid = figure.subplots(each * rows, columns, squeeze=False)
        for axes in grid.flat:
            axes.set_axis_off()
        for k, (name, picture) in enumerate(pictures.items()):
            above, below = (grid[k // columns * each + i, k % columns] for i in (0, each - 1))
            above.imshow(linear_to_srgb(picture), interpolation="nearest")
            above.set_title(name, fontsize=10.5, fontweight="bold", pad=4)
            if name in maps:
                look = {"cmap": "magma", "norm": log_norm(low, high), "interpolation": "nearest"}
                shown = below.imshow(np.maximum(maps[name], low), **look)
            captioned = below if name in maps else above
            captioned.annotate((captions or {}).get(name, ""), (0.5, 0), fontsize=8.6, color="#444444", **note)
        if maps:
            label = "FLIP difference, no unit: 0 none, 1 the most (logarithmic, one scale for all)"
            bar = figure.colorbar(shown, ax=grid, label=label, aspect=40, extend="both")
            bar.outline.set_visible(False)
            plain_log_ticks(bar.ax.yaxis)
    return Path(path)


EXACT = "exact"


def scene_cameras(
    lens: Lens, domain: Domain, models: Mapping[str, Path], shot: CameraSettings, fused: bool = False
) -> dict[str, Camera]:
    """Make the exact lens, each model, a thin lens and a pinhole, set as a scene's [camera] asks if the lens can.

    All are in best focus, and show the plane in focus at one size. With `fused` lens and models run as C.
    """
    widest = first_order(lens).f_number
    # All cameras get the same light, and the lens focuses as its models do: as a whole.
    real = Shot(
        shot.film_mm, shot.focus_m, max(shot.f_number or widest, widest), focus_mode="best",
        wavelength_nm=shot.wavelength_nm, runtime=None if fused else "onnxruntime",
    )  # fmt: skip
    exact = ExactCamera(lens, real, bounds=domain.bounds)
    fitted = {name: OnnxCamera(load_model(file), real) for name, file in models.items()}
    thin, pinhole = (ideal_as(kind, exact.lens, real) for kind in ("thin:", "pinhole:"))
    return {EXACT: exact, **fitted, "thin lens": thin, "pinhole": pinhole}


def read_scenes(choice: RenderChoice, lens: Lens, domain: Domain) -> list[Scene]:
    """Read the scenes of an experiment.

    Raises:
        InputError: a scene has a mistake, or is focused at a distance that models of the domain do not reach.
    """
    (near, far), scenes = domain.film_z_mm, [load_scene(path) for path in choice.scenes]
    for path, scene in zip(choice.scenes, scenes, strict=True):
        focus_m = scene.settings.camera.focus_m
        inside = min(domain.focus_m) <= focus_m <= max(domain.focus_m)
        if not inside and not near / DOMAIN_SLACK <= film_z_mm(lens, focus_m) <= far * DOMAIN_SLACK:
            expected = f"a focus within the domain, {min(domain.focus_m):g} m to {max(domain.focus_m):g} m"
            raise InputError(str(path), "camera.focus_m", focus_m, expected)
    return scenes


def renders(choice: RenderChoice, lens: Lens, domain: Domain) -> Callable[[Mapping[str, Path], Path, Report], Pictures]:
    """Read the scenes of an experiment, and return what renders them; see `experiment.Renders`."""
    return partial(_render_all, choice, read_scenes(choice, lens, domain), lens, domain)


def _render_all(
    choice: RenderChoice, scenes: Sequence[Scene], lens: Lens, domain: Domain, models: Mapping[str, Path],
    folder: Path, report: Report,
) -> Pictures:  # fmt: skip
    """Render every scene through every camera with several seeds, for the noise floor; pictures are their mean."""
    records, fused = Pictures(settings=SETTINGS), choice.fused and has_compiler()
    done, total = 0, len(scenes) * (3 + len(models)) * choice.seeds
    for scene in scenes:
        film = replace(scene.settings.film, wavelengths="one")  # so that all cameras share their random numbers
        renders: dict[str, list[FloatArray]] = {}
        for name, camera in scene_cameras(lens, domain, models, scene.settings.camera, fused).items():
            for seed in range(choice.seeds):
                result = render(
                    scene, camera, width=choice.width, height=choice.height, samples=choice.samples, seed=seed,
                    threads=choice.threads, film=film,
                )  # fmt: skip
                renders.setdefault(name, []).append(result.rgb)
                done += 1
                report(done / total)
            stats = result.stats
            share, record = stats.camera_fraction, {"name": name, "scene": scene.name, "render_s": stats.seconds}
            record |= {"camera_s": share * stats.seconds, "camera_share": share, "samples": stats.samples}
            size = {key: stats.settings[key] for key in ("width", "height")}
            records.cameras.append(record | size | {"threads": stats.threads})
            metadata = {"render": plain(stats), "camera": camera.settings, "mean_of_renders": choice.seeds}
            file, mean = folder / f"{_stem(scene, name)}.exr", np.mean(renders[name], axis=0, dtype=np.float32)
            attributes = standard_attributes(camera.settings, choice.width, choice.height)
            write_exr(file, mean, half=True, metadata=metadata, attributes=attributes)
            write_png(file.with_suffix(".png"), mean)
        _compare_scene(records, scene, choice, renders, folder)
    return records


def _stem(scene: Scene, name: str) -> str:
    return f"{scene.name}-{name.replace(' ', '-')}"


def _compare_scene(
    records: Pictures, scene: Scene, choice: RenderChoice, renders: Mapping[str, list[FloatArray]], folder: Path
) -> None:
    exact = renders[EXACT]
    captions, maps = {}, {}
    for name, pictures in renders.items():
        record: dict[str, Any] = {
            "name": f"{scene.name}, {name}",
            "scene": scene.name,
            "camera": name,
            **{f"file_{kind}": f"{folder.name}/{_stem(scene, name)}.{kind}" for kind in ("png", "exr")},
            "samples": choice.samples * choice.seeds,
        }
        if name != EXACT:
            errors = compare(pictures, exact)
            record |= asdict(errors)
            captions[name] = (
                f"FLIP {errors.flip_paired:.3g} (noise {errors.noise_floor_flip:.3g})\n"
                f"relMSE {errors.rel_mse:.3g} (noise {errors.noise_floor_rel_mse:.3g})"
            )
            maps[name] = flip_map(np.mean(pictures, axis=0), np.mean(exact[: len(pictures)], axis=0))
        records.images.append(record)
    maps[EXACT] = flip_map(exact[0], exact[1])
    captions[EXACT] = "two seeds: the noise floor"
    file = folder / f"{scene.name}-side-by-side.png"
    shown = {name: np.mean(pictures, axis=0) for name, pictures in renders.items()}
    side_by_side(shown, maps, file, captions, title=f"{scene.name}, error against exact")
    caption = f"The mean of {choice.seeds} renders of {choice.samples} samples a pixel. Below each its FLIP difference "
    caption += "from the exact lens's with the same random numbers; below the exact lens that of two seeds."
    title = f"{scene.name}: every camera"
    records.figures.append({"file": f"{folder.name}/{file.name}", "title": title, "caption": caption, "wide": True})


def seen_depths_m(scene: Scene, camera: Camera, film_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return depths [N] of what chief rays of film points [2, N] meet, in m along the axis from the film.

    They are inf where rays meet nothing, and NaN where no light passes.
    """
    shot, count = scene.settings.camera, film_mm.shape[1]
    nanometres = np.full(count, np.mean(shot.wavelength_nm), np.float32)
    rays = camera.sample(film_mm.astype(np.float32), np.full((2, count), 0.5, np.float32), nanometres)
    axes, position = camera_axes(shot), np.array(shot.position_m, np.float32)[:, None]
    world = world_of(scene, SpectralRange(*shot.wavelength_nm), geometry=True)
    distance, _ = world.nearest(Rays.of(axes @ rays.origin_m + position, axes @ rays.direction))
    with np.errstate(invalid="ignore"):
        depth = -(rays.origin_m[2] + distance * rays.direction[2])  # the camera looks along -z
    return np.where(rays.weight > 0, np.where(np.isfinite(distance), depth, np.inf), np.nan)
