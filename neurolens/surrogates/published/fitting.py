"""Which fit a published method asks for."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from neurolens.base.errors import InputError
from neurolens.surrogates.cores import Core
from neurolens.surrogates.fit import ModelSettings, Prepared
from neurolens.surrogates.lightfield import Encoding
from neurolens.surrogates.model import Gate
from neurolens.surrogates.published.adaptive import fit_adaptive
from neurolens.surrogates.published.data import RawData, outer_pupil
from neurolens.surrogates.published.neural import NetworkSettings, fit_averaged
from neurolens.surrogates.published.polynomials import fit_dense, fit_sparse
from neurolens.surrogates.published.rtf import fit_rtf
from neurolens.surrogates.published.taylor import fit_taylor

Progress = Callable[[float], None] | None


class PublishedFit(NamedTuple):
    """A core with the coordinates that it is written in and the tests of who passes that its scalars stand for."""

    core: Core
    encoding: Encoding
    gates: tuple[Gate, ...]


def fit_published(prepared: Prepared, settings: ModelSettings, progress: Progress = None) -> PublishedFit:
    """Fit one published method.

    Raises:
        InputError: an unknown method, or a lens or settings that it cannot take.
    """
    fit = _FITS.get(settings.method)
    if fit is None:
        raise InputError("fit", "method", settings.method, f"one of {', '.join(_FITS)}")
    return fit(prepared, settings, progress)


def _taylor(prepared: Prepared, settings: ModelSettings, progress: Progress) -> PublishedFit:
    data = RawData.of(prepared, centred=True)
    core, gates = outer_pupil(data, fit_taylor(prepared.pairs.lens, data.encoding, settings.degree), 0.0)
    return PublishedFit(core, data.encoding, gates)


def _hanika(prepared: Prepared, settings: ModelSettings, progress: Progress) -> PublishedFit:
    data = RawData.of(prepared, centred=True)
    core, gates = outer_pupil(data, fit_dense(data, settings.degree))
    return PublishedFit(core, data.encoding, gates)


def _schrade(prepared: Prepared, settings: ModelSettings, progress: Progress) -> PublishedFit:
    data = RawData.of(prepared)
    core, gates = outer_pupil(data, fit_sparse(data, settings.terms, settings.degree))
    return PublishedFit(core, data.encoding, gates)


def _zheng(prepared: Prepared, settings: ModelSettings, progress: Progress) -> PublishedFit:
    data = RawData.of(prepared)
    core, gates = outer_pupil(data, fit_adaptive(data, settings.terms, settings.partitions, progress))
    return PublishedFit(core, data.encoding, gates)


def _neurolens(prepared: Prepared, settings: ModelSettings, progress: Progress) -> PublishedFit:
    data, s = RawData.of(prepared), settings
    training = NetworkSettings(s.units, s.layers, s.steps, s.seconds, s.seed, s.partitions)
    core, gates = fit_averaged(data, training, progress)
    return PublishedFit(core, data.encoding, gates)


def _rtf(prepared: Prepared, settings: ModelSettings, progress: Progress) -> PublishedFit:
    data = RawData.of(prepared)
    core, gates = fit_rtf(data, settings.degree)
    return PublishedFit(core, data.encoding, gates)


_FITS: dict[str, Callable[[Prepared, ModelSettings, Progress], PublishedFit]] = {
    "taylor": _taylor,
    "hanika": _hanika,
    "schrade": _schrade,
    "zheng-adaptive": _zheng,
    "neurolens2017": _neurolens,
    "rtf": _rtf,
}
