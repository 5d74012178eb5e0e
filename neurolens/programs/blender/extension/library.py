"""The facts of the extension's lenses, checks of a camera's settings, and advice on which camera a shot needs.

It is plain Python, without Blender.
"""

from __future__ import annotations

import dataclasses
import json
import math
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

FACTS = "lenses.json"  # beside shaders/ and thumbnails/, in the extension and in its user folder
SCHEMA = 1
PASSES = ("alpha", "cryptomatte", "vector")  # passes that differ from those of Blender's own camera
KINDS = {"polynomial": "Polynomial", "network": "Network", "exact": "Exact"}
CHARACTER = {  # figures of `neurolens lens list`
    "cats_eye": "Cat's Eye", "swirl": "Swirl", "bubble": "Soap Bubbles", "softness_um": "Softness", "flare": "Flare",
}  # fmt: skip
# orders of menus, with their labels
ORDERS = {"focal_length": "Focal Length", "speed": "Speed", "year": "Year", "maker": "Maker", **CHARACTER}
OLDEST = (4, 5, 0)  # the first Blender whose Cycles runs cameras written in OSL
BEYOND = 1.02  # as lenses are engraved, a film of 36 x 24 mm fits an image circle of 43.2 mm
NOMINAL = 1.02  # as lenses are engraved, f/1.8 may stand for f/1.83
FEW = 16  # with fewer samples a pixel, colours are far off where wavelengths part
DAMAGED = (ValueError, KeyError, TypeError, AttributeError, OverflowError)  # errors of reading damaged facts
_HEADROOM = 1.001  # factor on a near limit, for rounding


class LensError(Exception):
    """One sentence that tells the user why nothing was done; the scene is as it was before."""


@dataclass(frozen=True)
class Variant:
    """One shader of a lens.

    Attributes:
        kind: one of `KINDS`. model: the model's name ("ols-64"), "" for an exact lens. path: the OSL source.
        rms_um: error of rays on the film; None for an exact lens. poor: properties that the card calls poor.
        film_radius_mm: of the lens's picture. f_number: the widest. nearest_m: the nearest focus; None if there is
            none.
        notes: sentences on what the shader leaves out.
    """

    kind: str
    model: str
    path: Path
    rms_um: float | None
    film_radius_mm: float
    f_number: float
    nearest_m: float | None
    poor: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Field:
    """Distortion, blur and light of a lens wide open, by film radius: focused far away (first row) and near (second).

    Attributes:
        radius_mm: rising. near_m: the focus of the second row. distortion_um: distance from where a thin lens images.
            blur_um: diameter of the picture of a point in focus. light: relative to the middle.
    """

    radius_mm: tuple[float, ...]
    near_m: float
    distortion_um: tuple[tuple[float, ...], ...]
    blur_um: tuple[tuple[float, ...], ...]
    light: tuple[tuple[float, ...], ...]

    def at(self, rows: Sequence[Sequence[float]], radius_mm: float, focus_m: float) -> float:
        """Return the largest value (for light the least) up to a radius; between rows it is linear in 1 / focus."""
        share = min(self.near_m / max(focus_m, 1e-6), 1.0)
        values = [a + share * (b - a) for a, b in zip(*rows, strict=True)]
        inside = [v for r, v in zip(self.radius_mm, values, strict=True) if r <= radius_mm]
        for k in range(1, len(values)):
            low, high = self.radius_mm[k - 1 : k + 1]
            if low < radius_mm < high:
                inside.append(values[k - 1] + (values[k] - values[k - 1]) * (radius_mm - low) / (high - low))
        return max(inside) if rows is not self.light else min(inside)


