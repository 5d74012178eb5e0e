"""Mesh files and the materials of OBJ files: what is in them arrives, and each mistake is one clear error."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from render_helpers import CAMERA, WHITE, diffuse, radiance, scene, world

from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.base.settings import from_dict
from neurolens.pictures.render import mesh as meshes
from neurolens.pictures.render.colour import SpectralRange
from neurolens.pictures.render.mesh import TriangleSet, read_file, read_mesh
from neurolens.pictures.render.primitives import Rays
from neurolens.pictures.render.scene import Scene, scene_from_tables
from neurolens.pictures.render.scenetables import MeshSettings
from neurolens.pictures.render.world import World

HERE = Path("scene.toml")
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1.25]], float)
# A pyramid that faces outwards: a square and four triangles.
SQUARE, SIDES = [0, 3, 2, 1], [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
HEADER = "ply\nformat {form} 1.0\ncomment a pyramid\nelement vertex 5\nproperty float x\nproperty float y\n"
HEADER += "property float z\nelement face 5\nproperty list uchar int vertex_indices\nend_header\n"


def obj() -> bytes:
    lines = ["# a pyramid", *(f"v {x:g} {y:g} {z:g}" for x, y, z in CORNERS), "g base"]
    lines += ["f " + " ".join(str(k + 1) for k in face) for face in (SQUARE, *SIDES)]
    return "\n".join(lines).encode()


def ply(form: str) -> bytes:
    header = HEADER.format(form=form).encode()
    if form == "ascii":
        rows = [" ".join(f"{x:g}" for x in v) for v in CORNERS]
        rows += [f"{len(f)} " + " ".join(map(str, f)) for f in (SQUARE, *SIDES)]
        return header + "\n".join(rows).encode() + b"\n"
    order = "<" if form == "binary_little_endian" else ">"
    body = b"".join(struct.pack(f"{order}3f", *v) for v in CORNERS)
    return header + body + b"".join(struct.pack(f"{order}B{len(f)}i", len(f), *f) for f in (SQUARE, *SIDES))


def enclosed(mesh: TriangleSet) -> float:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return float(np.sum(a * np.cross(b, c)) / 6)


@pytest.mark.parametrize("form", ["obj", "ascii", "binary_little_endian", "binary_big_endian"])
def test_every_format_gives_the_same_solid(form: str, tmp_path: Path) -> None:
    path = tmp_path / ("a.obj" if form == "obj" else "a.ply")
    path.write_bytes(obj() if form == "obj" else ply(form))
    mesh = read_file(HERE, "meshes[0].file", path)
    assert mesh.faces.shape == (6, 3) and mesh.uv is None and mesh.normals is None
    assert np.array_equal(np.unique(mesh.vertices, axis=0), np.unique(CORNERS, axis=0))
    assert enclosed(mesh) == pytest.approx(1.25 / 3)  # base times height over three: no face is lost or turned


def test_triangles_without_area_are_left_out_with_one_warning(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_bytes(obj() + b"\nf 1 1 2\nf 3 4 3\nf 1 2 3\n")
    settings = MeshSettings("m", file=Path("a.obj"))
    with pytest.warns(NeurolensWarning, match=r"a\.obj: 2 of 9 triangles have no area and are left out") as told:
        mesh = read_mesh(tmp_path / "scene.toml", "meshes[0]", settings)
    assert len(told) == 1 and len(mesh.faces) == 7
    (tmp_path / "a.obj").write_bytes(b"v 0 0 0\nv 1 0 0\nf 1 1 2\n")
    with pytest.raises(InputError, match="a triangle with an area"):
        read_mesh(tmp_path / "scene.toml", "meshes[0]", settings)


SHEAR = ((1.0, 0.5, 0.0, 3.0), (0.0, 2.0, 0.0, 0.0), (0.0, 0.25, 1.0, -1.0))
MIRROR = ((-1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))


@pytest.mark.parametrize("given", [{"scale": [2, 0.5, 3]}, {"matrix": SHEAR}, {"matrix": MIRROR, "scale": [1, 2, 1]}])
def test_a_mesh_may_be_sheared_mirrored_and_scaled_along_axes(given: dict[str, Any], tmp_path: Path) -> None:
    """The volume goes with the determinant, fronts stay outside, normals square to their faces."""
    (tmp_path / "a.obj").write_bytes(obj())
    settings = from_dict(MeshSettings, {"material": "m", "file": "a.obj", "rotate_y_deg": 30} | given, HERE)
    solid, plain = read_mesh(tmp_path / "s.toml", "m", settings), read_file(HERE, "m", tmp_path / "a.obj")
    linear = np.array(given.get("matrix", np.eye(3, 4)))[:, :3]
    volume = abs(np.linalg.det(linear)) * np.prod(given.get("scale", 1))
    assert enclosed(solid) == pytest.approx(volume * enclosed(plain))
    corners = plain.vertices[plain.faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    rows = [*(f"v {x} {y} {z}" for x, y, z in corners.reshape(-1, 3)), *(f"vn {x} {y} {z}" for x, y, z in flat)]
    rows += ["f " + " ".join(f"{3 * k + i}//{k + 1}" for i in (1, 2, 3)) for k in range(len(flat))]
    (tmp_path / "a.obj").write_text("\n".join(rows))
    mesh = read_mesh(tmp_path / "s.toml", "m", settings)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    out = np.cross(b - a, c - a)
    assert mesh.normals is not None
    towards = np.einsum("tk,tk->t", mesh.normals[mesh.faces[:, 0]], out) / np.linalg.norm(out, axis=1)
    assert towards == pytest.approx(np.ones(len(out)))


def test_indices_are_counted_back_and_comments_may_be_latin_1(tmp_path: Path) -> None:
    absolute, relative = tmp_path / "a.obj", tmp_path / "b.obj"
    head, tail = b"# caf\xe9\ng K\xf6rper\n", b"v 0 0 1\nvt 1 1\nf %s %s %s\n"
    corners = b"v 0 0 0\nvt 0 0\nv 1 0 0\nvt 1 0\nv 0 1 0\nvt 0 1\nvn 0 0 1\n# \xff\nf %s %s %s # \xe9\n"
    absolute.write_bytes(head + corners % (b"1/1/1", b"2/2/1", b"3/3/1") + tail % (b"2/2/1", b"3/3/1", b"4/4/1"))
    relative.write_bytes(
        head + corners % (b"-3/-3/-1", b"-2/-2/-1", b"-1/-1/-1") + tail % (b"-3/-3/1", b"3/-2/-1", b"-1/4/-1")
    )
    one, other = (read_file(HERE, "file", path) for path in (absolute, relative))
    assert len(one.faces) == 2 and one.uv is not None and other.uv is not None
    assert np.array_equal(one.vertices[one.faces], other.vertices[other.faces])
    assert np.array_equal(one.uv[one.faces], other.uv[other.faces])
    bare = tmp_path / "c.obj"
    bare.write_bytes(b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\n")
    mesh = read_file(HERE, "file", bare)
    assert np.array_equal(mesh.vertices[mesh.faces[0]], [[0, 0, 0], [1, 0, 0], [0, 1, 0]])


def test_texture_coordinates_and_normals_of_parts_and_polygons(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text(
        "mtllib none.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvn 0 0 1\nvn 0.6 0 0.8\n"
        "usemtl a\nf 1/1/1 2/2/2 3/3/1 \\\n 4/4/1\nusemtl b\nf 1/4/1 2/3/1 3/2/1\n"
    )
    mesh = read_file(HERE, "file", path)
    assert mesh.faces.shape == (3, 3) and mesh.uv is not None and mesh.normals is not None
    quad = [k for k in range(3) if not np.allclose(mesh.uv[mesh.faces[k]], [[0, 1], [1, 1], [1, 0]])]
    assert len(quad) == 2
    for k in quad:
        corner, uv = mesh.vertices[mesh.faces[k]], mesh.uv[mesh.faces[k]]
        assert np.allclose(corner[:, :2], uv)
        tilted = (corner[:, 0] == 1) & (corner[:, 1] == 0)
        assert np.allclose(mesh.normals[mesh.faces[k]][tilted], [0.6, 0, 0.8])


def test_a_picture_lies_on_a_mesh_as_its_coordinates_say(tmp_path: Path) -> None:
    picture = np.zeros((2, 2, 3), np.uint8)
    picture[0, 1], picture[1, 0], picture[1, 1] = 255, (255, 0, 0), (0, 255, 0)
    Image.fromarray(picture).save(tmp_path / "p.png")
    # Turned by a quarter: u runs along +y, v along -x.
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "property float s\nproperty float t\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0 0 1\n1 0 0 0 0\n1 1 0 1 0\n0 1 0 1 1\n4 0 1 2 3\n"
    )
    made = world(
        textures={"p": {"kind": "image", "file": str(tmp_path / "p.png")}},
        materials={"m": {"kind": "diffuse", "texture": "p"}},
        meshes=[{"file": str(tmp_path / "a.ply"), "material": "m", "translate_m": [0, 0, -2]}],
        environment=WHITE,
    )
    for x, y, shown in ((1, 1, (0, 0, 0)), (1, 3, (1, 1, 1)), (3, 1, (1, 0, 0)), (3, 3, (0, 1, 0))):
        plain = world(
            materials={"m": diffuse(*shown)},
            planes=[{"point_m": [0, 0, -2], "normal": [0, 0, 1], "material": "m"}],
            environment=WHITE,
        )
        seen, expected = (
            radiance(w, [x / 4, y / 4, 0], [x / 4, y / 4, -2], samples=256, max_depth=1) for w in (made, plain)
        )
        assert np.allclose(seen, expected, atol=2e-3)


@pytest.mark.parametrize(("smooth", "tilted"), [(None, True), (True, True), (False, False)])
def test_normals_of_the_file_are_used_and_turned(smooth: bool | None, tilted: bool, tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("v -1 -1 0\nv 1 -1 0\nv 0 1 0\nvn 0.6 0 0.8\nf 1//1 2//1 3//1\n")
    table: dict[str, Any] = {"file": str(path), "material": "m", "rotate_y_deg": 90, "scale": 2}
    made = world(materials={"m": diffuse(1, 1, 1)}, meshes=[table | ({} if smooth is None else {"smooth": smooth})])
    batch = Rays.of(np.float32([[5], [0], [0]]), np.float32([[-1], [0], [0]]))
    distance, found = made.nearest(batch)
    flat, shading = made.normals(found.astype(np.intp), batch.origin + distance * batch.direction)
    assert np.allclose(flat[:, 0], [1, 0, 0], atol=1e-6)
    assert np.allclose(shading[:, 0], [0.8, 0, -0.6] if tilted else [1, 0, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.obj", b"", "at least one triangle"),
        ("a.obj", b"v 0 0 0\nv 1 0\nv 0 1 0\nf 1 2 3\n", "line 2.*v X Y Z"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2\n", "line 4.*f I J K"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -4\n", "line 4.*'-4'.*v from 1 to 3"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/2\n", "line 5.*'3/2'.*vt from 1 to 1"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nf 2/1 3 4\n", "line 6.*corners of the same form"),
        ("a.obj", b"\xff\xfe\x00v", "text file"),
        ("a.ply", b"solid cube", "begins with ply"),
        ("a.ply", ply("binary_little_endian")[:-7], "ends before its last element"),
        ("a.ply", ply("ascii")[:-30], "ends before its last element"),
        ("a.ply", ply("ascii").replace(b"3 0 1 4", b"3 0 1 9"), "vertices from 0 to 4"),
        ("a.ply", ply("ascii").replace(b"element face 5", b"element face 0"), "at least one triangle"),
        ("a.ply", ply("binary_little_endian").replace(b"vertex 5", b"vertex 50000000"), "50000000 elements vertex in"),
    ],
)
def test_each_broken_file_is_named(name: str, content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        scene(materials={"m": diffuse(1, 1, 1)}, meshes=[{"file": str(path), "material": "m"}])
    assert str(caught.value).startswith("test.toml: meshes[0]") and ", expected " in str(caught.value)


def test_large_and_missing_files_are_refused_before_they_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.obj"
    path.write_bytes(obj())
    monkeypatch.setattr(meshes, "LARGEST_FILE", 100)
    with pytest.raises(InputError, match="at most 100 bytes"):
        read_file(HERE, "meshes[0].file", path)
    for missing in (tmp_path / "none.ply", tmp_path):
        with pytest.raises(InputError, match="exists|ends in"):
            read_file(HERE, "meshes[0].file", missing)


# Two squares side by side, the left one red, the right one with a picture, and a triangle of the scene's own material.
OBJ = """\
mtllib my colours.mtl
v -2 0 0
v 0 0 0
v 0 2 0
v -2 2 0
v 2 0 0
v 2 2 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl red one
f 1/1 2/2 3/3 4/4
usemtl wall
f 2/1 5/2 6/3 3/4
usemtl own
f 1/1 2/2 6/3
"""
MTL = """\
# made up
newmtl red one
  Ka 1 1 1
