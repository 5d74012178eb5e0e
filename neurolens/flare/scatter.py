"""How light scatters in a lens: at its tube and rings, on the film, at dust on the front surface, in hazy glass.

These are simple models that conserve energy, written as graphs of one event for photons (`flare.photons`). Between two
surfaces the lens sits in a tube as wide as the wider rim; flat rings close the tube towards the rims, and the stop is a
plate. Walls reflect by Lambert's law or about the direction of a mirror. Haze and dust deflect light by the phase
function of Henyey and Greenstein (1941). Frames are those of `flare.steps`: light travels towards -z.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from neurolens.flare.steps import LOST, STATE
from neurolens.graph.ir import Graph, Value
from neurolens.lens.prescription import Lens
from neurolens.render.flaresettings import Scatter
from neurolens.trace.shapes import sag_mm

CHANCES = 5  # rows: an exponential variate; two uniform ones; cosine and sine of a uniform angle
PASSED, VOLUME, WALL, NOWHERE = range(4)  # what happens to light: see `scatter_graph`
NUMBERS = (
    "shift_mm", "tube_mm", "ring_r2_mm2", "ring_z_mm", "per_rim2", "least_mm", "per_mm", "layer", "forward", "gloss",
)  # fmt: skip
_LOBE = 0.9  # mean cosine of the glossy lobe about the mirror's direction, 26 degrees
_TINY, _NEAR = 1e-20, 1e-3
_FLAT = 1e-6  # the smallest cosine with the axis, so that no light stays between two surfaces for ever


def scatter_numbers(scatter: Scatter, lens: Lens) -> NDArray[np.float32]:
    """`NUMBERS` for the way to every surface, towards the film and back, [surfaces, 2, NUMBERS]."""
    z, rows = [float(v) for v in lens.vertices_mm], lens.surfaces
    found = np.zeros((len(rows), 2, len(NUMBERS)), np.float32)
    for k, s in enumerate(rows):
        r = s.semi_diameter_mm
        for way, sense in enumerate((1, -1)):
            last = k - sense
            inside = 0 <= last < len(rows)
            tube = max(r, rows[last].semi_diameter_mm) if inside else 0.0
            medium = rows[min(k, last)].n_d if inside else 1.0
            bends = s.n_d != lens.media[k].n_d
            dusty = -math.log1p(-min(scatter.dust, 1 - 1e-7)) if last < 0 else 0.0
            found[k, way] = (
                sense * (z[k] - z[last]) if inside else 0.0,
                tube,
                0.0 if s.stop else (r * (1 - 1e-4)) ** 2,
                -sense * float(sag_mm(s, r, 0.0)),
                1 / r**2 if bends else LOST,
                -_NEAR if inside else -LOST,
                scatter.haze_per_mm * (medium > 1),
                dusty,
                max(scatter.dust_forward if last < 0 else scatter.haze_forward, _NEAR),
                scatter.gloss,
            )
    return found


def scatter_graph() -> Graph:
    """The graph of what happens to light on its way to a surface.

    Its inputs are `row`, the state before [8], the state after refraction there [8] and random numbers [CHANCES]; and
    `call`, the `NUMBERS`. Its output `event` has x, y, z and the direction in the frame of the next step, then what
    happens (`PASSED`, ...), and whether light then travels the other way. Light that the surface refracts or totally
    reflects has met it; other light meets the ring, the tube, or nothing.
    """
    g = Graph()
    row, call = g.input("row", 2 * STATE + CHANCES), g.input("call", len(NUMBERS), per_call=True)
    shift, tube, ring_r2, ring_z, per_rim2, least, per_mm, layer, forward, gloss = (call[k] for k in range(call.rows))
    zero, tiny, near = g.constant(0.0), g.constant(_TINY), g.constant(-_NEAR)
    free, choice, u, turn = row[2 * STATE], row[2 * STATE + 1], row[2 * STATE + 2], row[2 * STATE + 3 :]
    x, d, met = g.concat(row[0:2], row[2] + shift), row[3:6], row[STATE : STATE + 3]
    way = (met[2] - x[2]) / d[2]
    beyond = g.select(row[2 * STATE - 1] <= 1.0, 0.0, g.square(met[0:2]) * per_rim2)
    meets = (beyond <= 1.0) & (least <= way)
    # The tube, by the form of the root that divides by what is not small; then the plane of the ring.
    along, out2 = g.dot(x[0:2], d[0:2]), g.square(x[0:2]) - tube * tube
    steep = g.square(d[0:2])
    root = (along * along - steep * out2).sqrt()
    to_tube = g.select(zero <= along, -out2 / (along + root), (root - along) / steep)
    to_ring = (ring_z - x[2]) / d[2]
    on_ring = to_ring <= to_tube
    to_wall = g.select(on_ring, to_ring, to_tube)
    wall = d * to_wall + x
    stops = (g.select(on_ring, ring_r2, 0.0) <= g.square(wall[0:2])) & (near <= to_wall) & (tiny <= tube)
    missed = g.select(stops, float(WALL), float(NOWHERE))
    found, end = g.select(meets, float(PASSED), missed), g.select(meets, way, to_wall)
    volume = (found <= float(WALL)) & (tiny <= per_mm + layer) & (free <= per_mm * end + layer)
    there = d * g.select(volume, g.select(tiny <= per_mm, (free / per_mm).minimum(end), end), end) + x
    normal = g.select(on_ring, g.constant([0.0, 0.0, 1.0]), wall * g.constant([-1.0, -1.0, 0.0]) / tube)
    glossy = choice <= gloss
    axis = g.select(volume, d, g.select(glossy, normal * (g.dot(d, normal) * -2.0) + d, normal))
    cosine = g.select(glossy, _greenstein(g.constant(_LOBE), u), u.sqrt())
    after = _about(g, axis, g.select(volume, _greenstein(forward, u), cosine), turn)
    inwards = normal * (g.dot(after, normal).minimum(0.0) * -2.0) + after
    after = g.select(volume, after, inwards)
    after = after / g.square(after).sqrt()
    back = zero <= after[2]
    z = g.select(back, -there[2], there[2] - shift)
    place = g.concat(there[0:2], z, after[0:2], -after[2].abs().maximum(_FLAT))
    g.outputs["event"] = g.concat(place, g.select(volume, float(VOLUME), found), g.select(back, 1.0, 0.0))
    return g


def film_scatter_graph() -> Graph:
    """The graph of light that the film sends back.

    Its inputs are `row`, the state behind the last surface [8], the point on the film [2] and random numbers
    [CHANCES]; and `call`, the film's distance from that surface and the share that the film reflects as a mirror. Its
    output `event` [6] is the position and direction in the frame of the last surface.
    """
    g = Graph()
    row, call = g.input("row", STATE + 2 + CHANCES), g.input("call", 2, per_call=True)
    choice, u, turn = row[STATE + 3], row[STATE + 4], row[STATE + 5 :]
    diffuse = g.concat(turn * (1.0 - u).maximum(0.0).sqrt(), -u.sqrt().maximum(_FLAT))
    direction = g.select(choice <= call[1], row[3:6], diffuse)
    g.outputs["event"] = g.concat(row[STATE : STATE + 2], call[0], direction)
    return g


def _greenstein(forward: Value, u: Value) -> Value:
    """A random cosine by a uniform variate u, for a mean cosine above 0 (the inverse of Henyey and Greenstein 1941)."""
    square = forward * forward
    q = (1.0 - square) / (1.0 - forward + forward * u * 2.0)
    return ((square + 1.0 - q * q) / (forward * 2.0)).maximum(-1.0).minimum(1.0)


def _about(g: Graph, axis: Value, cosine: Value, turn: Value) -> Value:
    """The unit vector at an angle from an axis and turned about it, in the frame of Duff et al. (JCGT 6, 2017)."""
    x, y, z = axis[0], axis[1], axis[2]
    sign = g.select(g.constant(0.0) <= z, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = g.concat(sign * x * x * a + 1.0, sign * b, -sign * x)
    second = g.concat(b, y * y * a + sign, -y)
    sine = (1.0 - cosine * cosine).maximum(0.0).sqrt()
    return first * (sine * turn[0]) + second * (sine * turn[1]) + axis * cosine