@dataclass(frozen=True)
class LensFacts:
    """One lens of the menu; `variants` go by kind, `character` by the keys of `CHARACTER`.

    `picture`, `bokeh` (three discs of light, from the axis outwards) and `field` may be None.
    """

    lens_id: str
    name: str
    efl_mm: float
    f_number: float
    year: int | None
    source: str
    picture: Path | None
    variants: dict[str, Variant]
    field: Field | None = None
    maker: str = ""
    character: dict[str, float] = dataclasses.field(default_factory=dict)
    bokeh: Path | None = None
    said: str = ""  # nicknames

    @property
    def line(self) -> str:
        """Its focal length, f-number and year, in words."""
        year = "" if self.year is None else f", {self.year}"
        return f"{self.efl_mm:.3g} mm f/{self.f_number:.2g}{year}"

    def value(self, order: str) -> float | str | None:
        """Return what an order of `ORDERS` looks at; None where it is not known."""
        if order in CHARACTER:
            return self.character.get(order)
        known = {"speed": self.f_number, "year": self.year, "maker": self.maker.casefold() or None}
        return known.get(order, self.efl_mm)

    def entry(self, order: str) -> str:
        """Return its text in menus of an order."""
        text, value = f"{self.name} ({self.line})", self.value(order)
        if order == "maker" and value is not None:
            return f"{self.maker}: {text}"
        return text if order not in CHARACTER or value is None else f"{text}, {CHARACTER[order].lower()} {value:.2g}"

    @property
    def number(self) -> int:
        """Its number in menus; it depends on this lens alone, since files keep numbers, not names."""
        return zlib.crc32(self.lens_id.encode()) & 0x7FFFFFFF


def read_library(folders: Sequence[Path]) -> tuple[dict[str, LensFacts], list[str]]:
    """Read the lenses of folders by id, later folders first in rank, and say why others cannot be read."""
    found: dict[str, LensFacts] = {}
    wrong: list[str] = []
    for folder in folders:
        file = folder / FACTS
        if not file.is_file():
            continue
        try:
            data = json.loads(file.read_text(encoding="utf-8"))
            if data["schema"] != SCHEMA:
                raise ValueError(f"its schema is {data['schema']}, this extension reads {SCHEMA}")
            for entry in data["lenses"]:
                lens = lens_of(folder, entry)
                kept = found[lens.lens_id].variants if lens.lens_id in found else {}
                lens.variants.update({k: v for k, v in kept.items() if k not in lens.variants})
                found[lens.lens_id] = lens
        except (OSError, RecursionError, *DAMAGED) as error:
            wrong.append(f"{file} cannot be read: {type(error).__name__}: {error}")
    return dict(sorted(found.items(), key=lambda item: (item[1].efl_mm, item[0]))), wrong


def ordered(lenses: Iterable[LensFacts], order: str) -> list[LensFacts]:
    """Sort lenses by an order of `ORDERS`: a character strongest first, lenses where it is not known last."""
    values = {lens.lens_id: lens.value(order) for lens in lenses}
    falling = order in CHARACTER and order != "cats_eye"  # of which less is left where more is cut
    known = [lens for lens in lenses if values[lens.lens_id] is not None]
    known.sort(key=lambda lens: values[lens.lens_id], reverse=falling)  # type: ignore[arg-type, return-value]
    return known + [lens for lens in lenses if values[lens.lens_id] is None]


def lens_of(folder: Path, entry: dict[str, Any]) -> LensFacts:
    """Make a lens from its entry in the facts of a folder; raises `DAMAGED` if it is none."""
    variants = {}
    for v in entry["variants"]:
        if v["kind"] not in KINDS:
            raise ValueError(f"variant {v['kind']!r}")
        variants[v["kind"]] = Variant(
            kind=v["kind"],
            model=str(v.get("model") or ""),
            path=_inside(folder, v["file"]),
            rms_um=None if v.get("rms_um") is None else float(v["rms_um"]),
            film_radius_mm=float(v["film_radius_mm"]),
            f_number=float(v["f_number"]),
            nearest_m=None if v.get("nearest_m") is None else float(v["nearest_m"]),
            poor=tuple(map(str, v.get("poor") or ())),
            notes=tuple(map(str, v.get("notes") or ())),
        )
    picture, bokeh = (entry.get(name) and _inside(folder, entry[name]) for name in ("picture", "bokeh"))
    return LensFacts(
        lens_id=str(entry["id"]),
        name=str(entry["name"]),
        efl_mm=float(entry["efl_mm"]),
        f_number=float(entry["f_number"]),
        year=None if entry.get("year") is None else int(entry["year"]),
        source=str(entry.get("source") or ""),
        picture=picture or None,
        variants=variants,
        field=None if entry.get("field") is None else _field(entry["field"]),
        maker=str(entry.get("maker") or ""),
        character={k: float(v) for k, v in (entry.get("character") or {}).items() if k in CHARACTER and v is not None},
        bokeh=bokeh or None,
        said=", ".join(map(str, entry.get("said") or ())),
    )


