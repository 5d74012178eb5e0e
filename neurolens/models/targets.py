"""What a fit takes: gates, settings, and ray pairs with their exact vectors and scalars, scaled and weighted.

Gates are the rims and discriminants that a model must test. A rim is tested at the ray's crossing with its surface. A
ray that misses a surface or is totally reflected has no crossing; there the sign of the discriminant decides (of the
intersection, or of Snell's law). It is smooth across the boundary, because it depends only on the ray that arrives.

Of a lens whose rays leave the front surface at grazing angles, polynomials are fitted up to the front glass, and models
refract there exactly (`cores.Refracted`): near grazing the direction outside turns as the square root of the distance
to the grazing ray. Networks follow that themselves, and measured worse when their error was that inside the glass.
"""

import math
import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import NeurolensWarning
from neurolens.base.settings import Rule, check_bounds, setting
from neurolens.models.assemble import tilt_series
from neurolens.models.cores import DIRECTION, POSITION, STOP, Array, LightField, Refracted, angle_vector
from neurolens.models.fitted import Domain, Encoding, FilmRays, Gate, Scales
from neurolens.models.model import LensModel
from neurolens.models.pairs import (
    RIM_REACH,
    PairSet,
    RayPairs,
    draw,
    draw_everywhere,
    join_pairs,
    reached,
    sample_domain,
    trace_pairs,
)
from neurolens.models.terms import pinned_threads
from neurolens.optics.lens.glass import index_of, inverse_square_um
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.trace.rays import CHUNK
from neurolens.optics.trace.shapes import is_deep, rim_sine
from neurolens.optics.trace.surfaces import entered

# Rays of the boundary fits are mixed by this seed: networks use the first of them.
_MIXING_SEED = 1
# The most gates of either kind. Rims are added until this share of the blocked rays is left unexplained, discriminants
# until this share of all rays is.
_MOST_GATES, _UNEXPLAINED = 10, 1e-4

# Only the neighbourhood of a boundary decides who passes: weights fall off beyond this distance from it, in units of
# the gate (one of which is about half a rim's radius).
BOUNDARY_WIDTH = 0.03
# The stop crossing may err by the same share of any opening down to this one, in stop radii: four stops.
STOPPED_DOWN = 0.25


def gate_reach(gates: tuple[Gate, ...], pairs: PairSet) -> Tensor:
    """Return for which rays each gate's value is known [G, N]: those that get as far as its surface, or to its rim."""
    arrives = reached(pairs)
    rows = [arrives[g.surface] & (pairs.meets[g.surface] > 0 if g.reason == st.RIM else True) for g in gates]
    return torch.stack(rows) if rows else torch.empty((0, len(pairs)), dtype=torch.bool)


def gate_values(lens: Lens, gates: tuple[Gate, ...], pairs: PairSet) -> Tensor:
    """Return exact values [G, N] of gates: positive where the surface stops the ray, 0 where it never gets there."""
    rows = []
    for gate in gates:
        k = gate.surface
        if gate.reason == st.RIM:
            rows.append(_beyond_rim(lens.surfaces[k], torch.hypot(pairs.cross_x[k], pairs.cross_y[k])))
        else:
            rows.append(-(pairs.meets[k] if gate.reason == st.MISSED else pairs.refracts[k]))
    if not rows:
        return torch.empty((0, len(pairs)), dtype=pairs.transmittance.dtype)
    return torch.where(gate_reach(gates, pairs), torch.stack(rows), 0.0)


def _beyond_rim(surface: Surface, height: Tensor) -> Tensor:
    """Return a rim's gate [N] at crossings `height` [N] mm from the axis: the height's square over the rim's, less 1.

    On a sphere whose equator lies within reach of the rays near the rim, the square turns back there and cannot be
    fitted. The gate is then the depth over the rim's depth, less 1, which agrees to first order and never turns.
    """
    if not (is_deep(surface) and RIM_REACH * rim_sine(surface) > 1):
        return height**2 / surface.semi_diameter_mm**2 - 1
    sine = height * abs(surface.curvature)
    near = sine <= 1
    cosine = torch.sqrt((1 - torch.where(near, sine, 2 - sine) ** 2).clamp_min(0.0))
    depth = 1 - torch.where(near, cosine, -cosine)
    return depth / (1 - math.sqrt(1 - rim_sine(surface) ** 2)) - 1


