"""A scene made ready for tracing: shapes to hit, and one row of properties a surface.

Every flat shape, box face, sphere and triangle is a surface with a number. What a path needs at a hit (normal, kind of
material, colours) is looked up by that number in flat tables, because a gather costs a nanosecond a path. Row -1 is
what a ray meets that meets nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.render.arealights import FlatLights, SphereLights
from neurolens.render.assembly import Assembly, Surfaces
from neurolens.render.checks import BLACK
from neurolens.render.coat import CoatTable
from neurolens.render.environment import SkyLight, SunLight, make_surroundings
from neurolens.render.lights import Lights, LightSamples
from neurolens.render.lightsettings import PointLight, SpotLight
from neurolens.render.materialsettings import Material
from neurolens.render.palette import Index, Palette
from neurolens.render.pointlights import PointLights
from neurolens.render.primitives import Box, IntArray, Primitive, Rays
from neurolens.render.scenefile import Scene
from neurolens.render.shapes import Disc, Sphere
from neurolens.render.spectrum import SpectralRange
from neurolens.render.textures import Textured, TextureTable

DIFFUSE, GLOSSY, MIRROR, GLASS, NOTHING = range(5)
_KINDS = {"diffuse": DIFFUSE, "glossy": GLOSSY, "mirror": MIRROR, "glass": GLASS}


class World:
    """What the integrator sees of a scene over a range of wavelengths.

    Attributes:
        kind: [S] uint8, DIFFUSE to NOTHING. normal: [3, S]. light: [S] number of the light or -1.
        reflectance_row, specular_row, index_row, absorption_row, emission_row: [S] rows of `palette`, 0 for black.
        absorbs: whether any glass does. alpha: [S] GGX width. coat: albedos of coats, of which `coat_row` [S] is one.
        lights: for direct sampling. light_emission_row: [lights] their rows of `palette`. dark: no light from afar.
    """

    def __init__(self, scene: Scene, spectral: SpectralRange) -> None:
        self.palette = Palette(spectral, scene.illuminants, scene.reflectances)
        self.scene = scene
        assert self.palette.colour(BLACK) == 0
        assembly = Assembly(scene)
        self._primitives, self._boxes, self._smooth = assembly.primitives, assembly.boxes, assembly.smooth
        self._fill_tables(assembly.surfaces, spectral)
        self._fill_spheres(assembly.first_sphere)
        self._make_lights(assembly.surfaces)
        self.palette.freeze()
        self._shadow_casters = [p for p in self._primitives if not self._never_shades(p)]

    def _fill_tables(self, surfaces: Sequence[Surfaces], spectral: SpectralRange) -> None:
        """One row a surface, and the last one for nothing."""
        parts = [*surfaces, Surfaces(np.zeros((1, 3)), None)]
        materials, counts = [part.material for part in parts], [part.count for part in parts]
        colour, palette = self.palette.colour, self.palette

        def spread(values: list[int] | list[float], kind: type) -> NDArray:
            return np.repeat(np.array(values, kind), counts)

        self.normal = np.concatenate([part.normals for part in parts]).T.astype(np.float32)
        self.kind = spread([_KINDS[m.kind] if m else NOTHING for m in materials], np.uint8)
        self.light = spread([part.light for part in parts], np.intp)
        self.emission_row = spread([palette.light(part.emission, part.illuminant) for part in parts], np.intp)
        reflectances = [palette.reflectance((m and m.reflectance) or BLACK) for m in materials]
        self.reflectance_row = spread(reflectances, np.intp)
        self.specular_row = spread([colour((m and m.specular) or BLACK) for m in materials], np.intp)
        self.index_row = spread([palette.index(m.n_d, m.V_d) if m and m.n_d else 0 for m in materials], np.intp)
        self.absorption_row = spread([self._absorption(m) for m in materials], np.intp)
        alphas = [m.roughness**2 if m and m.roughness else 1.0 for m in materials]
        self.absorbs = bool(self.absorption_row.any())
        self.alpha = spread(alphas, np.float32)
        used = sorted({alpha for alpha, m in zip(alphas, materials, strict=True) if m and m.kind == "glossy"})
        self.coat = CoatTable(used)
        self.coat_row = spread([used.index(alpha) if alpha in used else 0 for alpha in alphas], np.intp)
        textures = [m.texture if m else None for m in materials]
        textured = [Textured(p.count, t, p.frames) for p, t in zip(parts, textures, strict=True)]
        self.textures = TextureTable(self.scene.settings.textures or {}, self.scene.images, textured, colour, spectral)

    def _absorption(self, material: Material | None) -> int:
        if material is None or material.transmittance is None or material.transmittance_depth_m is None:
            return 0
        return self.palette.absorption(material.transmittance, material.transmittance_depth_m)

    def _fill_spheres(self, first: int) -> None:
        """Centre and 1 / radius of each sphere, 0 for other surfaces."""
        self._spheres = np.zeros((4, len(self.kind)), np.float32)
        for number, sphere in enumerate(self.scene.settings.spheres, first):
            self._spheres[:, number] = (*sphere.centre_m, 1 / sphere.radius_m)
        self._has_spheres = bool(self.scene.settings.spheres)

    def _make_lights(self, surfaces: Sequence[Surfaces]) -> None:
        """All lights, in the order in which `Assembly` counts those with a surface: quads, discs, spheres."""
        settings, light = self.scene.settings, self.palette.light
        quads = [quad for quad in settings.quads if any(quad.emission)]
        discs = [disc for disc in settings.discs if any(disc.emission)]
        spheres = [sphere for sphere in settings.spheres if any(sphere.emission)]
        sizeless: list[PointLight | SpotLight] = [*settings.points, *settings.spots]
        self._surroundings = make_surroundings(settings.environment, settings.sky, self.scene.environment, self.palette)
        self._sky, self._sun = SkyLight(self._surroundings), SunLight(settings.sky)
        groups = (
            FlatLights(quads, discs),
            SphereLights(spheres),
            PointLights(settings.points, settings.spots),
            self._sun,
            self._sky,
        )
        self.lights = Lights(groups, settings.camera.look_at_m)
        rows = [light(part.emission, part.illuminant) for part in surfaces if part.light >= 0]
        rows += [light(point.intensity, point.illuminant) for point in sizeless]
        if settings.sky is not None and self._sun.count:
            rows.append(self._sun.row(settings.sky, self.palette))
        # The sky's number is the last; what it shines depends on the direction.
        self._sky_number = len(rows) if self._sky.count else -1
        self._sun_number = len(rows) - 1 if self._sun.count else -1
        self.light_emission_row = np.array([*rows, 0], np.intp)
        self.dark = self._surroundings.dark and not self._sun.count

    def _never_shades(self, shape: Primitive) -> bool:
        """Whether no shadow ray can be blocked: the walls of a room around every light, as walls let light in."""
        if not isinstance(shape, Box) or not shape.room or self._sky.count or self._sun.count:
            return False
        settings = self.scene.settings
        points = [np.array(point.position_m) for point in settings.points]
        points += [np.array(spot.position_m) for spot in settings.spots]
        round_lights: list[Sphere | Disc] = [*settings.spheres, *settings.discs]
        for light in round_lights:
            if any(light.emission):
                points += [np.add(light.centre_m, side * light.radius_m) for side in (-1, 1)]
        for quad in settings.quads:
            if any(quad.emission):
                points += [np.array(quad.corner_m), np.sum([quad.corner_m, quad.edge_u_m, quad.edge_v_m], axis=0)]
        return all(bool(np.all((p > shape.low) & (p < shape.high))) for p in points)

    def nearest(self, rays: Rays) -> tuple[FloatArray, IntArray]:
        """Distance [N] in m (inf: none) and surface [N] that rays hit first; -1 for none, of a box its first face."""
        count = rays.origin.shape[1]
        best, found = np.full(count, np.inf, np.float32), np.full(count, -1, np.int32)
        for shape in self._primitives:
            shape.nearer(rays, best, found)
        return best, found

    def visible(self, origin: FloatArray, direction: FloatArray, distance: FloatArray) -> NDArray[np.bool_]:
        """Whether nothing stands on the way [N] from origins [3, N] to lights at `distance` [N]."""
        rays = Rays.of(origin, direction)
        best, found = distance * np.float32(1 - 1e-4), np.full(len(distance), -1, np.int32)
        for shape in self._shadow_casters:
            shape.nearer(rays, best, found)
        return found < 0

    def surfaces(self, found: IntArray, point: FloatArray) -> Index:
        """Surface numbers [N], the faces of boxes told apart."""
        surface = found.astype(np.intp)
        for box in self._boxes:
            rows = np.flatnonzero(found == box.first)
            if rows.size:
                surface[rows] = box.face(point.take(rows, axis=1))
        return surface

    def normals(self, surface: Index, point: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Outward geometric and shading normals [3, N] at points [3, N] of surfaces [N]."""
        normal = self.normal.take(surface, axis=1)
        if self._has_spheres:
            rows = np.flatnonzero(self._spheres[3].take(surface))
            number = surface[rows]
            local = point.take(rows, axis=1) - self._spheres[:3].take(number, axis=1)
            local *= self._spheres[3].take(number)
            normal[:, rows] = local
        shading = normal
        for mesh in self._smooth:
            rows = np.flatnonzero((surface >= mesh.first) & (surface < mesh.first + len(mesh.planes)))
            if rows.size:
                shading = normal.copy() if shading is normal else shading
                triangle = surface[rows] - mesh.first
                at = np.vstack([point.take(rows, axis=1), np.ones(len(rows), np.float32)])
                u, v = np.einsum("tij,jt->it", mesh.planes[triangle, 1:], at)
                weights = np.stack([1 - u - v, u, v])
                blended = np.einsum("it,tij->jt", weights, mesh.normals[triangle])
                shading[:, rows] = blended / np.sqrt(np.maximum(np.sum(blended**2, axis=0), 1e-12))
        return normal, shading

    def reflectance(self, surface: Index, point: FloatArray, bins: Index) -> FloatArray:
        """Reflectance [..., N] at wavelength bins [N], textures included."""
        value = self.palette.look_up(self.reflectance_row.take(surface), bins)
        self.textures.apply(value, surface, point, bins, self.palette.look_up)
        return value

    def aimed_emission(self, aimed: LightSamples, rows: Index, bins: Index) -> FloatArray:
        """Emission [..., n] of the lights that some rows [n] aim at, at wavelength bins [n]."""
        light = aimed.light[rows]
        emitted = self.palette.look_up(self.light_emission_row.take(light), bins)
        if self._sky_number >= 0:
            far = np.flatnonzero(light == self._sky_number)
            emitted[..., far] = self._surroundings.radiance(aimed.direction.take(rows[far], axis=1), bins[far])
        return emitted

    def environment(self, direction: FloatArray, bins: Index, density: FloatArray | None = None) -> FloatArray:
        """Radiance [..., N] from infinitely far along directions [3, N].

        With `density` [N], with which scattering chose them, each part is weighted against aiming at it.
        """
        light = self._surroundings.radiance(direction, bins)
        if self._sky_number >= 0 and density is not None:
            light /= self._rivals(self._sky_number, self._sky.far_pdf(direction), density)
        if self._sun_number >= 0:
            aimed = self._sun.far_pdf(direction)
            rows = np.flatnonzero(aimed)
            sun = self.palette.look_up(np.full(len(rows), self.light_emission_row[self._sun_number]), bins[rows])
            if density is not None:
                sun /= self._rivals(self._sun_number, aimed[rows], density[rows])
            light[..., rows] += sun
        return light

    def _rivals(self, light: int, pdf: FloatArray, density: FloatArray) -> FloatArray:
        """1 over the weight [N] of scattering by the power heuristic."""
        ratio = pdf * self.lights.probability[light] / density
        result: FloatArray = 1 + ratio * ratio
        return result
