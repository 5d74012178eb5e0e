"""Programs run in shading languages by the compilers that are here: Slang's on the processor, naga with Vulkan in
software, glslang for HLSL, g++ for CUDA, and for VEX that is rewritten as C++. A text is compiled once."""

from __future__ import annotations

import ctypes
import itertools
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import cache, lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.graph.c import Signature, literal
from neurolens.graph.program import Program
from neurolens.models.source import WRITERS

Rows = dict[str, NDArray[np.float32]]
GROUP = 64
_NUMBER = itertools.count()
# What VEX has and C++ has not.
_VEX = """
#include <algorithm>
#include <cmath>
#include <vector>
using std::floor; using std::max; using std::min; using std::sqrt;
typedef const std::vector<float> &floats;
inline int len(floats v) { return (int)v.size(); }
inline int clamp(int x, int low, int high) { return x < low ? low : x > high ? high : x; }
"""


class Missing(Exception):
    """A compiler, or what runs its results, is not on this machine; the message says which."""


def _package(name: str, language: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        raise Missing(f"{language} is not run here: no {name} (pip install '.[shading]')") from None


class Given:
    """What a call takes: rows of rays, tables of the caller, the band or the numbers of the state; flags for g++."""

    def __init__(
        self, program: Program, rays: Mapping[str, Any], band: int = 0, state: Sequence[float] = (), flags: str = "-O0"
    ) -> None:
        self.program, self.flags, s = program, flags.split(), Signature.of(program, "lens")
        self.count = max(np.size(rays[i]) for i in s.inputs)
        self.rays = np.stack([np.broadcast_to(np.float32(rays[i]), self.count) for i in s.inputs])
        self.tables = {t: np.ascontiguousarray(rays[t], np.float32) for t in s.tables}
        self.extra = [f"lens_at({', '.join(map(literal, state))})"] if s.state else [str(band)] * (s.bands > 1)
        self.names = (*s.outputs, *["status"] * s.status)

    def text(self, language: str) -> str:
        return WRITERS[language](self.program, "lens", ["A program in a test."])

    def call(self, ray: str, tables: Sequence[str]) -> str:
        """The arguments that go in; `ray` is the expression of an input by its number."""
        return ", ".join([*(ray.format(k) for k in range(len(self.rays))), *tables, *self.extra])

    def stored(self, place: str, ray: str, whole: str) -> str:
        """Statements that store the results; `ray` is a result by its name, `whole` makes a float of the status."""
        values = [whole.format(ray.format(o)) if o == "status" else ray.format(o) for o in self.names]
        return "".join(f"    {place.format(k)} = {value};\n" for k, value in enumerate(values))

    def declared(self) -> str:
        """Variables for results that are arguments, NAME_."""
        return "".join(f"    {'int' if o == 'status' else 'float'} {o}_;\n" for o in self.names)

    def found(self, rows: NDArray[np.float32]) -> Rows:
        return dict(zip(self.names, rows.reshape(len(self.names), -1), strict=True))


# ---- WGSL, and SPIR-V of HLSL, by wgpu ----


@cache
def _webgpu() -> Any:
    wgpu = _package("wgpu", "WGSL")
    try:
        return wgpu.gpu.request_adapter_sync().request_device_sync()
    except RuntimeError as reason:
        raise Missing(f"WGSL is not run here: {reason} (Debian: mesa-vulkan-drivers)") from None


def in_wgsl(given: Given) -> Rows:
    n = given.count
    tables = [f"{t}_here" for t in given.tables]
    code = given.text("wgsl") + "".join(
        f"@group(0) @binding({k + 2}) var {t}: texture_2d<f32>;\n" for k, t in enumerate(tables)
    )
    code += f"""
@group(0) @binding(0) var<storage, read> rays: array<f32>;
@group(0) @binding(1) var<storage, read_write> found: array<f32>;
@compute @workgroup_size({GROUP}) fn run(@builtin(global_invocation_id) id: vec3<u32>) {{
    let i = id.x;
    if (i >= {n}u) {{ return; }}
    let one = lens({given.call(f"rays[{{}}u * {n}u + i]", tables)});
{given.stored(f"found[{{}}u * {n}u + i]", "one.{}", "f32({})")}}}
"""
    return _run_webgpu(code, given)


@lru_cache(8)
def _pipeline(code: str | bytes) -> Any:
    module = {"module": _webgpu().create_shader_module(code=code), "entry_point": "run"}
    return _webgpu().create_compute_pipeline(layout="auto", compute=module)


def _run_webgpu(code: str | bytes, given: Given) -> Rows:
    device, size = _webgpu(), 4 * given.count * len(given.names)
    rays = device.create_buffer_with_data(data=given.rays.tobytes(), usage="STORAGE")
    found = device.create_buffer(size=size, usage="STORAGE | COPY_SRC")
    resources: list[Any] = [{"buffer": rays}, {"buffer": found}]
    for table in given.tables.values():
        (height, width), usage = table.shape, "TEXTURE_BINDING | COPY_DST"
        texture = device.create_texture(size=(width, height, 1), format="r32float", usage=usage)
        layout = {"bytes_per_row": 4 * width}
        device.queue.write_texture({"texture": texture}, table.tobytes(), layout, (width, height, 1))
        resources.append(texture.create_view())
    pipeline = _pipeline(code)
    entries = [{"binding": k, "resource": r} for k, r in enumerate(resources)]
    encoder = device.create_command_encoder()
    work = encoder.begin_compute_pass()
    work.set_pipeline(pipeline)
    work.set_bind_group(0, device.create_bind_group(layout=pipeline.get_bind_group_layout(0), entries=entries))
    work.dispatch_workgroups(-(-given.count // GROUP))
    work.end()
    device.queue.submit([encoder.finish()])
    return given.found(np.frombuffer(device.queue.read_buffer(found), np.float32))


# ---- HLSL and Slang ----


def _compute_shader(language: str, given: Given, entry: str, at: str) -> str:
    """A compute shader; `entry` and `at` come before its function and before what is bound at a number."""
    n, kind = given.count, "Texture2D" if language == "hlsl" else "StructuredBuffer<float>"
    tables = [f"{t}_here" for t in given.tables]
    bound = ["StructuredBuffer<float> rays", "RWStructuredBuffer<float> found", *(f"{kind} {t}" for t in tables)]
    call = given.call(f"rays[{{}}u * {n}u + i]", tables)
    head = "".join(f"{at.format(k)} {what};\n" for k, what in enumerate(bound))
    return f"""{given.text(language)}{head}
{entry} [numthreads({GROUP}, 1, 1)] void run(uint3 id : SV_DispatchThreadID) {{
    uint i = id.x;
    if (i >= {n}u) return;
{given.declared()}    lens({call}, {", ".join(f"{o}_" for o in given.names)});
{given.stored(f"found[{{}}u * {n}u + i]", "{}_", "float({})")}}}
"""


def in_hlsl(given: Given) -> Rows:
    """Compile the text by glslang to SPIR-V, which naga reads."""
    _webgpu()
    glslang = shutil.which("glslangValidator")
    if glslang is None:
        raise Missing("HLSL is not compiled here: no glslangValidator (Debian: glslang-tools)")
    return _run_webgpu(_spirv(glslang, _compute_shader("hlsl", given, "", "[[vk::binding({}, 0)]]")), given)


@lru_cache(8)
def _spirv(glslang: str, code: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        text, binary = Path(folder) / "lens.hlsl", Path(folder) / "lens.spv"
        text.write_text(code)
        command: list[Any] = [glslang, "-D", "-V", "-S", "comp", "-e", "run", text, "-o", binary]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout
        return binary.read_bytes()


@cache
def _slang() -> Any:
    slangpy = _package("slangpy", "Slang")
    return slangpy, slangpy.Device(type=slangpy.DeviceType.cpu, enable_debug_layers=False)


@lru_cache(8)
def _kernel(text: str) -> Any:
    _, device = _slang()
    module = device.load_module_from_source(f"lens_{next(_NUMBER)}", text)
    return device.create_compute_kernel(device.link_program([module], [module.entry_point("run")]))


def in_slang(given: Given, language: str = "slang") -> Rows:
    slangpy, device = _slang()
    usage = slangpy.BufferUsage.shader_resource | slangpy.BufferUsage.unordered_access

    def buffer(values: NDArray[np.float32]) -> Any:
        return device.create_buffer(element_count=values.size, struct_size=4, usage=usage, data=values.reshape(-1))

    kernel = _kernel(_compute_shader(language, given, '[shader("compute")]', ""))
    found = buffer(np.zeros(given.count * len(given.names), np.float32))
    tables = {f"{t}_here": buffer(values) for t, values in given.tables.items()}
    kernel.dispatch([given.count, 1, 1], {"rays": buffer(given.rays), "found": found, **tables})
    return given.found(found.to_numpy().view(np.float32))


def in_slang_as_hlsl(given: Given) -> Rows:
    """HLSL by Slang's compiler; the processor has no textures there."""
    if given.tables:
        raise Missing("Slang has no textures on the processor")
    return in_slang(given, "hlsl")


# ---- CUDA and VEX as C++ ----


def in_cuda(given: Given) -> Rows:
    tables = [f"{t}, {len(values)}" for t, values in given.tables.items()]
    body = f"    const lens_ray one = lens({given.call('rays[{} * n + i]', tables)});\n"
    return _run_cpp(given.text("cuda"), "", body, "one.{}", given)


def in_vex(given: Given) -> Rows:
    made = "".join(f"    const std::vector<float> {t}_here({t}, {t} + {v.size});\n" for t, v in given.tables.items())
    call = given.call("rays[{} * n + i]", [f"{t}_here" for t in given.tables])
    body = f"{given.declared()}    lens({call}, {', '.join(f'{o}_' for o in given.names)});\n"
    return _run_cpp(vex_as_cpp(given.text("vex")), made, body, "{}_", given, "-fsingle-precision-constant")


def vex_as_cpp(text: str) -> str:
    """VEX as C++: arguments between commas, results as references, arrays as vectors."""
    for head in re.findall(r"^(?:float|void) \w+\([^)]*\)$", text, re.MULTILINE):
        assert "," not in head
        cpp = re.sub(r"\bexport (float|int) ", r"\1 &", head.replace(";", ","))
        text = text.replace(head, "static " + re.sub(r"\bfloat (\w+)\[\]", r"floats \1", cpp))
    return _VEX + text


@lru_cache(8)
def _compiled(text: str, flags: tuple[str, ...]) -> Any:
    compiler = shutil.which("g++")
    if compiler is None:
        raise Missing("CUDA and VEX are not compiled here: no g++")
    command = [compiler, "-x", "c++", "-std=c++14", "-Wall", "-Wextra", "-Werror", *flags]
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "lens.so"
        done = subprocess.run(
            [*command, "-fPIC", "-shared", "-", "-o", library], input=text, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return ctypes.CDLL(str(library)).run


def _run_cpp(text: str, before: str, body: str, result: str, given: Given, *flags: str) -> Rows:
    """Run a statement for each ray in a function of arrays."""
    tables = "".join(f", const float *{t}" for t in given.tables)
    text += f"""
#include <cstddef>
extern "C" void run(size_t n, const float *rays, float *found{tables})
{{
{before}    for (size_t i = 0; i < n; i++) {{
{body}{given.stored("found[{} * n + i]", result, "(float)({})")}    }}
}}
"""
    function = _compiled(text, (*given.flags, *flags))
    found = np.empty((len(given.names), given.count), np.float32)
    arrays = [given.rays, found, *given.tables.values()]
    function.argtypes = [ctypes.c_size_t] + [ctypes.c_void_p] * len(arrays)
    function(given.count, *(a.ctypes.data for a in arrays))
    return given.found(found)


RUN: dict[str, Callable[[Given], Rows]] = {
    "cuda": in_cuda, "vex": in_vex, "wgsl": in_wgsl, "hlsl": in_hlsl, "slang": in_slang,
    "hlsl by slang": in_slang_as_hlsl,
}  # fmt: skip
