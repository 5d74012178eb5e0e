"""Mitsuba's own Cornell box as a scene of our renderer, on which the two are compared."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.pictures.render.colour import table
from neurolens.pictures.render.scene import Scene, scene_from_tables
from neurolens.programs.mitsuba.sensor import matrix

_SKIPPED = ("type", "integrator", "sensor")
# Centres and edges of faces from -1 to 1; edge_u x edge_v is the outward normal.
_RECTANGLE = [(np.zeros(3), np.array([2.0, 0, 0]), np.array([0, 2.0, 0]))]
_CUBE = [
    (sign * np.roll([1.0, 0, 0], axis), np.roll([0, 2.0, 0], axis), np.roll([0, 0, 2.0 * sign], axis))
    for axis in range(3)
    for sign in (1, -1)
]


def our_scene(
    description: Mapping[str, Any], film_mm: tuple[float, float], *, back_m: float = 0.0, triangles: bool = False
) -> Scene:
    """The dictionary mi.cornell_box() as a scene of ours: the same geometry, colours and depth.

    Args:
        description: rectangles, cubes, diffuse colours and area lights; a scene unit is a metre.
        back_m: how far behind the place of Mitsuba's sensor the film stands. Its own pinhole and thin lens stand at
            that place themselves, one image distance in front of the film.
        triangles: a mesh for each material instead of rectangles; lights stay rectangles.
    """
    named = {k: v for k, v in description.items() if k not in _SKIPPED}
    materials = {k: v for k, v in named.items() if v["type"] == "diffuse"}
    quads = [quad for name, item in named.items() if name not in materials for quad in _quads(item)]
    flat = [q for q in quads if not triangles or "emission" in q]
    meshed = [q for q in quads if q not in flat]
    tables = {
        "camera": _camera(description, film_mm, back_m),
        "materials": {k: {"kind": "diffuse", "reflectance": _rgb(v["reflectance"])} for k, v in materials.items()},
        "quads": flat,
        "meshes": [_mesh(k, [q for q in meshed if q["material"] == k]) for k in materials if triangles],
    }
    return scene_from_tables(tables, "mitsuba scene")


def _camera(description: Mapping[str, Any], film_mm: tuple[float, float], back_m: float) -> dict[str, Any]:
    """The camera table from Mitsuba's sensor, film and integrator."""
    sensor = description["sensor"]
    at, film, depth = matrix(sensor["to_world"]), sensor["film"], description["integrator"].get("max_depth", -1)
    position = at[:3, 3] - back_m * at[:3, 2]
    return {
        "position_m": position.tolist(),
        "look_at_m": (position + at[:3, 2]).tolist(),
        "up": at[:3, 1].tolist(),
        "focus_m": float("inf"),
        "film_width_mm": film_mm[0],
        "film_height_mm": film_mm[1],
        "width": film["width"],
        "height": film["height"],
        # Mitsuba counts the segments of a path, we count the surfaces between them; -1 is no limit there.
        "max_depth": depth - 1 if depth > 1 else 1000,
    }


def _quads(item: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A rectangle, or the faces of a cube, as tables of our quads."""
    place = matrix(item["to_world"])
    shared = {"material": item["bsdf"]["id"]}
    if "emitter" in item:
        shared["emission"] = _rgb(item["emitter"]["radiance"])
    quads = []
    for centre, u, v in _CUBE if item["type"] == "cube" else _RECTANGLE:
        corner = place[:3, :3] @ (centre - (u + v) / 2) + place[:3, 3]
        quad = {"corner_m": corner, "edge_u_m": place[:3, :3] @ u}
        # Rotations that Mitsuba stores as float32 leave errors of 1e-8, which would misalign walls with the axes.
        quad = {k: x.round(6).tolist() for k, x in {**quad, "edge_v_m": place[:3, :3] @ v}.items()}
        quads.append(quad | shared)
    return quads


def _mesh(material: str, quads: list[dict[str, Any]]) -> dict[str, Any]:
    """Two triangles for each rectangle."""
    vertices: list[Any] = []
    for quad in quads:
        corner, u, v = (np.array(quad[k]) for k in ("corner_m", "edge_u_m", "edge_v_m"))
        vertices += [x.tolist() for x in (corner, corner + u, corner + u + v, corner + v)]
    faces = [[k + a, k + b, k + c] for k in range(0, len(vertices), 4) for a, b, c in ((0, 1, 2), (0, 2, 3))]
    return {"material": material, "vertices_m": vertices, "faces": faces}


def _rgb(colour: Mapping[str, Any]) -> list[float]:
    return [float(x) for x in np.broadcast_to(np.asarray(colour["value"], np.float64), 3)]


def with_our_spectra(description: Mapping[str, Any]) -> dict[str, Any]:
    """The dictionary with every RGB colour as the spectrum that our renderer makes of it, for spectral variants.

    Mitsuba turns RGB into other spectra of the same colour (Jakob and Hanika 2019), which differ once light has met two
    coloured surfaces. Reflectances are sums of Mallett and Yuksel's basis, lights the same times D65 of luminance 1.
    """

    def replaced(item: Any, light: bool) -> Any:
        if not isinstance(item, Mapping):
            return item
        if item.get("type") == "rgb":
            return _spectrum(np.asarray(_rgb(item)), light)
        return {k: replaced(v, light or k in ("radiance", "emitter")) for k, v in item.items()}

    return {k: replaced(v, False) for k, v in description.items()}


def _spectrum(rgb: NDArray[np.float64], light: bool) -> dict[str, Any]:
    basis = np.stack([table(name) for name in ("red", "green", "blue")])
    values = rgb @ (basis / basis.sum(axis=0))
    if light:
        values = values * table("d65") * (table("y").sum() / (table("y") * table("d65")).sum())
    nm = table("wavelength_nm")
    text = ", ".join(f"{v:.7g}" for v in values)
    return {"type": "regular", "wavelength_min": float(nm[0]), "wavelength_max": float(nm[-1]), "values": text}