def boundary_weights(lens: Lens, gates: tuple[Gate, ...], pairs: PairSet) -> tuple[Tensor, Tensor]:
    """Weigh the rays of `boundary_rays` for the fits of the gates [G, N] and of the stop crossing [N].

    A gate decides where its value is near 0 and no other boundary stops the ray. The stop crossing counts wherever the
    ray passes, because the stop may be closed, and more near the middle, which is all that a small opening uses. Rays
    that are lost before a boundary weigh 0.
    """
    every = (*gates, Gate(lens.stop_index, st.RIM))
    values, arrives = gate_values(lens, every, pairs), gate_reach(every, pairs)
    beyond = values.where(arrives, 0.0).clamp_min(0.0)
    rows = []
    for i, value in enumerate(values):
        others = torch.cat([beyond[:i], beyond[i + 1 :]])
        stopped = others.amax(0) if len(others) else torch.zeros_like(value)
        distance = value if i < len(gates) else beyond[i]
        rows.append((_near(distance) * _near(stopped)).where(arrives[i], 0.0))
    opening = torch.sqrt((values[-1] + 1).clamp_min(0.0)).where(arrives[-1], 1.0)
    rows[-1] *= (1 + STOPPED_DOWN) / (opening + STOPPED_DOWN)
    return torch.stack(rows[:-1]) if gates else values[:0], rows[-1]


def _near(distance: Tensor) -> Tensor:
    return 1 / torch.sqrt(1 + (distance / BOUNDARY_WIDTH) ** 2)


def boundary_rays(pairs: RayPairs, gates: tuple[Gate, ...]) -> PairSet:
    """Return the rays to which gates are fitted: those near the rims, and lost rays where a gate stops those."""
    if all(gate.reason == st.RIM for gate in gates) or not len(pairs.edge):
        return pairs.rim
    both = join_pairs([pairs.rim, pairs.edge])
    return both.select(torch.randperm(len(both), generator=torch.Generator().manual_seed(_MIXING_SEED)))


def choose_gates(lens: Lens, blocked: PairSet, drawn: int | None = None) -> tuple[Gate, ...]:
    """Choose the boundaries that block anything in the domain: the one that explains most blocked rays, then the next.

    Rims are chosen first, by the rays that refract at all surfaces; then discriminants, for what the rims leave. A gate
    of total reflection covers the rays that miss the same surface, whose discriminant is lower still.

    Args:
        blocked: rays that did not pass, of uniform ones over the domain.
        drawn: how many uniform rays were drawn; None takes the number of `blocked`.

    Returns the gates in the order in which camera rays meet them. The stop is no gate: it is tested on its crossing.
    """
    arrives = reached(blocked)
    radii = torch.tensor(lens.semi_diameters_mm, dtype=torch.float64)[:, None]
    outside = ((blocked.cross_x**2 + blocked.cross_y**2) > radii**2) & arrives & (blocked.meets > 0)  # [S, N]
    whole = ((blocked.meets > 0) & (blocked.refracts > 0)).all(0)
    left = outside[:, whole & ~outside[lens.stop_index]]
    rims = _greedy(left, math.floor(_UNEXPLAINED * int(whole.sum())))
    stopped = outside[[*rims, lens.stop_index]].any(0)
    # Rows: total reflection, then missed. The first of equals is taken.
    lost = torch.cat([arrives & ~(blocked.refracts > 0), arrives & ~(blocked.meets > 0)])
    edges = _greedy(lost[:, ~stopped], math.floor(_UNEXPLAINED * (drawn or len(blocked))))
    count = len(lens.surfaces)
    gates = [Gate(k, st.RIM) for k in rims]
    gates += [Gate(k % count, st.TOTAL_REFLECTION if k < count else st.MISSED) for k in edges]
    return tuple(sorted(gates, key=lambda g: (-g.surface, g.reason)))


