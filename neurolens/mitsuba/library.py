"""Import of Mitsuba and Dr.Jit, and conversion of their arrays to numpy and back, in scalar and compiled variants."""

from __future__ import annotations

import importlib
import warnings
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError, NeurolensError, NeurolensWarning
from neurolens.cameras.contract import FloatArray

DEFAULT_VARIANT, WITHOUT_LLVM = "llvm_ad_spectral", "scalar_spectral"
# LLVM 15 and 16, which Dr.Jit takes, abort the process on Mitsuba's kernels (seen with AVX-512); 19 works.
_OLDEST_LLVM = 17


def libraries() -> tuple[Any, Any]:
    """The modules mitsuba and drjit, untyped: what Mitsuba has depends on its variant.

    NeurolensError: they are not installed.
    """
    try:
        return importlib.import_module("mitsuba"), importlib.import_module("drjit")
    except ImportError as error:
        raise NeurolensError(
            f"Mitsuba 3 cannot be imported ({error}): pip install 'neurolens[mitsuba]', or '.[mitsuba]' in a checkout"
        ) from None


def require_mitsuba(variant: str | None = None) -> Any:
    """The module mitsuba with a variant set: `variant`, else the current one, else llvm_ad_spectral.

    Warns:
        NeurolensWarning: no LLVM, or one so old that compiled variants may end the process; where no variant was asked
            for, scalar_spectral is taken in its place.

    Raises:
        NeurolensError: Mitsuba is not installed, or the variant's compiler (LLVM, CUDA) is missing.
        InputError: a variant that this Mitsuba does not have, or one that carries neither RGB nor plain spectra.
    """
    mi, dr = libraries()
    wanted = variant or mi.variant() or DEFAULT_VARIANT
    if wanted.startswith("llvm") and (doubt := _llvm_doubt(dr)):
        asked = variant or mi.variant()
        told = f"{doubt}; the variant {WITHOUT_LLVM} needs none{'' if asked else ' and is taken'}"
        warnings.warn(told, NeurolensWarning, stacklevel=2)
        wanted = asked or WITHOUT_LLVM
    known = [v for v in mi.variants() if v.endswith(("_rgb", "_spectral"))]
    if wanted not in known:
        raise InputError("mitsuba", "variant", wanted, f"one of: {', '.join(known)}")
    try:
        if mi.variant() != wanted:
            mi.set_variant(wanted)
        if not wanted.startswith("scalar"):
            _compile(wanted)
    except Exception as error:  # the library's exception types
        reason = " ".join(str(error).split())[:200]
        needed = "libLLVM" if wanted.startswith("llvm") else "CUDA"
        raise NeurolensError(f"mitsuba variant {wanted}: no {needed} ({reason}); a scalar variant needs none") from None
    return mi


def _llvm_doubt(dr: Any) -> str:
    """The fault of the LLVM that Dr.Jit loads; empty if it has none."""
    version = dr.detail.llvm_version()
    if version[0] >= _OLDEST_LLVM:
        return ""
    found = (
        f"LLVM {'.'.join(map(str, version))} is too old for Mitsuba"
        if version[0] > 0
        else "Mitsuba found no LLVM that it takes"
    )
    return f"{found} (19 works; DRJIT_LIBLLVM_PATH names the library)"


@cache
def _compile(variant: str) -> None:
    """Compile one small kernel: a missing LLVM is detected only then."""
    mi, dr = libraries()
    dr.eval(mi.Float(dr.arange(mi.UInt32, 2)) + 1)


def rows(*values: Any) -> FloatArray:
    """Numbers of the current variant, one wide or N, as [len(values), N] float32; evaluates them."""
    arrays = [np.atleast_1d(np.asarray(value, np.float32)) for value in values]
    return np.stack(np.broadcast_arrays(*arrays))


def number(values: FloatArray) -> Any:
    """Numbers [N] as the variant's Float; in scalar variants N is 1."""
    mi, dr = libraries()

    return mi.Float(np.ascontiguousarray(values)) if dr.is_jit_v(mi.Float) else float(values[0])


def vector(kind: Any, values: FloatArray) -> Any:
    """Numbers [D, N] as a vector, point, colour or spectrum `kind` of D parts."""
    return kind(*(number(row) for row in values))


def matrix(transform: Any) -> NDArray[np.float64]:
    """A transform of any variant as float64 [4, 4]."""
    return np.array(transform.matrix, np.float64).reshape(4, 4, -1)[..., 0]
