"""What flare loses by two habits of public tools: one quarter-wave layer on every surface, and aspheres dropped.

Truth is the lens with its aspheres and today's coatings ("multi-layer": seven films that disperse, made for each
surface's glass) on every surface between glass and air, none where glasses are cemented; beside it the coatings of
other eras. One layer is "quarter-wave": magnesium fluoride of index 1.38 at all wavelengths, a quarter of 550 nm thick.
An asphere dropped is the sphere of its curvature at the vertex, all else as it was, the film too.

Ghosts of two reflections, all pairs, of lights far away at 0.4, 0.8 and 1.2 of the half field, daylight in nine
wavelengths from 400 to 700 nm, the widest stop; counted is the light that falls into the image circle. "Light" is
luminance; "of the image's" is over that of the image of the same light on the axis. Place and colour compare each ghost
with itself and are means weighted by its light in truth: the distance of the centre of its light on film; of its
chromaticity (x, y); and CIELAB's delta E (1976) where both are as bright as middle grey (L* = 50), for brightness is
another column. "10%" and "90%" are ratios of single ghosts that bound a tenth of truth's light.
Ghosts that only one of the two has have no place or colour: their share of truth's light is "gone".

Writes coatings.md, coatings.json, coatings.png.
"""

from __future__ import annotations

import argparse
import math
import statistics
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from experiments import lab
from neurolens.flare.ghosts import GhostTracer, coated
from neurolens.flare.lights import Light, light_rays
from neurolens.optics.coatings import reflectance
from neurolens.optics.designs import design
from neurolens.optics.lensfile import read_lens
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Lens
from neurolens.optics.states import set_lens
from neurolens.render.colour import SRGB
from neurolens.render.spectrum import SpectralRange

Array = NDArray[np.float64]

LENSES = (
    *("laikin_double_gauss_50", "merte_biotar_100", "brendel_tessar_100", "cooke_triplet_50", "canon_gauss_35"),
    *("angenieux_retrofocus_35", "tajima_retrofocus_24", "nakamura_wide_22", "sigler_telephoto_100"),
    *("ogawa_zoom_70_200", "nikon_zoom_70_200"),
    *("canon_aspheric_50", "sony_sonnar_55", "ikemori_retrofocus_14", "nikon_zoom_14_24", "phone_lens_6"),
    *("edmund_asphere_30", "thorlabs_acl5040u_asphere_40"),
)
ERAS = ("bare", "single-layer", "three-layer", "multi-layer")
PRACTICE = "quarter-wave"
FIELDS = (0.4, 0.8, 1.2)  # of the half field
_RAYS, _AT_ONCE, _GLASS = 1024, 256, 1.62
_SPECTRAL = SpectralRange(400.0, 700.0, bins=9)

OPTIONS = [lab.ONLY, lab.out()]


@dataclass(frozen=True)
class Seen:
    """What arrives in the image circle, by light and ghost.

    Attributes:
        xyz: [L, P, 3]. centre_um: [L, P, 2]. image: luminance of the light's image on the axis.
    """

    xyz: Array
    centre_um: Array
    image: float


@dataclass(frozen=True)
class Era:
    """Ghost light of the image's, by coating."""

    lens: str
    ghosts: int
    aspheres: int
    light: Mapping[str, float]


@dataclass(frozen=True)
class Cost:
    """One habit on one lens; see the module. `light` is a ratio, `all_um` and `all_colour` are those of all ghosts."""

    lens: str
    light: float
    low: float | None = None
    high: float | None = None
    place_um: float | None = None
    all_um: float | None = None
    colour: float | None = None
    delta_e: float | None = None
    all_colour: float | None = None
    gone: float = 0.0


def run(args: argparse.Namespace) -> int:
    """Measure, write the tables and the picture."""
    lab.quiet_glasses()
    names = lab.chosen(LENSES, str, args.only, "coatings")
    eras: list[Era] = []
    layer: list[Cost] = []
    dropped: list[Cost] = []
    for name, report in lab.stages(names, str, args.quiet, 10.0):
        lens = set_lens(read_lens(lab.LENSES / f"{name}.toml"), focus_m=math.inf)
        seen = {}
        for k, coating in enumerate((*ERAS, PRACTICE)):
            seen[coating] = seen_by(lens if coating == "bare" else coated(lens, coating), lens)
            report(k / 6)
        truth = seen[ERAS[-1]]
        light = {
            coating: float(seen[coating].xyz[..., 1].sum()) / seen[coating].image / len(FIELDS) for coating in ERAS
        }
        aspheres = [k for k, s in enumerate(lens.surfaces) if s.asphere or (s.conic and not s.cylinder)]
        eras.append(Era(name, truth.xyz.shape[1], len(aspheres), light))
        layer.append(cost_of(name, truth, seen[PRACTICE]))
        if aspheres:
            dropped.append(cost_of(name, truth, seen_by(coated(spheres_of(lens), ERAS[-1]), lens)))
    told = {"machine": lab.machine(), "rays": _RAYS, "eras": [asdict(row) for row in eras]}
    told |= {"one_layer": [asdict(row) for row in layer], "dropped": [asdict(row) for row in dropped]}
    print(lab.write_results(args.out, "coatings", _page(eras, layer, dropped), told))
    _draw(args, eras)
    return 0


