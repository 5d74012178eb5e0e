"""Image error: relative MSE on linear radiance, FLIP on a display, and the noise floor of both."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base.errors import InputError, NeurolensError

Image = NDArray[np.float64]

MIN_PAIRS = 4  # with fewer pairs the noise floor is too noisy to divide by
# In the denominator of the relative MSE, squared radiance, so that dark pixels do not dominate the mean.
EPS = 1e-2
# Of visual angle, for FLIP: its authors' default (0.7 m from a 0.7 m wide 4K display).
PIXELS_PER_DEGREE = 67.0
# Of the comparison, as a run's results have them; the exposure is a factor before the sRGB curve.
SETTINGS = {"exposure": 1.0, "pixels_per_degree": PIXELS_PER_DEGREE, "eps": EPS}


def checked_image(image: ArrayLike, name: str) -> Image:
    """`image` as float64 [H, W, 3].

    Raises:
        InputError: another shape, an empty picture, or values that are not finite; `name` names the picture.
    """
    array = np.asarray(image)
    if array.ndim != 3 or array.shape[2] != 3 or array.size == 0:
        raise InputError("image", f"{name}, shape", f"({array.shape})", "[height, width, 3] linear RGB")
    if not np.issubdtype(array.dtype, np.floating):
        raise InputError("image", f"{name}, type", str(array.dtype), "floating-point linear radiance, not 8-bit values")
    array = array.astype(np.float64)
    bad = int(np.count_nonzero(~np.isfinite(array)))
    if bad:
        raise InputError("image", f"{name}, values", f"({bad} values not finite)", "finite linear RGB")
    return array


def _checked_pair(test: ArrayLike, reference: ArrayLike) -> tuple[Image, Image]:
    a, b = checked_image(test, "test"), checked_image(reference, "reference")
    if a.shape != b.shape:
        raise InputError("image", "test, shape", f"({a.shape})", f"the shape of the reference, {b.shape}")
    return a, b


def to_srgb(linear: ArrayLike, exposure: float = 1.0) -> Image:
    """Linear RGB times `exposure`, clipped to [0, 1], through the sRGB curve (IEC 61966-2-1). Any shape."""
    c = np.clip(np.asarray(linear, dtype=np.float64) * exposure, 0.0, 1.0)
    return np.where(c <= 0.0031308, 12.92 * c, 1.055 * c ** (1 / 2.4) - 0.055)


def rel_mse(test: ArrayLike, reference: ArrayLike) -> float:
    """Relative mean squared error on linear radiance: mean over pixels and channels of (a - b)^2 / (b^2 + eps).

    Rousselle, Knaus, Zwicker 2011, "Adaptive sampling and reconstruction using greedy error minimization", with their
    eps = 0.01.

    Args:
        test, reference: [H, W, 3] linear RGB.
    Raises:
        InputError: shapes that differ or are not [H, W, 3]; values that are not finite.
    """
    a, b = _checked_pair(test, reference)
    return float(np.mean((a - b) ** 2 / (b**2 + EPS)))


def flip_map(test: ArrayLike, reference: ArrayLike) -> Image:
    """LDR-FLIP for each pixel, [H, W] in [0, 1]: what an observer sees when flipping between the two pictures.

    Andersson et al. 2020, "FLIP: a difference evaluator for alternating images", through their `flip-evaluator`.
    Linear RGB goes through `to_srgb`; the viewing distance is that of `PIXELS_PER_DEGREE`.

    Raises:
        InputError: as `rel_mse`.
        NeurolensError: flip-evaluator is not installed.
    """
    a, b = _checked_pair(test, reference)
    try:
        import flip_evaluator
    except ImportError as error:
        raise NeurolensError(
            "FLIP needs flip-evaluator: pip install 'neurolens[train]', or '.[train]' in a checkout"
        ) from error
    shown_a, shown_b = (np.ascontiguousarray(to_srgb(x), dtype=np.float32) for x in (a, b))
    options = {"applyMagma": False, "computeMeanError": False, "parameters": {"ppd": PIXELS_PER_DEGREE}}
    errors, _, _ = flip_evaluator.evaluate(shown_b, shown_a, "LDR", **options)
    return np.asarray(errors, dtype=np.float64).reshape(a.shape[:2])


def flip(test: ArrayLike, reference: ArrayLike) -> float:
    """Mean of `flip_map`: 0 for equal pictures, 1 at most."""
    return float(flip_map(test, reference).mean())


def seed_pairs(count: int) -> list[tuple[int, int]]:
    """(i, j) with j the next render in a ring: every render is once the test and once the reference, never with itself.

    Raises:
        InputError: fewer than MIN_PAIRS renders.
    """
    if count < MIN_PAIRS:
        raise InputError("image", "renders of different seeds", count, f"at least {MIN_PAIRS}, for {MIN_PAIRS} pairs")
    return [(i, (i + 1) % count) for i in range(count)]


@dataclass(frozen=True)
class ImageErrors:
    """Errors of a camera's renders: means over `pairs` pairs, the noise floor over all pairs of exact renders.

    Attributes:
        flip_paired: against the exact render of the same random numbers, where most noise cancels: what the camera
            itself changes, and the one to judge it by.
        flip, rel_mse: against an exact render of another seed, noise included.
        paired_share: of the noise floor; None where that is 0.
    """

    flip_paired: float
    paired_share: float | None
    flip: float
    rel_mse: float
    noise_floor_flip: float
    noise_floor_rel_mse: float
    pairs: int


def compare(renders: Sequence[ArrayLike], exact_renders: Sequence[ArrayLike]) -> ImageErrors:
    """Error of a surrogate's renders against exact ones, beside the noise floor.

    Render i of the surrogate is compared with exact render i, whose random numbers it shares (paired), and with exact
    render j != i of `seed_pairs`, as two independent renders differ. The floor is exact i against the same exact j.

    Args:
        renders: one or more [H, W, 3] linear renders; number i has the seed of exact render i.
        exact_renders: at least four, and at least as many as `renders`.

    Raises:
        InputError: too few renders, or pictures that do not fit each other.
    """
    ring = seed_pairs(len(exact_renders))
    if not (1 <= len(renders) <= len(ring)):
        raise InputError("image", "surrogate renders", len(renders), f"1 to {len(ring)}, one for each exact render")

    def errors(tests: Sequence[ArrayLike], measure: Callable[..., float]) -> list[float]:
        """Compare each pair (i, j): test render i against exact render j."""
        return [measure(tests[i], exact_renders[j]) for i, j in ring[: len(tests)]]

    floor = float(np.mean(errors(exact_renders, flip)))
    paired = float(np.mean([flip(a, b) for a, b in zip(renders, exact_renders, strict=False)]))
    return ImageErrors(
        flip_paired=paired,
        paired_share=paired / floor if floor > 0 else None,
        flip=float(np.mean(errors(renders, flip))),
        rel_mse=float(np.mean(errors(renders, rel_mse))),
        noise_floor_flip=floor,
        noise_floor_rel_mse=float(np.mean(errors(exact_renders, rel_mse))),
        pairs=len(renders),
    )
