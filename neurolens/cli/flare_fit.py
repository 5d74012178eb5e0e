"""Fitted ghosts of `neurolens flare`: --fit writes them to a file, which then takes the place of a lens."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens.base.errors import InputError, warn
from neurolens.base.lensname import is_model
from neurolens.base.progress import Progress
from neurolens.cli.arguments import add_within, aperture_of, between, check_suffix, given_options
from neurolens.cli.output import answer, number, table

if TYPE_CHECKING:
    from neurolens.flare.ghostmodel import GhostModel
    from neurolens.lens.prescription import Lens

_COMMAND = "neurolens flare"
_FREE = {"--f-number", "--blades", "--blade-rotation", "--blade-curvature"}
_SHOWN = 12


def add_fit(parser: argparse.ArgumentParser) -> None:
    """Add --fit and its settings."""
    group = parser.add_argument_group("fitted ghosts")
    group.add_argument(
        "--fit", metavar="OUT", type=Path,
        help="fit polynomials to the ghosts, for lights in any direction and any smaller stop: OUT.onnx, which then "
        "stands for the lens; of such a file OUT.h or OUT.glsl, a function a ghost",
    )  # fmt: skip
    group.add_argument(
        "--angle", metavar="DEG", type=between(0.1, 89, "degrees"), default=35.0,
        help="of --fit: largest angle between light and axis (default: 35)",
    )  # fmt: skip
    about = "of --fit: RMS on the film in um at which a ghost's degree is high enough (default: 10um)"
    add_within(group, about, default=("rms_um", 10.0))


def check_fit(args: argparse.Namespace) -> None:
    """Refuse --fit together with options that ask for a picture; raises InputError."""
    for name in ("light", "lights", "image", "out", "path", "frames", "photons", "glare", "starburst"):
        if args.fit is not None and getattr(args, name):
            expected = f"no --{name} beside it: it writes the ghosts of one state, for any light"
            raise InputError(_COMMAND, "--fit", args.fit, expected)
    if args.within[0] != "rms_um":
        raise InputError(_COMMAND, "--within", f"{args.within[1]:g}px", "micrometres, as 10um: a ghost has no pixels")


def fitted(args: argparse.Namespace, states: Sequence[argparse.Namespace]) -> GhostModel | None:
    """The fitted ghosts, if the file holds some instead of a lens.

    Args:
        states: the arguments of each frame.

    Raises:
        InputError: options that need the lens itself, since the ghosts were fitted for one state.
        ModelError: see `read_ghosts`.
    """
    if not is_model(args.file):
        return None
    from neurolens.flare.ghostfile import read_ghosts

    wrong = [name for name in given_options(args) if name not in _FREE]
    wrong += [f"--{name}" for name in ("coating", "photons") if getattr(args, name)]
    wrong += ["--key focus"] * any(math.isfinite(s.focus) for s in states)
    wrong += ["--key zoom"] * any(s.zoom is not None for s in states)
    if wrong:
        raise InputError(_COMMAND, wrong[0], args.file, "a lens: fitted ghosts have one state and two reflections")
    model, half = read_ghosts(args.file), math.hypot(*args.film) / 2
    if half > 1.001 * (known := float(model.report.get("film_radius_mm", math.inf))):
        warn(f"{args.file}: fitted up to {known:.4g} mm from the axis, and the film's corners are at {half:.4g} mm")
    return model


def stopped(args: argparse.Namespace, model: GhostModel) -> GhostModel:
    """The model at the f-number and with the blades of the options.

    Raises:
        InputError: a stop wider than that of the fit.
    """
    from neurolens.setting.states import set_lens

    lens = model.lens.with_aperture(aperture_of(args))
    return replace(model, lens=lens if args.f_number is None else set_lens(lens, f_number=args.f_number))


def run_fit(args: argparse.Namespace, lens: Lens | None, model: GhostModel | None) -> int:
    """Fit and write a lens's ghosts, or write those of a model as source."""
    from neurolens.flare.ghostfile import write_ghost_source, write_ghosts
    from neurolens.flare.ghostfit import GhostSettings, fit_ghosts

    progress = Progress(quiet=args.quiet or args.json)
    if model is not None:
        check_suffix(args.fit, "--fit", (".h", ".glsl"))
        write_ghost_source(model, args.fit)
    else:
        check_suffix(args.fit, "--fit", (".onnx",))
        assert lens is not None
        settings = GhostSettings(args.angle, film_radius_mm=math.hypot(*args.film) / 2, target_um=args.within[1])
        with progress.stage("ghosts") as report:
            model = fit_ghosts(lens, settings, report)
        write_ghosts(model, args.fit)
    results = {"lens": model.lens.name, "out": str(args.fit), **model.report}
    return answer(args, results, lambda: _text(results))


def _text(results: dict[str, Any]) -> str:
    rows = [
        [
            r["ghost"], number(100 * r["energy"]), number(r["film_rms_um"]), number(100 * r["false_light"]),
            number(100 * r["lost_light"]), str(r["degree"]), str(r["rims"]),
        ]
        for r in results["ghosts"][:_SHOWN]
    ]  # fmt: skip
    head = ("ghost", "energy %", "RMS um", "light too much %", "too little %", "degree", "rims")
    energy, error = number(100 * results["kept_energy"]), number(results["film_rms_um"])
    return (
        f"{results['lens']}: {results['kept']} of {results['pairs']} ghosts, with {energy}% of their light; {error} um "
        f"RMS on the film, by light; the brightest:\n\n{table(head, rows)}\n\n{results['out']}: fitted in "
        f"{results['seconds']:.1f} s"
    )
