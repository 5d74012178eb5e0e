"""A scene: a TOML file, then the pictures, meshes and spectra that it names, with every reference checked.

The tables of shapes, materials and lights are defined in `neurolens.pictures.render.scenetables`.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError, printable
from neurolens.base.settings import LIGHT_NM, Rule, from_dict, setting, setting_of
from neurolens.base.tomlfile import read_toml, suggestion
from neurolens.cameras.contract import FloatArray
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.shot import Shot, StopShape
from neurolens.pictures.render import scenetables as tables
from neurolens.pictures.render.colour import Spectrum, check_name, check_spectrum, illuminant, read_spectrum
from neurolens.pictures.render.images import make_aperture, read_environment, read_pictures
from neurolens.pictures.render.mesh import Parts, TriangleSet
from neurolens.pictures.render.scenetables import (
    BLACK,
    Checked,
    Material,
    MeasuredSpectrum,
    Texture,
    Vector,
    require,
)
from neurolens.pictures.render.settings import FilmSettings, FlareSettings, SensorSettings

_SHAPES = ("planes", "quads", "discs", "spheres", "boxes", "rooms", "meshes")
_FILM_MM = (36.0, 20.25)
_WALLS = ("left", "right", "floor", "ceiling", "far", "near")


@dataclass(frozen=True, kw_only=True)
class CameraSettings(Shot, StopShape, Checked):
    """Place, shot and picture of the camera; which camera it is, the caller of `render` chooses.

    Attributes: those of `Shot` and `StopShape`, whose mask is a picture beside the scene, and
        position_m: the film-plane centre. look_at_m: a point on the optical axis. up: points to the picture's top.
        width, height: of the picture, in pixels. samples: per pixel.
        max_depth: at how many surfaces along a path light is scattered.
    """

    position_m: tables.Place
    look_at_m: tables.Place
    up: tables.Place = (0.0, 1.0, 0.0)
    focus_m: float = setting_of(Shot, "focus_m", ...)
    film_mm: tuple[float, float] = _FILM_MM
    wavelength_nm: Annotated[
        tuple[float, float], Rule(lambda v: 380 <= v[0] <= v[1] <= 780, "low and high within 380 to 780")
    ] = field(default=LIGHT_NM, metadata={"was": ("wavelengths_nm",)})
    aperture: Any = field(default=None, init=False)
    clamp_f_number: bool = field(default=True, init=False)
    width: int = setting(
        320, "width of the picture (default: the scene's, or from --height and the film's shape)", within=(1, 16384),
        metavar="PIXELS", common=True,
    )  # fmt: skip
    height: int = setting(
        180,
        "height of the picture (default: the scene's, or from --width and the film's shape)",
        within=(1, 16384),
        metavar="PIXELS",
    )
    samples: int = setting(64, "samples of a pixel (default: the scene's)", within=(1, 2**20), common=True)
    max_depth: int = setting(6, "surfaces at which a path may scatter (default: the scene's)", within=(1, 1000))

    def __post_init__(self) -> None:
        super().__post_init__()
        axis, up = np.subtract(self.look_at_m, self.position_m), np.array(self.up)
        far, high = float(np.linalg.norm(axis)), float(np.linalg.norm(up))
        require(far > 0, "look_at_m", self.look_at_m, "a point other than position_m")
        across = float(np.linalg.norm(np.cross(axis, up)))
        require(across > 1e-6 * far * high, "up", self.up, "a direction not along the optical axis")

    def shot(self, aperture: Aperture | None = None) -> Shot:
        """Return the scene's shot; its f-number is clamped to that of the lens."""
        return Shot(**{f.name: getattr(self, f.name) for f in fields(Shot)} | {"aperture": aperture})


