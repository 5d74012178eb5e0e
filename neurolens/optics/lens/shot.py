"""The camera settings of one frame, in one vocabulary for cameras, scene files, options, experiments and plans."""

import math
import re
from argparse import ArgumentTypeError
from collections.abc import Collection
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, Self

from neurolens.base.errors import InputError
from neurolens.base.settings import F_NUMBER, FILM_MM, FOCAL_MM, LIGHT_NM, between, check_bounds, said, setting, within
from neurolens.base.units import in_unit

FocusMode = Literal["auto", "best", "paraxial", "internal"]
Vignetting = Literal["both", "natural", "optical", "none"]
Dispersion = Literal["full", "lateral", "off"]
Runtime = Literal["c", "onnxruntime"]
# Settings that every camera takes, and those of a lens alone, without its film; "internal" stands for the focus mode.
BY_ALL = (
    "film_mm", "focus_m", "f_number", "focus_mode", "wavelength_nm", "clamp_f_number", "vignetting", "dispersion",
    "runtime",
)  # fmt: skip
BY_LENSES = (
    "focus_m", "f_number", "focal_length_mm", "zoom", "field_deg", "focus_mode", "internal", "aperture",
    "cover_glass_mm", "coating",
)  # fmt: skip
POSES = ("film_tilt_deg", "film_swing_deg", "film_shift_mm", "film_rise_mm")  # how the film stands
FILMS = {  # by name, the largest first: options take these, and a lens has the first that it covers
    "largeformat": "120x96", "645": "56x41.5", "mediumformat": "43.8x32.9", "fullframe": "36x24",
    "super35": "24.89x18.66", "apsc": "23.6x15.7", "apsccanon": "22.3x14.9", "mft": "17.3x13", "1inch": "13.2x8.8",
    "super16": "12.52x7.41", "phone": "5.6x4.2",
}  # fmt: skip
_COVERS = 1.02  # the circle of a film over that of a lens that is made for it: makers round


