"""Polynomials fitted to one shot of a lens alone: its film, stop, focus and light."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path

from neurolens.base.errors import InputError
from neurolens.plan.probe import Probed
from neurolens.shaders.blender_shader import IDLE
from neurolens.study.experiment import DomainChoice
from neurolens.surrogates.domain import domain_of
from neurolens.surrogates.export import export_onnx
from neurolens.surrogates.fit import fit_model, prepare
from neurolens.surrogates.fits.polynomial import fit_planes
from neurolens.surrogates.pairs import PairSettings, make_pairs
from neurolens.surrogates.targets import ModelSettings, Prepared

TERMS = (2, 4, 6, 8, 12, 16, 22, 28, 36, 48, 64, 90)  # of the polynomials that are fitted on the spot
_FIT = ModelSettings("ols", planes=False, elimination=False, idle_gates=IDLE)
_FIT_MIRROR = replace(_FIT, degree=5)  # of lenses with cylinders: more candidates cost ten times, for the same errors
_MOVED_TERMS = 16, 22  # from so many on, planes are searched: once, for the second number
PAIRS = PairSettings(train=5000, held_out=1000, rim=5000)


def shot_domain(found: Probed) -> DomainChoice:
    """That of `Probed.domain`, as an experiment asks for it."""
    return DomainChoice(found.domain.film_radius_mm, found.domain.focus_m, found.asked.shot.wavelength_nm)


def shot_terms(found: Probed) -> list[int]:
    """Sizes of polynomials that are tried for a shot; those of lenses with cylinders have terms of x and of y."""
    return [n for n in TERMS if n >= (4 if found.lens.anamorphic else 2)]


def shot_fits(
    found: Probed, folder: Path, choice: DomainChoice | None = None, name: str = "shot"
) -> Callable[[int], tuple[Path, ModelSettings]]:
    """What fits a polynomial of so many terms to a shot alone, or to another domain of its lens: its file, in a folder,
    and its settings."""
    lens, domain = found.lens.with_aperture(None), found.domain
    if choice is not None:
        with suppress(InputError):  # a lens that goes no nearer
            domain = domain_of(lens, **asdict(choice))
    plain, model = prepare(make_pairs(lens, domain, PAIRS)), _FIT_MIRROR if lens.anamorphic else _FIT
    folder.mkdir(parents=True, exist_ok=True)

    @cache
    def moved() -> Prepared:  # the planes of one size: a search takes a second, and others of its kind agree on them
        return replace(plain, encoding=fit_planes(plain.pairs, plain.encoding, _MOVED_TERMS[1], model.position_weight))

    def fit(terms: int) -> tuple[Path, ModelSettings]:
        settings = replace(model, name=f"{name}-ols-{terms}", terms=terms)
        file = folder / f"{found.lens.lens_id}.{settings.label}.onnx"
        planes = terms >= _MOVED_TERMS[0] and not lens.anamorphic
        export_onnx(fit_model(moved() if planes else plain, settings), file, errors={})
        return file, replace(settings, planes=planes)  # as a training from scratch has it

    return fit
