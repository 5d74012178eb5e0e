"""Exported lens models, loaded with suspicion and run with onnxruntime: rays in, rays out, numpy arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError, ModelError
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.onnxsession import open_session, run_batches
from neurolens.modelfile.cardcheck import check_card, tolerances
from neurolens.modelfile.onnxfile import read_checked, without_outputs
from neurolens.modelfile.states import STATE, axes_of, card_at, default_state, state_numbers

INPUTS = {"rays": ("tensor(float)", 5, None), "film_z_mm": ("tensor(float)", 1), "stop_radius_mm": ("tensor(float)", 1)}
OUTPUTS = {
    "scene_ray": ("tensor(float)", 6, None),
    "transmittance": ("tensor(float)", None),
    "stop_xy_mm": ("tensor(float)", 2, None),
    "status": ("tensor(int32)", None),
}
# Outputs that a file may have besides; see `onnxmaps`.
DERIVATIVES = {name: ("tensor(float)", 2, 6, None) for name in ("scene_ray_d_film", "scene_ray_d_pupil")}
# Rays a call of onnxruntime: enough to hide the cost of its operators, few enough for the caches.
BATCH = 16384
MAX_RAYS = 2**27


class LensRays(NamedTuple):
    """What a model gives for N rays; lens frame, mm. Rays mean something where status is 0.

    scene_ray [6, N] float32 (x, y, z, unit direction), transmittance [N], stop_xy_mm [2, N] (crossing with the stop),
    status [N] int32 (see `neurolens.base.status`).
    """

    scene_ray: FloatArray
    transmittance: FloatArray
    stop_xy_mm: FloatArray
    status: NDArray[np.int32]


class OnnxLens:
    """An exported model, loaded and checked. Make it with `load_model`.

    Attributes:
        card: see `neurolens.surrogates.card`; its lens and domain are those of `state`.
        path, data: of the file.
        axes: what the model's state is made of (zoom in mm, focus in 1/m); none for a model of one state.
        state: a number for every axis.
    """

    def __init__(self, path: Path, data: bytes, card: dict[str, Any], threads: int) -> None:
        self.path, self.card, self.threads = path, card, threads
        self.axes, self.state = axes_of(card), default_state(card)
        self.data = data
        self._session = open_session(
            path, without_outputs(data, frozenset(DERIVATIVES)), threads, self._inputs, OUTPUTS
        )
        self._status: Any = None  # session, opened when asked for

    def at(self, *state: float) -> OnnxLens:
        """The same model in another state, its card with the lens and the domain there; one session serves all.

        Raises:
            InputError: another number of values than axes, or one out of range.
        """
        other = copy(self)
        if self.axes or state:
            other.card, other.state = card_at(self.card, self.axes, state), tuple(float(v) for v in state)
        return other

    def reopened(self) -> OnnxLens:
        """The same model with a session of its own, for another process or thread."""
        other = OnnxLens(self.path, self.data, self.card, self.threads)
        other.state = self.state
        return other

    @np.errstate(over="ignore")  # numbers that float32 does not hold are outside the domain
    def rays(
        self,
        film_xy_mm: ArrayLike,
        pupil_xy_mm: ArrayLike,
        wavelength_nm: ArrayLike,
        film_z_mm: float | ArrayLike | None = None,
        stop_radius_mm: float | None = None,
        state: float | Sequence[float] | None = None,
    ) -> LensRays:
        """Scene-side rays of camera rays.

        Args:
            film_xy_mm, pupil_xy_mm: [2, N], lens frame, on the film plane and on the plane domain.pupil_z_mm.
            wavelength_nm: [N], or one number.
            film_z_mm: film plane; None takes the paraxial image of the farthest focus. An array [N] costs
                a call for each distinct value.
            stop_radius_mm: None takes the widest stop.
            state: of a model of many states, a number for every axis; None takes `self.state`, at first the first end
                of every axis. Out of range, every ray is outside the domain.

        Raises:
            InputError: arrays of other shapes, or another number of states than axes. Rays outside the domain are no
                error: their status says so.
        """
        if state is not None:
            return self._in_state(state).rays(film_xy_mm, pupil_xy_mm, wavelength_nm, film_z_mm, stop_radius_mm)
        points = {"film_xy_mm": film_xy_mm, "pupil_xy_mm": pupil_xy_mm}
        columns = ray_columns("OnnxLens.rays", 2, points, wavelength_nm)
        stop = self.card["domain"]["stop_radius_mm"] if stop_radius_mm is None else stop_radius_mm
        film_z_mm = self.card["lens"]["film_z_mm"] if film_z_mm is None else film_z_mm
        plane, count = np.atleast_1d(np.asarray(film_z_mm, np.float32)), columns.shape[1]
        if plane.shape not in ((1,), (count,)):
            raise InputError("OnnxLens.rays", "film_z_mm", plane.shape, f"a number or an array ({count},)")
        if len(plane) == 1:
            return self._run(columns, plane, stop)
        planes, at = np.unique(plane, return_inverse=True)
        parts = [self._run(columns[:, at == k], planes[k : k + 1], stop) for k in range(len(planes))]
        place = np.argsort(np.argsort(at, kind="stable"), kind="stable")
        return LensRays(*(np.concatenate(of_one, -1)[..., place] for of_one in zip(*parts, strict=True)))

    def _run(self, rays: FloatArray, plane: FloatArray, stop_radius_mm: float) -> LensRays:
        call = self._call(plane, stop_radius_mm)
        return LensRays(*run_batches(self.path, self._session, tuple(OUTPUTS), {"rays": rays}, call, BATCH))

    def status(
        self, film_xy_mm: FloatArray, pupil_xy_mm: FloatArray, wavelength_nm: FloatArray, film_z_mm: float, stop: float
    ) -> NDArray[np.int32]:
        """`rays(...).status` alone, in less time: nothing else is computed. Arguments as there."""
        if self._status is None:
            rest = frozenset({*DERIVATIVES, *OUTPUTS} - {"status"})
            asked = {"status": OUTPUTS["status"]}
            self._status = open_session(self.path, without_outputs(self.data, rest), self.threads, self._inputs, asked)
        points = {"film_xy_mm": film_xy_mm, "pupil_xy_mm": pupil_xy_mm}
        rays = {"rays": ray_columns("OnnxLens.status", 2, points, wavelength_nm)}
        found: NDArray[np.int32] = run_batches(
            self.path, self._status, ("status",), rays, self._call(np.array([film_z_mm], np.float32), stop), BATCH
        )[0]
        return found

    @property
    def _inputs(self) -> dict[str, tuple[Any, ...]]:
        return {**INPUTS, STATE: ("tensor(float)", len(self.axes))} if self.axes else INPUTS

    def _call(self, plane: FloatArray, stop_radius_mm: float) -> dict[str, Any]:
        return {"film_z_mm": plane, "stop_radius_mm": stop_radius_mm} | ({STATE: self.state} if self.axes else {})

    def _in_state(self, state: float | Sequence[float]) -> OnnxLens:
        """`at`, for any numbers: out of range, where there is no domain, rays are sent with that of this state."""
        other, values = copy(self), state_numbers(self.axes, state)
        if all(a.limits[0] <= v <= a.limits[1] for a, v in zip(self.axes, values, strict=True)):
            other.card = card_at(self.card, self.axes, values)
        other.state = values
        return other


def load_model(path: str | Path, lens: str | None = None, threads: int = 1) -> OnnxLens:
    """Load an exported model and check it.

    Args:
        lens: SHA-256 of the prescription (`Lens.sha256`) that the model must stand for; None takes any.
        threads: of onnxruntime, within one operator. Batches that fit a core's cache gain nothing from more than one.

    Raises:
        ModelError: a file that is missing, truncated, too large, no ONNX model, without a card or with one of another
            schema, with other inputs and outputs, with operators or weights that no lens model has, of another lens, or
            whose reference rays come out wrong.
        InputError: fewer than one thread.
    """
    if threads < 1:
        raise InputError("load_model", "threads", threads, "at least 1")
    file = Path(path)
    data, card = read_checked(file)
    check_card(file, card)
    if lens is not None and card["lens"].get("sha256") != lens:
        found = str(card["lens"].get("sha256"))
        raise ModelError(
            f"{file}: card: lens.sha256: got {found[:16]}... ({card['lens'].get('name')}), expected {lens[:16]}...: "
            "the model stands for another lens"
        )
    model = OnnxLens(file, data, card, threads)
    _check_reference(model)
    return model


def ray_columns(
    where: str, rows: int, points: Mapping[str, ArrayLike], wavelength_nm: ArrayLike, dtype: type = np.float32
) -> NDArray[Any]:
    """Arrays [rows, N] of points or directions, by name, and wavelengths [N] or one for all, below each other.

    Raises:
        InputError: other shapes; more than `MAX_RAYS`.
    """
    try:
        given: list[NDArray[Any]] = [np.asarray(v, dtype) for v in (*points.values(), wavelength_nm)]
    except (ValueError, TypeError) as error:
        raise InputError(where, f"{', '.join(points)}, wavelength_nm", "(no arrays)", "arrays of numbers") from error
    *arrays, wavelength = given
    count = arrays[0].shape[1] if arrays[0].ndim == 2 else MAX_RAYS
    for name, array in zip(points, arrays, strict=True):
        if array.shape != (rows, count) or count > MAX_RAYS:
            expected = f"an array ({rows}, N) with N up to {MAX_RAYS}, the same for all"
            raise InputError(where, name, f"({array.shape})", expected)
    if wavelength.shape not in ((), (count,)):
        raise InputError(where, "wavelength_nm", f"({wavelength.shape})", f"a number or an array ({count},)")
    return np.concatenate([*arrays, np.broadcast_to(wavelength, (1, count))])


def _check_reference(model: OnnxLens) -> None:
    """Recompute the card's reference rays, at every state that has some: what is loaded here is what was exported."""
    _check_rays(model, model.card.get("reference"))
    for reference in model.card["states"]["reference"] if model.axes else ():
        _check_rays(model.at(*reference["state"]), reference)