@dataclass(frozen=True)
class Shot:
    """Camera settings for one frame: film, focus, f-number, zoom, size, shape of the stop and light::

        shot = Shot(film_mm=(36.0, 24.0), focus_m=2.0, f_number=2.8)

    Options, keys and scene files give some of the settings: a `part` of a shot, whose other settings are None.

    Attributes:
        film_mm: width and height of the film.
        focus_m: distance from the film to the object in focus, inf allowed. Where it is not given, it is that of the
            focus state which `zoom` names, else infinity.
        f_number: None: the widest stop of a lens or model; f/4 for the thin lens, nominally f/8 for a point.
        focal_length_mm: None: a lens file as tabled; 50 mm for thin lens and pinhole, 14 mm for a fisheye projection
            unless `field_deg` sets it. A model has its own.
        zoom: state of a lens file by name, or a focal length in mm between its states; also of a model of a whole zoom.
            A focus state that is named keeps its groups, and the film moves from there.
        field_deg: full field of view that the film's image circle shall see; sets the size of a lens file. For a
            fisheye projection it is what the circle within the film shall see; beyond it the film is dark.
        focus_mode: "best" places the film where the spot on the axis is smallest, "paraxial" in the paraxial image;
            "internal" moves the groups as the lens file's focus states do, and then the film to the smallest spot.
            "auto" is "internal" where the lens has such states and they reach the distance, else "best".
        aperture: an `Aperture`, the shape of the stop's opening; None is that of the lens file, else round.
        wavelength_nm: shortest and longest wavelength of the light, which sets exposure and best focus.
        film_offset_mm: moves the film away from the lens after focusing; a pinhole has none.
        film_tilt_deg: turns the film about the x axis through its centre (Scheimpflug): positive moves points of the
            film with y > 0, the picture's lower half, away from the lens.
        film_swing_deg: turns it about its y axis before that: positive moves points with x > 0, the picture's left
            half, away from the lens.
        film_shift_mm: moves the film in its own plane along -x, so that the picture shows more to its right.
        film_rise_mm: moves it in that plane along -y, so that the picture shows more above, as where the front of a
            view camera rises. The axis of the lens then meets the film at (film_shift_mm, film_rise_mm).
        cover_glass_mm: thickness of a plate of N-BK7 that is put before the film of a lens file, which is focused anew.
        coating: of the surfaces between glass and air, see `optics.lens.designs.coated`; None leaves the lens's own.
        clamp_f_number: an f-number wider than the lens opens becomes its widest; else it is an error for a model, and
            opens the stop of a lens file as far as the rims let light through.
        vignetting: the part that is kept; see `neurolens.cameras.reduced`.
        dispersion: the part that is kept; see `neurolens.cameras.reduced`.
        runtime: what runs the camera of a lens or a model; None takes C where the machine has a compiler that takes it,
            else onnxruntime.

    Raises:
        InputError: a film, focus, f-number, focus mode, vignetting, dispersion or runtime that no camera has; a focal
            length beside a field.
    """

    film_mm: tuple[float, float]
    focus_m: float = setting(
        math.inf, "distance from the film to the object in focus, or inf (default: {}inf)",
        within=(1e-6, math.inf), unit="a distance such as 2, 200cm, 6ft or inf, in metres", common=True,
    )  # fmt: skip
    f_number: float | None = setting(
        None, "focal length over entrance-pupil diameter, focused at infinity (default: {}the widest)",
        within=F_NUMBER, unit="an f-number", metavar="N", common=True,
    )  # fmt: skip
    focal_length_mm: float | None = setting(
        None, "scale the whole lens to this focal length (default: that of its table)", within=FOCAL_MM,
        unit="a focal length in mm", old=("efl",), apart="size", common=True,
    )  # fmt: skip
    zoom: str | float | None = setting(
        None, "zoom state of the lens file by its name, or a focal length in mm between its states, whose gaps are "
        "interpolated (default: the state of the table)", old=("configuration",), metavar="STATE", common=True,
    )  # fmt: skip
    field_deg: float | None = setting(
        None, "scale the whole lens so that its image circle sees this full field of view, traced",
        within=(0.001, 360.0), unit="degrees", apart="size",
    )  # fmt: skip
    focus_mode: FocusMode = setting(
        "auto", "best puts the film where the spot on the axis is smallest at this aperture, paraxial into the "
        "paraxial image; internal first moves the groups as the focus states of the lens file say (default: "
        "auto, which is internal where these states reach the distance, else best)", old=("focusing",),
    )  # fmt: skip
    aperture: Any = None  # an `Aperture`, whose module loads numpy, which the help of the command line does without
    wavelength_nm: tuple[float, float] = LIGHT_NM
    film_offset_mm: float = setting(
        0.0, "move the film away from the lens after focusing (default: 0)", within=(-1e3, 1e3), unit="mm"
    )
    film_tilt_deg: float = setting(
        0.0, "turn the film about the horizontal axis through its centre, the picture's lower half away from the lens "
        "(default: 0)", within=(-45, 45), unit="degrees",
    )  # fmt: skip
    film_swing_deg: float = setting(
        0.0, "turn the film about the vertical axis through its centre, the picture's left half away from the lens "
        "(default: 0)", within=(-45, 45), unit="degrees",
    )  # fmt: skip
    film_shift_mm: float = setting(
        0.0, "move the film sideways in its plane, so that the picture shows more to its right (default: 0)",
        within=(-1e3, 1e3), unit="mm",
    )  # fmt: skip
    film_rise_mm: float = setting(
        0.0, "move the film down in its plane, so that the picture shows more above (default: 0)",
        within=(-1e3, 1e3), unit="mm",
    )  # fmt: skip
    cover_glass_mm: float = setting(
        0.0, "put a plane plate of N-BK7 of this thickness before the film, and focus anew (default: none beyond the "
        "lens file's)", within=(0, 100), unit="mm",
    )  # fmt: skip
    coating: str | None = setting(
        None, "coat every surface between glass and air whose coating the lens file does not state: single-layer "
        "(1940s to 60s), three-layer (1970 on), multi-layer (today), quarter-wave, v-coat, broadband. bare "
        "takes every coating away, stated keeps those of the file alone; three-layer,s07=bare sets one "
        "surface apart (default: by the year of the design)",
        metavar="NAME",
    )  # fmt: skip
    clamp_f_number: bool = False
    vignetting: Vignetting = setting(
        "both", "which dark corners are kept: both kinds; natural, the cos^4 law; optical, what the rims cut off; "
        "none (default: both)",
    )  # fmt: skip
    dispersion: Dispersion = setting(
        "full", "which dispersion is kept: full; lateral, the picture's shift with the wavelength, for less noise; "
        "off (default: full)",
    )  # fmt: skip
    runtime: Runtime | None = setting(
        None,
        "what runs a lens or model; both give the same rays (default: c where the machine has a C compiler "
        "that takes it)",
    )

    def __post_init__(self) -> None:
        check_bounds(self, "camera")
        if self.field_deg is not None and self.focal_length_mm is not None:
            expected = "left out beside focal_length_mm: each sets the size"
            raise InputError("camera", "field_deg", self.field_deg, expected)
        if self.film_mm is not None:
            object.__setattr__(self, "film_mm", check_film(self.film_mm))
        if self.focus_m is not None:
            object.__setattr__(self, "focus_m", float(self.focus_m))

    @classmethod
    def part(cls, **given: Any) -> Self:
        """Return some settings of a shot; the others are None, which stands for not given."""
        return cls(**{f.name: None for f in fields(cls)} | given)

    @property
    def given(self) -> dict[str, Any]:
        """The settings that are given, by name."""
        return {name: value for name, value in vars(self).items() if value is not None}

    @property
    def size(self) -> dict[str, Any]:
        """The settings that zoom or scale the lens, of those that are given."""
        return {name: self.given[name] for name in ("zoom", "focal_length_mm", "field_deg") if name in self.given}

    def whole(self) -> Self:
        """Return the shot with defaults for the settings that are not given."""
        return type(self)(**self.given)

    def check_taken(self, camera: str, takes: Collection[str]) -> None:
        """Refuse settings that a kind of camera does not take.

        `takes` names what it takes besides `BY_ALL`; "internal" is that focus mode.
        """
        for f in fields(self):
            value, taken = getattr(self, f.name), f.name in {*takes, *BY_ALL}
            if taken if f.name != "focus_mode" else value != "internal" or "internal" in takes:
                continue
            if value != f.default:
                value = value.settings() if f.name == "aperture" else value
                own = ", ".join(g.name for g in fields(self) if g.name in takes)
                expected = f"left out: lens files take it; of this camera one sets film, focus, f-number, {own}"
                raise InputError(f"camera {camera}", f.name, value, expected)

    def record(self, takes: Collection[str]) -> dict[str, Any]:
        """Return what a camera's settings say of its shot, for JSON: film, focus (None is inf), and what it `takes`."""
        found: dict[str, Any] = {
            "film_mm": list(self.film_mm),
            **{f.name: getattr(self, f.name) for f in fields(self) if f.name in takes},
            "focus_m": None if math.isinf(self.focus_m) else self.focus_m,
        }
        return found | ({"aperture": self.aperture.settings()} if self.aperture else {})

    def f_number_for(self, widest: float) -> float | None:
        """Return the f-number of a lens that opens to `widest`; None stands for its widest."""
        too_wide = self.clamp_f_number and self.f_number is not None and self.f_number < widest
        return None if too_wide else self.f_number


