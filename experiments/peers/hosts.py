"""One scene through one lens in our renderer, in Mitsuba 3 and in NVIDIA Newton, by the rays of `neurolens rays`.

Spheres and tiles shine evenly, so that all noise comes of the rays. Light of 550 nm and grey shapes make the numbers:
each host renders the scene with two seeds, whose difference is its noise; then the three pictures, of seeds of their
own, may differ by no more. Mitsuba takes weights, Newton rays by importance and the picture of weights. Newton's depth
along the rays is held against our own intersection. The pictures are of all light, with colours.

Needs mitsuba (with LLVM 17 or later), newton and warp-lang; a host that is not installed is left out. Writes hosts.md,
hosts.json and hosts.jpg.
"""

from __future__ import annotations

import argparse
import math
from contextlib import suppress
from importlib.util import find_spec
from typing import Any

import numpy as np
from PIL import Image

import neurolens
from experiments import lab
from neurolens.base.errors import NeurolensError
from neurolens.base.settings import LIGHT_NM
from neurolens.cameras.build import make_camera
from neurolens.optics.lens.shot import Shot
from neurolens.pictures.render.colour import linear_to_srgb
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.scene import Scene, scene_from_tables
from neurolens.programs.mitsuba import require_mitsuba

MODEL = "laikin_double_gauss_50.ols-60"
FILM, FOCUS, F_NUMBER, NM = (36.0, 24.0), 1.5, 1.8, 550.0
EYE, LOOK = (0.0, 0.25, 0.0), (0.0, 0.12, -1.5)
COLOURS = ((0.9, 0.3, 0.1), (0.9, 0.7, 0.2), (0.3, 0.8, 0.3), (0.2, 0.5, 0.9), (0.7, 0.3, 0.8))
PALE, DARK = (0.6, 0.6, 0.6), (0.15, 0.15, 0.15)
# Centre x, y, z and radius in metres.
BALLS = tuple(
    (-0.22 + 0.11 * k * z**0.4, 0.06 * z**0.4, -z, 0.06 * z**0.4) for k, z in enumerate((0.7, 1, 1.5, 2.2, 3.5))
)
TILE, TILES = 0.25, [(i, k) for i in range(-8, 8) for k in range(1, 20)]  # on y = 0, from x = i TILE and z = -k TILE
BEHIND = (8.0, 4.0, -5.0)  # half width, height and z of a wall
OPTIONS = (
    lab.count("width", 240, "pixels of the picture (default 240)"),
    lab.count("samples", 64, "rays a pixel (default 64)"),
    lab.out(),
)


def colour_of(rgb: tuple[float, ...], grey: bool) -> list[float]:
    return [rgb[1]] * 3 if grey else list(rgb)


def shapes(grey: bool) -> tuple[list[Any], list[Any]]:
    """The balls with their colours, and the corners x and z of the tiles with theirs."""
    balls = [(ball, colour_of(c, grey)) for ball, c in zip(BALLS, COLOURS, strict=True)]
    return balls, [(i * TILE, -k * TILE, colour_of((PALE, DARK)[(i + k) % 2], grey)) for i, k in TILES]


def our_scene(grey: bool) -> Scene:
    balls, tiles = shapes(grey)
    wide, high, far = BEHIND
    quads = [
        {"corner_m": [x, 0, z], "edge_u_m": [0, 0, TILE], "edge_v_m": [TILE, 0, 0], "emission": c} for x, z, c in tiles
    ]
    wall = {"corner_m": [-wide, 0, far], "edge_u_m": [2 * wide, 0, 0], "edge_v_m": [0, high, 0]}
    quads.append(wall | {"emission": colour_of(DARK, grey)})
    light = [NM, NM] if grey else list(LIGHT_NM)
    camera = {"position_m": list(EYE), "look_at_m": list(LOOK), "focus_m": FOCUS, "film_mm": list(FILM)}
    camera |= {"wavelength_nm": light, "max_depth": 1, "f_number": F_NUMBER}
    spheres = [{"centre_m": list(b[:3]), "radius_m": b[3], "emission": c} for b, c in balls]
    return scene_from_tables({"camera": camera, "quads": quads, "spheres": spheres})


def shot(grey: bool) -> dict[str, Any]:
    return {"focus_m": FOCUS, "f_number": F_NUMBER, "wavelength_nm": (NM, NM) if grey else LIGHT_NM}


def rays(size: tuple[int, int], samples: int, seed: int, grey: bool, **more: Any) -> dict[str, Any]:
    light = {"wavelengths": (NM,)} if grey else {}
    place = {"position_m": EYE, "look_at_m": LOOK}
    return neurolens.rays(MODEL, FILM, width=size[0], height=size[1], samples=samples, seed=seed, **place, **light,
                          **shot(grey), **more)  # fmt: skip


def ours(size: tuple[int, int], samples: int, seed: int, grey: bool) -> Any:
    """The picture [H, W, 3] of our renderer."""
    camera = make_camera(MODEL, Shot(FILM, **shot(grey)))
    return render(our_scene(grey), camera, width=size[0], height=size[1], samples=samples, seed=seed, threads=1).rgb


