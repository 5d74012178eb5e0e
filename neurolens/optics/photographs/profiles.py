"""Measured profiles of lenses: lensfun's database, which the package `lensfunpy` brings, searched by name.

A profile holds fits to photographs of one copy of a lens: distortion and lateral colour by focal length, and light by
focal length, aperture and distance. The formulae are lensfun's (lensfun.github.io/manual/latest/group__Lens.html). The
database is under CC BY-SA 3.0: it is read at run time, and no part of it is kept here.
"""

import math
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError, pip_install

Array = NDArray[np.float64]

FULL_FRAME_MM = math.hypot(36, 24) / 2  # half the diagonal, at crop factor 1
FAR_M = 1000.0  # the distance that stands for infinity
_FARTHEST = 2.0  # in half short sides: how far the formulae are tabulated
_STEPS = 2001
_SAME_FOCAL, _SAME_F = 0.02, 0.04  # relative differences within which two names speak of the same lens
# shares of the weight of all words that two names share, from which a match is certain or likely
_CERTAIN, _LIKELY = 0.55, 0.25
_FISHEYE = re.compile("fish-?eye", re.IGNORECASE)  # in the name of a profile that does not state its projection
_OTHER = 0.5  # factor on the likeness where versions or mounts differ


class Light(NamedTuple):
    """The light at a focal length, aperture and distance: 1 + k1 r^2 + k2 r^4 + k3 r^6, with r = 1 in the corner."""

    focal_mm: float
    f_number: float
    distance_m: float
    k: tuple[float, float, float]


class Radial(NamedTuple):
    """The measured over the ideal radius as a polynomial of the ideal radius: coefficients, lowest power first."""

    focal_mm: float
    factors: tuple[float, ...]


@dataclass(frozen=True)
class Profile:
    """What was measured in photographs of one copy of a lens.

    Attributes:
        maker, model: lensfun's names.
        crop: half the diagonal of full frame over that of the camera's film. aspect: its long over its short side.
        projection: that of the ideal picture: "rectilinear", or one of a fisheye.
        distortion, red, blue: by focal length; red and blue relative to green.
        light: by focal length, aperture and distance.
    """

    maker: str
    model: str
    crop: float
    aspect: float
    projection: str
    distortion: tuple[Radial, ...]
    red: tuple[Radial, ...]
    blue: tuple[Radial, ...]
    light: tuple[Light, ...]

    @property
    def half_diagonal_mm(self) -> float:
        """Half the diagonal of the camera's film."""
        return FULL_FRAME_MM / self.crop

    @property
    def unit_mm(self) -> float:
        """The radius that is 1 in the formulae of distortion and colour: half the short side."""
        return self.half_diagonal_mm / math.hypot(1, self.aspect)

    def stretch(self, radial: Radial, height_mm: Array) -> Array:
        """The measured image height over that of the ideal picture, at measured heights; the scale is arbitrary."""
        ideal = np.linspace(0, _FARTHEST, _STEPS)[1:]
        factor = np.polynomial.polynomial.polyval(ideal, radial.factors)
        real = ideal * factor
        rising = int(np.argmax(np.diff(real, append=-np.inf) <= 0)) + 1
        return np.interp(height_mm / self.unit_mm, real[:rising], factor[:rising], right=math.nan)

    def shift_um(self, radial: Radial, height_mm: Array) -> Array:
        """Return how much farther from the axis than green a colour lies, at heights of green."""
        factor = np.polynomial.polynomial.polyval(height_mm / self.unit_mm, radial.factors)
        return np.asarray(1000 * height_mm * (factor - 1))

    def stops(self, light: Light, height_mm: Array) -> Array:
        """The light at image heights over that on the axis, in stops (powers of two); NaN where the fit has none."""
        r2 = (height_mm / self.half_diagonal_mm) ** 2
        share = 1 + r2 * (light.k[0] + r2 * (light.k[1] + r2 * light.k[2]))
        return np.log2(np.where(share > 0, share, math.nan))

    @property
    def focal_mm(self) -> tuple[float, ...]:
        """The focal lengths at which anything is measured."""
        found = {row.focal_mm for row in (*self.distortion, *self.red)} | {row.focal_mm for row in self.light}
        return tuple(sorted(found))

    def light_at(self, focal_mm: float) -> list[Light]:
        """Return the light at a focal length by aperture, each at the farthest distance measured."""
        by_f: dict[float, Light] = {}
        for row in self.light:
            if row.focal_mm == focal_mm and row.distance_m >= by_f.get(row.f_number, row).distance_m:
                by_f[row.f_number] = row
        return [by_f[f] for f in sorted(by_f)]