def film_size(text: str) -> tuple[float, float]:
    """Read an option: a film's width x height in mm, as in 36x24, also with units, or its name in `FILMS`."""
    named = FILMS.get(re.sub(r"[-_ ]", "", text.lower()), text.lower())
    width, _, height = re.sub(r"[*\N{MULTIPLICATION SIGN}]", "x", named).partition("x")
    expected = f"the film's width x height in mm, as in 36x24, or one of {', '.join(FILMS)}, each"
    side = in_unit("mm", between(*FILM_MM, expected))
    try:
        return side(width.strip()), side(height.strip())
    except ArgumentTypeError as error:
        raise ArgumentTypeError(f"got {text!r}, expected {str(error).partition(', expected ')[2]}") from None


def film_within(radius_mm: float) -> tuple[tuple[float, float], str]:
    """Return the largest of `FILMS`, narrow ones apart, in an image circle, and its name; else a 3:2 film and ""."""
    films = {name: film_size(text) for name, text in FILMS.items()}
    fitting = {name: film for name, film in films.items() if math.hypot(*film) / 2 <= _COVERS * radius_mm}
    named = max(fitting, key=lambda name: math.hypot(*fitting[name]), default="")
    share = 2 * radius_mm / math.hypot(3, 2)
    return fitting.get(named) or (float(f"{3 * share:.3g}"), float(f"{2 * share:.3g}")), named


def check_film(film_mm: tuple[float, float]) -> tuple[float, float]:
    """Return width and height of a film as floats; raises InputError for any that no film has."""
    if len(film_mm) != 2:
        raise InputError("camera", "film_mm", film_mm, "a width and a height")
    width, height = film_mm
    if not (within(FILM_MM, width) and within(FILM_MM, height)):
        raise InputError("camera", "film_mm", film_mm, f"sides {said(FILM_MM)} mm")
    return float(width), float(height)


@dataclass(frozen=True)
class StopShape:
    """The shape of the stop's opening, as files and options state it; without any field it is the lens file's.

    `pictures.render.images.make_aperture` makes an `Aperture` of it and reads the picture of a mask.
    """

    blades: int | None = setting(
        None, "blades, their corners on the circle of the stop (default: the lens file's, else round)", within=(3, 100)
    )
    blade_rotation_deg: float | None = setting(
        None, "angle of the first corner (or of the mask), from x towards y, seen from the film (default: 0)",
        within=(-360.0, 360.0), unit="degrees",
    )  # fmt: skip
    blade_curvature: float | None = setting(
        None,
        "how far the blades' edges bulge, from 0 (straight) to 1 (round) (default: 0)",
        within=(0.0, 1.0),
        metavar="C",
    )
    aperture_mask: Path | None = setting(
        None, "opening of any shape: light passes where the picture is brighter than half; it spans the stop",
        metavar="PICTURE",
    )  # fmt: skip
