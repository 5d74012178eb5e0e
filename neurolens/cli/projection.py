"""`neurolens projection CAMERA --projection NAME`: a lens as the projections of vision and splatting programs."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens import __version__
from neurolens.base.errors import InputError, warn
from neurolens.base.files import atomic_write_text
from neurolens.base.progress import Progress
from neurolens.base.records import plain
from neurolens.cli.arguments import CAMERAS_HELP, add_json, add_lens_state, add_option, add_output, check_folder
from neurolens.cli.output import answer, number, table
from neurolens.cli.stmap import LIGHT_NM, add_picture, picture_shot, size_of

if TYPE_CHECKING:
    from neurolens.analysis.projections import Projection, Residual

# Repeated here, so that help imports no torch; a test compares with `analysis.projections`.
MODELS = ("opencv", "opencv-rational", "kannala-brandt", "f-theta", "table", "two-axis")
_FITTED, _HELD_OUT = (61, 41), (50, 34)  # points over the film
_DESCRIPTION = """\
Fit a lens (or model, or any other camera) with a projection of other programs, and say what it leaves in
pixels:

  opencv            fx fy cx cy, k1 k2 p1 p2 k3      opencv-rational   and k4 k5 k6
  kannala-brandt    OpenCV's fisheye, k1 k2 k3 k4    f-theta           NVIDIA's polynomials, both ways
  table             radius over angle                two-axis          of lenses with cylinders: a polynomial an axis

Directions are those of the light's centroid at this stop, from the lens's entrance pupil to what is in focus. With
-o NAME: NAME.yaml for OpenCV's FileStorage, NAME.json for nerfstudio (its camera block; cx, cy from the corner of
the first pixel, OpenCV's from its centre), NVIDIA's names for f-theta. A projection that turns back within the
field is said, and an error of a planar one beyond 85 degrees. Needs the extra "train" (torch)."""
_EPILOG = """\
examples:
  neurolens projection laikin_double_gauss_50 --width 1920 --film 36x20.25 --projection opencv -o gauss
  neurolens projection models/NAME.onnx --width 1920 --film 36x24 --projection f-theta --focus 2 -o fisheye"""


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "projection", help="fit a lens with a projection of OpenCV, nerfstudio or NVIDIA",
        description=_DESCRIPTION, epilog=f"{CAMERAS_HELP}\n\n{_EPILOG}",
    )  # fmt: skip
    add_picture(parser)
    add_option(parser, "--projection", old=("--model",), choices=MODELS, required=True, help="the projection to fit")
    add_output(parser, "NAME", "write NAME.json and, for OpenCV's, NAME.yaml")
    add_lens_state(parser)
    add_json(parser, quiet=True)
    parser.set_defaults(run=run, kept="files that were written are whole")


def run(args: argparse.Namespace) -> int:
    """Trace, fit, write."""
    if args.out is not None:
        check_folder(args.out, "--output")
        if not args.out.name:
            raise InputError("neurolens projection", "--output", str(args.out), "a name")
        if args.out.suffix in (".json", ".yaml"):  # the name of a file that will be written
            args.out = args.out.with_suffix("")
    from neurolens.analysis.projections import fit, residual
    from neurolens.cameras.build import make_camera
    from neurolens.cameras.field import field_of, spectrum_of

    shot, progress = picture_shot(args), Progress(quiet=args.quiet)
    camera = make_camera(args.camera, shot, progress)
    for note in camera.settings.get("notes", ()):
        warn(note)
    with progress.stage(f"trace the field of {args.camera}"):
        field = field_of(camera, shot.focus_m, "equidistant", spectrum=spectrum_of(camera, LIGHT_NM))
    size = size_of(args)
    step = [side / count for side, count in zip(args.film, size, strict=True)]
    focal = (field.frame.reach_mm[0] / step[0], field.frame.reach_mm[1] / step[1])
    if math.isclose(*field.frame.reach_mm, rel_tol=1e-9) and math.isclose(*step, rel_tol=1e-9):
        focal = focal[0], focal[0]
    with progress.stage(f"fit {args.projection}"):
        found = fit(args.projection, *shown(field, size, args.film), size, focal, source=str(args.camera))
        left = residual(found, *shown(field, size, args.film, _HELD_OUT))
    data = _told(args, found, left) | {"before_film_mm": list(field.frame.pupil_mm)}
    data["files"] = _write(args.out, found, data) if args.out is not None else []
    if not left.sound:
        warn(f"{args.projection} turns back at {left.fold_deg:.4g} degrees; the picture goes to {left.field_deg:.4g}")
    return answer(args, data, lambda: _text(data, left))


def shown(
    field: Any, size: tuple[int, int], film_mm: tuple[float, float], points: tuple[int, int] = _FITTED
) -> tuple[Any, Any]:
    """Unit directions [N, 3] and pixels [N, 2], in OpenCV's frame, of points spread over the lit picture."""
    import numpy as np

    across, up = (np.linspace(-0.5, 0.5, n) for n in points)
    x, y = (v.reshape(-1) for v in np.meshgrid(across, up))
    point = x * film_mm[0] + 1j * (y * film_mm[1])
    lit = field.lit(point)
    pixel = np.stack([(x + 0.5) * size[0] - 0.5, (0.5 - y) * size[1] - 0.5], 1)
    return field.directions(point[lit]).T * [1, -1, 1], pixel[lit]


