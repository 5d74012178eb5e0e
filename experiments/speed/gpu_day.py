"""What a GPU makes of exact lenses, of their models and of whole cameras: rays a second, frames, errors, gradients.

Run this first where there is a GPU. It takes under 8 minutes on a machine with CUDA, nvcc, torch, numpy, Jinja2 and
onnxruntime; of other packages it needs none. Other people's tracers are measured where they can be imported: the wheels
of optiland 0.6.3 and deeplens-core 2.5.6 have 16 MB (`pip install --no-deps`; `ray_peers` says what else they import).
Without a GPU everything runs in software, as C++ by g++, to see that it works: its times mean nothing.

    python -m experiments gpu-day -o found  # 8 minutes; with `--seconds 0`, without torch's compilers, about four
    cp found/gpu_day.* experiments/results && python -m experiments answers

What is measured is written at once, so that a run that is stopped leaves its tables. `--only LENS` measures one lens.
The table of 2026-11-28 is of bare glass and of gradients without parts (`graph.adjoint`): run it again.

Lenses of 2 to 56 refractions, exact and as the models that ship, are written as CUDA C++, compiled, and raced in two
kinds of work: "stored", rays read from memory and results written there; "in place", as an integrator has them, rays
made of their number and results added up. Whole cameras take film points and random numbers, make frames, and are
differentiated. What comes back is held against float64. Torch (eager, compiled, as a CUDA graph) and shaders of OpenGL
run the same lenses. Writes gpu_day.md, gpu_day.json and gpu_day.png.
"""

from __future__ import annotations

import argparse
import ctypes
import fcntl
import json
import math
import os
import re
import shutil
import statistics
import string
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from experiments import lab
from experiments.peers import ray_peers, rays
from experiments.speed import gpu
from experiments.speed.gpu import EXACT, LENSES
from neurolens.base.errors import NeurolensError
from neurolens.base.files import atomic_write_text
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.lenscamera import LensCamera as Camera
from neurolens.cameras.lensfilm import whole_camera
from neurolens.cameras.model import OnnxCamera, load_model
from neurolens.graph.c import Signature
from neurolens.graph.program import FILM_Z, RAY, STOP_RADIUS, WAVELENGTH, Program
from neurolens.graph.scalars import lower
from neurolens.graph.shading import Cuda
from neurolens.optics.analysis.plots import FIELD_COLOURS, drawing, plain_log_ticks
from neurolens.optics.lens.shot import Shot
from neurolens.programs.torch import LensCamera, Run, step_by_step

MODELS = {**LENSES, "laikin_double_gauss_50": ("ols-36", "mlp-16x2")}
LENS, CAMERA = "lens", "whole camera"
STORED, IN_PLACE, FRAME = range(3)  # kinds of work of gpu_day.cu
FRAMES = {"1080p": (1920, 1080, 1), "4K": (3840, 2160, 1), "4K, 16 samples": (3840, 2160, 16)}
SMALL = {"1080p": (48, 27, 1), "4K": (96, 54, 1), "4K, 16 samples": (96, 54, 4)}  # in software
GOALS = (  # thousand million rays a second in place; the third is ms of a frame
    ("whole camera, ols-36, thousand million rays a second", ("laikin_double_gauss_50", "ols-36"), 5.0, True),
    ("whole camera, exact double Gauss, thousand million rays a second", ("laikin_double_gauss_50", EXACT), 1.5, True),
    ("4K at 16 samples, ols-36, ms a frame", ("laikin_double_gauss_50", "ols-36"), 30.0, False),
)
FAST = ("-prec-div=false", "-prec-sqrt=false")  # roots and quotients within 2 units in the last place
THREADS, EACH, BYTES = 128, 4, 4
OPTIONS = (
    lab.count("rays", None, "of a timed call (default 8388608; in software 16384)"),
    lab.count("rounds", None, "repetitions of a timed call (default 15; in software 3)"),
    lab.count("seconds", 420, "after which torch's compilers are waited for no longer (default 420; 0: none)", 0),
    lab.option("--torch", metavar="LENS:FORM", default="", help=argparse.SUPPRESS),  # one job of a worker
    lab.ONLY,
    lab.out(),
)
_CHECKED = 20_000
_ROWS = (*RAY, WAVELENGTH)  # of a lens's rays
_SQUARE = (*RAY[:2], "u", "v", WAVELENGTH)  # of a camera's
_PEAK = """
extern "C" __global__ void chains(float *out, double first, double second)
{
    float a = first, b = second;
    float x[8];
    for (int k = 0; k < 8; k++) x[k] = threadIdx.x + k;
    for (int i = 0; i < 4096; i++)
        for (int k = 0; k < 8; k++) x[k] = fmaf(x[k], a, b);
    float sum = 0.0f;
    for (int k = 0; k < 8; k++) sum += x[k];
    out[blockIdx.x * blockDim.x + threadIdx.x] = sum;
}
"""


class Place(ctypes.Structure):
    """`Place` of gpu_day.cu: where rays of a work are."""

    _fields_ = [("low", 5 * ctypes.c_float), ("span", 5 * ctypes.c_float)] + [
        (name, ctypes.c_int) for name in ("width", "height", "each")
    ]

    @staticmethod
    def over(low: Sequence[float], high: Sequence[float], width: int = 0, height: int = 0, each: int = EACH) -> Place:
        span = [b - a for a, b in zip(low, high, strict=True)]
        return Place((5 * ctypes.c_float)(*low), (5 * ctypes.c_float)(*span), width, height, each)


