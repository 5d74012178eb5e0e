"""What races on the clock (`speed`): the exact tracer eager and compiled, exported models, and the simple cameras."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from neurolens.cameras.contract import Camera
from neurolens.cameras.pinhole import Pinhole
from neurolens.cameras.thin import ThinLens
from neurolens.evaluate.rays import frame_width_mm
from neurolens.evaluate.speed import Call, Candidate, Unavailable
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Lens
from neurolens.optics.pupils import camera_rays
from neurolens.optics.trace import Traced, trace
from neurolens.surrogates.domain import Domain, FilmRays

EAGER_BATCHES = (8192, 16384, 32768)
COMPILED_BATCHES = (16384,)  # each further size would compile anew, for half a minute


def exact_candidates(
    lens: Lens,
    domain: Domain,
    *,
    dtype: torch.dtype = torch.float32,
    transmittance: bool = True,
    build_rays: bool = True,
    compiled: bool = True,
    label: str = "exact",
) -> list[Candidate]:
    """The exact tracer, eager and compiled: every surface, stop, rims and dispersion, status out.

    Args:
        transmittance: whether to follow it, as surrogates do.
        build_rays: start from film and pupil points, as surrogates do; else from camera rays made beforehand.
        compiled: whether the compiled one is wanted.
        label: names are "{label} eager" and "{label} compiled".
    """

    def whole(fx: Any, fy: Any, fz: Any, px: Any, py: Any, wavelength: Any) -> Traced:
        return trace(lens, camera_rays(fx, fy, fz, px, py, domain.pupil_z_mm), wavelength, transmittance=transmittance)

    def tracing(rays: Any, wavelength: Any) -> Traced:
        return trace(lens, rays, wavelength, transmittance=transmittance)

    run: Callable[..., Traced] = whole if build_rays else tracing

    def arguments(rays: FilmRays) -> tuple[Any, ...]:
        fx, fy, fz, px, py, wavelength = columns = [c.to(dtype).contiguous() for c in rays.columns()]
        columns[2] = fz = fz[0].clone()  # one film plane, as in a picture
        return tuple(columns) if build_rays else (camera_rays(fx, fy, fz, px, py, domain.pupil_z_mm), wavelength)

    def eager(rays: FilmRays) -> Call:
        given = arguments(rays)
        return lambda: run(*given)

    fast = torch.compile(run, dynamic=False, fullgraph=True)

    def faster(rays: FilmRays) -> Call:
        given = arguments(rays)
        try:
            fast(*given)
        except (
            Exception
        ) as error:  # torch raises its own kinds: no compiler, a compiler that fails, an unsupported platform
            raise Unavailable(f"torch cannot compile here: {_first_line(error)}") from error
        return lambda: fast(*given)

    found = [Candidate(f"{label} eager", eager, EAGER_BATCHES)]
    return [*found, Candidate(f"{label} compiled", faster, COMPILED_BATCHES)] if compiled else found


def _first_line(error: BaseException) -> str:
    # Torch wraps the reason: the innermost cause is the one worth reading.
    while error.__cause__ is not None:
        error = error.__cause__
    text = next((line.strip() for line in str(error).splitlines() if line.strip()), "")
    return f"{type(error).__name__}: {text}"[:200]


def camera_candidate(camera: Camera, domain: Domain, name: str | None = None) -> Candidate:
    """A camera of the renderer (thin lens, pinhole), from film points and pupil samples to weighted scene rays."""

    def prepare(rays: FilmRays) -> Call:
        film = np.ascontiguousarray(torch.stack([rays.film_x, rays.film_y]).numpy(), dtype=np.float32)
        square = torch.stack([rays.pupil_x, rays.pupil_y]) / (2 * domain.pupil_radius_mm) + 0.5
        pupil = np.ascontiguousarray(square.numpy(), dtype=np.float32)
        wavelength = rays.wavelength_nm.numpy().astype(np.float32)
        return lambda: camera.sample(film, pupil, wavelength)

    return Candidate(name or camera.name, prepare)


def ideal_cameras(lens: Lens, domain: Domain) -> list[Candidate]:
    """Thin lens and pinhole of the lens's focal length, named "thin lens" and "pinhole"."""
    data = first_order(lens)
    focal, width = abs(data.efl_mm), frame_width_mm(domain.film_radius_mm)
    frame = (width, width * 2 / 3)
    thin, pinhole = ThinLens(focal, data.f_number, math.inf, frame), Pinhole(focal, frame)
    return [camera_candidate(thin, domain, "thin lens"), camera_candidate(pinhole, domain, "pinhole")]


def model_candidate(name: str, model: Any, stop_radius_mm: float) -> Candidate:
    """An exported model (`cameras.model.OnnxLens`, loaded with one thread: the race shares out batches)."""

    def prepare(rays: FilmRays) -> Call:
        columns = [np.ascontiguousarray(c.numpy(), dtype=np.float32) for c in rays.columns()]
        film, pupil, film_z_mm = np.stack(columns[0:2]), np.stack(columns[3:5]), float(rays.film_z[0])
        return lambda: model.rays(film, pupil, columns[5], film_z_mm, stop_radius_mm)

    return Candidate(name, prepare)
