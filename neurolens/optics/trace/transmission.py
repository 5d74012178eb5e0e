"""The power of unpolarised light that arrives: transmission or reflection at surfaces, absorption in glass.

Each surface polarises the light that the next one meets, and the next plane of incidence may be another. So Stokes
parameters are followed: at each surface they are turned into its plane of incidence, where the surface acts on s and p.
Angles enter only as the cosine and sine of twice the turn, which are products of normals and directions. Sources: Born
and Wolf, Principles of Optics, 1.5.2 and 10.9.3; Chipman, Lam and Young, Polarized Light and Optical Systems, chapter
6.

`Light`, `Shares` and the functions on them compute with tensors and with the values of a graph alike.
"""

from typing import Any, NamedTuple

from neurolens.optics.lens.glass import absorption_of
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.trace.arithmetic import Arithmetic, times
from neurolens.optics.trace.surfaces import Hit, Medium, Rays, nearest_approach, normal_at

Vector = Any  # x, y, z in the lens frame: three tensors [N], or the rows of a value

# Added to the square of a turn's cosine, so that nothing is turned at exactly normal incidence, where there is no
# plane. Light whose (n cos)^2 behind a stack is below it counts as totally reflected, for float32 products of such
# cosines underflow.
FLOOR = 1e-30


class Light(NamedTuple):
    """Stokes parameters, about the plane of incidence of a surface, of light that was unpolarised and of power 1.

    Attributes:
        power: that of both polarisations together, which is the transmittance so far.
        excess: power of s, polarised across the plane of incidence, less that of p, polarised in it.
        diagonal, circular: real and imaginary part of 2 E_s times the conjugate of E_p; None while they are 0.
    """

    power: Any
    excess: Any
    diagonal: Any = None
    circular: Any = None


class Shares(NamedTuple):
    """The shares of s and p that a surface sends on; all but the last two are to be scaled by `above / below`.

    Attributes:
        mean, half: mean of the shares of s and p power that go on, and half of their difference.
        real, imaginary: real and imaginary part of the amplitude of s times the conjugate of that of p; None for 0.
        above, below: the factor that the other fields have in common, as a fraction.
    """

    mean: Any
    half: Any
    real: Any
    imaginary: Any = None
    above: Any = 1.0
    below: Any = 1.0


def fresnel(before: Any, after: Any, p: Any) -> Shares:
    """Return the shares that a bare surface transmits (Born and Wolf, 1.5.2).

    Args:
        before, after: index times cosine in front of the surface and behind it, n cos i and n' cos t.
        p: n' cos i + n cos t.
    """
    s = before + after
    s2, p2 = s * s, p * p
    return Shares(p2 + s2, p2 - s2, s * p * 2.0, None, before * after * 2.0, s2 * p2)


def pass_surface(light: Light | None, turn: tuple[Any, Any] | None, shares: Shares) -> Light:
    """Return the light behind a surface that transmits or reflects it.

    Args:
        light: from the last surface that changed it; None before the first, where it is unpolarised.
        turn: from that surface's plane of incidence into this one's, as `turned` gives it; None before the first
            surface.
    """
    mean, half, real, imaginary, above, below = shares
    if light is None or turn is None:
        scale = above / below
        return Light(mean * scale, half * scale)
    along, across = turn
    along2, across2 = along * along + FLOOR, across * across
    cos, sin, size = along2 - across2, along * across * 2.0, along2 + across2
    scale = above / (below * size)
    power, excess, diagonal = light.power * size, light.excess * cos, -(light.excess * sin)
    if light.diagonal is not None:
        excess, diagonal = _plus(excess, light.diagonal, sin), _plus(diagonal, light.diagonal, cos)
    linear, circular = diagonal * real, None if light.circular is None else light.circular * size
    parts = [(circular, real), (diagonal, imaginary)]
    twists = [a * b for a, b in parts if a is not None and b is not None]
    if circular is not None and imaginary is not None:
        linear = linear - circular * imaginary
    return Light(
        _plus(power * mean, excess, half) * scale,
        _plus(power * half, excess, mean) * scale,
        linear * scale,
        sum(twists[1:], twists[0]) * scale if twists else None,
    )


def turned(last: Vector, normal: Vector, cosines: Any, across: Any) -> tuple[Any, Any]:
    """Return the turn from one plane of incidence into the next: its cosine and sine, both times the same factor.

    The direction d lies in both planes. Across them are s = d x n and s' = d x n', with s s' = n n' - (d n)(d n') and s
    x s' = d det(d, n, n').

    Args:
        last, normal: unit normals n and n' of the two surfaces.
        cosines: (d n)(d n').
        across: det(d, n, n'), see `crossed`.
    """
    return _plus(_plus(last[0] * normal[0], last[1], normal[1]), last[2], normal[2]) - cosines, across


def crossed(d: Vector, a: Vector, b: Vector) -> Any:
    """Return det(d, a, b)."""
    return d[0] * (a[1] * b[2] - a[2] * b[1]) + d[1] * (a[2] * b[0] - a[0] * b[2]) + d[2] * (a[0] * b[1] - a[1] * b[0])


def turned_spheres(
    o: Arithmetic, near: Vector, d: Vector, medium: Medium, curvatures: tuple[Any, Any], gap_mm: Any, skew: Any
) -> tuple[Any, Any]:
    """Return `turned` for two spheres with vertices on the axis, `gap_mm` apart, times the square of the index.

    The normal of a sphere of curvature c at the point P from its vertex is (0, 0, 1) - c P, and the part of P along the
    ray drops out. With `near`, the ray's point nearest to the second vertex, only terms remain that are small where
    angles are.

    Args:
        d: direction times the index.
        skew: x dy - y dx of any point of the ray.
    """
    first, second = curvatures
    ratio = 1.0 - first * gap_mm
    bent = o.fma(near[2], -(ratio * second + first), times(o.dot(near, near), first * second))
    along = o.fma(bent, medium.n2, times(o.dot(d[:2], d[:2]), ratio))
    return along, times(times(medium.n, first - second * ratio), skew)