def spheres_of(lens: Lens) -> Lens:
    """The lens with the sphere of its vertex for each asphere and conic; its film stays."""
    rows = (s if s.cylinder else replace(s, conic=0.0, asphere=()) for s in lens.surfaces)
    return replace(lens, surfaces=tuple(rows))


def seen_by(lens: Lens, framed: Lens) -> Seen:
    """Ghosts of the lights of a lens, and its image on the axis.

    Args:
        framed: has the field and the image circle.
    """
    efl = abs(float(first_order(framed).efl_mm))
    circle, half = framed.image_radius_mm, framed.half_field_deg
    half = half or math.degrees(math.atan((circle or efl * math.tan(math.radians(10))) / efl))
    circle = circle or efl * math.tan(math.radians(half))
    tracer = GhostTracer(lens)
    observer = SRGB.to_xyz @ (_SPECTRAL.response * _SPECTRAL.spectrum((1.0, 1.0, 1.0))) / _SPECTRAL.bins
    shape = len(FIELDS), len(tracer.pairs)
    xyz, moments, image = np.zeros((*shape, 3)), np.zeros((*shape, 2)), 0.0
    starts = [tracer.start(light_rays(lens, Light(min(f * half, 85.0), 0.0), 0, _RAYS)[0]) for f in (0.0, *FIELDS)]
    for k, nm in enumerate(_SPECTRAL.centres_nm):
        image += float(observer[1, k] * tracer.follow(starts[0], float(nm), only=(), direct=True).sums[-1, 0])
        for n, start in enumerate(starts[1:]):
            for first in range(0, len(tracer.pairs), _AT_ONCE):
                found = tracer.follow(start, float(nm), only=tracer.pairs[first : first + _AT_ONCE])
                power = np.where(np.hypot(*np.moveaxis(found.film_xy_mm, 1, 0)) <= circle, found.power, 0)
                some = slice(first, first + _AT_ONCE)
                xyz[n, some] += power.sum(1, dtype=np.float64)[:, None] * observer[:, k]
                place = np.where(power[:, None] > 0, found.film_xy_mm, 0)
                moments[n, some] += observer[1, k] * np.einsum("pn,pcn->pc", power, place, dtype=np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        return Seen(xyz, 1000 * moments / xyz[..., 1:2], image)


def cost_of(name: str, truth: Seen, other: Seen) -> Cost:
    """What differs, as a mean over truth's light."""
    weight, there = truth.xyz[..., 1], (truth.xyz[..., 1] > 0) & (other.xyz[..., 1] > 0)
    seen, total = (truth, other), [xyz.sum((0, 1)) for xyz in (truth.xyz, other.xyz)]
    if not there.any():
        return Cost(name, float(total[1][1] / total[0][1]), gone=1.0)
    shift = np.hypot(*np.moveaxis(other.centre_um - truth.centre_um, -1, 0))
    centres = [np.nansum(s.xyz[..., 1:2] * s.centre_um, (0, 1)) / s.xyz[..., 1].sum() for s in seen]
    ratio = other.xyz[..., 1][there] / weight[there]
    order = np.argsort(ratio)
    at = np.cumsum(weight[there][order]) / weight[there].sum()

    def mean(values: Array) -> float:
        return float((values[there] * weight[there]).sum() / weight[there].sum())

    with np.errstate(invalid="ignore", divide="ignore"):
        apart, colour = _delta_e(truth.xyz, other.xyz), _apart(truth.xyz, other.xyz)
    return Cost(
        name,
        float(total[1][1] / total[0][1]),
        float(ratio[order][np.searchsorted(at, 0.1)]),
        float(ratio[order][np.searchsorted(at, 0.9)]),
        mean(shift),
        float(np.hypot(*(centres[1] - centres[0]))),
        mean(colour),
        mean(apart),
        float(_apart(*total)),
        float(max(weight[~there].sum() / weight.sum(), 0.0)),
    )


def _apart(one: Array, two: Array) -> Array:
    """Distance in (x, y) of colours XYZ [..., 3]."""
    a, b = (xyz[..., :2] / xyz.sum(-1, keepdims=True) for xyz in (one, two))
    return np.asarray(np.hypot(*np.moveaxis(a - b, -1, 0)))


def _delta_e(one: Array, two: Array) -> Array:
    """CIELAB distance of colours XYZ [..., 3] at L* = 50, of a white as D65 (CIE 15)."""
    white = SRGB.to_xyz.sum(1)
    middle = (66 / 116) ** 3

    def lab_of(xyz: Array) -> Array:
        t = xyz / xyz[..., 1:2] * middle / white
        f = np.where(t > (6 / 29) ** 3, np.cbrt(np.maximum(t, 0)), t / (3 * (6 / 29) ** 2) + 4 / 29)
        return np.stack([500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], -1)

    return np.asarray(np.hypot(*np.moveaxis(lab_of(one) - lab_of(two), -1, 0)))


def _page(eras: list[Era], layer: list[Cost], dropped: list[Cost]) -> str:
    return lab.page(
        "# Coatings and aspheres in flare",
        _summary(layer, dropped),
        __doc__ or "",
        "![reflectance of eras, ghost light of lenses](coatings.png)",
        "## Ghost light by era, of the image's",
        lab.table(_ERAS, eras),
        "## One quarter-wave layer in place of today's coatings",
        lab.table(_COSTS, layer, "-"),
        "## Aspheres dropped, today's coatings",
        lab.table(_COSTS, dropped, "-"),
    )


def _summary(layer: list[Cost], dropped: list[Cost]) -> str:
    """What the tables say, in a paragraph."""

    def middle(rows: list[Cost], value: str, form: str) -> str:
        found = [getattr(row, value) for row in rows if getattr(row, value) is not None]
        return f"{statistics.median(found):{form}} ({min(found):{form}} to {max(found):{form}})"

    words = (
        f"Medians over {len(layer)} lenses, with the least and the most. One quarter-wave layer in place of today's "
        f"coatings makes {middle(layer, 'light', '.1f')} times the ghost light, with factors of single ghosts so far "
        "apart that no exposure mends it, and changes the colour of a ghost by a delta E of "
        f"{middle(layer, 'delta_e', '.0f')}. Rays and the outlines of ghosts are the same, but the light lies "
        "elsewhere within them, for another coating favours other angles: the centre of a ghost's light moves by "
        f"{middle(layer, 'place_um', '.0f')} um, that of all by {middle(layer, 'all_um', '.0f')} um."
    )
    if dropped:
        words += (
            f" Aspheres dropped, on {len(dropped)} lenses that have some, make {middle(dropped, 'light', '.2f')} times "
            f"the light; ghosts with {middle(dropped, 'gone', '.1%')} of it are gone, and the centre of one that is "
            f"left moves by {middle(dropped, 'place_um', '.0f')} um, delta E {middle(dropped, 'delta_e', '.0f')}."
        )
    return words + (
        " Truth is a design of ours for today's coatings, as no maker publishes theirs, and real films vary by some "
        "per cent; the ghost light of lenses with the eras' coatings is told first, for other truths."
    )


def _draw(args: argparse.Namespace, eras: list[Era]) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, (by_nm, by_angle, by_lens) = plt.subplots(1, 3, figsize=(15, 4.6), width_ratios=(1, 1, 1.3))
    nm, angle = np.linspace(380, 750, 200), np.linspace(0, 80, 161)
    colours = dict(zip(ERAS, ("0.4", "tab:orange", "tab:green", "tab:blue"), strict=True))
    for name, colour in colours.items():
        layers = design(name, 1.0, _GLASS).layers
        for degrees, style in ((0.0, "-"), (45.0, "--")):
            cos = torch.full((len(nm),), math.cos(math.radians(degrees)), dtype=torch.float64)
            found = 100 * reflectance(cos, 1.0, _GLASS, layers, torch.from_numpy(nm)).numpy()
            by_nm.semilogy(nm, found, style, color=colour)
        cos = torch.cos(torch.deg2rad(torch.from_numpy(angle)))
        by_angle.semilogy(angle, 100 * reflectance(cos, 1.0, _GLASS, layers, 550.0).numpy(), color=colour, label=name)
        by_lens.semilogx([100 * row.light[name] for row in eras], range(len(eras)), "o", color=colour)
    by_nm.set(
        xlabel="nm", ylabel="% reflected", title=f"Glass of {_GLASS}, at 0 and 45 degrees (dashed)", ylim=(0.01, 20)
    )
    by_angle.legend(fontsize=8, loc="lower right")
    by_angle.set(xlabel="degrees from the normal", title="550 nm", ylim=(0.01, 60))
    by_lens.set(xlabel="ghosts, % of the image's light", title="Ghosts by era", yticks=range(len(eras)))
    by_lens.set_yticklabels([row.lens for row in eras], fontsize=7)
    for axes in (by_nm, by_angle, by_lens):
        axes.grid(alpha=0.3)
    figure.tight_layout()
    lab.write_figure(args.out / "coatings.png", figure, 100)


def _era(name: str) -> tuple[Any, ...]:
    return name, lambda row: row.light[name], ".4%"


_ERAS = lab.columns(("lens", "lens"), ("ghosts", "ghosts"), ("aspheres", "aspheres"), *(_era(name) for name in ERAS))
_COSTS = lab.columns(
    ("lens", "lens"),
    ("light, times", "light", ".2f"),
    ("of ghosts, 10%", "low", ".2f"),
    ("to 90%", "high", ".2f"),
    ("gone", "gone", ".1%"),
    ("centre of a ghost, um", "place_um", ".0f"),
    ("of all, um", "all_um", ".0f"),
    ("colour of a ghost, xy", "colour", ".3f"),
    ("delta E", "delta_e", ".0f"),
    ("of all, xy", "all_colour", ".3f"),
)
