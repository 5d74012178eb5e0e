"""The layers of flare: pictures that are added to a render of the same lens, film and focus.

Each maker makes one picture, and by name others that are parts of it. A layer that is switched off is absent.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neurolens.base.errors import InputError
from neurolens.base.progress import Progress, Report
from neurolens.flare.canvas import Raster
from neurolens.flare.diffraction import starburst_picture
from neurolens.flare.ghosts import GhostTracer, Pair, coated, ghost_pairs
from neurolens.flare.lights import Light
from neurolens.flare.photons import PhotonTracer
from neurolens.flare.picture import PARTS, ghost_layers, ghost_picture, photon_picture
from neurolens.flare.sources import Name, SceneLights, chosen, keep_named
from neurolens.flare.steps import Floats
from neurolens.lens.prescription import Lens
from neurolens.render.film import check_memory
from neurolens.render.scene import Scene
from neurolens.render.settings import LAYERS, FlareSettings

Layers = dict[str, Floats]
REST = "rest"
_ONE = (1.0, 1.0, 1.0)
_FINER = 4  # wavelengths of a ghost at most, for one of a star


@dataclass(frozen=True)
class FlareJob:
    """Everything that decides the flare of one picture.

    Attributes:
        lens: its film must be placed (`set_lens`), and it must have the coating of the settings (`with_coating`).
        wavelength_nm: range of light. threads: of the work.
        ghosts: traces the ghosts of the same lens and stop; None traces all of two reflections.
        single: names of the ghosts that become layers; the others are the layer "rest".
        keep: picture beside which the photons of long work are kept until they are whole (see `kept_beside`).
    """

    lens: Lens
    lights: Sequence[Light]
    raster: Raster
    settings: FlareSettings = FlareSettings()
    wavelength_nm: tuple[float, float] = (400.0, 700.0)
    threads: int = 2
    ghosts: GhostTracer | None = None
    single: tuple[str, ...] = ()
    keep: Path | None = None

    @property
    def fineness(self) -> dict[str, Any]:
        """The arguments of `ghost_layers` and `ghost_picture`; a ghost takes as many wavelengths as it needs."""
        bins, cell = _FINER * self.settings.bins, self.settings.cell_px
        return {"wavelength_nm": self.wavelength_nm, "wavelengths": bins, "cell_px": cell, "threads": self.threads}


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


class Choice(NamedTuple):
    """The names of the lights that all frames of a scene have (`sources.chosen`), and of ghosts that become layers."""

    lights: frozenset[Name]
    single: tuple[str, ...]


def scene_choice(frames: Sequence[tuple[Scene, Lens]], raster: Raster, threads: int) -> Choice:
    """The lights of the most energy in all frames together, and the ghosts that `brightest` names.

    The scene must have the table [flare].

    Args:
        frames: the scene, its camera in the frame's place, and the lens in its state.

    Raises:
        InputError: as of `coated`.
    """
    scene = frames[0][0]
    settings, sources = scene.settings.flare, SceneLights(scene)
    assert settings is not None
    of_frames = [sources.named(at, lens.film_z_mm or 0.0) for at, lens in frames]
    names = chosen(of_frames, settings.most)
    jobs = []
    for (_, lens), named in zip(frames, of_frames, strict=True):
        lens, lights = with_coating(lens, settings), keep_named(named, names).lights
        jobs.append(FlareJob(lens, lights, raster, settings, scene.settings.camera.wavelength_nm, threads))
    return Choice(names, brightest(jobs))


def with_coating(lens: Lens, settings: FlareSettings) -> Lens:
    """The lens with the coating of the settings; raises InputError as `coated`."""
    return lens if settings.coating is None else coated(lens, settings.coating)


def scene_flare(
    scene: Scene,
    lens: Lens,
    raster: Raster,
    white_balance: str | None,
    threads: int,
    progress: Progress,
    choice: Choice | None = None,
) -> Layers:
    """The layers of a scene that has the table [flare], by its own lights and a lens whose film is placed.

    Args:
        choice: of all frames; None chooses by this picture.

    Raises:
        InputError: as `flare_layers` and `coated`.
    """
    settings, sources = scene.settings.flare, SceneLights(scene)
    assert settings is not None and lens.film_z_mm is not None
    names, single = choice or scene_choice([(scene, lens)], raster, threads)
    lights = keep_named(sources.named(scene, lens.film_z_mm), names).lights
    light_nm = scene.settings.camera.wavelength_nm
    job = FlareJob(with_coating(lens, settings), lights, raster, settings, light_nm, threads, single=single)
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
    tracers = [job.ghosts or GhostTracer(job.lens) for job in frames]
    most = min(count, max(len(ghosts.pairs) for ghosts in tracers))
    check_memory(raster.width, raster.height, _bytes(most, most))
    for number, (job, ghosts) in enumerate(zip(frames, tracers, strict=True)):
        factors = _factors(ghosts.pairs, job.settings, ghost_pairs(ghosts.lens))
        each, begun = range(len(ghosts.pairs)), number / len(frames)
        report = partial(lambda begun, share: done(begun + share / len(frames)), begun)
        for k, picture in ghost_layers(ghosts, job.lights, raster, each, **job.fineness, done=report):
            peak = float((picture.max(0).max(0) * factors[ghosts.pairs[k]]).max())
            peaks[ghosts.pairs[k].name] = max(peak, peaks.get(ghosts.pairs[k].name, 0.0))
    return tuple(sorted((name for name in peaks if peaks[name] > 0), key=lambda name: -peaks[name])[:count])


def _ghosts(job: FlareJob, done: Report) -> Layers:
    if job.settings.photons:
        part = "ghosts" if job.settings.glare else "flare"
        return {"ghosts": _photons(job, done, part, job.settings.photons)}
    ghosts = job.ghosts or GhostTracer(job.lens)
    factors = _factors(ghosts.pairs, job.settings, ghost_pairs(job.lens))
    # Ghosts of one layer and of equal factors share a picture.
    keys = [(p.name if p.name in job.single else REST, factors[p]) for p in ghosts.pairs]
    kinds = list(dict.fromkeys([*keys, *((name, _ONE) for name in (*job.single, REST))]))
    raster = job.raster
    check_memory(raster.width, raster.height, _bytes(len(kinds), len(job.single)))
    layers = [kinds.index(key) for key in keys]
    pictures = ghost_picture(ghosts, job.lights, raster, layers=layers, **job.fineness, done=done)
    parts: Layers = {name: np.zeros(pictures.shape[1:], np.float32) for name in (*job.single, REST)}
    for (name, factor), picture in zip(kinds, pictures, strict=False):
        parts[name] += picture * np.array(factor, np.float32)
    return {"ghosts": np.sum(list(parts.values()), 0), **(parts if job.single else {})}


def _bytes(pictures: int, layers: int) -> int:
    """The bytes of a pixel of all pictures that are drawn, and of the layers of single ghosts that they become."""
    return 12 * (pictures + layers + 4)


def _starburst(job: FlareJob, done: Report) -> Layers:
    return {
        "starburst": starburst_picture(
            job.lens, job.lights, job.raster, wavelength_nm=job.wavelength_nm, wavelengths=job.settings.bins,
            threads=job.threads, done=done,
        )
    }  # fmt: skip


def _photons(job: FlareJob, done: Report, part: str, count: int) -> Floats:
    settings = job.settings
    return photon_picture(
        PhotonTracer(job.lens, settings.scatter), job.lights, job.raster, part=part, wavelength_nm=job.wavelength_nm,
        wavelengths=settings.bins, photons=count, most_reflections=settings.most_reflections,
        kernel_px=settings.kernel_px, seed=settings.seed, threads=job.threads, done=done,
        keep=None if job.keep is None else _kept_file(job.keep, part),
    )  # fmt: skip


def kept_beside(picture: Path) -> list[Path]:
    """The files of photons that interrupted work has left beside a picture."""
    return [path for part in PARTS if (path := _kept_file(picture, part)).is_file()]


def _kept_file(picture: Path, part: str) -> Path:
    return picture.with_name(f"{picture.name}.{part}.part")


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
    "glare": lambda job, done: {"glare": _photons(job, done, "glare", job.settings.glare)},
    "starburst": _starburst,
}
assert tuple(MAKERS) == LAYERS
