"""Small surrogates of real lenses for tests, fitted in about a second each and kept while the tests run."""

import base64
import json
import math
import tempfile
import warnings
import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import onnx

from experiments.accuracy.published import PublishedSettings, fit_any
from experiments.data.refit import refitted
from neurolens.base.errors import NeurolensWarning
from neurolens.cameras.exact import ExactCamera
from neurolens.models.card import CARD_KEY, MODEL_KEY, read_card
from neurolens.models.export import export_onnx
from neurolens.models.fit import ModelSettings, Prepared, as_model, fit_model, prepare
from neurolens.models.fitted import Domain
from neurolens.models.model import LensModel
from neurolens.models.network import fit_network
from neurolens.models.pairs import PairSettings, domain_of, make_pairs
from neurolens.models.source import at_wavelength
from neurolens.models.targets import TRANSMITTANCE_TERMS
from neurolens.models.transmittance import with_transmittance
from neurolens.optics.lens import designs, paraxial
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens

LENSES = Path(__file__).parents[1] / "lenses"
GAUSS, FISHEYE, COLOURLESS = "laikin_double_gauss_50", "horimoto_fisheye_16", "muller_fisheye_100"
KINDS = ("invariants", "network", "thick", "fisheye")
GATED = ("singlet", "hemisphere")  # lenses whose rays are lost at surfaces, too
PUBLISHED = ("hanika", "schrade", "rtf", "taylor", "cells", "neurolens2017", "ray-lut")
_FITS = {
    "invariants": ModelSettings("dense", degree=4),
    "thick": ModelSettings("thick"),
    "residual": ModelSettings("ols+mlp", terms=12, degree=5, planes=False, units=8, layers=1, steps=60),
    "hanika": PublishedSettings("hanika", degree=3),
    "schrade": PublishedSettings("schrade", degree=5, terms=12),
    "rtf": PublishedSettings("rtf", degree=4),
    "taylor": PublishedSettings("taylor", degree=3),
    "ray-lut": PublishedSettings("ray-lut", units=6),
    "cells": PublishedSettings("zheng-adaptive", terms=6, partitions=2),
    "neurolens2017": PublishedSettings("neurolens2017", units=16, layers=2, steps=60, partitions=2),
}


@cache
def lens(name: str = GAUSS) -> Lens:
    return set_lens(read_lens(LENSES / f"{name}.toml"), focal_length_mm=14.0 if "muller" in name else None)


@cache
def coated() -> Lens:
    """The double Gauss with seven films on each surface between glass and air."""
    return designs.coated(lens(), "multi-layer")


@cache
def domain(name: str = GAUSS) -> Domain:
    return domain_of(lens(name), focus_m=(math.inf, 0.7))


@cache
def exact_camera(focus_m: float, f_number: float | None) -> ExactCamera:
    """The traced lens on 36 x 24 mm, in the bounds of `domain`: the search for its outline takes a second."""
    return ExactCamera(lens(), Shot((36.0, 24.0), focus_m, f_number), bounds=domain().bounds)


@cache
def prepared(name: str = GAUSS) -> Prepared:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NeurolensWarning)
        return prepare(make_pairs(lens(name), domain(name), PairSettings(train=6000, held_out=100, rim=6000)))


@cache
def anamorphic() -> Prepared:
    """Pairs of a lens with cylinders, focused at infinity, where its shipped model knows the pupil, whose search takes
    seconds."""
    lens = set_lens(read_lens(LENSES / "cooke_anamorphic_42.toml"))
    known = Domain.from_dict(read_card(LENSES.with_name("models") / "cooke_anamorphic_42.ols-64.onnx")["domain"])
    far = (known.film_z_mm[0],) * 2
    shot = {"film_radius_mm": 10.0, "film_z_mm": far, "focus_m": (math.inf, math.inf), "wavelength_nm": (400.0, 700.0)}
    return prepare(make_pairs(lens, replace(known, **shot), PairSettings(5000, 3000, 5000)))


