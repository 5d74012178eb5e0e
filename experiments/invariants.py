"""Record what the package computes, and compare a changed tree against it: exports, source code, fits, pictures.

    python experiments/invariants.py record FOLDER [--tree OLD]     goldens of a tree (default: the one of this file)
    python experiments/invariants.py check FOLDER [--tree NEW] [--only ITEM ...] [--rays N] [--models GLOB]

Items: onnx, onnx-speed, source, derivatives, wild, fits, render, start. Only the command line of the package and
onnxruntime are used, but for `fit_all`. Both commands go on where they stopped: goldens and results are files, the
results of a check by a hash of the tree's source and of the number of rays. `check` exits with 1 on a failure.

Differences are in units in the last place (ulp) of float32, over rays that both pass (status 0): |a - b| over the ulp
of the largest component of the vector (position, direction, crossing with the stop, a column of derivatives), or of the
RMS of that over all rays compared where it is larger, so that vectors near zero count in the scale of their kind.
A status that differs is "at an edge" where the golden model gives it too when inputs of the ray move by up to 4 ulp.
"""

from __future__ import annotations

import argparse
import ctypes
import dataclasses
import fnmatch
import functools
import hashlib
import importlib
import itertools
import json
import math
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
import traceback
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

Out = dict[str, Any]  # arrays by the name of the output
ITEMS = ("onnx", "onnx-speed", "source", "derivatives", "wild", "fits", "fits-onnx", "render", "start")
FAILURES = ("status", "cards", "differs", "signature", "message", "broken", "convergence", "passed wrongly", "no torch")
BATCH = 16384
LIMIT_ULP, LIMIT_DERIVATIVES_ULP, LIMIT_SPEED, LIMIT_START = 2.0, 4.0, 1.03, 1.05
SLACK = 1.000011  # of the domain: the models' own is 1.00001, in float32
FLAGS = ("-std=c99", "-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math")
WITH_DERIVATIVES = (
    "laikin_double_gauss_50.ols-60", "laikin_double_gauss_50.mlp-16x2", "cooke_anamorphic_42.ols-64",
    "schneider_anamorphic_31.mlp-16x2", "muller_fisheye_100-14mm.ols-40", "nikon_zoom_14_24.ols-64",
    "phone_lens_6.ols-64", "muller_fisheye_100-14mm.mlp-16x2",
)  # fmt: skip
GAUSS, CYLINDERS = "laikin_double_gauss_50", "cooke_anamorphic_42"
ZOOM = "models/nikon_zoom_70_200-range.states-64.onnx"
# Groups of methods by lens (published methods refuse cylinders), without the fits that take minutes.
FIT_LENSES = {
    GAUSS: "paraxial published ours ablations", "phone_lens_6": "paraxial published ours",
    "brendel_tessar_100": "paraxial published", CYLINDERS: "ours",
}  # fmt: skip
SLOW_FITS = ("phone_lens_6.zheng-adaptive-36x4", "cooke_anamorphic_42.ols-100")
CAMERAS = {
    "pinhole": "--camera pinhole",
    "fisheye": "--camera fisheye-equidistant",
    "thin": "--camera thin",
    "thick": f"--camera thick:lenses/{GAUSS}.toml",
    "exact": f"--camera lenses/{GAUSS}.toml",
    "onnx": f"--camera models/{GAUSS}.ols-60.onnx",
    "onnx-derivatives": f"--camera GOLDEN/derivatives/{GAUSS}.mlp-16x2.onnx",
    "fused-model": f"--camera fused:models/{GAUSS}.ols-60.onnx",
    "fused-exact": f"--camera fused:lenses/{GAUSS}.toml",
    "onnx-blades": f"--camera models/{GAUSS}.ols-60.onnx --blades 6 --f-number 2.8 --vignetting optical",
    "exact-blades": f"--camera lenses/{GAUSS}.toml --blades 6 --f-number 2.8 --pupil rear-rim",
    "anamorphic": f"--camera models/{CYLINDERS}.ols-64.onnx --focus 6",
    "zoom": f"--camera {ZOOM} --zoom 100 --focus 6",
    "fused-zoom": f"--camera fused:{ZOOM} --zoom 100 --focus 6",
}
SCENES = ("room", "garden", "lamps")


# ---- What uses the package itself: adapt names and arguments here if they change (modules are found by name). --------


def find(name: str) -> Any:
    """A function or class of the package under test, in whatever module it is."""
    root = Path.cwd()
    pattern = re.compile(rf"^(?:def|class) {name}\b", re.MULTILINE)
    files = [f for f in sorted((root / "neurolens").rglob("*.py")) if pattern.search(f.read_text(encoding="utf-8"))]
    if len(files) != 1:
        raise LookupError(f"{name}: defined in {len(files)} modules, expected 1")
    return getattr(importlib.import_module(".".join(files[0].relative_to(root).with_suffix("").parts)), name)


