"""A network's last layer by linear least squares: the projection of variable projection (Golub and Pereyra 1973)."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import torch
from torch import Tensor

# Rays per chunk: the products of one chunk stay within a few megabytes.
_CHUNK = 512
# Penalty on the squares of the last layer, relative to a feature that is 1 on every ray. 1e-12 is the square of about
# ten roundings of float32: weights cannot grow to where the rounding of float32 evaluation would count.
_RIDGE = 1e-12


@dataclass(frozen=True)
class Problem:
    """A weighted fit of vectors A p + B u and of scalars.

    Attributes:
        inputs: [N, I] what the network sees.
        p, u: [1, 2, N]; of a lens with cylinders [V, 1, N], what stands for p and u of each component.
        vectors: [V, 2, N] and their weights vector_weights [V, N]; [V, 1, N] of components.
        scalars: [S, N] and their weights scalar_weights [S, N].
    """

    inputs: Tensor
    p: Tensor
    u: Tensor
    vectors: Tensor
    vector_weights: Tensor
    scalars: Tensor
    scalar_weights: Tensor

    def __len__(self) -> int:
        return self.inputs.shape[0]

    @property
    def rows(self) -> int:
        """Outputs of the network: A and B of each vector, then the scalars."""
        return 2 * len(self.vectors) + len(self.scalars)

    @property
    def tensors(self) -> list[Tensor]:
        """All the data, in the order of the fields."""
        return [getattr(self, f.name) for f in fields(self)]

    def every(self, step: int, first: int = 0) -> Problem:
        """Every `step`-th ray from the `first`."""
        inputs, *rest = self.tensors
        return Problem(inputs[first::step], *(t[..., first::step] for t in rest))

    @cached_property
    def curvature(self) -> Tensor:
        """[N, 3 V + S] second derivatives of half a ray's loss by its outputs: AA, AB, BB of a vector; each scalar."""
        pairs = ((self.p, self.p), (self.p, self.u), (self.u, self.u))
        dots = torch.stack([(a * b).sum(1) for a, b in pairs], 1)  # [1 or V, 3, N]
        vectors = (self.vector_weights**2)[:, None] * dots
        return torch.cat([vectors.flatten(0, 1), self.scalar_weights**2]).T.contiguous()

    @cached_property
    def pull(self) -> Tensor:
        """[N, rows] the slope of half a ray's loss at outputs of zero, negated."""
        dots = torch.stack([(self.vectors * self.p).sum(1), (self.vectors * self.u).sum(1)], 1)  # [V, 2, N]
        vectors = (self.vector_weights**2)[:, None] * dots
        return torch.cat([vectors.flatten(0, 1), self.scalar_weights**2 * self.scalars]).T.contiguous()

    @cached_property
    def ridge(self) -> Tensor:
        """[V + S] penalty on the squared last-layer weights of each vector and scalar."""
        vectors = self.curvature[:, : 3 * len(self.vectors)].sum(0).reshape(-1, 3)[:, ::2].mean(1)
        # The tiny constant keeps an output that no ray weighs solvable (as zero).
        return _RIDGE * torch.cat([vectors, self.curvature[:, 3 * len(self.vectors) :].sum(0)]) + 1e-30

    def loss(self, outputs: Tensor) -> float:
        """Mean weighted squared residual of outputs [N, rows]."""
        n = 2 * len(self.vectors)
        ab = outputs[:, :n].T.reshape(-1, 2, 1, len(self))
        error = (ab[:, 0] * self.p + ab[:, 1] * self.u - self.vectors) * self.vector_weights[:, None]
        scalar = (outputs[:, n:].T - self.scalars) * self.scalar_weights
        return float((error**2).sum() + (scalar**2).sum()) / len(self)


@dataclass(frozen=True)
class Projection:
    """Hidden layers with their best last layer.

    Attributes:
        hidden: [units, inputs + 1] of each layer, bias last.
        output: [rows, units + 1].
        factors: Cholesky factors of the last layer's normal equations, one a vector and one a scalar.
        outputs: [N, rows].
        loss: mean weighted squared residual with the ridge.
    """

    hidden: list[Tensor]
    output: Tensor
    factors: list[Tensor]
    outputs: Tensor
    loss: float


def activations(hidden: list[Tensor], inputs: Tensor) -> list[Tensor]:
    """The inputs and every tanh layer, [N, width + 1] each, with a column of ones for the bias."""
    layers = [_with_ones(inputs)]
    for weight in hidden:
        layers.append(_with_ones(torch.tanh(layers[-1] @ weight.T)))
    return layers


def project(problem: Problem, hidden: list[Tensor]) -> Projection:
    """Solve the last layer for given hidden layers.

    Raises:
        torch.linalg.LinAlgError: where the hidden layers are not finite.
    """
    width = hidden[-1].shape[0] + 1
    count, vectors = problem.curvature.shape[1], len(problem.vectors)
    packed = torch.zeros(count, width * (width + 1) // 2, dtype=torch.float64)
    moments = torch.zeros(problem.rows, width, dtype=torch.float64)
    features = []
    for part in chunks(len(problem)):
        h = activations(hidden, problem.inputs[part])[-1]
        packed += problem.curvature[part].T @ squares(h)
        moments += problem.pull[part].T @ h
        features.append(h)
    grams = unpacked(packed, width)
    output, factors = torch.empty_like(moments), []
    for i, ridge in enumerate(problem.ridge):
        if i < vectors:
            aa, ab, bb = grams[3 * i : 3 * i + 3]
            matrix, rows = torch.cat([torch.cat([aa, ab], 1), torch.cat([ab, bb], 1)]), slice(2 * i, 2 * i + 2)
        else:
            matrix, rows = grams[2 * vectors + i], slice(vectors + i, vectors + i + 1)
        factors.append(torch.linalg.cholesky(matrix + ridge * torch.eye(len(matrix), dtype=torch.float64)))
        output[rows] = torch.cholesky_solve(moments[rows].reshape(-1, 1), factors[-1]).reshape(-1, width)
    outputs = torch.cat(features) @ output.T
    sizes = (output**2).sum(1)
    grouped = torch.cat([sizes[: 2 * vectors].reshape(-1, 2).sum(1), sizes[2 * vectors :]])
    loss = problem.loss(outputs) + float((problem.ridge * grouped).sum()) / len(problem)
    return Projection(hidden, output, factors, outputs, loss)


def chunks(count: int) -> list[slice]:
    return [slice(i, i + _CHUNK) for i in range(0, count, _CHUNK)]


def _with_ones(x: Tensor) -> Tensor:
    return torch.cat([x, torch.ones((len(x), 1), dtype=x.dtype)], 1)


def squares(a: Tensor) -> Tensor:
    """Products of every pair of columns once."""
    i, j = torch.triu_indices(a.shape[1], a.shape[1])
    return a[:, i] * a[:, j]


def unpacked(packed: Tensor, size: int) -> Tensor:
    """[..., size, size] symmetric matrices from their upper triangles [..., size (size + 1) / 2]."""
    i, j = torch.triu_indices(size, size)
    full = torch.empty((*packed.shape[:-1], size, size), dtype=packed.dtype)
    full[..., i, j] = packed
    full[..., j, i] = packed
    return full
