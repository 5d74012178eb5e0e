"""Forbes's aspheres against their definitions in 50 digits: orthogonality, sag, and what powers cannot follow."""

import math

import pytest

from neurolens.optics.lens.figures import MOST_Q_TERMS, Qcon
from neurolens.optics.readers.forbes import CLOSE_MM, _qbfs_sum, qbfs_terms

mpmath = pytest.importorskip("mpmath")
mp = mpmath.mp.clone()
mp.dps = 50


def sag(terms: tuple[tuple[int, float], ...], h: float) -> float:
    return math.fsum(a * h**p for p, a in terms)


@pytest.mark.parametrize("rim", [5.0, 5.4])
def test_qcon_is_its_jacobi_polynomial(rim: float) -> None:
    a = [0.3, -0.05, 0.02, -7e-3, 1e-3, 2e-4]
    terms = Qcon(qcon=tuple(a), norm_mm=5.0).powers
    assert [p for p, _ in terms] == list(range(4, 16, 2))
    for k in range(11):
        h = rim * k / 10
        u2 = (mp.mpf(h) / 5) ** 2
        exact = u2**2 * sum(mp.mpf(c) * mp.jacobi(m, 0, 4, 2 * u2 - 1) for m, c in enumerate(a))
        assert abs(sag(terms, h) - float(exact)) < 1e-14


def _qbfs(m: int):  # type: ignore[no-untyped-def]
    """Qbfs_m as a polynomial, from the unit vectors of the sum."""
    coefficients = [mp.mpf(str(c)) for c in _qbfs_sum([0.0] * m + [1.0]).coef]
    return lambda x: sum(c * x**k for k, c in enumerate(coefficients))


def test_qbfs_begins_as_published() -> None:
    """1, (13 - 16 x) / sqrt 19, sqrt(2 / 95) (29 - 4 x (25 - 19 x)): the first three of the paper of 2007."""
    for x in (0.0, 0.25, 1.0):
        assert abs(_qbfs(0)(x) - 1) < 1e-24
        assert abs(_qbfs(1)(x) - (13 - 16 * mp.mpf(x)) / mp.sqrt(19)) < 1e-24
        exact = mp.sqrt(mp.mpf(2) / 95) * (29 - 4 * mp.mpf(x) * (25 - 19 * mp.mpf(x)))
        assert abs(_qbfs(2)(x) - exact) < 1e-24


def test_slopes_of_qbfs_are_orthonormal() -> None:
    """Mean of the products of d/du [u^2 (1 - u^2) Q_m(u^2)] with the weight 2 / (pi sqrt(1 - u^2)) on [0, 1]."""

    def slope(m: int, u):  # type: ignore[no-untyped-def]
        return mp.diff(lambda v: v**2 * (1 - v**2) * _qbfs(m)(v**2), u)

    # Gauss and Chebyshev's rule: exact for polynomials.
    points = [mp.cos((2 * k + 1) * mp.pi / 32) for k in range(16)]
    table = [[slope(m, u) for u in points] for m in range(5)]
    for i in range(5):
        for k in range(5):
            mean = sum(p * q for p, q in zip(table[i], table[k], strict=True)) / 16
            assert abs(mean - (i == k)) < 1e-15


@pytest.mark.parametrize(("curvature", "rim"), [(0.0, 10.0), (0.02, 10.0), (-0.05, 10.0), (0.06, 10.0), (0.04, 11.0)])
def test_qbfs_sag(curvature: float, rim: float) -> None:
    a = [0.12, -0.03, 4e-3, 1e-3]
    terms = qbfs_terms(a, 10.0, curvature, rim)
    for k in range(21):
        h = mp.mpf(rim) * k / 20
        u2 = (h / 10) ** 2
        form = u2 * (1 - u2) * sum(mp.mpf(c) * _qbfs(m)(u2) for m, c in enumerate(a))
        exact = form / mp.sqrt(1 - (mp.mpf(curvature) * h) ** 2)
        assert abs(sag(terms, float(h)) - float(exact)) < 3 * CLOSE_MM


def test_what_powers_cannot_follow_is_refused() -> None:
    with pytest.raises(ValueError, match="a conic that powers"):
        qbfs_terms([0.1, 0.01], 10.0, 0.0985, 10.0)
    with pytest.raises(ValueError, match="inside the conic"):
        qbfs_terms([0.1], 10.0, 0.1, 10.0)
    with pytest.raises(ValueError, match="fewer terms"):
        qbfs_terms([10.0] * MOST_Q_TERMS, 10.0, 0.0, 10.0)