class Subject(NamedTuple):
    """A lens or a camera, in one form.

    Attributes:
        program: with numbers of the call. call: these. tables: that lookups read.
        low, high: ends of the rows of a ray.
    """

    lens: str
    kind: str
    form: str
    program: Program
    call: dict[str, float]
    tables: dict[str, Tensor]
    low: tuple[float, ...]
    high: tuple[float, ...]
    refractions: int

    @property
    def name(self) -> str:
        return f"{self.lens} {self.kind} {self.form}"

    @property
    def rows(self) -> tuple[str, ...]:
        return _ROWS if self.kind == LENS else _SQUARE


def lens_subject(known: gpu.Subject, form: str) -> Subject:
    """A lens, exact or as a model."""
    domain = known.model.domain
    film, pupil = (r / math.sqrt(2.0) for r in (domain.film_radius_mm, domain.pupil_radius_mm))
    half, light = (film, film, pupil, pupil), domain.wavelength_nm
    ends = (*(-h for h in half), light[0]), (*half, light[1])
    call = {FILM_Z: domain.film_z_mm[0], STOP_RADIUS: domain.stop_radius_mm}
    return Subject(known.name, LENS, form, known.programs[form], call, {}, *ends, known.model.lens.refractions)


def camera_subject(known: gpu.Subject, form: str) -> Subject:
    """The camera of a lens, exact or of a model, focused at infinity."""
    camera = camera_of(known, form)
    graph, numbers = whole_camera(camera.film, camera.lens_graph(), mask_too=True)
    tables = {"outline": torch.from_numpy(np.ascontiguousarray(camera.film.outline.table, np.float32))}
    (x, y), light = (side / 2 for side in camera.film_mm), known.model.domain.wavelength_nm
    ends = (-x, -y, 0.0, 0.0, light[0]), (x, y, 1.0, 1.0, light[1])
    return Subject(known.name, CAMERA, form, lower(graph), numbers, tables, *ends, known.model.lens.refractions)


def shot_of(known: gpu.Subject) -> Shot:
    """The largest film of 16:9 in the domain, focused at infinity."""
    domain = known.model.domain
    side = 1.999 * domain.film_radius_mm / math.hypot(16, 9)
    return Shot((16 * side, 9 * side), math.inf, wavelength_nm=domain.wavelength_nm, runtime="onnxruntime")


def camera_of(known: gpu.Subject, form: str) -> Camera:
    """The camera of a lens in one of its forms."""
    if form == EXACT:
        return ExactCamera(known.model.lens, shot_of(known))
    return OnnxCamera(load_model(lab.MODELS / f"{known.name}.{form}.onnx"), shot_of(known))


# ---- CUDA C++. -------------------------------------------------------------------------------------------------------


def source_of(subject: Subject) -> str:
    """A written program and the work around it."""
    s = Signature.of(subject.program, "lens")
    tables = "".join(f"{name}, {name}_cells, " for name in s.tables)
    named = dict(zip(subject.rows, ("fx", "fy", "a", "b", "nm"), strict=True))
    given = [*(named[row] for row in s.per_ray), *(f"call[{k}]" for k in range(len(s.per_call)))]
    stores = [f"    out[{k} * rows + i] = float(ray.{o});" for k, o in enumerate((*s.outputs, "status"))]
    harness = string.Template(Path(__file__).with_suffix(".cu").read_text(encoding="utf-8"))
    return Cuda(subject.program, "lens").kernel() + harness.safe_substitute(
        arguments="const float *call, " + "".join(f"const float *{t}, int {t}_cells, " for t in s.tables),
        passed=f"call, {tables}", tables=tables, stores="\n".join(stores),
        given=", ".join([*given, *tables.rstrip(", ").split(", ")] if tables else given),
        sum=" + ".join(f"ray.{o}" for o in s.outputs),
    )  # fmt: skip


