"""The extension as a zip that Blender installs, and lenses that are added to the zip or to its user folder.

blender_manifest.toml, *.py     the extension, neurolens/programs/blender/extension
lenses.json                     facts of every lens, see `extension.library`
shaders/NAME.osl                one for each form of a lens
thumbnails/NAME.png             its section; NAME.bokeh.png three discs of light
"""

import io
import json
import os
import re
import sys
import time
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

from neurolens.base.errors import InputError
from neurolens.base.files import atomic_path, check_writable, fcntl, place_inside, read_bytes, safe_name
from neurolens.base.find import entries, said_of
from neurolens.base.lensname import year_of
from neurolens.base.tomlfile import parse_json

EXTENSION = Path(__file__).parent / "extension"
FACTS, SCHEMA = "lenses.json", 1
_ID = "neurolens"
_CODE = (*sorted(path.name for path in EXTENSION.glob("*.py")), "blender_manifest.toml")
_THEN = (1980, 1, 1, 0, 0, 0)  # a date for all entries, so that a zip of the same lenses is the same, byte for byte
_LARGEST = 1 << 28  # the most bytes of a library: 200 lenses unpacked are some 80 MB
LONGEST_S = 60.0  # how long a lens waits while another is added


@dataclass(frozen=True)
class Form:
    """A shader of a lens; `extension.library.Variant` says what the fields mean."""

    kind: str
    model: str
    osl: str
    rms_um: float | None
    film_radius_mm: float
    f_number: float
    nearest_m: float | None
    poor: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class PackedLens:
    """A lens of the menu; its files are named by `lens_id`.

    Attributes:
        picture, bokeh: PNGs. lens_field: an `extension.library.Field` as a table.
        character: by the keys of `extension.library.CHARACTER`.
    """

    lens_id: str
    name: str
    efl_mm: float
    f_number: float
    source: str
    picture: bytes | None
    forms: list[Form]
    lens_field: dict[str, Any] | None = None
    maker: str = ""
    character: Mapping[str, float | None] | None = None
    bokeh: bytes | None = None

    def files(self) -> dict[str, bytes]:
        """Return the contents of its files, by their places in the extension."""
        found = {f"shaders/{self._stem(f)}.osl": f.osl.encode() for f in self.forms}
        pictures = {self._picture(): self.picture, self._picture(".bokeh"): self.bokeh}
        found |= {name: data for name, data in pictures.items() if data is not None}
        return found

    def facts(self) -> dict[str, Any]:
        """Return its entry in `lenses.json`."""
        same = ("name", "efl_mm", "f_number", "source", "maker", "character")
        variants = [{**asdict(f), "file": f"shaders/{self._stem(f)}.osl"} for f in self.forms]
        return {
            "id": self.lens_id,
            **{name: getattr(self, name) for name in same},
            "year": year_of(self.source),
            "said": [s for e in entries() if e.lens == self.lens_id.partition("-")[0] for s in said_of(e)],
            "picture": None if self.picture is None else self._picture(),
            "bokeh": None if self.bokeh is None else self._picture(".bokeh"),
            "variants": [{k: v for k, v in variant.items() if k != "osl"} for variant in variants],
            "field": self.lens_field,
        }

    def _picture(self, what: str = "") -> str:
        return f"thumbnails/{safe_name(self.lens_id)}{what}.png"

    def _stem(self, form: Form) -> str:
        """Return a safe name of files: the model's name comes from its card, which anybody may have written."""
        return safe_name(f"{self.lens_id}.{form.model or form.kind}")


