"""Curves over the field: colour, curvature and astigmatism, distortion, vignetting, and Seidel sums."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from neurolens.base.errors import InputError
from neurolens.base.report import Report, over
from neurolens.base.settings import EYE_NM
from neurolens.optics.analysis.bundles import bundle, hexapolar, points
from neurolens.optics.analysis.fields import Array, OverField, Scene, on_plane
from neurolens.optics.lens.glass import LINE_C_NM, LINE_D_NM, LINE_F_NM, LINE_G_NM
from neurolens.optics.lens.paraxial import PathOfRay, System, system_of
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.setting.pupil_nodes import FilmLight, converged
from neurolens.optics.setting.pupils import pupil_plane_z_mm
from neurolens.optics.trace.surfaces import Rays

# Share of the stop's radius at which a ray stands for the paraxial one: its error grows with the square.
PARAXIAL = 1e-3
_ZONES = (PARAXIAL, 0.5**0.5, 1 - 1e-7)


@dataclass(frozen=True)
class Colour(Report):
    """Colour of a lens. Focus counts from the film; shifts are positive away from the lens.

    Attributes:
        spectrum_nm: [L].
        zone: [3] shares of the stop's radius: paraxial, half of the area, edge.
        focus_shift_mm: [L, 3] where rays of each zone cross the axis; NaN where a rim blocks them.
        field_deg, height_mm: [F], of the chief ray of the first line.
        line_nm: [W]; the first is the reference.
        lateral_um: [F, W] image height less that of the reference.
    """

    spectrum_nm: Array
    zone: Array
    focus_shift_mm: Array = field(metadata=over("spectrum_nm", "zone"))
    field_deg: Array
    height_mm: Array = field(metadata=over("field_deg"))
    line_nm: Array
    lateral_um: Array = field(metadata=over("field_deg", "line_nm"))


def colour(
    scene: Scene, *, spectrum_nm: Sequence[float] | None = None, line_nm: Sequence[float] | None = None,
    fields: int = 21,
) -> Colour:  # fmt: skip
    """Compute longitudinal colour on the axis by zones, and lateral colour of chief rays up to the edge of the field.

    The spectrum is 380 to 780 nm and the lines are d, F, C and g; for a lens made for other light, its range and
    wavelengths.

    Raises:
        InputError: the lens is a pinhole, which has no focus.
    """
    scene.require_power()
    lens = scene.lens
    if spectrum_nm is None:
        spectrum_nm = np.linspace(*(EYE_NM if lens.visible else lens.light_nm), 41).tolist()
    spectrum = np.asarray(spectrum_nm, dtype=np.float64)
    line_nm = line_nm or (*scene.waves_nm, *((LINE_G_NM,) if lens.visible else ()))
    axial = bundle(scene.round, [0.0], spectrum.tolist(), points(list(_ZONES), [0.0] * 3))
    crossing = -(axial.tangential_mm / axial.slopes[0])[0].numpy()
    angles = np.linspace(0, scene.edge.field_deg, fields)
    chief = bundle(scene.open, angles.tolist(), line_nm, points([0.0], [0.0]))
    # Tangential coordinates grow with the image height where the field's angle is positive.
    lateral = 1000 * chief.tangential_mm[..., 0].numpy()
    return Colour(
        spectrum, np.array(_ZONES), crossing, angles, chief.chief_height_mm.numpy(), np.array(line_nm), lateral
    )


_CLOSE = 1e-3  # of the stop's radius; differences are central, so that their error is of the order of its square


@dataclass(frozen=True)
class Curvature(OverField):
    """Foci over F fields from the axis to the edge, one wavelength.

    Attributes:
        tangential_mm, sagittal_mm: [F] along the axis, counted from the film, positive away from the lens.
        petzval_mm: [F] the Petzval surface at these heights, through the sagittal focus on the axis.
        petzval_radius_mm: its radius, positive when its centre lies towards +z; inf when flat; NaN with cylinders.
    """

    wavelength_nm: float
    tangential_mm: Array = field(metadata=over("field_deg"))
    sagittal_mm: Array = field(metadata=over("field_deg"))
    petzval_mm: Array = field(metadata=over("field_deg"))
    petzval_radius_mm: float


def curvature(
    scene: Scene, *, wavelength_nm: float | None = None, fields: int = 31, edge_deg: float | None = None
) -> Curvature:
    """Compute sagittal and tangential foci up to the edge of the field, without rims.

    Raises:
        InputError: the lens is a pinhole, which has no focus.
    """
    scene.require_power()
    wavelength_nm = scene.lens.reference_nm if wavelength_nm is None else wavelength_nm
    angles = np.linspace(0, scene.edge.field_deg if edge_deg is None else edge_deg, fields)
    pattern = points([-_CLOSE, _CLOSE, 0.0, 0.0], [0.0, 0.0, -_CLOSE, _CLOSE])
    rays = bundle(scene.open, angles.tolist(), [wavelength_nm], pattern)
    slope_t, slope_s = rays.slopes
    tangential = _crossing(rays.tangential_mm[:, 0, :2], slope_t[:, 0, :2])
    sagittal = _crossing(rays.sagittal_mm[:, 0, 2:], slope_s[:, 0, 2:])
    height = rays.chief_height_mm.numpy()
    bend = petzval_curvature(scene.lens, wavelength_nm)
    petzval, radius = sagittal[0] + bend * height**2 / 2, math.inf if bend == 0 else 1 / bend
    return Curvature(angles, height, wavelength_nm, tangential, sagittal, petzval, radius)


def _crossing(place: Tensor, slope: Tensor) -> Array:
    """Return z from the film at which two rays [F, 2] cross."""
    return (-(place[:, 1] - place[:, 0]) / (slope[:, 1] - slope[:, 0])).numpy()


# Image height over focal length for an angle in rad.
PROJECTIONS = {
    "rectilinear, f tan": lambda a: np.where(a < math.pi / 2, np.tan(np.minimum(a, 1.57)), np.nan),
    "equidistant, f theta": lambda a: a,
    "equisolid, 2 f sin(theta/2)": lambda a: 2 * np.sin(a / 2),
    "stereographic, 2 f tan(theta/2)": lambda a: 2 * np.tan(a / 2),
    "orthographic, f sin": lambda a: np.where(a <= math.pi / 2, np.sin(a), np.nan),
}
RECTILINEAR = next(iter(PROJECTIONS))
_SMALL_DEG = 1e-3  # the field whose image height gives the scale


@dataclass(frozen=True)
class Distortion(OverField):
    """Distortion over F fields from the axis to the edge.

    Attributes:
        scale_mm: image height per radian at the axis: the focal length for a distant object.
        error_percent: by projection [F], 100 (height / ideal - 1); 0 on the axis, NaN where the projection ends.
        best: the projection with the least root mean square error over the whole field.
        reference: rectilinear below 60 degrees of half field, `best` from there on.
        edge_percent: error of `reference` at the edge of the field. edge: which edge that is, in words.
    """

    wavelength_nm: float
    scale_mm: float
    error_percent: dict[str, Array] = field(metadata=over("field_deg"))
    best: str
    reference: str
    edge_percent: float
    edge: str


def distortion(
    scene: Scene, *, wavelength_nm: float | None = None, fields: int = 41, edge_deg: float | None = None
) -> Distortion:
    """Compute distortion against every projection; for a near object of a rectilinear lens, against object heights."""
    wavelength_nm = scene.lens.reference_nm if wavelength_nm is None else wavelength_nm
    angles = np.linspace(0, scene.edge.field_deg if edge_deg is None else edge_deg, fields)
    small_first = np.concatenate([[_SMALL_DEG], angles])
    chief, theta = scene.chief_rays(small_first, wavelength_nm), np.radians(small_first)
    height = chief.height_mm.numpy()
    errors = {name: _error(height, ideal(theta)) for name, ideal in PROJECTIONS.items()}
    origin = scene.object_points(chief.start)
    if origin is not None and not scene.wide:
        errors[RECTILINEAR] = _error(height, (origin[0] if scene.axis == "x" else origin[1]).numpy())
    best = min(errors, key=lambda k: np.mean(errors[k] ** 2) if np.isfinite(errors[k]).all() else math.inf)
    reference = best if scene.wide else RECTILINEAR
    return Distortion(
        angles, height[1:], wavelength_nm, float(height[0] / theta[0]), errors, best, reference,
        float(errors[reference][-1]), scene.edge.name if edge_deg is None else f"{edge_deg:g} degrees",
    )  # fmt: skip


def _error(height: Array, ideal: Array) -> Array:
    """Return the error in percent, for the scale that the first, small field has; that field is left out."""
    with np.errstate(divide="ignore", invalid="ignore"):
        error = 100 * (height / ideal * (ideal[0] / height[0]) - 1)
    return np.where(ideal[1:] == 0, 0.0, error[1:])


_MARGIN = 0.08  # of the grid around the bundle, since film points off the chief ray see another pupil


@dataclass(frozen=True)
class Illumination(OverField):
    """Light over F fields from the axis to the edge, one wavelength, glass without losses.

    Attributes:
        relative: [F] film irradiance over that on the axis.
        unvignetted: [F] the same without rims: natural falloff, pupil growth and distortion.
        passed: [F] share of the stop's light that no rim takes.
        cos4: [F] cos^4 of the field angle, 0 from 90 degrees on.
        spread: for each figure by name, [F, ...], how much two samplings of the pupil differ (`pupil_nodes.converged`).
    """

    wavelength_nm: float
    relative: Array = field(metadata=over("field_deg"))
    unvignetted: Array = field(metadata=over("field_deg"))
    passed: Array = field(metadata=over("field_deg"))
    cos4: Array = field(metadata=over("field_deg"))
    spread: dict[str, Array] = field(metadata=over())


def illumination(scene: Scene, *, fields: int = 21) -> Illumination:
    """Compute relative illumination at the reference wavelength, up to the edge of the field, by rays from the film.

    Fields without a chief ray are NaN; all are NaN where the axis gets no light.
    """
    angles, nm = np.linspace(0, scene.edge.field_deg, fields), scene.lens.reference_nm
    rays = bundle(scene.open, angles.tolist(), [nm], hexapolar(6))
    pupil = on_plane(Rays(*(c[:, 0] for c in rays.film)), pupil_plane_z_mm(scene.lens))
    both = [_film_light(scene, lens, rays.chief_height_mm, pupil) for lens in (scene.open.traced, scene.lens)]

    def shares(light: list[Array]) -> dict[str, tuple[Array, Array | float]]:
        whole, seen = light
        with np.errstate(divide="ignore", invalid="ignore"):  # dark fields, and an axis without light, give NaN
            found = seen / (seen[0] or np.nan), whole / (whole[0] or np.nan), seen / whole
        return {k: (v, 1.0) for k, v in zip(("relative", "unvignetted", "passed"), found, strict=True)}

    height = rays.chief_height_mm.numpy()
    known = np.where(np.isfinite(height), 1.0, np.nan)
    light, spread = converged(
        lambda level, some: [known[some] * b.only(some).sums(level) for b in both], shares, fields
    )
    cos4 = np.where(angles < 90, np.cos(np.radians(angles)), 0.0) ** 4
    relative, unvignetted, passed = (values for values, _ in shares(light).values())
    return Illumination(angles, height, nm, relative, unvignetted, passed, cos4, spread)


def _film_light(scene: Scene, lens: Lens, height_mm: Tensor, pupil: Rays) -> FilmLight:
    """Return the light that film points at `height_mm` [F] get from a lens, by rays about those of `pupil` [F, P]."""
    plane_z_mm = pupil_plane_z_mm(scene.lens)
    # Where no ray meets the edge of the stop, the rear surface bounds the light, as seen from the film point.
    zero = torch.zeros_like(height_mm)
    x, y = (-height_mm, zero) if scene.axis == "x" else (zero, -height_mm)
    film = torch.stack((x, y), 1)
    rear_mm, rear_z_mm = scene.lens.surfaces[-1].semi_diameter_mm, float(scene.lens.vertices_mm[-2])
    farther = (scene.film_z_mm - plane_z_mm) / (scene.film_z_mm - rear_z_mm)
    rear = [film + (edge - film) * farther for edge in (-rear_mm, rear_mm)]
    places = torch.stack([pupil.x, pupil.y], 2)
    sound = torch.isfinite(places)
    low = torch.where(sound, places, torch.minimum(*rear)[:, None]).amin(1)
    high = torch.where(sound, places, torch.maximum(*rear)[:, None]).amax(1)
    margin = _MARGIN * (high - low)
    near = torch.where(sound, places, 0.0).sum(1) / sound.sum(1).clamp_min(1)
    return FilmLight(lens, (x, y), scene.film_z_mm, plane_z_mm, low - margin, high + margin, near)


SUMS = ("S1 spherical", "S2 coma", "S3 astigmatism", "S4 Petzval", "S5 distortion", "C1 axial colour", "C2 lateral")


@dataclass(frozen=True)
class Seidel(Report):
    """Third-order (Seidel) sums and the two of colour, in mm, for the present stop and one image height.

    As wavefront aberrations at the edge of pupil and field they are W040 = S1/8, W131 = S2/2, W222 = S3/2, W220 = (S3 +
    S4)/4, W311 = S5/2; those of colour, F against C, are C1/2 and C2 (for a lens made for other light, its shortest
    wavelength against its longest).

    Attributes:
        surfaces: [S, 7], one row per surface; columns as in `SUMS`.
        total: [7].
        image_height_mm: the paraxial image height to which the sums belong.
        lagrange_mm: H, the Lagrange invariant.
        petzval_radius_mm: that of the Petzval surface, positive when its centre lies towards +z.
        odd_powers: surfaces whose r^3 or r terms are left out, because they have no third-order theory.
    """

    wavelength_nm: float
    image_height_mm: float
    lagrange_mm: float
    petzval_radius_mm: float
    surfaces: Array = field(metadata=over("surface", "names"))
    total: Array = field(metadata=over("names"))
    names: tuple[str, ...]
    odd_powers: tuple[int, ...]


def seidel(scene: Scene, *, wavelength_nm: float | None = None, image_height_mm: float | None = None) -> Seidel:
    """Compute Seidel sums at the edge of the field, or at another paraxial image height in mm.

    Raises:
        InputError: the lens has cylinders (these sums need symmetry about the axis) or ideal surfaces.
    """
    lens = scene.lens
    wavelength_nm = lens.reference_nm if wavelength_nm is None else wavelength_nm
    if lens.anamorphic:
        raise InputError(lens.path, "cylinder", "(an anamorphic lens)", "a lens that is symmetric about its axis")
    scene.require_power()
    lens.require_centred("Seidel's sum")
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
    lagrange = n[0] * (marginal.before[0] * chief.y[0] - chief.before[0] * marginal.y[0])
    odd = tuple(k for k, s in enumerate(lens.surfaces) if any(p in (1, 3) and a for p, a in s.figure.powers))
    radius = math.inf if bend == 0 else 1 / bend
    return Seidel(wavelength_nm, image_height_mm, lagrange, radius, rows, rows.sum(0), SUMS, odd)


def petzval_curvature(lens: Lens, wavelength_nm: float = LINE_D_NM) -> float:
    """Return the curvature of the Petzval surface in 1/mm (positive: centre towards +z); NaN with cylinders."""
    if lens.anamorphic:
        return math.nan
    system = system_of(lens, wavelength_nm)
    n = system.index
    return float(sum(c * (1 / n[k + 1] - 1 / n[k]) for k, c in enumerate(system.curvature)))


def _rays(scene: Scene, system: System, image_height_mm: float) -> tuple[PathOfRay, PathOfRay]:
    """Return the marginal ray to the edge of the stop, and the chief ray to -image_height_mm in the paraxial image."""
    stop, near = scene.lens.stop_index, 0.0 if math.isinf(scene.focus_m) else -1 / scene.object_z_mm
    scale = scene.lens.stop_radius_mm / system.march(1.0, near).y[stop]
    marginal = system.march(scale, scale * near)
    # The linear combination of the two rays that goes through the middle of the stop.
    y, u = -system.march(0.0, 1.0).y[stop], system.march(1.0, 0.0).y[stop]
    chief = system.march(y, u)
    image = -marginal.y[-1] / marginal.after[-1]
    scale = -image_height_mm / (chief.y[-1] + image * chief.after[-1])
    return marginal, system.march(scale * y, scale * u)


def _row(s: Surface, k: int, n: list[float], spread: list[float], m: PathOfRay, b: PathOfRay) -> list[float]:
    """Return the sums of a surface by Welford 1986, "Aberrations of Optical Systems", ch. 8 and 10.

    y and u are height and slope of the paraxial marginal ray, barred those of the chief ray, A = n (u + y c),
    H = n (u ybar - ubar y). The fifth sum avoids a division by A, which is 0 at a surface that the marginal ray meets
    at normal incidence.
    """
    before, after, c = n[k], n[k + 1], float(s.vertex_curvature("y"))
    y, y_bar = m.y[k], b.y[k]
    a, a_bar = before * (m.before[k] + y * c), before * (b.before[k] + y_bar * c)
    h = a * y_bar - a_bar * y
    bend = m.after[k] / after - m.before[k] / before
    inverse, inverse2 = 1 / after - 1 / before, 1 / after**2 - 1 / before**2
    s5 = -a_bar * (a_bar**2 * y * inverse2 - y_bar * (2 * a_bar * y - a * y_bar) * c * inverse)
    # How the surface departs from the sphere of its vertex curvature, per r^4.
    conic = (1 + float(s.figure.conic)) * float(s.curvature) ** 3 - c**3
    g = (conic + 8 * float(dict(s.figure.powers).get(4, 0.0))) * (after - before)
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
