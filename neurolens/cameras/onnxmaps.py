"""Inverse maps of exported models, from stop points and from scene rays back to camera rays, run by onnxruntime."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError, ModelError
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.onnxlens import OUTPUTS, check_lens, open_session, ray_columns, run_batches
from neurolens.graph.onnx import write_onnx
from neurolens.surrogates.assemble import ONNX
from neurolens.surrogates.file import ModelFile, check_size, read_model
from neurolens.surrogates.inverse import Guess, front_index, scene_graph, stop_graph
from neurolens.trace.shapes import Shape
from neurolens.trace.surfaces import front_rays

# Rays a call: these graphs have more rows than those of models alone.
_BATCH = 4096
_CALL = {"film_z_mm": ("tensor(float)", 1), "stop_radius_mm": ("tensor(float)", 1)}
_OUTPUTS = {"rays": ("tensor(float)", 5, None), **OUTPUTS, "density": ("tensor(float)", None)}
_GIVEN = {"stop": "stop_rays", "scene": "front_rays"}


class InverseRays(NamedTuple):
    """Camera rays found, [N]; they mean something where status is 0.

    rays [5, N] float32 (film x, y, pupil x, y in mm, wavelength in nm); scene_ray [6, N], transmittance [N], stop_xy_mm
    [2, N] and status [N] as the model gives them for those rays, with NO_SOLUTION where they are not what was asked
    for; density [N]: of `through_stop` |d stop / d pupil|, of `from_scene` mm^2 of film times mm^2 of the pupil plane
    per mm^2 of (x, y) on the front surface and steradian.
    """

    rays: FloatArray
    scene_ray: FloatArray
    transmittance: FloatArray
    stop_xy_mm: FloatArray
    status: NDArray[np.int32]
    density: FloatArray


class OnnxInverse:
    """The inverse maps of one model. Make it with `load_inverse`.

    Attributes:
        card: of the model; its entry "inverse" says how the map was fitted and how often it converges, by map.
    """

    def __init__(self, maps: Mapping[str, tuple[Any, ModelFile]], path: Path) -> None:
        self.path, self._maps = path, maps
        self.card = next(iter(maps.values()))[1].card

    def through_stop(
        self,
        film_xy_mm: ArrayLike,
        stop_xy_mm: ArrayLike,
        wavelength_nm: ArrayLike,
        film_z_mm: float | None = None,
        stop_radius_mm: float | None = None,
    ) -> InverseRays:
        """Rays from film points [2, N] through stop points [2, N].

        Raises:
            InputError: arrays of other shapes, or no file of this map.
        """
        points = {"film_xy_mm": film_xy_mm, "stop_xy_mm": stop_xy_mm}
        return self._run("stop", ray_columns("OnnxInverse", 2, points, wavelength_nm), film_z_mm, stop_radius_mm)

    def from_scene(
        self,
        origin_mm: ArrayLike,
        direction: ArrayLike,
        wavelength_nm: ArrayLike,
        film_z_mm: float | None = None,
        stop_radius_mm: float | None = None,
    ) -> InverseRays:
        """Camera rays of light along scene rays.

        Args:
            origin_mm: [3, N], a point of each ray before or on the front surface, lens frame.
            direction: [3, N] unit vectors of the camera rays, away from the lens: from a point X of the front surface
                to a scene point S, (S - X) / |S - X|.

        Raises:
            InputError: arrays of other shapes, or no file of this map.
        """
        lines = {"origin_mm": origin_mm, "direction": direction}
        *rays, wavelength = ray_columns("OnnxInverse", 3, lines, wavelength_nm, np.float64)
        index = front_index(self._map("scene")[1].nodes[0])
        known, solid = front_rays(self.front, *rays, index=index, wavelength_nm=wavelength)
        out = self._run("scene", np.concatenate([known, [wavelength]]), film_z_mm, stop_radius_mm)
        with np.errstate(all="ignore"):  # area of direction vectors to solid angle
            return out._replace(density=(out.density / solid).astype(np.float32))

    @property
    def front(self) -> Shape | None:
        """The surface on which scene rays are taken; None for the plane z = 0.

        Raises:
            InputError: no file of the map of scene rays.
        """
        return self._map("scene")[1].nodes[0].front

    def _map(self, name: str) -> tuple[Any, ModelFile]:
        if name not in self._maps:
            raise InputError(self.path, "map", name, f"one of those found: {', '.join(self._maps)}")
        return self._maps[name]

    def _run(
        self, name: str, given: NDArray[Any], film_z_mm: float | None, stop_radius_mm: float | None
    ) -> InverseRays:
        session, file = self._map(name)
        card, domain = file.card, file.card["domain"]
        call = {
            "film_z_mm": card["lens"]["film_z_mm"] if film_z_mm is None else film_z_mm,
            "stop_radius_mm": domain["stop_radius_mm"] if stop_radius_mm is None else stop_radius_mm,
        }
        with np.errstate(over="ignore"):
            rays = {_GIVEN[name]: given.astype(np.float32)}
        return InverseRays(*run_batches(self.path, session, InverseRays._fields, rays, call, _BATCH))


def load_inverse(path: str | Path, lens: str | None = None) -> OnnxInverse:
    """Load the inverse maps that lie beside a model: NAME.stop.onnx and NAME.scene.onnx for NAME.onnx.

    Args:
        path: of the model. lens: see `load_model`.

    Raises:
        ModelError: neither file is there, or one is damaged, of another lens, or does not lead the card's reference
            rays back.
    """
    base = Path(path).with_suffix("")
    maps = {}
    for name in _GIVEN:
        file = base.with_name(f"{base.name}.{name}.onnx")
        if file.is_file():
            maps[name] = _load(file, name, lens)
    if not maps:
        raise ModelError(f"{base}.stop.onnx, {base}.scene.onnx: no such files, expected exported inverse maps")
    inverse = OnnxInverse(maps, Path(path))
    for name, (_, model) in maps.items():
        _check(inverse, name, model.card)
    return inverse


def _load(path: Path, name: str, lens: str | None) -> tuple[Any, ModelFile]:
    file = read_model(path)
    facts = file.card.get("inverse")
    if not isinstance(facts, dict) or facts.get("map") != name or file.axes:
        raise ModelError(f"{path}: card: inverse: got {str(facts)[:80]}, expected the facts of the {name} map")
    check_lens(file, lens)
    build = stop_graph if name == "stop" else scene_graph
    try:
        with np.errstate(all="ignore"):
            guess = Guess.unpacked(file.more["guess"])
            check_size((guess.exponents, guess.ab))
            data = write_onnx(build(file.nodes[0], guess, ONNX), {})
    except (ValueError, TypeError, KeyError, IndexError, ArithmeticError, AttributeError) as error:
        raise ModelError(f"{path}: its first guess is damaged ({type(error).__name__}: {error})") from error
    inputs = {_GIVEN[name]: ("tensor(float)", 5, None), **_CALL}
    return open_session(path, data, inputs, _OUTPUTS), file


def _check(inverse: OnnxInverse, name: str, card: dict[str, Any]) -> None:
    """Nine of ten of the card's passing reference rays come back; folded maps lead a few to another ray."""
    try:
        reference = card["reference"]
        passed = np.asarray(reference["status"]) == st.PASSED
        rays = np.asarray(reference["rays"], np.float64)[:, passed]
        call = (rays[4], float(reference["film_z_mm"][0]), float(reference["stop_radius_mm"]))
        if name == "stop":
            found = inverse.through_stop(rays[:2], np.asarray(reference["stop_xy_mm"])[:, passed], *call)
        else:
            scene = np.asarray(reference["scene_ray"], np.float64)[:, passed]
            found = inverse.from_scene(scene[:3], scene[3:], *call)
    except (InputError, KeyError, TypeError, ValueError, IndexError) as error:
        raise ModelError(f"{inverse.path}: {name}: card: reference: {type(error).__name__}: {error}") from error
    off = np.abs(found.rays[:4] - rays[:4]).max(0)
    back = (off < 1e-3 * float(card["domain"]["pupil_radius_mm"])) & (found.status == st.PASSED)
    if not (back.size and back.mean() >= 0.9):
        raise ModelError(f"{inverse.path}: {name} map: {int(back.sum())} of {back.size} reference rays come back")
