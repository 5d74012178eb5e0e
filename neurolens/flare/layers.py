"""The layers of flare, and the module of each: pictures that are added to a render of the same lens, film and focus.

Each maker gives a picture of its own, and more by name that are parts of it. A layer that is switched off is absent.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neurolens.base.errors import InputError
from neurolens.base.progress import Progress, Report
from neurolens.flare.diffraction import starburst_picture
from neurolens.flare.ghostmodel import GhostModel
from neurolens.flare.ghosts import GhostTracer, Way, coated, ghost_pairs
from neurolens.flare.lights import Light
from neurolens.flare.photons import PhotonTracer
from neurolens.flare.picture import PARTS, Raster, ghost_layers, ghost_picture, photon_picture
from neurolens.flare.scatter import Scatter
from neurolens.flare.sources import Name, SceneLights, chosen, keep_named
from neurolens.flare.stack import Floats
from neurolens.optics.prescription import Lens
from neurolens.render.film import check_memory
from neurolens.render.scene import Scene

Layers = dict[str, Floats]
REST = "rest"
_ONE = (1.0, 1.0, 1.0)
_FINER = 4  # wavelengths of a ghost at most, for one of a star


@dataclass(frozen=True)
class FlareSettings:
    """What flare is made of, and how finely.

    Attributes:
        wavelength_nm: range of light. wavelengths: of equal shares of it, in stars and photons. A ghost has as many as
            its colours need, at most four times as many.
        cell_px: size on film, about, of the cells that ghosts are drawn by.
        photons: if above 0, ghosts by photons with up to `most_reflections`, so many a light and wavelength, smoothed
            by kernels from radius `kernel_px` on, instead of by all pairs of reflections; 0 leaves them.
        glare: if above 0, so many photons of the layer "glare": light that was reflected more than twice, or scattered.
        scatter: what scatters it. The ghosts keep what scatters of theirs, which is little.
        starburst: whether to make the layer "starburst": what diffraction at the stop and the rims takes out of images.
        ghosts: what traces ghosts, or stands for that, of the same lens and stop; None traces all of two reflections.
            Those of four (see `picture.with_four`) go without photons and glare, which have that light by chance.
        single: ghosts that become layers, by name; the other ghosts are the layer "rest".
        without: layers that are not made.
        gains: factors of red, green and blue by the name of a layer, of a ghost (g07-03), or of a surface (s07: of all
            ghosts that it reflects); several for one ghost are multiplied.
        seed: of the places and chances of photons, the same for all frames. threads: of the work.
        keep: picture beside which photons of long work are kept until they are whole (see `kept_beside`).
    """

    wavelength_nm: tuple[float, float] = (400.0, 700.0)
    wavelengths: int = 15
    cell_px: float = 8.0
    photons: int = 0
    most_reflections: int = 10
    kernel_px: float = 3.0
    glare: int = 0
    scatter: Scatter = Scatter()
    starburst: bool = False
    ghosts: GhostTracer | GhostModel | None = None
    single: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    gains: tuple[tuple[str, tuple[float, float, float]], ...] = ()
    seed: int = 0
    threads: int = 2
    keep: Path | None = None

    def __post_init__(self) -> None:
        for name in self.without:
            if name not in MAKERS:
                raise InputError("flare", "without", name, f"layers of flare: {', '.join(MAKERS)}")
        if self.scatter.on and not self.glare:
            raise InputError("flare", "glare", self.glare, "photons, for light that scatters")
        often = [way.name for way in (self.ghosts.pairs if self.ghosts else ()) if len(way.reflections) > 2]
        if often and (self.photons or self.glare):
            raise InputError(
                "flare", "ghosts", often[0], "none of four reflections with photons or glare: they have it"
            )
        of_ghosts = [name for name, _ in self.gains if name not in MAKERS]
        if self.photons and (self.single or of_ghosts):
            raise InputError("flare", "photons", self.photons, "0 with layers or gains of single ghosts")
        for name, factor in self.gains:
            if not all(0 <= v < math.inf for v in factor):
                raise InputError("flare", f"gain {name}", factor, "finite numbers of at least 0")

    def makes(self, name: str) -> bool:
        """Whether the layer of this name is switched on."""
        return name not in self.without and bool({"glare": self.glare, "starburst": self.starburst}.get(name, True))

    def gain(self, *names: str) -> tuple[float, float, float]:
        """Factors of red, green and blue of what has these names."""
        r, g, b = np.prod([_ONE, *(factor for name, factor in self.gains if name in names)], 0)
        return float(r), float(g), float(b)


def flare_layers(
    lens: Lens, lights: Sequence[Light], raster: Raster, settings: FlareSettings, progress: Progress | None = None
) -> Layers:
    """The layers that are switched on, by name, [H, W, 3] linear sRGB each; those of `MAKERS` sum to the flare.

    Args:
        lens: its film must be placed (`Lens.at`).

    Raises:
        InputError: as of the makers.
    """
    found: Layers = {}
    progress = progress or Progress(quiet=True)
    for name, make in MAKERS.items():
        if settings.makes(name):
            with progress.stage(name) as report:
                made = make(lens, lights, raster, settings, report)
            for picture in made.values():
                picture *= np.array(settings.gain(name), np.float32)
            found |= made
    return found


class Choice(NamedTuple):
    """What all frames of a scene show: names of lights (`sources.chosen`), and of ghosts that become layers."""

    lights: frozenset[Name]
    single: tuple[str, ...]


def scene_choice(frames: Sequence[tuple[Scene, Lens]], raster: Raster, threads: int) -> Choice:
    """The lights of the most energy in all frames together, and the ghosts that `brightest` names, of a scene that has
    the table [flare].

    Args:
        frames: the scene, its camera in the frame's place, and the lens in its state.

    Raises:
        InputError: as of `coated`.
    """
    scene = frames[0][0]
    table, sources = scene.settings.flare, SceneLights(scene)
    assert table is not None
    seen = [sources.named(at, lens.film_z_mm or 0.0) for at, lens in frames]
    names = chosen(seen, table.most)
    tracers = [GhostTracer(lens if table.coating is None else coated(lens, table.coating)) for _, lens in frames]
    ghosts = [(tracer, keep_named(there, names).lights) for tracer, there in zip(tracers, seen, strict=True)]
    return Choice(names, brightest(ghosts, raster, _settings_of(scene, threads), table.brightest))


def _settings_of(scene: Scene, threads: int) -> FlareSettings:
    """The settings of a scene's table [flare], without layers of single ghosts."""
    table = scene.settings.flare
    assert table is not None
    return FlareSettings(
        scene.settings.camera.wavelengths_nm, table.bins, table.cell_px, without=table.without, threads=threads,
        glare=table.glare, starburst=table.starburst,
    )  # fmt: skip


