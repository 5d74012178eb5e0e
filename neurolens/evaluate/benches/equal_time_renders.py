"""Renders that are kept: one file a render, named by everything that it depends on, so that a run may be resumed."""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import neurolens
from neurolens.base.files import atomic_path
from neurolens.base.tomlfile import read_toml
from neurolens.cameras.contract import Camera
from neurolens.evaluate.records import plain
from neurolens.render.film import FilmSettings
from neurolens.render.renderer import render
from neurolens.render.scene import Scene

_SOURCES = ("cameras", "optics", "programs", "render")  # folders of the package that a picture depends on


@dataclass(frozen=True)
class Shelf:
    """The renders of one scene through one camera.

    Attributes:
        folder: of its files; its name ends in the hash of scene, camera, film, size and source.
    """

    folder: Path
    scene: Scene
    camera: Camera
    film: FilmSettings
    size: tuple[int, int]

    def file(self, samples: int, seed: int, threads: int) -> Path:
        return self.folder / f"{samples}-{seed}-{threads}.npz"

    def take(self, samples: int, seed: int, threads: int) -> tuple[NDArray[np.float32], float]:
        """The picture [H, W, 3] and the seconds that it took, rendered or as an earlier run left it.

        A file that is broken is made again. Raises what `render` does.
        """
        width, height = self.size
        file = self.file(samples, seed, threads)
        known = _read(file, (height, width, 3))
        if known is not None:
            return known
        found = render(
            self.scene, self.camera, width=width, height=height, samples=samples, seed=seed, threads=threads,
            film=self.film,
        )  # fmt: skip
        self.folder.mkdir(parents=True, exist_ok=True)
        with atomic_path(file) as temporary:
            np.savez(temporary, rgb=found.rgb, seconds=np.float64(found.stats["seconds"]))
        return found.rgb, float(found.stats["seconds"])

    def warm_up(self) -> None:
        """A sample a pixel that nobody counts: the first render of a camera loads code and fills caches."""
        width, height = self.size
        render(self.scene, self.camera, width=width, height=height, samples=1, threads=1, film=self.film)


def shelf(
    run: Path, scene_file: Path, scene: Scene, name: str, camera: Camera, film: FilmSettings, size: tuple[int, int]
) -> Shelf:
    """The shelf of a camera in the folder of a run."""
    about = [neurolens.__version__, _source(), _scene_bytes(scene_file), plain(camera.settings), film.__dict__, size]
    model = camera.settings.get("model")
    if model is not None:
        about.append(hashlib.sha256(Path(model).read_bytes()).hexdigest())
    digest = hashlib.sha256(json.dumps(about, sort_keys=True, default=str).encode()).hexdigest()
    return Shelf(run / scene.name / f"{name.replace(' ', '-')}-{digest[:16]}", scene, camera, film, size)


def _read(file: Path, shape: tuple[int, ...]) -> tuple[NDArray[np.float32], float] | None:
    try:
        with np.load(file, allow_pickle=False) as kept:
            rgb, seconds = kept["rgb"], float(kept["seconds"])
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    good = rgb.shape == shape and rgb.dtype == np.float32 and np.isfinite(rgb).all() and seconds > 0
    return (rgb, seconds) if good else None


def _source() -> str:
    """Hash of the code that makes pictures."""
    digest = hashlib.sha256()
    package = Path(neurolens.__file__).parent
    for file in sorted(f for part in _SOURCES for f in (package / part).rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _scene_bytes(file: Path) -> str:
    """Hash of a scene file and of the files that it names, wherever it names one."""
    digest = hashlib.sha256(file.read_bytes())
    for named in sorted(set(_strings(read_toml(file)))):
        beside = file.parent / named
        if Path(named).suffix and beside.is_file():
            digest.update(beside.read_bytes())
    return digest.hexdigest()


def _strings(value: Any) -> list[str]:
    """Every string in tables of tables."""
    if isinstance(value, str):
        return [value]
    inner = list(value.values()) if isinstance(value, Mapping) else value if isinstance(value, list) else []
    return [text for part in inner for text in _strings(part)]
