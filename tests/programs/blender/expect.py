"""What Blender must show, by neurolens's exact lenses: python tests/programs/blender/expect.py FOLDER.

Blender's Python cannot run neurolens. This writes shots.json, numbers for test_optics.py, the shaders named there, and
maps of `neurolens stmap`, and a lens handed over by `neurolens handover`.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from measure import crop_at, measures

from neurolens.base.progress import Progress
from neurolens.cameras.build import make_camera
from neurolens.cameras.contract import Camera
from neurolens.cameras.sampling import stratified
from neurolens.cli import main as command_line
from neurolens.cli.blender import form_of
from neurolens.optics.lens.shot import Shot

_SIDE = 512  # rays of a point: this squared
_LIGHT_NM = (400.0, 700.0)
_CARD = (16, 9)  # parts of a white card
_CARD_SIDE = 96
_SPHERE_PX = 2.5  # radius of the picture of a point of light in focus
_EDGE_PX = 6


@dataclass(frozen=True)
class Lens:
    """A lens by its exact file, the file from which its shader is written, and tilt and swing of its film (degrees)."""

    name: str
    exact: str
    shader: str
    film_mm: tuple[float, float]
    tilt: float = 0.0
    swing: float = 0.0

    def camera(self, focus_m: float, f_number: float, zoom_mm: float | None = None) -> Camera:
        """The exact one."""
        how: Literal["best", "internal"] = "internal" if self.name == "inside" else "best"
        shot = Shot(self.film_mm, focus_m, f_number, film_tilt_deg=self.tilt, film_swing_deg=self.swing)
        return make_camera(self.exact, replace(shot, zoom=zoom_mm, focus_mode=how))


_GAUSS = "lenses/laikin_double_gauss_50.toml"
_ZOOM = "models/nikon_zoom_80_200-range.states-64.onnx"
LENSES = {
    lens.name: lens
    for lens in (
        Lens("rectilinear", _GAUSS, "models/laikin_double_gauss_50.ols-60.onnx", (36.0, 20.25)),
        Lens("turned", _GAUSS, "models/laikin_double_gauss_50.ols-60.onnx", (36.0, 20.25), 8.0, -5.0),
        Lens("fisheye", "lenses/horimoto_fisheye_16.toml", "models/horimoto_fisheye_16.mlp-16x2.onnx", (36.0, 24.0)),
        Lens("anamorphic", "lenses/cooke_anamorphic_42.toml", "models/cooke_anamorphic_42.mlp-16x2.onnx", (23.0, 13.0)),
        Lens("exact", _GAUSS, _GAUSS, (36.0, 20.25)),
        Lens("zoom", "lenses/nikon_zoom_80_200.toml", _ZOOM, (36.0, 20.25)),
        Lens("inside", "lenses/sony_sonnar_55.toml", "lenses/sony_sonnar_55.toml", (36.0, 20.25)),
    )
}


def colours(wavelength_nm: Any) -> Any:
    """Weights [3, N] of a ray in R, G and B, as the shaders have them: Bernstein's polynomials, red from 700 nm."""
    t = (_LIGHT_NM[1] - wavelength_nm) / (_LIGHT_NM[1] - _LIGHT_NM[0])
    return np.stack([3 * (1 - t) ** 2, 6 * t * (1 - t), 3 * t * t])


@dataclass(frozen=True)
class Picture:
    """A lens, its setting, and the width of the picture in pixels."""

    lens: Lens
    width: int
    focus_m: float
    f_number: float

    @property
    def height(self) -> int:
        return round(self.width * self.lens.film_mm[1] / self.lens.film_mm[0])

    @property
    def pitch_mm(self) -> float:
        return self.lens.film_mm[0] / self.width

    def settings(self) -> dict[str, Any]:
        return {
            "lens": self.lens.name,
            "film_mm": self.lens.film_mm,
            "width": self.width,
            "height": self.height,
            "custom": {
                "f_number": self.f_number, "focus_m": self.focus_m, "origin": 0, "tilt": self.lens.tilt,
                "swing": self.lens.swing,
            },
        }  # fmt: skip


def scene_point(made: Camera, film_mm: Sequence[float], away_m: float) -> Any:
    """The point [3], metres in the camera's frame, that many metres from the film's centre on the mean ray."""
    square, _ = stratified(32, (550.0, 550.0))
    film = np.repeat(np.array(film_mm, np.float32)[:, None], square.shape[1], axis=1)
    rays = made.sample(film, square, np.full(square.shape[1], 550.0, np.float32))
    passed = rays.status == 0
    start, way = (v[:, passed].astype(float).mean(1) for v in (rays.origin_m, rays.direction))
    way /= np.linalg.norm(way)
    along = start @ way
    return start + (-along + math.sqrt(along**2 + away_m**2 - start @ start)) * way


