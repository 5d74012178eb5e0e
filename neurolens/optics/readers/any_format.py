"""Reads lens files of any format, which is recognised by the content, else by the suffix."""

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from neurolens.base.errors import InputError
from neurolens.base.tomlfile import read_toml
from neurolens.optics.lens.designs import with_assumptions
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.readers.codev import read_seq
from neurolens.optics.readers.json_lens import is_blender, read_blender, read_json_lens
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.readers.oslo import read_len
from neurolens.optics.readers.source import ReadOptions, lines_of, read_text
from neurolens.optics.readers.tables import read_flaresim, read_opticalbench, read_table
from neurolens.optics.readers.zemax import read_zmx

OURS = "neurolens"
_HEAD = 20_000  # characters by which a format is recognised


@dataclass(frozen=True)
class Format:
    """A format that lenses are read from; `like` is a pattern that is found at the beginning of its texts."""

    name: str
    suffixes: tuple[str, ...]
    read: Callable[[str | Path, ReadOptions], Lens]
    like: str


# In a plain table the first line that is no comment holds numbers: a count, or those of a row.
_NUMBER = r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e[-+]?[0-9]+)?"
_TABLE = rf"\A(?:[^\S\n]*(?:#.*)?\n)*[^\S\n]*{_NUMBER}(?:(?:[^\S\n]+{_NUMBER}){{3}})?[^\S\n]*(?:[#\n]|\Z)"
FORMATS = (
    Format("Zemax", (".zmx",), read_zmx, r"^[^\S\n]*(?-i:SURF|MODE)(?!\S)"),
    Format("OSLO", (".len", ".osl"), read_len, r"^[^\S\n]*LEN[^\S\n]+NEW(?!\S)"),
    Format("CODE V", (".seq",), read_seq, r"^(?:[^\S\n]|;)*(?:RDM|LEN)(?![^\s;])"),
    Format("JSON", (".json",), read_json_lens, r"\A\s*\{"),
    Format("Optical Bench", (".txt",), read_opticalbench, r"^\[(?:lens data|variable distances)\][^\S\n]*$"),
    Format("FlareSim", (".lens",), read_flaresim, r"^[^\S\n]*(?-i:surfaces:)[^\S\n]*(?:#.*)?$"),
    Format("lens table", (".dat", ".txt", ".lens"), read_table, _TABLE),
)


SUFFIXES = frozenset([".toml", *(suffix for f in FORMATS for suffix in f.suffixes)])


def read_any(path: str | Path, options: ReadOptions | None = None) -> Lens:
    """Return the lens of a file in any format, also our own TOML; `options` give what the file lacks.

    What is left open of coatings and absorption is assumed (`designs.with_assumptions`).

    The content decides; the suffix is used if the content is not recognised.

    Raises:
        InputError: the file is in no known format, or has a mistake; names file and line. Where an option of `neurolens
            convert` would help, and `options` is None, the message says how.
    """
    if options is None:
        try:
            return read_any(path, ReadOptions())
        except InputError as error:
            if (option := re.search(r"--[a-z-]+", error.expected)) is None:
                raise
            command = f"neurolens convert FILE {option[0]} ... -o LENS.toml"
            raise InputError(error.file, error.field, error.value, f"{error.expected} ({command})") from None
    if Path(path).suffix.lower() == ".toml":
        data = read_toml(path)
        if is_blender(data):
            return with_assumptions(read_blender(data, str(path), options))
        lens = read_lens(path, data)
        lens = replace(lens, name=options.name or lens.name, source=options.source or lens.source)
        if options != ReadOptions(name=options.name, source=options.source):
            raise InputError(path, "options", "(others)", "--name and --source only: the file has the rest")
        return lens
    found = format_of(path)
    for name, value in (("--gap-before", options.gap_before), ("--semi-diameters", options.semi_diameters)):
        if value and found.read is not read_table:
            raise InputError(path, name, f"(a {found.name} file)", "a plain table: other formats define it")
    return with_assumptions(found.read(path, options))


def format_of(path: str | Path) -> Format:
    """Return the format of a file, by its content, else by a suffix that no other format has.

    Raises:
        InputError: neither tells the format.
    """
    head = "\n".join(lines_of(read_text(path)[:_HEAD]))
    suffix = Path(path).suffix.lower()
    by_content = next((f for f in FORMATS if re.search(f.like, head, re.MULTILINE | re.IGNORECASE)), None)
    by_suffix = [f for f in FORMATS if suffix in f.suffixes]
    if by_content is None and len(by_suffix) != 1:
        known = ", ".join(f"{f.name} ({', '.join(f.suffixes)})" for f in FORMATS)
        raise InputError(path, "format", "(not known)", f"one of {known}, or a lens file (.toml)")
    return by_content or by_suffix[0]


def kind_of(path: str | Path) -> str:
    """Return the name of a file's format, "neurolens" for our own; raises as `format_of` and `read_toml`."""
    if Path(path).suffix.lower() == ".toml":
        return "Physical Camera" if is_blender(read_toml(path)) else OURS
    return format_of(path).name


@dataclass(frozen=True)
class Collection:
    """The files of a folder that may be lenses, by name with "/" between its parts, and how many others there are.

    Attributes:
        others: how many files of other kinds lie in the folder, by suffix.
    """

    folder: Path
    names: tuple[str, ...]
    others: dict[str, int] = field(default_factory=dict)


def collection_of(folder: Path) -> Collection:
    """Find the lens files of a folder and of its folders by suffix; hidden files and links to folders do not count.

    Raises:
        InputError: there is no such folder, or no lens file in it.
    """
    if not folder.is_dir():
        raise InputError(folder, "FOLDER", "(no folder)", "a folder of lens files")
    names, others = list[str](), dict[str, int]()
    for file in sorted(folder.rglob("*")):
        parts = file.relative_to(folder).parts
        kind = file.suffix.lower() or "(none)"
        if file.is_dir():
            if not file.is_symlink():
                continue
            kind = "(link to a folder)"
        elif any(part.startswith(".") for part in parts):
            kind = "(hidden)"
        elif kind in SUFFIXES:
            names.append("/".join(parts))
            continue
        others[kind] = others.get(kind, 0) + 1
    if not names:
        known = ", ".join(sorted(SUFFIXES))
        raise InputError(folder, "FOLDER", f"({sum(others.values())} files of other kinds)", f"lens files: {known}")
    return Collection(folder, tuple(names), others)


def lens_files(folder: Path) -> list[Path]:
    """Return the lens files of a folder and of its folders, by name; raises InputError as `collection_of`."""
    return [folder / name for name in collection_of(folder).names]