def mitsuba(size: tuple[int, int], samples: int, seed: int, grey: bool) -> Any:
    """The picture [H, W, 3] of Mitsuba's path integrator for rays and weights of ours."""
    mi = require_mitsuba("llvm_ad_rgb")
    found = rays(size, samples, seed, grey, to="mitsuba", weights="kept" if grey else "rgb")
    balls, tiles = shapes(grey)
    wide, high, far = BEHIND

    def light(c: list[float]) -> dict[str, Any]:
        return {"type": "area", "radiance": {"type": "rgb", "value": c}}

    t = mi.ScalarTransform4f
    flat = [
        (t().translate([x + TILE / 2, 0, z + TILE / 2]).rotate([1, 0, 0], -90).scale(TILE / 2), c) for x, z, c in tiles
    ]
    flat.append((t().translate([0, high / 2, far]).scale([wide, high / 2, 1]), colour_of(DARK, grey)))
    scene: dict[str, Any] = {"type": "scene", "integrator": {"type": "path", "max_depth": 1}}
    scene |= {f"ball{k}": {"type": "sphere", "center": list(b[:3]), "radius": b[3], "emitter": light(c)}
              for k, (b, c) in enumerate(balls)}  # fmt: skip
    scene |= {f"flat{k}": {"type": "rectangle", "to_world": m, "emitter": light(c)} for k, (m, c) in enumerate(flat)}
    world = mi.load_dict(scene)
    o, d = (mi.Vector3f(found[name].reshape(-1, 3).T) for name in ("origin", "direction"))
    at = mi.Transform4f(found["to_world"].astype(float))
    ray = mi.RayDifferential3f(at @ mi.Point3f(o), at @ d)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, len(found["weight"].reshape(-1)) // (1 if grey else 3))
    seen = np.array(world.integrator().sample(world, sampler, ray)[0]).T.reshape(*found["origin"].shape)
    weight = found["weight"][..., None] if grey else found["weight"]
    return (seen * weight).mean(axis=2)


def newton(size: tuple[int, int], samples: int, seed: int, grey: bool, weights: str = "importance") -> Any:
    """The picture [H, W, 3] of Newton's camera sensor, and with one sample the rays and Newton's depth along them."""
    import newton as nw
    import warp as wp
    from newton.sensors import SensorCamera

    def shown(c: list[float]) -> list[float]:  # Newton's colours are those of a display
        return [float(v) for v in linear_to_srgb(np.array(c, np.float32))]

    wp.config.quiet = True
    found = rays(size, samples, seed, grey, to="newton", weights=weights)
    (width, height), (balls, tiles), (wide, high, far) = size, shapes(grey), BEHIND
    b = nw.ModelBuilder()
    for (x, y, z, r), c in balls:
        b.add_shape_sphere(-1, xform=wp.transform((x, y, z), wp.quat_identity()), radius=r, color=shown(c))
    thin, half = 1e-5, TILE / 2
    for x, z, c in tiles:
        place = wp.transform((x + half, -thin, z + half), wp.quat_identity())
        b.add_shape_box(-1, xform=place, hx=half, hy=thin, hz=half, color=shown(c))
    place = wp.transform((0.0, high / 2, far - thin), wp.quat_identity())
    b.add_shape_box(-1, xform=place, hx=wide, hy=high / 2, hz=thin, color=shown(colour_of(DARK, grey)))
    model = b.finalize(device="cpu")
    camera = SensorCamera(model)
    camera.set_ambient_light((1.0, 1.0, 1.0))
    matrix = found["to_world"]
    turn = wp.quat_from_matrix(wp.mat33(*map(float, matrix[:3, :3].ravel())))
    at = wp.array([wp.transformf(wp.vec3(*map(float, matrix[:3, 3])), turn)], dtype=wp.transformf, device="cpu")
    config = SensorCamera.RenderConfig()
    config.anti_aliasing = SensorCamera.AntiAliasing.SSAA
    picture, depth = camera.allocate_image_color_hdr(1, width, height), camera.allocate_image_depth(1, width, height)
    bundle = wp.array(found["camera_rays"], dtype=wp.vec3f, device="cpu")
    camera.update(model.state(), at, bundle, hdr_color_image=picture, depth_image=depth, render_config=config)
    if weights != "importance":
        return found, depth.numpy()[0]
    return picture.numpy()[0] * found["weight"][..., None]


_GRAZING_M = 2e-6  # what float32 rounds off the square of two metres, over the diameter of the smallest ball


