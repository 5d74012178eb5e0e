"""What each part of our fits is worth: settings that leave one part out, by the name of a table's row.

Each is a change to `ModelSettings`; the benchmark fits it beside the whole and gives the ratio of the errors.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from neurolens.base.errors import InputError
from neurolens.surrogates.fit import ModelSettings


def _frozen(table: dict[str, dict[str, Any]]) -> Mapping[str, Mapping[str, Any]]:
    return MappingProxyType({name: MappingProxyType(changes) for name, changes in table.items()})


# Of method "ols" in the invariants.
POLYNOMIAL_ABLATIONS = _frozen(
    {
        "planes not searched": {"planes": False},
        "candidates do not grow": {"growth": 0},
        "no elimination": {"elimination": False},
        "no replacement": {"replacement": False},
        "position at its first-order weight": {"position_weight": 1.0},
        "no terms for transmittance": {"transmittance_terms": 0},
        "forward selection alone": {"planes": False, "growth": 0, "elimination": False, "replacement": False},
        "matching pursuit": {"method": "omp"},
        "raw monomials": {"basis": "raw", "degree": 5},
    }
)

# Of networks.
NETWORK_ABLATIONS = _frozen(
    {
        "20 steps of training": {"steps": 20},
        "one layer": {"layers": 1},
    }
)


def ablated(settings: ModelSettings, name: str) -> ModelSettings:
    """The settings with one part left out, named for the table.

    Raises:
        InputError: an ablation of neither table, or of the other kind of model.
    """
    known = NETWORK_ABLATIONS if settings.method == "mlp" else POLYNOMIAL_ABLATIONS
    if name not in known:
        raise InputError("ablation", "name", name, f"one of {', '.join(known)}")
    return replace(settings, **known[name], name=f"{settings.label}, {name}")
