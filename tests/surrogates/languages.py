"""Programs run in shading languages by the compilers that are here: Slang's on the processor, naga with Vulkan in
software, glslang for HLSL, g++ for CUDA and for VEX in a disguise of C++."""

import ctypes
import re
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from neurolens.graph.c import Signature, literal
from neurolens.graph.program import Program
from neurolens.surrogates.source import WRITERS

Rows = dict[str, NDArray[np.float32]]
GROUP = 64
# VEX as C++: vectors for arrays, references for what is exported, and single precision for numbers without a suffix.
VEX_SHIM = """
#include <algorithm>
#include <cmath>
#include <vector>
using std::floor; using std::max; using std::min; using std::sqrt;
typedef const std::vector<float> &floats;
inline int len(floats v) { return (int)v.size(); }
inline int clamp(int x, int low, int high) { return x < low ? low : x > high ? high : x; }
"""


def text_of(language: str, program: Program) -> str:
    return WRITERS[language](program, "lens", ["A program in a test."])


class Given:
    """What a call takes: rows of rays, the band or the state, the table of the caller."""

    def __init__(self, program: Program, rays: Mapping[str, Any], band: int = 0, state: Sequence[float] = ()) -> None:
        self.signature = s = Signature.of(program, "lens")
        count = max(np.size(rays[i]) for i in s.inputs)
        self.rays = np.stack([np.broadcast_to(np.float32(rays[i]), count) for i in s.inputs])
        self.tables = [np.asarray(rays[t], np.float32) for t in s.tables]
        self.extra = [f"lens_at({', '.join(map(literal, state))})"] if s.state else [str(band)] * (s.bands > 1)
        self.names = (*s.outputs, *["status"] * s.status)

    def call(self, ray: str, tables: Sequence[str]) -> str:
        """The arguments that go in; `ray` is the expression of an input, by its number."""
        return ", ".join([*(ray.format(k) for k in range(len(self.rays))), *tables, *self.extra])

    def found(self, rows: NDArray[np.float32]) -> Rows:
        return dict(zip(self.names, rows.reshape(len(self.names), -1), strict=True))


def outputs(given: Given, found: str, status: str, ray: str) -> str:
    """Statements that store the results."""
    whole = [status.format(ray.format(o)) if o == "status" else ray.format(o) for o in given.names]
    return "".join(f"    {found.format(k)} = {value};\n" for k, value in enumerate(whole))


# ---- WGSL, and SPIR-V of HLSL, by wgpu ----


@cache
def webgpu() -> Any:
    wgpu = pytest.importorskip("wgpu", reason="WGSL is not run here: no wgpu")
    try:
        return wgpu, wgpu.gpu.request_adapter_sync().request_device_sync()
    except RuntimeError as reason:
        pytest.skip(f"WGSL is not run here: {reason} (Debian: mesa-vulkan-drivers)")


def in_wgsl(program: Program, given: Given) -> Rows:
    s, n = given.signature, given.rays.shape[1]
    code = text_of("wgsl", program) + "".join(
        f"@group(0) @binding({k + 2}) var {t}_of_test: texture_2d<f32>;\n" for k, t in enumerate(s.tables)
    )
    code += (
        "@group(0) @binding(0) var<storage, read> rays: array<f32>;\n"
        "@group(0) @binding(1) var<storage, read_write> found: array<f32>;\n"
        f"@compute @workgroup_size({GROUP}) fn run(@builtin(global_invocation_id) id: vec3<u32>) {{\n"
        f"    let i = id.x;\n    if (i >= {n}u) {{ return; }}\n"
        f"    let one = lens({given.call(f'rays[{{}}u * {n}u + i]', [f'{t}_of_test' for t in s.tables])});\n"
        + outputs(given, f"found[{{}}u * {n}u + i]", "f32({})", "one.{}")
        + "}\n"
    )
    return run_webgpu(code, given)