def _field(entry: dict[str, Any]) -> Field:
    radius = tuple(map(float, entry["radius_mm"]))
    rows = {
        name: tuple(tuple(map(float, row)) for row in entry[name]) for name in ("distortion_um", "blur_um", "light")
    }
    whole = len(radius) > 0 and list(radius) == sorted(radius)
    if not whole or any(len(v) != 2 or {len(row) for row in v} != {len(radius)} for v in rows.values()):
        raise ValueError("a field of rising radii, and two rows of each quantity")
    return Field(radius_mm=radius, near_m=float(entry["near_m"]), **rows)


def _inside(folder: Path, name: str) -> Path:
    """Return a file of the folder and none outside, for the facts may come from elsewhere."""
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise ValueError(f"{name!r} leads out of the folder")
    return path


@dataclass(frozen=True)
class Setting:
    """The settings of a scene for a lens.

    Attributes:
        sensor_mm: width and height that are exposed. pixels: width of the picture as rendered.
        focus_m: distance in focus; None where depth of field is off. focus_object: its name, "" for a distance.
        f_number: None takes the shader's.
        shift, shift_side_mm: Blender's shift, and the side in which Blender's own camera counts it.
        stereo: what each eye's view adds to shift X; () without stereo.
        turned: whether the film is tilted or swung.
        unit_m, lens_unit_m: metres in a unit of the scene, by its unit scale, and as the lens takes it.
        on_gpu: whether a GPU is chosen that cannot run OSL cameras.
        darkens: whether the lens may weaken light, by vignetting or exposure.
        passes: those of `PASSES` that are rendered.
        samples: of a pixel of the render, where they decide how far colours are off; else None.
    """

    sensor_mm: tuple[float, float]
    pixels: int
    focus_m: float | None
    focus_object: str = ""
    f_number: float | None = None
    shift: tuple[float, float] = (0.0, 0.0)
    shift_side_mm: float = 0.0
    stereo: tuple[float, ...] = ()
    turned: bool = False
    unit_m: float = 1.0
    lens_unit_m: float = 1.0
    on_gpu: bool = False
    darkens: bool = True
    passes: tuple[str, ...] = ()
    samples: int | None = None


def refused(version: tuple[int, ...], has_osl: bool = True) -> str | None:
    """Return why this Blender cannot run the lenses, or None."""
    if tuple(version[:3]) < OLDEST:
        said = ".".join(map(str, version[:3]))
        return f"This is Blender {said}: cameras written in OSL need {'.'.join(map(str, OLDEST[:2]))} or later"
    return None if has_osl else "This Blender was built without Open Shading Language, which lenses are written in"


def refusals(variant: Variant, setting: Setting) -> list[str]:
    """Return the reasons why a lens is not put on a camera."""
    found = []
    if too_large(variant, setting):
        (width, height), circle = setting.sensor_mm, 2 * variant.film_radius_mm
        fitting = fitting_width_mm(variant, setting)
        found.append(
            f"The sensor, {width:.4g} x {height:.4g} mm, is larger than the lens's picture of {circle:.4g} mm: "
            f"make it at most {fitting:.2f} mm wide, or fit the sensor"
        )
    if too_near(variant, setting):
        what = f"The focus object {setting.focus_object!r}" if setting.focus_object else "The focus distance"
        found.append(f"{what} is {setting.focus_m:.4g} m away, nearer than the lens focuses: {variant.nearest_m:.4g} m")
    return found


def too_large(variant: Variant, setting: Setting) -> bool:
    """Return whether the sensor is larger than the lens's picture."""
    return math.hypot(*setting.sensor_mm) > BEYOND * 2 * variant.film_radius_mm


