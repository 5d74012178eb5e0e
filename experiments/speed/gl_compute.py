"""Compute shaders of OpenGL 4.3 without a window, by EGL: run once, or raced.

`python gl_compute.py SHADER RAYS.npy OUT.npy ROWS`, in tests: Mesa's own display. Rays are [K, N] float32, bound as
buffer 0; the result [ROWS, N] is buffer 1. `python gl_compute.py FOLDER ROUNDS`: see `race`. A process of its own,
because drivers bring libraries that torch has in other versions. Exit code 3 where there is no such OpenGL, with the
reason on stderr; 4 where a shader does not compile.
"""

import ctypes
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

GROUP = 64
_SECONDS = 0.005  # of calls in a timed pass: short ones fall between interruptions
_SURFACELESS_MESA, _DEVICE, _OPENGL_API = 0x31DD, 0x313F, 0x30A2
_MAJOR, _MINOR, _NONE = 0x3098, 0x30FB, 0x3038
_COMPUTE, _COMPILED, _LINKED = 0x91B9, 0x8B81, 0x8B82
_BUFFER, _DYNAMIC_READ, _BARRIER = 0x90D2, 0x88E9, 0xFFFFFFFF
_RENDERER, _VERSION = 0x1F01, 0x1F02
_Pointer, _Int, _Word, _Size = ctypes.c_void_p, ctypes.c_int, ctypes.c_uint, ctypes.c_ssize_t
_MOST_DEVICES = 16
Reader = Callable[..., Any]


def _opened(devices: bool) -> Reader:
    """The reader of `_context`; the process ends where there is no context."""
    try:
        return _context(devices)
    except OSError as error:
        print(f"no OpenGL here: {error}", file=sys.stderr)
        sys.exit(3)


def _context(devices: bool) -> Reader:
    """Make an OpenGL 4.3 context current; returns a reader of its functions by name, result and arguments.

    Args:
        devices: the first of the machine's devices that has one, before Mesa's own display.
    """
    egl = ctypes.CDLL("libEGL.so.1")
    egl.eglGetProcAddress.restype = _Pointer

    def function(name: str, result: Any, *arguments: Any) -> Any:
        address = egl.eglGetProcAddress(name.encode())
        if not address:
            raise OSError(f"no {name}")
        return ctypes.CFUNCTYPE(result, *arguments)(address)

    egl.eglInitialize.argtypes = [_Pointer] * 3
    egl.eglCreateContext.argtypes, egl.eglCreateContext.restype = [_Pointer] * 4, _Pointer
    egl.eglMakeCurrent.argtypes = [_Pointer] * 4
    found, count = (_Pointer * _MOST_DEVICES)(), _Int()
    if devices:
        function("eglQueryDevicesEXT", _Word, _Int, _Pointer, _Pointer)(_MOST_DEVICES, found, ctypes.byref(count))
    places = [*((_DEVICE, device) for device in found[: count.value]), (_SURFACELESS_MESA, None)]
    wanted = (_Int * 5)(_MAJOR, 4, _MINOR, 3, _NONE)
    for platform, device in places:
        display = function("eglGetPlatformDisplayEXT", _Pointer, _Word, _Pointer, _Pointer)(platform, device, None)
        if not display or not egl.eglInitialize(display, None, None) or not egl.eglBindAPI(_OPENGL_API):
            continue
        context = egl.eglCreateContext(display, None, None, wanted)
        if context and egl.eglMakeCurrent(display, None, None, context):
            return function
    raise OSError("no display without a window has OpenGL 4.3")


def _program(function: Reader, text: str) -> int:
    source = ctypes.c_char_p(text.encode())
    shader = function("glCreateShader", _Word, _Word)(_COMPUTE)
    function("glShaderSource", None, _Word, _Int, _Pointer, _Pointer)(shader, 1, ctypes.byref(source), None)
    function("glCompileShader", None, _Word)(shader)
    program = function("glCreateProgram", _Word)()
    function("glAttachShader", None, _Word, _Word)(program, shader)
    function("glLinkProgram", None, _Word)(program)
    done = _Int()
    for what, number, asked in (("Shader", shader, _COMPILED), ("Program", program, _LINKED)):
        function(f"glGet{what}iv", None, _Word, _Word, _Pointer)(number, asked, ctypes.byref(done))
        if not done.value:
            log = ctypes.create_string_buffer(4096)
            function(f"glGet{what}InfoLog", None, _Word, _Int, _Pointer, _Pointer)(number, 4096, None, log)
            print(log.value.decode(), file=sys.stderr)
            sys.exit(4)
    return int(program)