@dataclass(frozen=True)
class SceneSettings:
    """The tables of a whole scene file."""

    camera: CameraSettings
    film: FilmSettings = FilmSettings()
    sensor: SensorSettings | None = None
    flare: FlareSettings | None = None
    illuminants: dict[str, MeasuredSpectrum] = field(default_factory=dict)
    environment: tables.Environment = tables.Environment(colour=BLACK)
    sky: tables.Sky | None = None
    reflectances: dict[str, MeasuredSpectrum] = field(default_factory=dict)
    textures: dict[str, Texture] = field(default_factory=dict)
    materials: dict[str, Material] = field(default_factory=dict)
    planes: tuple[tables.Plane, ...] = ()
    quads: tuple[tables.Quad, ...] = ()
    discs: tuple[tables.Disc, ...] = ()
    spheres: tuple[tables.Sphere, ...] = ()
    boxes: tuple[tables.Box, ...] = ()
    rooms: tuple[tables.Room, ...] = ()
    meshes: tuple[tables.MeshSettings, ...] = ()
    points: tuple[tables.PointLight, ...] = ()
    spots: tuple[tables.SpotLight, ...] = ()

    def __post_init__(self) -> None:
        dark = self.sky is None or self.environment == tables.Environment(colour=BLACK)
        require(dark, "sky", "(given)", "either sky or environment")


@dataclass(frozen=True)
class Scene:
    """A scene with all it needs.

    Attributes:
        name: the file's name without its ending. settings: the tables of the file.
        images: linear RGB [H, W, 3] of each image texture. triangles: a set for each mesh.
        aperture: shape of the stop's opening, None if not given.
        illuminants, reflectances: measured spectra by name.
        environment: linear RGB [H, W, 3] of the environment's picture, if it has one.
    """

    name: str
    settings: SceneSettings
    images: dict[str, FloatArray]
    triangles: tuple[TriangleSet, ...]
    aperture: Aperture | None = None
    illuminants: dict[str, Spectrum] = field(default_factory=dict)
    reflectances: dict[str, Spectrum] = field(default_factory=dict)
    environment: FloatArray | None = None


def load_scene(path: str | Path) -> Scene:
    """Read a scene file; pictures and meshes lie beside it.

    Raises:
        InputError: a key is unknown or missing, a type or value is wrong, a material or texture is not defined, a
            picture or mesh is missing or broken, a triangle is degenerate. It names file, field, value and what was
            expected.
    """
    return scene_from_tables(read_toml(path), path)


def scene_from_tables(tables: Mapping[str, Any], path: str | Path = "scene") -> Scene:
    """Make a scene from tables in memory, as `load_scene` does; `path` is for messages and for finding files."""
    path = Path(path)
    settings = from_dict(SceneSettings, _with_film(tables, path), path)
    parts = Parts(path, settings.meshes, settings.materials)
    materials, textures = parts.materials | settings.materials, parts.textures | settings.textures
    settings = replace(settings, meshes=tuple(parts.meshes), materials=materials, textures=textures)
    triangles = tuple(parts.triangles)
    _check_references(path, settings, triangles)
    _check_camera(path, settings, triangles)
    named = {name: t.file for name, t in textures.items() if t.file is not None}
    pictures = read_pictures(path, {f"textures.{name}.file": path.parent / file for name, file in named.items()})
    images = dict(zip(named, pictures.values(), strict=True))
    around, scale = settings.environment.file, settings.environment.scale
    return Scene(
        printable(path.stem),
        settings,
        images,
        triangles,
        _aperture(path, settings.camera),
        _illuminants(path, settings),
        _spectra(path, "reflectances", settings.reflectances, settings.camera, most=1.0),
        None if around is None else read_environment(path, "environment.file", path.parent / around, scale),
    )


def _with_film(tables: Mapping[str, Any], path: Path) -> Mapping[str, Any]:
    """Return a scene's tables with `film_mm` in place of its earlier keys, film_width_mm and film_height_mm."""
    camera, sides = tables.get("camera"), ("film_width_mm", "film_height_mm")
    if not (isinstance(camera, Mapping) and set(sides) & camera.keys()):
        return tables
    if "film_mm" in camera:
        raise InputError(path, "camera.film_mm", camera["film_mm"], f"left out beside {sides[0]} and {sides[1]}")
    film_mm = [camera.get(side, default) for side, default in zip(sides, _FILM_MM, strict=True)]
    rest = {key: value for key, value in camera.items() if key not in sides}
    return {**tables, "camera": {**rest, "film_mm": film_mm}}


