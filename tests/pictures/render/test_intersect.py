"""Shapes against brute force in float64."""

import sys
from typing import Any

import numpy as np
import pytest
from render_helpers import diffuse, world

from neurolens.base.errors import NeurolensError
from neurolens.pictures.render.primitives import Mesh, Quad, Rays, SphereClusters, Spheres
from neurolens.pictures.render.world import World

RANDOM = np.random.default_rng(11)


def rays(count: int, spread: float = 3.0) -> Rays:
    """Rays from all around towards points near the origin, some exactly along an axis."""
    origin = RANDOM.normal(size=(3, count)) * spread
    direction = RANDOM.normal(size=(3, count)) * 0.5 - origin
    direction[:, :30] = np.repeat(np.eye(3), 10, axis=1) * RANDOM.choice([-1, 1], 30)
    direction /= np.linalg.norm(direction, axis=0)
    return Rays.of(origin.astype(np.float32), direction.astype(np.float32))


def hits(mesh: Any, batch: Rays, limit: Any = np.inf) -> tuple[np.ndarray, np.ndarray]:
    """Distances and surfaces [N], of hits nearer than the limit."""
    count = batch.origin.shape[1]
    best, found = np.full(count, limit, np.float32), np.full(count, -1, np.int32)
    mesh.nearer(batch, best, found)
    return best, found


def meet_triangles(corners: np.ndarray, batch: Rays) -> np.ndarray:
    """Nearest distance [N] by Moeller and Trumbore, every pair, float64."""
    o, d = batch.origin.T.astype(float)[:, None], batch.direction.T.astype(float)[:, None]
    a, b, c = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(d, c)
    with np.errstate(all="ignore"):
        scale = 1 / np.sum(p * b, axis=-1)
        s = o - a
        u, q = np.sum(s * p, axis=-1) * scale, np.cross(s, b)
        v, t = np.sum(d * q, axis=-1) * scale, np.sum(c * q, axis=-1) * scale
        return np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-6), t, np.inf).min(axis=1)


def agree(found: np.ndarray, expected: np.ndarray, allowed: float = 2e-3) -> None:
    """Same distances but for a few rays that graze an edge."""
    same = np.isclose(found, expected, rtol=1e-4, atol=1e-4) | (np.isinf(found) & np.isinf(expected))
    assert np.mean(~same) <= allowed
    assert 0.02 < np.mean(np.isfinite(expected)) < 0.98