class Compiled:
    """A subject as a compiled library, with what the compiler made of it.

    Raises:
        Unmeasured: the compiler fails.
    """

    def __init__(self, subject: Subject, folder: Path, device: torch.device, fast: bool = False) -> None:
        self.subject, self.device, self.fast = subject, device, fast
        self.form = f"{subject.form}, fast roots" if fast else subject.form
        source = folder / f"{re.sub('[^a-z0-9]+', '_', f'{subject.name} {fast}')}.cu"
        source.write_text(source_of(subject), encoding="utf-8")
        self.library = source.with_suffix(".so")
        begun = time.perf_counter()
        if device.type == "cuda":
            command = ["nvcc", "-O3", "-arch=native", *(FAST if fast else ()), "-Xcompiler", "-fPIC"]
        else:
            command = ["g++", "-O1", "-march=native", "-fno-math-errno", "-fPIC", "-x", "c++"]
        done = subprocess.run(
            [*command, "-shared", str(source), "-o", str(self.library)], capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise lab.Unmeasured(f"experiments gpu-day: {command[0]}: {done.stderr.strip()[-500:]}")
        self.seconds = time.perf_counter() - begun
        self.run = ctypes.CDLL(str(self.library))
        s = Signature.of(subject.program, "lens")
        self.call = torch.tensor([subject.call[name] for name in s.per_call] or [0.0], device=device)
        self.tables = [subject.tables[name].to(device) for name in s.tables]
        self.order = [subject.rows.index(row) for row in s.per_ray]
        self.results = len(s.outputs) + 1

    def timed(
        self, kind: int, place: Place, given: Tensor | None, count: int, rounds: int
    ) -> tuple[list[float], Tensor]:
        """Seconds of each repetition, and what came back [results, count] or, in place, [count]; `count` threads."""
        out = torch.full((count,) if kind == IN_PLACE else (self.results, count), math.nan, device=self.device)
        pointer = ctypes.c_void_p
        tables: list[Any] = [x for t in self.tables for x in (pointer(t.data_ptr()), ctypes.c_int(len(t)))]
        read = given[self.order].to(self.device).contiguous() if given is not None else self.call
        ms = (rounds * ctypes.c_float)()
        failed = self.run.timed(
            ctypes.c_int(kind), ctypes.byref(place), pointer(read.data_ptr()), pointer(self.call.data_ptr()), *tables,
            pointer(out.data_ptr()), ctypes.c_int(count), ctypes.c_int(THREADS), ctypes.c_int(rounds), ms,
        )  # fmt: skip
        if failed or bool(out.flatten()[:: max(1, count // 997)].isnan().all()):
            raise lab.Unmeasured(
                f"experiments gpu-day: {self.subject.name}: error {failed} of CUDA, or nothing written"
            )
        return [v / 1e3 for v in ms], out

    def facts(self, kind: int) -> lab.Row:
        """Registers, spilled bytes and occupancy of a kernel; nothing on the host."""
        registers, spilled, occupancy = ctypes.c_int(), ctypes.c_int(), ctypes.c_float()
        numbers = (ctypes.byref(v) for v in (registers, spilled, occupancy))
        if self.run.facts(ctypes.c_int(kind), ctypes.c_int(THREADS), *numbers):
            return {}
        return {"registers": registers.value, "spilled": spilled.value, "occupancy": occupancy.value}

    def instructions(self) -> int | None:
        """Machine instructions of a ray that is read and stored, up to the end of its straight way."""
        if self.device.type != "cuda" or not shutil.which("cuobjdump"):
            return None
        command = ["cuobjdump", "-sass", "-fun", "lens_rays", str(self.library)]
        listed = subprocess.run(command, capture_output=True, text=True, check=False).stdout
        count = 0
        for line in listed.splitlines():
            if re.match(r"\s+/\*[0-9a-f]{4,}\*/\s", line):
                count += 1
                if re.search(r"\*/\s+EXIT", line):
                    return count
        return count or None


def place_of(subject: Subject, frame: tuple[int, int, int] = (0, 0, EACH)) -> Place:
    return Place.over(subject.low, subject.high, *frame)


def drawn(subject: Subject, count: int, seed: int = 7) -> Tensor:
    """Rays [5, count] in float32, uniform between the ends."""
    low, high = (np.array(v)[:, None] for v in (subject.low, subject.high))
    return torch.from_numpy((low + (high - low) * np.random.default_rng(seed).random((5, count))).astype(np.float32))


def camera_errors(subject: Subject, given: Tensor, found: Tensor) -> lab.Row:
    """How far a camera in float32 on the device is from its own program in float64: RMS over rays that pass both."""
    numbers = {name: torch.tensor(v, dtype=torch.float64) for name, v in subject.call.items()}
    tables = {name: t.double() for name, t in subject.tables.items()}
    exact = step_by_step(subject.program, subject.rows, numbers, tables)(given.double())
    order = [list(subject.program.outputs).index(name) for name in Signature.of(subject.program, "lens").outputs]
    status = exact[list(subject.program.outputs).index("status")]
    here = found.cpu().double()
    both = (here[-1] == 0) & (status == 0)
    off = (here[:-1] - exact[order])[:, both]
    rms = off.square().mean(1).sqrt()
    scale = exact[order][6][both].square().mean().sqrt()
    return {
        "position_um": 1e6 * float(rms[:3].square().sum().sqrt()),
        "direction_urad": 1e6 * float(rms[3:6].square().sum().sqrt()),
        "weight": float(rms[6] / scale),
        "wrong": float(((here[-1] == 0) != (status == 0)).double().mean()),
    }


class Ceiling(NamedTuple):
    """What the device can do at best, measured: bytes a second, and instructions a second of all its lanes."""

    bytes_s: float
    instructions_s: float


def ceiling(device: torch.device) -> Ceiling | None:
    """The ceilings of a GPU: a copy of 2 GB, and chains of fused multiply-adds."""
    if device.type != "cuda":
        return None
    large = torch.empty(2**29, device=device)
    other = torch.empty_like(large)
    copy_s = min(event_times(lambda: other.copy_(large), 5))
    kernel = torch.cuda._compile_kernel(_PEAK, "chains")
    blocks = 64 * torch.cuda.get_device_properties(device).multi_processor_count
    out = torch.empty(blocks * 256, device=device)
    times = event_times(lambda: kernel((blocks, 1, 1), (256, 1, 1), [out, 1.0001, 1e-6]), 5)
    return Ceiling(2 * large.nbytes / copy_s, blocks * 256 * 4096 * 8 / min(times))


def event_times(call: Callable[[], Any], rounds: int, device: str = "cuda") -> list[float]:
    """Seconds of calls: on a GPU by its events, the device idle before each; else by the clock. One is not counted."""
    found = []
    for k in range(rounds + 1):
        if device == "cuda":
            torch.cuda.synchronize()
            before, after = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            before.record()
            call()
            after.record()
            torch.cuda.synchronize()
            seconds = before.elapsed_time(after) / 1e3
        else:
            begun = time.perf_counter()
            call()
            seconds = time.perf_counter() - begun
        if k:
            found.append(seconds)
    return found


# ---- The race of CUDA C++. -------------------------------------------------------------------------------------------


def race(
    made: Compiled, size: int, rounds: int, best: Ceiling | None, frames: Mapping[str, tuple[int, int, int]]
) -> lab.Row:
    """The row of a compiled subject: seconds a ray and a frame, what the compiler made of it, what bounds it."""
    subject = made.subject
    row: lab.Row = {"lens": subject.lens, "kind": subject.kind, "refractions": subject.refractions, "form": made.form}
    row |= lab.operations_of(subject.program) | {"compile_s": made.seconds}
    place, given = place_of(subject), drawn(subject, size)
    stored, _ = made.timed(STORED, place, given, size, rounds)
    threads = max(1, size // EACH)
    used, _ = made.timed(IN_PLACE, place, None, threads, rounds)
    row["seconds"] = {"stored": [t / size for t in stored], "in place": [t / (threads * EACH) for t in used]}
    row |= {f"{name}_in_place": value for name, value in made.facts(IN_PLACE).items()} | made.facts(STORED)
    if subject.kind == CAMERA:
        row["frames"] = {}
        for name, (width, height, each) in frames.items():
            place, pixels = place_of(subject, (width, height, each)), width * height
            used, _ = made.timed(IN_PLACE, place, None, pixels, rounds)
            kept, _ = made.timed(FRAME, place, None, pixels * each, max(2, rounds // 3))
            row["frames"][name] = {"in place": [1e3 * t for t in used], "stored": [1e3 * t for t in kept]}
    row["instructions"] = made.instructions()
    if best is not None and row["instructions"]:
        bytes_of_a_ray = BYTES * (len(subject.rows) + made.results)
        row["memory"] = bytes_of_a_ray / min(row["seconds"]["stored"]) / best.bytes_s
        row["issue"] = row["instructions"] / min(row["seconds"]["in place"]) / best.instructions_s
    return row


def errors_of(made: Compiled, known: gpu.Subject, checked: gpu.Checked) -> lab.Row:
    """What came back beside float64: of a lens its exact trace, of a camera its own program."""
    if made.subject.kind == CAMERA:
        given = drawn(made.subject, _CHECKED, seed=11)
        return camera_errors(made.subject, given, made.timed(STORED, place_of(made.subject), given, _CHECKED, 1)[1])
    given = torch.from_numpy(gpu.columns_of(checked.rays))
    _, found = made.timed(STORED, place_of(made.subject), given, _CHECKED, 1)
    names = [*Signature.of(made.subject.program, "lens").outputs, "status"]
    ordered = found.cpu()[[names.index(o) for o in gpu.RESULTS]]
    rms, wrong = checked.errors(known, ordered)
    return {"rms_um": rms, "wrong": wrong}


# ---- Torch. Its compilers take minutes, which they may spend beside each other, in workers. --------------------------


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """The device to itself, of all processes of this run."""
    with (folder / "device.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def in_steps(subject: Subject, device: torch.device, size: int) -> tuple[Run, Tensor]:
    """A lens in torch, step by step, and rays for it."""
    numbers = {name: torch.tensor(number, device=device) for name, number in subject.call.items()}
    return step_by_step(subject.program, subject.rows, numbers, {}), drawn(subject, size).to(device)


def torch_row(known: gpu.Subject, form: str, device: torch.device, size: int, rounds: int) -> lab.Row:
    """A lens in torch: step by step, and as a CUDA graph of these steps; the exact one by the tracer, too."""
    subject = lens_subject(known, form)
    run, given = in_steps(subject, device, size)
    ways: dict[str, Callable[[], Any]] = {"eager": lambda: run(given)}
    if form == EXACT:
        lens, domain = known.model.lens, known.model.domain
        fx, fy, px, py, nm = given
        z = torch.full_like(fx, subject.call[FILM_Z])
        ways["tracer"] = lambda: rays.whole_trace(lens, fx, fy, z, px, py, domain.pupil_z_mm, nm)
    row: lab.Row = {"lens": known.name, "form": form, "seconds": {}}
    with torch.no_grad():
        for way, call in ways.items():
            with suppress(NeurolensError, RuntimeError):
                row["seconds"][way] = [t / size for t in event_times(call, min(rounds, 5), device.type)]
        if device.type == "cuda":
            recorded, side = torch.cuda.CUDAGraph(), torch.cuda.Stream()
            with torch.cuda.stream(side):
                run(given)
            torch.cuda.synchronize()
            with torch.cuda.graph(recorded):
                run(given)
            row["seconds"]["CUDA graph"] = [t / size for t in event_times(recorded.replay, rounds)]
            del recorded
            torch.cuda.empty_cache()
    return row


def torch_job(name: str, form: str, folder: Path, size: int, rounds: int) -> None:
    """A lens compiled by torch; what was found is a file of the folder."""
    from torch.fx.experimental.proxy_tensor import make_fx

    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    run, given = in_steps(lens_subject(gpu.subject_of(name), form), device, size)
    begun = time.perf_counter()
    compiled = torch.compile(make_fx(run)(given), dynamic=False)
    with torch.no_grad():
        first = compiled(given)
        found: lab.Row = {"compile_s": time.perf_counter() - begun}
        with alone(folder):
            found["compiled_differs"] = float((first - run(given)).nan_to_num().abs().max())
            found["compiled"] = [t / size for t in event_times(lambda: compiled(given), rounds, device.type)]
    atomic_write_text(folder / f"{name}.{form}.json", json.dumps(found))


def workers(
    jobs: Sequence[tuple[str, str]], folder: Path, args: argparse.Namespace
) -> dict[str, subprocess.Popen[str]]:
    """A process for each job; its row comes into the folder."""
    command = [sys.executable, "-m", "experiments", "gpu-day", "--rays", str(args.rays), "--rounds", str(args.rounds)]
    environment = {**os.environ, "TORCHINDUCTOR_CACHE_DIR": str(folder / "inductor"), "OMP_NUM_THREADS": "1"}
    return {
        f"{name}:{form}": subprocess.Popen(
            [*command, "--torch", f"{name}:{form}", "-o", str(folder)], cwd=lab.ROOT, env=environment, text=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        )
        for name, form in jobs
    }  # fmt: skip


def collected(running: Mapping[str, subprocess.Popen[str]], folder: Path, until: float) -> dict[str, lab.Row]:
    """What the workers found that end in time, by their jobs; of others why there is nothing."""
    rows: dict[str, lab.Row] = {}
    for key, process in running.items():
        said = ""
        try:
            _, said = process.communicate(timeout=max(0.1, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            said = "torch's compiler was stopped when the time was over"
        file = folder / f"{key.replace(':', '.')}.json"
        done = file.is_file() and not process.returncode
        rows[key] = json.loads(file.read_text(encoding="utf-8")) if done else {"reason": said.strip()[-200:]}
    return rows


# ---- Gradients, and other people's tracers. --------------------------------------------------------------------------


def gradient_row(known: gpu.Subject, form: str, device: torch.device, size: int, rounds: int) -> lab.Row:
    """Rays of `neurolens.programs.torch` and their gradients by film points and random numbers."""
    name = known.name
    spec = lab.LENSES / f"{name}.toml" if form == EXACT else lab.MODELS / f"{name}.{form}.onnx"
    shot = shot_of(known)
    begun = time.perf_counter()
    camera = LensCamera(spec, shot, device=device)
    ends = torch.tensor(shot.film_mm, device=device)
    g = torch.Generator(device).manual_seed(1)
    film = ((torch.rand(size, 2, device=device, generator=g) - 0.5) * ends).requires_grad_()
    square = torch.rand(size, 2, device=device, generator=g).requires_grad_()
    light = torch.empty(size, device=device).uniform_(*known.model.domain.wavelength_nm, generator=g)
    made = camera(film, square, light)
    value = made.origin.sum() + made.direction.sum() + made.weight.sum()
    given = (film, square)
    gradients = torch.autograd.grad(value, given, retain_graph=True)
    start_s = time.perf_counter() - begun
    forward = event_times(lambda: camera(film, square, light), rounds, device.type)
    backward = event_times(lambda: torch.autograd.grad(value, given, retain_graph=True), rounds, device.type)
    one = camera._lens.program
    back = camera._lens.adjoint(by_light=False)
    run, turn = camera._lens.forward, camera._lens.backward(by_light=False)
    rows = torch.stack([*film.detach().T, *square.detach().T, light])
    longer = torch.cat([rows, torch.ones(7, size, device=device)])
    alone_s = {
        "forward": event_times(lambda: run(rows), rounds, device.type),
        "backward": event_times(lambda: turn(longer), rounds, device.type),
    }
    some = min(size, _CHECKED // 5)
    double = LensCamera(spec, shot, dtype=torch.float64)
    again = [t.detach()[:some].cpu().double().requires_grad_() for t in given]
    exact = double(again[0], again[1], light[:some].cpu().double())
    wanted = torch.autograd.grad(exact.origin.sum() + exact.direction.sum() + exact.weight.sum(), again)
    off = [
        float((a[:some].cpu().double() - b).abs().quantile(0.99) / b.abs().mean())
        for a, b in zip(gradients, wanted, strict=True)
    ]
    return {
        "lens": name, "form": form, "operations": [sum(p.count().values()) for p in (one, back)], "start_s": start_s,
        "seconds": {"forward": [t / size for t in forward], "backward": [t / size for t in backward]},
        "kernels": {way: [t / size for t in some_s] for way, some_s in alone_s.items()}, "off": max(off),
    }  # fmt: skip


def peer_rows(name: str, device: torch.device, made: Compiled, size: int, rounds: int) -> list[lab.Row]:
    """Tracers of torch on the same rays of one wavelength, timed with the device idle before and after."""
    task = rays.task_of(name, size)
    focal = float(rays.first_order(task.lens).efl_mm)
    call, read = rays.in_torch(rays.whole_trace, torch.float64)(task)
    exact = read(call())

    def ours() -> ray_peers.Prepared:
        given = torch.from_numpy(
            np.stack([*task.film, *task.pupil, np.full(size, ray_peers.WAVELENGTH_NM)]).astype(np.float32)
        )
        names = [*Signature.of(made.subject.program, "lens").outputs, "status"]
        place = place_of(made.subject)
        seconds.extend(made.timed(STORED, place, given, size, rounds)[0])
        out = made.timed(STORED, place, given, size, 1)[1].cpu().numpy()[[names.index(o) for o in gpu.RESULTS]]
        return lambda: out, lambda found: ray_peers.Found(*rays.split(found[:6]), found[-1] == 0)

    def by_torch(task: ray_peers.Task) -> ray_peers.Prepared:
        call, read = rays.in_torch(rays.whole_trace, torch.float32, device.type)(task)
        return call, read

    ways: dict[str, Callable[[], ray_peers.Prepared]] = {
        "exact as CUDA C++": ours,
        "exact in torch": lambda: by_torch(task),
        "Optiland 0.6.3 in torch": lambda: ray_peers.optiland(task, "torch", "float32", device.type),
        "DeepLens 2.5.6": lambda: ray_peers.deeplens(task, "float32", device.type),
    }
    rows = []
    for way, prepare in ways.items():
        seconds: list[float] = []
        row: lab.Row = {"lens": name, "program": way}
        try:
            call, read = prepare()
            if not seconds:
                seconds = event_times(call, min(rounds, 7), device.type)
            found = read(call())
            row |= {"seconds": [t / size for t in seconds], **rays.errors(found, exact, focal)}
        except Exception as error:  # a program of other people raises what it likes
            row["reason"] = f"{type(error).__name__}: {error}"[:160].partition("\n")[0]
        rows.append(row)
    return rows


# ---- The page. -------------------------------------------------------------------------------------------------------


def rate(seconds: Sequence[float] | None) -> str | None:
    """Thousand million rays a second: of the best repetition (the median)."""
    return lab.best_median(*(1e-9 / f(seconds) for f in (min, statistics.median)), form=".3g") if seconds else None


def frame_ms(name: str, work: str) -> Callable[[lab.Row], str | None]:
    def cell(row: lab.Row) -> str | None:
        some = row.get("frames", {}).get(name, {}).get(work)
        return lab.best_median(min(some), statistics.median(some), form=".3g") if some else None

    return cell


def bound(row: lab.Row) -> str | None:
    """What takes more of its ceiling."""
    if row.get("memory") is None:
        return None
    larger = max(("memory", "issue"), key=lambda k: float(row[k]))
    return f"{'memory' if larger == 'memory' else 'arithmetic'}, {100 * row[larger]:.0f}%"


_MADE = (
    ("lens", "lens"), ("refractions", "refractions"), ("form", "form"),
    ("operations (roots)", lambda r: f"{r['operations']} ({r['roots']})"),
    ("stored, 10^9 rays/s", lambda r: rate(r["seconds"]["stored"])),
    ("in place, 10^9 rays/s", lambda r: rate(r["seconds"]["in place"])),
)  # fmt: skip
_BUILT = (
    ("registers", "registers"), ("spilled bytes", "spilled"), ("occupancy %", "occupancy", ".0f", 100),
    ("instructions", "instructions"), ("bound by", bound),
)  # fmt: skip
_LENSES = lab.columns(*_MADE, ("RMS um", "rms_um", ".2g"), ("wrong %", "wrong", ".2g", 100), *_BUILT)
_CAMERAS = lab.columns(
    *_MADE,
    *((f"{name}, in place, ms", frame_ms(name, "in place")) for name in FRAMES),
    *((f"{name}, stored, ms", frame_ms(name, "stored")) for name in list(FRAMES)[2:]),
    ("position um", "position_um", ".2g"), ("direction urad", "direction_urad", ".2g"),
    ("weight %", "weight", ".2g", 100), ("wrong %", "wrong", ".2g", 100), *_BUILT,
)  # fmt: skip
_TORCH = lab.columns(
    ("lens", "lens"), ("form", "form"),
    *(
        (f"{way}, 10^9 rays/s", lambda r, way=way: rate(r["seconds"].get(way)))
        for way in ("tracer", "eager", "CUDA graph")
    ),
    ("compiled, 10^9 rays/s", lambda r: rate(r["seconds"].get("compiled")) or r.get("reason")),
    ("compiled in s", "compile_s", ".0f"), ("CUDA C++ over the best", "gain", ".1f"),
)  # fmt: skip
_GRADIENTS = lab.columns(
    ("lens", "lens"), ("form", "form"), ("operations: rays, gradients", lambda r: "{}, {}".format(*r["operations"])),
    *((f"{way}, ns a ray", lambda r, way=way: _ns(r["seconds"][way])) for way in ("forward", "backward")),
    *((f"kernel {way}, ns", lambda r, way=way: _ns(r["kernels"][way])) for way in ("forward", "backward")),
    ("backward over forward", "ratio", ".2f"), ("off float64, 99%", "off", ".1g"), ("first call, s", "start_s", ".1f"),
)  # fmt: skip
_PEERS = lab.columns(
    ("lens", "lens"), ("program", "program"), ("10^9 rays/s", lambda r: rate(r.get("seconds")) or r.get("reason")),
    ("film um", "film_um", ".2g"), ("wrong %", "other", ".2g", 100), ("CUDA C++ over it", "gain", ".0f"),
)  # fmt: skip
_SHADERS = lab.columns(
    ("lens", "lens"), ("form", "form"), ("RMS um", "rms_um", ".2g"), ("wrong %", "wrong", ".2g", 100),
    *((f"{work}, 10^9 rays/s", lambda r, work=work: f"{1 / r['ns'][work][0]:.3g}") for work in gpu.WORKS),
)  # fmt: skip
_NOTES = """\
{device}; nvcc -O3, float32, {threads} threads a block, {rays} rays a call, {rounds} repetitions by events of the
device: best (median). Rays are uniform over film and pupil; those that are blocked count. "Stored": {read} bytes a ray
read, 32 or 40 written. "In place": rays made of their number, {each} for a thread, results added up. "Fast roots":
quotients and square roots within 2 units in the last place (nvcc -prec-div=false -prec-sqrt=false). Errors of lenses
are against the exact trace in float64, on {checked} rays; of cameras against their own program in float64. Bound by:
the larger share of what the device did at best, a copy at {copy} TB/s and {issue} thousand million multiply-adds a
second; the instructions of a ray are counted in the machine code of the stored kernel, which makes that an estimate."""


_MACHINE = "{processor}, {cores} cores; Python {python}, torch {torch}; the whole in {seconds:.0f} s."


def _ns(seconds: Sequence[float]) -> str:
    return lab.best_median(*(1e9 * f(seconds) for f in (min, statistics.median)), form=".3g")


def page_of(found: lab.Row) -> str:
    """The page of all that was measured."""
    rows, best = found.get("rows", []), found.get("ceiling")
    copy, issue = (f"{best[0] / 1e12:.2f}", f"{best[1] / 1e9:,.0f}") if best else ("(not measured)", "(not measured)")
    notes = _NOTES.format(
        **found["about"], threads=THREADS, each=EACH, read=BYTES * 5, checked=_CHECKED, copy=copy, issue=issue
    )
    parts = ["`python -m experiments gpu-day`", notes, _MACHINE.format(**found["machine"], seconds=found["seconds"])]
    if found["software"]:
        parts.append("**In software, without a GPU: these times say nothing about one.**")
    goals = [lab.Goal(**{k: v for k, v in goal.items() if k != "verdict"}) for goal in found.get("goals", [])]
    parts += [lab.goal_table("goal", goals)] if goals else []
    parts += ["![Error against rays a second](gpu_day.png)", "## Lenses", lab.table(_LENSES, _of(rows, LENS))]
    parts += ["Not measured: " + "; ".join(found["failed"])] if found.get("failed") else []
    parts += ["## Whole cameras", lab.table(_CAMERAS, _of(rows, CAMERA))]
    parts += ["## Gradients (`neurolens.programs.torch`)", lab.table(_GRADIENTS, found.get("gradients", []))]
    timed = [row for row in found.get("torch", []) if row["seconds"]]
    left = ", ".join(f"{r['lens']} {r['form']}" for r in found.get("torch", []) if not r["seconds"])
    parts += ["## Lenses in torch", lab.table(_TORCH, timed) if timed else ""]
    parts += [f"Not measured, for the time was over before torch had compiled them: {left}." if left else ""]
    parts += [
        "## Other people's tracers, on the same rays of one wavelength",
        lab.table(_PEERS, found.get("peers", [])),
    ]
    shaders = found.get("shaders", "Not measured.")
    what = shaders if isinstance(shaders, str) else lab.table(_SHADERS, shaders)
    return lab.page("# Lenses on a GPU", *parts, "## As compute shaders of OpenGL", what)


def _of(rows: Sequence[lab.Row], kind: str) -> list[lab.Row]:
    return [row for row in rows if row["kind"] == kind]


def plot(found: lab.Row, file: Path) -> None:
    """Errors on the film against rays a second, a point a form and language."""
    from matplotlib.lines import Line2D

    blue, orange, green, _, pink, *_, grey = FIELD_COLOURS
    key = {"exact": blue, "polynomial": green, "network": orange, "Optiland, DeepLens": pink}
    if any(row["seconds"] for row in found.get("torch", [])):
        key["torch"] = grey
    marks = dict(zip(MODELS, "os^D", strict=False))
    rates = {(r["lens"], r["form"]): r for r in _of(found.get("rows", []), LENS)}
    with drawing(file, 7.5, 4.8, found["about"]["device"]) as figure:
        axes = figure.subplots()
        for (lens, form), row in rates.items():
            colour = blue if form.startswith(EXACT) else green if form.startswith("ols") else orange
            face = "none" if "fast" in form else colour
            axes.plot(1e-9 / min(row["seconds"]["in place"]), row["rms_um"], marks[lens], mfc=face, color=colour, ms=8)
        for row in found.get("torch", []):
            base = rates.get((row["lens"], row["form"]))
            for way in ("eager", "compiled"):
                if base and row["seconds"].get(way):
                    axes.plot(1e-9 / min(row["seconds"][way]), base["rms_um"], marks[row["lens"]], color=grey, ms=6)
        for row in found.get("peers", []):
            if row.get("seconds") and row["program"][0] in "OD":
                axes.plot(1e-9 / min(row["seconds"]), max(row["film_um"], 1e-3), marks[row["lens"]], color=pink, ms=6)
        lines = [Line2D([], [], color=c, marker="s", ls="", label=name) for name, c in key.items()]
        counts = {r["lens"]: r["refractions"] for r in found.get("rows", [])}
        lines += [
            Line2D([], [], color="k", marker=marks[name], ls="", mfc="none", label=f"{count} refractions")
            for name, count in counts.items()
        ]
        figure.legend(handles=lines, loc="outside lower center", ncols=4)
        axes.set(xscale="log", yscale="log", ylabel="RMS error on the film, um")
        axes.set_xlabel("10^9 rays a second, in place (hollow: with fast roots)")
        plain_log_ticks(axes.xaxis, axes.yaxis)
        axes.grid()


def run(args: argparse.Namespace) -> None:
    """Measure everything, or one job of a worker, and write what was found."""
    lab.quiet_glasses()
    cuda = torch.cuda.is_available() and shutil.which("nvcc") is not None
    device = torch.device("cuda" if cuda else "cpu")
    args.rays = args.rays or (2**23 if cuda else 2**14)
    args.rounds = args.rounds or (15 if cuda else 3)
    if args.torch:
        name, form = args.torch.split(":")
        torch_job(name, form, args.out, args.rays, args.rounds)
        return
    torch.set_num_threads(1)  # its threads would wait for those of the workers
    lenses = lab.chosen(list(MODELS), str, args.only, "gpu-day")
    args.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="neurolens-gpu-day-") as place:
        Day(args, lenses, device, Path(place)).run()


class Day:
    """The measurements in their order; what is measured is written at once."""

    def __init__(self, args: argparse.Namespace, lenses: list[str], device: torch.device, folder: Path) -> None:
        self.args, self.lenses, self.device, self.folder = args, lenses, device, folder
        self.begun, self.cuda = time.monotonic(), device.type == "cuda"
        name = torch.cuda.get_device_name() if self.cuda else "software (g++)"
        about = {"device": name, "rays": args.rays, "rounds": args.rounds}
        self.found: lab.Row = {"about": about, "software": not self.cuda, "machine": lab.machine()}
        self.forms = [(name, form) for name in lenses for form in (EXACT, *MODELS[name])]

    def run(self) -> None:
        """All of it."""
        with alone(self.folder):  # workers compile meanwhile, and wait with their clocks
            running = workers(self.forms if self.args.seconds else (), self.folder, self.args)
            known = {name: gpu.subject_of(name) for name in self.lenses}
            made = self._compiled(known)
            self._race(known, made)
            self._gradients(known)
            self._peers({m.subject.lens: m for m in made if (m.subject.kind, m.form) == (LENS, EXACT)})
            self.found["shaders"] = shaders_of(known.values(), self.args)
            self._say("shaders")
            self._torch(known)
        compiled = collected(running, self.folder, self.begun + self.args.seconds)
        mine = {(r["lens"], r["form"]): min(r["seconds"]["stored"]) for r in _of(self.found["rows"], LENS)}
        for row in self.found["torch"]:
            row |= compiled.get(f"{row['lens']}:{row['form']}", {})
            if times := row.pop("compiled", None):
                row["seconds"]["compiled"] = times
            if row["seconds"]:
                row["gain"] = min(min(t) for t in row["seconds"].values()) / mine[row["lens"], row["form"]]
        self._say("torch's compiler")
        print(page_of(self.found))

    @contextmanager
    def _unless_it_fails(self, what: str) -> Iterator[None]:
        """The others are measured all the same."""
        try:
            yield
        except Exception as error:  # of compilers and devices that nobody has tried
            self.found.setdefault("failed", []).append(f"{what}: {type(error).__name__}: {error}"[:300])

    def _say(self, what: str) -> None:
        """Write what was measured so far."""
        self.found["seconds"] = time.monotonic() - self.begun
        plot(self.found, self.args.out / "gpu_day.png")
        lab.write_results(self.args.out, "gpu_day", page_of(self.found), self.found)
        if not self.args.quiet:
            print(f"{self.found['seconds']:5.0f} s  {what}", file=sys.stderr, flush=True)

    def _compiled(self, known: Mapping[str, gpu.Subject]) -> list[Compiled]:
        subjects = [make(known[name], form) for make in (lens_subject, camera_subject) for name, form in self.forms]
        ways = [(s, fast) for s in subjects for fast in ((False, True) if self.cuda else (False,))]
        with ThreadPoolExecutor(max(1, (os.cpu_count() or 1) - 2)) as pool:
            made = list(pool.map(lambda way: Compiled(way[0], self.folder, self.device, way[1]), ways))
        self._say(f"{len(made)} programs compiled")
        return made

    def _race(self, known: Mapping[str, gpu.Subject], compiled: Sequence[Compiled]) -> None:
        best = self.found["ceiling"] = ceiling(self.device)
        frames, rows = FRAMES if self.cuda else SMALL, self.found.setdefault("rows", [])
        checked = {name: gpu.Checked.of(one, one.model.domain.film_z_mm[0]) for name, one in known.items()}
        for made in compiled:
            with self._unless_it_fails(f"{made.subject.name}, {made.form}"):
                row = race(made, self.args.rays, self.args.rounds, best, frames)
                rows.append(row | errors_of(made, known[made.subject.lens], checked[made.subject.lens]))
        cameras = {(r["lens"], r["form"]): r for r in _of(rows, CAMERA)}
        self.found["goals"] = [
            lab.Goal(text, wanted, value_of(cameras[key], at_least), at_least).to_dict()
            for text, key, wanted, at_least in (GOALS if self.cuda else ())
            if key in cameras
        ]
        self._say("CUDA C++")

    def _gradients(self, known: Mapping[str, gpu.Subject]) -> None:
        rows = self.found.setdefault("gradients", [])
        for name, form in self.forms:
            with self._unless_it_fails(f"gradients of {name}, {form}"):
                row = gradient_row(known[name], form, self.device, self.args.rays // 2, self.args.rounds)
                row["ratio"] = min(row["kernels"]["backward"]) / min(row["kernels"]["forward"])
                rows.append(row)
        self._say("gradients")

    def _torch(self, known: Mapping[str, gpu.Subject]) -> None:
        rows = self.found.setdefault("torch", [])
        for name, form in self.forms:
            with self._unless_it_fails(f"{name}, {form} in torch"):
                rows.append(torch_row(known[name], form, self.device, self.args.rays, self.args.rounds))
        self._say("torch")

    def _peers(self, exact: Mapping[str, Compiled]) -> None:
        rows = self.found.setdefault("peers", [])
        for name in (n for n in self.lenses if n in rays.CASES):
            some = peer_rows(name, self.device, exact[name], min(self.args.rays, 2**20), self.args.rounds)
            for row in (r for r in some if r.get("seconds")):
                row["gain"] = min(row["seconds"]) / min(some[0]["seconds"])
            rows += some
        self._say("other tracers")


def value_of(row: lab.Row, at_least: bool) -> float:
    """Of a camera: thousand million rays a second in place, or ms of the largest frame."""
    return 1e-9 / min(row["seconds"]["in place"]) if at_least else min(row["frames"]["4K, 16 samples"]["in place"])


def shaders_of(subjects: Collection[gpu.Subject], args: argparse.Namespace) -> list[lab.Row] | str:
    """The same lenses as shaders, or why they cannot be measured."""
    with tempfile.TemporaryDirectory(prefix="neurolens-gpu-") as folder:
        raced = gpu.ShaderRace(Path(folder), min(args.rays, 2**21))
        try:
            for subject in subjects:
                raced.add(subject)
            result = raced.run(max(3, args.rounds // 3))
            rows = [row for subject in subjects for row in gpu.rows_of(subject, raced, result)]
        except NeurolensError as error:
            return f"Not measured: {error}"
    return [row | {"renderer": result["renderer"]} for row in rows if row["form"] != gpu.NOTHING]