\tKd 0.6 0.1 0.05
newmtl wall
Kd 1 1 1
map_Kd pictures\\wall.png
newmtl unused
Kd 0.5
"""


def loaded(tmp_path: Path, obj: str = OBJ, mtl: str = MTL, **mesh: Any) -> Scene:
    assets = tmp_path / "assets"
    (assets / "pictures").mkdir(parents=True, exist_ok=True)
    (assets / "room.obj").write_text(obj)
    (assets / "my colours.mtl").write_text(mtl)
    Image.fromarray(np.full((2, 2, 3), (0, 255, 0), np.uint8)).save(assets / "pictures" / "wall.png")
    tables = {"camera": CAMERA, "materials": {"own": diffuse(0.2, 0.2, 0.2)}, "environment": {"colour": [1, 1, 1]}}
    return scene_from_tables(tables | {"meshes": [{"file": "assets/room.obj", **mesh}]}, tmp_path / "scene.toml")


def test_each_triangle_has_the_colour_or_the_picture_of_its_material(tmp_path: Path) -> None:
    """Lit evenly, the left square reflects most at long wavelengths, the right one in the middle."""
    found = loaded(tmp_path)
    assert [mesh.material for mesh in found.settings.meshes] == ["room:red one", "room:wall", "own"]
    assert [len(part.faces) for part in found.triangles] == [2, 2, 1] and list(found.images) == ["room:wall"]
    materials = found.settings.materials or {}
    assert materials["room:red one"].reflectance == (0.6, 0.1, 0.05) and "room:unused" not in materials
    made = World(found, SpectralRange(400, 700))
    left, right = (radiance(made, [x, 1.5, 3], [x, 1.5, 0], samples=3000).reshape(3, -1).mean(1) for x in (-1.5, 1.5))
    assert left[2] > 3 * left[0] and right[1] > 3 * max(right[0], right[2])


@pytest.mark.parametrize(
    ("obj", "mtl", "words"),
    [
        (
            OBJ.replace("usemtl wall", "usemtl door"),
            MTL,
            "usemtl: got 'door', expected a material of the scene or of my",
        ),
        (OBJ.replace("usemtl red one\n", ""), MTL, "none before a face"),
        (OBJ.replace("my colours", "other"), MTL, r"other\.mtl: file: got .missing."),
        (OBJ, MTL.replace("map_Kd ", "map_Kd -s 2 2 2 "), "without options"),
        (OBJ, MTL.replace("wall.png", "gone.png"), r"textures\.room:wall\.file"),
        (OBJ, "Kd 1 1 1\n", "newmtl before it"),
    ],
)
def test_what_is_missing_or_broken_is_named(obj: str, mtl: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        loaded(tmp_path, obj, mtl)


def test_a_picture_without_coordinates_leaves_the_colour(tmp_path: Path) -> None:
    bare = "\n".join(" ".join(word.split("/")[0] for word in line.split(" ")) for line in OBJ.splitlines())
    with pytest.warns(NeurolensWarning, match="no texture coordinates: wall.png is left out"):
        found = loaded(tmp_path, bare)
    assert (found.settings.materials or {})["room:wall"].reflectance == (1.0, 1.0, 1.0) and not found.images


MIXED = """\
mtllib my colours.mtl
o floor
v 0 0 0
v 0 2 0
v -2 2 0
v 2 0 0
vt 0 0
vt 1 0
vt 1 1
vn 0 0 1
usemtl wall
f 1/1/1 2/2/1 3/3/1
o ball
f 1//1 4//1 2//1
o box
usemtl red one
f 1 4 3
"""


def test_objects_without_coordinates_leave_those_of_others(tmp_path: Path) -> None:
    """As Blender writes several objects to one file: one without a UV map took the floor's picture away."""
    with pytest.warns(NeurolensWarning, match=r"room\.obj, ball: no texture coordinates: wall\.png is left out there"):
        found = loaded(tmp_path, MIXED)
    floor, ball, box = found.triangles
    assert [m.material for m in found.settings.meshes] == ["room:wall", "room:wall without coordinates", "room:red one"]
    assert floor.uv is not None and sorted(floor.uv.tolist()) == [[0, 0], [1, 0], [1, 1]]
    assert ball.uv is None and ball.normals is not None and box.uv is None and box.normals is None
    assert floor.normals is not None and list(found.images) == ["room:wall"]
    assert (found.settings.materials or {})["room:wall without coordinates"].reflectance == (1.0, 1.0, 1.0)
    whole = read_file(HERE, "meshes[0].file", tmp_path / "assets" / "room.obj")
    assert whole.uv is None and whole.normals is None and len(whole.faces) == 3


