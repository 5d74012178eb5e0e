"""The layers of flare: pictures that are added to a render of the same lens, film and focus.

Each maker makes one picture, and by name others that are parts of it. A layer that is switched off is absent.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from neurolens.base.errors import InputError
from neurolens.base.progress import Progress, Report
from neurolens.flare.canvas import Raster
from neurolens.flare.diffraction import starburst_picture
from neurolens.flare.ghosts import Pair, coated, ghost_pairs
from neurolens.flare.lights import SceneLights, keep
from neurolens.flare.picture import PARTS, FlareJob, ghost_layers, kept_file, photon_picture
from neurolens.flare.steps import Floats
from neurolens.lens.prescription import Lens
from neurolens.render.film import check_memory
from neurolens.render.scene import Scene
from neurolens.render.settings import LAYERS, FlareSettings

Layers = dict[str, Floats]
REST = "rest"


def flare_layers(job: FlareJob, progress: Progress | None = None) -> Layers:
    """The layers that are switched on, by name, [H, W, 3] linear sRGB each; those of `MAKERS` sum to the flare.

    Raises:
        InputError: as the makers.
    """
    layers: Layers = {}
    progress = progress or Progress(quiet=True)
    for name, make in MAKERS.items():
        if job.settings.makes(name):
            with progress.stage(name) as report:
                made = make(job, report)
            for picture in made.values():
                picture *= np.array(job.settings.gain(name), np.float32)
            layers |= made
    return layers


def with_coating(lens: Lens, settings: FlareSettings) -> Lens:
    """The lens with the coating of the settings; raises InputError as `coated`."""
    return lens if settings.coating is None else coated(lens, settings.coating)


class Choice(NamedTuple):
    """What the flare of all frames of a scene shares: ghosts that become layers, and whether lights fade (`keep`)."""

    single: tuple[str, ...]
    fade: bool


def scene_choice(frames: Sequence[tuple[Scene, Lens]], raster: Raster, threads: int) -> Choice:
    """The ghosts that `brightest` names in some frames of a scene that has the table [flare].

    Args:
        frames: the scene, its camera in the frame's place, and the lens in its state.

    Raises:
        InputError: as of `coated`.
    """
    sources, fade = SceneLights(frames[0][0]), len(frames) > 1
    return Choice(brightest([_scene_job(sources, *frame, raster, threads, fade) for frame in frames]), fade)


def _scene_job(sources: SceneLights, scene: Scene, lens: Lens, raster: Raster, threads: int, fade: bool) -> FlareJob:
    """The flare of a scene by its own lights."""
    settings = scene.settings.flare
    assert settings is not None and lens.film_z_mm is not None
    lights = keep(sources.seen(scene, lens.film_z_mm), settings.most, fade).lights
    light_nm = scene.settings.camera.wavelength_nm
    return FlareJob(with_coating(lens, settings), lights, raster, settings, light_nm, threads)


def scene_flare(
    scene: Scene, lens: Lens, raster: Raster, white_balance: str | None, threads: int, progress: Progress,
    choice: Choice | None = None,
) -> Layers:  # fmt: skip
    """The layers of a scene that has the table [flare], by its own lights and a lens whose film is placed.

    Args:
        choice: of all frames; None chooses by this picture.

    Raises:
        InputError: as `flare_layers` and `coated`.
    """
    choice, sources = choice or scene_choice([(scene, lens)], raster, threads), SceneLights(scene)
    job = replace(_scene_job(sources, scene, lens, raster, threads, choice.fade), single=choice.single)
    matrix = sources.balance(white_balance).T.astype(np.float32)
    return {name: picture @ matrix for name, picture in flare_layers(job, progress).items()}


def sum_of(layers: Mapping[str, Floats], raster: Raster) -> Floats:
    """The whole flare, [H, W, 3]: layers of `MAKERS`, without their parts."""
    total = np.zeros((raster.height, raster.width, 3), np.float32)
    for name in MAKERS:
        total += layers.get(name, np.float32(0))
    return total


def brightest(frames: Sequence[FlareJob], done: Callable[[float], None] = lambda share: None) -> tuple[str, ...]:
    """Names of the ghosts whose own pictures, with their gains, have the greatest values on the film in any frame.

    These are at most `settings.brightest` names, the brightest first. A ghost without light on the film is never one.
    """
    peaks: dict[str, float] = {}
    raster, count = frames[0].raster, frames[0].settings.brightest
    if not count:
        return ()
    every = [job.tracer.pairs for job in frames]
    most = min(count, max(map(len, every)))
    check_memory(raster.width, raster.height, _bytes(most, most))
    for number, (job, pairs) in enumerate(zip(frames, every, strict=True)):
        factors = _factors(pairs, job.settings, ghost_pairs(job.lens))
        report = partial(lambda begun, share: done((begun + share) / len(frames)), number)
        for k, picture in ghost_layers(job, range(len(pairs)), report):
            peak = float((picture.max(0).max(0) * factors[pairs[k]]).max())
            peaks[pairs[k].name] = max(peak, peaks.get(pairs[k].name, 0.0))
    return tuple(sorted((name for name in peaks if peaks[name] > 0), key=lambda name: -peaks[name])[:count])


def _ghosts(job: FlareJob, done: Report) -> Layers:
    if job.settings.photons:
        return {"ghosts": photon_picture(job, "ghosts" if job.settings.glare else "flare", job.settings.photons, done)}
    pairs, raster = job.tracer.pairs, job.raster
    factors = _factors(pairs, job.settings, ghost_pairs(job.lens))
    # Ghosts of one layer and of equal factors share a picture.
    keys = [(p.name if p.name in job.single else REST, factors[p]) for p in pairs]
    kinds = list(dict.fromkeys(keys))
    check_memory(raster.width, raster.height, _bytes(len(kinds), len(job.single)))
    parts = {name: np.zeros((raster.height, raster.width, 3), np.float32) for name in (*job.single, REST)}
    for number, picture in ghost_layers(job, [kinds.index(key) for key in keys], done):
        name, factor = kinds[number]
        parts[name] += picture * np.array(factor, np.float32)
    return {"ghosts": np.sum(list(parts.values()), 0), **(parts if job.single else {})}


def _bytes(pictures: int, layers: int) -> int:
    """The bytes of a pixel of all pictures that are drawn, and of the layers of single ghosts that they become."""
    return 12 * (pictures + layers + 4)


def kept_beside(picture: Path) -> list[Path]:
    """The files of photons that interrupted work has left beside a picture."""
    return [path for part in PARTS if (path := kept_file(picture, part)).is_file()]


def _factors(
    pairs: Sequence[Pair], settings: FlareSettings, every: Sequence[Pair]
) -> dict[Pair, tuple[float, float, float]]:
    """The gain of each pair. A gain may also name a ghost of `every`, since fits leave ghosts out."""
    known = {*MAKERS, *(pair.name for pair in (*pairs, *every))}
    for name in settings.gains:
        if name not in known:
            expected = f"a layer ({', '.join(MAKERS)}) or a ghost ({every[0].name if every else 'g01-00'}) of this lens"
            raise InputError("flare", "gain", name, expected)
    return {pair: settings.gain(pair.name) for pair in pairs}


MAKERS: dict[str, Callable[[FlareJob, Report], Layers]] = {
    "ghosts": _ghosts,
    "glare": lambda job, done: {"glare": photon_picture(job, "glare", job.settings.glare, done)},
    "starburst": lambda job, done: {"starburst": starburst_picture(job, done)},
}
assert tuple(MAKERS) == LAYERS
