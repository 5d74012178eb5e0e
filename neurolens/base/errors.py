"""User-facing errors: one line with the file, the field, the value and the expected value."""

import os
import re
import shlex
import shutil
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import neurolens

_CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
_NOT_XML = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")
_LONGEST = 400  # characters of a value or field in a message
# The extra of pyproject.toml that installs a package, by the name under which the package is imported.
EXTRAS = {
    **dict.fromkeys(("torch", "scipy", "matplotlib", "contourpy", "flip_evaluator"), "train"),
    **dict.fromkeys(("distributed", "dask", "cryptography"), "dask"),
    **dict.fromkeys(("mitsuba", "drjit"), "mitsuba"),
    **dict.fromkeys(("onnx", "mpmath"), "dev"),
    "lensfunpy": "photographs",
    "safetensors": "rays",
}


def printable(text: str) -> str:
    """Return a text that a terminal can show: what controls it or reverses the writing becomes \\u and digits."""
    return _CONTROLS.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def without_controls(text: str) -> str:
    """Return a text for files, without the characters that XML forbids and USD cannot escape."""
    return _NOT_XML.sub("", text)


def one_line(text: str, most: int) -> str:
    """Return a text as one line of at most `most` characters that is safe on a terminal."""
    shown = printable(" ".join(text[: 4 * most].split()))
    return shown if len(shown) <= most else f"{shown[: most - 3]}..."


def _shown(value: object) -> str:
    try:
        value = os.fspath(value) if isinstance(value, os.PathLike) else value
        return value if isinstance(value, str) and value.startswith("(") else repr(value)
    except (ValueError, RecursionError):  # an integer of 5000 digits, lists in lists
        return f"({type(value).__name__} that is too long to show)"


class NeurolensError(Exception):
    """Base class of all neurolens errors."""


class InputError(NeurolensError, ValueError):
    """Bad input: a file, a field, a shape, a unit or a domain.

    Args:
        file: the file, or another source of the value ("--set", "argument").
        field: location in the file, for example "surface 3, radius_mm".
        value: the value found.
        expected: description of a valid value.
    """

    def __init__(self, file: str | Path, field: str, value: object, expected: str) -> None:
        found, where = one_line(_shown(value), _LONGEST), one_line(field, _LONGEST)
        super().__init__(f"{file}: {where}: got {found}, expected {expected}")
        self.file, self.field, self.value, self.expected = str(file), field, value, expected


class ModelError(NeurolensError, ValueError):
    """An exported lens model that cannot be trusted: truncated, of another schema, for another lens, or not finite."""


class NeurolensWarning(UserWarning):
    """A condition that is not an error but affects results, such as a glass without dispersion data."""


class AssumedWarning(NeurolensWarning):
    """Something that a file does not say, or says wrongly, was assumed: what is read from it is doubtful."""


class Note(NeurolensWarning):
    """A message on what was taken where a file or command says nothing; it is no reason to worry."""


def note(text: str) -> None:
    """Say on stderr what was taken or assumed, a `Note`."""
    warnings.warn(text, Note, stacklevel=_outside())


def warn(text: str) -> None:
    """Warn with a NeurolensWarning, which the command line prints to stderr."""
    warnings.warn(text, NeurolensWarning, stacklevel=_outside())


def _outside() -> int:
    """Return the `stacklevel` of the line that called this package, which Python shows with a warning."""
    own, frame, found = str(Path(__file__).parents[1]), sys._getframe(1), [True]
    while frame.f_back is not None:
        frame = frame.f_back
        found.append(frame.f_code.co_filename.startswith(own))
    return len(found) - found[::-1].index(True) + 1


@contextmanager
def warned(file: str | Path = "") -> Iterator[list[str]]:
    """Collect the NeurolensWarnings of the block, each once and without the name of the file, and show none of them."""
    texts: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", NeurolensWarning)
        try:
            yield texts
        finally:
            own = (str(w.message) for w in caught if issubclass(w.category, NeurolensWarning))
            texts += dict.fromkeys(text.removeprefix(f"{file}: ") for text in own)


def pip_install(extra: str) -> str:
    """Return the command that installs an extra of this project: in a checkout from there, else by our name on PyPI."""
    checkout = (Path(__file__).parents[2] / "pyproject.toml").is_file()
    return f"pip install '{'.' if checkout else neurolens.DISTRIBUTION}[{extra}]'"


def program() -> str:
    """Return how a command line begins here: "neurolens" if it is on the PATH, else the words that began this one."""
    if shutil.which("neurolens"):
        return "neurolens"
    started = sys.argv[0]
    return shlex.quote(started) if Path(started).name == "neurolens" else f"{shlex.quote(sys.executable)} -m neurolens"


def missing(error: BaseException) -> str:
    """Return the package that an import did not find, and the command that brings it; empty for any other error."""
    package = (error.name or "").partition(".")[0] if isinstance(error, ModuleNotFoundError) else ""
    if package not in EXTRAS:
        return ""
    return f"this needs {package}, which is not installed: {pip_install(EXTRAS[package])}"


def out_of_memory(error: BaseException) -> bool:
    """Test whether memory ran out: for values, or for the code of a library, whose loader then fails."""
    unmapped = isinstance(error, ImportError) and "failed to map segment" in str(error)
    # In a folder from which nothing may be run the loader says the same, and why.
    return isinstance(error, MemoryError) or (unmapped and "not permitted" not in str(error))


@contextmanager
def installed() -> Iterator[None]:
    """In the block, an import that does not find a package is a NeurolensError that says what brings it."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise (NeurolensError(missing(error)) if missing(error) else error) from None


def reason(error: BaseException) -> str:
    """Return what an error says; an error of the system begins with the file's name, where it has one."""
    if text := missing(error):
        return text
    if not isinstance(error, OSError):
        return str(error) or type(error).__name__
    return f"{'' if error.filename is None else f'{error.filename}: '}{error.strerror or error}"
