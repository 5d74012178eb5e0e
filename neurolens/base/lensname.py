"""Arguments that name a lens: a lens or a model that ships, a file of either, or a camera made from one.

laikin_double_gauss_50              a lens of lenses/, or a model of models/, by its name
helios 44, "nikkor z 58"            words of one lens of lenses/: `neurolens.base.find`
FILE.toml, FILE.zmx, ...            a lens file of any format that `neurolens.optics.readers.any_format` reads
MODEL.onnx                          an exported model
plan.toml                           a file of `neurolens plan`: the camera that it names
thick:, thin:, pinhole:             before any of these: a kind of camera
thin, pinhole, fisheye-PROJECTION   a camera without a lens

Older command lines and files have "fused:" before a lens or model that was to be compiled, as all are now: it is read,
and changes nothing.
"""

import os
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from neurolens.base.errors import InputError, note
from neurolens.base.files import library
from neurolens.base.find import Found, find
from neurolens.base.tomlfile import read_toml, suggestion

_FUSED = "fused:"
IDEAL_OF = ("thick:", "thin:", "pinhole:")  # ideal cameras that are framed as a lens is
FISHEYES = tuple(f"fisheye-{name}" for name in ("equidistant", "equisolid", "stereographic", "orthographic"))
IDEAL = ("thin", "pinhole", *FISHEYES)
_YEAR = re.compile(r"\b(1[89]\d\d|20\d\d)\b(?!,?\d)|\bS\.(\d\d)-\d")  # S.53 of a Japanese patent: Showa 53, 1978
_SHOWA = 1925
_NEAR = 5  # names that a message offers
_FORMATS = "a lens file of any format (see neurolens convert --help)"


class Named(NamedTuple):
    """A kind of camera ("" or one that `split_kind` knows) and a file, which a camera without a lens lacks."""

    kind: str
    file: Path | None

    def __str__(self) -> str:
        return f"{self.kind}{self.file or ''}"


def split_kind(text: str) -> tuple[str, str]:
    """Split a word into its kind of camera, with the colon, and the rest; file names may have colons of their own."""
    text = text.removeprefix(_FUSED)
    kind = next((k for k in IDEAL_OF if text.startswith(k)), "")
    return kind, text.removeprefix(kind)


def is_model(file: str | Path) -> bool:
    """Return whether a file is an exported model, by its name; any other file is read as a lens."""
    return Path(file).suffix.lower() == ".onnx"


def lens_id_of(file: str | Path) -> str:
    """Return a lens's id from its file's name: letters, digits, "-" and "_", which can begin any file's name."""
    return re.sub(r"[^\w-]+", "_", Path(file).stem).strip("_") or "lens"


def year_of(source: str) -> int | None:
    """Return the first year that a source names: a lens's own year stands before that of a book that reprints it."""
    found = _YEAR.search(source)
    return None if found is None else int(found[1] or _SHOWA + int(found[2]))


def maker_of(designer: str) -> str:
    """Return the maker from a lens file's designers, where persons stand before their company."""
    return designer.rpartition(",")[2].strip()


def resolve(text: str | Path, *, models: bool = True, cameras: bool = True) -> Named:
    """Find what an argument names: first a file, then a name that ships, then the folder of a run, then words of one
    lens of the library, of which a `Note` says what was taken.

    Args:
        models: whether a model is accepted. cameras: whether kinds of cameras and files of `neurolens plan` are.

    Raises:
        InputError: there is no such file or name, and the nearest is offered; or words name several lenses.
    """
    if cameras and text in IDEAL:
        return Named(str(text), None)
    kind, word = split_kind(str(text)) if cameras else ("", str(text))
    places = (("lenses", ".toml"), ("models", ".onnx")) if models else (("lenses", ".toml"),)
    ships = [library() / folder / f"{word}{suffix}" for folder, suffix in places if Path(word).name == word]
    path = next((file for file in (Path(word), *ships) if file.is_file()), Path(word))
    found = find(word) if not path.exists() and _is_words(word) else Found((), None)
    if found.chosen:
        path = library() / "lenses" / f"{found.chosen.lens}.toml"
        note("; ".join([f"{word!r} is {found.chosen.name}, {found.chosen.lens}", *found.notes]))
    elif (is_model(path) and (not models or kind in IDEAL_OF)) or not path.exists():
        asked = "camera" if cameras else "lens"
        if found.hits:
            named = [f"{entry.lens} ({entry.name})" for entry in found.hits[:_NEAR]]
            raise InputError(word, asked, f"({len(found.hits)} lenses)", f"words of one lens: {', '.join(named)} ...")
        expected = _FORMATS + (", a model (.onnx)" if models else "") + " or a name that ships (neurolens find WORDS)"
        if cameras:
            expected += f", with {', '.join(IDEAL_OF)} before it or not, or one of {', '.join(IDEAL)}"
        ours = [file.stem for folder, suffix in places for file in sorted((library() / folder).glob(f"*{suffix}"))]
        known = [*ours, *_beside(Path(word)), *(IDEAL if cameras else ())]
        near = suggestion(word, [name for name in known if name != word])
        if not near and found.near:
            near = f"; did you mean {' or '.join(repr(entry.lens) for entry in found.near)}?"
        raise InputError(word, asked, "(a model)" if path.exists() else "(missing)", expected + near)
    if cameras and path.suffix.lower() == ".toml" and (planned := _planned(path)):
        own, file = split_kind(planned)
        return Named(kind or own, Path(os.path.normpath(path.parent / file)))
    here = path in ships and path.is_relative_to(Path.cwd())
    return Named(kind, Path(os.path.relpath(path)) if here else path)


def _is_words(text: str) -> bool:
    """Test whether a text may be words of a lens, and no path or file name; f/1.2 and 50/1.2 contain a slash, too."""
    bare = re.sub(r"(?<=\b[fFtT])/|(?<=\d)/(?=[\d.])", " ", text)
    return not re.search(r"[/\\]|\.[^\W\d][\w-]*$", bare)


def _planned(path: Path) -> str | None:
    """Return the camera that a file of `neurolens plan` names; None for other files."""
    with suppress(InputError):  # the reader of lenses reports it
        camera = read_toml(path).get("camera")
        return camera if isinstance(camera, str) else None
    return None


def _beside(path: Path) -> Iterator[str]:
    """Yield the files that lie where a file is missing, each written as the argument would name it."""
    with suppress(OSError):
        yield from sorted(str(path.parent / entry.name) for entry in os.scandir(path.parent) if entry.is_file())