def _greedy(stops: Tensor, enough: int) -> list[int]:
    """Choose rows of [K, N] bool: the one with most entries, then the one with most of the rest, down to `enough`."""
    chosen: list[int] = []
    while stops.shape[1] and len(chosen) < _MOST_GATES:
        counts = stops.sum(1)
        best = int(counts.argmax())
        if int(counts[best]) <= max(0, enough):
            break
        chosen.append(best)
        stops = stops & ~stops[best]
    return chosen


def explained(lens: Lens, gates: tuple[Gate, ...], pairs: PairSet) -> Tensor:
    """Return which rays [N] the stop or an exact gate would stop."""
    return (gate_values(lens, (*gates, Gate(lens.stop_index, st.RIM)), pairs) > 0).any(0)


# ---- settings and targets ----

Method = Literal["thin", "thick", "dense", "omp", "ols", "mlp", "ols+mlp"]
POLYNOMIALS = ("dense", "omp", "ols")
NETWORKS = ("mlp", "ols+mlp")
PLANES_SEARCHED = ("ols", "ols+mlp")
# About 5000 candidate columns, whose Gram matrix takes 200 MB.
_MOST_DEGREE = 16
TRANSMITTANCE_TERMS = 48  # at most; seven of 12 coated lenses need fewer


@dataclass(frozen=True)
class ModelSettings:
    """The settings of one fit.

    Raises:
        InputError: numbers that ask for more than a fit can hold, or for less than one.
    """

    # First order; polynomials: all terms up to `degree`, matching pursuit, orthogonal least squares with replacement;
    # a network; a polynomial, and a network on what it leaves.
    method: Method = setting("ols", "of the fit")
    name: str = setting("", "of the file and of the table's row; empty: made from the other settings")
    terms: int = setting(40, "coefficients per vector output; dense ignores it", within=(1, 2000))
    degree: int = setting(7, "largest total degree of the first candidates", within=(0, _MOST_DEGREE))
    replacement: bool = setting(True, "whether ols exchanges terms afterwards")
    elimination: bool = setting(True, "whether ols first chooses half as many terms again, and drops the cheapest")
    # From 2 on a few more rounds follow where directions still err.
    growth: int = setting(2, "rounds in which ols adds products of the chosen terms to the candidates", within=(0, 16))
    position_weight: Annotated[float, Rule(lambda weight: 0 < weight < math.inf, "a number above 0")] = setting(
        2.0, "weight of the position in the choice of terms, relative to first order"
    )
    transmittance_terms: int = setting(TRANSMITTANCE_TERMS, "most terms of the transmittance", within=(1, 200))
    phase: bool = setting(False, "whether the optical path is one more output, of up to 240 terms of its own")
    idle_gates: Annotated[float, Rule(lambda share: 0 <= share < 1, "a share from 0 to below 1")] = setting(
        0.0, "rims that alone block at most this share of the domain's rays are left out"
    )
    planes: bool = setting(True, "whether methods of `PLANES_SEARCHED` search the planes of the light field")
    units: int = setting(16, "units of each layer of a network", within=(1, 512))
    layers: int = setting(2, "layers of a network", within=(1, 8))
    # A count, not a time, so that the load of a machine changes no byte. A step on n times the fewest rays counts n.
    steps: int = setting(400, "most iterations of a network's training", within=(1, 100_000))
    seed: int = setting(0, "of a network's first weights")

    def __post_init__(self) -> None:
        check_bounds(self, "settings")

    @property
    def label(self) -> str:
        """The name, or one made from the settings: "ols-40", "dense-d4", "mlp-16x2"."""
        if self.name:
            return self.name
        if self.method in NETWORKS:
            before = f"ols-{self.terms}-" if self.method == "ols+mlp" else ""
            return f"{before}mlp-{self.units}x{self.layers}"
        if self.method in ("thin", "thick"):
            return self.method
        return f"{self.method}-d{self.degree}" if self.method == "dense" else f"{self.method}-{self.terms}"

    @property
    def family(self) -> str:
        return "paraxial" if self.method in ("thin", "thick") else self.method