class Name(NamedTuple):
    """What a name says about a lens: shortest and longest focal length, f-number at the shortest, and other words."""

    focal_mm: tuple[float, float]
    f_number: float
    words: frozenset[str]


class Match(NamedTuple):
    """A profile for a lens. The likeness is the share of the weight of all words that both names have."""

    profile: Profile
    likeness: float

    @property
    def certainty(self) -> str:
        """How certain it is that both are the same lens, in a word."""
        return "certain" if self.likeness >= _CERTAIN else "likely" if self.likeness >= _LIKELY else "uncertain"


_NUMBER = r"(\d+(?:\.\d+)?)"
_FOCAL = re.compile(rf"{_NUMBER}(?:\s*[-–]\s*{_NUMBER})?\s*mm", re.IGNORECASE)
_APERTURE = re.compile(rf"(?:\bf\s*/?\s*|/f?|(?<=mm)\s*f|1\s*:\s*){_NUMBER}(?:\s*[-–]\s*{_NUMBER})?", re.IGNORECASE)
_ZEISS = re.compile(rf"\b{_NUMBER}(?:-{_NUMBER})?/{_NUMBER}(?:-{_NUMBER})?\b")  # f-number before focal length
_SAME_WORD = {"asph": "aspherical", "mkii": "ii", "mkiii": "iii", "fuji": "fujifilm", "fujinon": "fujifilm",
              "nikkor": "nikon", "zuiko": "olympus", "takumar": "pentax", "rokkor": "minolta",
              "voigtlander": "cosina", "voigtländer": "cosina"}  # fmt: skip
# Marks in which two names of one lens agree: the version, and the mount where both names have one.
_VERSIONS = frozenset(("ii", "iii", "iv", "v", "vi", "new", "l"))
_MOUNTS = frozenset(("ef", "rf", "fd", "z", "xf", "xc", "gf", "fe", "da", "fa", "dt", "af", "ai", "m", "tl", "sl"))
_NO_WORD = frozenset(("mm", "lens", "f", "the", "and", "for", "of", "t", "zoom", "g1", "compatibles"))


def name_of(text: str) -> Name | None:
    """Read a lens's name, such as "Nikon AF-S Nikkor 28mm f/1.4E ED"; None without a focal length."""
    focal, zeiss = _FOCAL.search(text), None
    if focal is None:
        zeiss = _ZEISS.search(text)
        if zeiss is None:
            return None
        low, high = zeiss[3], zeiss[4] or zeiss[3]
        aperture = float(zeiss[1])
        rest = text.replace(zeiss[0], " ")
    else:
        low, high = focal[1], focal[2] or focal[1]
        rest = f"{text[: focal.start()]} mm {text[focal.end() :]}"
        found = _APERTURE.search(rest)
        aperture = float(found[1]) if found else math.nan
        rest = rest.replace(found[0], " ", 1) if found else rest
    words = re.findall(r"[^\W\d_]+|\d+(?:\.\d+)?", rest.lower())
    kept = {_SAME_WORD.get(word, word) for word in words} - _NO_WORD
    return Name((float(low), float(high)), aperture, frozenset(kept))


def _same(one: float, other: float, within: float) -> bool:
    return abs(one / other - 1) <= within if one > 0 and other > 0 else False


def _marks_agree(one: frozenset[str], other: frozenset[str]) -> bool:
    mounts = one & _MOUNTS, other & _MOUNTS
    return one & _VERSIONS == other & _VERSIONS and (not all(mounts) or bool(mounts[0] & mounts[1]))


@cache
def database() -> tuple[Profile, ...]:
    """Return all profiles of lensfun's database that hold a measurement.

    Raises:
        InputError: the package lensfunpy is not installed.
    """
    spec = find_spec("lensfunpy")
    if spec is None or not spec.submodule_search_locations:
        expected = f"lensfunpy, which brings the profiles: {pip_install('photographs')}"
        raise InputError("verify", "photographs", "(not installed)", expected)
    folder = Path(next(iter(spec.submodule_search_locations))) / "db_files"
    found: list[Profile] = []
    for file in sorted(folder.glob("*.xml")):
        found += profiles_in(file)
    return tuple(found)


def profiles_in(file: Path) -> list[Profile]:
    """Return the profiles of a file of lensfun's database."""
    try:
        root = ElementTree.parse(file).getroot()
    except (OSError, ElementTree.ParseError) as error:
        raise InputError(file, "profiles", f"({error})", "an XML file of lensfun's database") from error
    return [profile for element in root.iter("lens") if (profile := _profile(element)) is not None]


