"""A compute shader run by Mesa in software, without a window: `python gl_compute.py SHADER RAYS.npy OUT.npy`.

Rays are [K, N] float32, bound as buffer 0; the result [M, N] is buffer 1, M the last argument. Exit code 3 where there
is no such OpenGL, with the reason on stderr; 4 where the shader does not compile.
"""

import ctypes
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

GROUP = 64
_SURFACELESS_MESA, _OPENGL_API = 0x31DD, 0x30A2
_MAJOR, _MINOR, _NONE = 0x3098, 0x30FB, 0x3038
_COMPUTE, _COMPILED, _LINKED = 0x91B9, 0x8B81, 0x8B82
_BUFFER, _DYNAMIC_READ, _BARRIER = 0x90D2, 0x88E9, 0xFFFFFFFF
_Pointer, _Int, _Word = ctypes.c_void_p, ctypes.c_int, ctypes.c_uint


def _context() -> Callable[..., Any]:
    """Make an OpenGL 4.3 context current; returns a reader of its functions by name, result and arguments."""
    egl = ctypes.CDLL("libEGL.so.1")
    egl.eglGetProcAddress.restype = _Pointer

    def function(name: str, result: Any, *arguments: Any) -> Any:
        address = egl.eglGetProcAddress(name.encode())
        if not address:
            raise OSError(f"no {name}")
        return ctypes.CFUNCTYPE(result, *arguments)(address)

    display = function("eglGetPlatformDisplayEXT", _Pointer, _Word, _Pointer, _Pointer)(_SURFACELESS_MESA, None, None)
    egl.eglInitialize.argtypes = [_Pointer] * 3
    egl.eglCreateContext.argtypes, egl.eglCreateContext.restype = [_Pointer] * 4, _Pointer
    egl.eglMakeCurrent.argtypes = [_Pointer] * 4
    if not display or not egl.eglInitialize(display, None, None) or not egl.eglBindAPI(_OPENGL_API):
        raise OSError("no surfaceless display")
    wanted = (_Int * 5)(_MAJOR, 4, _MINOR, 3, _NONE)
    context = egl.eglCreateContext(display, None, None, wanted)
    if not context or not egl.eglMakeCurrent(display, None, None, context):
        raise OSError("no OpenGL 4.3")
    return function


def _program(function: Callable[..., Any], text: str) -> int:
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


def main(shader: str, rays: str, out: str, rows: str) -> None:
    try:
        function = _context()
    except OSError as error:
        print(f"no OpenGL here: {error}", file=sys.stderr)
        sys.exit(3)
    with open(shader, encoding="utf-8") as file:
        program = _program(function, file.read())
    given = np.ascontiguousarray(np.load(rays), np.float32)
    found = np.zeros((int(rows), given.shape[1]), np.float32)
    names = (_Word * 2)()
    function("glGenBuffers", None, _Int, _Pointer)(2, names)
    for binding, array in enumerate((given, found)):
        function("glBindBufferBase", None, _Word, _Word, _Word)(_BUFFER, binding, names[binding])
        data = function("glBufferData", None, _Word, ctypes.c_ssize_t, _Pointer, _Word)
        data(_BUFFER, array.nbytes, array.ctypes.data, _DYNAMIC_READ)
    function("glUseProgram", None, _Word)(program)
    function("glDispatchCompute", None, _Word, _Word, _Word)(-(-given.shape[1] // GROUP), 1, 1)
    function("glMemoryBarrier", None, _Word)(_BARRIER)
    read = function("glGetBufferSubData", None, _Word, ctypes.c_ssize_t, ctypes.c_ssize_t, _Pointer)
    read(_BUFFER, 0, found.nbytes, found.ctypes.data)
    np.save(out, found)


if __name__ == "__main__":
    main(*sys.argv[1:])
