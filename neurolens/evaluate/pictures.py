"""Renders scenes through every camera of a run and compares the pictures with the exact lens's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from neurolens.base.progress import Report
from neurolens.cameras.contract import Camera, FloatArray
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.model import OnnxCamera, load_model
from neurolens.cameras.pinhole import Pinhole
from neurolens.cameras.thin import ThinLens
from neurolens.evaluate.experiment import RenderChoice
from neurolens.evaluate.image import compare, error_maps
from neurolens.evaluate.plots import image_caption, side_by_side
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Lens
from neurolens.render.pictures import write_exr, write_png
from neurolens.render.renderer import render
from neurolens.render.scene import CameraSettings, Scene, load_scene
from neurolens.surrogates.domain import Domain

EXACT = "exact"


@dataclass
class Pictures:
    """Records for `results.json`: pictures, cameras, figures."""

    images: list[dict[str, Any]] = field(default_factory=list)
    cameras: list[dict[str, Any]] = field(default_factory=list)
    figures: list[dict[str, Any]] = field(default_factory=list)


def scene_cameras(lens: Lens, domain: Domain, models: Mapping[str, Path], shot: CameraSettings) -> dict[str, Camera]:
    """Exact lens, each model, thin lens and pinhole, set as a scene's [camera] asks; no wider than the lens opens."""
    film = (shot.film_width_mm, shot.film_height_mm)
    data = first_order(lens)
    f_number = max(shot.f_number or data.f_number, data.f_number)
    # The same light for all: exposures are for it.
    real: dict[str, Any] = {"film_mm": film, "focus_m": shot.focus_m, "f_number": f_number}
    real["wavelength_nm"] = shot.wavelengths_nm
    cameras: dict[str, Camera] = {EXACT: ExactCamera(lens, bounds=domain.bounds, **real)}
    for name, file in models.items():
        cameras[name] = OnnxCamera(load_model(file), **real)
    cameras["thin lens"] = ThinLens(data.efl_mm, f_number, shot.focus_m, film)
    cameras["pinhole"] = Pinhole(data.efl_mm, film, f_number)
    return cameras


def render_all(
    choice: RenderChoice, lens: Lens, domain: Domain, models: Mapping[str, Path], folder: Path, report: Report
) -> Pictures:
    """Every scene through every camera; the exact lens and the models with several seeds, for the noise floor."""
    found = Pictures()
    scenes = [load_scene(path) for path in choice.scenes]
    done, total = 0, len(scenes) * ((1 + len(models)) * choice.seeds + 2)
    for scene in scenes:
        film = replace(scene.settings.film, wavelengths="one")  # for every camera: they share their random numbers
        renders: dict[str, list[FloatArray]] = {}
        for name, camera in scene_cameras(lens, domain, models, scene.settings.camera).items():
            seeds = choice.seeds if name == EXACT or name in models else 1
            for seed in range(seeds):
                result = render(
                    scene,
                    camera,
                    width=choice.width,
                    height=choice.height,
                    samples=choice.samples,
                    seed=seed,
                    threads=choice.threads,
                    film=film,
                )
                renders.setdefault(name, []).append(result.rgb)
                if seed == 0:
                    found.cameras.append(_camera_record(scene, name, result.stats))
                    _save(folder, scene, name, result.rgb, {"render": result.stats, "camera": camera.settings})
                done += 1
                report(done / total)
        _compare_scene(found, scene, choice, renders, folder)
    return found


def _camera_record(scene: Scene, name: str, stats: Mapping[str, Any]) -> dict[str, Any]:
    share = stats["camera_fraction"]
    return {
        "name": name,
        "scene": scene.name,
        "render_s": stats["seconds"],
        "camera_s": share * stats["seconds"],
        "camera_share": share,
        "samples": stats["samples"],
        "width": stats["width"],
        "height": stats["height"],
        "threads": stats["threads"],
    }


def _stem(scene: Scene, name: str) -> str:
    return f"{scene.name}-{name.replace(' ', '-')}"


def _save(folder: Path, scene: Scene, name: str, rgb: FloatArray, metadata: dict[str, Any]) -> None:
    write_exr(folder / f"{_stem(scene, name)}.exr", rgb, half=True, metadata=metadata)
    write_png(folder / f"{_stem(scene, name)}.png", rgb)


def _compare_scene(
    found: Pictures, scene: Scene, choice: RenderChoice, renders: Mapping[str, list[FloatArray]], folder: Path
) -> None:
    exact = renders[EXACT]
    captions, maps = {}, {}
    for name, pictures in renders.items():
        record: dict[str, Any] = {
            "name": f"{scene.name}, {name}",
            "scene": scene.name,
            "camera": name,
            "file_png": f"{folder.name}/{_stem(scene, name)}.png",
            "file_exr": f"{folder.name}/{_stem(scene, name)}.exr",
            "samples": choice.samples,
        }
        if name != EXACT:
            figures = compare(pictures, exact)
            record.update({k: figures[k] for k in figures if k in _COMPARED})
            captions[name] = image_caption(figures)
            # The second exact seed, so that what shows is the noise of two renders and not the shared random numbers.
            maps[name] = error_maps(pictures[0], exact[1])["flip"]
        found.images.append(record)
    maps[EXACT] = error_maps(exact[0], exact[1])["flip"]
    captions[EXACT] = "two seeds: the noise floor"
    file = folder / f"{scene.name}-side-by-side.png"
    side_by_side(
        {n: r[0] for n, r in renders.items()}, maps, file, captions, title=f"{scene.name}, error against exact"
    )
    found.figures.append(
        {
            "file": f"{folder.name}/{file.name}",
            "title": f"{scene.name}: every camera",
            "caption": "Below each render its FLIP difference from an exact render with another seed.",
            "wide": True,
        }
    )


_COMPARED = ("flip", "rel_mse", "noise_floor_flip", "noise_floor_rel_mse", "flip_ratio", "pairs")
