"""The list of models that ship, experiments/models.toml: which lenses, over which domains, by which fits."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from neurolens.base.config import read_config
from neurolens.base.errors import InputError
from neurolens.base.files import atomic_write_text
from neurolens.evaluate.describe import lens_files
from neurolens.evaluate.experiment import DomainChoice, LensChoice, check_names
from neurolens.evaluate.train import versions
from neurolens.surrogates.fit import ModelSettings
from neurolens.surrogates.pairs import PairSettings


def _default_models() -> tuple[ModelSettings, ...]:
    return ModelSettings("ols", terms=100), ModelSettings("mlp", units=32)


@dataclass(frozen=True)
class Entry:
    """One lens in one state and the models made of it.

    Attributes:
        models: what is fitted.
        best: keep the best polynomial and the best network only; else all.
        promise: whether the index promises a speed-up, to which `make bench` holds the models.
    """

    lens: LensChoice
    domain: DomainChoice = field(default_factory=DomainChoice)
    models: tuple[ModelSettings, ...] = field(default_factory=_default_models)
    best: bool = False
    promise: bool = True

    def __post_init__(self) -> None:
        check_names("lens", [self.state])
        check_names("models", [m.label for m in self.models])

    @property
    def state(self) -> str:
        """Name of the lens and its state, as model files carry it."""
        c = self.lens
        parts = [c.file.stem, c.configuration or "", f"{c.efl_mm:g}mm" if c.efl_mm else "", c.zoom or ""]
        parts += ["internal"] if c.focusing == "internal" else []
        return "-".join(p for p in parts if p)

    def file(self, settings: ModelSettings) -> str:
        """Name of the file of a model."""
        return f"{self.state}.{settings.label}.onnx"


@dataclass(frozen=True)
class WholeFolder:
    """Every lens file of a folder in its default state, unless an entry has it: best polynomial, best network."""

    folder: Path
    models: tuple[ModelSettings, ...] = field(default_factory=_default_models)


@dataclass(frozen=True)
class Library:
    """All entries, the ray pairs of each, and whether the compiled exact tracer is timed (half a minute a lens)."""

    entry: tuple[Entry, ...] = ()
    lenses: WholeFolder | None = None
    pairs: PairSettings = field(default_factory=PairSettings)
    compile_exact: bool = True

    def __post_init__(self) -> None:
        files = [e.file(m) for e in self.entry for m in e.models]
        twice = sorted({f for f in files if files.count(f) > 1})
        if not (files or self.lenses) or twice:
            raise InputError("settings", "entry", twice or "(none)", "at least one model, each of a file of its own")


def read_list(path: str | Path) -> Library:
    """The list of a file, with every lens of its folder as an entry; files lie relative to the list.

    Raises:
        InputError: as `config.read_config`; no such folder of lenses; a file that two entries would write.
    """
    library, folder = read_config(Library, path), Path(path).parent
    entries = [replace(e, lens=replace(e.lens, file=folder / e.lens.file)) for e in library.entry]
    if library.lenses is not None:
        models = library.lenses.models
        named = {e.state for e in entries}
        for file in lens_files(folder / library.lenses.folder):
            if file.stem not in named:
                entries.append(Entry(LensChoice(file), models=models, best=True, promise=False))
    return replace(library, entry=tuple(entries), lenses=None)


def chosen(library: Library, names: Sequence[str]) -> tuple[Entry, ...]:
    """The entries whose state starts with one of the names; all without names.

    Raises:
        InputError: a name that no entry has.
    """
    for name in names:
        if not any(e.state.startswith(name) for e in library.entry):
            known = ", ".join(dict.fromkeys(e.state for e in library.entry))
            raise InputError("experiments models", "LENS", name, f"the start of one of: {known}")
    return tuple(e for e in library.entry if not names or any(e.state.startswith(n) for n in names))


_HEAD = """# Models that ship

Made by `python -m experiments models` from experiments/models.toml: of every lens of lenses/ the best polynomial of at most
64 coefficients a vector output and the best network of two layers of 16 units, each fitted within half a minute,
over the whole lit film, full aperture, focus from infinity to near and all wavelengths for which the glasses are known;
of a few lenses also faster ones. Errors on held-out rays (`neurolens.evaluate.rays`), micrometres at an image radius of
21.6 mm; every card was checked on fresh rays. Times on one core in onnxruntime, with stop, rims and transmittance;
speed-up over the compiled exact tracer doing the same work in the same run. Check a model with
`neurolens evaluate models/FILE`; `make bench` holds those of the first lenses to the speed-ups that the index promises.

| model | RMS um | p99 um | direction deg | position um | T RMS | false pass / block % | coefficients | kB | ns per ray | speed-up |
|---|---|---|---|---|---|---|---|---|---|---|
"""  # noqa: E501


def write_index(rows: Sequence[Mapping[str, Any]], left_out: Mapping[str, str], out: Path) -> None:
    """Write both; `left_out` gives the reason for each entry that has no models."""
    index = {
        "schema": 2,
        "command": "python -m experiments models",
        "versions": versions(),
        "models": list(rows),
        "left_out": dict(left_out),
    }
    atomic_write_text(out / "index.json", json.dumps(index, indent=1, allow_nan=False) + "\n")
    lines = [_line(row) for row in rows]
    if left_out:
        lines += ["", "Not made:", "", *(f"- {state}: {reason}" for state, reason in left_out.items())]
    atomic_write_text(out / "README.md", _HEAD + "\n".join(lines) + "\n")


def _line(row: Mapping[str, Any]) -> str:
    um, p99, position = (
        row.get(f"{key}_at_21_6", row.get(key)) for key in ("rms_um", "p99_um", "position_rms_um")
    )  # fmt: skip
    cells = [
        row["file"] + (" (card does not hold)" if row.get("broken") else ""),
        _n(um),
        _n(p99),
        _n(row["direction_rms_deg"]),
        _n(position),
        _n(row["transmittance_rms"]),
        f"{_n(row['false_pass'], 100)} / {_n(row['false_block'], 100)}",
        str(row["coefficients_per_vector"] or row["parameters"]),
        f"{row['bytes'] / 1000:.0f}",
        _n((row["ns_per_ray"] or {}).get("min")),
        _n(row["speedup_over_compiled"]),
    ]
    return "| " + " | ".join(cells) + " |"


def _n(value: float | None, factor: float = 1.0) -> str:
    return "–" if value is None else f"{value * factor:.3g}"