def scales_of(lens: Lens) -> Scales:
    """Return the scales of a lens: positions in units of the front rim, stop crossings in units of the stop."""
    return Scales(lens.surfaces[0].semi_diameter_mm, lens.stop_radius_mm)


@dataclass(frozen=True)
class Targets:
    """Inputs and outputs of a fit.

    Attributes:
        field: light field of the rays.
        vectors: [3, 2, N] position, direction (angle vector), stop crossing, scaled.
        transmittance: [N].
    """

    field: LightField
    vectors: Tensor
    transmittance: Tensor


def targets_of(lens: Lens, encoding: Encoding, pairs: PairSet) -> Targets:
    """Return the targets of rays that reach the scene."""
    scales, scene, stop = scales_of(lens), pairs.scene, lens.stop_index
    vectors = torch.empty((3, 2, len(pairs)), dtype=scene.x.dtype)
    vectors[POSITION] = torch.stack([scene.x, scene.y]) / scales.position_mm
    vectors[DIRECTION] = angle_vector(scene.dx, scene.dy, scene.dz)
    vectors[STOP] = torch.stack([pairs.cross_x[stop], pairs.cross_y[stop]]) / scales.stop_mm
    return Targets(encoding(pairs.inputs), vectors, pairs.transmittance)


@dataclass(frozen=True)
class Prepared:
    """Ray pairs with what all fits share.

    Attributes:
        encoding, gates: of the model.
    """

    pairs: RayPairs
    encoding: Encoding
    gates: tuple[Gate, ...]

    @property
    def train(self) -> Targets:
        return targets_of(self.pairs.lens, self.encoding, self.pairs.train)

    @cached_property
    def boundary(self) -> PairSet:
        """The rays on which gates and the stop crossing are fitted."""
        return boundary_rays(self.pairs, self.gates)

    @property
    def boundary_field(self) -> LightField:
        return self.encoding(self.boundary.inputs)

    @cached_property
    def boundary_weights(self) -> tuple[Tensor, Tensor]:
        """The weights of the gates [G, N] and of the stop crossing [N]."""
        return boundary_weights(self.pairs.lens, self.gates, self.boundary)


def film_equivalent_weights(lens: Lens, domain: Domain) -> tuple[float, float]:
    """Return the micrometres on the film per unit of scaled position and per radian, to first order.

    A direction error d moves the image by f d. A position error e on the front surface moves a point in the nearest
    focused plane by e, and its image by e times the magnification there. Where the domain has objects nearer than that
    plane (`Domain.nearest_m`), the magnification is theirs. For a lens focused at infinity a position error would count
    for nothing; it counts with the magnification of 20 focal lengths, so that near objects keep their place.
    """
    f = abs(first_order(lens).efl_mm)
    nearest_m = min(*domain.focus_m, math.inf if domain.nearest_m is None else domain.nearest_m)
    nearest_mm = min(1000 * nearest_m, 20 * f)
    magnification = f / max(nearest_mm - f, f)
    return 1000 * magnification * scales_of(lens).position_mm, 1000 * f


def film_equivalent(lens: Lens, domain: Domain, vectors: Tensor) -> Tensor:
    """Return errors on the film [2, 2, N] (um) of vectors [3, 2, N]: in the nearest focused plane, and at infinity."""
    position, direction = film_equivalent_weights(lens, domain)
    at_infinity = direction * vectors[DIRECTION]
    return torch.stack([at_infinity + position * vectors[POSITION], at_infinity])


def weighed_apart(lens: Lens, domain: Domain, vectors: Tensor, position_weight: float) -> Tensor:
    """Return what decides which terms a fit keeps [2, 2, N]: direction (um on the film), and position.

    Position counts `position_weight` times what first order makes of it (see `film_equivalent_weights`): the point on
    the front surface matters by itself too, for objects near the lens and for what stands on the front rim.
    """
    position, direction = film_equivalent_weights(lens, domain)
    return torch.stack([direction * vectors[DIRECTION], position_weight * position * vectors[POSITION]])


