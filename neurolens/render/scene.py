"""What a scene file says: frozen dataclasses, one for each kind of table, checked one by one.

Metres, y up, colours linear sRGB. The reader is `neurolens.render.scenefile`. Shapes are in `neurolens.render.shapes`,
materials in `materialsettings`, lights without a surface in `lightsettings`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from neurolens.render.checks import BLACK, Vector, length, require, require_place, require_positive
from neurolens.render.filmsettings import FilmSettings
from neurolens.render.illuminants import IlluminantSettings
from neurolens.render.lightsettings import Environment, PointLight, Sky, SpotLight
from neurolens.render.materialsettings import Material, ReflectanceSettings, Texture
from neurolens.render.shapes import Box, Disc, MeshSettings, Plane, Quad, Room, Sphere


@dataclass(frozen=True)
class CameraSettings:
    """Where the camera stands and what it takes; which camera it is, the caller of `render` decides.

    Attributes:
        position_m: film-plane centre. look_at_m: a point on the optical axis. up: points to the picture's top.
        focus_m: distance from film to the object in focus. f_number: None leaves it to the lens.
        blades, blade_rotation_deg, blade_curvature, aperture_mask: shape of the stop's opening, see
            `optics.apertures`; the mask is a picture beside the scene. Without them the lens's own, else round.
        film_width_mm, film_height_mm: the part of the film that is used.
        wavelengths_nm: range of light. width, height: picture in pixels. samples: a pixel.
        max_depth: number of surfaces along a path at which light is scattered.
    """

    position_m: Vector
    look_at_m: Vector
    focus_m: float
    up: Vector = (0.0, 1.0, 0.0)
    f_number: float | None = None
    blades: int | None = None
    blade_rotation_deg: float | None = None
    blade_curvature: float | None = None
    aperture_mask: Path | None = None
    film_width_mm: float = 36.0
    film_height_mm: float = 20.25
    wavelengths_nm: tuple[float, float] = (400.0, 700.0)
    width: int = 320
    height: int = 180
    samples: int = 64
    max_depth: int = 6

    def __post_init__(self) -> None:
        for field in ("position_m", "look_at_m", "up"):
            require_place(field, getattr(self, field))
        axis = tuple(b - a for a, b in zip(self.position_m, self.look_at_m, strict=True))
        require(length(axis) > 0, "look_at_m", self.look_at_m, "a point other than position_m")  # type: ignore[arg-type]
        across = _cross(axis, self.up)  # type: ignore[arg-type]
        parallel = length(across) <= 1e-6 * length(axis) * length(self.up)  # type: ignore[arg-type]
        require(not parallel, "up", self.up, "a direction not along the optical axis")
        require(self.focus_m > 0, "focus_m", self.focus_m, "a number above 0")
        if self.f_number is not None:
            require_positive("f_number", self.f_number)
        require_positive("film_width_mm", self.film_width_mm)
        require_positive("film_height_mm", self.film_height_mm)
        low, high = self.wavelengths_nm
        require(380 <= low <= high <= 780, "wavelengths_nm", self.wavelengths_nm, "low and high within 380 to 780")
        for field, most in (("width", 16384), ("height", 16384), ("samples", 1 << 20), ("max_depth", 1000)):
            value = getattr(self, field)
            require(1 <= value <= most, field, value, f"an integer from 1 to {most}")


def _cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@dataclass(frozen=True)
class SceneSettings:
    """A whole scene file."""

    camera: CameraSettings
    film: FilmSettings = FilmSettings()
    illuminants: dict[str, IlluminantSettings] | None = None
    environment: Environment = Environment(colour=BLACK)
    sky: Sky | None = None
    reflectances: dict[str, ReflectanceSettings] | None = None
    textures: dict[str, Texture] | None = None
    materials: dict[str, Material] | None = None
    planes: tuple[Plane, ...] = ()
    quads: tuple[Quad, ...] = ()
    discs: tuple[Disc, ...] = ()
    spheres: tuple[Sphere, ...] = ()
    boxes: tuple[Box, ...] = ()
    rooms: tuple[Room, ...] = ()
    meshes: tuple[MeshSettings, ...] = ()
    points: tuple[PointLight, ...] = ()
    spots: tuple[SpotLight, ...] = ()

    def __post_init__(self) -> None:
        if self.sky is not None:
            dark = self.environment == Environment(colour=BLACK)
            require(dark, "sky", "(given)", "either sky or environment")