@cache
def extension_library(name: str = "library") -> ModuleType:
    """Load a module of the extension that needs no Blender (facts, lights) without its package, which needs it."""
    spec = spec_from_file_location(f"neurolens_{name}", EXTENSION / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up there
    spec.loader.exec_module(module)
    return module


def write_pack(out: Path, lenses: Iterable[PackedLens]) -> None:
    """Write the extension with these lenses, atomically.

    Raises:
        InputError: two lenses have one id. OSError: the place cannot be written.
    """
    packed = list(lenses)
    if len({p.lens_id for p in packed}) < len(packed):
        raise InputError(out, "lenses", [p.lens_id for p in packed], "each id once")
    files = {name: (EXTENSION / name).read_bytes() for name in _CODE}
    for lens in packed:
        files |= lens.files()
    _write_zip(out, files | {FACTS: _facts(lens.facts() for lens in packed)})


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Let one process or thread at a time run the block for a folder; others wait.

    Systems without such locks let all of them through.

    Raises:
        InputError: another held it for `LONGEST_S`.
    """
    handle = None if fcntl is None else os.open(folder, os.O_RDONLY)
    try:
        end = time.monotonic() + LONGEST_S
        while handle is not None:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if time.monotonic() > end:
                    raise InputError(folder, "lock", _holder(folder), f"freed within {LONGEST_S:g} s") from None
                time.sleep(0.05)
                continue
            except OSError:
                pass
            break
        yield
    finally:
        if handle is not None:
            os.close(handle)  # which ends the lock


def _holder(folder: Path) -> str:
    """Say who locks a folder, where the system tells (Linux does)."""
    with suppress(OSError):
        for words in map(str.split, Path("/proc/locks").read_text().splitlines()):
            if words[1] == "FLOCK" and words[5].endswith(f":{folder.stat().st_ino}"):
                return f"(held by process {words[4]})"
    return "(held by another process)"


def check_takes(to: Path) -> None:
    """Refuse a zip or a user folder that takes no lens, before the lens is made; raises what `add_lens` does."""
    _contents(to)
    there = next(p for p in (to, *to.absolute().parents) if p.exists())
    check_writable(there if there.is_file() else there / FACTS)


def add_lens(to: Path, lens: PackedLens) -> None:
    """Add a lens to a packed extension (.zip) or to its user folder, which is made if needed.

    It replaces a lens of the same id.

    Raises:
        InputError: it is no packed extension and no folder, or its facts are not neurolens's. OSError: it cannot be
            written.
    """
    if to.suffix != ".zip" and not to.exists():
        to.mkdir(parents=True, exist_ok=True)
    with locked(to if to.is_dir() else to.parent):  # another process may add a lens meanwhile
        files, known = _contents(to)
        new = lens.files() | {FACTS: _facts(_merged(known, lens))}  # facts come last, for they name files
        if to.suffix == ".zip":
            _write_zip(to, files | new)
            return
        for name, data in new.items():
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(to / name) as temporary:
                temporary.write_bytes(data)


def _contents(to: Path) -> tuple[dict[str, bytes], list[dict[str, Any]]]:
    """Read a packed extension's files (a folder gives none) and the entries of its facts (a new folder has none)."""
    if to.suffix == ".zip":
        return _of_zip(to)
    file = to / FACTS
    if to.exists() and not to.is_dir():
        raise InputError(to, "--extension", "(a file)", "a zip that `neurolens blender build` wrote, or a folder")
    if not file.exists():
        return {}, []
    data = read_bytes(file, _LARGEST, "a file of facts")
    try:
        return {}, _entries(data)
    except (InputError, RecursionError, *extension_library().DAMAGED) as error:
        raise InputError(file, "file", f"({error})", "facts that neurolens wrote") from None


def _of_zip(path: Path) -> tuple[dict[str, bytes], list[dict[str, Any]]]:
    """Read the files of a packed extension, and the entries of its facts."""
    expected = "a zip of `neurolens blender build`"
    data = io.BytesIO(read_bytes(path, _LARGEST, expected))
    try:
        with zipfile.ZipFile(data) as packed:
            # An entry never gives more bytes than it says here, so that these bound the memory taken.
            if sum(i.file_size for i in packed.infolist()) > _LARGEST:
                raise ValueError(f"more than {_LARGEST} bytes unpacked")
            for info in packed.infolist():
                place_inside(Path(), info.filename)
            files = {i.filename: packed.read(i) for i in packed.infolist() if not i.is_dir()}
        return files, _entries(files[FACTS])
    except MemoryError:
        raise
    except Exception as error:  # zipfile raises many types: for passwords, methods of compression, damaged data
        clear = isinstance(error, (zipfile.BadZipFile, ValueError))  # the messages of others are about the code
        why = f"no {error}" if isinstance(error, KeyError) else str(error) if clear else "damaged or encrypted"
        raise InputError(path, "file", f"({why or type(error).__name__})", expected) from None


def user_folders() -> list[Path]:
    """Return the extension's user folders in the Blenders of this machine that have it, newest Blender first."""
    home = Path.home()
    if given := os.environ.get("BLENDER_USER_RESOURCES"):
        places = [Path(given)]
    else:
        root = {
            "darwin": home / "Library" / "Application Support" / "Blender",
            "win32": Path(os.environ.get("APPDATA", home)) / "Blender Foundation" / "Blender",
        }.get(sys.platform, Path(os.environ.get("XDG_CONFIG_HOME", home / ".config")) / "blender")
        places = [p for p in root.glob("*") if re.fullmatch(r"\d+\.\d+", p.name)]
        places.sort(key=lambda p: [int(n) for n in p.name.split(".")], reverse=True)
    installed = (p for place in places for p in sorted((place / "extensions").glob(f"*/{_ID}/blender_manifest.toml")))
    return [p.parents[2] / ".user" / p.parents[1].name / _ID for p in installed]


def _entries(text: bytes) -> list[dict[str, Any]]:
    """Read entries of facts by the extension's own reader, so that it can read those to which a lens is added.

    Raises:
        InputError, RecursionError, those of `DAMAGED` in the extension's library: the facts are none.
    """
    data = parse_json(text, FACTS)
    if data["schema"] != SCHEMA:
        raise ValueError(f"schema {data['schema']}")
    for entry in data["lenses"]:
        extension_library().lens_of(Path(), entry)
    return list(data["lenses"])


def _merged(known: Iterable[dict[str, Any]], lens: PackedLens) -> list[dict[str, Any]]:
    """Add a lens to entries; an entry of the same id keeps the forms that the lens does not bring."""
    mine = lens.facts()
    kinds = {v["kind"] for v in mine["variants"]}
    others = []
    for entry in known:
        if entry["id"] != lens.lens_id:
            others.append(entry)
            continue
        mine["variants"] += [v for v in entry["variants"] if v["kind"] not in kinds]
        mine |= {name: mine[name] or entry.get(name) for name in ("picture", "bokeh", "character")}
    return [*others, mine]


def _facts(entries: Iterable[Mapping[str, Any]]) -> bytes:
    return (json.dumps({"schema": SCHEMA, "lenses": list(entries)}, indent=1, allow_nan=False) + "\n").encode()


def _write_zip(out: Path, files: Mapping[str, bytes]) -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as packed:
        for name in sorted(files):
            info = zipfile.ZipInfo(name, _THEN)
            info.compress_type, info.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            packed.writestr(info, files[name])
    with atomic_path(out) as temporary:
        temporary.write_bytes(buffer.getvalue())
