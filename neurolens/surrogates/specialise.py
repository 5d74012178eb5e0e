"""Models that fix what a scene fixes: one wavelength folds every power of w into the coefficients.

For pictures in one colour of light (a laser line, a filter, a measurement at the d line), or one model a channel where
dispersion within a channel does not count. Pictures in white light take the whole model.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurolens.errors import InputError
from neurolens.optics.glass import inverse_square_um
from neurolens.surrogates.cores import InvariantPolynomial, Network, Partitioned, RawPolynomial
from neurolens.surrogates.model import Core, LensModel


def at_wavelength(model: LensModel, wavelength_nm: float) -> LensModel:
    """The same model for one wavelength: smaller and faster. Rays of any other wavelength are outside its domain.

    Raises:
        InputError: a wavelength outside the model's domain, or a model without a wavelength input.
    """
    low, high = model.domain.wavelength_nm
    if model.encoding.w_half == 0:
        raise InputError("at_wavelength", "model", model.method, "a model whose rays depend on the wavelength")
    if not low <= wavelength_nm <= high:
        raise InputError("at_wavelength", "wavelength_nm", wavelength_nm, f"{low:g} to {high:g} nm")
    w = (inverse_square_um(wavelength_nm) - model.encoding.w_middle) / model.encoding.w_half
    return replace(
        model,
        domain=replace(model.domain, wavelength_nm=(wavelength_nm, wavelength_nm)),
        encoding=replace(model.encoding, w_half=0.0),
        core=_fixed(model.core, w),
        settings={**model.settings, "wavelength_nm": wavelength_nm},
    )


def _fixed(core: Core, w: float) -> Any:
    if isinstance(core, InvariantPolynomial):
        exponents, merge = _merge(core.exponents, w)
        return replace(core, exponents=exponents, ab=core.ab @ merge, scalars=core.scalars @ merge)
    if isinstance(core, RawPolynomial):
        exponents, merge = _merge(core.exponents, w)
        return replace(core, exponents=exponents, components=core.components @ merge, scalars=core.scalars @ merge)
    if isinstance(core, Network):
        # With w_half = 0 the network is shown w = 0; its shift makes that the wanted one.
        return replace(core, shift=core.shift - w * torch.tensor([0, 0, 0, 1], dtype=core.shift.dtype))
    if isinstance(core, Partitioned):
        # Zones are split by rho, which no wavelength changes.
        return replace(core, parts=tuple(_fixed(part, w) for part in core.parts))
    raise TypeError(f"no fixed wavelength for a core of type {type(core).__name__}")


def _merge(exponents: NDArray[np.int64], w: float) -> tuple[NDArray[np.int64], Tensor]:
    """Exponents without w, each once, and the matrix [M, M'] that sums the old coefficients into the new."""
    rest = exponents.copy()
    rest[:, -1] = 0
    unique, place = np.unique(rest, axis=0, return_inverse=True)
    merge = np.zeros((len(exponents), len(unique)))
    merge[np.arange(len(exponents)), place.reshape(-1)] = w ** exponents[:, -1].astype(float)
    return unique, torch.from_numpy(merge)
