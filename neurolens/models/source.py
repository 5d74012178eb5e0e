"""Source code of models in C99 or a shading language, with the card as a comment on top.

Inputs that a scene fixes can be folded into the code, which takes torch; all else does without it.
"""

import math
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import neurolens
from neurolens.base.errors import InputError, printable
from neurolens.base.files import atomic_write_text
from neurolens.base.status import DOMAIN_SLACK
from neurolens.graph.c import NOTHING, Extras, Signature, write_c, write_double
from neurolens.graph.program import (
    FILM_Z,
    RAY,
    SCENE_RAY,
    STATUS,
    STOP,
    STOP_RADIUS,
    TRANSMITTANCE,
    WAVELENGTH,
    Program,
)
from neurolens.graph.scalars import lower
from neurolens.graph.shading import LANGUAGES, write_shading
from neurolens.models.assemble import ALL, SCALARS, Parts, model_graph
from neurolens.models.axes import mixture, mixture_of, state_names
from neurolens.models.card import axes_of
from neurolens.models.copied import copy_inputs, copy_nodes
from neurolens.models.fitted import Domain
from neurolens.models.model import LensModel, with_one_angle
from neurolens.optics.lens.glass import inverse_square_um

DOUBLE = "c-double"
WRITERS: Mapping[str, Callable[..., str]] = {
    "c": write_c, DOUBLE: write_double, **{name: partial(write_shading, kind) for name, kind in LANGUAGES.items()}
}  # fmt: skip
OSL = "osl"  # of whole cameras: `cameras.shaders.osl`
_WIDTH, _MOST_WAVELENGTHS = 110, 64
# Keywords of C11, C++20 and GLSL 4.60 and words reserved there, types and functions of GLSL and OSL, words of HLSL,
# WGSL, CUDA and VEX, names of the code that is written.
_WORDS = (Path(__file__).parent / "reserved_words.txt").read_text(encoding="utf-8").split()
_PATTERNS = re.compile(
    r"t\d+|[fiu](16|32|64)|gl_.*|[biud]?vec[234]|d?mat[234](x[234])?|[iu]?(sampler|image|texture|subpassInput)\w*|texel\w*|atomic\w*|hvec\d"
    r"|dmat\w*|fvec\d|u?int(8|16|32|64)?_t|u?int|float_t|double_t"
)
_ERRORS = ("rms_um", "p99_um", "max_um", "direction_rms_deg", "transmittance_rms", "false_pass", "false_block")


# ---- what a scene fixes ----


@dataclass(frozen=True)
class Fix:
    """The arguments that a scene fixes; None or empty ones stay free. Film plane and stop in mm, lens frame."""

    wavelengths_nm: tuple[float, ...] = ()
    film_z_mm: float | None = None
    stop_radius_mm: float | None = None

    def check(self, domain: Domain) -> None:
        """Raise InputError for a film position or a stop outside a domain."""
        z, stop, (near, far), widest = self.film_z_mm, self.stop_radius_mm, domain.film_z_mm, domain.stop_radius_mm
        if z is not None and not near / DOMAIN_SLACK <= z <= far * DOMAIN_SLACK:
            raise InputError("fix", "film_z", z, f"{near:.6g} to {far:.6g} mm, the film positions of the fit")
        if stop is not None and not 0 < stop <= widest * DOMAIN_SLACK:
            raise InputError("fix", "stop", stop, f"above 0, up to {widest:.6g} mm, the widest stop of the fit")


# Wavelengths are fixed in the models themselves, one model a table; film plane and stop in programs, too.
FREE = Fix()


def fixed_models(model: LensModel, fix: Fix) -> tuple[LensModel, ...]:
    """Return a model for each wavelength that is fixed, all of one structure; one model where wavelengths stay free.

    One wavelength folds every power of w into the coefficients. That serves pictures in one colour of light (a laser
    line, a filter, a measurement at the d line), or one model a channel where dispersion within a channel does not
    count. Pictures in white light take the whole model. A film position and a stop narrow the domain; rims that then
    block nothing are left out.

    Raises:
        InputError: a wavelength, film position or stop outside the model's domain; too many wavelengths, or one twice.
    """
    from neurolens.models.targets import with_angle, without_idle_gates  # rays are traced, which needs torch

    wanted = fix.wavelengths_nm
    if len(wanted) > _MOST_WAVELENGTHS or len(set(wanted)) < len(wanted):
        raise InputError("fix", "wavelengths", list(wanted), f"up to {_MOST_WAVELENGTHS} that differ")
    fix.check(model.domain)
    domain, lens, settings = model.domain, model.lens, dict(model.settings)
    if fix.film_z_mm is not None:
        domain = replace(domain, film_z_mm=(fix.film_z_mm, fix.film_z_mm))
        settings["film_z_mm"] = fix.film_z_mm
    if fix.stop_radius_mm is not None:
        domain = replace(domain, stop_radius_mm=fix.stop_radius_mm)
        lens = lens.with_stop_radius(fix.stop_radius_mm)
        settings["stop_radius_mm"] = fix.stop_radius_mm
    narrow = replace(model, domain=domain, lens=lens, settings=settings)
    models = tuple(at_wavelength(narrow, w) for w in wanted) or (with_angle(narrow),)
    return without_idle_gates(models) if fix != FREE else models


