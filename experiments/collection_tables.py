"""Two hundred tables of the public collection as data of a test: the figures, their patent, and what ray-optics says.

A table keeps the lines that move a ray, without comments and names, as a small Zemax file named by its patent. Chosen
are those that lie farthest apart by focal length, f-number, field, surfaces, aspheres, states and age.
"""

from __future__ import annotations

import io
import json
import math
import re
import tarfile
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from experiments.collection import PARAXIAL, SHARES, TENTHS, RayOptics, own_row, reach
from experiments.lab import Row
from neurolens.base.files import atomic_path
from neurolens.base.progress import Report
from neurolens.lens.paraxial import first_order
from neurolens.lens.prescription import Lens
from neurolens.readers.source import read_text
from neurolens.study.describe import read_quietly

COUNT = 200
MOST_EFL_MM = 3000.0  # longer ones are nearly afocal: an attachment
# Keywords that are kept, with how many words behind them mean something (None: all).
SYSTEM = {"MODE": 1, "UNIT": 1, "ENPD": 1, "FNUM": 2, "FLOA": 0, "GCAT": None, "FTYP": 4, "PWAV": 1, "MNUM": 2}
SURFACE = {"SURF": 1, "TYPE": 1, "CURV": 1, "CONI": 1, "PARM": 2, "XDAT": 2, "DISZ": 1, "GLAS": 5, "DIAM": 2, "STOP": 0}
STATES = {"THIC": 3, "SDIA": 3, "APER": 3}
PATENT = re.compile(
    r"\b(?P<office>US|JP|EP|DE|GB|WO|FR|CN|KR|DD|CH)(?:P|-)?\s*(?P<number>H?\d[\d,/\-]{4,})(?:\D{1,3}Example\s*(?P<example>\d+))?"
)


def source_of(text: str, name: str) -> str | None:
    """The patent that a file cites in its title, its notes or its name, as "US 2018/0074300, example 2"."""
    lines = [line.split(None, 1)[-1] for line in text.splitlines() if line.split()[:1] in (["NAME"], ["NOTE"])]
    for line in (*lines, Path(name).stem):
        found = PATENT.search(line.replace("U.S.Patent", "US").replace(";", ""))
        if found:
            number = found["number"].rstrip(",/-")
            example = f", example {found['example']}" if found["example"] else ""
            return f"{found['office']} {number}{example}"
    return None


def table_of(text: str, source: str) -> str:
    """The lines of a Zemax file that decide where rays go, its title replaced by the patent."""
    kept, values, surface = [f"NAME {source}"], [line.split() for line in text.splitlines()], False
    for words in values:
        word = words[0] if words else ""
        surface = surface or word == "SURF"
        if word in ("XFLN", "YFLN") and any(map(float, words[1:])):
            kept.append(" ".join([word, *_without_zeros(words[1:])]))
        elif word == "WAVM" and int(words[1]) <= _wavelengths(values):
            kept.append(" ".join(words[:4]))
        elif word in SYSTEM or (surface and word in SURFACE) or word in STATES:
            count = {**SYSTEM, **SURFACE, **STATES}[word]
            if not (word in ("PARM", "CONI", "CURV") and float(words[-1 if word == "PARM" else 1]) == 0):
                kept.append(" ".join(words if count is None else words[: count + 1]))
    return "\n".join(line for line in kept if line != "TYPE STANDARD") + "\n"


def _without_zeros(words: list[str]) -> list[str]:
    last = max(k for k, word in enumerate(words) if float(word))
    return words[: last + 1]


def _wavelengths(lines: list[list[str]]) -> int:
    """How many wavelengths the file uses: the fourth number of FTYP."""
    return next((int(words[4]) for words in lines if words[:1] == ["FTYP"] and len(words) > 4), 1)


def chosen(features: np.ndarray, count: int) -> list[int]:
    """Rows [n, features] that lie far apart: each next one is the farthest from all before it."""
    scaled = (features - features.mean(0)) / np.maximum(features.std(0), 1e-9)
    taken = [int(np.argmin(np.linalg.norm(scaled, axis=1)))]
    apart = np.linalg.norm(scaled - scaled[taken[0]], axis=1)
    while len(taken) < min(count, len(scaled)):
        taken.append(int(np.argmax(apart)))
        apart = np.minimum(apart, np.linalg.norm(scaled - scaled[taken[-1]], axis=1))
    return sorted(taken)