def fit_all(folder: Path) -> None:
    """Fit every method of `bench surrogates` on few rays, and a zoom: NAME.npz of coefficients, NAME.onnx each."""
    import torch

    @functools.cache
    def prepared(name: str) -> Any:
        lens = find("read_lens")(f"lenses/{name}.toml").at()
        domain = find("DomainChoice")(focus_m=(math.inf, math.inf)).of(lens)
        return find("prepare")(find("make_pairs")(lens, domain, find("PairSettings")(3000, 300, 3000)))

    def fit(lens: str, row: Any) -> Any:
        quick = {"steps": min(row.settings.steps, 20), "seconds": 1e9, "degree": min(row.settings.degree, 8)}
        return find("fit_model")(prepared(lens), dataclasses.replace(row.settings, **quick))

    def fit_zoom() -> Any:
        lens = find("read_lens")("lenses/nikon_zoom_80_200.toml")
        space = find("StateSpace")(lens, (find("zoom_axis")(lens, 4),), focus_m=(math.inf, 4.0))
        return find("fit_states")(space, find("StateSettings")(terms=24, degree=5, rays=2000))

    rows = {
        f"{lens}.{row.name}": (lens, row)
        for lens, groups in FIT_LENSES.items()
        for row in find("all_rows")()
        if row.group in groups and (lens == GAUSS or not row.weights) and f"{lens}.{row.name}" not in SLOW_FITS
    }
    for name in progress([n for n in (*rows, "zoom.states") if not (folder / f"{n}.npz").exists()], "fits"):
        found: dict[str, Any] = {}
        lens, row = rows.get(name, ("", None))
        try:
            model = fit(lens, row) if row else fit_zoom()
            for k, part in enumerate(getattr(model, "nodes", [model])):
                with torch.no_grad():
                    out = part.predict(find("sample_domain")(part.domain, 500, 5))
                found |= {f"predict.{k}.{i}": a.numpy() for i, a in enumerate((*out.rays, *out[1:]))}
                for what in ("core", "encoding", "scales", "gates"):
                    found |= dict(arrays_of(getattr(part, what), f"{what}.{k}"))
            file = folder / f"{name}.onnx"
            find("export_onnx" if row else "export_states")(model, file, {})
            if row and row.weights:
                find("store_weights")(file, file, row.weights, {})
        except Exception as error:  # a method that refuses a lens, or has no graph
            found["refused"] = np.array(f"{type(error).__name__}: {error}")
        np.savez(folder / f"{name}.part.npz", **found)
        (folder / f"{name}.part.npz").replace(folder / f"{name}.npz")


def arrays_of(value: Any, path: str) -> Iterator[tuple[str, np.ndarray]]:
    """All numbers in nested dataclasses, tuples and dicts, by their path."""
    if hasattr(value, "detach"):
        yield path, value.detach().numpy()
    elif isinstance(value, (np.ndarray, float, int)):
        yield path, np.asarray(value)
    elif dataclasses.is_dataclass(value) or isinstance(value, (tuple, list, dict)):
        if dataclasses.is_dataclass(value):
            value = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        for key, part in value.items() if isinstance(value, dict) else enumerate(value):
            yield from arrays_of(part, f"{path}.{key}")


# ---- Work in the tree under test: subprocesses of this script with that tree as PYTHONPATH and current folder. ------


def progress(units: Sequence[Any], label: str) -> Iterator[Any]:
    """The units, with what is done and the time left on stderr."""
    start = time.monotonic()
    for k, unit in enumerate(units):
        left = f"{(time.monotonic() - start) / k * (len(units) - k):.0f} s left" if k else ""
        print(f"\r\033[K{label} {k}/{len(units)} {left}", end="", file=sys.stderr, flush=True)
        yield unit
    if units:
        print(f"\r\033[K{label}: {len(units)} in {time.monotonic() - start:.0f} s", file=sys.stderr, flush=True)


def run_jobs(folder: Path, label: str) -> None:
    """Run command lines of the package in this process; each leaves NAME.json: exit code, output, message."""
    import contextlib
    import io
    import runpy

    jobs = json.loads((folder / f"{label}.jobs.json").read_text())
    for name, arguments in progress([(n, a) for n, a in jobs.items() if not (folder / f"{n}.json").exists()], label):
        said, wrong = io.StringIO(), io.StringIO()
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        sys.argv = ["neurolens", *(a.replace("{out}", str(folder / name)) for a in arguments)]
        try:
            with contextlib.redirect_stdout(said), contextlib.redirect_stderr(wrong):
                runpy.run_module("neurolens", run_name="__main__", alter_sys=True)
            code: Any = 0
        except SystemExit as end:
            code = end.code or 0
        except Exception:
            code, _ = "traceback", wrong.write(traceback.format_exc())
        text = wrong.getvalue().replace(str(folder), "FOLDER") if code else ""
        result = {"code": code, "out": said.getvalue(), "message": text}
        (folder / f"{name}.json").write_text(json.dumps(result))