def scene_flare(
    scene: Scene,
    lens: Lens,
    raster: Raster,
    white_balance: str | None,
    threads: int,
    progress: Progress,
    choice: Choice | None = None,
) -> Layers:
    """The layers of a scene that has the table [flare], of its own lights, by a lens whose film is placed.

    Args:
        choice: of all frames; None: of this picture.

    Raises:
        InputError: as of `flare_layers` and `coated`.
    """
    table, sources = scene.settings.flare, SceneLights(scene)
    assert table is not None and lens.film_z_mm is not None
    names, single = choice or scene_choice([(scene, lens)], raster, threads)
    lights = keep_named(sources.named(scene, lens.film_z_mm), names).lights
    lens = lens if table.coating is None else coated(lens, table.coating)
    settings = replace(_settings_of(scene, threads), single=single)
    found = flare_layers(lens, lights, raster, settings, progress)
    matrix = sources.balance(white_balance).T.astype(np.float32)
    return {name: picture @ matrix for name, picture in found.items()}


def sum_of(layers: Mapping[str, Floats], raster: Raster) -> Floats:
    """The whole flare, [H, W, 3]: layers of `MAKERS`, without their parts."""
    total = np.zeros((raster.height, raster.width, 3), np.float32)
    for name in MAKERS:
        total += layers.get(name, np.float32(0))
    return total


def brightest(
    frames: Sequence[tuple[GhostTracer | GhostModel, Sequence[Light]]],
    raster: Raster,
    settings: FlareSettings,
    count: int,
    done: Callable[[float], None] = lambda share: None,
) -> tuple[str, ...]:
    """Names of the ghosts whose own pictures, with their gains, have the greatest values on the film in any frame.

    These are at most `count` names, the brightest first. A ghost without light on the film is never one of them.

    Args:
        frames: what traces the ghosts, and the lights, of each frame.
    """
    peaks: dict[str, float] = {}
    most = min(count, max((len(ghosts.pairs) for ghosts, _ in frames), default=0))
    check_memory(raster.width, raster.height, _bytes(most, most))
    for number, (ghosts, lights) in enumerate(frames if count else ()):
        factors = _factors(ghosts.pairs, settings, ghost_pairs(ghosts.lens))
        each, begun = range(len(ghosts.pairs)), number / len(frames)
        report = partial(lambda begun, share: done(begun + share / len(frames)), begun)
        for k, picture in ghost_layers(ghosts, lights, raster, each, **_fineness(settings), done=report):
            peak = float((picture.max(0).max(0) * factors[ghosts.pairs[k]]).max())
            peaks[ghosts.pairs[k].name] = max(peak, peaks.get(ghosts.pairs[k].name, 0.0))
    return tuple(sorted((name for name in peaks if peaks[name] > 0), key=lambda name: -peaks[name])[:count])


