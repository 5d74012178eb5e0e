"""Ray pairs: camera rays of a domain and their exact images, in five splits."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.base.files import atomic_path
from neurolens.lens.prescription import Lens
from neurolens.setting.pupils import camera_rays
from neurolens.surrogates.cores import DIRECTION, STOP, Refracted
from neurolens.surrogates.domain import SPARSE, FilmRays, draw, lit_share, sample_domain
from neurolens.surrogates.model import Domain, LensModel
from neurolens.trace.rays import CHUNK, Rays, trace

SCHEMA = 3
SPLITS = ("train", "held_out", "rim", "edge", "far")
# Rays beyond this many rim radii are too far from any boundary to show where it lies.
RIM_REACH = 1.25
_BATCH = 65536
# A gate goes where at most this share of the domain's rays is blocked by it and by nothing else.
IDLE_SHARE, _IDLE_RAYS = 1e-5, 200_000
_ANGLE_RAYS, _FEWEST_RAYS = 32_768, 300  # sampled for the largest angle of a lens; fewer passing rays do not show it


@dataclass(frozen=True)
class PairSettings:
    """How many rays of each split, and the seed."""

    train: int = 30000
    held_out: int = 30000
    rim: int = 30000
    seed: int = 1


@dataclass(frozen=True)
class PairSet:
    """Camera rays and their exact images, all float64 and [N] unless said.

    Attributes:
        inputs: film point, pupil point, wavelength.
        scene: point on the front surface and unit direction (lens frame, mm).
        transmittance: power of unpolarised light that arrives.
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
        """All tensors, in the order of `of_columns`; rays last."""
        surfaces = (self.cross_x, self.cross_y, self.meets, self.refracts)
        return (*self.inputs.columns(), *self.scene, self.transmittance, self.status, *surfaces)

    @staticmethod
    def of_columns(columns: Iterable[Tensor]) -> PairSet:
        """The set of such tensors."""
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
        far: other rays that do not pass, so that models block those, too; as many, and with such zeros.
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


def trace_pairs(lens: Lens, inputs: FilmRays, pupil_z: float) -> PairSet:
    """Exact images of camera rays, with every crossing."""
    rays = camera_rays(inputs.film_x, inputs.film_y, inputs.film_z, inputs.pupil_x, inputs.pupil_y, pupil_z)
    every, parts = range(len(lens.surfaces)), []
    fields = rays.x.new_empty(4, len(every), len(rays.x))  # most of the memory of a lens with many surfaces: had once
    for start in range(0, len(rays.x), CHUNK):
        here = slice(start, start + CHUNK)
        with torch.no_grad():
            chunk = Rays(*(c[here] for c in rays))
            out = trace(lens, chunk, inputs.wavelength_nm[here], transmittance=True, record=every)
        assert out.transmittance is not None
        for k in every:
            for field, values in zip(fields, out.crossings[k], strict=True):
                field[k, here] = values
        parts.append((*out.rays, out.transmittance, out.status))
    *ended, transmittance, status = (torch.cat(c) for c in zip(*parts, strict=True))
    return PairSet(inputs, Rays(*ended), transmittance, status, *fields)


