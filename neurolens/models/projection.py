"""Networks by variable projection (Golub and Pereyra 1973) and Levenberg-Marquardt.

The outputs of a network are linear in its last layer, so for given hidden layers the best last layer is a linear
least-squares problem, solved exactly. What is left is a problem in the hidden weights alone, of which Gauss-Newton
takes the Schur complement of the normal equations (Kaufman 1975 drops the same second-order term).

The normal equations never need the Jacobian: for one ray, the block of layers k and m is a Kronecker product of a small
matrix of sensitivities with the products of their inputs, so that the sum over rays is one matrix product. A step of
1600 weights on 12,000 rays and twelve outputs takes well under a second on one core.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property

import torch
from torch import Tensor

# Rays per chunk: the products of one chunk stay within a few megabytes.
_CHUNK = 512
# Penalty on the squares of the last layer, relative to a feature that is 1 on every ray. 1e-12 is the square of about
# ten roundings of float32: weights cannot grow to where the rounding of float32 evaluation would count.
_RIDGE = 1e-12
# Damping to start from, and at which no step helps any more; both relative to the diagonal.
_DAMPING_START, _DAMPING_END = 1e-2, 1e6

Progress = Callable[[float], None]


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
        """Return the number of outputs of the network: A and B of each vector, then the scalars."""
        return 2 * len(self.vectors) + len(self.scalars)

    @property
    def tensors(self) -> list[Tensor]:
        """Return all the data, in the order of the fields."""
        return [getattr(self, f.name) for f in fields(self)]

    def every(self, step: int, first: int = 0) -> Problem:
        """Return every `step`-th ray, beginning with `first`."""
        inputs, *rest = self.tensors
        return Problem(inputs[first::step], *(t[..., first::step] for t in rest))

    @cached_property
    def curvature(self) -> Tensor:
        """Return the second derivatives of half a ray's loss by its outputs, [N, 3 V + S].

        They are AA, AB, BB of each of V vectors, then one of each of S scalars.
        """
        pairs = ((self.p, self.p), (self.p, self.u), (self.u, self.u))
        dots = torch.stack([(a * b).sum(1) for a, b in pairs], 1)  # [1 or V, 3, N]
        vectors = (self.vector_weights**2)[:, None] * dots
        return torch.cat([vectors.flatten(0, 1), self.scalar_weights**2]).T.contiguous()

    @cached_property
    def pull(self) -> Tensor:
        """Return the negated slope of half a ray's loss where all outputs are zero, [N, rows]."""
        dots = torch.stack([(self.vectors * self.p).sum(1), (self.vectors * self.u).sum(1)], 1)  # [V, 2, N]
        vectors = (self.vector_weights**2)[:, None] * dots
        return torch.cat([vectors.flatten(0, 1), self.scalar_weights**2 * self.scalars]).T.contiguous()

    @cached_property
    def ridge(self) -> Tensor:
        """Return the penalty [V + S] on the squared last-layer weights of each vector and scalar."""
        vectors = self.curvature[:, : 3 * len(self.vectors)].sum(0).reshape(-1, 3)[:, ::2].mean(1)
        # The tiny constant keeps an output that no ray weighs solvable (as zero).
        return _RIDGE * torch.cat([vectors, self.curvature[:, 3 * len(self.vectors) :].sum(0)]) + 1e-30

    def loss(self, outputs: Tensor) -> float:
        """Return the mean weighted squared residual of outputs [N, rows]."""
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
    """Return the inputs and every tanh layer, [N, width + 1] each, with a column of ones for the bias."""
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
    for part in _chunks(len(problem)):
        h = activations(hidden, problem.inputs[part])[-1]
        packed += problem.curvature[part].T @ _squares(h)
        moments += problem.pull[part].T @ h
        features.append(h)
    grams = _unpacked(packed, width)
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


def _chunks(count: int) -> list[slice]:
    return [slice(i, i + _CHUNK) for i in range(0, count, _CHUNK)]


def _with_ones(x: Tensor) -> Tensor:
    return torch.cat([x, torch.ones((len(x), 1), dtype=x.dtype)], 1)


