"""Record what the package computes, and compare a changed tree against it: exports, source code, fits, pictures.

    python experiments/invariants.py record FOLDER [--tree OLD]     goldens of a tree (default: the one of this file)
    python experiments/invariants.py check FOLDER [--tree NEW] [--only ITEM ...] [--rays N] [--models GLOB]

Items: onnx, source, derivatives, wild, fits, fits-onnx, render, rays, ghosts. Only the command line of the package and
onnxruntime are used, but for `fit_all` and `trace_all`. Both commands go on where they stopped: goldens and results are
files, the results of a check by a hash of the tree's source and of the number of rays. `check` exits with 1 on a
failure. Record a tree by the copy of this file in it: functions of the package have other names in older trees.

`rays` are exact rays of every lens in both directions, --traced of them each way (10^6 for a full run; a check must
name the number that was recorded); `ghosts` are 1,000 paths with two reflections. Positions, directions and powers are
compared in float64; the float32 run by its errors against the float64 run of the recorded tree.

Differences are in units in the last place (ulp) of float32, over rays that both pass (status 0): |a - b| over the ulp
of the largest component of the vector (position, direction, crossing with the stop, a column of derivatives), or of the
RMS of that over all rays compared where it is larger, so that vectors near zero count in the scale of their kind.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import dataclasses
import fnmatch
import functools
import hashlib
import importlib
import io
import itertools
import json
import math
import os
import re
import runpy
import subprocess
import sys
import traceback
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

Out = dict[str, Any]  # arrays by the name of the output
Model = Callable[[Out], Out]
BATCH = 16384


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
    "exact-blades": f"--camera lenses/{GAUSS}.toml --blades 6 --f-number 2.8",
    "anamorphic": f"--camera models/{CYLINDERS}.ols-64.onnx --focus 6",
    "zoom": f"--camera {ZOOM} --zoom 100 --focus 6",
    "fused-zoom": f"--camera fused:{ZOOM} --zoom 100 --focus 6",
}
SCENES = ("room", "garden", "lamps")


def find(name: str) -> Any:
    """A function or class of the package under test, in whatever module it is."""
    root = Path.cwd()
    pattern = re.compile(rf"^(?:def|class) {name}\b", re.MULTILINE)
    modules = sorted([*(root / "neurolens").rglob("*.py"), *(root / "experiments").rglob("*.py")])
    files = [f for f in modules if f.name != "invariants.py" and pattern.search(f.read_text(encoding="utf-8"))]
    if len(files) != 1:
        raise LookupError(f"{name}: defined in {len(files)} modules, expected 1")
    return getattr(importlib.import_module(".".join(files[0].relative_to(root).with_suffix("").parts)), name)


def fit_all(folder: Path) -> None:
    """Fit every row of `experiments surrogates` on few rays, and a zoom: NAME.npz of coefficients, NAME.onnx each."""
    import torch

    @functools.cache
    def prepared(name: str) -> Any:
        lens = find("set_lens")(find("read_lens")(f"lenses/{name}.toml"))
        domain = find("DomainChoice")(focus_m=(math.inf, math.inf)).of(lens)
        return find("prepare")(find("make_pairs")(lens, domain, find("PairSettings")(3000, 300, 3000)))

    def fit(lens: str, row: Any) -> Any:
        quick = {"steps": min(row.settings.steps, 20), "degree": min(row.settings.degree, 8)}
        return find("fit_any")(prepared(lens), dataclasses.replace(row.settings, **quick))

    def fit_zoom() -> Any:
        lens = find("read_lens")("lenses/nikon_zoom_80_200.toml")
        space = find("StateSpace")(lens, (find("zoom_axis")(lens, 4),), focus_m=(math.inf, 4.0))
        return find("fit_states")(space, find("StateSettings")(terms=24, degree=5, rays=2000))

    rows = {
        f"{lens}.{row.name}": (lens, row)
        for lens, groups in FIT_LENSES.items()
        for row in find("all_rows")()
        if row.group in groups and f"{lens}.{row.name}" not in SLOW_FITS
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
        except Exception as error:  # a method that refuses a lens, or has no graph
            found["refused"] = np.array(f"{type(error).__name__}: {error}")
        np.savez(folder / f"{name}.part.npz", **found)
        (folder / f"{name}.part.npz").replace(folder / f"{name}.npz")


def trace_all(folder: Path, item: str, count: int) -> None:
    """Trace every lens both ways, or 1,000 ghost paths, in float64 and float32: LENS.npz, arrays by precision."""
    import torch

    tracer = sys.modules[find("trace_differentials").__module__]
    files = [file for file in sorted(Path("lenses").glob("*.toml")) if "OpticsDatabase" not in file.read_text()]
    for number, file in enumerate(progress(files, item)):
        if (folder / f"{file.stem}.npz").exists():
            continue
        lens, found = find("set_lens")(find("read_lens")(file)), dict[str, Any]()
        every = range(len(lens.surfaces))
        pairs = list(itertools.combinations([k for k in every if lens.surfaces[k].n_d != lens.media[k].n_d], 2))
        share = len(range(number, 1000, len(files)))
        rng = np.random.default_rng(zlib.crc32(file.stem.encode()))
        chosen = rng.choice(len(pairs), share, replace=share > len(pairs)) if item == "ghosts" else ()
        paths = [find("ghost")(len(every), *pairs[k]) for k in chosen]
        for name, steps in [*enumerate(paths)] if paths else [("scene", ()), ("film", ())]:
            rays, waves = launched(rng, lens, str(name), 200 if paths else count)
            for precision in ("float64", "float32"):
                one = tracer.Rays(*(torch.from_numpy(r.astype(precision)) for r in rays))
                nm = torch.from_numpy(waves.astype(precision))
                if paths:
                    out = find("follow")(lens, one, steps, nm)
                else:
                    out = tracer.trace(lens, one, nm, towards=name, transmittance=True)
                power = out.power if paths else out.transmittance
                found |= {f"{name}.{precision}.ray": torch.stack([*out.rays]).numpy()}
                found |= {f"{name}.{precision}.power": power.numpy()}
                found |= {f"{name}.{precision}.status": out.status.numpy().astype(np.int16)}
        np.savez(folder / f"{file.stem}.part.npz", **found)
        (folder / f"{file.stem}.part.npz").replace(folder / f"{file.stem}.npz")


def launched(rng: np.random.Generator, lens: Any, name: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays [6, N] from the film through the rear rim, or from the scene through the front rim, and wavelengths.

    One ray in eight passes the rim by up to a tenth of its radius, and film points lie up to a tenth beyond the image.
    """
    u, scene = rng.random((6, count)), name == "scene"
    rim = lens.surfaces[-1 if scene else 0].semi_diameter_mm * np.where(u[5] < 0.125, 1.1, 1.0) * np.sqrt(u[0])
    to = np.stack([rim * np.cos(2 * np.pi * u[1]), rim * np.sin(2 * np.pi * u[1]), np.zeros(count)])
    if scene:
        to[2] = float(lens.vertices_mm[len(lens.surfaces) - 1])
        radius = 1.1 * (lens.image_radius_mm or 0.8 * lens.surfaces[-1].semi_diameter_mm) * np.sqrt(u[2])
        start = np.stack([radius * np.cos(2 * np.pi * u[3]), radius * np.sin(2 * np.pi * u[3]), 0 * u[0]])
        start[2] = float(lens.film_z_mm if lens.film_z_mm is not None else lens.vertices_mm[-1])
        d = to - start
    else:
        angle = np.radians(1.1 * min(lens.half_field_deg or 30.0, 90.0)) * np.sqrt(u[2])
        d = np.stack(
            [np.sin(angle) * np.cos(2 * np.pi * u[3]), np.sin(angle) * np.sin(2 * np.pi * u[3]), np.cos(angle)]
        )
        start = to - 20 * d
    return np.concatenate([start, d / np.sqrt((d * d).sum(0))]), 400 + 300 * u[4]


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