def run_webgpu(code: str | bytes, given: Given) -> Rows:
    wgpu, device = webgpu()
    size, usage = 4 * given.rays.shape[1] * len(given.names), wgpu.BufferUsage
    buffers = [
        device.create_buffer_with_data(data=given.rays.tobytes(), usage=usage.STORAGE),
        device.create_buffer(size=size, usage=usage.STORAGE | usage.COPY_SRC),
    ]
    resources: list[Any] = [{"buffer": b, "offset": 0, "size": b.size} for b in buffers]
    for table in given.tables:
        height, width = table.shape
        texture = device.create_texture(
            size=(width, height, 1),
            format="r32float",
            usage=wgpu.TextureUsage.TEXTURE_BINDING | wgpu.TextureUsage.COPY_DST,
        )
        layout = {"bytes_per_row": 4 * width, "rows_per_image": height}
        device.queue.write_texture({"texture": texture}, table.tobytes(), layout, (width, height, 1))
        resources.append(texture.create_view())
    pipeline = device.create_compute_pipeline(
        layout="auto", compute={"module": device.create_shader_module(code=code), "entry_point": "run"}
    )
    entries = [{"binding": k, "resource": r} for k, r in enumerate(resources)]
    group = device.create_bind_group(layout=pipeline.get_bind_group_layout(0), entries=entries)
    encoder = device.create_command_encoder()
    work = encoder.begin_compute_pass()
    work.set_pipeline(pipeline)
    work.set_bind_group(0, group)
    work.dispatch_workgroups(-(-given.rays.shape[1] // GROUP))
    work.end()
    device.queue.submit([encoder.finish()])
    return given.found(np.frombuffer(device.queue.read_buffer(buffers[1]), np.float32))


def hlsl_shader(language: str, program: Program, given: Given, vulkan: bool) -> str:
    """A compute shader in HLSL or Slang."""
    s, n = given.signature, given.rays.shape[1]
    at = (lambda k: f"[[vk::binding({k}, 0)]] ") if vulkan else (lambda k: "")
    kind = "Texture2D" if language == "hlsl" else "StructuredBuffer<float>"
    declared = f"{at(0)}StructuredBuffer<float> rays;\n{at(1)}RWStructuredBuffer<float> found;\n"
    declared += "".join(f"{at(k + 2)}{kind} {t}_of_test;\n" for k, t in enumerate(s.tables))
    results = "".join(f"    {'int' if o == 'status' else 'float'} {o}_;\n" for o in given.names)
    call = given.call(f"rays[{{}}u * {n}u + i]", [f"{t}_of_test" for t in s.tables])
    return (
        text_of(language, program)
        + declared
        + f'[shader("compute")] [numthreads({GROUP}, 1, 1)] void run(uint3 id : SV_DispatchThreadID) {{\n'.replace(
            '[shader("compute")] ', "" if vulkan else '[shader("compute")] '
        )
        + f"    uint i = id.x;\n    if (i >= {n}u) return;\n{results}"
        + f"    lens({call}, {', '.join(f'{o}_' for o in given.names)});\n"
        + outputs(given, f"found[{{}}u * {n}u + i]", "float({})", "{}_")
        + "}\n"
    )


def in_hlsl(program: Program, given: Given) -> Rows:
    """By glslang to SPIR-V, which naga reads."""
    glslang = shutil.which("glslangValidator")
    if glslang is None:
        pytest.skip("HLSL is not compiled here: no glslangValidator (Debian: glslang-tools)")
    with tempfile.TemporaryDirectory() as folder:
        text, binary = Path(folder) / "lens.hlsl", Path(folder) / "lens.spv"
        text.write_text(hlsl_shader("hlsl", program, given, vulkan=True))
        command = [glslang, "-D", "-V", "-S", "comp", "-e", "run", text, "-o", binary]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout
        return run_webgpu(binary.read_bytes(), given)


# ---- Slang on the processor ----


@cache
def slang() -> Any:
    slangpy = pytest.importorskip("slangpy", reason="Slang is not compiled here: no slangpy")
    return slangpy, slangpy.Device(type=slangpy.DeviceType.cpu, enable_debug_layers=False)


def in_slang(program: Program, given: Given, language: str = "slang") -> Rows:
    """HLSL without tables, too: here there are no textures on the processor."""
    slangpy, device = slang()
    usage = slangpy.BufferUsage.shader_resource | slangpy.BufferUsage.unordered_access
    n = given.rays.shape[1]

    def buffer(values: NDArray[np.float32]) -> Any:
        return device.create_buffer(element_count=values.size, struct_size=4, usage=usage, data=values.reshape(-1))

    module = device.load_module_from_source(
        f"{language}_{id(given)}", hlsl_shader(language, program, given, vulkan=False)
    )
    kernel = device.create_compute_kernel(device.link_program([module], [module.entry_point("run")]))
    found = buffer(np.zeros(n * len(given.names), np.float32))
    tables = {f"{t}_of_test": buffer(v) for t, v in zip(given.signature.tables, given.tables, strict=True)}
    kernel.dispatch([n, 1, 1], {"rays": buffer(given.rays), "found": found, **tables})
    return given.found(found.to_numpy().view(np.float32))


# ---- CUDA and VEX as C++ ----


def in_cuda(program: Program, given: Given) -> Rows:
    code = text_of("cuda", program) + _loop(given, "    lens_ray one = lens({call});\n", "one.{}")
    return run_cpp(code, given, [])


def in_vex(program: Program, given: Given) -> Rows:
    text = vex_as_cpp(text_of("vex", program))
    kinds = "".join(f"    {'int' if o == 'status' else 'float'} {o}_;\n" for o in given.names)
    call = f"{kinds}    lens({{call}}, {', '.join(f'{o}_' for o in given.names)});\n"
    return run_cpp(f"{text}{_loop(given, call, '{}_')}", given, ["-fsingle-precision-constant"])


def vex_as_cpp(text: str) -> str:
    """VEX as C++, by its own grammar of what is written: anything else of C stops the compiler."""
    heads = re.findall(r"^(?:float|void) \w+\([^)]*\)$", text, re.MULTILINE)
    for head in heads:
        assert "," not in head
        cpp = re.sub(r"\bexport (float|int) ", r"\1 &", head.replace(";", ","))
        text = text.replace(head, re.sub(r"\bfloat (\w+)\[\]", r"floats \1", cpp))
    return VEX_SHIM + text


def _loop(given: Given, call: str, result: str) -> str:
    """A function of arrays around the call; a table is a pointer and its cells (CUDA), or made a vector (VEX)."""
    s = given.signature
    vectors = "floats" in call or "_;" in call
    tables = (
        "".join(
            f"    std::vector<float> {t}_v({t}, {t} + {v.size});\n" for t, v in zip(s.tables, given.tables, strict=True)
        )
        if vectors
        else ""
    )
    named = [f"{t}_v" if vectors else f"{t}, {len(v)}" for t, v in zip(s.tables, given.tables, strict=True)]
    pointers = "".join(f", const float *{t}" for t in s.tables)
    body = call.replace("{call}", given.call("rays[{} * n + i]", named))
    return (
        f'\n#include <cstddef>\nextern "C" void run(size_t n, const float *rays, float *found{pointers})\n{{\n{tables}'
        f"    for (size_t i = 0; i < n; i++) {{\n{body}"
        + outputs(given, "found[{} * n + i]", "(float)({})", result)
        + "    }\n}\n"
    )


def run_cpp(code: str, given: Given, flags: Sequence[str]) -> Rows:
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("CUDA and VEX are not compiled here: no g++")
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "lens.so"
        command = [compiler, "-x", "c++", "-std=c++14", "-O1", "-Wall", "-Wextra", "-Werror", *flags]
        command += ["-fPIC", "-shared", "-", "-o", str(library)]
        done = subprocess.run(command, input=code, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[:3000]
        run = ctypes.CDLL(str(library)).run
        found = np.empty((len(given.names), given.rays.shape[1]), np.float32)
        arrays = [given.rays, found, *given.tables]
        run.argtypes = [ctypes.c_size_t] + [ctypes.c_void_p] * len(arrays)
        run(given.rays.shape[1], *(a.ctypes.data for a in map(np.ascontiguousarray, arrays)))
    return given.found(found)


RUN = {"wgsl": in_wgsl, "hlsl": in_hlsl, "slang": in_slang, "cuda": in_cuda, "vex": in_vex}
