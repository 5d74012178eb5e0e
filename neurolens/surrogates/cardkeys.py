"""What the writer and the reader of exported models must agree on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# The metadata entry that holds the card, and the card's own first words.
CARD_KEY = "neurolens"
CARD_KIND, CARD_SCHEMA = "neurolens.lens_model", 1
MAX_CARD = 2**20  # characters; the longest that ships, of a zoom's range, has 64,000

# The entry that holds the coefficients from which the graph was made (`surrogates.stored`).
MODEL_KEY = "neurolens.coefficients"

# Relative slack of a domain's bounds: the rounding of float32 inputs, and no more.
DOMAIN_SLACK = 1.00001

# Transmittance of unpolarised light: with the polarisation that surfaces give to it, or averaged over it at each.
POLARISED, AVERAGED = "polarised", "averaged"


def transmittance_of(card: Mapping[str, Any]) -> str:
    """Which transmittance of unpolarised light a model holds: POLARISED, or AVERAGED where its card states none."""
    return str(card.get("transmittance", AVERAGED))