def progress(units: Sequence[Any], label: str) -> Iterator[Any]:
    """The units, counted on stderr."""
    for k, unit in enumerate(units):
        print(f"\r\033[K{label} {k + 1}/{len(units)}", end="", file=sys.stderr, flush=True)
        yield unit
    print(file=sys.stderr)


def run_jobs(folder: Path, label: str) -> None:
    """Run command lines of the package in this process; each leaves NAME.json: exit code, output, message."""
    jobs = json.loads((folder / f"{label}.jobs.json").read_text())
    for name, arguments in progress([(n, a) for n, a in jobs.items() if not (folder / f"{n}.json").exists()], label):
        said, wrong, code = io.StringIO(), io.StringIO(), 0
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        sys.argv = ["neurolens", *(a.replace("{out}", str(folder / name)) for a in arguments)]
        try:
            with contextlib.redirect_stdout(said), contextlib.redirect_stderr(wrong):
                runpy.run_module("neurolens", run_name="__main__", alter_sys=True)
        except SystemExit as end:
            code = end.code or 0  # type: ignore
        except Exception:
            code, _ = "traceback", wrong.write(traceback.format_exc())  # type: ignore
        text = wrong.getvalue().replace(str(folder), "FOLDER") if code else ""
        (folder / f"{name}.json").write_text(json.dumps({"code": code, "out": said.getvalue(), "message": text}))


