"""A scene as a lens sees it: places in view, the lens's footprints there, and the worth of each of its effects.

A probe sends the chief rays of a grid of film points into the scene. What they meet, and how far off, are the places at
which cameras are held against the exact lens (`footprints`), in the scene's own light. An effect is worth its part of
the exact footprints in pixels, or the light that it adds or takes relative to the picture; both are counted at the 95th
percentile over the picture.

A small picture with few samples shows where the scene is bright. The lens's ghosts, glare and stars from the scene's
own lights, drawn on as few pixels, are set against it.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Literal

import numpy as np

from neurolens.base.errors import InputError
from neurolens.cameras.build import ideal_as
from neurolens.cameras.contract import Camera
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.field import field_of
from neurolens.graph.compiler import has_compiler
from neurolens.models.fitted import Domain
from neurolens.models.pairs import domain_of
from neurolens.optics.analysis.field_curves import illumination
from neurolens.optics.analysis.fields import Scene as Fields
from neurolens.optics.lens.paraxial import colours, first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.lens.shot import Dispersion, Shot
from neurolens.optics.setting.pupils import image_radius_mm
from neurolens.optics.setting.states import set_lens
from neurolens.pictures.flare.canvas import Raster
from neurolens.pictures.flare.job import FlareJob
from neurolens.pictures.flare.layers import flare_layers
from neurolens.pictures.flare.lights import Light, SceneLights, highlights, keep
from neurolens.pictures.render.colour import SpectralRange
from neurolens.pictures.render.job import expected_light
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.scene import Scene
from neurolens.pictures.render.settings import FlareSettings
from neurolens.pictures.render.world import shared_worlds
from neurolens.studies.plan import footprints as prints
from neurolens.studies.plan.footprints import AFTERWARDS, Array, Footprints, Places
from neurolens.studies.scenes import seen_depths_m

ACROSS = 48  # pixels of the small picture along its longer side
BLACK = 0.01  # of the picture's mean: darker values do not count in ratios
STRAY = {"ghosts": "flare", "glare": "glare", "starburst": "star-bursts"}  # layers, and their names in a plan
_SAMPLES = 32  # samples of a pixel: all pixels together take a tenth of a second
_MOST_LIGHTS = 8
_STARS = 2  # lights whose stars are drawn, the brightest in view; each takes a second
_HIGHLIGHT = 4.0  # times the picture's mean: what is brighter shines, or mirrors what shines
_NEAR_DEG = 2.0  # within which a highlight is the image of a light
# Wavelengths of ghosts, of which coatings of many layers need so many; their cells; photons of all lights together.
_WAVES, _CELL_PX, _PHOTONS = 10, 2.0, 1 << 18
_TAIL = 1e-3  # share of the light that its range leaves out at either end


@dataclass(frozen=True)
class Overview:
    """A small picture of a scene.

    Attributes:
        rgb: [H, W, 3] linear sRGB.
        range_nm: the range of nearly all of its light, as the eye weighs it.
        wavelength_nm, share: [W] of that range; shares have the sum 1.
    """

    rgb: Array
    range_nm: tuple[float, float]
    wavelength_nm: Array
    share: Array

    @property
    def floor(self) -> float:
        """The radiance below which the picture counts as black."""
        return max(BLACK * float(self.rgb.mean()), 1e-30)


def overview(scene: Scene, camera: Camera) -> Overview:
    """Look at a scene through a camera."""
    width, height = small_raster(camera.film_mm)
    rgb = render(scene, camera, width=width, height=height, samples=_SAMPLES, threads=1).rgb.astype(np.float64)
    return Overview(rgb, *light_of(scene, camera, rgb.mean((0, 1))))


def small_raster(film_mm: tuple[float, float], across: int = ACROSS) -> tuple[int, int]:
    """Return width and height in pixels of a picture with `across` pixels along its longer side."""
    width, height = (max(round(across * side / max(film_mm)), 1) for side in film_mm)
    return width, height


def light_of(scene: Scene, camera: Camera, rgb: Array) -> tuple[tuple[float, float], Array, Array]:
    """Return range, wavelengths (nm) and their shares of a picture's light as the eye weighs it: see `spectrum_seen`.

    The range holds nearly all of the light. Each of its equal parts is one wavelength, its centroid, so that a narrow
    line is one.
    """
    low, high = scene.settings.camera.wavelength_nm
    if not camera.dispersive and getattr(camera, "achromatic", False):
        return (low, high), np.array([(low + high) / 2]), np.ones(1)
    nm, seen = spectrum_seen(scene, rgb)
    reached = np.cumsum(seen) / seen.sum()
    first, last = (int(np.searchsorted(reached, q)) for q in (_TAIL, 1 - _TAIL))
    return (float(nm[first]), float(nm[last])), *parts_of(nm, seen, first, last, len(colours((low, high))[0]))


def spectrum_seen(scene: Scene, rgb: Array) -> tuple[Array, Array]:
    """Return wavelengths (nm) and their light as the eye weighs it.

    It is that of the scene's lights, tinted so that the picture has the mean colour [3].
    """
    low, high = scene.settings.camera.wavelength_nm
    nm, light = expected_light(scene)
    spectral = SpectralRange(low, high, len(nm))
    if spectral.colours and rgb.max() > 0:
        white = spectral.film_rgb(light)
        light = light * spectral.spectrum(np.clip(rgb / np.maximum(white, 1e-3 * white.max()), 0, None))
    eye = np.interp(nm, *colours((low, high))) if low < high else np.ones_like(nm)
    return nm, np.maximum(light * eye, 0)


def parts_of(nm: Array, seen: Array, first: int, last: int, count: int) -> tuple[Array, Array]:
    """Return the centroids of equal parts of a spectrum between two indices, and their shares, without dark parts."""
    edges = np.linspace(nm[first], nm[last], count + 1)
    part = np.clip(np.searchsorted(edges, nm, side="right") - 1, 0, count - 1)
    share = np.bincount(part, seen, count)
    lit = share > 1e-6 * share.sum()
    return np.bincount(part, seen * nm, count)[lit] / share[lit], share[lit] / share[lit].sum()


def stray_light(scene: Scene, camera: ExactCamera, seen: Overview) -> dict[str, Array]:
    """Return the light that the lens adds, relative to the small picture, [H, W] by name of `STRAY`.

    It is that of the colour with most. The lights are those of the scene, in view or not, and highlights of the picture
    that are not their images. What mirrors or shines beyond the picture's edge is not known.

    Raises:
        InputError: there is no compiler, or the lens's flare is not known (cylinders).
    """
    lens: Lens = camera.lens
    assert lens.film_z_mm is not None
    if not has_compiler():
        raise InputError(lens.path, "flare", "(no C compiler)", "one, to trace ghosts")
    height, width = seen.rgb.shape[:2]
    sources = SceneLights(scene)
    lights = keep(sources.seen(scene, lens.film_z_mm, 16 * _MOST_LIGHTS), _MOST_LIGHTS).lights
    lights += _highlights(camera, seen, lights)
    none = np.zeros((height, width))
    if not lights:
        return dict.fromkeys(STRAY.values(), none)
    raster, light_nm = Raster(camera.film_mm, width, height), scene.settings.camera.wavelength_nm
    settings = FlareSettings(bins=_WAVES, cell_px=_CELL_PX, glare=_PHOTONS // len(lights))
    layers = flare_layers(FlareJob(lens, lights, raster, settings, light_nm, threads=1, finer=1))
    half = np.array(camera.film_mm) / 2 / camera.settings["lens_state"]["pinhole_focal_length_mm"]
    stars = [a for a in lights if (np.abs(a.towards[:2]) < -1.1 * half * a.towards[2]).all()][:_STARS]
    only = replace(settings, glare=0, starburst=True, without=("ghosts",))
    layers |= flare_layers(FlareJob(lens, stars, raster, only, light_nm, threads=1)) if stars else {}
    base = np.maximum(seen.rgb.mean(-1), seen.floor)
    return {effect: layers[name].max(-1) / base if name in layers else none for name, effect in STRAY.items()}


def _highlights(camera: ExactCamera, seen: Overview, known: list[Light]) -> list[Light]:
    """Find bright regions of the picture that are not where a known light is."""
    threshold = _HIGHLIGHT * float(seen.rgb.mean())
    if not threshold > 0 or not (seen.rgb.max(-1) >= threshold).any():
        return []
    focus = float(camera.settings.get("focus_m") or math.inf)
    middle = float((seen.wavelength_nm * seen.share).sum())  # one wavelength tells where they are
    field = field_of(camera, focus, "equidistant", spectrum=(np.array([middle]), np.ones(1)))
    found = highlights(seen.rgb.astype(np.float32), field, camera.film_mm, threshold, _MOST_LIGHTS)
    near = math.cos(math.radians(_NEAR_DEG + 45 / ACROSS))
    return [a for a in found.lights if all(float(a.towards @ b.towards) < near for b in known)]


COUNTED = 95.0  # percentile over the picture at which a budget is counted
Unit = Literal["px", "relative"]
Maps = dict[str, tuple[Unit, Array]]
LIGHT = 0.01  # relative error of light that a plan allows beside its budget of error
_FOCUS_SPARE = 0.25  # of a pixel of blur: how far a model may place its film from the lens's film
_FIELDS = 17  # fields from the axis to the edge of the film at which vignetting is traced
_ACROSS = 16  # points of the probe along the longer side
# The step of compositing that makes an effect; a blur by depth makes all blur.
_MADE_BY = {"distortion": "distortion", "natural fall-off": "distortion", "vignetting": "distortion"} | dict.fromkeys(
    ("defocus", "spherical aberration", "coma", "astigmatism", "field curvature", "higher orders",
     "longitudinal colour", "diffraction"), "defocus",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class SceneNeeds:
    """What a camera must serve in a scene and its shot.

    Attributes:
        f_number: no wider than the lens opens. pixel_mm: pitch.
        nearest_m, farthest_m: along the axis from the film; None where nothing is in view.
        distant: share of the picture that shows things without a distance. dark: share that the lens leaves dark.
        light_nm: range of all but 0.2% of the scene's light, as the eye weighs it.
        afterwards: which of `footprints.AFTERWARDS` compositing makes.
        denoised: whether noise is removed later, so that cameras are not charged for it.
        zoom: state of the lens.
    """

    film_mm: tuple[float, float]
    focus_m: float
    f_number: float
    wavelength_nm: tuple[float, float]
    pixel_mm: float
    nearest_m: float | None
    farthest_m: float | None
    distant: float
    dark: float
    light_nm: tuple[float, float]
    afterwards: tuple[str, ...] = ()
    denoised: bool = False
    zoom: str | None = None


@dataclass(frozen=True)
class Effect:
    """What an effect of the lens is worth in a picture.

    Attributes:
        worth: at the counted percentile, in pixels (RMS distance by which it moves light) or, where `relative`, as a
            share of the light; inf where it is not known.
        median: over the picture. over: share of the picture where it is beyond the budget.
        needed: whether a camera needs it. why: the reason where it does not, or where the worth is not known.
    """

    name: str
    worth: float
    median: float
    over: float
    unit: Unit
    needed: bool
    why: str = ""


@dataclass(frozen=True)
class Probe:
    """A scene's places as the exact lens sees them, with its camera, its footprints there, and a thin lens's.

    Attributes:
        shot: of the lens at its zoom, with the dispersion that cameras are to have.
        lens, domain: the lens is stopped down and focused; the domain is that of models of this shot.
        places: those with light, among `shape` rows and columns over the film.
        seen, thin_seen: footprints of the exact camera and of a thin lens.
        wanted: the footprints that a camera should have: `seen` without the effects that are made afterwards.
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
    wanted: Footprints
    overview: Overview

    @cached_property
    def camera_maps(self) -> Maps:
        """The maps of `effect_maps`, made once."""
        return effect_maps(self)

    @cached_property
    def maps(self) -> Maps:
        """`camera_maps`, and maps of the light that the lens adds, on more pixels, where that light is known."""
        with suppress(InputError):
            added = stray_light(self.scene, self.exact, self.overview)
            return self.camera_maps | {k: ("relative", v) for k, v in added.items()}
        return self.camera_maps

    def on_film(self, value: Array) -> Array:
        """Values [N] of places as a picture [rows, columns], upright as prints are; NaN where there is no place."""
        film = np.full(self.shape, np.nan)
        at = self.places.film_mm / np.array(self.asked.film_mm)[:, None] + 0.5
        column, row = (np.minimum((at[k] * n).astype(int), n - 1) for k, n in enumerate(self.shape[::-1]))
        film[row, column] = np.broadcast_to(value, row.shape)
        return film[:, ::-1]  # the top left of a picture is at +x, -y of the film


