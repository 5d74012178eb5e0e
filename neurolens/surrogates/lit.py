"""Rays of a domain near those that pass: where little of the pupil disc does, drawing from all of it is a waste."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neurolens.surrogates.domain import Domain, FilmRays, film_planes, sample_domain, sobol_points, wavelengths_of

# Where the boxes about what passes hold less than this share of the domain, rays are drawn from them.
SPARSE = 0.3
# Boxes are drawn from with this share of their half width more on every side: rays that a rim just blocks are wanted.
_BOX_MARGIN = 0.15
_EDGE = 0.03  # of the film radius


def draw(domain: Domain, count: int, seed: int, skip: int = 0) -> tuple[FilmRays, float]:
    """Rays of a domain, uniform where any passes, at most `count`; and how many of `sample_domain` they stand for."""
    if lit_share(domain) < SPARSE:
        return sample_lit(domain, count, seed, skip)
    return sample_domain(domain, count, seed, skip), float(count)


def draw_everywhere(domain: Domain, count: int, seed: int) -> FilmRays:
    """Rays that show what blocks light: of the whole domain, where little of it passes as many about what does, and a
    tenth as many from the edge of the first and the last film plane, where a rim may just begin to block.
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
    """Rays like those of `sample_domain`, of which only those near `Domain.bounds` are drawn.

    Returns fewer than `count` rays, for the corners of a box may lie outside the disc; and how many rays of
    `sample_domain` they stand for.
    """
    edges, low, high, half, area = _boxes(domain)
    weight = (edges[1:] ** 2 - edges[:-1] ** 2) * area
    s = sobol_points(count, seed, skip)
    total = torch.cumsum(weight, 0)
    ring = torch.searchsorted(total, s[0] * total[-1], right=True).clamp_max(len(weight) - 1)
    part = (s[0] * total[-1] - (total - weight)[ring]) / weight[ring]
    r = torch.sqrt(edges[ring] ** 2 + part.clamp(0, 1) * (edges[1:] ** 2 - edges[:-1] ** 2)[ring])
    u, v = low[ring] + (high - low)[ring] * s[2], half[ring] * (2 * s[3] - 1)
    cos, sin = torch.cos(2 * math.pi * s[1]), torch.sin(2 * math.pi * s[1])
    rays = FilmRays(
        r * cos, r * sin, film_planes(domain, s[5]), u * cos - v * sin, u * sin + v * cos, wavelengths_of(domain, s[4])
    )
    kept = rays.pupil_x**2 + rays.pupil_y**2 <= domain.pupil_radius_mm**2
    return rays.select(kept), count / lit_share(domain)


def lit_share(domain: Domain) -> float:
    """Share of the domain's rays within the boxes that `sample_lit` draws from (above 1: it gains nothing)."""
    edges, *_, area = _boxes(domain)
    held = ((edges[1:] ** 2 - edges[:-1] ** 2) * area).sum()
    return float(held) / (domain.film_radius_mm**2 * math.pi * domain.pupil_radius_mm**2)


def _boxes(domain: Domain) -> tuple[Tensor, ...]:
    """Edges of rings of the film [K + 1]; of each the box about what passes, enlarged: low, high, half, area [K]."""
    b = domain.bounds
    low, high, half = (torch.tensor(v, dtype=torch.float64) for v in (b.low_mm, b.high_mm, b.half_mm))
    dark = low >= high
    low, high, half = low.where(~dark, math.inf), high.where(~dark, -math.inf), half.where(~dark, 0.0)
    low, high, half = (
        torch.minimum(low[:-1], low[1:]),
        torch.maximum(high[:-1], high[1:]),
        torch.maximum(half[:-1], half[1:]),
    )
    lit = low < high
    low, high = low.where(lit, 0.0), high.where(lit, 0.0)
    spare = _BOX_MARGIN * torch.maximum((high - low) / 2, half)
    low, high, half = low - spare, high + spare, half + spare
    edges = torch.linspace(0, domain.film_radius_mm, len(low) + 1, dtype=torch.float64)
    return edges, low, high, half, (high - low) * 2 * half
