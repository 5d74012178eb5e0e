"""Exported lens models as cameras, which run with onnxruntime and numpy alone."""

import math
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.base.files import fingerprint_of
from neurolens.base.progress import Progress
from neurolens.base.status import DOMAIN_SLACK
from neurolens.cameras.cameragraph import LensGraph
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.exact import kept_outline, searching_code
from neurolens.cameras.lenscamera import LensCamera
from neurolens.cameras.lensfilm import Array, LensScene, axial_light, film_slope
from neurolens.cameras.onnxlens import LensRays, OnnxLens, load_model
from neurolens.cameras.pose import FilmPose, warn_beyond
from neurolens.cameras.pupil_outline import COARSE, PupilOutline, PupilTable, outline_of
from neurolens.cameras.sampling import beyond_circle, common_light, lens_state
from neurolens.models.assemble import ONNX, SCALARS, Form
from neurolens.models.card import state_for
from neurolens.models.copied import Copied
from neurolens.models.file import coefficients_text
from neurolens.models.inverse import InverseModel, inverse_of
from neurolens.optics.lens import paraxial
from neurolens.optics.lens.prescription import LINE_D_NM, Lens, Surface
from neurolens.optics.lens.shot import Shot
from neurolens.optics.setting import focusing

__all__ = ["LensRays", "OnnxCamera", "OnnxLens", "load_model"]

# Parts of the card that the metadata of pictures leave out.
_NOT_KEPT = ("reference", "units", "frame", "status_codes", "states")
_NOMINAL = 1.02  # engraved f-numbers are rounded: this factor wider than the widest stop still means the widest stop


class OnnxCamera(LensCamera):
    """A camera whose lens is an exported model.

    Args:
        model: see `load_model`.
        shot: the settings of the camera. Film beyond the model's film radius stays dark. An f-number up to 2% below the
            model's widest stop means that stop (an engraved f/1.8 may be 1.83). A zoom of None leaves the model in its
            state. Focusing moves the groups of a model that knows them, whatever the mode; the film then stands in
            best focus (`best_focus_z_mm`), or with "paraxial" in the paraxial image.
        outline: of the pupil of the lens itself, to compare the model with it; None searches the model's own.
        progress: as for `LensCamera.start`.

    Raises:
        InputError: a focus, stop or zoom position outside the model's domain, or no C compiler where one is needed.

    Warns:
        NeurolensWarning: best focus lies beyond the film positions of the model; its film is then at the end of them.
    """

    def __init__(
        self,
        model: OnnxLens,
        shot: Shot,
        *,
        outline: PupilOutline | None = None,
        progress: Progress | None = None,
    ) -> None:
        _check_shot(model, shot)
        if model.axes:
            model = model.at(*state_for(model.path, model.axes, model.state, shot.zoom, shot.focus_m))
        if shot.focus_mode == "auto":  # the card's axes say which motion the model holds: its groups', or the film's
            inside = any(a.name == "focus" for a in model.axes) and math.isfinite(shot.focus_m)
            shot = replace(shot, focus_mode="internal" if inside else "best")
        card = model.card
        lens, domain = card["lens"], card["domain"]
        self.model, self.path = model, model.path
        self.name = str(lens.get("name", model.path.stem))
        self.film_mm = shot.film_mm
        low, high = (float(v) for v in domain["wavelength_nm"])
        self.dispersive = low < high
        # A model for one wavelength of a dispersive lens knows that wavelength only; without dispersion, any wavelength
        # will do.
        self.wavelength_nm = (low, high) if lens["dispersive"] else None
        # Glass absorbs some wavelengths more than others, so that the exposure is that of the light in use.
        self._light_nm = used = common_light((low, high), shot.wavelength_nm)
        stop = _stop_radius(model, shot)
        paraxial, (near, far) = _paraxial_film_z(model, shot.focus_m), domain["film_z_mm"]
        start = ModelScene(model, min(max(paraxial, near), far), stop, shot.aperture)
        best = paraxial if shot.focus_mode == "paraxial" else best_focus_z_mm(start, shot.focus_m, used)
        film_z = _film_z(model, best, shot.film_offset_mm, lens["f_number"] * lens["stop_radius_mm"] / stop)
        scene = replace(start, film_z_mm=film_z)
        pupil_z, pose = float(domain["pupil_z_mm"]), FilmPose.of(shot)
        found = outline.on_plane(pupil_z, film_z) if outline else _outline_of(replace(scene, aperture=None), used)
        warn_beyond(self.path, model.fitted.lens, pose)
        covered = pose.covers_mm(shot.film_mm, film_z - pupil_z)
        notes = beyond_circle(covered, domain["film_radius_mm"], "the model's picture", "stay dark")
        poor = ", ".join(card["errors"].get("poor") or ())
        f_number = lens["f_number"] * lens["stop_radius_mm"] / stop
        about = {
            "camera": "model",
            "model": str(model.path),
            "efl_mm": lens["efl_mm"],
            "f_number": f_number,
            "state": dict(zip((a.name for a in model.axes), model.state, strict=True)),
            "card": {k: v for k, v in card.items() if k not in _NOT_KEPT},
            "lens_state": _state_of(scene, used, f_number),
            "notes": [*([f"the model is poor, as its card says: {poor}"] if poor else []), *notes],
        }
        self.place(found, scene, shot, about, progress)

    def lens_graph(self, form: Form = SCALARS) -> LensGraph:
        """Return the graph of the model in the camera's state, with its stop."""
        scene = self.film.scene
        # Series decode unit directions, whose range is tested; to test the length, too, takes eight passes in
        # onnxruntime.
        unit = form is ONNX and self.model.fitted.direction == "angle"
        return LensGraph(self.model.graph(form), scene.stop_radius_mm, scene.aperture, scene.stopped, unit)

    @property
    def front(self) -> Surface | None:
        """The front surface of the lens, as the inverse map has it."""
        return self.model.fitted.front

    def _traced_back(
        self, position: NDArray[np.float64], direction: NDArray[np.float64], wavelength_nm: FloatArray
    ) -> tuple[NDArray[np.float64], FloatArray, NDArray[np.int32]]:
        """Find film points by the model's inverse map of scene rays; where it finds none, the status is NO_SOLUTION."""
        scene = self.film.scene
        out = self._inverse.from_scene(position, direction, wavelength_nm, scene.film_z_mm, scene.stop_radius_mm)
        return out.rays[:4], np.maximum(out.transmittance, 0).astype(np.float32), scene.status_of(out)

    @cached_property
    def _inverse(self) -> InverseModel:
        return inverse_of(self.model.fitted)


