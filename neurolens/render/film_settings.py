"""The [film] table of a scene, without numpy: the command line has its options before anything else is loaded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from neurolens.base.options import setting

ColourSpaceName = Literal["sRGB", "ACEScg"]
WavelengthMode = Literal["auto", "one", "hero", "lanes"]
WavelengthSampling = Literal["importance", "uniform"]


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

    colour_space: ColourSpaceName = setting("sRGB", "of the EXR, linear: sRGB (D65) or ACEScg (AP1, the white of ACES)")
    white_balance: str | None = setting(
        None, "light that becomes neutral: A, D50, D65, E, '3200 K' or a measured one of the scene", metavar="LIGHT"
    )
    wavelengths: WavelengthMode = setting(
        "auto",
        "of a path: one; hero, four that share it; lanes, four paths that share their random numbers; auto, hero where "
        "the camera does not disperse",
        option="wavelength-mode",
        old=("wavelengths",),
    )
    wavelength_sampling: WavelengthSampling = setting(
        "importance", "by importance (film response times light) or uniform"
    )


def size_by_shape(shape: float, width: int | None, height: int | None) -> tuple[int, int]:
    """Width and height in pixels for a film of this width over height; one of them may be missing."""
    across = max(1, round((height or 0) * shape)) if width is None else width
    return across, max(1, round(across / shape)) if height is None else height
