"""The cameras that `neurolens bench equal-time` compares, set as a scene asks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from neurolens.cameras.build import FUSED, Shot, make_camera
from neurolens.cameras.contract import Camera
from neurolens.cameras.exact import ExactCamera, FusedExactCamera
from neurolens.cameras.onnxlens import load_model
from neurolens.optics.lensfile import read_lens
from neurolens.optics.paraxial import first_order
from neurolens.render.scene import CameraSettings
from neurolens.surrogates.domain import Domain

EXACT, THIN = "exact", "thin lens"
LENS = "laikin_double_gauss_50"
# Name in the tables to the file in models/; those named fused run as compiled C (`cameras.fused`).
MODELS = {"ols-28": f"{LENS}.ols-28.onnx", "mlp-16x2": f"{LENS}.mlp-16x2.onnx"}
MODELS["fused mlp-16x2"] = MODELS["mlp-16x2"]
FUSED_EXACT = "fused exact"
EXACTS = (EXACT, FUSED_EXACT)


def scene_cameras(root: Path, shot: CameraSettings) -> tuple[dict[str, Camera], ExactCamera]:
    """The cameras of a scene by name, the exact one first, and the exact one in float64 for film-space errors.

    All of the lens share the pupil bounds of the models' domain, so that the same random numbers are the same rays.
    """
    lens = read_lens(root / "lenses" / f"{LENS}.toml")
    data = first_order(lens)
    widest = shot.f_number is None or shot.f_number < data.f_number
    f_number = data.f_number if widest else float(shot.f_number or 0)
    card = load_model(root / "models" / next(iter(MODELS.values()))).card
    bounds = Domain.from_dict(card["domain"]).bounds
    film = (shot.film_width_mm, shot.film_height_mm)
    set_ = Shot(film, shot.focus_m, None if widest else f_number, wavelength_nm=shot.wavelengths_nm)

    same: dict[str, Any] = {
        "film_mm": film,
        "focus_m": shot.focus_m,
        "f_number": set_.f_number,
        "wavelength_nm": shot.wavelengths_nm,
        "bounds": bounds,
    }
    cameras: dict[str, Camera] = {EXACT: ExactCamera(lens, **same)}
    for name, model in MODELS.items():
        spec = str(root / "models" / model)
        cameras[name] = make_camera(FUSED + spec if name.startswith("fused") else spec, set_)
    cameras[FUSED_EXACT] = FusedExactCamera(lens, **same)
    cameras[THIN] = make_camera("thin", replace(set_, efl_mm=data.efl_mm, f_number=f_number))
    return cameras, ExactCamera(lens, dtype="float64", **same)
