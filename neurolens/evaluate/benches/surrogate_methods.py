"""The rows of the benchmark of surrogates: first order, published methods, ours, and ablations of ours."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import get_args

from neurolens.base.errors import InputError
from neurolens.surrogates.fit import ModelSettings
from neurolens.surrogates.fits.ablations import NETWORK_ABLATIONS, POLYNOMIAL_ABLATIONS, ablated
from neurolens.surrogates.precision import Precision
from neurolens.surrogates.published import PUBLISHED

GROUPS = {
    "paraxial": "what renderers use today",
    "published": "published methods, as their papers have them",
    "ours": "this project's",
    "ablations": "ours with one thing changed",
}
DEFAULT_GROUPS = ("paraxial", "published", "ours")


@dataclass(frozen=True)
class Row:
    """One method with its settings.

    Attributes:
        name: of the table's row and of files.
        group: of `GROUPS`.
        settings: of the fit.
        source: the paper, or what an ablation changes.
        weights: how a network's weights are stored in the file, where not in float32.
    """

    name: str
    group: str
    settings: ModelSettings
    source: str = ""
    weights: Precision | None = None


def _ours() -> tuple[ModelSettings, ...]:
    polynomials = tuple(ModelSettings("ols", terms=terms) for terms in (20, 40, 64, 100))
    networks = tuple(ModelSettings("mlp", units=n, layers=k) for n, k in ((8, 1), (10, 1), (8, 2), (16, 2), (32, 2)))
    return *polynomials, *networks, *(ModelSettings("ols+mlp", terms=n, units=u) for n, u in ((40, 8), (64, 16)))


def _ablations() -> Iterator[Row]:
    """Our polynomial of 64 terms and our network with one part left out."""
    for whole, parts in (
        (ModelSettings("ols", terms=64), POLYNOMIAL_ABLATIONS),
        (ModelSettings("mlp"), NETWORK_ABLATIONS),
    ):
        for text in parts:
            name = f"{whole.label}-{text.replace(' ', '-')}"
            yield Row(name, "ablations", replace(ablated(whole, text), name=name), text)


@cache
def all_rows() -> tuple[Row, ...]:
    """Every row that this version can fit, group by group."""
    rows = [Row(name, "paraxial", ModelSettings(name)) for name in ("thin", "thick")]
    for method in PUBLISHED.values():
        rows += [Row(s.label, "published", s, method.citation) for s in method.presets]
    rows += [Row(s.label, "ours", s) for s in _ours()]
    network = ModelSettings("mlp")
    rows += [Row(f"{network.label}-{p}", "ours", network, weights=p) for p in get_args(Precision)]
    return tuple([*rows, *_ablations()])


def chosen_rows(names: Sequence[str]) -> tuple[Row, ...]:
    """Rows by name, by group, or by method ("ols", "schrade"; without ablations); none named: all but the ablations.

    Raises:
        InputError: a name that is none of these.
    """
    rows, wanted = all_rows(), names or DEFAULT_GROUPS
    picked: dict[str, Row] = {}
    for name in wanted:
        found = [r for r in rows if name in (r.name, r.group) or (name == r.settings.method and r.group != "ablations")]
        if not found and name not in GROUPS:
            known = ", ".join((*GROUPS, *(r.name for r in rows)))
            raise InputError("neurolens bench surrogates", "--methods", name, f"one of: {known}")
        picked |= {r.name: r for r in found}
    return tuple(picked.values())
