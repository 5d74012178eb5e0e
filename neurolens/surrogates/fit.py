"""One interface to every surrogate: settings in, complete model out."""

from __future__ import annotations

import itertools
import math
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Literal, cast, get_args

from neurolens.base import status as st
from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.surrogates.cores import Basis, Core, RawPolynomial, Residual
from neurolens.surrogates.fits.checkpoint import of_zone, spent_s
from neurolens.surrogates.fits.mirror import fit_mirror
from neurolens.surrogates.fits.mlp import fit_network
from neurolens.surrogates.fits.paraxial import fit_paraxial
from neurolens.surrogates.fits.partition import ZoneCore, fit_partitioned
from neurolens.surrogates.fits.planes import fit_planes
from neurolens.surrogates.fits.polynomial import Method as PolynomialMethod
from neurolens.surrogates.fits.polynomial import PolynomialSettings, fit_polynomial
from neurolens.surrogates.fits.target import TERMS_LADDER, first_order_um, reach
from neurolens.surrogates.gates import choose_gates, explained
from neurolens.surrogates.lightfield import Encoding, fit_encoding
from neurolens.surrogates.lit import draw_everywhere
from neurolens.surrogates.model import Gate, LensModel
from neurolens.surrogates.pairs import RayPairs, trace_pairs
from neurolens.surrogates.targets import scales_of
from neurolens.surrogates.threads import pinned_threads

PublishedName = Literal["taylor", "hanika", "schrade", "zheng-adaptive", "neurolens2017", "rtf"]
Method = Literal["thin", "thick", "dense", "omp", "ols", "adaptive", "mlp", "ols+mlp", PublishedName]
POLYNOMIALS = ("dense", "omp", "ols", "adaptive")
NETWORKS = ("mlp", "ols+mlp")
PLANES_SEARCHED = ("ols", "adaptive", "ols+mlp")
# Rays drawn over the domain to find what blocks anything: a share of 1e-4 is 20 of them.
_GATE_RAYS = 200_000
# About 5000 candidate columns, whose Gram matrix takes 200 MB.
_MOST_DEGREE = {"invariants": 16, "raw": 11}