def make_pairs(
    lens: Lens, domain: Domain, settings: PairSettings | None = None,
    progress: Callable[[float], object] = lambda share: None,
) -> RayPairs:  # fmt: skip
    """Sample a domain and trace it in float64 until `train` and `held_out` are full.

    `rim`, `edge` and `far` come from the rays drawn for `train`, as many as those hold.

    Raises:
        InputError: an empty split, a stop with blades or a mask (models give the crossing with it instead), or fewer
            than one ray in 10,000 of the domain passes.
    """
    settings = settings or PairSettings()
    if lens.aperture is not None:
        raise InputError(
            lens.path, "aperture", "(blades or a mask)", "a round stop: cameras shape it outside the model"
        )
    for name in ("train", "held_out", "rim"):
        if getattr(settings, name) < 1:
            raise InputError("pairs", name, getattr(settings, name), "at least one ray")
    wanted = {"train": settings.train, "held_out": settings.held_out}
    splits: dict[str, list[PairSet]] = {name: [] for name in SPLITS}
    counts = dict.fromkeys(splits, 0)
    drawn, tested = 0, 0.0

    def keep(batch: PairSet, *names: str) -> None:
        """Add the blocked rays of a batch to these splits, as far as those are not full."""
        for name, chosen in _blocked_splits(lens, batch).items():
            if name in names:
                most = settings.rim if name == "rim" else (settings.rim + 1) // 2
                splits[name].append(batch.select(torch.nonzero(chosen)[: most - counts[name], 0]))
                counts[name] += len(splits[name][-1])

    if lit_share(domain) < SPARSE:  # then `draw` leaves far rays out
        keep(trace_pairs(lens, sample_domain(domain, _BATCH, settings.seed + 1), domain.pupil_z_mm), "far")
    total = sum(wanted.values())
    while counts["train"] < wanted["train"] or counts["held_out"] < wanted["held_out"]:
        split = "train" if counts["train"] < wanted["train"] else "held_out"
        inputs, stands_for = draw(domain, _BATCH, settings.seed, drawn)
        batch = trace_pairs(lens, inputs, domain.pupil_z_mm)
        passed = batch.status == st.PASSED
        if split == "train":
            needed = wanted["train"] - counts["train"]
            order = torch.nonzero(passed)[:, 0]
            used = int(order[needed - 1]) + 1 if len(order) >= needed else len(batch)
            tested += stands_for * used / max(len(batch), 1)
            keep(batch, "rim", "edge", "far")
        splits[split].append(batch.select(torch.nonzero(passed)[: wanted[split] - counts[split], 0]))
        counts[split] += len(splits[split][-1])
        del batch, passed  # before the next one: they are large
        drawn += _BATCH
        if drawn > 10000 * (counts["train"] + counts["held_out"] + 10):
            shown = f"({drawn} rays, {sum(counts.values())} passed)"
            raise InputError(lens.path, "domain", shown, "a domain that the lens can reach")
        progress((counts["train"] + counts["held_out"]) / total)
    joined = {name: join_pairs(splits.pop(name)) for name in SPLITS}
    joined |= {name: _unreached_as_zero(joined[name]) for name in ("edge", "far")}
    return RayPairs(lens, domain, settings, **joined, tested=round(tested))


def _blocked_splits(lens: Lens, batch: PairSet) -> dict[str, Tensor]:
    """[N] bool for each split of `RayPairs` about boundaries: the rays that belong there."""
    radii = torch.tensor(lens.semi_diameters_mm, dtype=torch.float64)[:, None]
    near = batch.cross_x**2 + batch.cross_y**2 <= (RIM_REACH * radii) ** 2
    refracts = (batch.meets > 0) & (batch.refracts > 0)
    whole = refracts.all(0)
    # Not by status alone: a ray that a rim stops may be lost at a later surface. A lost ray comes back along the axis.
    rim = whole & torch.isfinite(batch.cross_x).all(0) & ~_lost(batch) & near.all(0)
    edge = ~whole & (~(reached(batch) & refracts) | near).all(0)
    return {"rim": rim, "edge": edge, "far": ~(rim | edge | (batch.status == st.PASSED))}


