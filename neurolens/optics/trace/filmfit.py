"""What a stack of films transmits as polynomials, for graphs: they take a quarter of the operations of its matrices.

A stack without loss transmits the share 4 q q' / (E + 2 q q') of s, where q and q' are index times cosine on both sides
and E = (a q)^2 + (d q')^2 + (b q q')^2 + c^2 of the matrix [[a, -i b], [-i c, d]], for which a d + b c = 1. Of p it is
the same with q / n^2 in place of q. E is entire in the square of index times sine and in the wavelength, at grazing
light, too, where the share falls to 0 by q q' alone. So polynomials of low degree are close to it at all angles.
"""

from collections.abc import Callable
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from neurolens.optics.lens.glass import index_at
from neurolens.optics.trace.transmission import NO_FILM, times_film

Array = NDArray[np.float64]
Rows = tuple[tuple[float, ...], ...]
FIT = 2e-4  # the error that the mean of the shares of s and p may have, of a light of 1
_NODES, _SIZE = 27, 13  # of either variable; one more than the highest degree


class FilmFit(NamedTuple):
    """Polynomials in x and y, from -1 to 1 over the square of index times sine and over 1 / wavelength.

    Attributes:
        most: the square of index times sine where x is 1.
        both, split: E_s + E_p and E_p - E_s: for each power of x a series in y.
    """

    most: float
    both: Rows
    split: Rows


def inverse_um_at(ends: tuple[float, float]) -> Array:
    """Return the inverse wavelengths (1/um) between `ends` at which `fitted` wants indices."""
    return sum(ends) / 2 + (ends[1] - ends[0]) / 2 * _nodes()


@lru_cache(maxsize=4096)  # equal for all states of a zoom and for surfaces that are coated alike
def fitted(
    layers: Rows, before: tuple[float, ...], after: tuple[float, ...], ends: tuple[float, float]
) -> FilmFit | None:
    """Fit a stack; None where no degrees leave less than `FIT`, as for films many waves thick.

    Args:
        layers: films in the order in which light meets them, as in `prescription.Coating`.
        before, after: indices of the media around them at `inverse_um_at(ends)`.
        ends: range of the inverse wavelength in 1/um.
    """
    inverse_um, n1, n2 = (np.array(v)[:, None] for v in (inverse_um_at(ends), before, after))
    most = float(np.minimum(n1, n2).max()) ** 2
    square = most / 2 * (1 + _nodes())
    q1, q2 = (np.sqrt(np.maximum(n * n - square, 0)) for n in (n1, n2))
    s = p = NO_FILM
    for n_d, thickness_nm, *V_d in layers:
        index = index_at(n_d, V_d[0] if V_d else None, 1000 / inverse_um)
        q = np.emath.sqrt(index * index - square)
        per_q = 2e-3 * np.pi * thickness_nm * inverse_um
        sinc = np.sinc(q * per_q / np.pi).real * per_q
        s, p = times_film(s, p, (np.cos(q * per_q).real, sinc, (q * q).real * sinc), index * index)
    across = _entire(s, q1, q2)
    along = _entire(p, q1 / (n1 * n1), q2 / (n2 * n2)) * (n1 * n2) ** 2
    flux, both, split = 2 * q1 * q2, across + along, along - across
    mean = _mean(both, split, flux)
    fit_both = _least(both, lambda tried: np.abs(tried - both) / (both + 2 * flux))
    fit_split = _least(split, lambda tried: np.abs(_mean(both, tried, flux) - mean))
    return None if fit_both is None or fit_split is None else FilmFit(most, fit_both, fit_split)


def _entire(m: tuple[Any, ...], before: Array, after: Array) -> Array:
    """Return E of a matrix and of the admittances of the media."""
    a, b, c, d = m
    return np.asarray((a * before) ** 2 + (d * after) ** 2 + (b * before * after) ** 2 + c * c)


def _mean(both: Array, split: Array, flux: Array) -> Array:
    """Return the mean of the shares of s and p."""
    total = both + 2 * flux
    return 4 * flux * total / (total * total - split * split)


def _nodes() -> Array:
    return np.asarray(chebyshev.chebpts1(_NODES))


def _least(values: Array, error: Callable[[Array], Array]) -> Rows | None:
    """Return the polynomial of fewest terms that leaves at most `FIT` at the nodes; None where none does."""
    for shape in _shapes():
        basis, solve = _solver(*shape)
        found = solve @ values.reshape(-1)
        if error((basis @ found).reshape(values.shape)).max() <= FIT:
            kept = np.zeros((_SIZE, _SIZE))
            kept[_terms(*shape)] = found
            powers = _POWERS.T @ kept @ _POWERS
            return tuple(tuple(powers[k, : n + 1].tolist()) for k, n in enumerate(_longest(*shape)))
    return None


@cache
def _shapes() -> list[tuple[int, int]]:
    """Return the highest degrees in x and in y of the polynomials that are tried, fewest terms first."""
    pairs = [(a, b) for a in range(1, 9) for b in range(a, min(2 * a, _SIZE - 1) + 1)]
    return [(0, 0), *sorted(pairs, key=lambda pair: sum(n + 1 for n in _longest(*pair)))]


def _longest(most_x: int, most_y: int) -> list[int]:
    """Return the highest degree in y beside each power of x: shares of the degrees add up to at most 1."""
    return [most_y * (most_x - k) // max(most_x, 1) for k in range(most_x + 1)]


def _terms(most_x: int, most_y: int) -> tuple[list[int], list[int]]:
    pairs = [(k, j) for k, n in enumerate(_longest(most_x, most_y)) for j in range(n + 1)]
    return [k for k, _ in pairs], [j for _, j in pairs]


@cache
def _solver(most_x: int, most_y: int) -> tuple[Array, Array]:
    """Return Chebyshev's polynomials of x and y at all nodes, and what solves for them by least squares.

    Errors are weighted as those of the share of light are on bare glass of index 1.65.
    """
    one, square = chebyshev.chebvander(_nodes(), _SIZE - 1), (1 + _nodes()) / 2
    x, y = _terms(most_x, most_y)
    basis = np.einsum("bk,ak->abk", one[:, x], one[:, y]).reshape(-1, len(x))
    q, glass = np.sqrt(1 - square), np.sqrt(1.65**2 - square)
    rows = np.tile(1 / ((q + glass) ** 2 + (1.65 * q + glass / 1.65) ** 2), _NODES)[:, None]
    return basis, np.linalg.pinv(basis * rows) * rows.T


# From Chebyshev's polynomials, by rows, to powers.
_POWERS = np.array([np.pad(chebyshev.cheb2poly(np.eye(_SIZE)[k, : k + 1]), (0, _SIZE - k - 1)) for k in range(_SIZE)])