def _squares(a: Tensor) -> Tensor:
    """Return the product of every pair of columns, once."""
    i, j = torch.triu_indices(a.shape[1], a.shape[1])
    return a[:, i] * a[:, j]


def _unpacked(packed: Tensor, size: int) -> Tensor:
    """Return [..., size, size] symmetric matrices from their upper triangles [..., size (size + 1) / 2]."""
    i, j = torch.triu_indices(size, size)
    full = torch.empty((*packed.shape[:-1], size, size), dtype=packed.dtype)
    full[..., i, j] = packed
    full[..., j, i] = packed
    return full


@dataclass(frozen=True)
class OptimiserState:
    """Where the optimiser stands; from here it goes on to the very same bits.

    Attributes:
        hidden: [units, inputs + 1] of each layer.
        damping, growth: the damping of the next step, and the factor on it if that step does not help.
    """

    hidden: list[Tensor]
    damping: float = _DAMPING_START
    growth: float = 2.0

    @property
    def stuck(self) -> bool:
        """Whether no step helps any more."""
        return self.damping >= _DAMPING_END


def minimise(
    problem: Problem, start: OptimiserState, steps: int, progress: Progress = lambda share: None
) -> tuple[Projection, OptimiserState]:
    """Minimise over the hidden weights by Levenberg and Marquardt's method, with damping by Nielsen (1999).

    Args:
        steps: steps tried; fewer when the loss no longer falls.
        progress: called with the share of the steps done.
    """
    best, damping, growth, taken = project(problem, start.hidden), start.damping, start.growth, 0
    system = None
    while taken < steps and damping < _DAMPING_END:
        if system is None:
            system = normal_equations(problem, best)
        matrix, gradient, diagonal = system
        factor, failed = torch.linalg.cholesky_ex(matrix + torch.diag(damping * diagonal))
        if failed:
            damping *= 4
            continue
        step = -torch.cholesky_solve(gradient[:, None], factor)[:, 0]
        expected = -float(2 * (step @ gradient) + step @ matrix @ step) / len(problem)
        taken += 1
        parts = torch.split(step, [w.numel() for w in best.hidden])
        trial = _try(problem, [w + s.reshape(w.shape) for w, s in zip(best.hidden, parts, strict=True)])
        if trial is not None and trial.loss < best.loss:
            gain = (best.loss - trial.loss) / expected
            best, system = trial, None
            damping, growth = max(damping * max(0.1, 1 - (2 * min(gain, 1.0) - 1) ** 3), 1e-13), 2.0
        else:
            damping, growth = damping * growth, 2 * growth
        progress(taken / steps)
    return best, OptimiserState(best.hidden, damping, growth)


def _try(problem: Problem, hidden: list[Tensor]) -> Projection | None:
    try:
        return project(problem, hidden)
    except torch.linalg.LinAlgError:
        return None  # A step so long that the features are no longer finite: rejected like one that helps nothing.


def normal_equations(problem: Problem, at: Projection) -> tuple[Tensor, Tensor, Tensor]:
    """Return the Gauss-Newton equations of half the summed loss, with the last layer eliminated.

    Returns the matrix [P, P] and the gradient [P] in the hidden weights, layer by layer, and the matrix's diagonal [P]
    before elimination, by which damping is scaled.
    """
    depth = len(at.hidden)
    shapes = [tuple(w.shape) for w in (*at.hidden, at.output)]
    sums: dict[tuple[int, int], Tensor] = {}
    gradient = [torch.zeros_like(w) for w in at.hidden]
    for part in _chunks(len(problem)):
        layers = activations(at.hidden, problem.inputs[part])
        slopes, sensitivities = _sensitivities(problem, at, part, layers)
        for k in range(depth):
            gradient[k] += slopes[k].T @ layers[k]
        for (k, m), s in sensitivities.items():
            total = (
                _symmetric(s).T @ _squares(layers[k]) if k == m else s.flatten(1).T @ _products(layers[k], layers[m])
            )
            sums[k, m] = sums[k, m] + total if (k, m) in sums else total
    blocks = {(k, m): _block(total, shapes[k], shapes[m]) for (k, m), total in sums.items()}
    rows = [torch.cat([blocks[k, m] if k <= m else blocks[m, k].T for m in range(depth)], 1) for k in range(depth)]
    matrix, coupling = torch.cat(rows), torch.cat([blocks[k, depth] for k in range(depth)])
    diagonal = torch.diagonal(matrix).clone()
    # An input that never changes (the wavelength of a lens without dispersion) has no slope; the floor keeps it still.
    diagonal = diagonal.clamp_min(1e-12 * float(diagonal.max()) + 1e-30)
    start = 0
    for factor in at.factors:
        columns = coupling[:, start : start + len(factor)]
        eliminated = torch.linalg.solve_triangular(factor, columns.T, upper=False)
        matrix -= eliminated.T @ eliminated
        start += len(factor)
    return matrix, torch.cat([g.reshape(-1) for g in gradient]), diagonal


