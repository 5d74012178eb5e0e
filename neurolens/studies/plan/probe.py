"""A scene as a lens sees it: places in view, the lens's footprints there, and the worth of each of its effects.

A probe sends the chief rays of a grid of film points into the scene. What they meet, and how far off, are the places at
which cameras are held against the exact lens (`footprints`), in the scene's own light. An effect is worth its part of
the exact footprints in pixels, or the light that it adds or takes relative to the picture; both are counted at the 95th
percentile over the picture.

The lens's ghosts, glare and stars from the scene's own lights, drawn on few pixels, are set against a picture of as
many.
"""

import math
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np

from neurolens.base.errors import InputError
from neurolens.base.report import BULK
from neurolens.cameras.build import ideal_as
from neurolens.cameras.contract import Camera
from neurolens.cameras.exact import ExactCamera
from neurolens.graph.compiler import has_compiler
from neurolens.models.fitted import Domain
from neurolens.models.pairs import domain_of
from neurolens.optics.analysis.field_curves import illumination
from neurolens.optics.analysis.fields import Scene as Fields
from neurolens.optics.lens.paraxial import colours, first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.lens.shot import Shot
from neurolens.optics.setting.pupils import image_radius_mm
from neurolens.optics.setting.states import set_lens
from neurolens.pictures.flare.canvas import Raster
from neurolens.pictures.flare.job import FlareJob
from neurolens.pictures.flare.layers import flare_layers
from neurolens.pictures.flare.lights import SceneLights, keep
from neurolens.pictures.render.colour import SpectralRange
from neurolens.pictures.render.job import expected_light
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.scene import Scene
from neurolens.pictures.render.settings import FlareSettings
from neurolens.pictures.render.world import shared_worlds
from neurolens.studies.plan import footprints as prints
from neurolens.studies.plan.footprints import Array, Footprints, Places
from neurolens.studies.scenes import seen_depths_m

Unit = Literal["px", "relative"]
Maps = dict[str, tuple[Unit, Array]]
COUNTED = 95.0  # percentile over the picture at which a budget is counted
LIGHT = 0.01  # relative error of light that a plan allows beside its budget of error
_PLACES_ACROSS = 16  # places of the probe along the longer side
_FOCUS_SPARE = 0.25  # of a pixel of blur: how far a model may place its film from the lens's film
_FIELDS = 17  # fields from the axis to the edge of the film at which vignetting is traced
_TAIL = 1e-3  # share of the light that its range leaves out at either end
# The small picture: its pixels along the longer side, and samples of a pixel, which take a tenth of a second in all.
# What is darker than a part of its mean does not count in ratios.
_PIXELS_ACROSS, _SAMPLES, _BLACK = 48, 32, 0.01
STRAY = {"ghosts": "flare", "glare": "glare", "starburst": "star-bursts"}  # layers, and their names in a plan
_MOST_LIGHTS = 8
_STARS = 2  # lights whose stars are drawn, the brightest in view; each takes a second
# Wavelengths of ghosts, of which coatings of many layers need so many; their cells; photons of all lights together.
_WAVES, _CELL_PX, _PHOTONS = 10, 2.0, 1 << 18


def small_picture(scene: Scene, camera: Camera) -> Array:
    """Return a small picture [H, W, 3] of a scene, linear sRGB."""
    width, height = _raster(camera.film_mm, _PIXELS_ACROSS)
    return render(scene, camera, width=width, height=height, samples=_SAMPLES, threads=1).rgb.astype(np.float64)


def _raster(film_mm: tuple[float, float], across: int) -> tuple[int, int]:
    """Return columns and rows of a grid with `across` cells along the film's longer side."""
    columns, rows = (max(round(across * side / max(film_mm)), 1) for side in film_mm)
    return columns, rows