@np.errstate(over="ignore", invalid="ignore")  # what is not finite is refused
def _check_rays(model: OnnxLens, reference: Any) -> None:
    try:
        rays = np.asarray(reference["rays"], np.float32)
        wanted = [np.asarray(reference[k], np.float64) for k in ("scene_ray", "transmittance", "stop_xy_mm", "status")]
        found = model.rays(rays[:2], rays[2:4], rays[4], float(reference["film_z_mm"][0]), reference["stop_radius_mm"])
        if any(a.shape != b.shape for a, b in zip(found, wanted, strict=True)):
            raise ValueError("columns of unequal length")
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        raise ModelError(f"{model.path}: card: reference: {type(error).__name__}: {error}") from error
    passed = wanted[3] == st.PASSED
    if not np.array_equal(found.status, wanted[3]) or not passed.any():
        raise ModelError(
            f"{model.path}: reference rays: got status {found.status.tolist()}, expected {wanted[3].tolist()}"
        )
    try:
        position, direction, power, stop = tolerances(model.card, reference).values()
    except (AttributeError, TypeError, ValueError) as error:
        raise ModelError(f"{model.path}: card: reference.rounding: {type(error).__name__}: {error}") from error
    allowed = [[position]] * 3 + [[direction]] * 3, power, stop, 0
    for name, a, b, tolerance in zip(LensRays._fields, found, wanted, allowed, strict=True):
        off = np.abs(a[..., passed] - b[..., passed])
        if not (off <= np.asarray(tolerance)).all():  # NaN fails
            raise ModelError(
                f"{model.path}: reference rays: {name} is wrong by {off.max():.3g}: the weights are damaged"
            )
