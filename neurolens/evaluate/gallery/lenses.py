"""The lens of a panel, exact and as a surrogate that is fitted once to all shots of one state of the lens."""

from __future__ import annotations

import hashlib
import json
import math
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from neurolens import __version__
from neurolens.base.errors import NeurolensWarning
from neurolens.base.progress import Report
from neurolens.cameras.model import load_model
from neurolens.evaluate.gallery.settings import Panel
from neurolens.evaluate.measure import fit_and_measure, known_record
from neurolens.optics.lensfile import read_lens
from neurolens.optics.paraxial import film_z_mm, first_order
from neurolens.optics.prescription import Lens, Surface
from neurolens.render.pictures import make_aperture
from neurolens.render.scene import Scene
from neurolens.surrogates.domain import Domain, domain_of
from neurolens.surrogates.fit import ModelSettings, prepare
from neurolens.surrogates.pairs import PairSettings, make_pairs

_CLEAR = 0.95  # rims over the radius of curvature, at most
_VIGNETTING_RAYS = 50_000


@dataclass(frozen=True)
class Shot:
    """A panel with its lens and scene.

    Attributes:
        lens: in its state (size, zoom, widened, groups focused), stop at the shot's f-number, film in its place.
        focus_m, f_number, film_mm: as set. offset_mm: of the film from where first order focuses this lens.
    """

    panel: Panel
    scene: Scene
    lens: Lens
    focus_m: float
    f_number: float
    film_mm: tuple[float, float]
    offset_mm: float

    @property
    def wavelength_nm(self) -> tuple[float, float]:
        return self.scene.settings.camera.wavelengths_nm


@dataclass(frozen=True)
class Surrogate:
    """An exported model, the domain it was fitted to, and its record (`rms_um`, ...; see `records.ModelRecord`)."""

    file: Path
    domain: Domain
    record: dict[str, Any]


def shot_of(panel: Panel, scene: Scene) -> Shot:
    """The lens and the settings of a panel.

    Raises:
        InputError: as `read_lens` and `Lens.at`.
    """
    camera = scene.settings.camera
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NeurolensWarning)  # a lens of one wavelength is what the file asks for
        lens = read_lens(panel.lens).at(focal_length_mm=panel.efl_mm, field_deg=panel.field_deg, zoom=panel.zoom)
    lens = widened(lens, panel.widen)
    shape = make_aperture(panel.blades, panel.blade_rotation_deg, panel.blade_curvature, panel.aperture_mask)
    lens = lens.with_aperture(shape or scene.aperture or lens.aperture)
    focus_m = camera.focus_m if panel.focus_m is None else panel.focus_m
    f_number = panel.f_number or camera.f_number or float(first_order(lens).f_number)
    lens = lens.at(f_number=f_number, focus_m=focus_m, focus=panel.focusing)
    assert lens.film_z_mm is not None  # `at` places the film
    film_z = float(lens.film_z_mm) + panel.film_offset_mm
    lens = replace(lens, infinity_mm=())  # groups that have moved to focus stay there
    return Shot(
        panel,
        scene,
        replace(lens, film_z_mm=film_z),
        focus_m,
        f_number,
        panel.film_mm or (camera.film_width_mm, camera.film_height_mm),
        film_z - film_z_mm(lens, focus_m),
    )


def widened(lens: Lens, factor: float) -> Lens:
    """The lens with all rims but the stop's wider by a factor, none near its surface's radius of curvature."""

    def wider(s: Surface) -> Surface:
        if s.stop or factor == 1:
            return s
        most = 2 * _CLEAR * abs(float(s.radius_mm))
        return replace(s, diameter_mm=max(s.diameter_mm, min(factor * s.diameter_mm, most)))

    return replace(lens, surfaces=tuple(wider(s) for s in lens.surfaces))


def same_state(a: Shot, b: Shot) -> bool:
    """Whether one surrogate serves both: the same glass and fit, whatever the stop and the film's place."""
    same = a.lens.sha256 == b.lens.sha256 and a.panel.fit == b.panel.fit
    return same and a.panel.model == b.panel.model and a.wavelength_nm == b.wavelength_nm


def surrogate_of(shots: Sequence[Shot], cache: Path, report: Report) -> Surrogate:
    """The shipped model that the shots name, or one fitted to all of them, taken from `cache` if it is there.

    Args:
        shots: of one state of the lens (`same_state`).
    """
    named = shots[0].panel.model
    if named is not None:
        card = load_model(named).card
        return Surrogate(named, Domain.from_dict(card["domain"]), dict(card["errors"]))
    lens = min((s.lens for s in shots), key=lambda each: -each.stop_radius_mm).with_aperture(None)
    films = [float(s.lens.film_z_mm or 0) for s in shots]
    asked = {
        "film_radius_mm": max(math.hypot(*s.film_mm) / 2 for s in shots),
        "film_z_mm": (min(films), max(films)),
        "focus_m": (max(s.focus_m for s in shots), min(s.focus_m for s in shots)),
        "wavelength_nm": shots[0].wavelength_nm,
    }
    return fitted(lens, asked, shots[0].panel.fit, cache, report)


def fitted(
    lens: Lens,
    asked: dict[str, Any],
    fit: ModelSettings,
    cache: Path,
    report: Report,
    pairs: PairSettings = PairSettings(),  # noqa: B008  frozen
) -> Surrogate:
    """A surrogate of `lens` over the domain `asked` (arguments of `domain_of`), kept in `cache`."""
    made_of = [__version__, lens.sha256, lens.stop_radius_mm, asked, asdict(fit), asdict(pairs)]
    fingerprint = hashlib.sha256(json.dumps(made_of, sort_keys=True, default=str).encode()).hexdigest()
    folder = cache / f"{lens.lens_id}-{fingerprint[:12]}"
    file = folder / f"{fit.label}.onnx"
    made = sorted(folder.glob(f"{fit.label}.json"))
    if made and file.is_file():
        told = json.loads(made[0].read_text(encoding="utf-8"))
        record = known_record(made[0], file, told.get("fingerprint", ""))
        if record is not None:
            return Surrogate(file, Domain.from_dict(load_model(file).card["domain"]), record)
    folder.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NeurolensWarning)  # its errors stand in the table
        domain = domain_of(lens, **asked)
        prepared = prepare(make_pairs(lens, domain, pairs))
        measured = fit_and_measure(prepared, fit, folder, _VIGNETTING_RAYS, report)
    return Surrogate(measured.file, domain, measured.record)