def point_shot(name: str, picture: Picture, made: Camera, point_m: Any, radius_m: float) -> dict[str, Any]:
    """A sphere of light, the crop that it fills and its measures there."""
    square, wavelength = stratified(_SIDE, _LIGHT_NM)
    rng = np.random.default_rng(3)
    turn, reach = 2 * np.pi * rng.random(square.shape[1]), radius_m * np.sqrt(rng.random(square.shape[1]))
    way = point_m / np.linalg.norm(point_m)
    across = np.cross(way, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    points = point_m[:, None] + reach * (np.cos(turn) * across[:, None] + np.sin(turn) * np.cross(way, across)[:, None])
    found = made.to_film(points.astype(np.float32), square, wavelength)
    lit = found.weight > 0
    place = np.array([[picture.width / 2], [picture.height / 2]]) - found.film_mm[:, lit] / picture.pitch_mm
    weight, wavelength = found.weight[lit].astype(float), wavelength[lit]
    middle = (place.min(1) + place.max(1)) / 2
    crop = crop_at((float(middle[0]), float(middle[1])), math.ceil(float(np.ptp(place, axis=1).max()) / 2) + _EDGE_PX)
    edges = np.arange(crop[1], crop[3] + 1), np.arange(crop[0], crop[2] + 1)
    planes = [np.histogram2d(place[1], place[0], edges, weights=weight * c)[0] for c in colours(wavelength)]
    shot = {"name": name, **picture.settings(), "point_m": list(map(float, point_m)), "radius_m": radius_m}
    return shot | {"crop": crop, "found": measures(np.stack(planes, 2), crop[:2])}


def grid(lens: Lens, zoom_mm: float | None = None, focus_m: float = 2.0) -> list[dict[str, Any]]:
    """Points all over the picture, at f/8 and in focus."""
    picture = Picture(lens, 1920, focus_m, 8.0)
    made = lens.camera(focus_m, 8.0, zoom_mm)
    efl = float(made.settings["efl_mm"])
    found = []
    for v in (-0.46, 0.0, 0.25):
        for u in (-0.47, 0.0, 0.3):
            film = (u * lens.film_mm[0], v * lens.film_mm[1])
            radius = _SPHERE_PX * picture.pitch_mm * focus_m / efl
            shot = point_shot("grid", picture, made, scene_point(made, film, focus_m), radius)
            shot["custom"] |= {} if zoom_mm is None else {"zoom_mm": zoom_mm}
            found.append(shot)
    return found


def bokeh(lens: Lens) -> list[dict[str, Any]]:
    """Discs of a light before the focus, on the axis from f/1.8 to f/11 and off it."""
    found = []
    for f_number in (1.83, 2.8, 4.0, 5.6, 8.0, 11.0):
        picture = Picture(lens, 7680, 3.0, f_number)
        made = lens.camera(3.0, f_number)
        places = [("stop", (0.0, 0.0))]
        if f_number == 1.83:
            places += [("off axis", (9.0, 4.0)), ("off axis", (-16.0, -8.0)), ("off axis", (0.0, 9.0))]
        for name, film in places:
            found.append(point_shot(name, picture, made, scene_point(made, film, 1.2), 2e-3 / f_number))
    return found


def pull(lens: Lens) -> list[dict[str, Any]]:
    """Ten frames, focused from 1 to 4 m, of a light at 2 m."""
    found = []
    for frame in range(1, 11):
        focus = 1.0 + (frame - 1) / 3
        picture = Picture(lens, 1920, focus, 2.0)
        made = lens.camera(focus, 2.0)
        found.append(point_shot("pull", picture, made, scene_point(made, (0.0, 0.0), 2.0), 5e-4) | {"frame": frame})
    return found


def white_card(lens: Lens, f_number: float) -> dict[str, Any]:
    """Film values of white surroundings in parts of the picture, 1 on the axis."""
    made = lens.camera(5.0, f_number)
    columns, rows = _CARD
    wide, high = lens.film_mm[0], lens.film_mm[0] * rows / columns
    square, wavelength = stratified(_CARD_SIDE, _LIGHT_NM)
    inside = np.random.default_rng(5).random(square.shape)
    values = np.zeros((rows, columns))
    for row in range(rows):
        for column in range(columns):
            u, v = (column + inside[0]) / columns, (row + inside[1]) / rows
            film = np.stack([(0.5 - u) * wide, (0.5 - v) * high]).astype(np.float32)
            values[row, column] = made.sample(film, square, wavelength).weight.mean(dtype=np.float64)
    picture = Picture(lens, 64, 5.0, f_number)
    return {"name": "card", **picture.settings(), "height": 36, "found": values.tolist()}


def main(folder: Path) -> None:
    """Write all."""
    folder.mkdir(parents=True, exist_ok=True)
    progress = Progress()
    for lens in LENSES.values():
        with progress.stage(f"shader of {lens.shader}") as report:
            (folder / f"{lens.name}.osl").write_text(form_of(Path(lens.shader), quiet=True).osl, encoding="utf-8")
    shots = []
    with progress.stage("what exact lenses show") as report:
        for number, (make, name) in enumerate(
            [
                (grid, "rectilinear"),
                (grid, "turned"),
                (grid, "fisheye"),
                (grid, "anamorphic"),
                (bokeh, "rectilinear"),
                (pull, "rectilinear"),
            ]
        ):
            shots += make(LENSES[name])
            report((number + 1) / 9)
        for zoom_mm in (96.0, 170.0):
            shots += grid(LENSES["zoom"], zoom_mm, 4.0)
        shots += grid(LENSES["inside"])
        shots += [white_card(LENSES[name], 1.83) for name in ("rectilinear", "turned")]
        shots += [white_card(LENSES["anamorphic"], 2.8)]
        shots += [white_card(LENSES["fisheye"], 2.8)]
    command_line(["stmap", _GAUSS, "--width", "120", "--film", "36x20.4", "-o", str(folder / "maps"), "--quiet"])
    handed = ["handover", _GAUSS, "--width", "120", "--film", "36x20.4", "--focus", "2", "--f-number", "4", "--quiet"]
    command_line([*handed, "--lateral-colour", "-o", str(folder / "handed")])
    (folder / "shots.json").write_text(json.dumps(shots, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