def _bind(function: Reader, arrays: Sequence[Any]) -> list[int]:
    """New buffers of these contents, bound from 0 on; their names."""
    names = (_Word * len(arrays))()
    function("glGenBuffers", None, _Int, _Pointer)(len(arrays), names)
    for binding, array in enumerate(arrays):
        function("glBindBufferBase", None, _Word, _Word, _Word)(_BUFFER, binding, names[binding])
        data = function("glBufferData", None, _Word, _Size, _Pointer, _Word)
        data(_BUFFER, array.nbytes, array.ctypes.data, _DYNAMIC_READ)
    return list(names)


def _read(function: Reader, buffer: int, into: Any) -> None:
    function("glBindBuffer", None, _Word, _Word)(_BUFFER, buffer)
    read = function("glGetBufferSubData", None, _Word, _Size, _Size, _Pointer)
    read(_BUFFER, 0, into.nbytes, into.ctypes.data)


def _call(function: Reader, program: int, groups: int, times: int = 1) -> float:
    """Seconds of so many calls, one after the other, to their end."""
    dispatch = function("glDispatchCompute", None, _Word, _Word, _Word)
    finish = function("glFinish", None)
    function("glUseProgram", None, _Word)(program)
    finish()
    start = time.perf_counter()
    for _ in range(times):
        dispatch(groups, 1, 1)
    function("glMemoryBarrier", None, _Word)(_BARRIER)
    finish()
    return time.perf_counter() - start


def race(folder: Path, rounds: int) -> None:
    """Run every shader of a folder, then race them in turn; writes found.json: renderer, version, seconds a call.

    In jobs.json a row for each: shader, rays and call (files; buffers 0 and 2), groups, size (floats of buffer 1), and
    perhaps keep, a file for these floats after one call; those that keep are not raced.
    """
    function = _opened(devices=True)
    text = function("glGetString", ctypes.c_char_p, _Word)
    about: dict[str, Any] = {"renderer": text(_RENDERER).decode(), "version": text(_VERSION).decode(), "seconds": {}}
    jobs = json.loads((folder / "jobs.json").read_text())
    raced: dict[str, list[tuple[str, int, int, int]]] = {}
    for job in jobs:
        program = _program(function, (folder / job["shader"]).read_text())
        if "keep" in job:
            found = np.full(job["size"], np.nan, np.float32)
            buffers = _bind(function, [np.load(folder / job[k]) if k else found for k in ("rays", "", "call")])
            _call(function, program, job["groups"])
            _read(function, buffers[1], found)
            np.save(folder / job["keep"], found)
        else:
            raced.setdefault(job["rays"], []).append((job["name"], program, job["groups"], job["size"]))
    calls = {job["rays"]: job["call"] for job in jobs}
    for rays, runs in raced.items():
        room = np.zeros(max(size for *_, size in runs), np.float32)
        _bind(function, [np.load(folder / rays), room, np.load(folder / calls[rays])])
        for _, program, groups, _ in runs:
            _call(function, program, groups)
        times = [max(1, int(_SECONDS / _call(function, program, groups))) for _, program, groups, _ in runs]
        for _ in range(rounds):
            for (name, program, groups, _), often in zip(runs, times, strict=True):
                about["seconds"].setdefault(name, []).append(_call(function, program, groups, often) / often)
    (folder / "found.json").write_text(json.dumps(about))


def main(shader: str, rays: str, out: str, rows: str) -> None:
    """One shader on rays of a file."""
    function = _opened(devices=False)
    program = _program(function, Path(shader).read_text(encoding="utf-8"))
    given = np.ascontiguousarray(np.load(rays), np.float32)
    found = np.zeros((int(rows), given.shape[1]), np.float32)
    buffers = _bind(function, [given, found])
    _call(function, program, -(-given.shape[1] // GROUP))
    _read(function, buffers[1], found)
    np.save(out, found)


if __name__ == "__main__":
    main(*sys.argv[1:]) if len(sys.argv) > 3 else race(Path(sys.argv[1]), int(sys.argv[2]))
