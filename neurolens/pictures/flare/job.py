"""What decides the flare of one picture: lens, lights, raster, settings; and the exposure that divides its values."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import torch

from neurolens.base.errors import InputError
from neurolens.base.settings import LIGHT_NM
from neurolens.cameras.exact import light_on_axis
from neurolens.cameras.pose import UPRIGHT, FilmPose
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.trace.rays import Rays, Traced, trace
from neurolens.pictures.flare.canvas import Array, Raster
from neurolens.pictures.flare.ghosts import GhostTracer
from neurolens.pictures.flare.lights import Light, disc
from neurolens.pictures.render.colour import SpectralRange
from neurolens.pictures.render.settings import FlareSettings

_AXIS = 1 << 15  # rays that measure the exposure
_WAVES = 16  # wavelengths over which it is a mean


@dataclass(frozen=True)
class FlareJob:
    """Everything that decides the flare of one picture.

    Attributes:
        lens: its film must be placed (`set_lens`). pose: how the film stands.
        wavelength_nm: range of light. threads: for the work.
        ghosts: traces the ghosts of the same lens and stop; left out, all ghosts of two reflections.
        single: names of the ghosts that become layers; the others are the layer "rest".
        keep: picture beside which the photons of long work are kept until they are complete.
        finer: how many times as many wavelengths ghosts may take as stars do.
    """

    lens: Lens
    lights: Sequence[Light]
    raster: Raster
    settings: FlareSettings = FlareSettings()
    wavelength_nm: tuple[float, float] = LIGHT_NM
    threads: int = 2
    ghosts: GhostTracer | None = None
    single: tuple[str, ...] = ()
    keep: Path | None = None
    finer: int = 4
    pose: FilmPose = UPRIGHT

    def spectral(self, finer: int = 1, least: int = 1) -> SpectralRange:
        """Return the range of light in bins: `finer` times as many as the settings say, and at least `least`."""
        bins = self.settings.bins
        return SpectralRange(*self.wavelength_nm, bins=bins * max(finer, -(-least // bins)))

    @cached_property
    def exposure(self) -> float:
        """The irradiance (sr) where the axis meets the film, in uniform surroundings of radiance 1, as a mean over the
        wavelengths: that of a camera, so that flare and render have one unit."""
        low, high = self.wavelength_nm
        waves = low + (high - low) * np.append(0.5, (np.arange(_WAVES) + 0.5) / _WAVES)
        one = axis_irradiance(self.lens, float(waves[0])) * float(self.pose.axes[2, 2])
        middle, *light = light_on_axis(replace(self.lens, aperture=None), waves.tolist(), self.wavelength_nm)
        return one * float(np.mean(light) / middle)

    @cached_property
    def tracer(self) -> GhostTracer:
        """Return the tracer of its ghosts."""
        return self.ghosts or GhostTracer(self.lens, pose=self.pose)


@lru_cache(maxsize=32)
def axis_irradiance(lens: Lens, wavelength_nm: float) -> float:
    """Return the irradiance (sr) at the film's centre in uniform surroundings of radiance 1: the integral of T cos."""
    film_z = lens.film_z_mm
    assert film_z is not None  # a tracer's lens has one

    def traced(sines: Array, power: bool) -> Traced:
        d = torch.from_numpy(np.stack([*sines, -np.sqrt(1 - (sines**2).sum(0))]))
        zero = torch.zeros_like(d[0])
        return trace(lens, Rays(zero, zero, zero + film_z, *d), wavelength_nm, transmittance=power)

    coarse, widest = disc(0, _AXIS), 1.0
    for _ in range(3):  # narrows to a little more than the cone that passes
        lit = (traced(widest * coarse, False).status == 0).numpy()
        widest *= 1.02 * float(np.hypot(*coarse)[lit].max(initial=0.0)) if lit.any() else 0.3
    found = traced(min(widest, 1.0) * coarse, True)
    assert found.transmittance is not None
    light = math.pi * widest**2 * float(torch.where(found.status == 0, found.transmittance, 0.0).mean())
    if not light > 0:
        raise InputError(lens.path, "surfaces", "(no ray passes on the axis)", "rims that let axial light pass")
    return light
