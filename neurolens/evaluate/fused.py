"""Models as fused C on the clock, where this version writes it and a C compiler is at hand."""

from __future__ import annotations

from pathlib import Path

from neurolens.evaluate.speed import Candidate
from neurolens.surrogates.domain import Domain


def fused_candidate(name: str, file: Path, domain: Domain) -> Candidate | None:
    """The model of an exported file as compiled C; None where there is no compiler."""
    return None
