"""Source code of exported models: a C99 header or a GLSL function, the card as a comment on top."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import neurolens
from neurolens.base.errors import InputError
from neurolens.base.files import atomic_write_text
from neurolens.graph.c import Signature, write_c
from neurolens.graph.glsl import write_glsl
from neurolens.graph.program import FILM_Z, STOP_RADIUS, Program
from neurolens.graph.scalars import lower
from neurolens.surrogates.assemble import ALL, SCALARS, Parts, model_graph
from neurolens.surrogates.export import largest_angle
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.specialise import Fix

# Nothing fixed. Wavelengths are fixed in the models themselves, one model a table; film plane and stop here too.
FREE = Fix()
WRITERS = {"c": write_c, "glsl": write_glsl}
_WIDTH = 110
_ERRORS = ("rms_um", "p99_um", "max_um", "direction_rms_deg", "transmittance_rms", "false_pass", "false_block")


@dataclass(frozen=True)
class Written:
    """A file that was written: its function, and float operations of one ray (a fused multiply-add is one)."""

    path: Path
    signature: Signature
    operations: int


def export_source(
    models: Sequence[LensModel],
    path: str | Path,
    language: str,
    card: Mapping[str, Any],
    *,
    parts: Parts = ALL,
    fix: Fix = FREE,
    name: str | None = None,
) -> Written:
    """Write a model, or one for each of several fixed wavelengths, as one function.

    Args:
        language: "c" or "glsl".
        card: of the model, for the comment.
        name: of the function; None takes the lens's id.

    Raises:
        InputError: another language, a name that is no identifier, numbers that float32 cannot hold, a card that lacks
            what the comment says.
    """
    if language not in WRITERS:
        raise InputError("export", "to", language, f"one of {', '.join(WRITERS)}")
    own = identifier(models[0].lens.lens_id) if name is None else name
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,99}", own) or "__" in own:
        raise InputError("export", "name", own, "letters, digits and single underscores, a letter first")
    program = fused_program(models, parts, fix)
    try:
        comment = comment_of(models, card, fix)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            "export", "card", f"({type(error).__name__}: {error})", "a card of neurolens, whole"
        ) from error
    target = Path(path)
    atomic_write_text(target, WRITERS[language](program, own, comment))
    return Written(target, Signature.of(program, own), sum(program.count().values()))


def fused_program(models: Sequence[LensModel], parts: Parts = ALL, fix: Fix = FREE) -> Program:
    """The program of a model, or of several that differ only in their coefficients (one for each wavelength).

    Inputs: `program.RAY`, then wavelength_nm where rays depend on it, film_z_mm unless fixed, and stop_radius_mm unless
    fixed or without vignetting. Outputs: `program.SCENE_RAY`; transmittance, stop_x_mm and stop_y_mm as asked for;
    status, a float.

    Raises:
        InputError: weights that float32 cannot hold; a fixed film position or stop outside the domain.
    """
    fix.check(models[0].domain)
    angle = max(largest_angle(model) for model in models)
    fixed = {FILM_Z: fix.film_z_mm, STOP_RADIUS: fix.stop_radius_mm}
    known = {name: value for name, value in fixed.items() if value is not None}
    return lower([model_graph(model, angle, SCALARS, parts) for model in models], known)


def identifier(text: str) -> str:
    """A name of a function made from any text."""
    word = re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_")[:80]
    return word if word[:1].isalpha() else f"lens_{word}"


def comment_of(models: Sequence[LensModel], card: Mapping[str, Any], fix: Fix) -> list[str]:
    """What the card says, in lines."""
    model, lens, fit = models[0], card["lens"], card["fit"]
    d = model.domain
    waves = [m.domain.wavelength_nm for m in models]
    lines = [
        f"{lens['name']}: {fit['method']}, written by neurolens {neurolens.__version__}.",
        f"Lens data: figures published in {lens['source']} (sha256 {lens['sha256'][:16]}).",
        f"Focal length {lens['efl_mm']:.6g} mm, f/{lens['f_number']:.3g}, {lens['refractions']} refractions.",
        card["frame"],
        f"Domain: film radius {d.film_radius_mm:.6g} mm; film plane z {_span(*d.film_z_mm)} mm; pupil radius "
        f"{d.pupil_radius_mm:.6g} mm on the plane z = {d.pupil_z_mm:.6g} mm; stop radius up to "
        f"{d.stop_radius_mm:.6g} mm; wavelength {', '.join(_span(*w) for w in waves)} nm.",
    ]
    if len(models) > 1:
        bands = ", ".join(f"{k}: {w[0]:g} nm" for k, w in enumerate(waves))
        lines.append(f"Argument band: {bands}.")
    for what, value in (("film plane z", fix.film_z_mm), ("stop radius", fix.stop_radius_mm)):
        if value is not None:
            lines.append(f"Fixed: {what} {value:.9g} mm.")
    errors = card.get("errors") or {}
    known = [f"{key} {errors[key]:.3g}" for key in _ERRORS if isinstance(errors.get(key), (int, float))]
    if known:
        lines.append(f"Errors on held-out rays, whole domain of the exported model: {', '.join(known)}.")
    if errors.get("poor"):
        lines.append(f"Poor: {', '.join(errors['poor'])}.")
    lines.append("Units: mm, nm; directions are unit vectors, transmittance a share of the power.")
    codes = {g.status for g in model.gates}
    gone = {g["status"] for g in card["gates"]} - codes
    told = {c: w for c, w in card["status_codes"].items() if int(c) not in gone}
    lines.append(f"Status: {'; '.join(f'{c} {w}' for c, w in told.items())}.")
    flat = [" ".join(str(line).split()) for line in lines]
    return [part for line in flat for part in textwrap.wrap(line, _WIDTH, break_long_words=False)]


def _span(low: float, high: float) -> str:
    return f"{low:.6g}" if low == high else f"{low:.6g} to {high:.6g}"
