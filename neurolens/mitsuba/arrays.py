"""Numbers of Mitsuba to numpy and back, in scalar and in compiled variants."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.mitsuba.library import libraries


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