@cache
def gated(name: str) -> Prepared:
    """Pairs of one of `GATED`: rays that miss a surface or are totally reflected have gates of their own."""
    lens, radius_mm = hemisphere(), 12.0
    if name == "singlet":
        lens, radius_mm = read_lens(LENSES / "thorlabs_lb1471_biconvex_50.toml"), None
    with warnings.catch_warnings():
        warnings.simplefilter("error", NeurolensWarning)  # every lost ray is told by a gate
        # One film plane: best focus of the outer zones of so strong elements is millimetres away.
        film_z = paraxial.film_z_mm(lens, 2.0)
        domain = domain_of(lens, film_radius_mm=radius_mm, focus_m=(2.0, 2.0), film_z_mm=(film_z, film_z))
        return prepare(make_pairs(lens, domain, PairSettings(train=5000, held_out=100, rim=5000)))


def hemisphere() -> Lens:
    """A half ball with its flat side to the scene, lit far off its axis: rays miss the ball, or never leave."""
    surfaces = (
        Surface(math.inf, 2.0, 16.0, stop=True),
        Surface(math.inf, 9.9, 19.8, 1.6, 40.0),
        Surface(-10.0, 12.0, 19.8),
    )
    return set_lens(Lens("half ball", "", surfaces, 2.0, path="half_ball.toml"), focus_m=2.0)


@cache
def model(kind: str) -> LensModel:
    """A model of each kind.

    `KINDS` (each kind of core, first order, a fisheye whose rays graze its front), `GATED`, `PUBLISHED` (after which
    " fisheye" takes that lens), or "residual" network, "laser" (one wavelength), "colourless" (a fisheye
    without known dispersion), "cylinders", "cylinders network"; "coated" or "coated network": those of the invariants
    and "residual", whose transmittance is fitted again to the multi-coated lens.
    """
    if kind.startswith("coated"):
        return refitted([model("residual" if "network" in kind else "invariants")], [coated()], TRANSMITTANCE_TERMS)[0]
    if kind in ("fisheye", "colourless"):
        return fit_model(prepared(FISHEYE if kind == "fisheye" else COLOURLESS), _FITS["invariants"])
    if kind == "network":
        settings = ModelSettings("mlp", units=12, steps=4)
        known, train = as_model(prepared(), fit_network(prepared(), settings), settings, 0.0), prepared().pairs.train
        return with_transmittance([known], [(train.inputs, train.transmittance)], 12)[0]
    if kind == "laser":
        return at_wavelength(model("invariants"), 550.0)
    if kind.startswith("cylinders"):
        network = ModelSettings("mlp", units=12, layers=2, steps=25)
        return fit_model(
            anamorphic(), network if "network" in kind else ModelSettings(terms=48, degree=4, planes=False)
        )
    if kind in GATED:
        return fit_model(gated(kind), ModelSettings("ols", terms=40, planes=False))
    method, _, other = kind.partition(" ")
    return fit_any(prepared(FISHEYE if other else GAUSS), _FITS[method])


@cache
def exported(kind: str) -> Path:
    """The ONNX file of `model(kind)`."""
    return export_onnx(model(kind), Path(_folder().name) / f"{kind}.onnx", {"rms_um": 1.0})


def edited(source: Path, target: Path, change: Callable[[dict[str, Any]], object], key: str = CARD_KEY) -> Path:
    """A model file whose card, or whose stored coefficients (`MODEL_KEY`), were changed in place."""
    proto = onnx.load(str(source))
    entry = next(e for e in proto.metadata_props if e.key == key)
    packed = key == MODEL_KEY
    data = json.loads(zlib.decompress(base64.b64decode(entry.value)) if packed else entry.value)
    change(data)
    text = json.dumps(data)
    entry.value = base64.b64encode(zlib.compress(text.encode())).decode() if packed else text
    target.write_bytes(proto.SerializeToString())
    return target


@cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="neurolens-tests-")