AXES = ["x", "y", "z", "nx", "ny", "nz", "s", "t"]


@pytest.mark.parametrize("order", ["<", ">", ""])
def test_ply_files_hold_more_than_triangles(order: str, tmp_path: Path) -> None:
    """Every kind of polygon in turn, lists of other lengths, values beside the corners, elements that are no faces."""
    form = {"<": "binary_little_endian", ">": "binary_big_endian", "": "ascii"}[order]
    header = f"ply\nformat {form} 1.0\nelement vertex 6\nproperty uchar red\n"
    header += "".join(f"property {kind} {n}\n" for kind, n in zip(["double"] * 3 + ["float"] * 5, AXES, strict=True))
    header += "element edge 2\nproperty int vertex1\nproperty int vertex2\nelement strip 1\n"
    header += "property list ushort short vertex_index\nelement face 4\nproperty uchar flags\n"
    header += "property list uint ushort vertex_index\nproperty list uchar float texcoord\nproperty int last\n"
    vertices = np.random.default_rng(5).random((6, 8)).astype(np.float32).astype(float)
    faces = [[0, 1, 2, 3], [3, 4, 5], [5, 4, 3, 2, 1], [0, 2, 5]]
    rows: list[tuple[str, list[Any]]] = [("B3d5f", [7, *v.tolist()]) for v in vertices]
    rows += [("2i", [0, 1]), ("2i", [1, 2]), ("H2h", [2, 0, 1])]
    rows += [(f"BI{len(f)}HB2fi", [1, len(f), *f, 2, 0.5, 0.25, -9]) for f in faces]
    words = "\n".join(" ".join(map(repr, values)) for _, values in rows).encode()
    body = b"".join(struct.pack(order + kind, *values) for kind, values in rows) if order else words
    (tmp_path / "a.ply").write_bytes(header.encode() + b"end_header\n" + body)
    mesh = read_file(HERE, "meshes[0].file", tmp_path / "a.ply")
    assert mesh.faces.tolist() == [[f[0], f[k], f[k + 1]] for f in faces for k in range(1, len(f) - 1)]
    assert np.array_equal(mesh.vertices, vertices[:, :3])
    assert mesh.normals is not None and np.array_equal(mesh.normals, vertices[:, 3:6])
    assert mesh.uv is not None and np.array_equal(mesh.uv, vertices[:, 6:])


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ((b"3 0 1 4", b"2 0 1"), "a face of 2 corners"),
        ((b"3 0 1 4", b"nan 0 1 4"), "NaN"),
        ((b"3 0 1 4", b"3 0 x 4"), "words that are no numbers"),
        ((b"property float z\n", b""), "no x, y and z"),
        ((b"uchar int vertex", b"uchar float vertex"), "by fractions"),
        ((b"format ascii", b"format utf8"), "in its header"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_ply_files_that_are_none_say_why(change: tuple[bytes, bytes], word: str, tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(ply("ascii").replace(*change))
    with pytest.raises(InputError, match=word):
        read_file(HERE, "meshes[0].file", tmp_path / "a.ply")