def at_wavelength(model: LensModel, wavelength_nm: float) -> LensModel:
    """Return a smaller and faster model for one wavelength; rays of any other are outside its domain.

    Raises:
        InputError: a wavelength outside the model's domain, or a model without a wavelength input.
    """
    from neurolens.models.targets import with_angle

    low, high = model.domain.wavelength_nm
    if model.encoding.w_half == 0:
        raise InputError("at_wavelength", "model", model.method, "a model whose rays depend on the wavelength")
    if not low <= wavelength_nm <= high:
        raise InputError("at_wavelength", "wavelength_nm", wavelength_nm, f"{low:g} to {high:g} nm")
    w = (inverse_square_um(wavelength_nm) - model.encoding.w_middle) / model.encoding.w_half
    fixed = replace(
        model,
        domain=replace(model.domain, wavelength_nm=(wavelength_nm, wavelength_nm)),
        encoding=replace(model.encoding, w_half=0.0),
        core=model.core.fixed(w),
        settings={**model.settings, "wavelength_nm": wavelength_nm},
    )
    return with_angle(fixed)


# ---- files ----


@dataclass(frozen=True)
class Written:
    """A written file, with its function and the float operations of one ray (a fused multiply-add is one)."""

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
    extras: Extras = NOTHING,
    notes: Sequence[str] = (),
) -> Written:
    """Write a model, one for each of several fixed wavelengths, or one of many states, as one function.

    Args:
        models: one model; one for each wavelength; or one for every node of a card with states (zoom, internal focus).
            In the last case the state is an argument, which NAME_at makes of numbers.
        language: of `WRITERS`.
        card: of the model, for the comment.
        parts, fix: see `fused_program`.
        name: of the function; None takes the lens's id.
        extras, notes: what else the file holds, and lines of the comment about that.

    Raises:
        InputError: another language, a name that is no identifier, numbers that float32 cannot hold, a card that lacks
            what the comment says.
    """
    model, axes = models[0], axes_of(card)
    function_name = checked_name(language, model.lens.lens_id, name)
    program = copies_program(models, parts, fix) if copy_inputs(model) else fused_program(models, parts, fix)
    if axes:
        program.mixture = mixture_of(axes)
    waves = [m.domain.wavelength_nm for m in ([model] if axes else models)]
    try:
        codes = [gate.status for gate in model.gates]
        comment = [*comment_of(card, model.domain.to_dict(), waves, fix, codes), *lines_of(notes)]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        expected = "a card of neurolens, whole"
        raise InputError("export", "card", f"({type(error).__name__}: {error})", expected) from error
    return write_program(program, Path(path), language, function_name, comment, extras)


def checked_name(language: str, lens_id: str, name: str | None) -> str:
    if language not in (*WRITERS, OSL):
        raise InputError("export", "to", language, f"one of {', '.join((*WRITERS, OSL))}")
    function_name = identifier(lens_id) if name is None else name
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,99}", function_name) or "__" in function_name or _taken(function_name):
        expected = "letters, digits and single underscores, a letter first, no word of C, a shader or the code"
        raise InputError("export", "name", function_name, expected)
    return function_name


def _taken(word: str) -> bool:
    """Return whether a word has a meaning in a language, or in the code that is written."""
    reserved = {*_WORDS, *RAY, *SCENE_RAY, *STOP, WAVELENGTH, FILM_Z, STOP_RADIUS, TRANSMITTANCE, STATUS}
    return word in reserved or word.removesuffix("f") in dir(math) or _PATTERNS.fullmatch(word) is not None


def write_program(
    program: Program, target: Path, language: str, name: str, comment: Sequence[str], extras: Extras
) -> Written:
    """Write any program as a function whose name was checked before."""
    atomic_write_text(target, WRITERS[language](program, name, comment, extras))
    return Written(target, Signature.of(program, name), sum(program.count().values()))


def fused_program(models: Sequence[LensModel], parts: Parts = ALL, fix: Fix = FREE) -> Program:
    """Write the program of a model, or of several that differ only in their coefficients (one for each wavelength).

    Inputs: `program.RAY`, then wavelength_nm where rays depend on it, film_z_mm unless fixed, and stop_radius_mm unless
    fixed or without vignetting. Outputs: `program.SCENE_RAY`; transmittance, stop_x_mm and stop_y_mm as asked for;
    status, a float.

    Raises:
        InputError: as `lower`; a fixed film position or stop outside the domain.
    """
    fix.check(models[0].domain)
    fixed = {FILM_Z: fix.film_z_mm, STOP_RADIUS: fix.stop_radius_mm}
    constants = {name: value for name, value in fixed.items() if value is not None}
    return lower([model_graph(model, SCALARS, parts) for model in with_one_angle(models)], constants)


