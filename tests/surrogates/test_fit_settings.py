"""Settings of a fit: what is too much or too little is refused before anything is computed."""

from __future__ import annotations

import math
from typing import Any

import pytest

from neurolens.base.errors import InputError
from neurolens.surrogates.bases import invariant_exponents, raw_exponents
from neurolens.surrogates.fit import ModelSettings


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("degree", v) for v in (-1, 17, 10**9)),
        *(("terms", v) for v in (0, -3, 2001)),
        *(("partitions", v) for v in (0, 65)),
        *(("units", v) for v in (0, 513)),
        *(("layers", v) for v in (0, 9)),
        *(("steps", v) for v in (0, 10**9)),
        *(("seconds", v) for v in (0.0, -1.0, math.nan)),
    ],
)
def test_numbers_without_bounds_are_refused(field: str, value: Any) -> None:
    with pytest.raises(InputError, match=field):
        ModelSettings(**{field: value})


def test_raw_candidates_are_bounded_by_their_number() -> None:
    with pytest.raises(InputError, match="degree"):
        ModelSettings(basis="raw", degree=12)
    assert len(raw_exponents(ModelSettings(basis="raw", degree=11).degree)) <= 5000
    assert 2 * len(invariant_exponents(ModelSettings(degree=16).degree)) <= 5000