def in_tree(tree: Path, arguments: Sequence[str], **options: Any) -> subprocess.CompletedProcess[Any]:
    env = os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "0"}
    return subprocess.run([sys.executable, *arguments], cwd=tree, env=env, **options)


def make(tree: Path, folder: Path, golden: Path, item: str, pattern: str, traced: int = 10_000) -> None:
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
    if item in ("fits", "rays", "ghosts"):
        in_tree(tree, [__file__, f"_{item}", str(folder), item, str(traced)], check=True)
    elif jobs:
        (folder / f"{item}.jobs.json").write_text(json.dumps(jobs))
        in_tree(tree, [__file__, "_jobs", str(folder), item], check=True)


def open_model(file: Path) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    return onnxruntime.InferenceSession(file.read_bytes(), options, providers=["CPUExecutionProvider"])


def card_of(file: Path) -> Any:
    return json.loads(open_model(file).get_modelmeta().custom_metadata_map["neurolens"])


def runner(file: Path) -> Model:
    session = open_model(file)
    names = [o.name for o in session.get_outputs()]
    return lambda feeds: dict(zip(names, session.run(names, feeds), strict=True))


def batches(card: Any, count: int, kind: str, seed: str) -> Iterator[Out]:
    """Feeds of about `count` rays in all: "inside" the domain, "outside" it, or "wild" (any bits)."""
    rng = np.random.default_rng(zlib.crc32(f"{seed} {kind}".encode()))
    d, states = card["domain"], card.get("states") or {}
    (near, far), (low, high) = d["film_z_mm"], d["wavelength_nm"]
    radii = np.array([[d["film_radius_mm"]], [d["pupil_radius_mm"]]])
    strange = [np.nan, np.inf, -np.inf, 1e-42, -1e-42, 0, 3.4e38, -3.4e38, 1.9e19, -1e3]

    def bits(*shape: int) -> np.ndarray:
        return rng.integers(0, 2**32, shape, np.uint32).view(np.float32)

    for k in range(max(1, math.ceil(count / BATCH))):
        n = min(BATCH, count)
        state = list(card["lens"].get("state", [])) or [a["range"][0] for a in states.get("axes", [])]
        z, stop = rng.uniform(near, far), d["stop_radius_mm"] * (1.0 if k % 2 else rng.uniform(0.3, 1))
        if states and k % 3:  # films and stops of other states are known at the reference rays
            known = states["reference"][k % len(states["reference"])]
            state, z, stop = known["state"], known["film_z_mm"][0], 0.9 * known["stop_radius_mm"]
        r, turn = radii * np.sqrt(rng.random((2, n))), 2 * np.pi * rng.random((2, n))
        wave = rng.uniform(low, high, n)
        if kind == "outside":  # each ray at least in one way
            way, off = rng.integers(0, 3, n), rng.uniform(1.0001, 1.3, n)
            r = np.where(way == [[0], [1]], radii * off, 1.5 * r)
            wave = np.where(way == 2, np.where(rng.random(n) < 0.5, low / off, high * off), wave)
        x, y = r * np.cos(turn), r * np.sin(turn)
        rays = np.stack([x[0], y[0], x[1], y[1], wave]).astype(np.float32)
        call = [np.array(v, np.float32) for v in ([z], [stop], state)]
        if kind == "wild":
            odd = np.array([*strange, *bits(10)], np.float32)
            rays[:, : n // 3] = bits(5, n // 3)
            hit = rng.random((5, n)) < 0.25
            rays[hit] = rng.choice(odd, int(hit.sum()))
            for value in call:  # one call in four each
                if rng.random() < 0.25 and value.size:
                    value[:] = rng.choice(odd, value.size)
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


def total(parts: Iterable[Out]) -> Out:
    """Sums, and the largest of what is a size."""
    found: Out = {}
    for part in parts:
        for key, value in part.items():
            both = (found.get(key, 0), value)
            found[key] = value if key == "why" else (max if key in SIZES else sum)(both)
    return found


def held(run_old: Model, run_new: Model, feeds: Iterable[Out]) -> Out:
    """The comparison of two models over batches of rays."""
    return total(compare(run_old(given), run_new(given)) for given in feeds)


def check_wild(old: Path, new: Path, count: int, **_: Any) -> Out:
    """Random bits: statuses. What may pass at all is for `python -m experiments outside`."""
    return held(runner(old), runner(new), batches(card_of(old), count, "wild", old.name)) | {"ulp": 0.0}


def check_onnx(old: Path, new: Path, count: int, **_: Any) -> Out:
    """Rays inside and outside the domain, and what the card says."""
    cards = [{k: v for k, v in card_of(f).items() if k not in ("reference", "versions")} for f in (old, new)]
    for card in cards:
        card["fit"].pop("seconds")
    one, other = runner(old), runner(new)
    parts = [held(one, other, batches(card_of(old), count, kind, old.name)) for kind in ("inside", "outside")]
    return total(parts) | {"cards": int(json.dumps(cards[0]) != json.dumps(cards[1]))}


def refused(old: Path, new: Path, cache: Path) -> Out | None:
    """Where a command of either tree failed: whether both said the same."""
    facts = [json.loads(Path(f"{f}.json").read_text()) for f in (old, new)]
    if not (facts[0]["code"] or facts[1]["code"]):
        return None
    said = [f["message"].replace(str(cache.parent), "FOLDER") for f in facts]
    return {"refused": 1, "message": int(said[0] != said[1]), "why": said[1][-200:]}


def check_source(old: Path, new: Path, count: int, cache: Path) -> Out:
    """C and GLSL of a model: signature, operations, and rays through the compiled code."""
    if (failed := refused(old, new, cache)) is not None:
        return failed
    one, other = (json.loads(json.loads(Path(f"{f}.json").read_text())["out"]) for f in (old, new))
    found: Out = {"operations": max(0, other["operations_per_ray"] - one["operations_per_ray"])}
    found["signature"] = int(any(one[k] != other[k] for k in ("function", "inputs", "outputs", "bands_nm")))
    texts = [f.read_text() for f in (old, new)]
    if found["signature"] or texts[0] == texts[1]:
        return found | {"same text": int(texts[0] == texts[1])}
    stem = re.sub(r"(\.bands|\.wave|\.fixed|\.ray)*\.(h|glsl)$", "", old.name)
    card = card_of(cache.parent / ("fits" if old.parent.name == "fits" else "onnx") / f"{stem}.onnx")
    runs = [compiled(t, info, cache) for t, info in zip(texts, (one, other), strict=True)]
    for band in range(max(1, len(one["bands_nm"]))):
        for kind, n in (("inside", count), ("outside", count // 4), ("wild", count // 4)):
            a, b = (functools.partial(r, band=band) for r in runs)  # type: ignore
            found = total([found, held(a, b, batches(card, n, kind, stem))])
    return found


def check_derivatives(old: Path, new: Path, count: int, **_: Any) -> Out:
    """Derivatives on rays inside, and both inverse maps on what the golden model gives for them."""
    model, card = runner(old), card_of(old)
    parts = [held(model, runner(new), batches(card, count, "inside", old.name))]
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
    return {"derivative ulp" if k == "ulp" else k: v for k, v in total(parts).items()}


def check_fit(old: Path, new: Path, **_: Any) -> Out:
    """Coefficients as a bag of arrays, whatever their names, and predictions in float64, both bit by bit."""
    a, b = (dict(np.load(f)) for f in (old, new))
    if str(a.pop("refused", "")) != str(said := b.pop("refused", "")):
        return {"differs": 1, "why": f"refused: {str(said)[:150]}"}
    bags = [sorted((v.shape, v.tobytes()) for k, v in x.items() if "predict" not in k and v.size > 1) for x in (a, b)]
    said_a, said_b = ({k: v for k, v in x.items() if "predict" in k} for x in (a, b))
    if said_a.keys() != said_b.keys():
        return {"differs": 1, "why": "other predictions"}
    off = [np.abs(v.astype(float) - said_b[k]).max() / (np.abs(v).max() or 1.0) for k, v in said_a.items()]
    return {"differs": int(max(off, default=0) > 0 or bags[0] != bags[1]), "relative": float(max(off, default=0))}


def check_picture(old: Path, new: Path, cache: Path, **_: Any) -> Out:
    """Channels of the EXR bit by bit; the largest difference is over the largest value of a colour."""
    import OpenEXR

    if (failed := refused(old, new, cache)) is not None:
        return failed
    a, b = (
        {k: c.pixels for k, c in OpenEXR.File(str(f), separate_channels=True).channels().items()} for f in (old, new)
    )
    if a.keys() == b.keys() and all(a[k].tobytes() == b[k].tobytes() for k in a):
        return {"differs": 0}
    off = [np.nanmax(np.abs(a[k] - b[k])) / (np.nanmax(np.abs(a[k])) or 1) for k in a if k in b and k in "RGB"]
    return {"differs": 1, "relative": float(max(off, default=math.inf))}


def check_rays(old: Path, new: Path, **_: Any) -> Out:
    """Rays that both trees pass: largest differences in float64, and how float32 errors (RMS) compare."""
    (a, b), parts = (dict(np.load(f)) for f in (old, new)), []
    for name in sorted({key.rsplit(".", 2)[0] for key in a}):
        status, other = (x[f"{name}.float64.status"] for x in (a, b))
        part: Out = {"rays": len(status), "status": int((status != other).sum())}
        passed = (status == 0) & (other == 0)
        gap = np.abs(a[f"{name}.float64.ray"] - b[f"{name}.float64.ray"])[:, passed]
        part |= {"beyond 1e-12 mm": int((gap.max(0) > 1e-12).sum()), "mm": gap.max(initial=0.0)}
        off = np.abs(a[f"{name}.float64.power"] - b[f"{name}.float64.power"])[passed]
        part["power off"] = off.max(initial=0.0)
        for x, key in ((a, "old single"), (b, "new single")):  # sums of squares: of tens of rays, ratios would be noise
            both = passed & (x[f"{name}.float32.status"] == 0)
            off = (a[f"{name}.float64.ray"] - x[f"{name}.float32.ray"])[:2, both]
            part[key] = float(np.minimum(off * off, 1e-4).sum())
            part[f"{key} status"] = int((x[f"{name}.float32.status"] != status).sum())
        parts.append(part)
    found = total(parts)
    found["float32 error"] = (found.pop("new single") / max(found.pop("old single"), 1e-30)) ** 0.5
    return found


# What may not be more, summed over the files or, of `SIZES`, the largest; all else is told only.
LIMITS: dict[str, float] = {"ulp": 2.0, "derivative ulp": 4.0}
LIMITS |= dict.fromkeys(("status", "cards", "differs", "signature", "message", "operations"), 0.0)
LIMITS |= dict.fromkeys(("broken", "convergence"), 0.0) | {"mm": 1e-12, "power off": 1e-12, "float32 error": 1.1}
SIZES = ("ulp", "derivative ulp", "relative", "mm", "power off", "float32 error")
# The folder and endings of an item's goldens, the comparison of two files, and its share of --rays.
ITEMS: dict[str, tuple[str, tuple[str, ...], Callable[..., Out], float]] = {
    "onnx": ("onnx", (".onnx",), check_onnx, 1),
    "source": ("source", (".h", ".glsl"), check_source, 0.2),
    "derivatives": ("derivatives", (".onnx",), check_derivatives, 0.25),
    "wild": ("onnx", (".onnx",), check_wild, 0.1),
    "fits": ("fits", (".npz",), check_fit, 0),
    "fits-onnx": ("fits", (".onnx",), check_onnx, 0.1),
    "render": ("render", (".exr",), check_picture, 0),
    "rays": ("rays", (".npz",), check_rays, 0),
    "ghosts": ("ghosts", (".npz",), check_rays, 0),
}


def files_of(item: str, golden: Path, models: str) -> list[str]:
    """Names of what is compared, below the golden folder."""
    folder, endings, *_ = ITEMS[item]
    # What a command refuses leaves a message alone: NAME.json beside where NAME would be.
    told = {f.with_suffix("") if f.suffix == ".json" else f for f in (golden / folder).rglob("*")}
    files = sorted(f for f in told if f.name.endswith(endings) and ".part." not in f.name)
    files = [f for f in files if not f.name.endswith((".stop.onnx", ".scene.onnx"))]
    if folder == "source" and models != "*":  # those of fits are made for all models only
        files = [f for f in files if f.parent.name != "fits"]
    chosen = fnmatch.filter([f.name for f in files], f"{models}*")
    return [str(f.relative_to(golden)) for f in files if f.name in chosen or folder in ("fits", "render")]


def check(args: argparse.Namespace) -> int:
    """All items: a line for each file that fails, then one table."""
    golden, tree = args.folder.resolve(), args.tree.resolve()
    source = b"".join(f.read_bytes() for f in sorted((tree / "neurolens").rglob("*.py")))
    new = golden / "checks" / hashlib.sha256(source).hexdigest()[:12]
    table = []
    for item in args.only or ITEMS:
        folder, _, compare_files, share = ITEMS[item]
        make(tree, new, golden, folder, args.models, args.traced)
        results: list[Out] = []
        for name in progress(files_of(item, golden, args.models), item):
            file = new / "results" / f"{item}-{args.rays}" / f"{name.replace('/', '_')}.json"
            if not file.exists():
                both = golden / name, new / name
                try:
                    result = compare_files(*both, count=round(share * args.rays), cache=golden / "compiled")
                except Exception as error:
                    result = {"broken": 1, "why": f"{type(error).__name__}: {str(error)[:200]}"}
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(json.dumps(result, default=float))
            results.append(json.loads(file.read_text()))
            if any(results[-1].get(k, 0) > limit for k, limit in LIMITS.items()):
                print(f"  {item}: {name}: {', '.join(f'{k} {v}' for k, v in results[-1].items() if v)}")
        sums = {k: v for k, v in total(results).items() if k != "why" and (v or k in ("ulp", "status"))}
        failed = [k for k, limit in LIMITS.items() if sums.get(k, 0) > limit]
        told = ", ".join(f"{k} {v:.4g}" for k, v in sums.items())
        table.append(
            f"{item:<12} {len(results):>4} files  {'FAIL: ' + ', '.join(failed) if failed else 'ok':<24} {told}"
        )
    print("\n".join(table))
    return int(any("FAIL" in line for line in table))


def main() -> int:
    if sys.argv[1].startswith("_"):  # in a subprocess, see `make`
        sys.path[0] = str(Path.cwd())
        folder, item = Path(sys.argv[2]), sys.argv[3]
        (folder / item).mkdir(parents=True, exist_ok=True)
        if sys.argv[1] in ("_rays", "_ghosts"):
            trace_all(folder / item, item, int(sys.argv[4]))
        else:
            run_jobs(folder, item) if sys.argv[1] == "_jobs" else fit_all(folder / item)
        return 0
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("record", "check"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--tree", type=Path, default=Path(__file__).resolve().parents[1])
    parser.add_argument("--only", nargs="+", choices=ITEMS, default=[])
    parser.add_argument("--rays", type=int, default=1_000_000, help="inside, and as many outside (default 10^6)")
    parser.add_argument("--traced", type=int, default=10_000, help="exact rays of a lens each way (default 10^4)")
    parser.add_argument("--models", default="*", help="pattern of file names in models/, without .onnx")
    args = parser.parse_args()
    if args.command == "check":
        return check(args)
    golden, tree = args.folder.resolve(), args.tree.resolve()
    golden.mkdir(parents=True, exist_ok=True)
    (golden / "tree.json").write_text(json.dumps({"tree": str(tree)}))
    for item in ("fits", "onnx", "derivatives", "source", "render", "rays", "ghosts"):
        if not args.only or item in args.only:
            make(tree, golden, golden, item, "*", args.traced)
    return 0


if __name__ == "__main__":
    sys.exit(main())
