"""A kernel beside the path-traced picture of a small ball that shines, as `python -m experiments defocus --checks`."""

from __future__ import annotations

import pytest

from experiments.pictures.defocus import point_light
from neurolens.graph.compiler import has_compiler


@pytest.mark.skipif(not has_compiler(), reason="kernels take a C compiler")
def test_a_kernel_is_the_render_of_a_point_of_light() -> None:
    pytest.importorskip("flip_evaluator")
    found = point_light(12.0, 0.8, samples=2048)
    # The noise of few samples adds to the goals of the command, FLIP 0.02 and 1%.
    assert found["flip"] < 0.025 and abs(found["area"]) < 0.015 and abs(found["light"]) < 0.01