def in_tree(tree: Path, arguments: Sequence[str], **options: Any) -> subprocess.CompletedProcess[Any]:
    env = os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "0"}
    return subprocess.run([sys.executable, *arguments], cwd=tree, env=env, **options)


def make(tree: Path, folder: Path, golden: Path, item: str, pattern: str) -> None:
    """Everything of an item that the tree makes, into the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    jobs: dict[str, list[str]] = {}
    if item == "render":
        for scene, (name, camera) in itertools.product(SCENES, CAMERAS.items()):
            words = f"--film 36x24 --width 48 --height 32 --samples 4 --threads 1 --quiet --restart -o {{out}} {camera}"
            command = f"render experiments/scenes/{scene}.toml {words}".replace("GOLDEN", str(golden)).split()
            jobs[f"render/{scene}.{name}.exr"] = command
    files = sorted((tree / "models").glob("*.onnx"))
    fits = [f for lens in (GAUSS, CYLINDERS) for f in sorted((golden / "fits").glob(f"{lens}.*.onnx"))]
    for file in [f for f in files if fnmatch.fnmatch(f.stem, pattern)] + (fits if pattern == "*" else []):
        own = file in files
        export = ["export", str(file.relative_to(tree) if own else file), *"--json -o {out} --to".split()]
        if item == "onnx" and own:
            jobs[f"onnx/{file.name}"] = [*export, "onnx"]
        if item == "derivatives" and own and file.stem in WITH_DERIVATIVES:
            jobs[f"derivatives/{file.name}"] = [*export, "onnx", "--derivatives", "--inverse"]
        if item == "source":
            base = f"source/{'' if own else 'fits/'}{file.stem}"
            jobs |= {f"{base}.h": [*export, "c"], f"{base}.glsl": [*export, "glsl"]}
            jobs[f"{base}.ray.h"] = [*export, "c", "--only", "ray"]
            if own:
                d = card_of(file)["domain"]
                waves = ["--fix", "wavelengths=550"] if d["wavelength_nm"][0] < d["wavelength_nm"][1] else []
                film = ["--fix", f"film_z={d['film_z_mm'][0]!r}", "--fix", f"stop={0.5**0.5 * d['stop_radius_mm']!r}"]
                jobs[f"{base}.wave.h"] = [*export, "c", *waves]
                jobs[f"{base}.fixed.h"] = [*export, "c", *waves, *film]
                jobs[f"{base}.fixed.ray.h"] = [*export, "c", "--only", "ray", *waves, *film]
                bands = ["--fix", "wavelengths=450,550,650"] if waves else []
                jobs |= {f"{base}.bands.{k}": [*export, t, *bands] for k, t in (("h", "c"), ("glsl", "glsl"))}
    if item == "fits":
        in_tree(tree, [__file__, "_fits", str(folder), item], check=True)
    elif jobs:
        (folder / f"{item}.jobs.json").write_text(json.dumps(jobs))
        in_tree(tree, [__file__, "_jobs", str(folder), item], check=True)


# ---- Models in onnxruntime and in C: rays in, outputs out. -----------------------------------------------------------


def open_model(file: Path) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    return onnxruntime.InferenceSession(file.read_bytes(), options, providers=["CPUExecutionProvider"])


def card_of(file: Path) -> Any:
    return json.loads(open_model(file).get_modelmeta().custom_metadata_map["neurolens"])


def runner(file: Path) -> Callable[[Out], Out]:
    session = open_model(file)
    names = [o.name for o in session.get_outputs()]
    return lambda feeds: dict(zip(names, session.run(names, feeds), strict=True))


def in_disc(rng: np.random.Generator, radius: float, n: int, most: float = 1.0) -> np.ndarray:
    r, angle = radius * most * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    return np.stack([r * np.cos(angle), r * np.sin(angle)])


def batches(card: Any, count: int, kind: str, seed: str) -> Iterator[Out]:
    """Feeds of about `count` rays in all: "inside" the domain, "outside" it, or "wild" (any bits)."""
    rng = np.random.default_rng(zlib.crc32(f"{seed} {kind}".encode()))
    d, states = card["domain"], card.get("states") or {}
    bits = lambda *shape: rng.integers(0, 2**32, shape, np.uint32).view(np.float32)  # noqa: E731
    for k in range(max(1, math.ceil(count / BATCH))):
        n = min(BATCH, count)
        (near, far), (low, high) = d["film_z_mm"], d["wavelength_nm"]
        state = list(card["lens"].get("state", [])) or [a["range"][0] for a in states.get("axes", [])]
        stop = d["stop_radius_mm"] * (1.0 if k % 2 else rng.uniform(0.3, 1))
        z = rng.uniform(near, far)
        if states and k % 3:  # films and stops of other states are known at the reference rays
            known = states["reference"][k % len(states["reference"])]
            state, z, stop = known["state"], known["film_z_mm"][0], 0.9 * known["stop_radius_mm"]
        wide = 1.0 if kind == "inside" else 1.5
        rays = np.empty((5, n))
        rays[:2], rays[2:4] = in_disc(rng, d["film_radius_mm"], n, wide), in_disc(rng, d["pupil_radius_mm"], n, wide)
        rays[4] = rng.uniform(low, high, n)
        if kind == "outside":  # each ray at least in one way
            way = rng.integers(0, 3, n)
            for rows, radius, its in ((slice(0, 2), d["film_radius_mm"], 0), (slice(2, 4), d["pupil_radius_mm"], 1)):
                scale = radius * rng.uniform(1.0001, 1.3, n) / np.maximum(np.hypot(*rays[rows]), 1e-9)
                rays[rows] *= np.where(way == its, scale, 1.0)
            off = rng.uniform(1.0001, 1.3, n)
            rays[4] = np.where(way == 2, np.where(rng.random(n) < 0.5, low / off, high * off), rays[4])
        with np.errstate(all="ignore"):
            rays = rays.astype(np.float32)
            call = [np.array(v, np.float32) for v in ([z], [stop], state)]
        if kind == "wild":
            strange = np.array([np.nan, np.inf, -np.inf, 1e-42, -1e-42, 0, 3.4e38, -3.4e38, 1.9e19, -1e3], np.float32)
            third = n // 3
            rays[:, :third] = bits(5, third)
            hit = rng.random((5, n - third)) < 0.25
            rays[:, third:][hit] = rng.choice(strange, int(hit.sum()))
            for value in call:  # one call in four each
                if rng.random() < 0.25 and value.size:
                    value[:] = rng.choice([*strange, *bits(10)], value.size)
        feeds = {"rays": rays, "film_z_mm": call[0], "stop_radius_mm": call[1]}
        yield feeds | ({"state": call[2]} if states else {})


def compiled(text: str, info: Any, cache: Path) -> Callable[[Out, int], Out]:
    """Source of a model as a function: a C header, or GLSL read as C++."""
    cache.mkdir(parents=True, exist_ok=True)
    name, outputs = info["function"], info["outputs"]
    inputs = [*info["inputs"], *(["band"] if len(info["bands_nm"]) > 1 else [])]
    rows = ("film_x_mm", "film_y_mm", "pupil_x_mm", "pupil_y_mm", "wavelength_nm")
    kinds = ["int" if v in ("band", "status") else "float" for v in (*inputs, *outputs)]
    if " in float " in text:  # GLSL
        text = re.sub(r"\bout (float|int) ", r"\1 &", re.sub(r"\bin (float|int) ", r"\1 ", text))
        text = re.sub(r"= float\[\d+\]\((.*?)\);", r"= {\1};", text, flags=re.DOTALL)
        text = "#include <algorithm>\n#include <cmath>\nusing namespace std;\n" + text
        head = text.split(f"void {name}(")[1].split(")")[0]
        given = [v for v in re.findall(r"\w+", head) if v not in ("float", "int")]
        place = {v: k for k, v in enumerate([*inputs, *outputs])}
        used = [f"(({kinds[place[v]]}*)a[{place[v]}])[{'i' if v in (*rows, *outputs) else '0'}]" for v in given]
        loop = f"for (size_t i = 0; i < n; i++) {name}({', '.join(used)});"
        text += f'\nextern "C" void run(size_t n, void **a) {{ {loop} }}\n'
        flags = ["-x", "c++", "-std=c++17", "-O2", "-march=native", "-ffp-contract=off"]
    else:
        used = [
            f"({t} *)a[{k}]" if v in (*rows, *outputs) else f"*({t} *)a[{k}]"
            for k, (v, t) in enumerate(zip((*inputs, *outputs), kinds, strict=True))
        ]
        text += f"\nvoid run(size_t n, void **a) {{ {name}_rays(n, {', '.join(used)}); }}\n"
        flags = ["-x", "c", *FLAGS]
    library = cache / f"{hashlib.sha256((text + str(flags)).encode()).hexdigest()[:24]}.so"
    if not library.exists():
        command = ["gcc", *flags, "-shared", "-fPIC", "-", "-o", f"{library}.part", "-lm"]
        subprocess.run(command, input=text, text=True, check=True, capture_output=True)
        Path(f"{library}.part").replace(library)
    function = ctypes.CDLL(str(library)).run
    function.argtypes, function.restype = [ctypes.c_size_t, ctypes.c_void_p], None

    def call(feeds: Out, band: int = 0) -> Out:
        n = feeds["rays"].shape[1]
        values = dict(zip(rows, feeds["rays"], strict=True)) | feeds | {"band": np.array([band], np.int32)}
        found = {v: np.empty(n, np.int32 if v == "status" else np.float32) for v in outputs}
        arrays = [np.ascontiguousarray(values[v]) for v in inputs] + list(found.values())
        function(n, (ctypes.c_void_p * len(arrays))(*(a.ctypes.data for a in arrays)))
        groups = {"scene_ray": ("x_mm", "y_mm", "z_mm", "dx", "dy", "dz"), "stop_xy_mm": ("stop_x_mm", "stop_y_mm")}
        whole = {g: np.stack([found.pop(v) for v in names]) for g, names in groups.items() if names[0] in found}
        return whole | found

    return call


# ---- Comparisons. ----------------------------------------------------------------------------------------------------


def vectors(name: str, array: np.ndarray) -> list[np.ndarray]:
    """The parts of an output that have one unit, [components, N] each."""
    if name.startswith("scene_ray"):
        return [part[i : i + 3] for part in array.reshape(-1, 6, array.shape[-1]) for i in (0, 3)]
    return [array[:2], array[2:4], array[4:]] if name == "rays" else [np.atleast_2d(array)]


def compare(old: Out, new: Out) -> dict[str, float]:
    """Rays, largest ulp over rays that both pass, statuses that differ."""
    if {k: v.shape for k, v in old.items()} != {k: v.shape for k, v in new.items()}:
        return {"rays": 0, "ulp": math.inf, "status": 0}
    passed, most = (old["status"] == 0) & (new["status"] == 0), 0.0
    for name in old if passed.any() else ():
        pairs = zip(vectors(name, old[name]), vectors(name, new[name]), strict=True)
        for a, b in ((a[:, passed], b[:, passed]) for a, b in pairs if name != "status"):
            if np.array_equal(a, b):
                continue
            with np.errstate(all="ignore"):
                size = np.abs(np.concatenate([a, b])).max(0)
                scale = np.maximum(size, np.sqrt(np.mean(size.astype(float) ** 2)).astype(np.float32))
                ulp = (np.abs(a.astype(float) - b) / np.spacing(scale)).max()
            most = max(most, math.inf if np.isnan(ulp) else float(ulp))
    return {"rays": len(passed), "ulp": most, "status": int((old["status"] != new["status"]).sum())}


def total(parts: Sequence[dict[str, float]]) -> dict[str, float]:
    """Sums, and the largest of ulp."""
    keys = {k for p in parts for k in p}
    return {k: (max if k == "ulp" else sum)(p.get(k, 0) for p in parts) for k in sorted(keys)}


def at_edges(run: Callable[[Out], Out], feeds: Out, old: Out, new: Out) -> int:
    """How many rays whose status differs have the new one in the golden model, too, a few ulp away."""
    differ = old["status"] != new["status"]
    if not differ.any():
        return 0
    rays, rng, found = feeds["rays"][:, differ], np.random.default_rng(0), np.zeros(int(differ.sum()), bool)
    for _ in range(64):
        with np.errstate(all="ignore"):
            near = rays + rng.integers(-4, 5, rays.shape).astype(np.float32) * np.spacing(rays)
        found |= run(feeds | {"rays": near.astype(np.float32)})["status"] == new["status"][differ]
    return int(found.sum())


def held(run_old: Callable[[Out], Out], run_new: Callable[[Out], Out], feeds: Iterator[Out]) -> dict[str, float]:
    parts = []
    for given in feeds:
        old, new = run_old(given), run_new(given)
        parts.append(compare(old, new))
        if parts[-1]["status"]:
            parts[-1]["edge"] = at_edges(run_old, given, old, new)
    return total(parts)


def check_wild(old: Path, new: Path, count: int) -> dict[str, float]:
    """Random bits: statuses, rays outside the domain that pass, and passing rays that are not finite."""
    one, other, card = runner(old), runner(new), card_of(old)
    d, (low, high), parts = card["domain"], card["domain"]["wavelength_nm"], []
    for feeds in batches(card, count, "wild", old.name):
        a, b = one(feeds), other(feeds)
        with np.errstate(all="ignore"):
            r = feeds["rays"].astype(float)
            inside = np.hypot(*r[:2]) <= SLACK * d["film_radius_mm"]
            inside &= np.hypot(*r[2:4]) <= SLACK * d["pupil_radius_mm"]
            inside &= ((r[4] >= low / SLACK) & (r[4] <= high * SLACK)) | (not card["lens"]["dispersive"])
            inside &= bool(0 <= feeds["stop_radius_mm"][0] <= SLACK * d["stop_radius_mm"]) or "state" in feeds
        finite = [np.isfinite(np.concatenate([v.reshape(-1, v.shape[-1]) for v in o.values()])).all(0) for o in (a, b)]
        wrong = [int(((o["status"] == 0) & ~(inside & f)).sum()) for o, f in zip((a, b), finite, strict=True)]
        parts.append(compare(a, b) | {"ulp": 0.0, "passed wrongly": max(0, wrong[1] - wrong[0])})
        if parts[-1]["status"]:
            parts[-1]["edge"] = at_edges(one, feeds, a, b)
    return total(parts)


def check_onnx(old: Path, new: Path, count: int) -> dict[str, float]:
    cards = [{k: v for k, v in card_of(f).items() if k not in ("reference", "versions")} for f in (old, new)]
    for card in cards:
        card["fit"].pop("seconds")
    one, other = runner(old), runner(new)
    parts = [held(one, other, batches(card_of(old), count, kind, old.name)) for kind in ("inside", "outside")]
    return total(parts) | {"cards": int(json.dumps(cards[0]) != json.dumps(cards[1]))}


def check_speed(old: Path, new: Path, rounds: int = 40) -> dict[str, float]:
    """Time of the thread in pairs of calls, the first by turns: minimum over minimum, and the median of the ratios."""
    import onnx

    if onnx.load(old).graph == onnx.load(new).graph:
        return {"ratio": 1.0, "median": 1.0, "same graph": 1}
    sessions, feeds = [open_model(old), open_model(new)], next(batches(card_of(old), BATCH, "inside", old.name))
    times: list[list[float]] = [[], []]
    for k in range(4 * rounds):
        for which in (0, 1) if k % 2 else (1, 0):
            start = time.thread_time_ns()
            sessions[which].run(None, feeds)
            times[which].append(time.thread_time_ns() - start)
        a, b = np.array(times[0][3:]), np.array(times[1][3:])
        if k >= rounds and min(b.min() / a.min(), np.median(b / a)) <= LIMIT_SPEED:
            break  # what looks slower is measured for longer
    return {"ratio": b.min() / a.min(), "median": float(np.median(b / a)), "same graph": 0}


def check_source(old: Path, new: Path, cache: Path, count: int) -> dict[str, Any]:
    facts = [json.loads(Path(f"{f}.json").read_text()) for f in (old, new)]
    if facts[0]["code"] or facts[1]["code"]:
        said = [f["message"].replace(str(cache.parent), "FOLDER") for f in facts]
        return {"refused": 1, "message": int(said[0] != said[1])}
    one, other = (json.loads(f["out"]) for f in facts)
    found = {"operations": other["operations_per_ray"] - one["operations_per_ray"]}
    found["signature"] = int(any(one[k] != other[k] for k in ("function", "inputs", "outputs", "bands_nm")))
    texts = [f.read_text() for f in (old, new)]
    if found["signature"] or texts[0] == texts[1]:
        return found | {"same text": int(texts[0] == texts[1])}
    stem = re.sub(r"(\.bands|\.wave|\.fixed|\.ray)*\.(h|glsl)$", "", old.name)
    card = card_of(cache.parent / ("fits" if old.parent.name == "fits" else "onnx") / f"{stem}.onnx")
    runs = [compiled(t, info, cache) for t, info in zip(texts, (one, other), strict=True)]
    for band in range(max(1, len(one["bands_nm"]))):
        for kind, n in (("inside", count), ("outside", count // 4), ("wild", count // 4)):
            calls = [functools.partial(r, band=band) for r in runs]  # type: ignore
            found = total([found, held(*calls, batches(card, n, kind, stem))])  # type: ignore
    return found


def check_derivatives(old: Path, new: Path, count: int) -> dict[str, float]:
    """Derivatives on rays inside, and both inverse maps on what the golden model gives for them."""
    model, card = runner(old), card_of(old)
    parts = [held(runner(old), runner(new), batches(card, count, "inside", old.name))]
    for which, given in (("stop", "stop_rays"), ("scene", "front_rays")):
        runs = [runner(f.with_name(f"{f.stem}.{which}.onnx")) for f in (old, new)]
        share = [0, 0]
        for feeds in batches(card, count // 4, "inside", old.name):
            out = model(feeds)
            ray, rays = out["scene_ray"], feeds["rays"]
            sine = np.maximum(np.hypot(ray[3], ray[4]), 1e-12)
            v = ray[3:5] * np.arctan2(sine, -ray[5]) / sine
            stack = [rays[:2], out["stop_xy_mm"], rays[4:]] if which == "stop" else [ray[:2], v, rays[4:]]
            call = {k: feeds[k] for k in ("film_z_mm", "stop_radius_mm")}
            asked = np.concatenate(stack)[:, out["status"] == 0].astype(np.float32)
            found = [r({given: asked, **call}) for r in runs]
            share = [s + int((f["status"] == 0).sum()) for s, f in zip(share, found, strict=True)]
            parts.append(compare(*found))
        parts.append({"convergence": abs(share[0] - share[1])})
    return total(parts)


def check_fit(old: Path, new: Path) -> dict[str, Any]:
    """Coefficients as a bag of arrays, whatever their names, and predictions in float64, both bit by bit."""
    a, b = (dict(np.load(f)) for f in (old, new))
    if str(a.pop("refused", "")) != str(said := b.pop("refused", "")):
        return {"differs": 1, "why": f"refused: {str(said)[:150]}"}
    bags = [sorted((v.shape, v.tobytes()) for k, v in x.items() if "predict" not in k and v.size > 1) for x in (a, b)]
    worst = 0.0 if {k for k in a if "predict" in k} == {k for k in b if "predict" in k} else math.inf
    for k in (k for k in a if "predict" in k and math.isfinite(worst)):
        worst = max(worst, float(np.abs(a[k].astype(float) - b[k]).max() / (np.abs(a[k]).max() or 1.0)))
    return {"differs": int(worst > 0 or bags[0] != bags[1]), "relative": worst, "arrays": len(bags[0])}


def check_picture(old: Path, new: Path) -> dict[str, Any]:
    """Channels of the EXR bit by bit; the largest difference is over the largest value of a colour."""
    import OpenEXR

    facts = [json.loads(Path(f"{f}.json").read_text()) for f in (old, new)]
    if facts[0]["code"] or facts[1]["code"]:
        same = facts[0]["message"] == facts[1]["message"]
        return {"differs": int(not same), "refused": 1, "why": f"{old.name}: {facts[1]['message'][-200:]}"}
    a, b = (
        {k: c.pixels for k, c in OpenEXR.File(str(f), separate_channels=True).channels().items()} for f in (old, new)
    )
    if a.keys() != b.keys() or any(a[k].tobytes() != b[k].tobytes() for k in a):
        off = [np.nanmax(np.abs(a[k] - b[k])) / (np.nanmax(np.abs(a[k])) or 1) for k in a if k in b and k in "RGB"]
        return {"differs": 1, "relative": float(max(off, default=math.inf)), "why": old.name}
    return {"differs": 0}


def check_start(old: Path, new: Path) -> dict[str, Any]:
    """Processor time of fresh processes in pairs, and what must run without the packages of the extra "train"."""
    found: dict[str, Any] = {}
    jobs = {"import": ["-c", "import neurolens.cameras.model"], "help": ["-m", "neurolens", "--help"]}
    for name, arguments in jobs.items():
        times: dict[Path, list[float]] = {old: [], new: []}
        for k in range(15):
            for tree in (old, new) if k % 2 else (new, old):
                before = resource.getrusage(resource.RUSAGE_CHILDREN)
                in_tree(tree, arguments, check=True, capture_output=True)
                after = resource.getrusage(resource.RUSAGE_CHILDREN)
                times[tree].append(after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime)
        found[f"{name} s"] = min(times[new][1:])
        found[name] = min(times[new][1:]) / min(times[old][1:])
    blocked = "torch sklearn onnx matplotlib flip_evaluator"
    without = f"import sys; sys.modules.update(dict.fromkeys('{blocked}'.split())); sys.argv = ['neurolens', *{{}}]; "
    without += "import neurolens.cameras.model, runpy; runpy.run_module('neurolens', run_name='__main__')"
    words = f"experiments/scenes/room.toml -o {tempfile.gettempdir()}/without_torch.exr --restart --quiet --threads 1"
    words += " --film 36x27 --width 8 --height 6 --samples 1"
    commands = [["--help"], ["render", "--help"]]
    commands += [["render", *words.split(), *CAMERAS[c].split()] for c in ("thin", "onnx", "fused-model", "zoom")]
    failed = [c for c in commands if in_tree(new, ["-c", without.format(c)], capture_output=True).returncode]
    return found | {"no torch": len(failed)} | ({"why": str(failed[0][:2])} if failed else {})


# ---- The table. ------------------------------------------------------------------------------------------------------

SOURCES = {"onnx-speed": "onnx", "wild": "onnx", "fits-onnx": "fits"}  # items that compare files of another


def units_of(item: str, old: Path, new: Path, tree: Path, args: argparse.Namespace) -> dict[str, Callable[[], Any]]:
    """The comparisons of an item by the name of the file."""
    if item == "start":
        return {"start": lambda: check_start(Path(json.loads((old / "tree.json").read_text())["tree"]), tree)}
    folder = SOURCES.get(item, item)
    ends = {"fits": ".npz", "render": ".exr", "source": (".h", ".glsl")}.get(item, ".onnx")
    files = [f for f in sorted((old / folder).rglob("*")) if f.name.endswith(ends) and ".part." not in f.name]  # type: ignore
    files = [f for f in files if not f.name.endswith((".stop.onnx", ".scene.onnx"))]
    if item == "source":  # what is refused leaves a message alone
        files = [f.with_suffix("") for f in sorted((old / folder).rglob("*.json"))]
    if folder in ("onnx", "source", "derivatives"):
        files = [f for f in files if fnmatch.fnmatch(f.name, args.models + "*")]
    run: Callable[[Path, Path], Any] = {  # type: ignore
        "onnx": functools.partial(check_onnx, count=args.rays),
        "fits-onnx": functools.partial(check_onnx, count=args.rays // 10),
        "onnx-speed": check_speed,
        "source": functools.partial(check_source, cache=old / "compiled", count=min(args.rays, 200_000)),
        "derivatives": functools.partial(check_derivatives, count=args.rays // 4),
        "wild": functools.partial(check_wild, count=10 * args.rays // max(1, len(files))),
        "fits": check_fit,
        "render": check_picture,
    }[item]
    names = [str(f.relative_to(old)) for f in files]
    return {name: functools.partial(run, old / name, new / name) for name in names}


def row(item: str, found: dict[str, dict[str, Any]]) -> list[str]:
    """A row of the table; what fails is told on lines of its own."""
    limit = LIMIT_DERIVATIVES_ULP if item == "derivatives" else LIMIT_ULP
    sums = total([{k: v for k, v in p.items() if k != "why"} for p in found.values()])
    bad = {k: sums[k] for k in FAILURES if sums.get(k)}
    for name, p in found.items():
        slow = min(p.get("ratio", 0), p.get("median", 0)) > LIMIT_SPEED
        slow |= max(p.get("import", 0), p.get("help", 0)) > LIMIT_START
        for what, fails in {
            f"above {limit:g} ulp": p.get("ulp", 0) > limit,
            "more operations": p.get("operations", 0) > 0,
            "slower": slow,
        }.items():
            bad |= {what: bad.get(what, 0) + 1} if fails else {}
        if any(p.get(k) for k in FAILURES) or slow or p.get("ulp", 0) > limit or p.get("operations", 0) > 0:
            print(f"  {item}: {name}: {', '.join(f'{k} {v}' for k, v in p.items() if v)}")
    largest = f"{sums.get('ulp', 0):.3g} ulp"
    if item in ("fits", "render"):
        largest = f"{max((p.get('relative', 0) for p in found.values()), default=0):.3g} of the largest value"
    if item == "onnx-speed":
        ratios = [max(p.get(k, 0) for p in found.values()) for k in ("ratio", "median")]
        largest = f"x {ratios[0]:.3f} of minima, {ratios[1]:.3f} median"
    if item == "start":
        largest = ", ".join(f"{k} x {sums.get(k, 0):.3f} ({sums.get(f'{k} s', 0):.2f} s)" for k in ("import", "help"))
    notes = {k: sums[k] for k in ("edge", "refused", "same text", "same graph", "operations") if sums.get(k)}
    verdict = "ok" if found and not bad else "FAIL: " + ", ".join(f"{k} {v:g}" for k, v in bad.items())
    verdict += f" ({', '.join(f'{k} {v:g}' for k, v in notes.items())})" if notes else ""
    return [item, f"{len(found)} files, {sums.get('rays', 0):.3g} rays", largest, f"{sums.get('status', 0):g}", verdict]


def check(args: argparse.Namespace) -> int:
    """All items, one table."""
    golden, tree = args.folder.resolve(), args.tree.resolve()
    source = b"".join(f.read_bytes() for f in sorted((tree / "neurolens").rglob("*.py")))
    new = golden / "checks" / hashlib.sha256(source).hexdigest()[:12]
    rows = [["what", "compared", "largest difference", "statuses", "verdict"]]
    for item in args.only or ITEMS:
        make(tree, new, golden, SOURCES.get(item, item), args.models)
        units, found = units_of(item, golden, new, tree, args), {}
        for unit in progress(list(units), item):
            file = new / "results" / f"{item}-{args.rays}" / f"{unit.replace('/', '_')}.json"
            if not file.exists():
                try:
                    result = units[unit]()
                except Exception as error:
                    result = {"broken": 1, "why": f"{type(error).__name__}: {str(error)[:200]}"}
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(json.dumps(result, default=float))
            found[unit] = json.loads(file.read_text())
        rows.append(row(item, found))
    for cells in rows:
        print(f"{cells[0]:<12} {cells[1]:<26} {cells[2]:<44} {cells[3]:>8}  {cells[4]}")
    return int(any(cells[4].startswith("FAIL") for cells in rows))


def main() -> int:
    if sys.argv[1] in ("_jobs", "_fits"):  # in a subprocess, see `make`
        sys.path[0] = str(Path.cwd())
        folder, item = Path(sys.argv[2]), sys.argv[3]
        (folder / item).mkdir(parents=True, exist_ok=True)
        run_jobs(folder, item) if sys.argv[1] == "_jobs" else fit_all(folder / item)
        return 0
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("record", "check"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--tree", type=Path, default=Path(__file__).resolve().parents[1])
    parser.add_argument("--only", nargs="+", choices=ITEMS, default=[])
    parser.add_argument("--rays", type=int, default=1_000_000, help="inside, and as many outside (default 10^6)")
    parser.add_argument("--models", default="*", help="pattern of file names in models/, without .onnx")
    args = parser.parse_args()
    if args.command == "check":
        return check(args)
    golden, tree = args.folder.resolve(), args.tree.resolve()
    golden.mkdir(parents=True, exist_ok=True)
    (golden / "tree.json").write_text(json.dumps({"tree": str(tree)}))
    for item in ("fits", "onnx", "derivatives", "source", "render"):
        if not args.only or item in args.only:
            make(tree, golden, golden, item, "*")
    return 0


if __name__ == "__main__":
    sys.exit(main())
