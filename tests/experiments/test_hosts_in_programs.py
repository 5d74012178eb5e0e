"""One scene by the same rays in our renderer, Mitsuba 3 and NVIDIA Newton; hosts that are not installed are skipped."""

import numpy as np
import pytest

SIZE, SAMPLES = (48, 32), 16


def test_mitsuba_and_our_renderer_see_the_same_by_the_same_rays() -> None:
    pytest.importorskip("mitsuba", reason='needs the extra "mitsuba"')
    from experiments.peers.hosts import here, mitsuba, ours

    if not here("mitsuba"):
        pytest.skip("needs LLVM 17 or later")
    np.testing.assert_allclose(mitsuba(SIZE, SAMPLES, 1, True), ours(SIZE, SAMPLES, 1, True), rtol=1e-3)


def test_newton_sees_the_same_within_noise_and_its_depth_is_ours() -> None:
    pytest.importorskip("newton", reason="needs newton and warp-lang")
    from experiments.peers.hosts import compared, depth_error

    row = next(row for row in compared(SIZE, SAMPLES) if row["host"] == "Newton")
    assert abs(row["apart"] / row["expected"] - 1) < 0.15
    assert abs(row["bias"]) < 4 * row["bias_error"] and abs(row["corners"]) < 4 * row["corners_error"]
    assert depth_error(SIZE)["median_mm"] < 0.01
