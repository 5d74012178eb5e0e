"""Random lenses that nobody has tuned anything to, as files for `neurolens survey`: DIR/FAMILY-SEED.toml.

Triplets from scratch (powers, bendings, glasses and gaps drawn), and lenses of the library changed to others: every
curvature, thickness and index, the size from 3 to 600 mm, field and f-number, aspheres put on. Rims are derived.
A lens is kept if it passes the checks of `neurolens lens`: image behind the glass, clear edges, light at the edge of
the field, and on the axis a blur of at most `MOST_BLUR` of the focal length. Lens K of seed S is always the same.
"""

from __future__ import annotations

import argparse
import math
import random
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from experiments import lab
from neurolens.base.errors import InputError
from neurolens.commands.convert import write_checked
from neurolens.optics.lenscheck import axial_blur_mm, check_lens
from neurolens.optics.lensfile import read_lens
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Lens, Surface
from neurolens.optics.pupils import image_radius_mm
from neurolens.optics.rims import narrowed_rims
from neurolens.readers.assemble import finish
from neurolens.readers.openings import with_rims

MOST_BLUR = 0.02
_TRIES = 4000  # of one lens: most drawn tables are no lens
_FAMILIES: dict[str, tuple[str, ...]] = {
    "triplet": (),
    "gauss": ("laikin_double_gauss_50", "smith_double_gauss_100", "tronnier_double_gauss_100", "merte_biotar_100"),
    "retrofocus": ("mori_retrofocus_100", "tajima_retrofocus_24", "angenieux_retrofocus_35", "canon_gauss_35"),
    "telephoto": ("sigler_telephoto_100", "ogawa_zoom_70_200", "nikon_zoom_70_200"),
    "fisheye": ("muller_fisheye_100", "horimoto_fisheye_16", "mizuguchi_fisheye_10", "takahashi_retrofocus_100"),
    "asphere": ("canon_aspheric_50", "sony_sonnar_55", "laikin_double_gauss_127", "phone_lens_6"),
    "old": ("brendel_tessar_100", "petzval_portrait_100", "schaefter_primoplan_100", "cooke_triplet_50"),
}
OPTIONS = (
    lab.count("count", 70, "lenses (default 70)"),
    lab.count("seed", 1, "of the random numbers (default 1)", 0),
    lab.option("--strength", type=float, default=0.06, help="relative change of tables (default 0.06)"),
    lab.option("--out", metavar="DIR", type=Path, required=True, help="folder for the lens files"),
    lab.QUIET,
)


def run(args: argparse.Namespace) -> int:
    """Write the lenses, family by family in turn."""
    warnings.simplefilter("ignore")
    args.out.mkdir(parents=True, exist_ok=True)
    names = [f"{list(_FAMILIES)[k % len(_FAMILIES)]}-{args.seed}-{k}" for k in range(args.count)]
    for name, report in lab.stages(names, str, args.quiet):
        lens = random_lens(name, args.strength, report)
        write_checked(lens, args.out / f"{name}.toml")
    return 0


def random_lens(name: str, strength: float, report: Callable[[float], object] = lambda _: None) -> Lens:
    """The first valid lens that a name, FAMILY-..., draws; the tables change less the longer that takes."""
    chance, family = random.Random(name), name.partition("-")[0]
    for k in range(_TRIES):
        report(k / _TRIES)
        start = _triplet(chance) if family == "triplet" else _changed(_library(chance, family), strength, chance)
        strength *= 0.998
        try:
            lens = _finished(replace(start, name=name, path=f"{name}.toml"), chance, family)
        except InputError:
            continue
        if all(not c.doubt or "blur" in c.quantity for c in check_lens(lens)):
            return lens
    raise InputError("experiments random-lenses", "name", name, f"a valid lens among {_TRIES} drawn ones")


def _library(chance: random.Random, family: str) -> Lens:
    return read_lens(lab.LENSES / f"{chance.choice(_FAMILIES[family])}.toml")