def _profile(element: ElementTree.Element) -> Profile | None:
    """Return one profile; None without a measurement or without the size of its film."""
    calibration, crop = element.find("calibration"), element.findtext("cropfactor")
    if calibration is None or crop is None:
        return None
    names = {e.get("lang"): (e.text or "").strip() for e in element.findall("model")}
    model = names.get(None, "")
    if name_of(model) is None or "en" in names and len(names["en"]) > len(model):
        model = names.get("en", model)
    across, _, down = (element.findtext("aspect-ratio") or "3:2").partition(":")
    rows = {kind: calibration.findall(kind) for kind in ("distortion", "tca", "vignetting")}
    return Profile(
        maker=(element.findtext("maker") or "").strip(),
        model=model,
        crop=float(crop),
        aspect=float(across) / float(down or 1),
        projection=(element.findtext("type") or ("fisheye" if _FISHEYE.search(model) else "rectilinear")).strip(),
        distortion=tuple(r for e in rows["distortion"] if (r := _distortion(e)) is not None),
        red=tuple(r for e in rows["tca"] if (r := _colour(e, "r")) is not None),
        blue=tuple(r for e in rows["tca"] if (r := _colour(e, "b")) is not None),
        light=tuple(_light(e) for e in rows["vignetting"] if e.get("model") == "pa"),
    )


def _number(element: ElementTree.Element, name: str, default: float = 0.0) -> float:
    return float(element.get(name, default))


def _light(e: ElementTree.Element) -> Light:
    k = _number(e, "k1"), _number(e, "k2"), _number(e, "k3")
    return Light(_number(e, "focal"), _number(e, "aperture"), _number(e, "distance", FAR_M), k)


def _distortion(e: ElementTree.Element) -> Radial | None:
    a, b, c, k1, k2 = (_number(e, name) for name in ("a", "b", "c", "k1", "k2"))
    factors = {"ptlens": (1 - a - b - c, c, b, a), "poly3": (1 - k1, 0.0, k1), "poly5": (1.0, 0.0, k1, 0.0, k2)}
    known = factors.get(e.get("model", ""))
    return None if known is None else Radial(_number(e, "focal"), known)


def _colour(e: ElementTree.Element, band: str) -> Radial | None:
    if e.get("model") == "poly3":
        return Radial(
            _number(e, "focal"), (_number(e, f"v{band}", 1.0), _number(e, f"c{band}"), _number(e, f"b{band}"))
        )
    return Radial(_number(e, "focal"), (_number(e, f"k{band}", 1.0),)) if e.get("model") == "linear" else None


@cache
def _names(profiles: tuple[Profile, ...]) -> tuple[list[tuple[Profile, Name]], Counter[str]]:
    """Return the profiles whose names have a focal length, and how many of them have each word."""
    found = [(p, n) for p in profiles if (n := name_of(f"{p.maker} {p.model}")) is not None]
    return found, Counter(word for _, name in found for word in name.words)


def matches(texts: Iterable[str], profiles: tuple[Profile, ...] | None = None) -> list[Match]:
    """Profiles for a lens that goes by these names, likeliest first: equal focal lengths and f-number, like words.

    The weight of a word is the logarithm of how rare it is among the names of all profiles.
    """
    named, often = _names(database() if profiles is None else profiles)

    def weight(words: frozenset[str]) -> float:
        return sum(math.log((2 + len(named)) / (1 + often[word])) for word in words)

    found: dict[int, Match] = {}
    for asked in filter(None, map(name_of, texts)):
        for place, (profile, name) in enumerate(named):
            same = all(_same(a, b, _SAME_FOCAL) for a, b in zip(asked.focal_mm, name.focal_mm, strict=True))
            if same and _same(asked.f_number, name.f_number, _SAME_F):
                union = weight(asked.words | name.words)
                likeness = weight(asked.words & name.words) / union if union else 0.0
                likeness *= 1.0 if _marks_agree(asked.words, name.words) else _OTHER
                if place not in found or likeness > found[place].likeness:
                    found[place] = Match(profile, likeness)
    return sorted(found.values(), key=lambda match: (-match.likeness, match.profile.crop))


def profile_named(name: str, profiles: tuple[Profile, ...] | None = None) -> list[Profile]:
    """Return the profiles of exactly this model, with or without its maker; case does not count.

    Raises:
        InputError: there is none; names the nearest ones.
    """
    everything = database() if profiles is None else profiles
    wanted = " ".join(name.lower().split())
    found = [p for p in everything if wanted in (p.model.lower(), f"{p.maker} {p.model}".lower())]
    if not found:
        near = dict.fromkeys(m.profile.model for m in matches([name], everything)[:3])
        expected = f"one of lensfun's names{', such as ' + ', '.join(near) if near else ''}"
        raise InputError("verify", "--profile", name, expected)
    return found
