"""Dispersion from n_d and V_d: both come back, and the index falls with wavelength."""

from __future__ import annotations

import pytest
import torch

from neurolens.optics.glass import LINE_C_NM, LINE_D_NM, LINE_F_NM, cauchy_coefficients, index_at


@pytest.mark.parametrize(("n_d", "V_d"), [(1.5168, 64.17), (1.7847, 25.7), (1.9, 20.0), (1.4338, 95.2)])
def test_index_and_abbe_number_come_back(n_d: float, V_d: float) -> None:
    assert index_at(n_d, V_d, LINE_D_NM) == pytest.approx(n_d, rel=1e-15)
    spread = index_at(n_d, V_d, LINE_F_NM) - index_at(n_d, V_d, LINE_C_NM)
    assert (n_d - 1) / spread == pytest.approx(V_d, rel=1e-12)
    wavelength = torch.linspace(380, 780, 100, dtype=torch.float64)
    n = index_at(n_d, V_d, wavelength)
    assert (n[1:] < n[:-1]).all() and (n > 1).all()


def test_unknown_dispersion_is_constant() -> None:
    assert cauchy_coefficients(1.6, None) == (1.6, 0.0)
    assert index_at(1.6, None, 400.0) == index_at(1.6, None, 700.0) == 1.6


def test_cauchy_is_near_the_catalogue_glass() -> None:
    """N-BK7 by Sellmeier's equation (Schott catalogue) at the ends of the visible: within 0.001."""
    b, c = (1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653)
    for wavelength in (404.66, 486.13, 706.52):
        square = (wavelength / 1000) ** 2
        catalogue = (1 + sum(p * square / (square - q) for p, q in zip(b, c, strict=True))) ** 0.5
        assert index_at(1.5168, 64.17, wavelength) == pytest.approx(catalogue, abs=1e-3)