def _plus(total: Any, a: Any, b: Any) -> Any:
    """Return total + a b, for tensors in one pass over memory."""
    return total.addcmul(a, b) if hasattr(total, "addcmul") else total + a * b


class Passage:
    """Follows the power of rays while they are traced; absorption follows Beer and Lambert's law.

    Args:
        polarised: whether to follow the polarisation that each surface gives to the light, or to average it there.
    """

    def __init__(self, o: Arithmetic, lens: Lens, wavelength_nm: Any, polarised: bool = True) -> None:
        self._o, self.lens, self.wavelength_nm, self._polarised = o, lens, wavelength_nm, polarised
        self._light: Light | None = None
        self._depth: Any = None
        self._last: tuple[int, Vector, Any] | None = None  # the last surface, its normal, and n cos behind it
        self._skew: Any = None

    def absorption(self, k: int) -> Any:
        """Return the Napierian absorption (1/mm) of the medium before surface k; None where there is none."""
        # Absorption in the medium in front of the lens belongs to the scene.
        return absorption_of(self.lens.surfaces[k - 1], self.wavelength_nm) if k else None

    def coated(self, k: int, met: Hit, q: Any, media: tuple[Medium, Medium], sense: int, reflected: bool) -> Shares:
        """Return the shares that the coating of surface k transmits or reflects; see `pass_surface`."""
        raise NotImplementedError

    def transmitted(self, depth: Any) -> Any:
        """Return exp(-depth)."""
        return (-depth).exp()

    def pass_surface(
        self, k: int, r: Rays, met: Hit, q: Any, media: tuple[Medium, Medium], sense: int, reflected: bool = False
    ) -> None:
        """Take the power through surface k: rays before it, their hit, n' cos t; media in the order of travel."""
        before, after = media
        absorbed = self.absorption(k if sense > 0 else k + 1)
        if absorbed is not None:
            depth = path_mm(self._o, r, met, before) * absorbed
            self._depth = depth if self._depth is None else self._depth + depth
        surface = self.lens.surfaces[k]
        self._skew = self._skew if surface.plain and not surface.figure.power else None
        coated = bool(surface.coating and surface.coating.layers)
        if before is after and not coated and not reflected:
            return
        if coated or reflected:
            shares = self.coated(k, met, q, media, sense, reflected)
        else:
            both = before.n * after.n
            p = self._o.fma(met.q, times(both, before.inverse_n2), q * times(both, after.inverse_n2))
            shares = fresnel(met.q, q, p)
        if not self._polarised:
            share = shares.mean * (shares.above / shares.below)
            self._light = Light(share if self._light is None else self._light.power * share, 0.0)
            return
        normal = normal_at(self._o, met, surface.curvature)
        turn = None if self._last is None else self._turn(k, normal, r, met, before)
        self._light = pass_surface(self._light, turn, shares)
        self._last = k, normal, met.q if reflected else q

    def _turn(self, k: int, normal: Vector, r: Rays, met: Hit, before: Medium) -> tuple[Any, Any]:
        """Return the turn between the planes of incidence (`turned`), times the square of the index."""
        assert self._last is not None
        last, other, q = self._last
        pair = self.lens.surfaces[last], self.lens.surfaces[k]
        if all(s.plain for s in pair):
            gap = self.lens.vertices_mm[k] - self.lens.vertices_mm[last]
            near = nearest_approach(self._o, r, before.inverse_n2)
            curvatures = pair[0].curvature, pair[1].curvature
            if self._skew is None:
                self._skew = r.x * r.dy - r.y * r.dx
            return turned_spheres(self._o, near, r[3:], before, curvatures, gap, self._skew)
        across = crossed(r[3:], other, normal)
        return turned([times(c, before.n2) for c in other], normal, q * met.q, times(across, before.n))

    def arrived(self, like: Any) -> Any:
        """Return the power of all rays, in the form that a value has."""
        power = self._o.like(like, 1.0) if self._light is None else self._light.power
        return power if self._depth is None else power * self.transmitted(self._depth)


def path_mm(o: Arithmetic, r: Rays, met: Hit, before: Medium) -> Any:
    """Return the length (mm) of the path from a ray's point to its meeting; negative where the meeting lies behind."""
    along = o.fma(met.z - r.z, r.dz, o.fma(met.y - r.y, r.dy, (met.x - r.x) * r.dx))
    return times(along, times(before.n, before.inverse_n2))


NO_FILM: tuple[Any, ...] = (1.0, 0.0, 0.0, 1.0)  # the matrix before the first film


def times_film(s: tuple[Any, ...], p: tuple[Any, ...], film: tuple[Any, Any, Any], index2: Any) -> Any:
    """Return the matrices of s and p times those of a film, given as cos, sin / q and q sin of its phase.

    Tensors and values of a graph serve alike. Here q is index times cosine in the film, and `index2` its index squared.
    """
    c, e, f = film
    return _times(s, (c, e, f, c)), _times(p, (c, index2 * e, f / index2, c))


def _times(m: tuple[Any, ...], k: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the product of two matrices [[a, -i b], [-i c, d]], each given as (a, b, c, d)."""
    if m is NO_FILM:
        return k
    return (m[0] * k[0] - m[1] * k[2], m[0] * k[1] + m[1] * k[3], m[2] * k[0] + m[3] * k[2], m[3] * k[3] - m[2] * k[1])
