"""Does a model keep what its card promises? Fresh rays through the exact lens and through the ONNX model itself."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import neurolens
from neurolens.cameras.model import OnnxLens
from neurolens.errors import InputError, NeurolensWarning
from neurolens.evaluate.measure import onnx_predictor
from neurolens.evaluate.rays import ray_errors
from neurolens.evaluate.vignetting import vignetting_errors
from neurolens.optics.lensfile import read_lens
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Lens
from neurolens.surrogates.domain import Domain
from neurolens.surrogates.pairs import PairSettings, make_pairs

# How much worse than promised a figure may be, for the rays are others: relative for errors, and for shares so many
# standard deviations of a count. A largest error has no such bound: more rays find larger ones.
RMS_TOLERANCE, P99_TOLERANCE, SHARE_SIGMAS = 0.10, 0.15, 4.0
_RMS = "rms_um rms_infinity_um rms_px direction_rms_deg position_rms_um transmittance_rms".split()
_P99 = ["p99_um"]
_SHARES = ["false_pass", "false_block"]
# Below this, float32 itself is the error: half a nanometre, a microdegree.
_FLOOR = 5e-7
_FRESH = 7919  # added to the seed of the fit


@dataclass(frozen=True)
class Promise:
    """One figure of a card against fresh rays; `allowed` is the promise with its tolerance, None where it has none."""

    key: str
    promised: float
    measured: float | None
    allowed: float | None

    @property
    def holds(self) -> bool:
        if self.allowed is None:
            return True
        return self.measured is not None and self.measured <= self.allowed  # False for NaN


def check_model(
    model: OnnxLens, lens: Lens, *, rays: int = 30_000, seed: int | None = None
) -> tuple[dict[str, Any], list[Promise]]:
    """Measure a model on rays that it has not seen.

    Args:
        lens: the exact lens, as `lens_of_card` gives it.
        rays: rays that the lens passes; four times as many test what passes and what is blocked.
        seed: None takes one that is not the fit's.

    Returns the figures (`rays.ray_errors`, false_pass and false_block of `vignetting.vignetting_errors`, rays, seed)
        and the promises of the card.

    Warns:
        NeurolensWarning: a seed that is the fit's own.
    """
    card, domain = model.card, Domain.from_dict(model.card["domain"])
    fitted = int(card["fit"]["settings"].get("rays_seed") or 0)
    seed = fitted + _FRESH if seed is None else seed
    if seed == fitted:
        warnings.warn(f"seed {seed} is that of the fit: these rays are not fresh", NeurolensWarning, stacklevel=2)
    pairs = make_pairs(lens, domain, PairSettings(train=1, held_out=rays, rim=1, seed=seed))
    predict = onnx_predictor(model)
    vignetting = vignetting_errors(lens, domain, predict, count=4 * rays, seed=seed)
    # Rays that the exact lens passes, and nearly those that the model passes: what the shares are of.
    passing = max(1.0, 4 * rays * vignetting["passing_share"])
    figures = {
        **ray_errors(lens, domain, pairs.held_out, predict),
        **{key: vignetting[key] for key in (*_SHARES, "false_pass_near_rim", "false_block_near_rim")},
        "rays": rays,
        "seed": seed,
    }
    return figures, [_promise(key, value, figures, passing) for key, value in _promised(card)]


def _promised(card: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    """Figures of the card's errors; a figure that was not measured promises nothing."""
    for key, value in card["errors"].items():
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            yield key, float(value)


def _promise(key: str, promised: float, figures: Mapping[str, Any], passing: float) -> Promise:
    allowed = None
    if key in _RMS:
        allowed = promised * (1 + RMS_TOLERANCE) + _FLOOR
    elif key in _P99:
        allowed = promised * (1 + P99_TOLERANCE) + _FLOOR
    elif key in _SHARES:
        # Both figures are counts; no event in either still leaves room for one or two.
        variance = max(promised * (1 - promised), 1 / passing) / passing
        allowed = promised + SHARE_SIGMAS * math.sqrt(2 * variance)
    value = figures.get(key)
    return Promise(key, promised, None if value is None else float(value), allowed)


def lens_of_card(
    card: Mapping[str, Any], lens_file: str | Path | None = None, model_file: str | Path = "model"
) -> Lens:
    """The exact lens that a model stands for, in the model's zoom state, size and stop.

    Args:
        lens_file: None looks for the card's lens id in lenses/: of the working folder, beside the model's folder, and
            of this project.

    Raises:
        InputError: no such file, or one whose prescription is not the card's in any zoom state.
    """
    wanted = card["lens"]
    path = Path(lens_file) if lens_file is not None else _find(str(wanted["id"]), Path(model_file))
    tabled = read_lens(path)
    for lens in _states(tabled, float(wanted["efl_mm"])):
        if lens.sha256 == wanted["sha256"]:
            return lens.with_stop_radius(float(card["domain"]["stop_radius_mm"]))
    expected = f"the prescription of {model_file}: {wanted['name']}, sha256 {str(wanted['sha256'])[:12]}..."
    raise InputError(path, "sha256", f"({tabled.name}, {tabled.sha256[:12]}...)", expected)


def _find(lens_id: str, model_file: Path) -> Path:
    name = f"{Path(lens_id).name}.toml"
    roots = (
        Path("."),
        model_file.resolve().parent,
        model_file.resolve().parent.parent,
        Path(neurolens.__file__).parents[1],
    )
    for root in roots:
        if (root / "lenses" / name).is_file():
            return root / "lenses" / name
    raise InputError(model_file, "lens", lens_id, f"lenses/{name}, or a lens file given with --lens")


def _states(tabled: Lens, efl_mm: float) -> Iterator[Lens]:
    """The lens in every zoom state, as tabled and at the focal length of the card."""
    for configuration in (None, *(c.name for c in tabled.configurations)):
        lens = tabled.at(zoom=configuration)
        yield lens
        # The card has the focal length that came out; the one asked for, whose bits count, had fewer digits.
        for digits in (9, 12, 15):
            asked = float(f"{efl_mm:.{digits}g}")
            if abs(first_order(lens).efl_mm / asked - 1) > 1e-12:
                yield tabled.at(zoom=configuration, focal_length_mm=asked)