class ModelScene(LensScene):
    """A model at one focus and stop."""

    lens: OnnxLens


# Rays of the best focus, of which many rings, because the stop's edge falls between two; radius of their disc over that
# of the axial pupil at the stop in use.
_RINGS, _SPOKES, _WIDER = 192, 24, 1.3
_STEPS, _SHIFT = 4, 1e-3  # towards film points whose rays meet the object; of differences, over the film radius
_SQUEEZED = 0.05  # height of the rays that tell a squeeze, as a share of the film radius
_BLUR_MM = 0.002  # a spot that grows by this much is worth a warning


def best_focus_z_mm(scene: ModelScene, focus_m: float, wavelength_nm: tuple[float, float]) -> float:
    """Find the film plane of least RMS spot for the axial point `focus_m` metres from it.

    It is that of the exact lens, which the model's file holds: a model knows the rays from a plane better than their
    focus. In a small stop a micrometre of error is 0.03 mm of focus, and a film moved by so much moves the picture's
    edge more than a micrometre. A copy, and a state between others, have no lens in the file: they are focused by
    their own rays. The plane may lie outside the domain.

    Args:
        scene: the model, with its film in the paraxial image or near it.

    Raises:
        InputError: no ray passes.
    """
    best = _by_the_lens(scene, lambda lens: focusing.best_focus_z_mm(lens, focus_m, wavelength_nm))
    return _axial_spot(scene, focus_m, wavelength_nm)[0] if best is None else best