@dataclass(frozen=True)
class ModelSettings:
    """One surrogate of an experiment.

    Attributes:
        name: of the file and of the table's row; made from the other settings where empty.
        method: "thin", "thick" (first order); "dense", "omp", "ols", "adaptive" (polynomials); "mlp"; "ols+mlp" (a
            polynomial and a network on what it leaves); the published methods of `neurolens.surrogates.published`.
        basis, terms, degree, replacement, elimination, growth, position_weight, transmittance_terms: see
            `PolynomialSettings`.
        planes: whether `PLANES_SEARCHED` methods in the invariants search the planes of the light field.
        partitions: zones of the film with a fit of their own (polynomials and networks).
        units, layers: of the network. steps, seconds: its training ends by either, or by convergence; results repeat
            bit for bit where the time does not end it.
        seed: of the network's first weights.
        target_um: film-equivalent RMS asked for. Polynomials take the fewest terms of `TERMS_LADDER` that reach it; a
            fit that does not reach it warns and gives its best.

    Raises:
        InputError: numbers that ask for more than a fit can hold, or for less than one.
    """

    method: Method = "ols"
    name: str = ""
    basis: Basis = "invariants"
    terms: int = 40
    degree: int = 7
    replacement: bool = True
    elimination: bool = True
    growth: int = 2
    position_weight: float = 2.0
    transmittance_terms: int = 16
    planes: bool = True
    partitions: int = 1
    units: int = 16
    layers: int = 2
    steps: int = 300
    seconds: float = 60.0
    seed: int = 0
    target_um: float | None = None

    def __post_init__(self) -> None:
        most_degree = _MOST_DEGREE[self.basis] if self.basis in _MOST_DEGREE else min(_MOST_DEGREE.values())
        limits = {
            "terms": (1, 2000),
            "degree": (0, most_degree),
            "growth": (0, 16),
            "transmittance_terms": (0, 200),
            "partitions": (1, 64),
            "units": (1, 512),
            "layers": (1, 8),
            "steps": (1, 100_000),
        }
        for name, (least, most) in limits.items():
            if not least <= getattr(self, name) <= most:
                raise InputError("settings", name, getattr(self, name), f"an integer from {least} to {most}")
        if not 0 < self.seconds:
            raise InputError("settings", "seconds", self.seconds, "a number above 0")
        if not 0 < self.position_weight < math.inf:
            raise InputError("settings", "position_weight", self.position_weight, "a number above 0")
        if self.target_um is not None and not 0 < self.target_um < math.inf:
            raise InputError("settings", "target_um", self.target_um, "micrometres above 0, or none")

    @property
    def label(self) -> str:
        """The name, or one made from the settings: "ols-40", "raw-omp-80", "dense-d4", "mlp-16x2"."""
        if self.name:
            return self.name
        zones = f"-{self.partitions}zones" if self.partitions > 1 else ""
        if self.target_um is not None:
            zones += f"-to-{self.target_um:g}um"
        if self.method in NETWORKS:
            before = f"ols-{self.terms}-" if self.method == "ols+mlp" else ""
            return f"{before}mlp-{self.units}x{self.layers}{zones}"
        if self.method in ("thin", "thick"):
            return self.method
        size = f"-d{self.degree}" if self.method == "dense" else f"-{self.terms}"
        return f"{'raw-' if self.basis == 'raw' else ''}{self.method}{'' if self.climbs else size}{zones}"

    @property
    def climbs(self) -> bool:
        """Whether the fit chooses the number of terms by the error asked for."""
        return self.target_um is not None and self.method in ("omp", "ols", "adaptive")

    @property
    def family(self) -> str:
        return "paraxial" if self.method in ("thin", "thick") else self.method


@dataclass(frozen=True)
class Prepared:
    """Ray pairs with what all fits share: encoding and gates. `lost_share`: lost rays of the domain that no gate tells.

    Lost rays miss a surface or are totally reflected.
    """

    pairs: RayPairs
    encoding: Encoding
    gates: tuple[Gate, ...]
    lost_share: float


def prepare(pairs: RayPairs) -> Prepared:
    """Find the encoding, and the rims and discriminants that block anything in the domain.

    Warns:
        NeurolensWarning: more than one ray in 10,000 is lost in a way that no gate can tell (beyond 90 degrees to a
            plane, or on the far half of a sphere).
    """
    seed = pairs.settings.seed + 1_000_003
    with pinned_threads():
        drawn = trace_pairs(pairs.lens, draw_everywhere(pairs.domain, _GATE_RAYS, seed), pairs.domain.pupil_z_mm)
    blocked = drawn.select(drawn.status != st.PASSED)
    gates = choose_gates(pairs.lens, blocked, len(drawn))
    untold = (blocked.status % 4 != st.RIM) & ~explained(pairs.lens, gates, blocked)
    lost = float(untold.double().sum()) / len(drawn)
    if lost > 1e-4:
        warnings.warn(
            f"{pairs.lens.path}: {100 * lost:.2f}% of the domain's rays end by missing a surface or by total "
            "reflection in a way that no gate can tell; the rims near by stand in for that boundary",
            NeurolensWarning,
            stacklevel=2,
        )
    return Prepared(pairs, fit_encoding(pairs.domain, pairs.train, mirror=pairs.lens.anamorphic), gates, lost)