def too_near(variant: Variant, setting: Setting) -> bool:
    """Return whether the focus is nearer than the near limit."""
    if setting.focus_m is None or variant.nearest_m is None:
        return False
    return setting.focus_m * _HEADROOM < variant.nearest_m


def fitting_width_mm(variant: Variant, setting: Setting) -> float:
    """Return the widest sensor of the setting's shape that the lens's picture fills, rounded down to 0.01 mm."""
    width, height = setting.sensor_mm
    return math.floor(100 * 2 * variant.film_radius_mm * width / math.hypot(width, height)) / 100


def notes(variant: Variant, setting: Setting) -> list[str]:
    """Return sentences for the user about a setting that works."""
    found = []
    if setting.f_number is not None and setting.f_number * NOMINAL < variant.f_number:
        found.append(f"The lens opens to f/{variant.f_number:.3g}: f/{setting.f_number:.3g} renders as that")
    if setting.focus_m is None:
        found.append("Depth of field is off: the lens is focused at infinity")
    if not math.isclose(setting.unit_m, setting.lens_unit_m, rel_tol=1e-5):
        found.append(
            f"A unit of this scene is {setting.unit_m:g} m by its unit scale; the lens takes it for "
            f"{setting.lens_unit_m:g} m (Metres per Unit)"
        )
    for axis, shift, side, name in zip("XY", setting.shift, setting.sensor_mm, ("widths", "heights"), strict=True):
        if shift and not math.isclose(side, setting.shift_side_mm, rel_tol=1e-3):  # in which Cycles counts it
            same = f"set {shift * setting.shift_side_mm / side:.4g}"
            found.append(f"Shift {axis} counts {name} here: for what {shift:.4g} does in Blender's own camera, {same}")
    if setting.samples is not None:
        render = f"does this render of {setting.samples}" if setting.samples < FEW else f"do renders below {FEW}"
        found.append(f"The viewport has no dispersion, nor {render} samples: it would be noise. Dispersion On keeps it")
    if setting.on_gpu:
        found.append("OSL cameras run on the CPU, or on a GPU by OptiX")
    error = error_px(variant, setting)
    if error is not None and error > 1:
        found.append(f"The model's error is {error:.2g} pixels of this picture")
    if variant.poor:
        found.append(f"The model is poor, as its card says: {', '.join(variant.poor)}")
    return [*found, *_pass_notes(setting), *variant.notes]


def _pass_notes(setting: Setting) -> list[str]:
    """Return sentences about passes: Cycles counts the throughput of a lens's rays into alpha and coverage."""
    light, remedy = "the share of the rays that pass there, nearly 1", ""
    if setting.darkens:
        light = "the lens's light there"
        remedy = (
            "; with Vignetting off and Exposure 0 it is nearly right: then multiply the picture by the illumination "
            "map of neurolens stmap"
        )
    said = {
        "alpha": f"Alpha where nothing is: 1 minus {light}; Blender's own camera has 0{remedy}",
        "cryptomatte": f"Cryptomatte's coverage of what is opaque: {light}; Blender's own camera has 1{remedy}",
        "vector": "The Vector pass is wrong with custom cameras: render Motion Blur, or take the pass of Blender's own "
        "camera through the redistort map of neurolens stmap",
    }
    return [said[name] for name in PASSES if name in setting.passes]


def outside(variant: Variant, setting: Setting) -> list[str]:
    """Warn of corners that shift or stereo puts outside the lens's picture."""
    (width, height), (shift_x, shift_y) = setting.sensor_mm, setting.shift
    eyes = [abs(shift_x + more) for more in setting.stereo or (0.0,)]
    corner = math.hypot(width * (0.5 + max(eyes)), height * (0.5 + abs(shift_y)))
    if not any((*eyes, shift_y)) or corner <= BEYOND * variant.film_radius_mm:
        return []
    stereo = any(setting.stereo)
    reach = f"{corner:.4g} mm from the axis; the lens's picture ends at {variant.film_radius_mm:.4g} mm"
    less = ": Parallel convergence, or a longer convergence distance, takes it nearer" if stereo else ""
    return [f"{'Off-axis stereo' if stereo else 'The shift'} takes a corner to {reach}, beyond it is black{less}"]


