"""Domains, which are the camera rays that a surrogate stands for, and pairs: rays of a domain with their exact images.

Ray pairs are sampled from a domain and traced in float64, in five splits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.base.settings import FILM_MM, WAVELENGTH_NM, said, within
from neurolens.models.fitted import Domain, FilmRays
from neurolens.optics.lens.paraxial import PupilBounds, first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.setting.focusing import film_range_mm
from neurolens.optics.setting.pupils import camera_rays, image_radius_mm, pupil_bounds
from neurolens.optics.trace.rays import CHUNK, Rays, trace

_PUPIL_MARGIN = 1.05  # radius of the pupil disc over that of the disc of all passing rays
# Film positions of sampled rays, both limits of focus among them: a picture has one film position, and so has a call of
# an exported model.
_FILM_PLANES = 17
# Where the boxes around passing rays hold less than this share of the domain, rays are drawn from the boxes.
SPARSE = 0.3
# Boxes are enlarged by this share of their half width on every side, so that rays just beyond a rim are among them.
_BOX_MARGIN = 0.15
_EDGE = 0.03  # width of the film's edge, as a share of its radius
# Another pupil plane is taken where so many times more of the disc passes; each plane tried is this factor further from
# the film than the one before, out to so many focal lengths.
_BETTER, _STEP, _REACH = 1.25, 1.02, 20


def domain_of(
    lens: Lens,
    *,
    film_radius_mm: float | None = None,
    focus_m: tuple[float, float] = (math.inf, math.inf),
    wavelength_nm: tuple[float, float] | None = None,
    nearest_m: float | None = None,
    film_z_mm: tuple[float, float] | None = None,
    pupil_z_mm: float | None = None,
) -> Domain:
    """Return the domain of a lens at its present stop.

    Args:
        film_radius_mm: None takes the lit film (see `pupils.image_radius_mm`).
        focus_m: two object distances from the film. The domain holds every film plane between theirs: those of the
            paraxial image and those of least spot.
        wavelength_nm: None takes `Lens.light_nm`, or `Lens.reference_nm` where no dispersion is known.
        nearest_m: distance from the film of the nearest object in view; None takes the nearest focus.
        film_z_mm: film planes of a lens that was focused otherwise; None follows from `focus_m`.
        pupil_z_mm: plane of the pupil points; None takes the one on which the pupil is tightest.

    Raises:
        InputError: a radius outside `FILM_MM`, `nearest_m` that is not positive and finite, wavelengths outside
            `WAVELENGTH_NM` or in the wrong order.
    """
    if film_radius_mm is not None and not within(FILM_MM, film_radius_mm):
        raise InputError("domain", "film_radius_mm", film_radius_mm, f"a length {said(FILM_MM)} mm")
    if nearest_m is not None and not 0 < nearest_m < math.inf:
        raise InputError("domain", "nearest_m", nearest_m, "a positive distance in m, or none")
    low, high = wavelength_nm or lens.light_nm
    if not WAVELENGTH_NM[0] <= low <= high <= WAVELENGTH_NM[1]:
        expected = f"shortest then longest, {said(WAVELENGTH_NM)} nm"
        raise InputError("domain", "wavelength_nm", wavelength_nm, expected)
    if not lens.dispersive:
        low = high = lens.reference_nm
    # At both distances the paraxial image and the best focus at every aperture.
    planes = film_z_mm or [z for distance in focus_m for z in film_range_mm(lens, distance, (low, high))]
    travel = (min(planes), max(planes))
    radius = film_radius_mm if film_radius_mm is not None else image_radius_mm(lens)[0]
    bounds = pupil_bounds(lens, radius, travel, (low, high), pupil_z_mm=pupil_z_mm)
    plane = _best_plane_z_mm(lens, bounds, travel[0]) if pupil_z_mm is None else pupil_z_mm
    if plane != bounds.pupil_z_mm:
        bounds = pupil_bounds(lens, radius, travel, (low, high), pupil_z_mm=plane)
    return Domain(
        film_radius_mm=radius,
        film_z_mm=travel,
        focus_m=(max(focus_m), min(focus_m)),
        pupil_z_mm=bounds.pupil_z_mm,
        pupil_radius_mm=_PUPIL_MARGIN * bounds.disc_mm,
        wavelength_nm=(low, high),
        stop_radius_mm=lens.stop_radius_mm,
        bounds=bounds,
        nearest_m=nearest_m,
    )


def _best_plane_z_mm(lens: Lens, bounds: PupilBounds, film_z_mm: float) -> float:
    """Return the plane of `bounds`, or the one on which a disc holds the passing rays of all film points most tightly.

    The pupil of a fisheye or of a condenser walks as the film point moves, and the pupil of a lens that is almost
    telecentric on the film's side lies far away: on the plane of the paraxial exit pupil, or of the rear vertex in its
    place, most of the disc is dark. Rays are straight behind the lens, so that boxes on one plane give those on all.
    """
    here = film_z_mm - bounds.pupil_z_mm
    rows = zip(bounds.low_mm, bounds.high_mm, bounds.half_mm, strict=True)
    step = bounds.film_radius_mm / (len(bounds.low_mm) - 1)
    lit = [(i * step, low, high, half) for i, (low, high, half) in enumerate(rows) if low < high]

    def spread(distance: float) -> float:
        """Return the disc's radius over its distance from the film; its square grows as the disc's solid angle."""
        s = distance / here
        boxes = ((r + (low - r) * s, r + (high - r) * s, half * s) for r, low, high, half in lit)
        return max(max(abs(a), abs(b), math.hypot((a + b) / 2, h)) for a, b, h in boxes) / distance

    f = abs(first_order(lens).efl_mm)
    start = 0.25 * (film_z_mm - float(lens.vertices_mm[len(lens.surfaces) - 1]))
    end = max(_REACH * f if math.isfinite(f) else 0.0, here)
    count = math.ceil(math.log(max(end / start, 1.0)) / math.log(_STEP)) + 1
    best = min((start * _STEP**k for k in range(count)), key=spread)
    return film_z_mm - best if spread(here) > math.sqrt(_BETTER) * spread(best) else bounds.pupil_z_mm


def focused_plane_z_mm(lens: Lens, film_z: Tensor) -> Tensor:
    """Return z (mm, lens frame; -inf at infinity) of the object plane in focus for each film z, to first order."""
    data = first_order(lens)
    front, rear = data.front_efl_mm, data.efl_mm
    extension = film_z - data.rear_principal_z_mm - rear  # Newton: f f' / extension is how far beyond the front focus
    far = extension <= 1e-9 * rear
    distance = front + front * rear / torch.where(far, torch.ones_like(extension), extension)
    return data.front_principal_z_mm - torch.where(far, torch.full_like(distance, math.inf), distance)


def sample_domain(domain: Domain, count: int, seed: int, skip: int = 0) -> FilmRays:
    """Draw rays uniform on the film and pupil discs and in wavelength, on `_FILM_PLANES` film planes of the domain.

    Scrambled Sobol points (Owen scrambling, torch): the same seed gives the same rays; `skip` continues the sequence,
    so that splits never share a ray.
    """
    s, film_z, wavelength = _drawn(domain, count, seed, skip)
    film_x, film_y = _disc(s[0], s[1], domain.film_radius_mm)
    pupil_x, pupil_y = _disc(s[2], s[3], domain.pupil_radius_mm)
    return FilmRays(film_x, film_y, film_z, pupil_x, pupil_y, wavelength)


def _drawn(domain: Domain, count: int, seed: int, skip: int) -> tuple[Tensor, Tensor, Tensor]:
    """Draw scrambled Sobol points: four numbers of every ray [4, N], its film plane and its wavelength."""
    engine = SobolEngine(6, scramble=True, seed=seed)
    if skip:
        engine.fast_forward(skip)
    s = engine.draw(count, dtype=torch.float64).T
    (near, far), (low, high) = domain.film_z_mm, domain.wavelength_nm
    step = torch.floor(s[5] * _FILM_PLANES).clamp_max(_FILM_PLANES - 1)
    return s[:4], near + (far - near) * step / (_FILM_PLANES - 1), low + (high - low) * s[4]


def _disc(a: Tensor, b: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    r, phi = radius * torch.sqrt(a), 2 * math.pi * b
    return r * torch.cos(phi), r * torch.sin(phi)


def draw(domain: Domain, count: int, seed: int, skip: int = 0) -> tuple[FilmRays, float]:
    """Draw at most `count` rays of a domain, uniform where any passes, and say how many uniform rays they stand for."""
    if lit_share(domain) < SPARSE:
        return sample_lit(domain, count, seed, skip)
    return sample_domain(domain, count, seed, skip), float(count)


def draw_everywhere(domain: Domain, count: int, seed: int) -> FilmRays:
    """Draw rays that meet everything that blocks light.

    They are uniform over the domain. Where little of it passes, as many more lie near the passing rays. A tenth as many
    start at the edge of the first and the last film plane, where a rim may just begin to block.
    """
    rays = [sample_domain(domain, count, seed)]
    if lit_share(domain) < SPARSE:
        rays.append(sample_lit(domain, count, seed + 1)[0])
    x, y, z, *rest = rays[0].select(slice(0, count // 10)).columns()
    radius = torch.hypot(x, y).clamp_min(1e-9 * domain.film_radius_mm)
    stretch = domain.film_radius_mm * (1 - _EDGE * (1 - radius / domain.film_radius_mm)) / radius
    ends = torch.tensor(domain.film_z_mm, dtype=torch.float64)[torch.arange(len(z)) % 2]
    rays.append(FilmRays(x * stretch, y * stretch, ends, *rest))
    return FilmRays(*(torch.cat(c) for c in zip(*(r.columns() for r in rays), strict=True)))


def sample_lit(domain: Domain, count: int, seed: int, skip: int = 0) -> tuple[FilmRays, float]:
    """Return rays of the same distribution as `sample_domain`, but from the boxes of `Domain.bounds` alone.

    Returns fewer than `count` rays, because the corners of a box may lie outside the disc, and the number of rays of
    `sample_domain` that they stand for.
    """
    edges, low, high, half, area = _boxes(domain)
    weight = (edges[1:] ** 2 - edges[:-1] ** 2) * area
    s, film_z, wavelength = _drawn(domain, count, seed, skip)
    total = torch.cumsum(weight, 0)
    ring = torch.searchsorted(total, s[0] * total[-1], right=True).clamp_max(len(weight) - 1)
    part = (s[0] * total[-1] - (total - weight)[ring]) / weight[ring]
    r = torch.sqrt(edges[ring] ** 2 + part.clamp(0, 1) * (edges[1:] ** 2 - edges[:-1] ** 2)[ring])
    u, v = low[ring] + (high - low)[ring] * s[2], half[ring] * (2 * s[3] - 1)
    cos, sin = torch.cos(2 * math.pi * s[1]), torch.sin(2 * math.pi * s[1])
    rays = FilmRays(r * cos, r * sin, film_z, u * cos - v * sin, u * sin + v * cos, wavelength)
    kept = rays.pupil_x**2 + rays.pupil_y**2 <= domain.pupil_radius_mm**2
    return rays.select(kept), count / lit_share(domain)


def lit_share(domain: Domain) -> float:
    """Return the share of the domain's rays in the boxes of `sample_lit` (above 1 these gain nothing)."""
    edges, *_, area = _boxes(domain)
    held = ((edges[1:] ** 2 - edges[:-1] ** 2) * area).sum()
    return float(held) / (domain.film_radius_mm**2 * math.pi * domain.pupil_radius_mm**2)


