"""The tables [film], [sensor] and [flare] of a scene. They are options of commands, too, and load without numpy."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

from neurolens.base.errors import InputError
from neurolens.base.settings import bounded, check_bounds, setting

ColourSpaceName = Literal["sRGB", "ACEScg"]
WavelengthMode = Literal["auto", "one", "hero"]
WavelengthSampling = Literal["importance", "uniform"]
_BLACK = 512  # of 14 bits: the number that is read without light
Mosaic = Literal["none", "RGGB", "BGGR", "GRBG", "GBRG"]


def diffraction() -> Any:
    """Return --diffraction, a switch of pictures that are made of rays."""
    return setting(
        False, "spread light by the waves of the stop, its blades and the rims, in 5 x 3 zones of the picture, after "
        "the rays; for small pixels and stops. Takes a lens or its model, and the extra \"train\" (torch)",
    )  # fmt: skip


@dataclass(frozen=True)
class FilmSettings:
    """The [film] table of a scene: spectral sampling and colour.

    Attributes:
        colour_space: linear, of the EXR: "sRGB" (Rec. 709 primaries, D65) or "ACEScg" (AP1, the white of ACES).
        white_balance: the illuminant that becomes neutral, named as those of lights are; with None D65 is neutral.
        wavelengths: what a path carries: "one"; "hero", four that share the path (Wilkie et al. 2014), each with its
            own film point where the camera disperses, which takes a C compiler; "auto", hero where the camera can, else
            one.
        wavelength_sampling: "importance", by the film's response times the light of the scene, or "uniform".
        fill_factor: share of a pixel that takes light, a square in its middle, since the filter of a pixel is a box.
    """

    colour_space: ColourSpaceName = setting(
        "sRGB", "linear colours of the EXR: sRGB (D65) or ACEScg (AP1, the white of ACES)"
    )
    white_balance: str | None = setting(
        None, "light that becomes neutral: A, D50, D65, E, '3200 K' or a measured one of the scene", metavar="LIGHT"
    )
    wavelengths: WavelengthMode = setting(
        "auto", "wavelengths of a path: one; hero, four that share it; auto, hero where the camera can",
        option="wavelength-mode", old=("wavelengths",),
    )  # fmt: skip
    wavelength_sampling: WavelengthSampling = setting(
        "importance", "how wavelengths are drawn: by importance (the film's response times the light), or uniformly"
    )
    fill_factor: float = setting(
        1.0, "share of a pixel's area that takes light, a square in its middle", within=(0.01, 1), metavar="SHARE"
    )

    def __post_init__(self) -> None:
        check_bounds(self, "film")


@dataclass(frozen=True)
class SensorSettings:
    """The [sensor] table of a scene: what a sensor counts of a linear picture, see `pictures.render.sensor`.

    Attributes:
        mosaic: the colours of the pixels of two rows from the top left; with "none" every pixel counts all three.
        electrons: mean number in a pixel whose value is 1, as of a white card of radiance 1 on the axis.
        full_well: electrons that a pixel holds. read_noise: standard deviation in electrons.
        noise: "none" leaves out the noise of photons and that of reading.
        bits: of the converter, whose largest number is a full well. black_level: its number without any electron.

    Raises:
        InputError: a value out of bounds.
    """

    mosaic: Mosaic = setting(
        "RGGB",
        "colours of two rows of pixels, from the top left; with none each pixel counts all three (default: RGGB)",
    )
    electrons: float = setting(
        2e4,
        "mean number of electrons where the value of a pixel is 1 (default: 20000)",
        within=(1e-6, 1e9),
        metavar="N",
    )
    full_well: float = setting(3e4, "electrons that a pixel holds (default: 30000)", within=(1, 1e9), metavar="N")
    read_noise: float = setting(3.0, "noise of reading, in electrons RMS (default: 3)", within=(0, 1e6), metavar="N")
    noise: Literal["all", "none"] = setting(
        "all", "all: the noise of photons and of reading, by --seed; none: no noise (default: all)"
    )
    bits: int = setting(
        14, "bits of the numbers that the sensor gives; the largest number is a full well (default: 14)", within=(1, 16)
    )
    black_level: int | None = setting(
        None, "number that is read without light (default: 512 of 14 bits and more, else a 32nd of the range)",
        within=(0, 65_534), metavar="N",
    )  # fmt: skip

    def __post_init__(self) -> None:
        check_bounds(self, "sensor")
        most = 2 ** (self.bits or 16) - 2
        if (self.black_level or 0) > most:
            raise InputError("sensor", "black_level", self.black_level, f"at most {most}, below the largest number")

    @property
    def black(self) -> int:
        """The number that is read without light."""
        return min(_BLACK, 2**self.bits // 32) if self.black_level is None else self.black_level


def size_by_shape(shape: float, width: int | None, height: int | None) -> tuple[int, int]:
    """Return width and height in pixels for a film of this width over height; one of them may be missing."""
    across = max(1, round((height or 0) * shape)) if width is None else width
    return across, max(1, round(across / shape)) if height is None else height


LAYERS = ("ghosts", "glare", "starburst")
GLARE = 1 << 18  # photons of the glare where anything scatters
_MOST_PHOTONS = 1 << 30
_MOST_GAIN = 1e9
_QUICK_BINS, _QUICK_CELL_PX, _QUICK_PHOTONS = 5, 24.0, 1 << 16


# Titles of the options of flare in the help.
OF_LIGHTS, OF_PICTURE, OF_LAYERS = "lights, which add up", "picture", "layers"
OF_PHOTONS = "photons, and what scatters them"


@dataclass(frozen=True)
class Scatter:
    """The parts of a lens that scatter light, and how much; none by default.

    Attributes:
        barrel: share of the light that the tube, its rings and the stop's plate reflect. gloss: share of that which
            goes about the mirror's direction; the rest follows Lambert's law.
        sensor: share of the light that the film reflects. mirror: share of that which is reflected as by a mirror; the
            rest follows Lambert's law.
        dust: share of the light entering at the front that dust scatters there. dust_forward: its mean cosine.
        haze_per_mm: scattering of the glass, the inverse of the mean free path. haze_forward: its mean cosine.

    Raises:
        InputError: a value out of bounds.
    """

    barrel: float = setting(
        0.0, "share of light that the barrel, its rings and the stop reflect, a fifth of it glossily", within=(0, 1),
        metavar="SHARE", title=OF_PHOTONS,
    )  # fmt: skip
    gloss: Annotated[float, bounded(0, 1)] = 0.2
    sensor: float = setting(
        0.0, "share of light that the film reflects, half of it as a mirror does", within=(0, 0.9),
        metavar="SHARE", title=OF_PHOTONS,
    )  # fmt: skip
    mirror: Annotated[float, bounded(0, 1)] = 0.5
    dust: float = setting(
        0.0, "share of the front that is dusty; dust scatters light with a mean cosine of 0.98", within=(0, 1),
        metavar="SHARE", title=OF_PHOTONS,
    )  # fmt: skip
    dust_forward: Annotated[float, bounded(0, 0.9999)] = 0.98
    haze_per_mm: float = setting(
        0.0, "scattering in glass, inverse of the mean free path, mean cosine 0.9", within=(0, 10), title=OF_PHOTONS,
    )  # fmt: skip
    haze_forward: Annotated[float, bounded(0, 0.9999)] = 0.9

    def __post_init__(self) -> None:
        check_bounds(self, "scatter")

    @property
    def on(self) -> bool:
        """Whether anything scatters."""
        return bool(self.barrel or self.sensor or self.dust or self.haze_per_mm)


@dataclass(frozen=True)
class FlareSettings:
    """The layers of flare, and how finely they are computed.

    Attributes:
        gains: factors of red, green and blue, by the name of a layer or of a ghost (g07-03).
        scatter: what scatters light. Ghosts do not lose the light that is scattered out of them, which is little.

    Raises:
        InputError: a value out of bounds, an unknown layer, or photons together with single ghosts.
    """

    bins: int = setting(
        15,
        "wavelengths of stars and photons, in equal steps over the range of light, 400 to 700 nm (fewer than 30 of "
        "photons are cut into more); ghosts take what their colours need, at most four times as many (default: 15)",
        within=(1, 256),
        old=("wavelengths",), title=OF_PICTURE,
    )  # fmt: skip
    cell_px: float = setting(
        8.0, "size on the film of the cells of which a ghost is drawn (default: 8; 48 for a quick look)",
        within=(1, 256), unit="pixels", title=OF_PICTURE,
    )  # fmt: skip
    brightest: int = setting(
        0, "ghosts with a layer of their own, those with the greatest values on the film",
        within=(0, 64), option="layers", title=OF_LAYERS,
    )  # fmt: skip
    most: int = setting(
        32,
        "number of lights that --image and a scene give, those of the most energy; the command says what it leaves "
        "out. With --frames they fade before they are left out",
        within=(1, 10_000), title=OF_LIGHTS,
    )  # fmt: skip
    without: tuple[str, ...] = setting(
        (), f"layer that is not made: {', '.join(LAYERS)}; repeatable", metavar="LAYER", title=OF_LAYERS
    )
    gains: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    starburst: bool = setting(False, "the layer starburst; some seconds a light", title=OF_LAYERS)
    photons: int = setting(
        0, "trace N photons a light and wavelength in place of all pairs of surfaces; chance decides who reflects",
        within=(0, _MOST_PHOTONS), title=OF_PHOTONS,
    )  # fmt: skip
    most_reflections: int = setting(
        10, "reflections of a photon, at most, for --photons and --glare (default: 10)", within=(1, 1000),
        option="reflections", title=OF_PHOTONS,
    )  # fmt: skip
    kernel_px: float = setting(
        3.0, "radius of the kernel that smooths photons, where they are dense (default: 3); 0 leaves them",
        within=(0, 100), unit="pixels", title=OF_PHOTONS,
    )  # fmt: skip
    glare: int = setting(
        0, f"photons a light and wavelength of the layer glare (default: {GLARE} if anything scatters, else none)",
        within=(0, _MOST_PHOTONS), title=OF_PHOTONS,
    )  # fmt: skip
    scatter: Scatter = setting(Scatter(), "what scatters photons")
    seed: int = setting(
        0, "seed of photons, the same in all frames; ghosts need none", within=(0, 1 << 20), title=OF_PHOTONS
    )

    def __post_init__(self) -> None:
        check_bounds(self, "flare")
        for name in self.without:
            if name not in LAYERS:
                raise InputError("flare", "without", name, f"layers of flare: {', '.join(LAYERS)}")
        if self.photons and (self.brightest or set(self.gains) - set(LAYERS)):
            raise InputError(
                "flare",
                "photons",
                self.photons,
                "0 beside layers or gains of single ghosts, which photons do not tell apart",
            )
        for name, factor in self.gains.items():
            if not all(0 <= v <= _MOST_GAIN for v in factor):
                raise InputError("flare", f"gain {name}", factor, f"numbers from 0 to {_MOST_GAIN:g}")
        if self.scatter.on and not self.glare:
            object.__setattr__(self, "glare", GLARE)

    def quick(self) -> FlareSettings:
        """Return the same settings, coarse enough for a quick look."""
        photons, glare = (min(n, _QUICK_PHOTONS) for n in (self.photons, self.glare))
        cell = max(self.cell_px, _QUICK_CELL_PX)
        return replace(self, bins=min(self.bins, _QUICK_BINS), cell_px=cell, photons=photons, glare=glare)

    def makes(self, name: str) -> bool:
        """Return whether the layer of this name is switched on."""
        return name not in self.without and bool({"glare": self.glare, "starburst": self.starburst}.get(name, True))

    def gain(self, name: str) -> tuple[float, float, float]:
        """Return the factors of red, green and blue of a layer or ghost."""
        return self.gains.get(name, (1.0, 1.0, 1.0))