def _told(args: argparse.Namespace, found: Projection, left: Residual) -> dict[str, Any]:
    """What --json tells."""
    rows = [dict(zip(("from_deg", "to_deg", "rms_px", "worst_px"), row, strict=True)) for row in left.by_field]
    return {
        "camera": str(args.camera),
        "model": found.kind,
        "size": list(found.size),
        "focal_px": list(found.focal_px),
        "centre_px": list(found.centre_px),
        "coefficients": found.named,
        "rms_px": left.rms_px,
        "worst_px": left.worst_px,
        "worst_at_deg": left.worst_at_deg,
        "field_deg": left.field_deg,
        "turns_back_at_deg": None if left.sound else left.fold_deg,
        "by_field": rows,
    }


def _write(out: Path, found: Projection, data: dict[str, Any]) -> list[str]:
    """Write the files of a projection; their names."""
    files = {}
    if found.kind in ("opencv", "opencv-rational", "kannala-brandt"):
        files[out.with_name(f"{out.name}.yaml")] = _file_storage(found, data["rms_px"])
    block = _block(found) | {"neurolens": {"version": __version__, **data}}
    files[out.with_name(f"{out.name}.json")] = json.dumps(plain(block), indent=1, allow_nan=False) + "\n"
    for path, text in files.items():
        atomic_write_text(path, text)
    return [str(path) for path in files]


def _file_storage(found: Projection, rms_px: float) -> str:
    """YAML as OpenCV's FileStorage reads it, with the names of its own calibration sample."""

    def matrix(name: str, rows: list[list[float]]) -> str:
        values = ", ".join(repr(float(v)) for row in rows for v in row)
        shape = f"   rows: {len(rows)}\n   cols: {len(rows[0])}\n   dt: d\n"
        return f"{name}: !!opencv-matrix\n{shape}   data: [ {values} ]\n"

    (fx, fy), (cx, cy) = found.focal_px, found.centre_px
    return (
        f"%YAML:1.0\n---\nimage_width: {found.size[0]}\nimage_height: {found.size[1]}\n"
        f'distortion_model: "{found.kind}"\nfisheye_model: {int(found.kind == "kannala-brandt")}\n'
        + matrix("camera_matrix", [[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        + matrix("distortion_coefficients", [[v] for v in found.coefficients])
        + f"avg_reprojection_error: {rms_px!r}\n"
    )


def _block(found: Projection) -> dict[str, Any]:
    """The camera as nerfstudio, or NVIDIA's f-theta, or nobody but us has it."""
    size = {"w": found.size[0], "h": found.size[1]}
    if found.kind in ("opencv", "kannala-brandt"):
        cx, cy = (c + 0.5 for c in found.centre_px)
        name = "OPENCV" if found.kind == "opencv" else "OPENCV_FISHEYE"
        focal = {"fl_x": found.focal_px[0], "fl_y": found.focal_px[1], "cx": cx, "cy": cy}
        return {"camera_model": name, **size, **focal, **found.named, "frames": []}
    if found.kind == "f-theta":
        from neurolens.analysis.projections import inverse_polynomial

        return {
            "resolution": list(found.size),
            "shutter_type": "GLOBAL",
            "principal_point": list(found.centre_px),
            "reference_poly": "ANGLE_TO_PIXELDIST",
            "angle_to_pixeldist_poly": [0.0, *found.coefficients],
            "pixeldist_to_angle_poly": [0.0, *inverse_polynomial(found)],
            "max_angle": found.widest_rad,
            "linear_cde": [found.focal_px[0], 0.0, 0.0],
        }
    if found.kind == "table":
        steps = len(found.coefficients) - 1
        angle = [math.degrees(found.widest_rad) * k / steps for k in range(steps + 1)]
        return {**size, "angle_deg": angle, "radius_px": list(found.coefficients)}
    return {"camera_model": found.kind, **size, "focal_px": list(found.focal_px), **found.named}


def _text(data: dict[str, Any], left: Residual) -> str:
    numbers = ", ".join(f"{k} {number(v, 6)}" for k, v in data["coefficients"].items())
    focal, centre = (" x ".join(number(v, 7) for v in data[k]) for k in ("focal_px", "centre_px"))
    radii = f"scale {focal}" if data["model"] in ("f-theta", "table") else f"focal length {focal}"
    lines = [
        f"{data['camera']}, {data['model']}: {radii}, centre {centre} pixels",
        *([numbers] if numbers else []),
        f"leaves {left.rms_px:.3g} pixels RMS, at most {left.worst_px:.3g} (at {left.worst_at_deg:.3g} degrees)",
        table(
            ("field, degrees", "RMS px", "worst px"),
            [(f"{a:.3g} to {b:.3g}", f"{rms:.3g}", f"{most:.3g}") for a, b, rms, most in left.by_field],
        ),
    ]
    if data["model"] == "kannala-brandt" and left.field_deg >= 90:
        lines.append("OpenCV's own functions end at 90 degrees, for they divide by z")
    return "\n".join([*lines, *data["files"]])
