"""C text compiled by the system's compiler into a library, kept in a folder that only its owner can write to."""

import ctypes
import errno
import hashlib
import os
import platform
import shlex
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from contextlib import suppress
from functools import cache
from pathlib import Path

from neurolens.base.errors import InputError
from neurolens.base.files import atomic_path, cache_folder, folder_of_process, keep_newest, seal, sealed_bytes
from neurolens.base.progress import duration

# -march=native uses all of the machine; the next two let square roots and divisions become vectors, also where only one
# side of a choice needs them. NaN and infinity stay what they are. -fno-inline keeps the knowledge that the arrays of a
# function do not overlap; functions of single rays are marked to be inlined anyway.
FLAGS = ("-std=c99", "-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-fno-inline")
_SECONDS = 300  # the largest models known compile in ten
_ROOM = 2**20
_KEPT = 256  # libraries of 30 to 200 kB, up to four of a camera; as many as outlines are kept
_TAKEN_S: list[float] = []  # by each compilation of this process, see `compiled_so_far`
_ONE_AT_A_TIME = threading.RLock()  # threads that need the same library do not both compile it
if hasattr(os, "register_at_fork"):  # not under Windows
    os.register_at_fork(after_in_child=_ONE_AT_A_TIME._at_fork_reinit)  # type: ignore[attr-defined]


def find_compiler() -> str:
    """Return the C compiler: $CC, which may have arguments ("ccache gcc"), else cc, gcc or clang.

    Raises:
        InputError: there is none, or $CC names none.
    """
    asked = os.environ.get("CC", "").strip()
    if asked:
        if shutil.which(_words(asked)[0]) is None:
            raise InputError("compiler", "CC", asked, "a C compiler that is there, or nothing: cc, gcc or clang")
        return asked
    for name in ("cc", "gcc", "clang"):
        found = shutil.which(name)
        if found:
            return found
    raise InputError("compiler", "CC", "(none found)", "a C compiler: $CC, cc, gcc or clang")


def has_compiler() -> bool:
    """Return whether `find_compiler` finds one."""
    try:
        return bool(find_compiler())
    except InputError:
        return False


def _words(compiler: str) -> list[str]:
    """Return the words of a compiler's command; the path of a file, also with spaces, is one word."""
    if shutil.which(compiler):
        return [compiler]
    try:
        return shlex.split(compiler)
    except ValueError as error:
        raise InputError("compiler", "CC", compiler, f"a command ({error})") from None


def compile_c(source: str, library: Path, flags: tuple[str, ...] = FLAGS) -> str:
    """Compile a source into the shared library `library`; returns the compiler's warnings.

    Raises:
        InputError: there is no compiler, or it fails; the message says how.
        OSError: the disk is full, where the library goes or where compilers have their temporary files.
    """
    compiler, places = find_compiler(), (Path(tempfile.gettempdir()), library.parent)
    words = [*_words(compiler), *flags, "-shared", "-fPIC", "-x", "c", "-", "-o", str(library), "-lm"]
    done = _run(words, source, TMPDIR=str(_with_room(*places)))
    if done.returncode or not library.is_file() or not library.stat().st_size:
        # On a full disk, linkers that write to mapped memory print nothing; a signal ends them.
        full = [str(place) for place in places if not _has_room(place)]
        if full or "No space left" in done.stderr:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), " and ".join(full or map(str, places)))
        said = " ".join(next((line for line in done.stderr.splitlines() if "error" in line), done.stderr).split())
        raise InputError(compiler, "compile", f"({said[:200] or 'no word'})", "a C compiler that knows C99")
    return done.stderr


def _has_room(folder: Path) -> bool:
    return shutil.disk_usage(folder).free >= _ROOM


def _with_room(*folders: Path) -> Path:
    """Return the first folder whose disk has room, else the first of all."""
    return next(filter(_has_room, folders), folders[0])


def _run(command: list[str], text: str = "", **environment: str) -> subprocess.CompletedProcess[str]:
    pipe, english = subprocess.PIPE, {**os.environ, "LC_ALL": "C", **environment}
    try:
        # In a group of its own, the driver's children, which do the work, end with it, also at Ctrl-C.
        with subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, errors="replace", start_new_session=True,
            env=english,
        ) as child:  # fmt: skip
            try:
                out, err = child.communicate(text, timeout=_SECONDS)
            except BaseException:
                with suppress(OSError):
                    os.killpg(child.pid, signal.SIGKILL) if hasattr(os, "killpg") else child.kill()
                raise
    except (OSError, subprocess.TimeoutExpired) as error:
        said = f"no end after {_SECONDS} s" if isinstance(error, subprocess.TimeoutExpired) else error
        raise InputError(command[0], "compile", f"({said})", "a C compiler that works") from error
    return subprocess.CompletedProcess(command, child.returncode, out, err)


def c_source(file: str, **constants: object) -> str:
    """Return the text of a .c file ("pictures/flare/area.c"), after a #define for each of the constants."""
    defines = "".join(f"#define {name} {value}\n" for name, value in constants.items())
    return defines + (Path(__file__).parents[1] / file).read_text(encoding="utf-8")


def compiled_so_far() -> str:
    """Return what this process has compiled since the last call, in words; nothing where all libraries were there."""
    with _ONE_AT_A_TIME:
        number, taken_s = len(_TAKEN_S), sum(_TAKEN_S)
        _TAKEN_S.clear()
    programs = f"{number} programs" if number > 1 else "a program"
    said = f"compiled {programs} in {duration(taken_s)}, kept for the next time in {cache_folder()}"
    return said if number else ""


def load_compiled(source: str) -> ctypes.CDLL:
    """Load the library of a source, which is compiled once for this machine and kept in `cache_folder`.

    A library of another user, or a damaged one, is compiled again. Where the disk of the cache is full, it goes to the
    folder of temporary files, for this process; a compiler itself works in whichever of the two has room.

    Raises:
        InputError: as `compile_c`, and where a library cannot be loaded.
    """
    with _ONE_AT_A_TIME:
        return _loaded(source)


def _loaded(source: str) -> ctypes.CDLL:
    library = cache_folder() / f"{_key(source)}.so"
    if sealed_bytes(library) is not None:
        with suppress(OSError):  # another run has just removed it
            return ctypes.CDLL(str(library))
    if _with_room(library.parent, Path(tempfile.gettempdir())) != library.parent:
        library = Path(folder_of_process().name) / library.name
    began = time.monotonic()
    with atomic_path(library) as temporary:
        compile_c(source, temporary, FLAGS)
        seal(temporary, 0o700)
    _TAKEN_S.append(time.monotonic() - began)
    try:
        loaded = ctypes.CDLL(str(library))
    except OSError as error:
        raise InputError(library, "load", f"({error})", "code for this machine, and a disk that may hold it") from error
    keep_newest(library, _KEPT)  # one in use stays readable for those that have opened it
    return loaded


def _key(source: str) -> str:
    """Hash a source with the flags, the compiler and the processor: a library for another processor may crash here."""
    made_by = _compiler_and_processor(find_compiler())
    return hashlib.sha256("\0".join((source, *FLAGS, made_by)).encode()).hexdigest()[:32]


@cache
def _compiler_and_processor(compiler: str) -> str:
    asked = _run([*_words(compiler), "--version"])
    processor = platform.processor()
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        known = ("model name", "flags", "Features", "CPU part")
        processor += "".join(dict.fromkeys(line for line in lines if line.startswith(known)))
    return "\0".join((compiler, asked.stdout, platform.machine(), processor))