def _boxes(domain: Domain) -> tuple[Tensor, ...]:
    """Return edges [K + 1] of rings of the film, and low, high, half, area [K] of each ring's box of passing rays."""
    b = domain.bounds
    low, high, half = (torch.tensor(v, dtype=torch.float64) for v in (b.low_mm, b.high_mm, b.half_mm))
    dark = low >= high
    low, high, half = low.where(~dark, math.inf), high.where(~dark, -math.inf), half.where(~dark, 0.0)
    low, high = torch.minimum(low[:-1], low[1:]), torch.maximum(high[:-1], high[1:])
    half = torch.maximum(half[:-1], half[1:])
    lit = low < high
    low, high = low.where(lit, 0.0), high.where(lit, 0.0)
    spare = _BOX_MARGIN * torch.maximum((high - low) / 2, half)
    low, high, half = low - spare, high + spare, half + spare
    edges = torch.linspace(0, domain.film_radius_mm, len(low) + 1, dtype=torch.float64)
    return edges, low, high, half, (high - low) * 2 * half


SPLITS = ("train", "held_out", "rim", "edge", "far")
# Rays beyond this many rim radii are too far from any boundary to show where it lies.
RIM_REACH = 1.25
_BATCH = 65536


@dataclass(frozen=True)
class PairSettings:
    """How many rays each split has, and the seed."""

    train: int = 30000
    held_out: int = 30000
    rim: int = 30000
    seed: int = 1

    def __post_init__(self) -> None:
        for name in ("train", "held_out", "rim"):
            if getattr(self, name) < 1:
                raise InputError("settings", name, getattr(self, name), "at least one ray")


