"""Surfaces that are moved and turned away from the axis: closed forms, spheres, fifty digits, and cameras."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import pytest
import torch

from neurolens.base.errors import InputError
from neurolens.cameras.exact import ExactCamera
from neurolens.graph.interpret import evaluate
from neurolens.models.pairs import PairSettings, domain_of, make_pairs
from neurolens.optics.lens.placement import CENTRED, Placement
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import format_lens, read_lens
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace import arrays
from neurolens.optics.trace.rays import Rays, trace
from neurolens.optics.trace.tracegraph import exact_graph

ROOT = Path(__file__).parents[3]
DOUBLE_GAUSS = ROOT / "lenses" / "laikin_double_gauss_50.toml"


def plates(*placed: Placement, n: float = 1.6, gap_mm: float = 7.0) -> Lens:
    """A plate of two planes with a stop behind, whose surfaces are placed so."""
    rows = (
        Surface(math.inf, gap_mm, 40.0, n, placement=placed[0]), Surface(math.inf, 20.0, 40.0, placement=placed[1]),
        Surface(math.inf, 10.0, 40.0, stop=True),
    )  # fmt: skip
    return Lens("plate", "a test", rows, 1.0)


def beam(lens: Lens, *sines: float) -> Any:
    """A ray from the middle of a plane before the lens, towards the film."""
    ray = (0.0, 0.0, -10.0, *sines, math.sqrt(1 - sum(s * s for s in sines)))
    return trace(lens, Rays(*torch.tensor(ray, dtype=torch.float64)[:, None]), towards="film")


def test_a_tilted_plate_moves_a_ray_across() -> None:
    """A plane-parallel plate that turns as a group keeps the direction, and moves the ray by t sin a (1 - ...)."""
    angle, n, t = math.radians(25), 1.6, 7.0
    group = Placement(tilt_deg=(25.0, 0.0, 0.0))
    done = beam(plates(CENTRED.in_group(group, 0.0), CENTRED.in_group(group, t)), 0.0, 0.0)
    assert done.status.item() == 0
    assert [v.item() for v in done.rays[3:]] == pytest.approx([0, 0, 1], abs=1e-15)
    wanted = t * math.sin(angle) * (1 - math.cos(angle) / math.sqrt(n * n - math.sin(angle) ** 2))
    # The plate's upper half leans towards the film; its normal towards -y: the ray goes down.
    assert done.rays.y.item() == pytest.approx(-wanted, rel=1e-13)


def test_a_wedge_bends_by_snells_law() -> None:
    """Light enters square to the first plane and leaves the second, turned by a: it leaves at asin(n sin a) to it."""
    for axis, turn in ((1, (12.0, 0.0, 0.0)), (0, (0.0, 12.0, 0.0))):
        done = beam(plates(CENTRED, Placement(tilt_deg=turn)), 0.0, 0.0)
        angle = math.asin(1.6 * math.sin(math.radians(12))) - math.radians(12)
        sine = done.rays[3 + axis].item()
        # A turn about x moves y > 0 towards the film, whose normal then leans to -y; one about y leans it to +x.
        assert sine == pytest.approx(math.sin(angle) * (1 if axis else -1), rel=1e-13)


def tilted(lens: Lens, k: int, placement: Placement) -> Lens:
    rows = list(lens.surfaces)
    rows[k] = replace(rows[k], placement=placement)
    return replace(lens, surfaces=tuple(rows))


def rays_of(lens: Lens, count: int = 500) -> Rays:
    """Rays from points 200 mm before the lens into its front."""
    rng = np.random.default_rng(2)
    start, aim = rng.uniform(-40, 40, (2, count)), rng.uniform(-9, 9, (2, count))
    way = np.vstack([aim - start, np.full(count, 200.0)])
    way /= np.sqrt((way**2).sum(0))
    return Rays(*start, np.full(count, -200.0), *way)


def as_tensors(rays: Rays) -> Rays:
    return Rays(*(torch.from_numpy(c) for c in rays))


def test_a_tilted_sphere_is_a_decentred_one() -> None:
    """Only the centre of a sphere counts, but for its rim."""
    lens = set_lens(read_lens(DOUBLE_GAUSS))
    k = 2
    radius = float(lens.surfaces[k].radius_mm)
    turn = Placement(tilt_deg=(2.0, -1.5, 0.0))
    moved = radius * (turn.axes[:, 2] - [0, 0, 1])
    x, y, z = (float(v) for v in moved)
    one, two = (
        trace(tilted(lens, k, p), as_tensors(rays_of(lens)), towards="film", transmittance=True)
        for p in (turn, Placement((x, y, z)))
    )
    both = (one.status == 0) & (two.status == 0)
    assert both.sum() > 200
    for a, b in zip((*one.rays, one.transmittance), (*two.rays, two.transmittance), strict=True):
        np.testing.assert_allclose(a[both], b[both], rtol=0, atol=1e-11)
    plain = trace(lens, as_tensors(rays_of(lens)), towards="film").rays
    assert (one.rays.y - plain.y)[both].abs().min() > 0.01  # it is another lens


def by_mpmath(lens: Lens, ray: list[float]) -> list[Any]:
    """A ray through spheres and planes in 50 digits: by the implicit equation and the vector form of Snell's law."""
    p, d = mpmath.matrix(ray[:3]), mpmath.matrix(ray[3:])
    d /= mpmath.norm(d)
    n, vertex = mpmath.mpf(1), mpmath.mpf(0)
    for s in lens.surfaces:
        a, b, c = (mpmath.radians(mpmath.mpf(t)) for t in s.placement.tilt_deg)
        about_x = mpmath.matrix([[1, 0, 0], [0, mpmath.cos(a), -mpmath.sin(a)], [0, mpmath.sin(a), mpmath.cos(a)]])
        about_y = mpmath.matrix([[mpmath.cos(b), 0, mpmath.sin(b)], [0, 1, 0], [-mpmath.sin(b), 0, mpmath.cos(b)]])
        about_z = mpmath.matrix([[mpmath.cos(c), -mpmath.sin(c), 0], [mpmath.sin(c), mpmath.cos(c), 0], [0, 0, 1]])
        axis = about_x * about_y * about_z * mpmath.matrix([0, 0, 1])
        top = mpmath.matrix(s.placement.moved_mm) + mpmath.matrix([0, 0, vertex])
        if math.isinf(s.radius_mm):
            t = (axis.T * (top - p))[0] / (axis.T * d)[0]
            p = p + t * d
            normal = axis
        else:
            radius = mpmath.mpf(s.radius_mm)
            centre = top + radius * axis
            half, rest = (d.T * (p - centre))[0], mpmath.norm(p - centre) ** 2 - radius**2
            root = mpmath.sqrt(half**2 - rest)
            p = p + min((-half + root, -half - root), key=lambda t: mpmath.norm(p + t * d - top)) * d
            normal = (centre - p) / radius
        after = mpmath.mpf(float(s.n_d))
        cosine = (normal.T * d)[0]
        bent = mpmath.sqrt(1 - (n / after) ** 2 * (1 - cosine**2))
        d = n / after * d + (bent - n / after * cosine) * normal
        n, vertex = after, vertex + mpmath.mpf(s.thickness_mm)
    return [*p, *d]


