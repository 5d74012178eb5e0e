"""The [film] table of a scene, without numpy: the command line names its choices before anything else is loaded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

ColourSpaceName = Literal["sRGB", "ACEScg"]
WavelengthMode = Literal["auto", "one", "hero", "lanes"]
WavelengthSampling = Literal["importance", "uniform"]
COLOUR_SPACE_NAMES: tuple[str, ...] = get_args(ColourSpaceName)
WAVELENGTH_MODES: tuple[str, ...] = get_args(WavelengthMode)
WAVELENGTH_SAMPLINGS: tuple[str, ...] = get_args(WavelengthSampling)


@dataclass(frozen=True)
class FilmSettings:
    """The [film] table of a scene: spectral sampling and colour.

    Attributes:
        colour_space: of the EXR, linear: "sRGB" (Rec. 709 primaries, D65) or "ACEScg" (AP1, the white of ACES).
        white_balance: illuminant that becomes neutral, named as those of lights are; None leaves D65 neutral.
        wavelengths: of a path: "one"; "hero", four that share the path (Wilkie et al. 2014); "lanes", four paths one
            after the other that share all random numbers, a quarter of the wavelengths apart; "auto", hero where the
            camera's rays do not depend on the wavelength (by more than a twentieth of a pixel), else one.
        wavelength_sampling: "importance", by the film's response times the light of the scene, or "uniform".
    """

    colour_space: ColourSpaceName = "sRGB"
    white_balance: str | None = None
    wavelengths: WavelengthMode = "auto"
    wavelength_sampling: WavelengthSampling = "importance"


def size_by_shape(shape: float, width: int | None, height: int | None) -> tuple[int, int]:
    """Width and height in pixels for a film of this width over height; one of them may be missing."""
    across = max(1, round((height or 0) * shape)) if width is None else width
    return across, max(1, round(across / shape)) if height is None else height