def fit_model(
    prepared: Prepared,
    settings: ModelSettings,
    progress: Callable[[float], None] | None = None,
    *,
    checkpoint: Path | None = None,
    error_um: Callable[[LensModel], float] | None = None,
) -> LensModel:
    """Fit one surrogate.

    Args:
        checkpoint: file in which the training of networks keeps its state, to go on from there after a kill (see
            `fit_network`). It stays when the fit has ended; `checkpoint.clear` removes it.
        error_um: film-equivalent RMS of a model, for `target_um`; None takes first order on rays held out.

    Raises:
        InputError: an unknown method, or settings that the method refuses.

    Warns:
        NeurolensWarning: the error asked for is not reached.
    """
    start = time.perf_counter()
    rungs = [settings]
    if settings.climbs:
        rungs = [replace(settings, terms=t) for t in TERMS_LADDER if t < len(prepared.pairs.train)]
    models = (_fit_once(prepared, rung, progress, checkpoint) for rung in rungs)
    if settings.target_um is None:
        best = next(models)
    else:
        best = reach(models, settings.target_um, error_um or first_order_um(prepared.pairs))
    return replace(best, fit_s=max(time.perf_counter() - start, spent_s(checkpoint)))


def _fit_once(
    prepared: Prepared, settings: ModelSettings, progress: Callable[[float], None] | None, checkpoint: Path | None
) -> LensModel:
    encoding, gates = prepared.encoding, prepared.gates
    with pinned_threads():
        if settings.method in get_args(PublishedName):
            from neurolens.surrogates.published import fitting  # published methods need this module's types

            core, encoding, gates = fitting.fit_published(prepared, settings, progress)
        else:
            if settings.planes and settings.basis == "invariants" and settings.method in PLANES_SEARCHED:
                encoding = fit_planes(prepared.pairs, encoding, settings.terms, settings.position_weight)
            core = _fit_core(replace(prepared, encoding=encoding), settings, progress, checkpoint)
    pairs = prepared.pairs
    return LensModel(
        lens=pairs.lens,
        domain=pairs.domain,
        encoding=encoding,
        scales=scales_of(pairs.lens),
        gates=gates,
        core=core,
        method=settings.label,
        settings={**asdict(settings), "rays": len(pairs.train), "rays_seed": pairs.settings.seed},
        direction="slope" if settings.family == "paraxial" else "angle",
    )


def _fit_core(
    prepared: Prepared, settings: ModelSettings, progress: Callable[[float], None] | None, checkpoint: Path | None
) -> Core:
    pairs, encoding, gates = prepared.pairs, prepared.encoding, prepared.gates
    if settings.method in ("thin", "thick") and not encoding.mirror:
        return fit_paraxial(pairs, encoding, gates, settings.method)
    if settings.method not in (*POLYNOMIALS, *NETWORKS):
        known = ("thin", "thick", *POLYNOMIALS, *NETWORKS, *get_args(PublishedName))
        raise InputError("fit", "method", settings.method, f"one of {', '.join(known)}")

    if encoding.mirror and settings.method != "mlp":
        return fit_mirror(pairs, encoding, gates, settings.method, settings.terms, settings.degree)
    zones = itertools.count()

    def fit(zone: RayPairs) -> ZoneCore:
        base = None
        if settings.method != "mlp":
            base = fit_polynomial(zone, encoding, gates, _polynomial_settings(settings))
        if settings.method not in NETWORKS:
            assert base is not None
            return base
        if isinstance(base, RawPolynomial):
            raise InputError("fit", "basis", settings.basis, "invariants, with a network beside the polynomial")
        network = fit_network(
            zone,
            encoding,
            gates,
            units=settings.units,
            layers=settings.layers,
            seed=settings.seed,
            seconds=settings.seconds,
            steps=settings.steps,
            base=base,
            checkpoint=of_zone(checkpoint, next(zones)),
            progress=progress,
        )
        return network if base is None else Residual((base, network))

    return fit_partitioned(pairs, encoding, settings.partitions, fit)


def _polynomial_settings(settings: ModelSettings) -> PolynomialSettings:
    method = "ols" if settings.method == "ols+mlp" else cast(PolynomialMethod, settings.method)
    shared = {f.name: getattr(settings, f.name) for f in fields(PolynomialSettings)}
    return PolynomialSettings(**shared | {"method": method})