@dataclass(frozen=True)
class PairSet:
    """Camera rays and their exact images, all float64 and [N] unless said.

    Attributes:
        inputs: film point, pupil point, wavelength.
        scene: point on the front surface and unit direction (lens frame, mm).
        transmittance: power of unpolarised light that arrives; NaN where it was not followed.
        status: [N] int32.
        cross_x, cross_y: [S, N] crossings with every surface, mm.
        meets, refracts: [S, N] margins under the square roots of intersection and of refraction.
    """

    inputs: FilmRays
    scene: Rays
    transmittance: Tensor
    status: Tensor
    cross_x: Tensor
    cross_y: Tensor
    meets: Tensor
    refracts: Tensor

    def __len__(self) -> int:
        return len(self.inputs)

    def columns(self) -> tuple[Tensor, ...]:
        """Return all tensors in the order that `of_columns` takes; the last axis of each is that of rays."""
        surfaces = (self.cross_x, self.cross_y, self.meets, self.refracts)
        return (*self.inputs.columns(), *self.scene, self.transmittance, self.status, *surfaces)

    @staticmethod
    def of_columns(columns: Iterable[Tensor]) -> PairSet:
        """Make a set of tensors such as `columns` gives."""
        c = tuple(columns)
        return PairSet(FilmRays(*c[:6]), Rays(*c[6:12]), *c[12:])

    def select(self, index: Tensor | slice) -> PairSet:
        return PairSet.of_columns(c[..., index] for c in self.columns())


