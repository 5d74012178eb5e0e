"""Third-order (Seidel) sums and the two of colour, surface by surface.

Welford 1986, "Aberrations of Optical Systems", ch. 8 and 10; y and u are height and slope of the paraxial marginal ray,
barred those of the chief ray, A = n (u + y c), H = n (u ybar - ubar y). The fifth sum avoids a division
by A, which is 0 at a surface that the marginal ray meets at normal incidence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from neurolens.analysis.fields import Array, Result, Scene
from neurolens.base.errors import InputError
from neurolens.lens.glass import LINE_C_NM, LINE_D_NM, LINE_F_NM
from neurolens.lens.paraxial import PathOfRay, System, system_of
from neurolens.lens.prescription import Lens, Surface

NAMES = ("S1 spherical", "S2 coma", "S3 astigmatism", "S4 Petzval", "S5 distortion", "C1 axial colour", "C2 lateral")


@dataclass(frozen=True)
class Seidel(Result):
    """Seidel sums in mm, for the present stop and one image height.

    As wavefront aberrations at the edge of pupil and field: W040 = S1/8, W131 = S2/2, W222 = S3/2, W220 = (S3 + S4)/4,
    W311 = S5/2; of colour, F against C: C1/2 and C2
    (of a lens for other light, its shortest wavelength against its longest).

    Attributes:
        surfaces: [S, 7], one row per surface; columns as in `NAMES`.
        total: [7].
        image_height_mm: the paraxial image height that the sums are for.
        lagrange_mm: H, the Lagrange invariant.
        petzval_radius_mm: of the Petzval surface, positive when its centre lies towards +z.
        odd_powers: surfaces whose r^3 or r terms are left out: they have no third-order theory.
    """

    wavelength_nm: float
    image_height_mm: float
    lagrange_mm: float
    petzval_radius_mm: float
    surfaces: Array
    total: Array
    names: tuple[str, ...]
    odd_powers: tuple[int, ...]


def seidel(scene: Scene, *, wavelength_nm: float | None = None, image_height_mm: float | None = None) -> Seidel:
    """Seidel sums at the edge of the field, or at another paraxial image height in mm.

    Raises:
        InputError: a lens with cylinders: these sums are those of lenses symmetric about their axis; ideal surfaces.
    """
    lens = scene.lens
    wavelength_nm = lens.reference_nm if wavelength_nm is None else wavelength_nm
    if lens.anamorphic:
        raise InputError(lens.path, "cylinder", "(an anamorphic lens)", "a lens that is symmetric about its axis")
    scene.require_power()
    lens.require_glass("Seidel sums")
    if image_height_mm is None:
        image_height_mm = float(scene.chief_rays([scene.edge.field_deg], wavelength_nm).height_mm[0])
    system = system_of(lens, wavelength_nm)
    n = system.index
    blue, red = (system_of(lens, nm).index for nm in ((LINE_F_NM, LINE_C_NM) if lens.visible else lens.light_nm))
    spread = [a - b for a, b in zip(blue, red, strict=True)]
    marginal, chief = _rays(scene, system, image_height_mm)
    rows = np.array([_row(s, k, n, spread, marginal, chief) for k, s in enumerate(lens.surfaces)])
    bend = petzval_curvature(lens, wavelength_nm)
    return Seidel(
        wavelength_nm,
        image_height_mm,
        n[0] * (marginal.before[0] * chief.y[0] - chief.before[0] * marginal.y[0]),
        math.inf if bend == 0 else 1 / bend,
        rows,
        rows.sum(0),
        NAMES,
        tuple(k for k, s in enumerate(lens.surfaces) if any(p in (1, 3) and a for p, a in s.asphere)),
    )


def petzval_curvature(lens: Lens, wavelength_nm: float = LINE_D_NM) -> float:
    """Curvature of the Petzval surface in 1/mm (positive: centre towards +z); NaN for a lens with cylinders."""
    if lens.anamorphic:
        return math.nan
    system = system_of(lens, wavelength_nm)
    n = system.index
    return float(sum(c * (1 / n[k + 1] - 1 / n[k]) for k, c in enumerate(system.curvature)))


def _rays(scene: Scene, system: System, image_height_mm: float) -> tuple[PathOfRay, PathOfRay]:
    """Marginal ray to the edge of the stop, and chief ray to -image_height_mm in the paraxial image."""
    stop, near = scene.lens.stop_index, 0.0 if math.isinf(scene.focus_m) else -1 / scene.object_z_mm
    scale = scene.lens.stop_radius_mm / system.march(1.0, near).y[stop]
    marginal = system.march(scale, scale * near)
    # The linear combination of the two through the middle of the stop.
    y, u = -system.march(0.0, 1.0).y[stop], system.march(1.0, 0.0).y[stop]
    chief = system.march(y, u)
    image = -marginal.y[-1] / marginal.after[-1]
    scale = -image_height_mm / (chief.y[-1] + image * chief.after[-1])
    return marginal, system.march(scale * y, scale * u)


def _row(s: Surface, k: int, n: list[float], spread: list[float], m: PathOfRay, b: PathOfRay) -> list[float]:
    before, after, c = n[k], n[k + 1], float(s.vertex_curvature("y"))
    y, y_bar = m.y[k], b.y[k]
    a, a_bar = before * (m.before[k] + y * c), before * (b.before[k] + y_bar * c)
    h = a * y_bar - a_bar * y
    bend = m.after[k] / after - m.before[k] / before
    inverse, inverse2 = 1 / after - 1 / before, 1 / after**2 - 1 / before**2
    s5 = -a_bar * (a_bar**2 * y * inverse2 - y_bar * (2 * a_bar * y - a * y_bar) * c * inverse)
    # What the surface departs from the sphere of its vertex curvature, per r^4.
    conic = (1 + float(s.conic)) * float(s.curvature) ** 3 - c**3
    g = (conic + 8 * float(dict(s.asphere).get(4, 0.0))) * (after - before)
    dispersion = spread[k + 1] / after - spread[k] / before
    return [
        -(a**2) * y * bend + g * y**4,
        -a * a_bar * y * bend + g * y**3 * y_bar,
        -(a_bar**2) * y * bend + g * y**2 * y_bar**2,
        -(h**2) * c * inverse,
        s5 + g * y * y_bar**3,
        a * y * dispersion,
        a_bar * y * dispersion,
    ]