def best_focus_of_stops_mm(
    scene: ModelScene, focus_m: float, wavelength_nm: tuple[float, float], stops_mm: Array
) -> Array:
    """Return `best_focus_z_mm` at stop radii up to the scene's, from one set of rays."""
    rule = focusing.best_focus_of_stops_mm
    if (by_lens := _by_the_lens(scene, lambda lens: rule(lens, focus_m, stops_mm.tolist(), wavelength_nm))) is not None:
        return by_lens
    best, rays, moments = _axial_spot(scene, focus_m, wavelength_nm)
    radius = np.hypot(*scene.lens.rays(*rays, scene.film_z_mm, scene.stop_radius_mm).stop_xy_mm)
    edge_mm = scene.stop_radius_mm * _WIDER / _RINGS  # from ring to ring: rays at a stop's edge count in part
    share = np.nan_to_num((stops_mm[:, None] - radius) / edge_mm + 0.5).clip(0, 1)
    along, across = moments @ share.T
    shift = -along / across
    # The object keeps its distance from the film: where the film moves, the image moves by the square of its scale.
    lens = scene.lens.card["lens"]
    scale = 0.0 if math.isinf(focus_m) else (scene.film_z_mm - lens["infinity_film_z_mm"]) / lens["efl_mm"]
    return np.asarray(scene.film_z_mm + shift + (shift + scene.film_z_mm - best) * scale**2)


def _by_the_lens(scene: ModelScene, rule: Callable[[Lens], Any]) -> Any:
    """Return what a rule gives for the lens of a scene; None where the model's file does not have it.

    A file has the lens of one state, as designed. Its glasses may be in a catalogue that this machine does not have.
    """
    fitted = scene.lens.fitted
    with suppress(InputError):
        if not (scene.lens.axes or "copy" in fitted.settings):
            return rule(fitted.lens.with_stop_radius(scene.stop_radius_mm).with_aperture(scene.aperture))
    return None


def _axial_spot(
    scene: ModelScene, focus_m: float, wavelength_nm: tuple[float, float]
) -> tuple[float, tuple[FloatArray, FloatArray, FloatArray], FloatArray]:
    """Find the least spot by the model's own rays; spot and colours are those of `focusing.best_focus_z_mm`.

    There rays come from the object. Here, Newton's method finds for each pupil point the film point whose ray meets it.

    Returns:
        The film plane of that spot; the film points and pupil points [2, N] and wavelengths [N] of the rays; and
        moments [2, N], whose sums over rays tell the best film: 0 of rays that do not pass.
    """
    domain = scene.lens.card["domain"]
    colours, weights = paraxial.colours(wavelength_nm)
    reach = float(domain["film_radius_mm"])
    round_ = scene.aperture is None and _is_round(scene, wavelength_nm)
    spokes = 1 if round_ else _SPOKES  # one spoke of a round lens stands for all
    shape = len(colours), _RINGS, spokes
    pupil = np.tile(_axial_pupil(domain, scene.stop_radius_mm, spokes), len(colours))
    nanometres = np.repeat(colours, _RINGS * spokes).astype(np.float32)
    film, best, shift = np.zeros_like(pupil), scene.film_z_mm, _SHIFT * reach

    def miss(film: FloatArray, object_z_mm: float) -> tuple[FloatArray, FloatArray, NDArray[np.int32]]:
        """Return by how much rays miss the object, their place in the entrance pupil, and their status."""
        out = scene(film.astype(np.float32), pupil.astype(np.float32), nanometres)
        place, way = out.scene_ray[:3].astype(np.float64), out.scene_ray[3:].astype(np.float64)
        with np.errstate(all="ignore"):
            slope = way[:2] / way[2]
            at_lens = place[:2] - place[2] * slope
        if math.isinf(object_z_mm):
            return slope, at_lens, out.status
        return slope + at_lens / object_z_mm, slope, out.status

    start = miss(film, best - 1000 * focus_m)[0]
    dx, dy = ((miss(film + shift * axis, best - 1000 * focus_m)[0] - start) / shift for axis in np.eye(2)[:, :, None])
    for _ in range(_STEPS):
        wrong, seen, status = miss(film, best - 1000 * focus_m)
        with np.errstate(all="ignore"):
            step = np.stack([wrong[0] * dy[1] - wrong[1] * dy[0], wrong[1] * dx[0] - wrong[0] * dx[1]])
            film = film - step / (dx[0] * dy[1] - dx[1] * dy[0])
            slope = (pupil - film) / (domain["pupil_z_mm"] - scene.film_z_mm)
            # Equal areas of the entrance pupil count alike, so a ray's weight is the area of its cell there.
            cell = seen.reshape(2, *shape)
            out, turn = np.gradient(cell, axis=2), np.roll(cell, -1, 3) - np.roll(cell, 1, 3)
            if round_:  # its neighbours are the same spoke, turned
                turn = cell[::-1] * np.array([-1.0, 1.0])[:, None, None, None]
            weight = weights[:, None, None] * np.abs(out[0] * turn[1] - out[1] * turn[0])
            moments = weight.reshape(-1) * np.stack([(film * slope).sum(0), (slope**2).sum(0)])
        moments = np.where((status == st.PASSED) & np.isfinite(moments).all(0), moments, 0.0)
        along, across = moments.sum(1)
        if not across > 0:
            raise InputError(scene.lens.path, "focus_mode", "best", "a model that lets axial light pass")
        best = scene.film_z_mm - float(along / across)
        film = np.where(np.isfinite(film), film, 0.0).clip(-reach, reach)  # rays that do not pass may go anywhere
    return best, (film.astype(np.float32), pupil.astype(np.float32), nanometres), moments