def _sensitivities(
    problem: Problem, at: Projection, part: slice, layers: list[Tensor]
) -> tuple[list[Tensor], dict[tuple[int, int], Tensor]]:
    """Backpropagation for a chunk of n rays, by the sums that enter each tanh layer.

    Returns the slopes of half the loss [n, units] of each hidden layer, and J_k^T H J_m [n, units_k, units_m] of layers
    k <= m, where the layer after the last hidden one is the output; H is the second derivative by the outputs.
    """
    depth, vectors = len(at.hidden), len(problem.vectors)
    weights = [w[:, :-1] for w in (*at.hidden, at.output)]
    last, curvature = weights[depth], problem.curvature[part]
    aa, ab, bb = (curvature[:, i : 3 * vectors : 3, None] for i in range(3))
    scalar = curvature[:, 3 * vectors :, None]
    a, b, c = last[0 : 2 * vectors : 2], last[1 : 2 * vectors : 2], last[2 * vectors :]
    # H times the last layer: [n, rows, units].
    heavy = torch.cat([torch.stack([aa * a + ab * b, ab * a + bb * b], 2).flatten(1, 2), scalar * c], 1)
    ya, yb = at.outputs[part, 0 : 2 * vectors : 2], at.outputs[part, 1 : 2 * vectors : 2]
    y = torch.stack([aa[..., 0] * ya + ab[..., 0] * yb, ab[..., 0] * ya + bb[..., 0] * yb], 2).flatten(1)
    slope = torch.cat([y, scalar[..., 0] * at.outputs[part, 2 * vectors :]], 1) - problem.pull[part]
    bends = [1 - h[:, :-1] ** 2 for h in layers[1:]]
    slopes: list[Tensor] = [torch.empty(0)] * depth
    table: dict[tuple[int, int], Tensor] = {}
    for k in range(depth - 1, -1, -1):
        slope = slopes[k] = (slope @ weights[k + 1]) * bends[k]
        bend = bends[k][:, :, None]
        table[k, depth] = (
            heavy.transpose(1, 2) * bend if k == depth - 1 else (weights[k + 1].T @ table[k + 1, depth]) * bend
        )
        for m in range(depth - 1, k, -1):
            table[k, m] = (weights[k + 1].T @ table[k + 1, m]) * bend
        below = table[k, depth] if k == depth - 1 else table[k, k + 1]
        table[k, k] = (below @ weights[k + 1]) * bends[k][:, None]
    return slopes, table


def _products(a: Tensor, b: Tensor) -> Tensor:
    return (a[:, :, None] * b[:, None]).flatten(1)


def _symmetric(a: Tensor) -> Tensor:
    """Return the upper triangles of matrices [n, k, k]."""
    i, j = torch.triu_indices(a.shape[1], a.shape[1])
    return a[:, i, j]


def _block(total: Tensor, left: tuple[int, ...], right: tuple[int, ...]) -> Tensor:
    """Return the block of the normal equations between two layers of shapes (units, inputs), from its sums over rays.

    `total` is [unit pairs, input pairs], in upper triangles where both layers are the same.
    """
    if total.shape[0] < left[0] * right[0] or total.shape[1] < left[1] * right[1]:
        total = _unpacked(_unpacked(total, left[1]).flatten(1).T, left[0]).flatten(1).T
    four = total.reshape(left[0], right[0], left[1], right[1])
    return four.permute(0, 2, 1, 3).reshape(left[0] * left[1], right[0] * right[1])
