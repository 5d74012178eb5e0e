"""NeuroLens (Zheng and Zheng 2017, Computer Graphics Forum): averaged networks on subspaces of the input rays.

A network maps a raw ray (film position, slope, wavelength) to seven numbers: three of the position, three of the
direction, and whether the ray passes, regressed as 0 or 1. The space of input rays is divided into subspaces with
networks of their own, and in each the mean of several networks, differing by their random start, is the answer. As in
the public reimplementation: 5-128-128-128-7, ReLU, three networks, Adam.

Left open and chosen here: subspaces are rings of the film that hold equally many rays; a ray passes where the mean flag
is above 1/2; on a known front surface two numbers give the position, and the third channel carries the transmittance,
which they leave out; outputs are scaled to unit spread, blocked rays count for the flag alone and come in the
proportion in which they fall on the domain (at most two for one that passes); the rate of Adam falls to nothing along a
half cosine over 24,000 steps: on rays of the 50 mm double Gauss not fitted the loss of a network is 7.7e-3 after 6,000,
6.8e-3 after 24,000 and 7.8e-3 after 60,000 (its direction alone 0.31, 0.17 and 0.09 degrees). The flag belongs to one
stop: the model knows no stop crossing (its stop output is 0), and a smaller stop would need a new training.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from experiments.accuracy.published.data import PublishedSettings, RawData, raw_rows
from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.graph.ir import Graph, Value
from neurolens.models.cores import ROUND, Core, CoreValues, Field, Units, stored_as
from neurolens.models.fitted import Gate
from neurolens.models.pairs import PairSet, sample_domain, trace_pairs
from neurolens.models.targets import scales_of

NETWORKS = 3  # whose mean is taken
BATCH = 128
RATE = 3e-3
_FEWEST_RAYS = 200
_MARGIN = 0.02  # of rho beyond a ring's edges
_BLOCKED_RAYS = 65536

Array = NDArray[np.float64]
Layers = tuple[tuple[Array, Array], ...]


@stored_as("averaged")
@dataclass(frozen=True, eq=False)
class Averaged(Core):
    """The core: for each ring of the film the mean of some networks.

    Attributes:
        edges: rising values of rho between rings.
        networks: [rings][networks] layers (weight, bias), ReLU between them; the last include the outputs' scale.
    """

    edges: tuple[float, ...]
    networks: tuple[tuple[Layers, ...], ...]
    basis = "raw"

    def build(self, g: Graph, field: Field, units: Units) -> CoreValues:
        inputs, rho = raw_rows(field), g.quadratic(field.planes, ROUND[:1])
        out = _ring(inputs, self.networks[0])
        for edge, ring in zip(self.edges, self.networks[1:], strict=True):
            out = g.select(rho <= edge, out, _ring(inputs, ring))
        position, transmittance, direction, flag = g.split(out, [2, 1, 3, 1])
        unit = direction * (1.0 / g.square(direction).sqrt())
        position, gate = position * units.vectors[0], (0.5 - flag) * units.gates
        return CoreValues((position, position, position * 0.0), transmittance, gate, unit)

    @property
    def coefficients(self) -> int:
        return sum(w.size + b.size for ring in self.networks for net in ring for w, b in net)


def _ring(inputs: Value, networks: tuple[Layers, ...]) -> Value:
    """Mean of networks, 7 rows; without dispersion their last input is 0."""
    g, total = inputs.graph, None
    for layers in networks:
        h = inputs
        for weight, bias in layers[:-1]:
            h = g.affine(weight[:, : h.rows], h, bias).maximum(0.0)
        weight, bias = layers[-1]
        h = g.affine(weight / len(networks), h, bias / len(networks))
        total = h if total is None else total + h
    assert total is not None
    return total


def fit_averaged(
    data: RawData, settings: PublishedSettings, progress: Callable[[float], object] = lambda share: None
) -> tuple[Averaged, tuple[Gate, ...]]:
    """Train every network; the same seed gives the same weights.

    `partitions` are the rings, `steps` those of each network.

    Raises:
        InputError: more rings than the rays allow.
    """
    count = len(data.pairs.train)
    if count < settings.partitions * _FEWEST_RAYS:
        most = max(1, count // _FEWEST_RAYS)
        raise InputError("fit", "partitions", settings.partitions, f"1 to {most} rings for {count} training rays")
    inputs, values = _training_rays(data)
    rho = inputs[0] ** 2 + inputs[1] ** 2
    shares = torch.arange(1, settings.partitions) / settings.partitions
    edges = tuple(float(e) for e in torch.quantile(rho[values[6] > 0], shares))
    ends = (-math.inf, *edges, math.inf)
    rings: list[tuple[Layers, ...]] = []
    total = settings.partitions * NETWORKS
    for low, high in zip(ends, ends[1:], strict=False):
        within = (rho > low - _MARGIN) & (rho <= high + _MARGIN)
        ring = inputs[:, within], values[:, within]
        networks: list[Layers] = []
        for _ in range(NETWORKS):
            done = len(rings) * NETWORKS + len(networks)
            networks.append(_train(*ring, settings, settings.seed + done))
            progress((done + 1) / total)
        rings.append(tuple(networks))
    lens = data.pairs.lens
    gate = Gate(0 if lens.stop_index else len(lens.surfaces) - 1, st.RIM)
    return Averaged(edges, tuple(rings)), (gate,)


def _training_rays(data: RawData) -> tuple[Tensor, Tensor]:
    """Inputs [5, N] and values [7, N], the last whether a ray passes (1 or 0), in float32: the training rays, and
    blocked rays drawn over the domain."""
    pairs, scale = data.pairs, scales_of(data.pairs.lens)
    drawn = trace_pairs(
        pairs.lens, sample_domain(pairs.domain, _BLOCKED_RAYS, pairs.settings.seed + 2_000_003), pairs.domain.pupil_z_mm
    )
    blocked = drawn.select(drawn.status != st.PASSED)
    share = len(blocked) / len(drawn)
    wanted = len(pairs.train) * min(share / max(1 - share, 1e-9), 2.0)
    blocked = blocked.select(slice(0, int(wanted)))

    def values(rays: PairSet, passes: bool) -> Tensor:
        s = rays.scene
        flag = torch.full_like(s.x, float(passes))
        position = (s.x / scale.position_mm, s.y / scale.position_mm)
        return torch.stack([*position, rays.transmittance, s.dx, s.dy, s.dz, flag])

    sets = ((pairs.train, True), (blocked, False))
    inputs = torch.cat([data.variables(rays) for rays, _ in sets], 1)
    outputs = torch.cat([values(rays, passes) for rays, passes in sets], 1)
    return inputs.float(), outputs.float()


def _train(inputs: Tensor, values: Tensor, settings: PublishedSettings, seed: int) -> Layers:
    generator = torch.Generator().manual_seed(seed)
    widths = [5, *[settings.units] * settings.layers, 7]
    weights: list[Tensor] = []
    for fan_in, fan_out in zip(widths, widths[1:], strict=False):
        weights.append(torch.randn(fan_out, fan_in, generator=generator) * math.sqrt(2 / fan_in))
        weights.append(torch.zeros(fan_out))
    passing = values[:, values[6] > 0]
    mean, spread = passing.mean(1), passing.std(1).clamp_min(1e-6)
    mean[6], spread[6] = 0.5, 0.5
    wanted = ((values - mean[:, None]) / spread[:, None]).T
    # Blocked rays count for the flag alone.
    counts = torch.ones_like(wanted)
    counts[:, :6] = values[6][:, None]
    inputs = inputs.T.contiguous()
    for weight in weights:
        weight.requires_grad_(True)
    adam = torch.optim.Adam(weights, lr=RATE)
    for step in range(settings.steps):
        for group in adam.param_groups:
            group["lr"] = RATE * 0.5 * (1 + math.cos(math.pi * step / settings.steps))
        batch = torch.randint(len(inputs), (BATCH,), generator=generator)
        h = inputs[batch]
        for k in range(0, len(weights) - 2, 2):
            h = torch.relu(torch.addmm(weights[k + 1], h, weights[k].T))
        out = torch.addmm(weights[-1], h, weights[-2].T)
        loss = (((out - wanted[batch]) ** 2) * counts[batch]).mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
    fitted = [w.detach() for w in weights]
    fitted[-2], fitted[-1] = fitted[-2] * spread[:, None], fitted[-1] * spread + mean
    arrays = [w.double().numpy() for w in fitted]
    return tuple((arrays[k], arrays[k + 1]) for k in range(0, len(arrays), 2))