def depth_error(size: tuple[int, int]) -> dict[str, float]:
    """Newton's depth along one ray a pixel, beside the nearest of our balls, tiles and wall on it, in mm.

    Newton computes in float32, which cannot tell on which side of a ball's edge a ray passes within `_GRAZING_M`: such
    rays are counted, and left out.
    """
    found, depth = newton(size, 1, 3, True, "kept")
    matrix = found["to_world"].astype(float)
    o, d = (found["camera_rays"].reshape(-1, 2, 3).astype(float)[:, k] @ matrix[:3, :3].T for k in (0, 1))
    o += matrix[:3, 3]
    best, from_edge = np.full(len(o), np.inf), np.full(len(o), np.inf)
    with np.errstate(all="ignore"):
        for *c, r in BALLS:
            p = o - c
            half = (p * d).sum(1)
            beside2 = (p * p).sum(1) - half**2
            from_edge = np.minimum(from_edge, np.abs(np.sqrt(beside2) - r))
            t = -half - np.sqrt(r * r - beside2)
            best = np.where((t > 0) & (t < best), t, best)
        for t in (-o[:, 1] / d[:, 1], (BEHIND[2] - o[:, 2]) / d[:, 2]):
            best = np.where((t > 0) & (t < best), t, best)
    hit = np.isfinite(best) & (depth.ravel() > 0) & (found["weight"].ravel() > 0)
    clear = hit & (from_edge > _GRAZING_M)
    error = 1e3 * np.abs(depth.ravel() - best)[clear]
    return {"rays": int(clear.sum()), "grazing": int((hit & ~clear).sum()), "median_mm": float(np.median(error)),
            "p99_mm": float(np.quantile(error, 0.99)), "worst_mm": float(error.max())}  # fmt: skip


HOSTS = {"our renderer": (ours, ""), "Mitsuba 3": (mitsuba, "mitsuba"), "Newton": (newton, "newton")}


def here(module: str) -> bool:
    """Whether a host can run: its package is installed and, for Mitsuba, an LLVM that is not too old."""
    if module == "mitsuba":
        with suppress(NeurolensError):
            return bool(require_mitsuba("llvm_ad_rgb"))
        return False
    return not module or find_spec(module) is not None


def compared(size: tuple[int, int], samples: int) -> list[lab.Row]:
    """For each host that is here: noise of a pixel, and its difference from our renderer, all in shares of the mean."""
    rows: list[lab.Row] = []
    reference, noise_of_ours = None, 0.0
    for k, (name, (picture, module)) in enumerate(HOSTS.items()):
        if not here(module):
            continue
        first, second = (picture(size, samples, 10 * k + seed, True)[..., 1].astype(float) for seed in (1, 2))
        mean = first.mean()
        row = {"host": name, "pixels": first.size, "samples": samples, "mean": mean}
        row["noise"] = float(np.sqrt(np.mean((first - second) ** 2) / 2)) / mean
        if reference is None:
            reference, noise_of_ours = first, row["noise"]
        else:
            apart = (first - reference) / mean
            row["apart"] = float(np.sqrt(np.mean(apart**2)))
            row["expected"] = math.hypot(row["noise"], noise_of_ours)
            row["bias"], row["bias_error"] = float(apart.mean()), row["expected"] / math.sqrt(first.size)
            corner = np.zeros_like(first, bool)
            h, w = size[1] // 8, size[0] // 8
            corner[:h, :w] = corner[:h, -w:] = corner[-h:, :w] = corner[-h:, -w:] = True
            row["corners"] = float(apart[corner].mean() / (reference[corner].mean() / mean))
            row["corners_error"] = (
                row["bias_error"] * math.sqrt(first.size / corner.sum()) / (reference[corner].mean() / mean)
            )
        rows.append(row)
    return rows


_COLUMNS = lab.columns(
    ("host", "host"),
    ("noise of a pixel", "noise", ".2%"),
    ("differs from ours, RMS", "apart", ".2%"),
    ("noise of both", "expected", ".2%"),
    ("mean differs", "bias", "+.4%"),
    ("+-", "bias_error", ".4%"),
    ("corners differ", "corners", "+.3%"),
    ("+-", "corners_error", ".3%"),
)


def run(args: argparse.Namespace) -> None:
    """Render, compare, write."""
    size = args.width, round(args.width * FILM[1] / FILM[0])
    rows = compared(size, args.samples)
    depth = depth_error(size) if here("newton") else None
    told = "" if depth is None else (
        f"Newton's depth along {depth['rays']} rays differs from our own intersection by {depth['median_mm']:.2g} mm "
        f"(median; 99% within {depth['p99_mm']:.2g}, worst {depth['worst_mm']:.2g} mm). {depth['grazing']} more pass "
        f"within {1e6 * _GRAZING_M:g} um of a ball's edge, which float32 cannot tell from a hit."
    )  # fmt: skip
    said = f"Shares of the mean of the picture; {size[0]} x {size[1]} pixels, {args.samples} rays each."
    said = f"# One scene, three hosts\n\n{said} `python -m experiments hosts`"
    print(lab.write_results(args.out, "hosts", lab.page(said, lab.table(_COLUMNS, rows), told, lab.machine_line()), {
        "rows": rows, "depth": depth, "machine": lab.machine(),
    }))  # fmt: skip
    pictures = []
    for name, (picture, module) in HOSTS.items():
        if here(module):
            rgb = np.clip(picture(size, args.samples, 5, False), 0, 1)
            drawn = Image.fromarray((255 * linear_to_srgb(rgb.astype(np.float32)) + 0.5).astype(np.uint8))
            pictures.append(lab.labelled(drawn, name))
    lab.sheet(pictures, len(pictures), 4).save(args.out / "hosts.jpg", quality=90)