def reached(pairs: PairSet) -> Tensor:
    """[S, N] bool: whether each camera ray arrives at each surface, having met and passed the glass of those before."""
    goes_on = ((pairs.meets > 0) & (pairs.refracts > 0)).flip(0)  # camera rays meet the last surface first
    before = torch.cat([torch.ones_like(goes_on[:1]), goes_on[:-1]])
    # A ray that meets the far half of a sphere, or a plane from behind, ends there with a positive discriminant.
    end = torch.where(_lost(pairs), pairs.status // 4 - 1, -1)
    return (before.cumprod(0, dtype=torch.uint8).flip(0) > 0) & (torch.arange(len(goes_on))[:, None] >= end)


def _lost(pairs: PairSet) -> Tensor:
    """[N] bool: rays whose status is a missed surface or total reflection."""
    return (pairs.status >= 4) & (pairs.status % 4 != st.RIM)


def _unreached_as_zero(lost: PairSet) -> PairSet:
    """Lost rays with 0 for what they never reached, where tracing them further gave figures without meaning."""
    arrived = reached(lost)
    meets = lost.meets.where(arrived, 0.0)
    met = arrived & (meets > 0)
    cross_x, cross_y = lost.cross_x.where(met, 0.0), lost.cross_y.where(met, 0.0)
    return replace(lost, cross_x=cross_x, cross_y=cross_y, meets=meets, refracts=lost.refracts.where(arrived, 0.0))


def join_pairs(sets: list[PairSet]) -> PairSet:
    """One set of all the rays, in order."""
    return PairSet.of_columns(torch.cat(c, -1) for c in zip(*(s.columns() for s in sets), strict=True))


def save_pairs(pairs: RayPairs, path: str | Path) -> None:
    """Write a .npz (plain arrays, no pickle) with what was traced as JSON; whole or not at all.

    Arrays: `header`, the JSON's bytes; for each split `SPLIT_vectors` [13, N] (film x, y, z, pupil x, y, wavelength,
    scene ray, transmittance), `SPLIT_status` [N] and `SPLIT_surfaces` [4, S, N] (crossings x and y, margins).
    """
    header = {
        "schema": SCHEMA,
        "lens_sha256": pairs.lens.sha256,
        "domain": pairs.domain.to_dict(),
        "settings": asdict(pairs.settings),
        "tested": pairs.tested,
    }
    arrays: dict[str, Any] = {"header": np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)}
    for name in SPLITS:
        c = getattr(pairs, name).columns()
        arrays[f"{name}_vectors"] = torch.stack(c[:13]).numpy()
        arrays[f"{name}_status"] = c[13].numpy()
        arrays[f"{name}_surfaces"] = torch.stack(c[14:]).numpy()
    with atomic_path(path) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, **arrays)


def with_angle(model: LensModel) -> LensModel:
    """The model with the largest angle of its lens's rays, by a sample of the domain; see `LensModel.angle`."""
    rays, _ = draw(model.domain, _ANGLE_RAYS, seed=5)
    with torch.no_grad():
        exact = trace_pairs(model.lens, rays, model.domain.pupil_z_mm)
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
    """The models without the gates that block (next to) nothing that the others and the stop let through.

    Which surface a status names may change with that: the first of those left. `share`: see `IDLE_SHARE`.
    """
    left = list(range(len(models[0].gates)))
    sole = [_blocked(m) for m in models]  # [1 + G, N] of each, the stop first
    while left:
        others = [[b[[0, *(1 + k for k in left if k != g)]].any(0) for b in sole] for g in left]
        counts = [
            sum(int((b[1 + g] & ~rest).sum()) for b, rest in zip(sole, each, strict=True))
            for g, each in zip(left, others, strict=True)
        ]
        least = min(range(len(left)), key=lambda i: counts[i])
        if counts[least] > share * sum(b.shape[1] for b in sole):
            break
        del left[least]
    if len(left) == len(models[0].gates):
        return models
    return tuple(
        replace(m, gates=tuple(m.gates[k] for k in left), core=m.core.keep([0, *(1 + k for k in left)])) for m in models
    )


def _blocked(model: LensModel) -> Tensor:
    """[1 + G, N] bool: which of the stop and the gates block each ray of the domain."""
    with torch.no_grad():
        vectors, scalars = model.core(model.encoding(sample_domain(model.domain, _IDLE_RAYS, seed=17)))
    stop = ((vectors[STOP] * model.scales.stop_mm) ** 2).sum(0) > model.domain.stop_radius_mm**2
    return torch.cat([stop[None], scalars[1:] > 0])