def features_of(lens: Lens, row: Row, source: str) -> list[float]:
    """What makes lenses different from each other."""
    data, kinds = first_order(lens), [s for s in lens.surfaces if s.asphere]
    year = re.search(r"\b(19|20)\d\d(?=[/-])", source)
    return [
        2 * math.log(abs(data.efl_mm)),
        2 * math.log(data.f_number),
        math.log(row["fields_deg"][-1]),
        data.back_focus_mm / data.efl_mm,
        len(lens.surfaces),
        len(kinds),
        max((p for s in kinds for p, _ in s.asphere), default=0),
        any(p % 2 for s in kinds for p, _ in s.asphere),
        any(p == 2 for s in kinds for p, _ in s.asphere),
        any(s.conic for s in lens.surfaces),
        len(lens.configurations),
        any(s.glass for s in lens.surfaces),
        float(lens.object_medium.n_d),
        float(year[0]) if year else 1970.0,
    ]


def write_tables(file: Path, rows: Sequence[Row], other: RayOptics, report: Report) -> None:
    """Write the tables and "expected.json" to an archive (.tar.xz).

    Raises:
        InputError: as `RayOptics.ask`.
    """
    texts, candidates, features = dict[str, str](), dict[str, Row](), list[list[float]]()
    for row in rows:
        text = read_text(other.folder / row["file"])
        source = source_of(text, row["file"])
        independent = row.get("cause") is not None and "index of a glass" not in row["cause"]  # of our glass catalogue
        name = re.sub("[^a-z0-9]+", "_", (source or "").lower()) + ".zmx"
        camera = independent and abs(row["efl_mm"]) < MOST_EFL_MM
        if source and camera and name not in texts and reach(row) == len(TENTHS):
            texts[name], candidates[name] = table_of(text, source), row | {"source": source}
            features.append(features_of(read_quietly(other.folder / row["file"]), row, source))
    names = np.array(list(texts))[chosen(np.array(features), COUNT)].tolist()
    with TemporaryDirectory() as folder:
        for name in names:
            (Path(folder) / name).write_text(texts[name], encoding="utf-8")
        asked = [own_row(Path(folder) / n, n) | {"fields_deg": _fields(candidates[n])} for n in names]
        found = RayOptics(other.python, Path(folder)).ask(asked, True, report)
    lines = [
        json.dumps({"file": n, "source": candidates[n]["source"]} | _expected(r, found[n], candidates[n]["cause"]))
        for n, r in zip(names, asked, strict=True)
    ]
    texts["expected.json"] = '{"program": "ray-optics 0.9.8", "tables": [\n' + ",\n".join(lines) + "\n]}\n"
    with atomic_path(file) as temporary, tarfile.open(temporary, "w:xz", preset=9) as archive:
        for name in ("expected.json", *names):
            entry, data = tarfile.TarInfo(name), texts[name].encode()
            entry.size = len(data)
            archive.addfile(entry, io.BytesIO(data))


def _fields(row: Row) -> list[float]:
    return [row["fields_deg"][round(10 * share) - 1] for share in SHARES]


def _expected(asked: Row, answer: Row, cause: str) -> Row:
    """The figures of ray-optics to a nanometre; by real rays near the axis where its paraxial ones leave out terms."""
    efl, back = answer["rays"] if PARAXIAL in cause else (answer["efl_mm"], answer["back_mm"])
    figures = {"efl_mm": efl, "back_mm": back, "film_mm": answer["film_mm"]}
    return {
        "wavelength_nm": asked["wavelength_nm"],
        **{key: round(value, 6) for key, value in figures.items()},
        "states": [[round(value, 6) for value in state] for state in answer["states"]],
        "fields_deg": asked["fields_deg"],
        "heights_mm": [round(height, 6) for height in answer["heights_mm"]],
    }