def light_of(scene: Scene, rgb: Array, count: int = 0) -> tuple[tuple[float, float], Array, Array]:
    """Return the range of a picture's light, wavelengths (nm) and their shares of it, as the eye weighs it.

    The light is that of the scene's lights, tinted so that the picture has the mean colour [3]. The range holds nearly
    all of it. Each of its equal parts, `count` or as many as eyes need, is one wavelength, its centroid, so that a
    narrow line is one; dark parts are left out.
    """
    low, high = scene.settings.camera.wavelength_nm
    nm, light = expected_light(scene)
    spectral = SpectralRange(low, high, len(nm))
    if spectral.colours and rgb.max() > 0:
        white = spectral.film_rgb(light)
        light = light * spectral.spectrum(np.clip(rgb / np.maximum(white, 1e-3 * white.max()), 0, None))
    eye_nm, eye = colours((low, high))
    seen = np.maximum(light * (np.interp(nm, eye_nm, eye) if low < high else 1.0), 0)
    reached = np.cumsum(seen) / seen.sum()
    first, last = (nm[np.searchsorted(reached, q)] for q in (_TAIL, 1 - _TAIL))
    count = count or len(eye_nm)
    part = np.clip(np.searchsorted(np.linspace(first, last, count + 1), nm, side="right") - 1, 0, count - 1)
    share = np.bincount(part, seen, count)
    lit = share > 1e-6 * share.sum()
    return (
        (float(first), float(last)),
        np.bincount(part, seen * nm, count)[lit] / share[lit],
        share[lit] / share[lit].sum(),
    )


