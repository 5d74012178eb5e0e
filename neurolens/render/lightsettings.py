"""Lights without a surface in a scene file: points, spots, what is infinitely far away, and the clear sky.

An emission is a radiance: 1 is what a picture shows as white. The `intensity` of a light without size is a radiant
intensity in the same units times m^2 (as W/sr is to W/(sr m^2)): at distance d a surface that faces it receives the
irradiance intensity / d^2, as much as from a small sphere of radius r and emission L with pi r^2 L = intensity.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from neurolens.render.checks import (
    BRIGHTEST,
    Vector,
    require,
    require_angle,
    require_emission,
    require_place,
)

_NARROWEST_DEG = 0.01  # of the falloff of a spot


@dataclass(frozen=True)
class PointLight:
    """A light without size that shines alike in all directions; `illuminant` as for quads."""

    position_m: Vector
    intensity: Vector
    illuminant: str = "D65"

    def __post_init__(self) -> None:
        require_place("position_m", self.position_m)
        _require_light("intensity", self.intensity)


@dataclass(frozen=True)
class SpotLight:
    """A light without size that shines into a cone about the direction to `look_at_m`.

    Its intensity is `intensity` within the half angle `inner_deg` of the axis and 0 beyond `outer_deg`; in between it
    falls by the smoothstep t^2 (3 - 2t) of t = (cos angle - cos outer) / (cos inner - cos outer).
    """

    position_m: Vector
    look_at_m: Vector
    intensity: Vector
    outer_deg: float
    inner_deg: float = 0.0
    illuminant: str = "D65"

    def __post_init__(self) -> None:
        require_place("position_m", self.position_m)
        require_place("look_at_m", self.look_at_m)
        require(self.position_m != self.look_at_m, "look_at_m", self.look_at_m, "a point other than position_m")
        _require_light("intensity", self.intensity)
        require(0.1 <= self.outer_deg <= 90, "outer_deg", self.outer_deg, "a half angle from 0.1 to 90 degrees")
        # Nearer, their cosines would differ by the rounding of float32 or not at all.
        ok = 0 <= self.inner_deg <= self.outer_deg - _NARROWEST_DEG + 1e-9
        expected = f"a half angle from 0 to {_NARROWEST_DEG:g} below outer_deg"
        require(ok, "inner_deg", self.inner_deg, expected)


def _require_light(field: str, value: Vector) -> None:
    require_emission(field, value)
    require(any(value), field, value, "a number above 0 among the three")


@dataclass(frozen=True)
class Environment:
    """Light from infinitely far: one `colour`, a gradient by height from ground over horizon to zenith, or a picture.

    A picture `file` (beside the scene file) is equirectangular: its middle lies towards -z, its right half towards +x,
    its top row at the zenith. OpenEXR is read as linear sRGB, other pictures as sRGB. It is multiplied by `scale` and
    turned by `rotate_y_deg` about y as meshes are. `illuminant`: the light that the colours tint.
    """

    colour: Vector | None = None
    zenith: Vector | None = None
    horizon: Vector | None = None
    ground: Vector | None = None
    file: Path | None = None
    scale: float = 1.0
    rotate_y_deg: float = 0.0
    illuminant: str = "D65"

    def __post_init__(self) -> None:
        gradient = (self.zenith, self.horizon, self.ground)
        for field in ("colour", "zenith", "horizon", "ground"):
            if (value := getattr(self, field)) is not None:
                require_emission(field, value)
        kinds = [self.colour is not None, any(band is not None for band in gradient), self.file is not None]
        expected = "one of: colour; zenith, horizon and ground; file"
        require(sum(kinds) == 1, "environment", "(nothing)" if not any(kinds) else "(several)", expected)
        if kinds[1]:
            whole = all(band is not None for band in gradient)
            require(whole, "environment", "(incomplete)", "colour, or zenith, horizon and ground")
        if self.file is None:
            require(self.scale == 1, "scale", self.scale, "left out: it multiplies a picture")
            require(self.rotate_y_deg == 0, "rotate_y_deg", self.rotate_y_deg, "left out: it turns a picture")
        require(0 < self.scale <= BRIGHTEST, "scale", self.scale, f"a number above 0, at most {BRIGHTEST:g}")
        require_angle("rotate_y_deg", self.rotate_y_deg)


@dataclass(frozen=True)
class Sky:
    """A clear sky with its sun (Preetham, Shirley and Smits 1999); black below the horizon.

    Attributes:
        sun_elevation_deg: of the sun above the horizon. sun_azimuth_deg: from -z over +x.
        turbidity: haze; 2 is very clear, 3 clear, 6 hazy, 10 very hazy.
        sun: whether the sun's disc shines as well.
        white_kcd_per_m2: luminance that counts as emission 1. A white surface in the sun has some 30.
    """

    sun_elevation_deg: float
    sun_azimuth_deg: float = 0.0
    turbidity: float = 3.0
    sun: bool = True
    white_kcd_per_m2: float = 20.0

    def __post_init__(self) -> None:
        elevation = self.sun_elevation_deg
        require(0 <= elevation <= 90, "sun_elevation_deg", elevation, "a number from 0 (horizon) to 90 (zenith)")
        require_angle("sun_azimuth_deg", self.sun_azimuth_deg)
        require(2 <= self.turbidity <= 10, "turbidity", self.turbidity, "a number from 2 to 10")
        white = self.white_kcd_per_m2
        require(1e-6 <= white <= 1e6, "white_kcd_per_m2", white, "a number from 1e-06 to 1e+06")
