"""A public collection of lens files: what is read, what is refused and why, and agreement with ray-optics.

The collection is OpticsDatabase (github.com/amegahed/OpticsDatabase, MIT licence, 1,218 Zemax files); it is not stored
in this project: clone it, and name its folder. The independent tracer is ray-optics 0.9.8 (BSD 3-clause licence); it
brings a toolkit for windows, and so it lives in an environment of its own:

    git clone https://github.com/amegahed/OpticsDatabase
    python3 -m venv /tmp/ray-optics
    /tmp/ray-optics/bin/pip install rayoptics==0.9.8
    python -m experiments collection OpticsDatabase --ray-optics /tmp/ray-optics/bin/python

Both programs read each file. Compared are focal length, back focus, and the image heights of real chief rays (through
the middle of the stop, rims ignored) at 0.3, 0.7 and all of the field that both reach, with the object at infinity.
Where a figure differs, ray-optics is asked again with what it is known to read wrongly put right: that names the cause.
Writes collection.md, collection.json and collection.csv (a row for each file). Answers of ray-optics are kept in
runs/collection, so that later runs ask it for new files alone.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import subprocess
import time
import warnings
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments import lab
from experiments.lab import Row
from neurolens.base.errors import AssumedWarning, InputError, NeurolensError, NeurolensWarning
from neurolens.base.files import atomic_write_text, fingerprint_of, sha256_of
from neurolens.base.progress import Progress, Report
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.lens.glass import index_of
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.readers.any_format import read_any

SCRIPT = Path(__file__).with_name("ray_optics.py")
KEPT = lab.ROOT / "runs" / "collection" / "ray_optics.json"
LIMIT = 1e-4  # relative; a file that differs by more needs a named cause
PARAXIAL = "its paraxial rays leave out terms of r^2"  # a cause
READ_GOAL = 0.97
TENTHS = range(1, 11)  # of the file's field, at which chief rays are traced
SHARES = (0.3, 0.7, 1.0)  # of the field that both programs reach, at which they are compared
AS_FILED = "as filed"  # name of the state of a file without states that is focused near
SMALL_FIELD_DEG = 1.0  # for files that state no field
AT_ONCE = 50  # files for one process of ray-optics, after which the answers are kept


# ---- What neurolens reads. -------------------------------------------------------------------------------------------


def own_row(path: Path, name: str) -> Row:
    """The verdict on a file, its reason, the notes of the reader, and the figures that are compared."""
    row: Row = {"file": name, "sha256": sha256_of(path), "reason": ""}
    began = time.perf_counter()
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always", NeurolensWarning)
        try:
            lens = read_any(path)
            row |= {"verdict": "read", "seconds": time.perf_counter() - began} | figures_of(lens)
        except NeurolensError as error:
            row |= {"verdict": "refused", "reason": str(error).removeprefix(f"{path}: ")}
        except Exception as error:  # a fault of ours, which the table has to show
            row |= {"verdict": "fault", "reason": f"{type(error).__name__}: {error}"}
    notes = {str(w.message).removeprefix(f"{path}: "): issubclass(w.category, AssumedWarning) for w in heard}
    return row | {"notes": list(notes), "assumed": [text for text, assumed in notes.items() if assumed]}


def figures_of(lens: Lens) -> Row:
    """First-order data and heights of chief rays; see `ray_optics` for where lengths count from."""
    light, z, scene = lens.reference_nm, lens.vertices_mm, Scene(lens)
    index = [float(index_of(medium, light)) for medium in lens.media]
    changes = [k for k in range(len(lens.surfaces)) if index[k + 1] != index[k]]
    fields = [edge_deg(lens) * tenth / 10 for tenth in TENTHS]
    heights = scene.chief_rays(fields, light).height_mm.tolist()

    def focal(state: Lens) -> list[float]:
        data = first_order(state)
        return [float(data.efl_mm), float(data.rear_focal_z_mm) - state.vertices_mm[changes[-1]]]

    efl, back = focal(lens)
    return {
        "wavelength_nm": light,
        "efl_mm": efl,
        "back_mm": back,
        "states": [focal(lens.with_gaps(dict(c.thickness_mm))) for c in lens.configurations if c.name != AS_FILED],
        "film_mm": scene.film_z_mm - z[changes[-1]],
        "fields_deg": fields,
        "heights_mm": [None if math.isnan(height) else height for height in heights],
        "stop_z_mm": z[lens.stop_index] - z[changes[0]],
        "index": [index[k + 1] for k in changes],
    }


def edge_deg(lens: Lens) -> float:
    """The field that the file states, as an angle; an image height as a lens without distortion has it."""
    if lens.half_field_deg:
        return lens.half_field_deg
    radius = lens.image_radius_mm
    return math.degrees(math.atan(radius / abs(first_order(lens).efl_mm))) if radius else SMALL_FIELD_DEG


# ---- What ray-optics reads. ------------------------------------------------------------------------------------------


class RayOptics:
    """Answers of ray-optics, kept in a file by the hash of what decides them."""

    def __init__(self, python: Path, folder: Path) -> None:
        self.python, self.folder = python, folder
        self.kept = {row["key"]: row for row in lab.kept_rows(KEPT, "experiments collection")}

    def ask(self, rows: Sequence[Row], mend: bool, report: Report) -> dict[str, Row]:
        """The answers for files that neurolens has read, by name.

        Raises:
            InputError: a program that does not run ray-optics.
        """
        keys = ("wavelength_nm", "fields_deg", "stop_z_mm", *(["index"] if mend else ()))
        tasks = {r["file"]: {key: r[key] for key in keys} | {"mend": mend} for r in rows}
        script = sha256_of(SCRIPT)
        key = {r["file"]: fingerprint_of([script, r["sha256"], tasks[r["file"]]]) for r in rows}
        new = [name for name in tasks if key[name] not in self.kept]
        for begin in range(0, len(new), AT_ONCE):
            names = new[begin : begin + AT_ONCE]
            for name, found in zip(names, self._answers([tasks[n] | {"file": n} for n in names]), strict=True):
                self.kept[key[name]] = found | {"key": key[name]}
            atomic_write_text(KEPT, json.dumps(list(self.kept.values())))
            report((begin + len(names)) / len(new))
        return {name: self.kept[key[name]] for name in tasks}

    def _answers(self, tasks: Sequence[Row]) -> list[Row]:
        named = [task | {"file": str((self.folder / task["file"]).resolve())} for task in tasks]
        text = "".join(json.dumps(task) + "\n" for task in named)
        KEPT.parent.mkdir(parents=True, exist_ok=True)  # where ray-optics writes its own log, too
        options: Any = {"capture_output": True, "text": True, "check": False, "cwd": KEPT.parent}
        try:
            done = subprocess.run([self.python, SCRIPT], input=text, **options)
        except OSError as error:
            raise InputError("experiments collection", "--ray-optics", str(self.python), "a Python program") from error
        lines = done.stdout.splitlines()
        if len(lines) != len(tasks):
            said = " ".join(done.stderr.splitlines()[-1:])
            raise InputError("experiments collection", "--ray-optics", f"({said})", "a Python with ray-optics 0.9.8")
        return [json.loads(line) for line in lines]


# ---- How they differ, and why. ---------------------------------------------------------------------------------------


def differences(own: Row, theirs: Row) -> Row:
    """Relative differences: of lengths along the axis over the focal length, of image heights over themselves."""
    focal = abs(theirs["efl_mm"])
    pairs = list(zip(own["heights_mm"], theirs["heights_mm"], strict=False))
    reached = next((k for k, pair in enumerate(pairs) if None in pair), len(pairs))
    found = {key: abs(own[f"{key}_mm"] - theirs[f"{key}_mm"]) / focal for key in ("efl", "back", "film")}
    if len(own["states"]) != len(theirs["states"]):
        found["states"] = math.inf
    elif own["states"]:
        both = np.array(own["states"]), np.array(theirs["states"])
        found["states"] = float((np.abs(both[0] - both[1]) / np.abs(both[1][:, :1])).max())
    for share in SHARES if reached else ():
        a, b = pairs[max(1, round(share * reached)) - 1]
        found[f"height {share:g}"] = abs(a / b - 1) if b else abs(a)
    return found


def judged(own: Row, theirs: Row, mended: Row | None) -> Row:
    """The differences of a file, and their cause: "" where there is none above the limit, None for an unknown one.

    Args:
        mended: the answer of ray-optics after its known faults were put right; None where that was not tried.
    """
    read = [(answer, answer.get("mended", [])) for answer in (theirs, mended) if answer and "error" not in answer]
    if not read:
        return {"cause": f"ray-optics does not read it: {theirs['error']}"}
    found = differences(own, read[0][0])
    row: Row = {"differences": found, "reach": [reach(own), reach(read[0][0])], "cause": None}
    if read[0][0] is theirs and max(found.values()) <= LIMIT:
        return row | {"cause": ""}
    for answer, names in read:
        efl, back = answer["rays"]
        for rays, more in (({}, []), ({"efl_mm": efl, "back_mm": back}, [PARAXIAL])):
            rest = differences(own, answer | rays)
            if row["cause"] is None and max(rest.values()) <= LIMIT:
                row |= {"cause": "; ".join([*names, *more]), "rest": max(rest.values())}
    return row


def reach(row: Row) -> int:
    """The number of tenths of the field that have a chief ray."""
    return next((k for k, height in enumerate(row["heights_mm"]) if height is None), len(row["heights_mm"]))


# ---- The page. -------------------------------------------------------------------------------------------------------


def kind_of(text: str) -> str:
    """A message without the figures and names that only one file has."""
    text = re.sub(r"\bline \d+(, )?", "", text)
    text = re.sub(r"(\bglass )\S+( is taken as )\S+", r"\1...\2...", text)
    text = re.sub(r"'[^']*'|\"[^\"]*\"", "'...'", text)
    text = re.sub(r"[-+]?\b\d[\d.]*(e[-+]?\d+)?", "#", text, flags=re.IGNORECASE)
    return re.sub(r"#((, | to | )#)+", "#", text)


def grouped(pairs: Iterable[tuple[Row, str]]) -> list[tuple[str, list[Row]]]:
    """Files by the kind of what was said of them, the commonest first."""
    groups: dict[str, list[Row]] = {}
    for row, text in pairs:
        rows = groups.setdefault(kind_of(text), [])
        if row not in rows:
            rows.append(row)
    return sorted(groups.items(), key=lambda item: -len(item[1]))


def stem(row: Row) -> str:
    return Path(row["file"]).stem


WHY = {
    "describes a mirror": "catadioptric lenses: mirrors change rays, and the lens model has none",
    "XOSPHERE": "the file is wrong: terms of odd and even powers stand in the places of even ones",
    "GLAS: got '...', expected a glass of the catalogue": "a cement that no catalogue of glasses has, without an index",
    "overlap": "a figure is wrong: no rims clear it, or only some that cut the axial beam",
    "PARM": "the file is wrong: question marks in a number",
    "SURF": "the file is wrong: its surfaces are numbered out of order, one may be missing",
    "decimal commas": "a decimal comma may also part two numbers",
    "GLAS": "the file is wrong: a word or a question mark stands for the Abbe number",
    "back focus": "an eyepiece whose focus lies inside: no film can stand there",
    "OBNA": "an aperture in the object's space, whose distance is not that of use",
}


def _why(kind: str) -> str:
    return next((why for part, why in WHY.items() if part in kind), "")


def page(rows: list[Row]) -> str:
    """The result as Markdown."""
    read = [r for r in rows if r["verdict"] == "read"]
    parts = [_summary(rows, read)]
    refused = [(r, r["reason"]) for r in rows if r["verdict"] != "read"]
    shown = [[len(found), text, _why(text), "; ".join(map(stem, found))] for text, found in grouped(refused)]
    parts += ["## Refused", lab.table("files|reason|why it is right|which", shown)]
    for title, key in (("Assumed", "assumed"), ("Told", "notes")):
        pairs = [(r, text) for r in read for text in r[key] if key == "assumed" or text not in r["assumed"]]
        shown = [[len(some), text, stem(some[0])] for text, some in grouped(pairs)]
        parts += [f"## {title}", lab.table("files|what|the first", shown)]
    if any("cause" in r for r in read):
        parts += _agreement(read)
    return lab.page("# A public collection", "`python -m experiments collection`", *parts)


def _summary(rows: list[Row], read: list[Row]) -> str:
    compared = [r for r in read if "differences" in r]
    counts = Counter("unknown" if r["cause"] is None else "agree" if not r["cause"] else "named" for r in compared)
    goals = [lab.Goal("share of the files that are read", READ_GOAL, len(read) / len(rows), at_least=True)]
    if compared:
        goals.append(lab.Goal("files that differ without a named cause", 0, counts["unknown"]))
    seconds = sum(r.get("seconds", 0.0) for r in read)
    return lab.page(
        f"OpticsDatabase (github.com/amegahed/OpticsDatabase): {len(rows)} Zemax files, {len(read)} read in "
        f"{seconds:.0f} s, {len(compared)} compared with ray-optics 0.9.8; {counts['agree']} agree within {LIMIT:g}, "
        f"{counts['named']} differ by a named cause.",
        lab.goal_table("goal", goals),
    )


def _cause_kind(cause: str) -> str:
    return "; ".join(dict.fromkeys(re.sub(r" \(.*\)", "", part) for part in cause.split("; ")))


def _agreement(read: list[Row]) -> list[str]:
    agree = [r for r in read if r.get("cause") == ""]
    spread = []
    for key in dict.fromkeys(key for r in agree for key in r["differences"]):
        values = sorted(r["differences"][key] for r in agree if key in r["differences"])
        spread.append([key, len(values), *(f"{values[int(q * (len(values) - 1))]:.1e}" for q in (0.5, 0.99, 1.0))])
    differing = [r for r in read if r.get("cause") != ""]
    shown = []
    kinds = {r["file"]: _cause_kind(r["cause"] or "unknown") for r in differing}
    for cause in dict.fromkeys(kinds.values()):
        found = [r for r in differing if kinds[r["file"]] == cause]
        most = max((max(r.get("differences", {"": 0.0}).values()) for r in found), default=0.0)
        rest = max((r.get("rest", 0.0) for r in found), default=0.0)
        shown.append([len(found), cause, f"{most:.1e}", f"{rest:.1e}", "; ".join(map(stem, found))])
    short = [[stem(r), *(f"{10 * n}%" for n in r["reach"])] for r in read if "reach" in r and min(r["reach"]) < 10]
    return [
        "## Agreement",
        "Relative differences of the files that agree; lengths along the axis over the focal length, image heights "
        "over themselves, at shares of the field that both programs reach.",
        lab.table("figure|files|median|99%|most", spread),
        "Files that differ by more than 1e-4, and how much is left where ray-optics is given what it reads wrongly:",
        lab.table("files|cause, in ray-optics|difference|left|which", shown),
        f"Chief rays reach the whole field of the file in both programs, but in {len(short)} files:" if short else "",
        lab.table("file|neurolens|ray-optics", short) if short else "",
    ]


COLUMNS = lab.columns(
    ("file", "file"),
    ("verdict", "verdict"),
    ("focal length mm", "efl_mm", ".7g"),
    ("back focus mm", "back_mm", ".7g"),
    ("field deg", lambda r: r["fields_deg"][-1] if "fields_deg" in r else None, ".4g"),
    *((f"d {key}", f"differences.{key}", ".0e") for key in ("efl", "back", "film")),
    *((f"d height {s:g}", lambda r, s=s: r.get("differences", {}).get(f"height {s:g}"), ".0e") for s in SHARES),
    ("cause", "cause"),
    ("reason", "reason"),
)


# ---- The command. ----------------------------------------------------------------------------------------------------


def run_all(folder: Path, only: str, python: Path | None, quiet: bool) -> list[Row]:
    """One row for each file, in the order of their names.

    Raises:
        InputError: a folder without .zmx files; as `RayOptics.ask`.
    """
    files = sorted(p for p in folder.rglob("*") if p.suffix.lower() == ".zmx")
    if not files:
        raise InputError(folder, "files", "(no .zmx)", "a clone of OpticsDatabase: see `experiments collection --help`")
    names = lab.chosen([str(p.relative_to(folder)) for p in files], str, only, "collection")
    progress = Progress({"neurolens": len(names) / 20, "ray-optics": len(names) / 5}, quiet=quiet)
    rows = []
    with progress.stage("neurolens") as report:
        for count, name in enumerate(names, start=1):
            rows.append(own_row(folder / name, name))
            report(count / len(names))
    if python is None:
        return rows
    read, other = [r for r in rows if r["verdict"] == "read"], RayOptics(python, folder)
    with progress.stage("ray-optics") as report:
        first = other.ask(read, False, report)
    doubtful = [r for r in read if judged(r, first[r["file"]], None)["cause"] != ""]
    with progress.stage("ray-optics, mended") as report:
        second = other.ask(doubtful, True, report)
    for row in read:
        row |= judged(row, first[row["file"]], second.get(row["file"]))
    return rows


OPTIONS = (
    lab.option("folder", metavar="FOLDER", type=Path, help="clone of github.com/amegahed/OpticsDatabase"),
    lab.option("--ray-optics", metavar="PYTHON", type=Path, help="Python with ray-optics 0.9.8 (default: only read)"),
    lab.ONLY,
    lab.out(),
)


def run(args: argparse.Namespace) -> None:
    """Read, compare, print and write."""
    rows = run_all(args.folder, args.only, args.ray_optics, args.quiet)
    summary = {"files": len(rows), "verdicts": Counter(r["verdict"] for r in rows), "machine": lab.machine()}
    print(lab.write_results(args.out, "collection", page(rows), summary))
    atomic_write_text(args.out / "collection.csv", lab.csv_text(COLUMNS, rows))
