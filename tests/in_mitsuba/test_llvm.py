"""What is said of the LLVM that Dr.Jit finds, without Mitsuba."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from neurolens.base.errors import NeurolensWarning
from neurolens.mitsuba import library


@pytest.mark.parametrize("version", [(15, 0, 6), (-1, -1, -1)])
def test_an_llvm_too_old_is_named_with_the_variant_that_works(
    version: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """LLVM 15 would end the process: the default variant becomes one that needs none; one asked for is kept."""
    taken: list[str] = []
    mi = SimpleNamespace(
        variant=lambda: None, variants=lambda: ["scalar_spectral", "llvm_ad_spectral"], set_variant=taken.append
    )
    dr = SimpleNamespace(detail=SimpleNamespace(llvm_version=lambda: version))
    monkeypatch.setattr(library, "libraries", lambda: (mi, dr))
    monkeypatch.setattr(library, "_compile", lambda variant: None)
    with pytest.warns(NeurolensWarning, match="LLVM.*19 works.*variant scalar_spectral needs none and is taken"):
        library.require_mitsuba()
    with pytest.warns(NeurolensWarning, match="variant scalar_spectral needs none$"):
        library.require_mitsuba("llvm_ad_spectral")
    assert taken == ["scalar_spectral", "llvm_ad_spectral"]
