"""`neurolens projection CAMERA --projection NAME`: a lens as the projections of vision and splatting programs."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from neurolens import __version__
from neurolens.base.errors import warn
from neurolens.base.files import atomic_write_text
from neurolens.base.records import plain
from neurolens.base.settings import setting
from neurolens.cli.arguments import CAMERAS_HELP, check_folder, output_path
from neurolens.cli.output import number, table
from neurolens.cli.stmap import LIGHT_NM, PictureCommand

if TYPE_CHECKING:
    from neurolens.analysis import projections
    from neurolens.cameras.field import Field

_FITTED, _HELD_OUT = (61, 41), (50, 34)  # points over the film


@dataclass(frozen=True, kw_only=True)
class Projection(PictureCommand):
    """Fit a lens (or model, or any other camera) with a projection of other programs, and say what it leaves in
    pixels:

      opencv            fx fy cx cy, k1 k2 p1 p2 k3      opencv-rational   and k4 k5 k6
      kannala-brandt    OpenCV's fisheye, k1 k2 k3 k4    f-theta           NVIDIA's polynomials, both ways

    Directions are those of the light's centroid at this stop, from the lens's entrance pupil to what is in focus. With
    -o NAME: NAME.yaml for OpenCV's FileStorage, NAME.json for nerfstudio (its camera block; cx, cy from the corner of
    the first pixel, OpenCV's from its centre), NVIDIA's names for f-theta. A projection that turns back within the
    field is said, and an error of a planar one beyond 85 degrees. Needs the extra "train" (scipy)."""

    about: ClassVar[str] = "fit a lens with a projection of OpenCV, nerfstudio or NVIDIA"
    epilog: ClassVar[str] = f"""{CAMERAS_HELP}

examples:
  neurolens projection laikin_double_gauss_50 --width 1920 --film 36x20.25 --projection opencv -o gauss
  neurolens projection models/NAME.onnx --width 1920 --film 36x24 --projection f-theta --focus 2 -o fisheye"""

    projection: Literal["opencv", "opencv-rational", "kannala-brandt", "f-theta"] = setting(
        ..., "the projection to fit", old=("model",)
    )
    out: Path | None = output_path("NAME", "write NAME.json and, for OpenCV's, NAME.yaml", None)

    def run(self) -> int:
        """Trace, fit, write."""
        out = self.out
        if out is not None:
            check_folder(out, "--output")
            if not out.name:
                self.refuse("--output", str(out), "a name")
            if out.suffix in (".json", ".yaml"):  # the name of a file that will be written
                out = out.with_suffix("")
        from neurolens.cameras.field import field_of, spectrum_of

        progress = self.progress()
        camera, shot = self.make(self.state, progress)
        with progress.stage(f"trace the field of {self.camera}"):
            field = field_of(camera, shot.focus_m, "equidistant", spectrum=spectrum_of(camera, LIGHT_NM))
        with progress.stage(f"fit {self.projection}"):
            fitted, left, data = fitted_to(self.projection, field, self.picture, self.film, str(self.camera))
        data["files"] = write_projection(out, fitted, data) if out is not None else []
        if not left.sound:
            told = f"turns back at {left.fold_deg:.4g} degrees; the picture goes to {left.field_deg:.4g}"
            warn(f"{self.projection} {told}")
        return self.answer(data, lambda: _text(data, left))


def fitted_to(
    kind: str, field: Field, size: tuple[int, int], film_mm: tuple[float, float], source: str
) -> tuple[projections.Projection, projections.Residual, dict[str, Any]]:
    """A projection fitted to a field, what it leaves, and both as data; raises InputError as `fit`."""
    from neurolens.analysis.projections import fit, residual

    step = [side / count for side, count in zip(film_mm, size, strict=True)]
    focal = (field.frame.reach_mm[0] / step[0], field.frame.reach_mm[1] / step[1])
    if math.isclose(*field.frame.reach_mm, rel_tol=1e-9) and math.isclose(*step, rel_tol=1e-9):
        focal = focal[0], focal[0]
    fitted = fit(kind, *shown(field, size, film_mm), size, focal, source)
    left = residual(fitted, *shown(field, size, film_mm, _HELD_OUT))
    rows = [dict(zip(("from_deg", "to_deg", "rms_px", "worst_px"), row, strict=True)) for row in left.by_field]
    data: dict[str, Any] = {
        "camera": source,
        "model": fitted.kind,
        "size": list(fitted.size),
        "focal_px": list(fitted.focal_px),
        "centre_px": list(fitted.centre_px),
        "coefficients": fitted.named,
        "rms_px": left.rms_px,
        "worst_px": left.worst_px,
        "worst_at_deg": left.worst_at_deg,
        "field_deg": left.field_deg,
        "turns_back_at_deg": None if left.sound else left.fold_deg,
        "by_field": rows,
        "before_film_mm": list(field.frame.pupil_mm),
    }
    return fitted, left, data


def shown(
    field: Field, size: tuple[int, int], film_mm: tuple[float, float], points: tuple[int, int] = _FITTED
) -> tuple[Any, Any]:
    """Unit directions [N, 3] and pixels [N, 2], in OpenCV's frame, of points spread over the lit picture."""
    import numpy as np

    across, up = (np.linspace(-0.5, 0.5, n) for n in points)
    x, y = (v.reshape(-1) for v in np.meshgrid(across, up))
    point = x * film_mm[0] + 1j * (y * film_mm[1])
    lit = field.lit(point)
    pixel = np.stack([(x + 0.5) * size[0] - 0.5, (0.5 - y) * size[1] - 0.5], 1)
    return field.directions(point[lit]).T * [1, -1, 1], pixel[lit]