def seen_from(scene: Scene, path: str | Path, position_m: Vector | None, look_at_m: Vector | None) -> Scene:
    """Return the scene from another place, towards another point; None keeps the scene's. Errors as in `load_scene`."""
    moved: dict[str, Any] = {"position_m": position_m, "look_at_m": look_at_m}
    changes = {name: value for name, value in moved.items() if value is not None}
    if not changes:
        return scene
    try:
        settings = replace(scene.settings, camera=replace(scene.settings.camera, **changes))
    except InputError as error:
        raise InputError(path, f"camera.{error.field}", error.value, error.expected) from None
    _check_camera(Path(path), settings, scene.triangles)
    return replace(scene, settings=settings)


def _aperture(path: Path, camera: CameraSettings) -> Aperture | None:
    mask = None if camera.aperture_mask is None else path.parent / camera.aperture_mask
    try:
        return make_aperture(replace(camera, aperture_mask=mask))
    except InputError as error:
        raise InputError(path, f"camera, {error.file} {error.field}", error.value, error.expected) from None


def _illuminants(path: Path, settings: SceneSettings) -> dict[str, Spectrum]:
    low, high = settings.camera.wavelength_nm
    measured = _spectra(path, "illuminants", settings.illuminants, settings.camera)
    for name, (nm, values) in measured.items():
        if illuminant(name) is not None:
            raise InputError(path, f"illuminants.{name}", name, "a name that no illuminant has yet")
        if not np.interp(np.linspace(low, high, 4096), nm, values).any():
            raise InputError(path, f"illuminants.{name}", "(all 0)", f"light between {low:g} and {high:g} nm")
    for kind in ("quads", "discs", "spheres", "points", "spots"):
        for k, light in enumerate(getattr(settings, kind)):
            check_name(path, f"{kind}[{k}].illuminant", light.illuminant, measured)
    check_name(path, "environment.illuminant", settings.environment.illuminant, measured)
    if settings.film.white_balance is not None:
        check_name(path, "film.white_balance", settings.film.white_balance, measured)
    return measured


def _spectra(
    path: Path,
    kind: str,
    tables: Mapping[str, MeasuredSpectrum],
    camera: CameraSettings,
    most: float | None = None,
) -> dict[str, Spectrum]:
    """Return measured spectra over the camera's wavelengths, scaled to a maximum of 1 (with `most`: unscaled)."""
    low, high = camera.wavelength_nm
    found = {}
    for name, table in tables.items():
        place = f"{kind}.{name}"
        if table.file is not None:
            nm, values = read_spectrum(path, f"{place}.file", path.parent / table.file, most)
        else:
            nm, values = check_spectrum(path, f"{place}.spectrum", table.spectrum or (), most)
        if nm[0] > low or nm[-1] < high:
            expected = f"the {low:g} to {high:g} nm of the camera; what is dark there is written as 0"
            raise InputError(path, place, f"({nm[0]:g} to {nm[-1]:g} nm)", expected)
        found[name] = nm, values
    return found


def _check_references(path: Path, settings: SceneSettings, triangles: Sequence[TriangleSet]) -> None:
    """Check that named materials, textures and reflectances exist, and that textures fit their shapes."""
    materials, textures = settings.materials, settings.textures
    for name, material in materials.items():
        if material.texture is not None:
            _known(path, f"materials.{name}.texture", material.texture, textures)
        if isinstance(material.reflectance, str):
            _known(path, f"materials.{name}.reflectance", material.reflectance, settings.reflectances)
    for kind in _SHAPES:
        for k, shape in enumerate(getattr(settings, kind)):
            for part in ("material", *(_WALLS if kind == "rooms" else ())):
                used = getattr(shape, part)
                if used is None:
                    continue
                place = f"{kind}[{k}].{part}"
                _known(path, place, used, materials)
                mesh = triangles[k] if kind == "meshes" else None
                _check_texture(path, place, kind, materials[used], textures, mesh)