@dataclass(frozen=True)
class RayPairs:
    """The splits of one lens and domain.

    Attributes:
        lens, domain, settings: what was traced.
        train, held_out: rays that pass; no ray is in both.
        rim: rays that pass, or that only a rim or the stop blocks, by up to a quarter of its radius.
        edge: rays that miss a surface or are totally reflected, and before that are no further from the rims than the
            rays of `rim`; at most half as many as the settings ask for `rim`. Figures of surfaces that a ray never
            reached are 0.
        far: other rays that do not pass, so that models block those, too; at most as many as `edge`, with the same
            zeros.
        tested: rays drawn until `train` was full, so that len(train) / tested is the share of the disc that passes.
    """

    lens: Lens
    domain: Domain
    settings: PairSettings
    train: PairSet
    held_out: PairSet
    rim: PairSet
    edge: PairSet
    far: PairSet
    tested: int


def trace_pairs(lens: Lens, inputs: FilmRays, pupil_z: float, power: bool = True) -> PairSet:
    """Trace camera rays to their exact images, and note every crossing on the way.

    The pupil plane is at `pupil_z` (mm, lens frame). `power` tells whether to follow the light's power, too, which with
    thin films takes several times as long.
    """
    rays = camera_rays(inputs.film_x, inputs.film_y, inputs.film_z, inputs.pupil_x, inputs.pupil_y, pupil_z)
    every, parts = range(len(lens.surfaces)), []
    fields = rays.x.new_empty(4, len(every), len(rays.x))  # most of the memory of a lens with many surfaces: taken once
    for start in range(0, len(rays.x), CHUNK):
        here = slice(start, start + CHUNK)
        with torch.no_grad():
            chunk = Rays(*(c[here] for c in rays))
            out = trace(lens, chunk, inputs.wavelength_nm[here], transmittance=power, record=every)
        for k in every:
            for field, values in zip(fields, out.crossings[k], strict=True):
                field[k, here] = values
        arrives = torch.full_like(out.rays.x, math.nan) if out.transmittance is None else out.transmittance
        parts.append((*out.rays, arrives, out.status))
    *ended, transmittance, status = (torch.cat(c) for c in zip(*parts, strict=True))
    return PairSet(inputs, Rays(*ended), transmittance, status, *fields)