def _ghosts(lens: Lens, lights: Sequence[Light], raster: Raster, settings: FlareSettings, done: Report) -> Layers:
    if settings.photons:
        part = "ghosts" if settings.glare else "flare"
        return {"ghosts": _photons(lens, lights, raster, settings, done, part, settings.photons)}
    ghosts = settings.ghosts or GhostTracer(lens)
    factors = _factors(ghosts.pairs, settings, ghost_pairs(lens))
    # Ghosts of one layer and of equal factors share a picture.
    keys = [(p.name if p.name in settings.single else REST, factors[p]) for p in ghosts.pairs]
    kinds = list(dict.fromkeys([*keys, *((name, _ONE) for name in (*settings.single, REST))]))
    check_memory(raster.width, raster.height, _bytes(len(kinds), len(settings.single)))
    layers = [kinds.index(key) for key in keys]
    pictures = ghost_picture(ghosts, lights, raster, layers=layers, **_fineness(settings), done=done)
    parts: Layers = {name: np.zeros(pictures.shape[1:], np.float32) for name in (*settings.single, REST)}
    for (name, factor), picture in zip(kinds, pictures, strict=False):
        parts[name] += picture * np.array(factor, np.float32)
    return {"ghosts": np.sum(list(parts.values()), 0), **(parts if settings.single else {})}


def _bytes(pictures: int, layers: int) -> int:
    """Of a pixel, of pictures that are drawn and layers of single ghosts that they become."""
    return 12 * (pictures + layers + 4)


def _fineness(settings: FlareSettings) -> dict[str, Any]:
    """The settings that `ghost_layers` and `ghost_picture` have."""
    names = "wavelength_nm", "cell_px", "threads"
    return {name: getattr(settings, name) for name in names} | {"wavelengths": _FINER * settings.wavelengths}


def _glare(lens: Lens, lights: Sequence[Light], raster: Raster, settings: FlareSettings, done: Report) -> Layers:
    return {"glare": _photons(lens, lights, raster, settings, done, "glare", settings.glare)}


def _starburst(lens: Lens, lights: Sequence[Light], raster: Raster, settings: FlareSettings, done: Report) -> Layers:
    return {
        "starburst": starburst_picture(
            lens, lights, raster, wavelength_nm=settings.wavelength_nm, wavelengths=settings.wavelengths,
            threads=settings.threads, done=done,
        )
    }  # fmt: skip


def _photons(
    lens: Lens, lights: Sequence[Light], raster: Raster, settings: FlareSettings, done: Report, part: str, count: int
) -> Floats:
    return photon_picture(
        PhotonTracer(lens, settings.scatter), lights, raster, part=part, wavelength_nm=settings.wavelength_nm,
        wavelengths=settings.wavelengths, photons=count, most_reflections=settings.most_reflections,
        kernel_px=settings.kernel_px, seed=settings.seed, threads=settings.threads, done=done,
        keep=None if settings.keep is None else _kept_file(settings.keep, part),
    )  # fmt: skip


def kept_beside(picture: Path) -> list[Path]:
    """Files of photons that are there beside a picture, of work that was interrupted."""
    return [path for part in PARTS if (path := _kept_file(picture, part)).is_file()]


def _kept_file(picture: Path, part: str) -> Path:
    return picture.with_name(f"{picture.name}.{part}.part")


def _factors(
    pairs: Sequence[Way], settings: FlareSettings, every: Sequence[Way]
) -> dict[Way, tuple[float, float, float]]:
    """Of each of the pairs; names may be those of `every` ghost of the lens, of which a fit leaves some out."""
    surfaces = {k for pair in every for k in pair.reflections}
    known = {*MAKERS, *(pair.name for pair in (*pairs, *every)), *(f"s{k:02d}" for k in surfaces)}
    for name, _ in settings.gains:
        if name not in known:
            named = every[0].name if every else "g01-00"
            expected = (
                f"a layer ({', '.join(MAKERS)}), a ghost ({named}) or a surface (s{min(surfaces, default=0):02d})"
            )
            raise InputError("flare", "gain", name, f"{expected} of this lens")
    return {pair: settings.gain(pair.name, *(f"s{k:02d}" for k in pair.reflections)) for pair in pairs}


MAKERS: dict[str, Callable[[Lens, Sequence[Light], Raster, FlareSettings, Report], Layers]] = {
    "ghosts": _ghosts,
    "glare": _glare,
    "starburst": _starburst,
}
