"""The published surrogates of lenses, as rows of the benchmark beside ours: who, and with which settings.

All are our own implementations of the papers: none runs its authors' code. Each method has its own module, whose
docstring says what the paper does, what it leaves open and what was chosen. All are fitted on the same rays as ours
(`fit_model`), are written by the same writers (ONNX, C) and are measured by the same code; their tests of who passes
are their own.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from experiments.accuracy.published.adaptive import fit_adaptive
from experiments.accuracy.published.data import PublishedSettings, RawData, outer_pupil
from experiments.accuracy.published.neural import fit_averaged
from experiments.accuracy.published.polynomials import fit_dense, fit_sparse
from experiments.accuracy.published.raylut import fit_table
from experiments.accuracy.published.rtf import fit_rtf
from experiments.accuracy.published.taylor import fit_taylor
from neurolens.base.errors import InputError
from neurolens.models.cores import Core
from neurolens.models.fit import as_model, fit_model
from neurolens.models.fitted import Encoding, Gate
from neurolens.models.model import LensModel
from neurolens.models.targets import ModelSettings, Prepared
from neurolens.models.terms import pinned_threads

__all__ = ["NAMED", "PUBLISHED", "PublishedMethod", "PublishedSettings", "fit_any", "fit_published"]


class PublishedMethod(NamedTuple):
    """Where a method was published, and the settings of its rows; the first are those that the paper prefers.

    `limit` is what keeps its figures from being fair to it, and stands beside its name in every table.
    """

    citation: str
    presets: tuple[ModelSettings, ...]
    limit: str = ""


PUBLISHED: dict[str, PublishedMethod] = {
    "taylor": PublishedMethod(
        'Hullin, Hanika, Heidrich 2012, "Polynomial Optics: A Construction Kit for Efficient Ray-Tracing of Lens '
        'Systems", Computer Graphics Forum 31(4)',
        tuple(PublishedSettings("taylor", f"taylor-d{degree}", degree=degree) for degree in (5, 3, 7)),
    ),
    "hanika": PublishedMethod(
        'Hanika and Dachsbacher 2014, "Efficient Monte Carlo Rendering with Realistic Lenses", Computer Graphics '
        "Forum 33(2)",
        tuple(PublishedSettings("hanika", f"hanika-d{degree}", degree=degree) for degree in (5, 4, 3)),
    ),
    "schrade": PublishedMethod(
        'Schrade, Hanika, Dachsbacher 2016, "Sparse high-degree polynomials for wide-angle lenses", Computer Graphics '
        "Forum 35(4)",
        tuple(PublishedSettings("schrade", f"schrade-{terms}", terms=terms, degree=11) for terms in (28, 16, 40)),
    ),
    "zheng-adaptive": PublishedMethod(
        'Zheng and Zheng 2017, "Adaptive sparse polynomial regression for camera lens simulation", The Visual '
        "Computer 33(6-8)",
        tuple(
            PublishedSettings("zheng-adaptive", f"zheng-adaptive-{terms}x{zones}", terms=terms, partitions=zones)
            for terms, zones in ((36, 4), (36, 1))
        ),
    ),
    "neurolens2017": PublishedMethod(
        'Zheng and Zheng 2017, "NeuroLens: Data-Driven Camera Lens Simulation Using Neural Networks", Computer '
        "Graphics Forum 36(8); here 24,000 steps of 128 rays a network",
        (PublishedSettings("neurolens2017", "neurolens2017-128x3", partitions=2, units=128, layers=3, steps=24_000),),
        "not converged",
    ),
    "rtf": PublishedMethod(
        'Goossens et al. 2022, "Ray-transfer functions for camera simulation of 3D scenes with hidden lens design", '
        "Optics Express 30(13)",
        tuple(PublishedSettings("rtf", f"rtf-d{degree}", degree=degree) for degree in (6, 4, 8)),
    ),
    "ray-lut": PublishedMethod(
        'Honsbrok, Mostafawy, Herder, Huldtgren 2025, "Ray-LUT: A Lookup-Based Method for Camera Lens Simulation in '
        'Real-Time Using Ray Tracing", GRAPP',
        tuple(PublishedSettings("ray-lut", f"ray-lut-{nodes}", units=nodes) for nodes in (8, 16, 32)),
        "judged on a CPU",
    ),
}
# The name of a row with what limits it, by its label.
NAMED = {s.label: f"{s.label}, {m.limit}" for m in PUBLISHED.values() for s in m.presets if m.limit}


def fit_any(
    prepared: Prepared, settings: ModelSettings, progress: Callable[[float], object] = lambda share: None
) -> LensModel:
    """Fit a published method, or one of ours, and return the complete model.

    Raises:
        InputError: the method is unknown, or it cannot take the lens or the settings.
    """
    if not isinstance(settings, PublishedSettings):
        return fit_model(prepared, settings, progress)
    start = time.perf_counter()
    with pinned_threads():
        core, encoding, gates = fit_published(prepared, settings, progress)
    fitted = replace(prepared, encoding=encoding, gates=gates)
    return as_model(fitted, core, settings, time.perf_counter() - start)


def fit_published(
    prepared: Prepared, settings: PublishedSettings, progress: Callable[[float], object] = lambda share: None
) -> tuple[Core, Encoding, tuple[Gate, ...]]:
    """Fit one published method.

    Returns a core, the coordinates that it is written in, and the tests of who passes that its scalars stand for.

    Raises:
        InputError: an unknown method, or a lens or settings that it cannot take.
    """
    s, method = settings, str(settings.method)
    if method not in PUBLISHED:
        raise InputError("fit", "method", method, f"one of {', '.join(PUBLISHED)}")
    data = RawData.of(prepared, centred=method in ("taylor", "hanika", "ray-lut"))
    core: Core
    if method == "neurolens2017":
        core, gates = fit_averaged(data, s, progress)
    elif method == "rtf":
        core, gates = fit_rtf(data, s.degree)
    elif method == "taylor":
        core, gates = outer_pupil(data, fit_taylor(prepared.pairs.lens, data.encoding, s.degree), 0.0)
    elif method == "ray-lut":
        core, gates = outer_pupil(data, fit_table(data, s.units), 0.0)
    elif method == "hanika":
        core, gates = outer_pupil(data, fit_dense(data, s.degree))
    elif method == "schrade":
        core, gates = outer_pupil(data, fit_sparse(data, s.terms, s.degree))
    else:
        core, gates = outer_pupil(data, fit_adaptive(data, s.terms, s.partitions, progress))
    return core, data.encoding, gates