def probe(
    scene: Scene, lens: Lens, *, across: int = _ACROSS, afterwards: Collection[str] = (), denoised: bool = False,
    zoom: str | None = None, dispersion: Dispersion = "full",
) -> Probe:  # fmt: skip
    """Look through the exact lens at a scene.

    Args:
        across: places along the longer side. afterwards: which of `footprints.AFTERWARDS` compositing makes:
            distortion, where the ST map corrects the picture's light, too, and defocus. denoised: see `SceneNeeds`.
        zoom: state of the lens by name or focal length; None leaves it as it is.
        dispersion: what cameras are to have; the exact lens that they are held against has all of it.

    Raises:
        InputError: the scene's camera is none that the lens can be; the lens leaves the picture dark; other names; an
            unknown state.
    """
    if not set(afterwards) <= set(AFTERWARDS):
        raise InputError("plan", "afterwards", sorted(afterwards), f"of {', '.join(AFTERWARDS)}")
    lens, shot = lens if zoom is None else set_lens(lens, zoom=zoom), scene.settings.camera
    film, widest = shot.film_mm, first_order(lens).f_number
    f_number = max(shot.f_number or widest, widest)
    stopped, domain = set_lens(lens, f_number=f_number, focus_m=shot.focus_m), _domain(lens, scene, f_number)
    real = Shot(film, shot.focus_m, f_number, aperture=lens.aperture, wavelength_nm=shot.wavelength_nm)
    exact = ExactCamera(lens, real, bounds=domain.bounds)
    columns, rows = shape = small_raster(film, across)
    centres = (((np.arange(n) + 0.5) / n - 0.5) * side for n, side in zip(shape, film, strict=True))
    points = np.stack(np.meshgrid(*centres)).reshape(2, -1)
    with shared_worlds():
        small, depth = overview(scene, exact), seen_depths_m(scene, exact, points)
    far = np.where(np.isnan(depth), np.inf, depth)
    places = prints.places_of(exact, points, far, small.wavelength_nm, small.share)
    if not places.film_mm.shape[1]:
        raise InputError(scene.name, "camera", lens.name, "a lens that lights some of this film")
    met = depth[np.isfinite(depth)]
    asked = SceneNeeds(
        film_mm=film, focus_m=shot.focus_m, f_number=f_number, wavelength_nm=shot.wavelength_nm,
        pixel_mm=film[0] / shot.width, nearest_m=float(met.min()) if met.size else None,
        farthest_m=float(met.max()) if met.size else None, distant=float(np.isinf(depth).mean()),
        dark=1 - places.film_mm.shape[1] / points.shape[1], light_nm=small.range_nm,
        afterwards=tuple(sorted(afterwards)), denoised=denoised, zoom=zoom,
    )  # fmt: skip
    seen, ideal = (prints.footprints(c, places) for c in (exact, ideal_as("thin:", exact.lens, real)))
    wanted = prints.left_to(seen, ideal, places.share, afterwards)
    own = replace(real, dispersion=dispersion)
    return Probe(scene, asked, own, stopped, domain, exact, places, (rows, columns), seen, ideal, wanted, small)


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
    maps: Maps = {k: ("px", probed.on_film(v)) for k, v in parts.items()}
    maps |= {k: ("relative", probed.on_film(v)) for k, v in light.items()}
    return maps


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

    `stray`: whether ghosts, glare and stars are among them, which take seconds to draw.
    """
    effects = []
    for name, (unit, value) in (probed.maps if stray else probed.camera_maps).items():
        budget = budget_px if unit == "px" else LIGHT
        known = np.abs(value[np.isfinite(value)])
        worth, later = float(np.percentile(known, COUNTED)), _MADE_BY.get(name) in probed.asked.afterwards
        why = "made afterwards" if later else "left out" if worth <= budget else ""
        over = float((known > budget).mean())
        effects.append(Effect(name, worth, float(np.median(known)), over, unit, not why, why))
    if not {*STRAY.values()} & {e.name for e in effects}:
        why = "not known" if stray else "not looked for: --explain does, in seconds"
        effects.append(Effect("flare", math.inf, math.inf, 1.0, "relative", True, why))
    return tuple(sorted(effects, key=lambda e: (e.unit, -e.worth)))