def write_projection(out: Path, fitted: projections.Projection, data: dict[str, Any]) -> list[str]:
    """Write the files of a projection; their names."""
    files = {}
    if fitted.kind in ("opencv", "opencv-rational", "kannala-brandt"):
        files[out.with_name(f"{out.name}.yaml")] = _file_storage(fitted, data["rms_px"])
    block = _block(fitted) | {"neurolens": {"version": __version__, **data}}
    files[out.with_name(f"{out.name}.json")] = json.dumps(plain(block), indent=1, allow_nan=False) + "\n"
    for path, text in files.items():
        atomic_write_text(path, text)
    return [str(path) for path in files]


def _file_storage(fitted: projections.Projection, rms_px: float) -> str:
    """YAML as OpenCV's FileStorage reads it, with the names of its own calibration sample."""

    def matrix(name: str, rows: list[list[float]]) -> str:
        values = ", ".join(repr(float(v)) for row in rows for v in row)
        shape = f"   rows: {len(rows)}\n   cols: {len(rows[0])}\n   dt: d\n"
        return f"{name}: !!opencv-matrix\n{shape}   data: [ {values} ]\n"

    (fx, fy), (cx, cy) = fitted.focal_px, fitted.centre_px
    return (
        f"%YAML:1.0\n---\nimage_width: {fitted.size[0]}\nimage_height: {fitted.size[1]}\n"
        f'distortion_model: "{fitted.kind}"\nfisheye_model: {int(fitted.kind == "kannala-brandt")}\n'
        + matrix("camera_matrix", [[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        + matrix("distortion_coefficients", [[v] for v in fitted.coefficients])
        + f"avg_reprojection_error: {rms_px!r}\n"
    )


def _block(fitted: projections.Projection) -> dict[str, Any]:
    """The camera as nerfstudio, or NVIDIA's f-theta, or OpenCV has it."""
    size = {"w": fitted.size[0], "h": fitted.size[1]}
    if fitted.kind in ("opencv", "kannala-brandt"):
        cx, cy = (c + 0.5 for c in fitted.centre_px)
        name = "OPENCV" if fitted.kind == "opencv" else "OPENCV_FISHEYE"
        focal = {"fl_x": fitted.focal_px[0], "fl_y": fitted.focal_px[1], "cx": cx, "cy": cy}
        return {"camera_model": name, **size, **focal, **fitted.named, "frames": []}
    if fitted.kind == "f-theta":
        from neurolens.analysis.projections import inverse_polynomial

        return {
            "resolution": list(fitted.size),
            "shutter_type": "GLOBAL",
            "principal_point": list(fitted.centre_px),
            "reference_poly": "ANGLE_TO_PIXELDIST",
            "angle_to_pixeldist_poly": [0.0, *fitted.coefficients],
            "pixeldist_to_angle_poly": [0.0, *inverse_polynomial(fitted)],
            "max_angle": fitted.widest_rad,
            "linear_cde": [fitted.focal_px[0], 0.0, 0.0],
        }
    return {"camera_model": fitted.kind, **size, "focal_px": list(fitted.focal_px), **fitted.named}


def _text(data: dict[str, Any], left: projections.Residual) -> str:
    numbers = ", ".join(f"{k} {number(v, 6)}" for k, v in data["coefficients"].items())
    focal, centre = (" x ".join(number(v, 7) for v in data[k]) for k in ("focal_px", "centre_px"))
    radii = f"scale {focal}" if data["model"] == "f-theta" else f"focal length {focal}"
    lines = [
        f"{data['camera']}, {data['model']}: {radii}, centre {centre} pixels",
        numbers,
        f"leaves {left.rms_px:.3g} pixels RMS, at most {left.worst_px:.3g} (at {left.worst_at_deg:.3g} degrees)",
        table(
            ("field, degrees", "RMS px", "worst px"),
            [(f"{a:.3g} to {b:.3g}", f"{rms:.3g}", f"{most:.3g}") for a, b, rms, most in left.by_field],
        ),
    ]
    if data["model"] == "kannala-brandt" and left.field_deg >= 90:
        lines.append("OpenCV's own functions end at 90 degrees, for they divide by z")
    return "\n".join([*lines, *data["files"]])
