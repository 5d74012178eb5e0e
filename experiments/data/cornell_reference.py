"""Make tests/pictures/render/cornell_reference.csv: the Cornell box of experiments/scenes/cornell.toml by Mitsuba 3.

python experiments/data/cornell_reference.py                     # a minute

Needs mitsuba, which only this command does. The three channels of its RGB mode stand for three wavelengths; a lamp of
radiance 1 and the reflectances there. One row a wavelength and row of the picture: means of radiance over 8 x 8 parts.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import mitsuba as mi
import numpy as np
import trimesh

from neurolens.pictures.render.scene import load_scene

ROOT = Path(__file__).parents[2]
TARGET = ROOT / "tests" / "pictures" / "render" / "cornell_reference.csv"
WAVELENGTHS_NM = (450.0, 550.0, 650.0)
PARTS, PIXELS = 8, 64


def main() -> None:
    """Render and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=2048, help="a pixel, of 64 x 64; default 2048")
    samples = parser.parse_args().samples
    mi.set_variant("scalar_rgb")
    scene = load_scene(ROOT / "experiments" / "scenes" / "cornell.toml")
    picture = np.array(mi.render(mi.load_dict(description(scene)), spp=samples))[..., :3]
    means = picture.reshape(PARTS, PIXELS // PARTS, PARTS, PIXELS // PARTS, 3).mean(axis=(1, 3))
    lines = [f"# Mitsuba {mi.__version__}, {samples} samples a pixel of {PIXELS} x {PIXELS}, by {Path(__file__).name}"]
    for k, nm in enumerate(WAVELENGTHS_NM):
        lines += [f"{nm:g}," + ",".join(f"{value:.6f}" for value in row) for row in means[..., k]]
    TARGET.write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(f"{TARGET.relative_to(ROOT)}: mean {means.mean():.5f}")


def description(scene) -> dict:
    """The scene as Mitsuba's tables."""
    camera, materials = scene.settings.camera, scene.settings.materials
    eye = np.array(camera.position_m) + [0, 0, 0.035]

    def diffuse(name: str) -> dict:
        value = materials[name].reflectance
        if isinstance(value, str):
            value = [float(np.interp(nm, *scene.reflectances[value])) for nm in WAVELENGTHS_NM]
        inner = {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(value)}}
        return {"type": "twosided", "bsdf": inner}

    made: dict = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": -1, "rr_depth": 8},
        "sensor": {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(12.5 / 35))),
            "to_world": mi.ScalarTransform4f().look_at(eye.tolist(), list(camera.look_at_m), [0, 1, 0]),
            "film": {
                "type": "hdrfilm",
                "width": PIXELS,
                "height": PIXELS,
                "rfilter": {"type": "box"},
                "pixel_format": "rgb",
                "component_format": "float32",
            },
            "sampler": {"type": "independent"},
        },
    }
    folder = Path(tempfile.mkdtemp())
    (lamp,) = scene.settings.quads
    corner, u, v = (np.array(x) for x in (lamp.corner_m, lamp.edge_u_m, lamp.edge_v_m))
    shapes = [(s.vertices, s.faces, m.material) for s, m in zip(scene.triangles, scene.settings.meshes, strict=True)]
    shapes.append((np.array([corner, corner + u, corner + u + v, corner + v]), [[0, 1, 2], [0, 2, 3]], "lamp"))
    for k, (vertices, faces, material) in enumerate(shapes):
        file = folder / f"{k}.ply"
        trimesh.Trimesh(vertices, faces, process=False).export(file)
        made[f"shape{k}"] = {"type": "ply", "filename": str(file), "face_normals": True, "bsdf": diffuse(material)}
        if material == "lamp":
            made[f"shape{k}"]["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": [1, 1, 1]}}
    return made


if __name__ == "__main__":
    main()