@pytest.mark.parametrize("count", [1, 8, 9, 40, 129, 700])
def test_mesh_of_any_size_matches_every_triangle_in_turn(count: int) -> None:
    centre = RANDOM.normal(size=(count, 1, 3))
    corners = centre + RANDOM.normal(size=(count, 3, 3)) * (2.0 / count**0.4)
    batch = rays(1500)
    mesh = Mesh(5, corners)
    best, found = hits(mesh, batch)
    expected = meet_triangles(corners, batch)
    agree(best, expected)
    hit = np.flatnonzero(found >= 0)
    assert np.array_equal(found >= 0, np.isfinite(best)) and found.max() < 5 + count
    # The triangle named is the one that was met.
    own = corners[found[hit] - 5]
    normal = np.cross(own[:, 1] - own[:, 0], own[:, 2] - own[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    point = (batch.origin + batch.direction * np.where(np.isfinite(best), best, 0))[:, hit].T
    assert np.abs(np.sum((point - own[:, 0]) * normal, axis=1)).max() < 1e-4


def test_closed_mesh_has_no_seams() -> None:
    rows, columns = 40, 60
    polar, turn = np.meshgrid(np.linspace(0.02, np.pi - 0.02, rows), np.linspace(0, 2 * np.pi, columns, endpoint=False))
    shell = np.stack([np.sin(polar) * np.cos(turn), np.cos(polar), np.sin(polar) * np.sin(turn)], axis=-1) * 0.3
    i, j = np.meshgrid(np.arange(columns), np.arange(rows - 1), indexing="ij")
    a, b, c, d = i * rows + j, i * rows + j + 1, (i + 1) % columns * rows + j + 1, (i + 1) % columns * rows + j
    faces = np.concatenate([np.stack(x, axis=-1).reshape(-1, 3) for x in ((a, b, c), (a, c, d))])
    mesh = Mesh(0, (shell.reshape(-1, 3) + [2.0, 1.0, -3.0])[faces])
    direction = RANDOM.normal(size=(3, 60000))
    direction /= np.linalg.norm(direction, axis=0)
    direction = direction[:, np.abs(direction[1]) < 0.99]  # but for the holes at the poles
    count = direction.shape[1]
    origin = np.repeat([[2.0], [1.0], [-3.0]], count, axis=1) + RANDOM.normal(size=(3, count)) * 0.002
    best, found = hits(mesh, Rays.of(origin.astype(np.float32), direction.astype(np.float32)))
    assert np.all(found >= 0) and np.ptp(best) < 0.02


def test_shapes_match_float64_formulas() -> None:
    quads = [
        {"corner_m": [-1, 0.5, -1], "edge_u_m": [2, 0, 0], "edge_v_m": [0, 0, 1.5]},
        {"corner_m": [0.2, 0, 0], "edge_u_m": [1, 1, 0], "edge_v_m": [0, 0, -2]},
    ]
    spheres = [{"centre_m": RANDOM.normal(size=3).tolist(), "radius_m": 0.3, "material": "m"} for _ in range(5)]
    made = world(
        materials={"m": diffuse(0.5, 0.5, 0.5)},
        quads=[q | {"material": "m"} for q in quads],
        spheres=spheres,
        boxes=[{"min_m": [-2, -1, 0], "max_m": [-1, 0, 1], "material": "m"}],
        planes=[{"point_m": [0, -2, 0], "normal": [0.1, 1, 0], "material": "m"}],
    )
    batch = rays(20000)
    best, found = made.nearest(batch)
    o, d = batch.origin.astype(float), batch.direction.astype(float)
    low, sides = np.array([-2, -1, 0.0]), np.eye(3)
    faces = [(np.array(q["corner_m"]), np.array(q["edge_u_m"]), np.array(q["edge_v_m"])) for q in quads]
    for k in range(3):
        faces += [(low + far * sides[k], sides[k - 1], sides[k - 2]) for far in (0, 1)]
    triangles = [[a, a + u, a + v] for a, u, v in faces] + [[a + u + v, a + u, a + v] for a, u, v in faces]
    expected = meet_triangles(np.array(triangles, float), batch)
    for sphere in spheres:
        f = np.array(sphere["centre_m"])[:, None] - o
        middle = np.sum(f * d, axis=0)
        half2 = 0.09 - np.sum(f**2, axis=0) + middle**2
        half = np.sqrt(np.maximum(half2, 0))
        near, far = middle - half, middle + half
        distance = np.where(near > 1e-6, near, far)
        expected = np.where((half2 > 0) & (distance > 1e-6) & (distance < expected), distance, expected)
    normal = np.array([0.1, 1, 0]) / np.hypot(0.1, 1)
    with np.errstate(divide="ignore"):
        t = (normal @ [0, -2, 0] - normal @ o) / (normal @ d)
    expected = np.where((t > 1e-6) & (t < expected), t, expected)
    agree(best, expected)

    rows = np.flatnonzero(found >= 0)
    point = (batch.origin + batch.direction * np.where(found >= 0, best, 0))[:, rows]
    outward, _ = made.normals(made.surfaces(found[rows], point), point)
    assert np.allclose(np.sum(outward**2, axis=0), 1, atol=1e-3)
    on_box = np.flatnonzero((found[rows] >= 3) & (found[rows] < 9))
    relative = (point[:, on_box].T - [-1.5, -0.5, 0.5]) * 2
    assert len(on_box) > 100 and np.allclose(np.sum(relative * outward[:, on_box].T, axis=1), 1, atol=1e-3)


def test_small_sphere_far_away_is_hit_within_its_radius() -> None:
    made = world(spheres=[{"centre_m": [0, 0, -500], "radius_m": 0.01, "emission": [1, 1, 1]}])
    offset = np.linspace(-0.02, 0.02, 401)
    direction = np.stack([offset / 500, 0 * offset, -np.ones(401)])
    batch = Rays.of(np.zeros((3, 401), np.float32), (direction / np.linalg.norm(direction, axis=0)).astype(np.float32))
    hit = np.isfinite(made.nearest(batch)[0])
    assert np.all(hit[np.abs(offset) < 0.0099]) and not np.any(hit[np.abs(offset) > 0.0101])


@pytest.mark.parametrize("radius_m", [1e3, 1e5, 6.4e6])
def test_the_ground_of_a_planet_is_where_it_is(radius_m: float) -> None:
    # In float32 the surface of a large sphere is metres thick, and swallows rays that leave it.
    made = world(spheres=[{"centre_m": [0, -radius_m, 0], "radius_m": radius_m, "emission": [1, 1, 1]}])
    direction = RANDOM.normal(size=(3, 1000)).astype(np.float32)
    direction[1] = np.abs(direction[1]) + 1e-2
    direction /= np.linalg.norm(direction, axis=0)
    origin = np.repeat(np.float32([[0.0], [1e-3], [0.0]]), 1000, axis=1)
    assert not np.isfinite(made.nearest(Rays.of(origin, direction))[0]).any()
    steep = direction[1] > 0.5
    origin[1] = 0.5
    distance, _ = made.nearest(Rays.of(origin[:, steep], -direction[:, steep]))
    assert np.allclose(distance, 0.5 / direction[1, steep], rtol=1e-3)


def test_smooth_normals_follow_the_curve() -> None:
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    vertices = [[x, y, z] for z in (-1.0, 1.0) for x, y in ring]
    faces = [[k, (k + 1) % 24, 24 + k] for k in range(24)] + [
        [(k + 1) % 24, 24 + (k + 1) % 24, 24 + k] for k in range(24)
    ]
    mesh = {"material": "m", "vertices_m": vertices, "faces": faces, "smooth": True}
    made = world(materials={"m": diffuse(1, 1, 1)}, meshes=[mesh])
    start = RANDOM.uniform(0, 2 * np.pi, 500)
    radial = np.stack([np.cos(start), np.sin(start), 0 * start])
    origin = 3 * radial + np.array([[0], [0], [0.3]])
    batch = Rays.of(origin.astype(np.float32), (-radial).astype(np.float32))
    best, found = made.nearest(batch)
    assert np.all(np.isfinite(best))
    point = batch.origin + best * batch.direction
    flat, smooth = made.normals(made.surfaces(found, point), point)
    assert np.sum(smooth * radial, axis=0).min() > 0.9995 > np.sum(flat * radial, axis=0).min()


def test_many_spheres_and_rectangles_are_hit_as_each_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("neurolens.pictures.render.primitives.MANY_SPHERES", 10)
    batch, count = rays(4000), 300
    limit = np.where(RANDOM.random(4000) < 0.5, np.inf, RANDOM.uniform(0, 4, 4000)).astype(np.float32)
    centres, radii = RANDOM.normal(size=(count, 3)), RANDOM.uniform(0.01, 0.4, count)
    (a, clusters), (b, each) = (hits(made(7, centres, radii), batch, limit) for made in (SphereClusters, Spheres))
    assert np.array_equal(a, b) and np.array_equal(clusters, each) and 0.2 < np.mean(each >= 0) < 0.98
    edges = RANDOM.normal(size=(count, 2, 3)) * 0.1
    edges[:, 1] -= (
        edges[:, 0] * np.sum(edges[:, 0] * edges[:, 1], axis=1, keepdims=True) / np.sum(edges[:, :1] ** 2, axis=2)
    )
    corners = np.stack([centres, centres + edges[:, 0], centres + edges[:, 1]], axis=1)
    a, mesh = hits(Mesh.of_rectangles(7, corners), batch, limit)
    b, each = limit.copy(), np.full(4000, -1, np.int32)
    for k in range(count):
        Quad(7 + k, centres[k], edges[k, 0], edges[k, 1]).nearer(batch, b, each)
    same = (mesh == each) & np.isclose(a, b, rtol=1e-5, atol=1e-5)
    same |= (mesh == each) & np.isinf(a) & np.isinf(b)
    assert np.mean(~same) < 2e-3 and np.mean(mesh >= 0) > 0.1


def test_a_scene_of_many_lights_is_hit_as_one_of_few(monkeypatch: pytest.MonkeyPatch) -> None:
    def made() -> World:
        at = np.random.default_rng(2).uniform(-1, 1, (40, 3)).tolist()
        small = {"edge_u_m": [0.2, 0.0, 0.0], "edge_v_m": [0.0, 0.2, 0.0], "emission": [1.0, 1.0, 1.0]}
        return world(
            spheres=[{"centre_m": p, "radius_m": 0.1, "emission": [1.0, 1.0, 1.0]} for p in at[:20]],
            quads=[{"corner_m": p, **small} for p in at[20:]],
        )

    batch, few = rays(4000), made()
    monkeypatch.setattr("neurolens.pictures.render.world._MANY_QUADS", 10)
    monkeypatch.setattr("neurolens.pictures.render.world.MANY_SPHERES", 10)
    many = made()
    assert [type(p).__name__ for p in many._primitives] == ["Mesh", "SphereClusters"]
    (a, there), (b, here) = many.nearest(batch), few.nearest(batch)
    assert np.mean(there != here) < 1e-3 and np.mean(here >= 0) > 0.1
    same = there == here
    assert np.allclose(a[same], b[same], rtol=1e-4) and np.array_equal(many.light, few.light)


def test_meshes_are_hit_from_close_by_and_within_limits() -> None:
    corners = RANDOM.normal(size=(500, 1, 3)) + RANDOM.normal(size=(500, 3, 3)) * 0.2
    batch = rays(5000)
    # Rays that start just off a triangle, as shadow rays do, and limits that some hits are beyond.
    on = corners.mean(axis=1)[RANDOM.integers(500, size=2000)].T.astype(np.float32)
    batch.origin[:, :2000] = on + batch.direction[:, :2000] * np.float32(1e-3)
    limit = np.where(RANDOM.random(5000) < 0.5, np.inf, RANDOM.uniform(0, 12, 5000)).astype(np.float32)
    batch.origin[:, :200] = on[:, :200]  # and rays that start on one
    best, found = hits(Mesh(7, corners), batch, limit)
    each = np.stack([meet_triangles(some[None], batch) for some in corners])
    expected = each.min(axis=0)
    near = expected < limit
    assert np.mean((found >= 0) != near) < 2e-3 and 0.2 < np.mean(near) < 0.9
    assert np.mean(found[near] != 7 + each.argmin(axis=0)[near]) < 4e-3
    same = np.isclose(best, np.where(near, expected, limit), rtol=1e-4, atol=1e-4) | np.isinf(best)
    assert np.mean(~same) < 2e-3 and np.all(best[found < 0] == limit[found < 0]) and np.all(best <= limit)


def test_without_embree_a_mesh_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "embreex.mesh_construction", None)  # makes its import fail
    with pytest.raises(NeurolensError, match="pip install embreex"):
        Mesh(3, np.eye(3)[None])