def _known(path: Path, place: str, name: str, names: Mapping[str, Any]) -> None:
    if name not in names:
        listed = ", ".join(names) or "none is defined"
        raise InputError(path, place, name, f"one of: {listed}{suggestion(name, list(names))}")


def _check_texture(
    path: Path, place: str, kind: str, material: Material, textures: Mapping[str, Texture], mesh: TriangleSet | None
) -> None:
    texture, name = textures.get(material.texture or ""), material.texture
    if texture is None:
        return
    if kind == "spheres":
        raise InputError(path, place, name, "a material without texture on a curved shape")
    if mesh is not None:
        if texture.kind != "image" or texture.size_m is not None:
            raise InputError(path, place, name, "an image texture without size_m on a mesh")
        if mesh.uv is None:
            raise InputError(path, place, name, "a mesh file with texture coordinates, or no texture")
    elif kind not in ("quads", "discs") and texture.kind == "image" and texture.size_m is None:
        raise InputError(path, f"textures.{name}.size_m", "(missing)", "width, height in m")


def encloses(mesh: TriangleSet, point: NDArray[np.float64]) -> bool:
    """Return whether a point [3] lies inside a closed mesh whose triangles face outwards.

    The winding number decides, the sum of the triangles' solid angles over 4 pi (van Oosterom and Strackee 1983): 1
    inside, 0 outside. It is -1 in a room, whose triangles face inwards, and means nothing for an open mesh.
    """
    corners = mesh.vertices[mesh.faces]
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    if not np.all((point > low) & (point < high)) or not _is_closed(corners):
        return False
    a, b, c = np.moveaxis(corners - point, 1, 0)
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    volume = np.sum(a * np.cross(b, c), axis=1)
    ab, bc, ca = (np.sum(x * y, axis=1) for x, y in ((a, b), (b, c), (c, a)))
    solid = 2 * np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb)
    return bool(solid.sum() / (4 * np.pi) > 0.5)


def _is_closed(corners: NDArray[np.float64]) -> bool:
    """Return whether each edge of triangles [T, 3, 3], told by its position, runs as often forwards as backwards."""
    _, number = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    faces = number.reshape(-1, 3)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forth, back = (np.unique(pair, axis=0, return_counts=True) for pair in (edges, edges[:, ::-1]))
    return forth[0].shape == back[0].shape and all(np.array_equal(x, y) for x, y in zip(forth, back, strict=True))


def _check_camera(path: Path, settings: SceneSettings, triangles: Sequence[TriangleSet]) -> None:
    """Check that the film's centre is not inside a solid: a sphere, a box, or a closed mesh with its front outside."""
    at = np.array(settings.camera.position_m)
    spheres, boxes = settings.spheres, settings.boxes
    solids: dict[str, bool | np.bool_] = {
        **{f"meshes[{k}]": encloses(mesh, at) for k, mesh in enumerate(triangles)},
        **{f"spheres[{k}]": np.sum((at - s.centre_m) ** 2) < s.radius_m**2 for k, s in enumerate(spheres)},
        **{f"boxes[{k}]": np.all((at > b.min_m) & (at < b.max_m)) for k, b in enumerate(boxes)},
    }
    for name, inside in solids.items():
        if inside:
            position = list(settings.camera.position_m)
            raise InputError(path, "camera.position_m", position, f"a place outside {name}")


def files_named(tables: Any) -> Iterator[Path]:
    """Yield every file named in a scene's tables, as written there."""
    if isinstance(tables, Path):
        yield tables
    elif is_dataclass(tables):
        for each in fields(tables):
            yield from files_named(getattr(tables, each.name))
    elif isinstance(tables, (Mapping, tuple)):
        for item in tables.values() if isinstance(tables, Mapping) else tables:
            yield from files_named(item)
