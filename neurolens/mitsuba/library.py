"""The one place that imports Mitsuba and Dr.Jit, and says what is missing where it cannot."""

from __future__ import annotations

import importlib
from functools import cache
from typing import Any

from neurolens.base.errors import InputError, NeurolensError

DEFAULT_VARIANT = "llvm_ad_spectral"


def libraries() -> tuple[Any, Any]:
    """The modules mitsuba and drjit; what Mitsuba offers depends on its variant, so that no type describes it.

    Raises:
        NeurolensError: they are not installed.
    """
    try:
        return importlib.import_module("mitsuba"), importlib.import_module("drjit")
    except ImportError as error:
        raise NeurolensError(
            f"Mitsuba 3 cannot be imported ({error}): pip install '.[mitsuba]' in the project's folder"
        ) from None


def require_mitsuba(variant: str | None = None) -> Any:
    """The module mitsuba with a variant set: `variant`, else the one that is set already, else llvm_ad_spectral.

    Raises:
        NeurolensError: Mitsuba is not installed, or the variant's compiler (LLVM, CUDA) is missing.
        InputError: a variant that this Mitsuba does not have, or one that carries neither RGB nor plain spectra.
    """
    mi, _ = libraries()
    wanted = variant or mi.variant() or DEFAULT_VARIANT
    known = [v for v in mi.variants() if v.endswith(("_rgb", "_spectral"))]
    if wanted not in known:
        raise InputError("mitsuba", "variant", wanted, f"one of: {', '.join(known)}")
    try:
        if mi.variant() != wanted:
            mi.set_variant(wanted)
        if not wanted.startswith("scalar"):
            _compile(wanted)
    except Exception as error:  # the library's own kinds
        reason = " ".join(str(error).split())[:200]
        needed = "libLLVM" if wanted.startswith("llvm") else "CUDA"
        raise NeurolensError(f"mitsuba variant {wanted}: no {needed} ({reason}); a scalar variant needs none") from None
    return mi


@cache
def _compile(variant: str) -> None:
    """One small kernel: a missing LLVM shows only when the first is made."""
    mi, dr = libraries()
    dr.eval(mi.Float(dr.arange(mi.UInt32, 2)) + 1)