def fit_encoding(domain: Domain, passing: PairSet, *, mirror: bool = False) -> Encoding:
    """Centre and scale by the passing rays; with `mirror` x and y by themselves, for lenses with cylinders."""
    plain = Encoding(domain.film_z_mm[0], domain.pupil_z_mm, 0.0, 1.0, 1.0, 0.0, 0.0)
    p, u = plain.planes(passing.inputs)
    axes = [slice(0, 1), slice(1, 2)] if mirror else [slice(0, 2)]
    chiefs = [float((p[a] * u[a]).sum() / (p[a] * p[a]).sum()) for a in axes]
    scales = [float((u[a] - k * p[a]).norm(dim=0).max()) for a, k in zip(axes, chiefs, strict=True)]
    shortest, longest = (float(inverse_square_um(v)) for v in domain.wavelength_nm)
    return Encoding(
        film_plane_z_mm=plain.film_plane_z_mm,
        pupil_plane_z_mm=plain.pupil_plane_z_mm,
        chief=chiefs[0],
        film_scale_mm=float(p.norm(dim=0).max()),
        pupil_scale_mm=scales[0],
        w_middle=(shortest + longest) / 2,
        w_half=(shortest - longest) / 2,
        chief_y=chiefs[1] if mirror else None,
        pupil_scale_y_mm=scales[1] if mirror else None,
    )


# ---- rays that leave the front surface at grazing angles ----

# Cosine of the flattest ray that leaves the front surface, below which a fit refracts there.
GRAZING = 0.3
_SERIES_DEGREE, _SERIES_ERROR = 8, 3e-8  # of the index: float32's last bit


def grazes(pairs: RayPairs) -> bool:
    """Return whether any ray to fit leaves the front surface at a grazing angle, and models can refract there."""
    flattest = float(pairs.train.refracts[0].min()) if len(pairs.train) else 1.0
    return flattest < GRAZING**2 and tilt_series(pairs.lens.surfaces[0]) is not None


def inside_front(lens: Lens, pairs: PairSet) -> PairSet:
    """Return the rays with their directions inside the front glass; rays that end earlier stay as they were."""
    front, scene = lens.surfaces[0], pairs.scene
    n, outside = np.asarray(_index(lens, pairs.inputs.wavelength_nm.numpy())), torch.stack(scene[3:]).numpy()
    with np.errstate(all="ignore"):
        d, _ = entered(front, scene.x.numpy(), scene.y.numpy(), outside, n)
    d = np.where(np.isfinite(d).all(0), d, outside)
    return replace(pairs, scene=scene._replace(**dict(zip(("dx", "dy", "dz"), torch.from_numpy(d), strict=True))))


def _index(lens: Lens, wavelength_nm: Any) -> Any:
    """Return the index of the front glass over that of the medium in front of it."""
    return index_of(lens.surfaces[0], wavelength_nm) / index_of(lens.object_medium, wavelength_nm)


def index_series(lens: Lens, encoding: Encoding) -> Array:
    """Return the front glass's relative index as a power series [K] in the encoding's w, to float32's last bit."""
    if not encoding.dispersive:
        return np.array([float(lens.surfaces[0].n_d) / float(lens.object_medium.n_d)])
    w = np.linspace(-1, 1, 200)
    n = np.array([float(_index(lens, 1000 / v**0.5)) for v in encoding.w_middle + encoding.w_half * w])
    for degree in range(_SERIES_DEGREE + 1):
        series = np.polynomial.Polynomial.fit(w, n, degree, domain=[-1, 1])
        if np.abs(series(w) - n).max() < _SERIES_ERROR:
            break
    return np.asarray(series.convert().coef)


# Rays drawn over the domain to find what blocks anything: a share of 1e-4 is 20 of them.
_GATE_RAYS = 200_000


