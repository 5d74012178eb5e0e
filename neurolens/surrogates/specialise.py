"""Models that fix what a scene fixes: wavelengths, the film's position, the stop.

One wavelength folds every power of w into the coefficients: for pictures in one colour of light (a laser line, a
filter, a measurement at the d line), or one model a channel where dispersion within a channel does not count. Pictures
in white light take the whole model. A film position and a stop narrow the domain; rims that then block nothing go.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from neurolens.base.errors import InputError
from neurolens.lens.glass import inverse_square_um
from neurolens.surrogates.cardkeys import DOMAIN_SLACK
from neurolens.surrogates.cores import STOP

if TYPE_CHECKING:
    from torch import Tensor

    from neurolens.surrogates.model import Domain, LensModel

# A gate goes where at most this share of the domain's rays is blocked by it and by nothing else.
IDLE_SHARE = 1e-5
_IDLE_RAYS = 200_000
_MOST_WAVELENGTHS = 64


@dataclass(frozen=True)
class Fix:
    """What a scene fixes; what is None or empty stays free. Film plane and stop in mm, lens frame."""

    wavelengths_nm: tuple[float, ...] = ()
    film_z_mm: float | None = None
    stop_radius_mm: float | None = None

    def check(self, domain: Domain) -> None:
        """Refuse a film position or a stop outside a domain. Raises InputError: as it says."""
        z, stop, (near, far), widest = self.film_z_mm, self.stop_radius_mm, domain.film_z_mm, domain.stop_radius_mm
        if z is not None and not near / DOMAIN_SLACK <= z <= far * DOMAIN_SLACK:
            raise InputError("fix", "film_z", z, f"{near:.6g} to {far:.6g} mm, the film positions of the fit")
        if stop is not None and not 0 < stop <= widest * DOMAIN_SLACK:
            raise InputError("fix", "stop", stop, f"above 0, up to {widest:.6g} mm, the widest stop of the fit")


def fixed_models(model: LensModel, fix: Fix) -> tuple[LensModel, ...]:
    """The model for what is fixed: one for each wavelength, of one structure, or one where the wavelength stays free.

    Raises:
        InputError: a wavelength, film position or stop outside the model's domain; too many wavelengths, or one twice.
    """
    wanted = fix.wavelengths_nm
    if len(wanted) > _MOST_WAVELENGTHS or len(set(wanted)) < len(wanted):
        raise InputError("fix", "wavelengths", list(wanted), f"up to {_MOST_WAVELENGTHS} that differ")
    narrow = _narrowed(model, fix)
    models = tuple(at_wavelength(narrow, w) for w in wanted) or (narrow,)
    return without_idle_gates(models) if fix != Fix() else models


def _narrowed(model: LensModel, fix: Fix) -> LensModel:
    """The same model over one film position, with one stop as its widest."""
    fix.check(model.domain)
    domain, lens, settings = model.domain, model.lens, dict(model.settings)
    if fix.film_z_mm is not None:
        domain = replace(domain, film_z_mm=(fix.film_z_mm, fix.film_z_mm))
        settings["film_z_mm"] = fix.film_z_mm
    if fix.stop_radius_mm is not None:
        domain = replace(domain, stop_radius_mm=fix.stop_radius_mm)
        lens = lens.with_stop_radius(fix.stop_radius_mm)
        settings["stop_radius_mm"] = fix.stop_radius_mm
    return _with_angle(replace(model, domain=domain, lens=lens, settings=settings))


def without_idle_gates(models: tuple[LensModel, ...], share: float = IDLE_SHARE) -> tuple[LensModel, ...]:
    """The models without the gates that block (next to) nothing that the others and the stop let through.

    Which surface a status names may change with that: the first of those left. `share`: see `IDLE_SHARE`.
    """
    left = list(range(len(models[0].gates)))
    sole = [_blocked(m) for m in models]  # [1 + G, N] of each, the stop first
    while left:
        others = [[b[[0, *(1 + k for k in left if k != g)]].any(0) for b in sole] for g in left]
        counts = [
            sum(int((b[1 + g] & ~rest).sum()) for b, rest in zip(sole, each, strict=True))
            for g, each in zip(left, others, strict=True)
        ]
        least = min(range(len(left)), key=lambda i: counts[i])
        if counts[least] > share * sum(b.shape[1] for b in sole):
            break
        del left[least]
    if len(left) == len(models[0].gates):
        return models
    return tuple(
        replace(m, gates=tuple(m.gates[k] for k in left), core=m.core.keep([0, *(1 + k for k in left)])) for m in models
    )


def _blocked(model: LensModel) -> Tensor:
    """[1 + G, N] bool: which of the stop and the gates block each ray of the domain."""
    import torch

    from neurolens.surrogates.domain import sample_domain

    with torch.no_grad():
        vectors, scalars = model.core(model.encoding(sample_domain(model.domain, _IDLE_RAYS, seed=17)))
    stop = ((vectors[STOP] * model.scales.stop_mm) ** 2).sum(0) > model.domain.stop_radius_mm**2
    return torch.cat([stop[None], scalars[1:] > 0])


def at_wavelength(model: LensModel, wavelength_nm: float) -> LensModel:
    """The same model for one wavelength: smaller and faster. Rays of any other wavelength are outside its domain.

    Raises:
        InputError: a wavelength outside the model's domain, or a model without a wavelength input.
    """
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
    return _with_angle(fixed)


def _with_angle(model: LensModel) -> LensModel:
    from neurolens.surrogates.pairs import with_angle  # rays are traced, which needs torch

    return with_angle(model)