def _with_power(lens: Lens, pairs: PairSet, pupil_z: float) -> PairSet:
    return replace(pairs, transmittance=trace_pairs(lens, pairs.inputs, pupil_z).transmittance)


def make_pairs(
    lens: Lens, domain: Domain, settings: PairSettings | None = None,
    progress: Callable[[float], object] = lambda share: None,
) -> RayPairs:  # fmt: skip
    """Sample a domain and trace it in float64 until `train` and `held_out` are full.

    `rim`, `edge` and `far` are filled from the rays drawn for `train`, as far as these go; their transmittance is NaN.

    Raises:
        InputError: surfaces lie off the axis, the stop has blades or a mask (models give the crossing
            with it instead), or fewer than one ray in 10,000 of the domain passes.
    """
    settings = settings or PairSettings()
    lens.require_centred("a model")
    if lens.aperture is not None:
        raise InputError(
            lens.path, "aperture", "(blades or a mask)", "a round stop: cameras shape it outside the model"
        )
    splits: dict[str, list[PairSet]] = {name: [] for name in SPLITS}
    counts, tested, total = dict.fromkeys(splits, 0), 0.0, settings.train + settings.held_out

    def keep(batch: PairSet, *names: str) -> None:
        """Add the blocked rays of a batch to these splits, as far as those are not full."""
        for name, chosen in blocked_splits(lens, batch).items():
            if name in names:
                most = settings.rim if name == "rim" else (settings.rim + 1) // 2
                splits[name].append(batch.select(torch.nonzero(chosen)[: most - counts[name], 0]))
                counts[name] += len(splits[name][-1])

    if lit_share(domain) < SPARSE:  # then `draw` leaves far rays out
        keep(trace_pairs(lens, sample_domain(domain, _BATCH, settings.seed + 1), domain.pupil_z_mm, power=False), "far")
    for batch, order, stands_for in _batches(lens, domain, settings.seed, 0):
        needed = settings.train - counts["train"]
        used = int(order[needed - 1]) + 1 if len(order) >= needed else len(batch)
        tested += stands_for * used / max(len(batch), 1)
        keep(batch, "rim", "edge", "far")
        splits["train"].append(batch.select(order[:needed]))
        counts["train"] += len(splits["train"][-1])
        progress(counts["train"] / total)
        if counts["train"] == settings.train:
            break
        del batch  # before the next one: they are large
    drawn = _BATCH * len(splits["train"])
    splits["held_out"].append(
        passing_rays(
            lens, domain, settings.held_out, settings.seed, drawn, lambda n: progress((settings.train + n) / total)
        )
    )
    joined = {name: join_pairs(splits.pop(name)) for name in SPLITS}
    joined["train"] = _with_power(lens, joined["train"], domain.pupil_z_mm)
    joined |= {name: _unreached_as_zero(joined[name]) for name in ("edge", "far")}
    return RayPairs(lens, domain, settings, **joined, tested=round(tested))