def _is_round(scene: ModelScene, wavelength_nm: tuple[float, float]) -> bool:
    """Tell whether all azimuths are alike: there is no squeeze, and no element is off the axis."""
    copy = isinstance(scene.lens.fitted.core, Copied)
    return not copy and scene.squeeze(_SQUEEZED * scene.lens.card["domain"]["film_radius_mm"], wavelength_nm) == 1.0


def _outline_of(scene: ModelScene, wavelength_nm: tuple[float, float]) -> PupilOutline | None:
    """Search the outline of a model with a round stop, or take it from the cache; see `kept_outline`.

    With cylinders, or elements off the axis, it is one for all azimuths, which fits none well.
    """
    domain, model = scene.lens.card["domain"], coefficients_text([scene.lens.fitted])

    def search() -> PupilOutline | None:
        bounds = PupilTable.of(domain["bounds"])
        if _is_round(scene, wavelength_nm):
            return outline_of(bounds, scene.passes, wavelength_nm)
        return outline_of(bounds, scene.passes_at_any_azimuth, wavelength_nm, COARSE)

    place = map(float, (scene.film_z_mm, scene.stop_radius_mm, *wavelength_nm))
    key = fingerprint_of([*searching_code(), onnxruntime.__version__, domain, model, *place])
    return kept_outline(key, search)


def _state_of(scene: ModelScene, wavelength_nm: tuple[float, float], f_number: float) -> dict[str, Any]:
    """Return the table `lens_state` of the settings, by the first-order data of the card."""
    model, film_z = scene.lens, scene.film_z_mm
    lens, radius = model.card["lens"], model.card["domain"]["film_radius_mm"]
    efl, front_efl = lens["efl_mm"], lens["efl_mm"] * paraxial.index_ratio(lens)
    focal_points = lens["front_principal_z_mm"] - front_efl, lens["rear_principal_z_mm"] + efl
    exit_z = float(lens.get("exit_pupil_z_mm", math.nan))
    entrance = paraxial.entrance_pupil_z_mm(efl, front_efl, focal_points, exit_z)
    squeeze = scene.squeeze(_SQUEEZED * radius, wavelength_nm)
    slope = film_slope(f_number, focal_points[1], exit_z, film_z)
    light = _light_on_axis(scene, float(np.clip(LINE_D_NM, *wavelength_nm)), 1 if squeeze == 1.0 else _SPOKES, slope)
    return lens_state(
        nominal_mm=None if any(a.name == "focus" for a in model.axes) else efl,
        efl_mm=efl,
        pinhole_mm=paraxial.reach_mm(efl, front_efl, focal_points, entrance, film_z),
        entrance_pupil_mm=film_z - entrance,
        f_number=f_number,
        transmittance=light / slope**2,
        squeeze=squeeze,
    )


