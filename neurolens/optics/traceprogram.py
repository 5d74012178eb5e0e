"""The exact tracer as a program of float steps, from which C is written: the best that tracing can do.

A surrogate is only worth what it saves over this one. Surfaces of every shape, stop, rims, missed surfaces, total
reflection, dispersion; transmittance of bare surfaces (Fresnel, unpolarised, averaged at each surface) and of coated
ones as if they were bare: no lens is slower for its coatings here. Ray tracing after Feder, J. Opt. Soc. Am. 41 (1951);
conics, cylinders and aspheres in `traceshapes`.
"""

from __future__ import annotations

import numpy as np

from neurolens.base import status as st
from neurolens.graph.program import (
    FILM_Z,
    RAY,
    SCENE_RAY,
    STATUS,
    STOP,
    STOP_RADIUS,
    TRANSMITTANCE,
    WAVELENGTH,
    Expr,
    Program,
)
from neurolens.optics.glass import index_of
from neurolens.optics.prescription import Lens, Surface
from neurolens.optics.shapes import is_plain
from neurolens.optics.traceshapes import Vector, meet_shape

# The index is a polynomial in 1 / lambda^2 that holds it to float32's last bit.
_INDEX = 3e-8
_AIR = "air"


def exact_program(lens: Lens, pupil_z_mm: float, wavelength_nm: tuple[float, float], *, whole: bool = True) -> Program:
    """Film and pupil points in; scene ray and status out, as `graph.program` has them.

    Args:
        pupil_z_mm: plane of the pupil points. wavelength_nm: range in which the indices hold to float32's last bit.
        whole: with stop, rims and transmittance; else the ray alone, and whether it gets through.

    Coatings and absorption are not followed; who needs them must refuse such lenses.
    """
    return _Tracing(lens, pupil_z_mm, wavelength_nm, whole).program