def stray_light(scene: Scene, camera: ExactCamera, rgb: Array) -> dict[str, Array]:
    """Return the light that the lens adds, relative to the small picture, [H, W] by name of `STRAY`.

    It is that of the colour with most, by the lights that the scene's table [flare] would have, in view or not.

    Raises:
        InputError: there is no compiler, or the lens's flare is not known (cylinders).
    """
    lens: Lens = camera.lens
    assert lens.film_z_mm is not None
    if not has_compiler():
        raise InputError(lens.path, "flare", "(no C compiler)", "one, to trace ghosts")
    height, width = rgb.shape[:2]
    light_nm, none = scene.settings.camera.wavelength_nm, np.zeros((height, width))
    lights = keep(SceneLights(scene).seen(scene, lens.film_z_mm, 16 * _MOST_LIGHTS), _MOST_LIGHTS).lights
    if not lights:
        return dict.fromkeys(STRAY.values(), none)
    raster = Raster(camera.film_mm, width, height)
    settings = FlareSettings(bins=_WAVES, cell_px=_CELL_PX, glare=_PHOTONS // len(lights))
    layers = flare_layers(FlareJob(lens, lights, raster, settings, light_nm, threads=1, finer=1))
    half = np.array(camera.film_mm) / 2 / camera.settings["lens_state"]["pinhole_focal_length_mm"]
    stars = [a for a in lights if (np.abs(a.towards[:2]) < -1.1 * half * a.towards[2]).all()][:_STARS]
    only = replace(settings, glare=0, starburst=True, without=("ghosts",))
    layers |= flare_layers(FlareJob(lens, stars, raster, only, light_nm, threads=1)) if stars else {}
    base = np.maximum(rgb.mean(-1), max(_BLACK * float(rgb.mean()), 1e-30))
    return {effect: layers[name].max(-1) / base if name in layers else none for name, effect in STRAY.items()}


@dataclass(frozen=True)
class SceneNeeds:
    """What a scene's shot asks of a lens.

    Attributes:
        f_number: no wider than the lens opens. pixel_mm: pitch.
        nearest_m, farthest_m: along the axis from the film; None where nothing is in view.
        distant: share of the picture that shows things without a distance.
        light_nm: range of all but 0.2% of the scene's light, as the eye weighs it.
    """

    f_number: float
    focus_m: float
    pixel_mm: float
    nearest_m: float | None
    farthest_m: float | None
    distant: float
    light_nm: tuple[float, float]


@dataclass(frozen=True)
class Effect:
    """What an effect of the lens is worth in a picture.

    Attributes:
        worth: at the counted percentile, in pixels (RMS distance by which it moves light) or, where `relative`, as a
            share of the light.
        over: share of the picture where it is beyond the budget.
        needed: whether a camera needs it.
        film: [H, W] of `effect_maps`.
    """

    name: str
    worth: float
    over: float
    unit: Unit
    needed: bool
    film: Array = field(metadata=BULK, repr=False)


@dataclass(frozen=True)
class Probe:
    """A scene's places as the exact lens sees them, with its camera, its footprints there, and a thin lens's.

    Attributes:
        lens, domain: the lens is stopped down and focused; the domain is that of models of this shot.
        places: those with light, among `shape` rows and columns over the film.
        seen, thin_seen: footprints of the exact camera and of a thin lens.
        small: the small picture [H, W, 3].
    """

    scene: Scene
    asked: SceneNeeds
    shot: Shot
    lens: Lens
    domain: Domain
    exact: ExactCamera
    places: Places
    shape: tuple[int, int]
    seen: Footprints
    thin_seen: Footprints
    small: Array

    def on_film(self, value: Array) -> Array:
        """Values [N] of places as a picture [rows, columns], upright as prints are; NaN where there is no place."""
        film = np.full(self.shape, np.nan)
        at = self.places.film_mm / np.array(self.shot.film_mm)[:, None] + 0.5
        column, row = (np.minimum((at[k] * n).astype(int), n - 1) for k, n in enumerate(self.shape[::-1]))
        film[row, column] = np.broadcast_to(value, row.shape)
        return film[:, ::-1]  # the top left of a picture is at +x, -y of the film


def probe(scene: Scene, lens: Lens, *, across: int = _PLACES_ACROSS) -> Probe:
    """Look through the exact lens at a scene.

    Args:
        lens: in its zoom state. across: places along the longer side.

    Raises:
        InputError: the scene's camera is none that the lens can be; the lens leaves the picture dark.
    """
    shot = scene.settings.camera
    film, widest = shot.film_mm, first_order(lens).f_number
    f_number = max(shot.f_number or widest, widest)
    stopped, domain = set_lens(lens, f_number=f_number, focus_m=shot.focus_m), _domain(lens, scene, f_number)
    real = Shot(film, shot.focus_m, f_number, aperture=lens.aperture, wavelength_nm=shot.wavelength_nm)
    exact = ExactCamera(lens, real, bounds=domain.bounds)
    columns, rows = shape = _raster(film, across)
    centres = (((np.arange(n) + 0.5) / n - 0.5) * side for n, side in zip(shape, film, strict=True))
    points = np.stack(np.meshgrid(*centres)).reshape(2, -1)
    with shared_worlds():
        small, depth = small_picture(scene, exact), seen_depths_m(scene, exact, points)
    light_nm, wavelength_nm, share = light_of(scene, small.mean((0, 1)))
    places = prints.places_of(exact, points, np.where(np.isnan(depth), np.inf, depth), wavelength_nm, share)
    if not places.film_mm.shape[1]:
        raise InputError(scene.name, "camera", lens.name, "a lens that lights some of this film")
    met = depth[np.isfinite(depth)]
    nearest, farthest = (float(met.min()), float(met.max())) if met.size else (None, None)
    distant = float(np.isinf(depth).mean())
    asked = SceneNeeds(f_number, shot.focus_m, film[0] / shot.width, nearest, farthest, distant, light_nm)
    seen, ideal = (prints.footprints(c, places) for c in (exact, ideal_as("thin:", exact.lens, real)))
    return Probe(scene, asked, real, stopped, domain, exact, places, (rows, columns), seen, ideal, small)


def _domain(lens: Lens, scene: Scene, f_number: float) -> Domain:
    """The domain of models of the shot: its film, stop and wavelengths, and a quarter of a pixel of defocus more.

    The room is for models' own focus. A lens that focuses no nearer has none on that side.
    """
    shot, plain = scene.settings.camera, lens.with_aperture(None)
    film = shot.film_mm
    stopped = set_lens(plain, f_number=f_number, focus_m=shot.focus_m)
    radius = min(math.hypot(*film) / 2, image_radius_mm(lens)[0])
    move = _FOCUS_SPARE * f_number * film[0] / shot.width / first_order(stopped).efl_mm ** 2  # of the vergence, in 1/mm
    vergence = 1e-3 / shot.focus_m
    ends = 1e-3 / (vergence - move) if vergence > move else math.inf, 1e-3 / (vergence + move)
    made = partial(domain_of, stopped, film_radius_mm=radius, wavelength_nm=shot.wavelength_nm)
    with suppress(InputError):
        return made(focus_m=ends)
    return made(focus_m=(shot.focus_m, shot.focus_m))


def effect_maps(probed: Probe) -> Maps:
    """Unit and map [H, W] of each effect over the picture, upright; NaN where the lens is dark. See `effects_mm`.

    Light has a sign: it is the share that an effect adds, below 0 where the picture gets darker. Vignetting is what the
    rims take of the light through the stop (`passed_share`). Natural fall-off is the light that would remain without
    rims, relative to the axis: cos^4, and how the pupil grows or shrinks with the field. An Airy disc has no RMS
    radius: diffraction is worth the radius that holds half its light, 0.53 wavelengths times the f-number (Born and
    Wolf, 8.5.2). Transmittance is the colour that the lens gives, by its glass, its coatings, and an aperture that
    changes with the wavelength: RMS over wavelengths of the light there, relative to its mean.
    """
    pixel, share = probed.asked.pixel_mm, probed.places.share
    parts = {k: v / pixel for k, v in prints.effects_mm(probed.seen, probed.thin_seen, share).items()}
    middle = float((probed.places.wavelength_nm * share).sum())
    parts["diffraction"] = np.full(1, 0.53 * 1e-6 * middle * probed.asked.f_number / pixel)
    passed = passed_share(probed)
    open_light = probed.seen.light / np.maximum(passed, 1e-30)
    axis = int(np.argmin(np.hypot(*probed.places.film_mm)))
    by_wave = probed.seen.weight.mean(2) / np.maximum((probed.seen.weight.mean(2) * share).sum(1), 1e-30)[:, None]
    light = {
        "natural fall-off": open_light / max(open_light[axis], 1e-30) - 1,
        "vignetting": passed - 1,
        "transmittance": np.sqrt((share * (by_wave - 1) ** 2).sum(1)),
    }
    return {
        **{k: ("px", probed.on_film(v)) for k, v in parts.items()},
        **{k: ("relative", probed.on_film(v)) for k, v in light.items()},
    }


def passed_share(probed: Probe) -> Array:
    """Return the share [N] of the light through the stop that no rim takes, by exact tracing (`field_curves`).

    It is traced from the axis outwards; beyond the last field with a chief ray its share is kept. An anamorphic lens is
    traced along x and along y, and the two shares are multiplied, as if its rims were slits.
    """

    def along(axis: Literal["x", "y"], height_mm: Array) -> Array:
        try:
            data = illumination(Fields(probed.lens, probed.shot.focus_m, axis), fields=_FIELDS)
        except InputError:  # no chief rays: the natural fall-off then includes what the rims take
            return np.ones_like(height_mm)
        known = np.isfinite(data.passed)
        order = np.argsort(data.height_mm[known])
        return np.interp(height_mm, data.height_mm[known][order], data.passed[known][order])

    x, y = np.abs(probed.places.film_mm)
    return along("x", x) * along("y", y) if probed.lens.anamorphic else along("y", np.hypot(x, y))


def effects_of(probed: Probe, budget_px: float, stray: bool = True) -> tuple[Effect, ...]:
    """Return the effects with their worth in this picture, largest first.

    `stray`: whether ghosts, glare and stars are among them where they are known, which take seconds to draw.
    """
    maps, effects = effect_maps(probed), list[Effect]()
    if stray:
        with suppress(InputError):
            maps |= {k: ("relative", v) for k, v in stray_light(probed.scene, probed.exact, probed.small).items()}
    for name, (unit, value) in maps.items():
        budget = budget_px if unit == "px" else LIGHT
        known = np.abs(value[np.isfinite(value)])
        worth = float(np.percentile(known, COUNTED))
        effects.append(Effect(name, worth, float((known > budget).mean()), unit, worth > budget, value))
    return tuple(sorted(effects, key=lambda e: (e.unit, -e.worth)))