def _batches(
    lens: Lens, domain: Domain, seed: int, first: int, size: int = _BATCH
) -> Iterator[tuple[PairSet, Tensor, float]]:
    """Trace rays of a domain in batches, beginning with ray number `first`, without the light's power.

    Each batch comes with the numbers of its rays that pass, and with how many rays of the domain it stands for."""
    drawn = found = 0
    while drawn <= 10000 * (found + 10):
        inputs, stands_for = draw(domain, size, seed, first + drawn)
        batch = trace_pairs(lens, inputs, domain.pupil_z_mm, power=False)
        order = torch.nonzero(batch.status == st.PASSED)[:, 0]
        drawn, found = drawn + size, found + len(order)
        yield batch, order, stands_for
        del batch
    raise InputError(lens.path, "domain", f"({drawn} rays, {found} passed)", "a domain that the lens can reach")


def passing_rays(
    lens: Lens, domain: Domain, count: int, seed: int, first: int = _BATCH,
    report: Callable[[int], object] = lambda found: None, batch: int = _BATCH,
) -> PairSet:  # fmt: skip
    """Return `count` rays of a domain that the lens passes, searched from ray number `first` on.

    `report` is called with the number of rays found so far. `batch` is how many rays are traced at a time.

    Raises:
        InputError: fewer than one ray in 10,000 of the domain passes.
    """
    parts, found = list[PairSet](), 0
    for traced, order, _ in _batches(lens, domain, seed, first, batch):
        parts.append(traced.select(order[: count - found]))
        found += len(parts[-1])
        report(found)
        if found == count:
            break
        del traced
    return _with_power(lens, join_pairs(parts), domain.pupil_z_mm)


def blocked_splits(lens: Lens, batch: PairSet) -> dict[str, Tensor]:
    """Return which rays [N] belong in each split of `RayPairs` that is about boundaries."""
    radii = torch.tensor(lens.semi_diameters_mm, dtype=torch.float64)[:, None]
    near = batch.cross_x**2 + batch.cross_y**2 <= (RIM_REACH * radii) ** 2
    refracts = (batch.meets > 0) & (batch.refracts > 0)
    whole = refracts.all(0)
    # Not by status alone: a ray that a rim stops may be lost at a later surface. The tracer returns a lost ray on the
    # axis.
    rim = whole & torch.isfinite(batch.cross_x).all(0) & ~lost(batch) & near.all(0)
    edge = ~whole & (~(reached(batch) & refracts) | near).all(0)
    return {"rim": rim, "edge": edge, "far": ~(rim | edge | (batch.status == st.PASSED))}


def reached(pairs: PairSet) -> Tensor:
    """Return whether each ray arrives at each surface [S, N]: it has met all surfaces before and refracted there."""
    goes_on = ((pairs.meets > 0) & (pairs.refracts > 0)).flip(0)  # camera rays meet the last surface first
    before = torch.cat([torch.ones_like(goes_on[:1]), goes_on[:-1]])
    # A ray that meets the far half of a sphere, or a plane from behind, ends there with a positive discriminant.
    end = torch.where(lost(pairs), pairs.status // 4 - 1, -1)
    return (before.cumprod(0, dtype=torch.uint8).flip(0) > 0) & (torch.arange(len(goes_on))[:, None] >= end)


def lost(pairs: PairSet) -> Tensor:
    """Return which rays [N] have the status of a missed surface or of total reflection."""
    return (pairs.status >= 4) & (pairs.status % 4 != st.RIM)


def _unreached_as_zero(lost: PairSet) -> PairSet:
    """Put 0 for what lost rays never reached, where tracing them further gave figures without meaning."""
    arrived = reached(lost)
    meets = lost.meets.where(arrived, 0.0)
    met = arrived & (meets > 0)
    cross_x, cross_y = lost.cross_x.where(met, 0.0), lost.cross_y.where(met, 0.0)
    return replace(lost, cross_x=cross_x, cross_y=cross_y, meets=meets, refracts=lost.refracts.where(arrived, 0.0))


def join_pairs(sets: list[PairSet]) -> PairSet:
    """Join sets into one of all their rays, in order."""
    return PairSet.of_columns(torch.cat(c, -1) for c in zip(*(s.columns() for s in sets), strict=True))