class _Tracing:
    def __init__(self, lens: Lens, pupil_z_mm: float, wavelength_nm: tuple[float, float], whole: bool) -> None:
        self.lens, self.pupil_z_mm, self.wavelength_nm, self.whole = lens, pupil_z_mm, wavelength_nm, whole
        self.program = p = Program()
        fx, fy, px, py = (p.input(name) for name in RAY)
        self.inverse_square = p.literal(0.0)
        if lens.dispersive:
            v = p.literal(1000.0) / p.input(WAVELENGTH)
            self.inverse_square = v * v
        z = p.input(FILM_Z)
        self.stop_square = p.literal(0.0)
        if whole:
            radius = p.input(STOP_RADIUS)
            self.stop_square = radius * radius
        self.indices: dict[object, Expr] = {}
        self.lost: list[tuple[Expr, Expr, int]] = []
        self.at_stop = (fx, fy)
        self.power = p.literal(1.0)
        self._start(fx, fy, z, px, py)
        self._through()

    def _start(self, fx: Expr, fy: Expr, z: Expr, px: Expr, py: Expr) -> None:
        p = self.program
        dx, dy, dz = px - fx, py - fy, p.literal(self.pupil_z_mm) - z
        square = p.fma(dx, dx, p.fma(dy, dy, dz * dz))
        scale = p.literal(1.0) / p.op("sqrt", square)
        self.d = [dx * scale, dy * scale, dz * scale]
        self.x: Vector = (fx, fy, z)

    def _index(self, k: int) -> Expr:
        """Of the medium before surface k, as light comes from the scene."""
        p = self.program
        if k == 0:
            return p.literal(1.0)
        s = self.lens.surfaces[k - 1]
        key = (s.glass, float(s.n_d), s.V_d)
        if key not in self.indices:
            self.indices[key] = self._polynomial(s)
        return self.indices[key]

    def _polynomial(self, s: Surface) -> Expr:
        p = self.program
        if s.glass is None and s.V_d is None:
            return p.literal(float(s.n_d))
        long, short = ((1000 / w) ** 2 for w in reversed(self.wavelength_nm))
        if long == short:
            return p.literal(float(index_of(s, 1000 / long**0.5)))
        inverse = np.linspace(long, short, 200)
        n = np.array([float(index_of(s, 1000 / v**0.5)) for v in inverse])
        for degree in range(1, 8):
            fit = np.polynomial.Polynomial.fit(inverse, n, degree)
            if np.abs(fit(inverse) - n).max() < _INDEX:
                break
        return p.horner(self.inverse_square, list(fit.convert().coef))

    def _through(self) -> None:
        p, lens = self.program, self.lens
        vertex = 0.0
        for k in range(len(lens.surfaces) - 1, -1, -1):
            here = float(lens.vertices_mm[k])
            self.x = (*self.x[:2], self.x[2] + (vertex - here))
            vertex = here
            self._surface(k, lens.surfaces[k])
        for name, value in zip(SCENE_RAY, (*self.x, *self.d), strict=True):
            p.outputs[name] = value
        if self.whole:
            p.outputs[TRANSMITTANCE] = self.power
            p.outputs.update(zip(STOP, self.at_stop, strict=True))
        status = p.literal(float(st.PASSED))
        # Rays meet the last surface first: the first failure is the one written last.
        for low, high, code in reversed(self.lost):
            status = p.select(low, high, status, float(code))
        p.outputs[STATUS] = status

    def _surface(self, k: int, s: Surface) -> None:
        p, (x, y, z), (dx, dy, dz) = self.program, self.x, self.d
        c = float(s.curvature)
        # The point nearest to the vertex, then along the ray to the surface (Feder's e, M1 and L).
        e = -p.fma(x, dx, p.fma(y, dy, z * dz))
        nearest = p.fma(e, dx, x), p.fma(e, dy, y), p.fma(e, dz, z)
        normal = None
        if not is_plain(s):
            self.x, normal, q, tests = meet_shape(p, nearest, (dx, dy, dz), s)
            self.lost += [(*pair, st.blocked(k, st.MISSED)) for pair in tests]
        else:
            q = self._meet_sphere(nearest, k, c)
        x, y, z = self.x
        if s.stop:
            self.at_stop = (x, y)
        if self.whole:
            limit = self.stop_square if s.stop else p.literal(s.semi_diameter_mm**2)
            self.lost.append((p.fma(x, x, y * y), limit, st.blocked(k, st.RIM)))
        before, after = self._index(k + 1), self._index(k)
        if before.argument == after.argument:
            return
        ratio = before / after
        cos2 = p.fma(ratio * ratio, p.fma(q, q, -1.0), 1.0)
        self._test(cos2, k, st.TOTAL_REFLECTION)
        cos = p.op("sqrt", cos2)
        g = cos - ratio * q
        if normal is not None:
            self.d = [p.fma(-g, n, ratio * d) for n, d in zip(normal, self.d, strict=True)]
        else:  # of a sphere, the unit normal towards the film is (-c x, -c y, 1 - c z)
            self.d = [
                p.fma(g * c, x, ratio * dx),
                p.fma(g * c, y, ratio * dy),
                p.fma(ratio, dz, p.fma(g * c, z, -g)),
            ]
        if self.whole:
            self._fresnel(q, cos, before, after)

    def _meet_sphere(self, nearest: Vector, k: int, c: float) -> Expr:
        """Go to surface k, a sphere or a plane; returns the cosine of incidence."""
        p, (mx, my, mz), (dx, dy, dz) = self.program, nearest, self.d
        if c:
            m2 = p.fma(mx, mx, p.fma(my, my, mz * mz))
            f = p.fma(m2, c, mz * -2.0)
            q2 = p.fma(f, -c, dz * dz)
            self._test(q2, k, st.MISSED)
            q = p.op("sqrt", q2)
            way = f / (dz - q)  # towards -z
        else:
            q = -dz
            way = -(mz / dz)
        self.x = (p.fma(way, dx, mx), p.fma(way, dy, my), p.fma(way, dz, mz))
        return q

    def _test(self, square: Expr, k: int, reason: int) -> None:
        """Lost where what stands under a root is not positive; NaN too."""
        self.lost.append((self.program.literal(1e-30), square, st.blocked(k, reason)))

    def _fresnel(self, cos_i: Expr, cos_t: Expr, before: Expr, after: Expr) -> None:
        """(Ts + Tp) / 2 with one division: 2 a b (1 / s^2 + 1 / p^2), s = n1 c1 + n2 c2, p = n2 c1 + n1 c2."""
        p = self.program
        s = p.fma(before, cos_i, after * cos_t)
        t = p.fma(after, cos_i, before * cos_t)
        product = (before * cos_i) * (after * cos_t)
        st_ = s * t
        self.power = self.power * (product * 2.0 * p.fma(s, s, t * t) / (st_ * st_))
