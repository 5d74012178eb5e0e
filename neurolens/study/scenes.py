"""Scenes of an experiment: renders through every camera, compared with the exact lens's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from neurolens.base.progress import Report
from neurolens.cameras.build import ideal_as
from neurolens.cameras.contract import Camera, FloatArray
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.model import OnnxCamera, load_model
from neurolens.graph.compiler import has_compiler
from neurolens.lens.paraxial import first_order
from neurolens.lens.prescription import Lens
from neurolens.lens.shot import Shot
from neurolens.render.colour import SpectralRange
from neurolens.render.job import camera_axes
from neurolens.render.pictures import standard_attributes, write_exr, write_png
from neurolens.render.primitives import Rays
from neurolens.render.renderer import render
from neurolens.render.scene import CameraSettings, Scene, load_scene
from neurolens.render.world import world_of
from neurolens.study.experiment import RenderChoice
from neurolens.study.image import compare, flip_map
from neurolens.study.plots import side_by_side
from neurolens.surrogates.model import Domain

EXACT = "exact"


@dataclass
class Pictures:
    """Records for `results.json`: pictures, cameras, figures."""

    images: list[dict[str, Any]] = field(default_factory=list)
    cameras: list[dict[str, Any]] = field(default_factory=list)
    figures: list[dict[str, Any]] = field(default_factory=list)


def scene_cameras(
    lens: Lens, domain: Domain, models: Mapping[str, Path], shot: CameraSettings, fused: bool = False
) -> dict[str, Camera]:
    """Exact lens, each model, thin lens and pinhole, set as a scene's [camera] asks; no wider than the lens opens.

    All are in best focus, and show the plane in focus at one size. Lens and models as C if `fused`.
    """
    widest = first_order(lens).f_number
    # The same light for all cameras.
    real = Shot(shot.film_mm, shot.focus_m, max(shot.f_number or widest, widest), wavelength_nm=shot.wavelength_nm)
    exact = ExactCamera(lens, real, bounds=domain.bounds, runtime="c" if fused else "trace")
    runtime: Literal["c", "onnxruntime"] = "c" if fused else "onnxruntime"
    fitted = {name: OnnxCamera(load_model(file), real, runtime=runtime) for name, file in models.items()}
    thin, pinhole = (ideal_as(kind, exact.lens, real) for kind in ("thin:", "pinhole:"))
    return {EXACT: exact, **fitted, "thin lens": thin, "pinhole": pinhole}


def render_all(
    choice: RenderChoice, lens: Lens, domain: Domain, models: Mapping[str, Path], folder: Path, report: Report
) -> Pictures:
    """Every scene through every camera with several seeds: for the noise floor, and their mean as the picture."""
    records, fused = Pictures(), choice.fused and has_compiler()
    scenes = [load_scene(path) for path in choice.scenes]
    done, total = 0, len(scenes) * (3 + len(models)) * choice.seeds
    for scene in scenes:
        film = replace(scene.settings.film, wavelengths="one")  # for every camera: they share their random numbers
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
            share, record = stats["camera_fraction"], {"name": name, "scene": scene.name, "render_s": stats["seconds"]}
            record |= {"camera_s": share * stats["seconds"], "camera_share": share}
            records.cameras.append(record | {key: stats[key] for key in ("samples", "width", "height", "threads")})
            metadata = {"render": result.stats, "camera": camera.settings, "mean_of_renders": choice.seeds}
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
        record: dict[str, Any] = {"name": f"{scene.name}, {name}", "scene": scene.name, "camera": name}
        record |= {f"file_{kind}": f"{folder.name}/{_stem(scene, name)}.{kind}" for kind in ("png", "exr")}
        record["samples"] = choice.samples * choice.seeds
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
    """Depths [N] of what a camera's chief rays of film points [2, N] meet, in m from the film plane along the axis.

    inf where they meet nothing, NaN where no light passes.
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


def domain_facts(lens: Lens, domain: Domain) -> dict[str, Any]:
    """A domain as a flat table, units in the keys."""
    return {
        "film_radius_mm": domain.film_radius_mm,
        "f_number": first_order(lens).f_number,
        "wavelength_nm": list(domain.wavelength_nm),
        "focus_m": ["infinity" if f == float("inf") else f for f in domain.focus_m],
        "nearest_m": domain.nearest_m,
    }