def _triplet(chance: random.Random) -> Lens:
    """Three single elements in air, f = 1 or so: crown, flint behind which the stop is, crown."""
    rows: list[Surface] = []
    for place, power in enumerate((2.0, -3.8, 2.6)):
        n = chance.uniform(1.58, 1.75) if power < 0 else chance.uniform(1.6, 1.75)
        phi, bend = power * chance.gauss(1, 0.12), chance.gauss((0.8, 0.0, -0.6)[place], 0.4)
        total = phi / (n - 1)  # c1 - c2
        front, back = total * (1 + bend) / 2, -total * (1 - bend) / 2
        thick, gap = chance.uniform(0.03, 0.09), chance.uniform(0.08, 0.16)
        V_d = chance.uniform(28, 38) if power < 0 else chance.uniform(48, 62)
        rows += [Surface(1 / front, thick, math.nan, n, V_d), Surface(1 / back, gap, math.nan)]
        if power < 0:
            rows.append(Surface(math.inf, 0.02, math.nan, stop=True))
    return Lens("", "random", tuple(rows), chance.uniform(2.8, 8), half_field_deg=chance.uniform(8, 24))


def _changed(lens: Lens, strength: float, chance: random.Random) -> Lens:
    """All figures of a table changed, media by their figures alone, rims unknown."""
    rows = []
    for s in lens.surfaces:
        gap = float(s.thickness_mm) * math.exp(chance.gauss(0, 2 * strength))
        glass = s.n_d != 1
        row = replace(
            s,
            radius_mm=s.radius_mm / chance.gauss(1, strength),
            thickness_mm=gap,
            diameter_mm=math.nan,
            n_d=min(max(s.n_d + chance.gauss(0, 0.01), 1.43), 2.0) if glass else 1.0,
            V_d=min(max((s.V_d or 50) * chance.gauss(1, 0.05), 18), 95) if glass else None,
            asphere=tuple((p, a * chance.gauss(1, strength)) for p, a in s.asphere),
            glass=None, material=None, coating=None,
        )  # fmt: skip
        rows.append(row)
    edge = lens.half_field_deg or math.degrees(math.atan(image_radius_mm(lens.at())[0] / abs(first_order(lens).efl_mm)))
    return replace(
        lens, surfaces=tuple(rows), aperture=None, configurations=(),
        f_number=lens.f_number * chance.uniform(1.0, 1.6), half_field_deg=edge * chance.uniform(0.7, 1.0),
        designer="", source="random", notes="", rims="derived",
        image_radius_mm=None, stated_efl_mm=None, stated_efl_x_mm=None,
    )  # fmt: skip


def _finished(lens: Lens, chance: random.Random, family: str) -> Lens:
    """The lens of another size, its film in the focus, its rims derived, with new aspheres at times.

    Raises:
        InputError: it is none.
    """
    lens = replace(lens, rims="derived")
    efl = first_order(lens.with_stop_radius(1e-3)).efl_mm
    if not 0 < efl < math.inf:
        raise InputError(lens.path, "focal length", efl, "one above 0")
    lens = lens.scaled(math.exp(chance.uniform(math.log(3), math.log(600))) / efl)
    lens = with_rims(finish(lens, film_given=False))
    if family == "asphere" or chance.random() < 0.2:
        rows = [_aspheric(s, chance) if chance.random() < 0.25 and not s.stop else s for s in lens.surfaces]
        lens = finish(narrowed_rims(replace(lens, surfaces=tuple(rows))), film_given=False)
    if axial_blur_mm(lens) > MOST_BLUR * first_order(lens).efl_mm:
        raise InputError(lens.path, "blur", axial_blur_mm(lens), f"at most {MOST_BLUR} of the focal length")
    return lens


def _aspheric(s: Surface, chance: random.Random) -> Surface:
    """A conic, and powers 4 and 6 of up to a thousandth of the rim."""
    h = s.semi_diameter_mm
    terms = {p: chance.gauss(0, 5e-4) * h ** (1 - p) for p in (4, 6)}
    for p, a in s.asphere:
        terms[p] = terms.get(p, 0.0) + a
    curved = 0.0 if math.isinf(s.radius_mm) else chance.gauss(0, 0.3)
    return replace(s, conic=s.conic + curved, asphere=tuple(sorted(terms.items())))