def error_px(variant: Variant, setting: Setting) -> float | None:
    """Return the model's RMS error in pixels of this picture; None for an exact lens."""
    return None if variant.rms_um is None else variant.rms_um / (1e3 * setting.sensor_mm[0] / setting.pixels)


PINHOLE, THIN = "pinhole", "depth of field"
_ORDER = ("polynomial", "network", "exact")  # by what they cost in Cycles


@dataclass(frozen=True)
class Advice:
    """The camera to use (`PINHOLE`, `THIN`, a variant's kind, or "" if none is good enough), and two sentences why."""

    use: str
    why: tuple[str, str]


def needs(lens: LensFacts, setting: Setting, depths_m: Sequence[float], f_number: float, tolerance_px: float) -> Advice:
    """Advise the cheapest camera whose picture stays within a tolerance of the lens's.

    Args:
        depths_m: along the view, of what the picture shows, inf where it shows nothing; if empty, everything is far.
        f_number: the shot's; a lens that does not open so wide is taken as wide as it opens.
    """
    pixel_um = 1e3 * setting.sensor_mm[0] / setting.pixels
    f_number = max(f_number, lens.f_number)
    corner = math.hypot(*setting.sensor_mm) / 2
    focus = setting.focus_m if setting.focus_m is not None else math.inf
    defocus = max((confusion_mm(lens.efl_mm, f_number, focus, d) for d in depths_m or (math.inf,)), default=0.0)
    defocus *= 1e3 / pixel_um
    if lens.field is None:
        moved = blurred = None
        worth = "what the lens itself adds is not known: pack it with its lens file"
    else:
        moved = lens.field.at(lens.field.distortion_um, corner, focus) / pixel_um
        # Aberrations shrink at least as fast as the aperture.
        blurred = lens.field.at(lens.field.blur_um, corner, focus) / pixel_um * lens.f_number / f_number
        dark = 1 - lens.field.at(lens.field.light, corner, focus)
        worth = f"distortion up to {_px(moved)} px, aberrations {_px(blurred)} px, corners {100 * dark:.0f}% darker"
    asked = f"At f/{f_number:.3g} depths in view are blurred by up to {_px(defocus)} px; {worth}."
    ideal = moved is not None and blurred is not None and max(moved, blurred) <= tolerance_px
    if ideal and not setting.turned:  # Blender's own camera has no film to turn
        if defocus <= tolerance_px:
            return Advice(PINHOLE, ("Use Blender's camera without depth of field.", asked))
        return Advice(THIN, ("Use Blender's camera with its own depth of field.", asked))
    errors: list[tuple[float, str]] = []
    for kind in _ORDER:
        variant = lens.variants.get(kind)
        if variant is None or refusals(variant, setting):
            continue
        error = error_px(variant, setting) or 0.0
        if error <= tolerance_px:
            accuracy = "traces every surface" if kind == "exact" else f"is right to {error:.2g} px"
            return Advice(kind, (f"Use this lens, form {kind}: it {accuracy}, within {tolerance_px:g} px.", asked))
        errors.append((error, kind))
    best = ": none takes this sensor and focus"
    if errors:
        best = f"; the best is {min(errors)[1]} with {min(errors)[0]:.2g} px"
    return Advice("", (f"No form of this lens keeps {tolerance_px:g} px{best}.", asked))


def _px(value: float) -> str:
    return f"{value:.2g}" if value >= 1e-3 else "0"


def confusion_mm(efl_mm: float, f_number: float, focus_m: float, depth_m: float) -> float:
    """Return the diameter (mm) of a thin lens's circle of confusion, from distances to the film (inf allowed)."""

    def image(distance_m: float) -> float:
        total = 1e3 * distance_m
        if math.isinf(total):
            return efl_mm
        if total <= 4 * efl_mm:
            return 2 * efl_mm  # focus nearer than any film can be counts as at life size
        return (total - math.sqrt(total * (total - 4 * efl_mm))) / 2

    film, there = image(focus_m), image(depth_m)
    return efl_mm / f_number * abs(film - there) / there
