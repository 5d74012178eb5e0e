"""Random numbers through an exported model."""

import lens_models
import numpy as np
import pytest

from experiments import outside
from neurolens.base import status as st
from neurolens.cameras.onnxlens import load_model

pytestmark = pytest.mark.whole  # a command of its own


def test_broken_promises_are_counted() -> None:
    """Any bits, NaN, rays just outside: a model keeps its promises; one that passes everything is caught at each."""
    model = load_model(lens_models.exported("invariants"))
    found = outside.send(model, 200_000, seed=7)
    assert found.broken == dict.fromkeys(found.broken, 0) and found.inside > 10_000 and found.passed > 3000
    honest = model.rays

    def liar(*arguments: object) -> object:
        out = honest(*arguments)  # type: ignore[arg-type]
        return out._replace(status=np.full_like(out.status, st.PASSED))

    model.rays = liar  # type: ignore[method-assign, assignment]
    found = outside.send(model, 40_000, seed=7)
    assert found.broken[outside.PASSES_OUTSIDE] > 10_000 and found.broken[outside.NOT_FINITE] > 1000
    assert found.passed == 40_000