def copies_program(models: Sequence[LensModel], parts: Parts = ALL, fix: Fix = FREE) -> Program:
    """Write the program of a model with derivatives by what is off in copies, which are arguments (`copy_inputs`).

    Raises:
        InputError: as `fused_program`; models of several wavelengths.
    """
    if len(models) > 1:
        raise InputError(
            "fix", "wavelengths", len(models), "one at most for a model of copies, whose figures are arguments, too"
        )
    nodes, graph, transform = copy_nodes(models[0])
    program = fused_program(nodes, parts, fix)
    program.mixture = mixture(graph, transform, copy_inputs(models[0]))
    return program


def identifier(text: str) -> str:
    """Make the name of a function from any text."""
    word = re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_")[:80]
    return word if word[:1].isalpha() and not _taken(word) else f"lens_{word}"


def comment_of(
    card: Mapping[str, Any], domain: Mapping[str, Any], waves: Sequence[Sequence[float]], fix: Fix, gates: Sequence[int]
) -> list[str]:
    """Write the card as lines of text, for this domain, its bands of wavelengths and the status codes of its gates."""
    lens, fit, d = card["lens"], card["fit"], domain
    lines = [
        f"{lens['name']}: {fit['method']}, written by neurolens {neurolens.__version__}.",
        f"Lens data: figures published in {lens['source']} (sha256 {lens['sha256'][:16]}).",
        f"Focal length {lens['efl_mm']:.6g} mm, f/{lens['f_number']:.3g}, {lens['refractions']} refractions.",
        card["frame"],
        f"Domain: film radius {d['film_radius_mm']:.6g} mm; film plane z {_span(*d['film_z_mm'])} mm; pupil radius "
        f"{d['pupil_radius_mm']:.6g} mm on the plane z = {d['pupil_z_mm']:.6g} mm; stop radius up to "
        f"{d['stop_radius_mm']:.6g} mm; wavelength {', '.join(_span(*w) for w in waves)} nm.",
    ]
    if card.get("states"):
        axes = axes_of(card)
        names = state_names(axes)
        spans = ", ".join(f"{n} {_span(*a.range)}" for n, a in zip(names, axes, strict=True))
        at = ", ".join(f"{n} {a.range[0]:.6g}" for n, a in zip(names, axes, strict=True))
        lines.append(f"States: {spans}. Focal length and domain above are those at {at}.")
        lines.append(
            f"Argument state: NAME_at({', '.join(names)}) makes it, once for all rays of a state; zoom_mm is the focal "
            "length at infinity focus, focus_per_m is 1 / (distance from film to object in m), 0 at infinity."
        )
    if copies := card.get("copies"):
        lines.append(
            "Argument state: NAME_at makes it of what is off in a copy of the lens, once for all its rays; of "
            "the lens itself all are 0. NAME_at takes, with their limits: "
            + ", ".join(f"{name} {limit:.4g}" for name, limit in copies.items())
            + "."
        )
    if len(waves) > 1:
        bands = ", ".join(f"{k}: {w[0]:g} nm" for k, w in enumerate(waves))
        lines.append(f"Argument band: {bands}.")
    for what, value in (("film plane z", fix.film_z_mm), ("stop radius", fix.stop_radius_mm)):
        if value is not None:
            lines.append(f"Fixed: {what} {value:.9g} mm.")
    errors = card.get("errors") or {}
    figures = [f"{key} {errors[key]:.3g}" for key in _ERRORS if isinstance(errors.get(key), (int, float))]
    if figures:
        lines.append(f"Errors on held-out rays, whole domain of the exported model: {', '.join(figures)}.")
    if errors.get("poor"):
        lines.append(f"Poor: {', '.join(errors['poor'])}.")
    lines.append("Units: mm, nm; directions are unit vectors, transmittance a share of the power of unpolarised light.")
    lines.append("Transmittance: the polarisation that surfaces give to the light is followed.")
    gone = {g["status"] for g in card["gates"]} - set(gates)
    codes = [f"{code} {words}" for code, words in card["status_codes"].items() if int(code) not in gone]
    lines.append(f"Status: {'; '.join(codes)}.")
    return lines_of(lines)


def lines_of(texts: Sequence[str]) -> list[str]:
    """Write texts as lines of a comment."""
    flat = [" ".join(printable(str(text)).split()) for text in texts]
    return [part for line in flat for part in textwrap.wrap(line, _WIDTH, break_long_words=False)]


def _span(low: float, high: float) -> str:
    return f"{low:.6g}" if low == high else f"{low:.6g} to {high:.6g}"