def placed_lens() -> Lens:
    """Three elements, without dispersion: a decentred surface, one turned about all axes, and a plane that leans."""
    rows = (
        Surface(40.0, 5.0, 30.0, 1.62, placement=Placement((0.4, -0.2, 0.1))),
        Surface(-90.0, 4.0, 30.0, placement=Placement((0.0, 0.1, 0.0), (3.0, -2.0, 40.0))),
        Surface(math.inf, 2.0, 30.0, stop=True),
        Surface(-80.0, 3.0, 30.0, 1.7),
        Surface(math.inf, 4.0, 30.0, placement=Placement(tilt_deg=(-4.0, 1.0, 0.0))),
        Surface(math.inf, 30.0, 30.0),
    )
    return Lens("placed", "a test", rows, 2.0, film_z_mm=48.0)


def test_fifty_digits() -> None:
    lens, rays = placed_lens(), Rays(*(c[:20] for c in rays_of(placed_lens(), 40)))
    found = trace(lens, as_tensors(rays), towards="film")
    array = arrays.follow(lens, rays, lens.reference_nm, "film")
    assert (found.status == 0).all() and (array.status == 0).all()
    with mpmath.workdps(50):
        exact = np.array([[float(v) for v in by_mpmath(lens, [c[i] for c in rays])] for i in range(20)]).T
    np.testing.assert_allclose(np.stack([c.numpy() for c in found.rays]), exact, rtol=0, atol=2e-12)
    np.testing.assert_allclose(np.stack(array.rays), exact, rtol=0, atol=2e-12)


def test_the_graph_is_the_tracer_both_ways() -> None:
    """Camera rays of the graph leave as the tracer says, with their power, and the way back leads to the film point."""
    lens, count = placed_lens(), 300
    rng, nm = np.random.default_rng(4), lens.reference_nm
    film, pupil = rng.uniform(-6, 6, (2, count)), rng.uniform(-5, 5, (2, count))
    given = {"rays": np.vstack([film, pupil, np.full(count, nm)])}
    given |= {"film_z_mm": np.array([[48.0]]), "stop_radius_mm": np.array([[15.0]])}
    out = evaluate(exact_graph(lens, 5.0, (nm, nm)), given)
    way = np.vstack([pupil - film, np.full(count, 5.0 - 48.0)])
    way /= np.sqrt((way**2).sum(0))
    start = Rays(*film, np.full(count, 48.0), *way)
    there = trace(lens, as_tensors(start), transmittance=True)
    ok = there.status.numpy() == 0
    assert ok.sum() > 200 and (out["status"][0] == there.status.numpy()).all()
    scene = np.stack([c.numpy() for c in there.rays])
    np.testing.assert_allclose(out["scene_ray"][:, ok], scene[:, ok], rtol=0, atol=1e-12)
    assert there.transmittance is not None
    np.testing.assert_allclose(out["transmittance"][0, ok], there.transmittance.numpy()[ok], atol=1e-13)
    back = Rays(*(scene[:3, ok] + 5 * scene[3:, ok]), *-scene[3:, ok])
    done = trace(lens, as_tensors(back), towards="film").rays
    reach = (48.0 - done.z) / done.dz
    np.testing.assert_allclose(np.stack([done.x + reach * done.dx, done.y + reach * done.dy]), film[:, ok], atol=1e-11)