def _light_on_axis(scene: ModelScene, wavelength_nm: float, turns: int, slope: float) -> float:
    """Return `axial_light`; 0 where nothing passes or the stop's shape is closed on the axis."""

    def trace(pupil: Array) -> LensRays:
        points, waves = pupil.astype(np.float32), np.full(pupil.shape[1], wavelength_nm, np.float32)
        return replace(scene, aperture=None)(np.zeros_like(points), points, waves)

    distance_mm = abs(scene.film_z_mm - scene.lens.card["domain"]["pupil_z_mm"])
    light = axial_light(trace, turns, slope, distance_mm, scene.stop_radius_mm, scene.stopped)
    return float(light[0] * (scene.aperture is None or scene.aperture.inside(np.zeros(1), np.zeros(1), 1.0)[0]))


def _axial_pupil(domain: dict[str, Any], stop_radius_mm: float, spokes: int) -> FloatArray:
    """Return pupil points [2, rings * spokes] about all rays from the film's centre that pass a stop."""
    ring, spoke = (np.arange(_RINGS) + 0.5) / _RINGS, 2 * np.pi * (np.arange(spokes) + 0.5) / spokes
    low, high, half = (abs(domain["bounds"][name][0]) for name in ("low_mm", "high_mm", "half_mm"))
    reach = _WIDER * max(low, high, half) * min(1.0, stop_radius_mm / domain["stop_radius_mm"])
    return (reach * ring[:, None] * np.stack([np.cos(spoke), np.sin(spoke)])[:, None]).reshape(2, -1)


def _paraxial_film_z(model: OnnxLens, focus_m: float) -> float:
    """Return the film position of the paraxial image of the object in focus; the focus must lie in the domain."""
    lens, (near, far) = model.card["lens"], model.card["domain"]["film_z_mm"]
    if any(a.name == "focus" for a in model.axes):
        return float(lens["film_z_mm"])  # its groups have moved
    z = paraxial.film_z_of_card_mm(lens, focus_m)
    # A domain may hold the film of best focus alone, which for a singlet is a millimetre from the paraxial one.
    least, most = sorted(float(v) for v in model.card["domain"]["focus_m"])
    if not (near / DOMAIN_SLACK <= z <= far * DOMAIN_SLACK or least <= focus_m <= most):
        raise InputError(model.path, "focus_m", focus_m, f"a focus within the model's domain, {_limits(model)}")
    return z


def _film_z(model: OnnxLens, best_mm: float, offset_mm: float, f_number: float) -> float:
    """Return the film position asked for, or the end of the model's domain nearest to it."""
    near, far = model.card["domain"]["film_z_mm"]
    z = best_mm + offset_mm
    if offset_mm and not near / DOMAIN_SLACK <= z <= far * DOMAIN_SLACK:
        expected = f"a film position within the model's domain, {near:.6g} to {far:.6g} mm (focus {_limits(model)})"
        raise InputError(model.path, "film_offset_mm", offset_mm, expected)
    used = min(max(z, near), far)
    if abs(used - z) > _BLUR_MM * f_number:
        said = (
            f"best focus needs its film at {z:.6g} mm; its domain ends at {used:.6g} mm, which is used: train it anew"
        )
        warnings.warn(f"{model.path}: {said}", NeurolensWarning, stacklevel=4)
    return float(used)


def _limits(model: OnnxLens) -> str:
    return " to ".join(f"{v} m" for v in reversed(model.card["domain"]["focus_m"]))


def _stop_radius(model: OnnxLens, shot: Shot) -> float:
    lens, widest = model.card["lens"], float(model.card["domain"]["stop_radius_mm"])
    widest_f = float(lens["f_number"] * lens["stop_radius_mm"] / widest)
    f_number = shot.f_number_for(widest_f)
    if f_number is None:
        return widest
    radius = lens["stop_radius_mm"] * lens["f_number"] / f_number
    if radius > widest * _NOMINAL:
        raise InputError(model.path, "f_number", f_number, f"at least {widest_f:.4g}, the model's widest stop")
    return float(min(radius, widest))


def _check_shot(model: OnnxLens, shot: Shot) -> None:
    """Refuse settings that the model does not take; what it takes depends on its axes, too."""
    axes = [a.name for a in model.axes]
    lacks = {name for name, axis in (("zoom", "zoom"), ("internal", "focus")) if axis not in axes}
    shot.check_taken(str(model.path), LensCamera.takes - lacks)