def prepare(pairs: RayPairs) -> Prepared:
    """Find the encoding, and the rims and discriminants that block anything in the domain.

    Warns:
        NeurolensWarning: more than one ray in 10,000 is lost in a way that no gate shows (beyond 90 degrees to a
            plane, or on the far half of a sphere).
    """
    drawn, ended = draw_everywhere(pairs.domain, _GATE_RAYS, pairs.settings.seed + 1_000_003), []
    with pinned_threads():
        for start in range(0, len(drawn), CHUNK):  # crossings with many surfaces are large: of blocked rays alone
            some = FilmRays(*(c[start : start + CHUNK] for c in drawn.columns()))
            traced = trace_pairs(pairs.lens, some, pairs.domain.pupil_z_mm, power=False)
            ended.append(traced.select(traced.status != st.PASSED))
            del traced
    blocked = join_pairs(ended)
    del ended
    gates = choose_gates(pairs.lens, blocked, len(drawn))
    untold = (blocked.status % 4 != st.RIM) & ~explained(pairs.lens, gates, blocked)
    lost = float(untold.double().sum()) / len(drawn)
    if lost > 1e-4:
        warnings.warn(
            f"{pairs.lens.path}: {100 * lost:.2f}% of the domain's rays miss a surface or are totally "
            "reflected where no gate of the model says so; there the model blocks by the nearest rims",
            NeurolensWarning,
            stacklevel=2,
        )
    return Prepared(pairs, fit_encoding(pairs.domain, pairs.train, mirror=pairs.lens.anamorphic), gates)


# ---- what a model is told of its lens once it is fitted ----

# A gate goes where at most this share of the domain's rays is blocked by it and by nothing else.
IDLE_SHARE, _IDLE_RAYS = 1e-5, 200_000
# rays that are sampled for the largest angle of a lens; fewer passing rays than the second do not show it
_ANGLE_RAYS, _FEWEST_RAYS = 32_768, 300


def with_angle(model: LensModel) -> LensModel:
    """Return the model with the largest angle of its lens's rays in a sample of the domain; see `LensModel.angle`."""
    rays, _ = draw(model.domain, _ANGLE_RAYS, seed=5)
    with torch.no_grad():
        exact = trace_pairs(model.lens, rays, model.domain.pupil_z_mm, power=False)
        if isinstance(model.core, Refracted):
            angles = model.core(model.encoding(rays))[0][DIRECTION].norm(dim=0)
        else:
            angles = torch.atan2(torch.hypot(exact.scene.dx, exact.scene.dy), -exact.scene.dz)
    angles = angles[exact.status == st.PASSED]
    if len(angles) < _FEWEST_RAYS:
        return replace(model, angle=math.pi)
    angle = float(angles.max())
    bound = next((b for b in (math.pi / 2, math.pi) if angle < b), math.pi)
    return replace(model, angle=min(1.05 * angle, (angle + bound) / 2, bound))


def without_idle_gates(models: tuple[LensModel, ...], share: float = IDLE_SHARE) -> tuple[LensModel, ...]:
    """Leave out the gates that block almost no ray that the other gates and the stop let through.

    A status may then name another surface: the first of those left. `share`: see `IDLE_SHARE`.
    """
    left, blocked = list(range(len(models[0].gates))), torch.cat([_blocked(m) for m in models], 1)  # the stop first
    while left:
        others = (blocked[[0, *(1 + k for k in left if k != g)]].any(0) for g in left)
        alone = [int((blocked[1 + g] & ~rest).sum()) for g, rest in zip(left, others, strict=True)]
        if min(alone) > share * blocked.shape[1]:
            break
        del left[alone.index(min(alone))]
    if len(left) == len(models[0].gates):
        return models
    return tuple(
        replace(m, gates=tuple(m.gates[k] for k in left), core=m.core.keep([0, *(1 + k for k in left)])) for m in models
    )


def _blocked(model: LensModel) -> Tensor:
    """Return which of the stop and the gates [1 + G, N] block each ray of the domain."""
    with torch.no_grad():
        vectors, scalars = model.core(model.encoding(sample_domain(model.domain, _IDLE_RAYS, seed=17)))
    stop = ((vectors[STOP] * model.scales.stop_mm) ** 2).sum(0) > model.domain.stop_radius_mm**2
    return torch.cat([stop[None], scalars[1:] > 0])
