"""Image error: relative MSE on linear radiance, FLIP on a display, and the noise floor of both."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base.errors import InputError, NeurolensError

Image = NDArray[np.float64]

MIN_PAIRS = 4  # with fewer pairs the noise floor is too noisy to divide by
EPS = 1e-2  # squared radiance in the denominator of the relative MSE: dark pixels do not dominate the mean
PIXELS_PER_DEGREE = 67.0  # of FLIP, its authors' default: 0.7 m from a 0.7 m wide 4K display
# Settings of the comparison for a run's results; the exposure is a factor before the sRGB curve.
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
    pictures = (np.ascontiguousarray(to_srgb(x), dtype=np.float32) for x in (b, a))
    options = {"applyMagma": False, "computeMeanError": False, "parameters": {"ppd": PIXELS_PER_DEGREE}}
    errors, _, _ = flip_evaluator.evaluate(*pictures, "LDR", **options)
    return np.asarray(errors, dtype=np.float64).reshape(a.shape[:2])


def flip(test: ArrayLike, reference: ArrayLike) -> float:
    """Mean of `flip_map`: 0 for equal pictures, 1 at most."""
    return float(flip_map(test, reference).mean())


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
    render i + 1 (the last with the first), as two independent renders differ. The floor is exact i against that one.

    Args:
        renders: one or more [H, W, 3] linear renders; number i has the seed of exact render i.
        exact_renders: at least four, and at least as many as `renders`.

    Raises:
        InputError: too few renders, or pictures that do not fit each other.
    """
    count = len(exact_renders)
    if count < MIN_PAIRS:
        raise InputError("image", "renders of different seeds", count, f"at least {MIN_PAIRS}, for {MIN_PAIRS} pairs")
    if not (1 <= len(renders) <= count):
        raise InputError("image", "surrogate renders", len(renders), f"1 to {count}, one for each exact render")
    others = [*exact_renders[1:], exact_renders[0]]

    def mean(measure: Callable[..., float], tests: Sequence[ArrayLike], references: Sequence[ArrayLike]) -> float:
        return float(np.mean([measure(a, b) for a, b in zip(tests, references, strict=False)]))

    floor, paired = mean(flip, exact_renders, others), mean(flip, renders, exact_renders)
    return ImageErrors(
        flip_paired=paired,
        paired_share=paired / floor if floor > 0 else None,
        flip=mean(flip, renders, others),
        rel_mse=mean(rel_mse, renders, others),
        noise_floor_flip=floor,
        noise_floor_rel_mse=mean(rel_mse, exact_renders, others),
        pairs=len(renders),
    )