def test_a_centred_lens_is_traced_as_before() -> None:
    """A placement of nothing adds no step to the graph, and the hash of the lens stays."""
    lens = read_lens(DOUBLE_GAUSS)
    same = tilted(lens, 1, Placement((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    graphs = [exact_graph(set_lens(each), 10.0, (400.0, 700.0)) for each in (lens, same)]
    plain, placed = ([repr(node) for node in graph.nodes] for graph in graphs)
    assert plain == placed
    other = tilted(lens, 1, Placement((0.05, 0.0, 0.0)))
    assert lens.sha256 == same.sha256 != other.sha256
    assert lens.round and not other.round


def test_lens_files_move_surfaces_and_groups(tmp_path: Path) -> None:
    """A group turns as a rigid body; what is written is read back; bad values name their place."""
    text = DOUBLE_GAUSS.read_text()
    path = tmp_path / "copy.toml"
    path.write_text(text + "\n[[moved]]\nsurfaces = [0, 1]\ndecentre_mm = [0.05, 0]\ntilt_deg = [0.2, -0.1]\n")
    lens, plain = read_lens(path), read_lens(DOUBLE_GAUSS)
    assert lens.decentred == [0, 1]
    group = Placement((0.05, 0.0, 0.0), (0.2, -0.1, 0.0))
    for k, z in ((0, 0.0), (1, float(plain.surfaces[0].thickness_mm))):
        found = lens.surfaces[k].placement
        place = group.axes @ [0, 0, z] + [0.05, 0, 0] - [0, 0, z]
        np.testing.assert_allclose(found.moved_mm, place, atol=1e-15)
        np.testing.assert_allclose(found.axes, group.axes, atol=1e-15)
    (tmp_path / "again.toml").write_text(format_lens(lens))
    assert read_lens(tmp_path / "again.toml").surfaces == lens.surfaces
    for bad, words in (
        ("surfaces = [0, 99]", "moved 0, surfaces: .*from 0 to"),
        ("surfaces = [0, 1]\ntilt_deg = [80, 0]", "moved 0, tilt_deg: .*degrees, each from -60 to 60"),
        ("surfaces = [0, 1]\ndecentre_mm = 0.05", r"moved 0, decentre_mm: .*\[x, y\] or"),
    ):
        path.write_text(f"{text}\n[[moved]]\n{bad}\n")
        with pytest.raises(InputError, match=words):
            read_lens(path)


def test_a_camera_loses_no_light_and_looks_aside() -> None:
    """White light of points on either side, and where the middle looks, by a dense integral over the pupil's plane."""
    lens = replace(placed_lens(), film_z_mm=None)
    camera = ExactCamera(lens, Shot((12.0, 8.0), math.inf, 4.0, runtime="onnxruntime"))
    rng, count, side, fine = np.random.default_rng(1), 20_000, 12.0, 300
    square, nm = rng.random((2, count), np.float32), np.full(count, 550.0, np.float32)
    u, v = (c.ravel() for c in np.meshgrid(*2 * [(2 * np.arange(fine) + 1) / fine * side - side]))
    call = {"film_z_mm": camera.film.film_z_mm, "stop_radius_mm": camera.film.scene.stop_radius_mm}
    given = {name: np.array([[value]]) for name, value in call.items()}
    for x, y in ((0.0, -3.9), (0.0, 3.9), (-5.9, 2.0), (0.0, 0.0)):
        rays = camera.sample(np.repeat(np.float32([[x], [y]]), count, 1), square, nm)
        place = np.stack([np.full(u.size, x), np.full(u.size, y), u, v, np.full(u.size, 550.0)])
        out, z = evaluate(camera.lens_graph().graph, given | {"rays": place}), camera.film.distance_mm
        cos2 = 1 / (1 + ((u - x) ** 2 + (v - y) ** 2) / z**2)
        light = np.where(out["status"][0] == 0, out["transmittance"][0], 0) * cos2**2
        whole = light.sum() * (2 * side / fine) ** 2 / z**2 / camera.film.exposure
        assert rays.weight.mean() == pytest.approx(whole, rel=5e-3)
    looks = (rays.direction * rays.weight).mean(1) / rays.weight.mean()
    assert looks == pytest.approx((out["scene_ray"][3:] * light).sum(1) / light.sum(), abs=3e-4)
    assert math.hypot(*looks[:2]) > 0.01


def test_what_needs_a_centred_lens_says_so() -> None:
    plain = set_lens(read_lens(DOUBLE_GAUSS))
    lens = tilted(plain, 3, Placement((0.0, 0.1, 0.0)))
    with pytest.raises(InputError, match="surface 3, decentre_mm: .*surfaces on the axis"):
        make_pairs(lens, domain_of(plain, film_radius_mm=20.0, pupil_z_mm=10.0), PairSettings())
