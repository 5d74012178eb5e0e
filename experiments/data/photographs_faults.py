"""Lens tables broken on purpose: whether the check of `table_faults` finds the fault, and names the change.

The tables are the primes of OpticsDatabase (github.com/amegahed/OpticsDatabase, MIT licence; its folder is to be named)
whose match with a profile of lensfun is certain and whose distortion was measured. Each is broken once in every kind
(chosen by a seed), of an asphere at each surface that has one. Whether a fault is found is asked of every table, and
which change is named of those of some lenses, for the search takes seconds. Writes faults.md and faults.json.

With --alarms nothing is broken: any folder of lens files will do, and alarms.md has the share of tables that alarm, by
group. Zooms are asked at the shortest, middle and longest measured focal length near a state of their table.
"""

from __future__ import annotations

import argparse
import math
import random
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from experiments import lab
from experiments.data.table_faults import (
    ALARM,
    ONE_OF,
    VARIES,
    alarm,
    changed,
    check,
    focal_lengths,
    glasses,
    opened_at,
    swapped,
    transposed,
)
from experiments.data.table_figures import Measures, measure
from experiments.lab import Row
from neurolens.base.errors import InputError, NeurolensError, NeurolensWarning
from neurolens.optics.lens.figures import SPHERE
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.photographs.profiles import Profile
from neurolens.optics.photographs.verify import found_for
from neurolens.optics.readers.any_format import read_any

SEVERAL = "all of several aspheres dropped"  # which no single change mends
_GROUPS = {"certain": "primes, certain match", "likely": "primes, likely match",
           "fixed": "fixed-aperture zooms", "variable": "variable-aperture zooms"}  # fmt: skip
SEEN = 0.3  # percent by which a dropped asphere changes distortion, from which it should be found

OPTIONS = (
    lab.option("folder", metavar="FOLDER", type=Path, help="clone of github.com/amegahed/OpticsDatabase"),
    lab.count("lenses", 40, "lenses whose faults are to be named (default: 40)"),
    lab.count("seed", 1, "of the choices"), lab.ONLY, lab.out(),
    lab.option("--alarms", action="store_true", help="only whether tables as they are alarm; breaks none"),
)  # fmt: skip


def broken(lens: Lens, some: random.Random) -> Iterator[tuple[str, str, Lens]]:
    """Kind, what the sentence must hold that names the fault, and the broken table."""
    rows = lens.surfaces
    curved = [k for k, s in enumerate(rows) if math.isfinite(s.radius_mm) and not s.stop]
    aspheric = [k for k, s in enumerate(rows) if s.figure.asphere or s.figure.conic]
    k = some.choice(curved)
    yield "sign of a radius", f"sign of the radius of surface {k} ", changed(lens, k, radius_mm=-rows[k].radius_mm)
    for k in some.sample(aspheric, len(aspheric)):
        yield "asphere dropped", f"at surface {k} ", changed(lens, k, figure=SPHERE)
    if len(aspheric) > 1:
        plain = [replace(s, figure=SPHERE) for s in rows]
        yield SEVERAL, "(no single change)", replace(lens, surfaces=tuple(plain))
    for k in [k for k in some.sample(aspheric, len(aspheric)) if rows[k].figure.asphere][:1]:
        n = some.randrange(len(rows[k].figure.asphere))
        (power, a), factor = rows[k].figure.asphere[n], some.choice((0.1, 10.0))
        where, back = f"of the coefficient of power {power} of surface {k} ", "10 times" if factor < 1 else "a tenth"
        for kind, word, value in (("sign", "sign", -a), ("exponent", f"({back})", a * factor)):
            terms = (*rows[k].figure.asphere[:n], (power, value), *rows[k].figure.asphere[n + 1 :])
            figure = replace(rows[k].figure, asphere=terms)
            yield f"{kind} of an asphere's term", f"{word} {where}", changed(lens, k, figure=figure)
    pairs = [(a, b) for a, b in pairwise(glasses(lens)) if float(rows[a].n_d) != float(rows[b].n_d)]
    for a, b in some.sample(pairs, min(1, len(pairs))):
        yield "glasses swapped", f"glasses after surfaces {a} and {b} ", swapped(lens, a, b)
    for field in ("radius_mm", "thickness_mm", "n_d"):
        each = [(k, v) for k, s in enumerate(rows) if not s.stop for v in transposed(float(getattr(s, field)))]
        each = [(k, v) for k, v in each if field != "n_d" or (1.3 < v < 2.3 and rows[k].glass is None)]
        for k, v in some.sample(each, min(1, len(each))):
            before = float(f"{float(getattr(rows[k], field)):.6g}")
            yield f"digits of {field}", f"digits: {field} of surface {k} {before:g} ", changed(lens, k, **{field: v})
    unit, factor = some.choice((("centimetres", 0.1), ("inches", 1 / 25.4)))
    yield "units", f"units: the figures are {unit} ", lens.scaled(factor)


def of_folder(folder: Path, only: str, quiet: bool) -> list[tuple[str, str, Lens, Profile]]:
    """Name, certainty of the match (of zooms with a certain one, their kind), table, profile."""
    found = []
    files = sorted(p for p in folder.rglob("*") if p.suffix.lower() in (".zmx", ".toml") and only in p.stem)
    if not files:
        raise InputError(folder, "files", "(no .zmx and no .toml)", "a clone of OpticsDatabase")
    for file in lab.counted(files, "files", quiet):
        try:
            lens = read_any(file)
            match, profiles, _ = found_for(lens)
        except NeurolensError:
            continue
        zoom = len(profiles[0].focal_mm) > 1
        if (
            profiles[0].distortion
            and not lens.anamorphic
            and not lens.ideal
            and not (zoom and match.certainty != "certain")
        ):
            kind = "variable" if VARIES.search(profiles[0].model) else "fixed"
            found.append((file.stem, kind if zoom else match.certainty, lens, profiles[0]))
    return found


def alarms_of(lens: Lens, profile: Profile) -> list[Row]:
    """What the table as it is raises, at the ends of a zoom's measured focal lengths and in the middle."""
    known = focal_lengths(lens, profile)
    rows: list[Row] = []
    for focal in dict.fromkeys((known[0], known[len(known) // 2], known[-1])):
        found = measure([opened_at(lens, profile, focal)], profile, focal).figures
        over = {name: float(v[0]) for name, v in found._asdict().items() if v[0] > getattr(ALARM, name)}
        rows.append({"focal_mm": focal, "alarm": float(alarm(found)[0]), "beyond": over})
    return rows


def alarms_page(groups: dict[str, list[list[Row]]], title: str) -> str:
    """The share of tables that alarm, by group, and what they alarm by."""
    lines = []
    for group, text in (pair for pair in _GROUPS.items() if pair[0] in groups):
        tables = groups[group]
        rows = [row for each in tables for row in each]
        middle = [each[len(each) // 2] for each in tables]
        why = Counter(name for row in rows for name in row["beyond"])
        told = ", ".join(f"{name} {count}" for name, count in why.most_common(3))
        lines.append([text, str(len(tables)), _share(middle), str(len(rows)), _share(rows), told])
    return lab.page(
        f"# Alarms of tables as they are: {title}",
        f"`python -m experiments photographs-faults FOLDER --alarms`; {lab.machine_line()}",
        lab.table("tables|number|alarms in the middle|states|alarms of states|by most often", lines),
        "States: a prime, or the shortest, middle and longest measured focal length near a state of the table. "
        "The limits were set by OpticsDatabase's primes of certain match; no other group here set any, but primes of "
        "other collections are partly of the same patents. Some alarms are real: tables are transcribed.",
    )


def _share(rows: Sequence[Row]) -> str:
    count = sum(row["alarm"] > 1 for row in rows)
    return f"{count} ({100 * count / max(len(rows), 1):.0f}%)"


def rows_of(lens: Lens, profile: Profile, seed: str, named: bool) -> list[Row]:
    """The sound table, and each of its broken ones."""
    known = focal_lengths(lens, profile)
    focal = known[len(known) // 2]
    lens = opened_at(lens, profile, focal)
    some = random.Random(seed)

    def figures(table: Lens) -> Measures:
        return measure([table], profile, focal).figures

    sound = figures(lens)
    rows: list[Row] = [{"kind": "sound", "alarm": float(alarm(sound)[0]), "figures": [float(v[0]) for v in sound]}]
    if len(profile.focal_mm) > 1 or rows[0]["alarm"] > 1:
        return rows
    told: set[str] = set()
    for kind, right, table in broken(lens, some):
        found = figures(table)
        row: Row = {"kind": kind, "alarm": float(alarm(found)[0]), "right": right}
        row["moved"] = abs(float(found.distortion[0] - sound.distortion[0]))
        if named and row["alarm"] > 1 and kind not in told and kind != SEVERAL:
            told.add(kind)
            checked = check(table, profile)
            row |= {"change": checked.change, "said": checked.said[-1]}
        rows.append(row)
    return rows


def _line(kind: str, rows: Sequence[Row]) -> list[str]:
    asked = [r for r in rows if "said" in r]
    sound = [r for r in asked if r["change"]]
    named = [(r["right"], [f"{one} " for one in r["change"].removeprefix(ONE_OF).split("; ")]) for r in sound]
    right = [(own, each) for own, each in named if any(own in one for one in each)]
    first = [own for own, each in right if own in each[0]]
    return [
        kind,
        str(len(rows)),
        _share(rows),
        str(len(asked)),
        str(len(sound)),
        str(len(right)),
        str(len(first)),
    ]


def page(groups: dict[str, list[list[Row]]]) -> str:
    """The table of kinds, and of the alarms of sound tables."""
    rows = [row for each in groups["certain"] for row in each if row["kind"] != "sound"]
    kinds = dict.fromkeys(row["kind"] for row in rows)
    lines = []
    for kind in kinds:
        some = [r for r in rows if r["kind"] == kind]
        lines.append(_line(kind, some))
        if "dropped" in kind:
            lines.append(_line(f"... that change distortion by over {SEEN}%", [r for r in some if r["moved"] > SEEN]))
    alarms = []
    for group, text in (pair for pair in _GROUPS.items() if pair[0] in groups):
        each = [r for found in groups[group] for r in found if r["kind"] == "sound"]
        alarms.append([text, str(len(each)), _share(each)])
    figures = np.array([r["figures"] for found in groups["certain"] for r in found if r["kind"] == "sound"])
    told = [[name, *(f"{v:.3g}" for v in np.percentile(column, (50, 90, 95, 98), method="lower"))]
            for name, column in zip(Measures._fields, figures.T, strict=True)]  # fmt: skip
    return lab.page(
        "# Lens tables broken on purpose",
        f"`python -m experiments photographs-faults FOLDER`: what `table_faults` finds; {lab.machine_line()}",
        "## Faults", lab.table("kind|tables|found|asked for|told|the right one among them|it is first", lines),
        "Up to four changes that fit alike are named. A dropped asphere counts as found at its surface. Some faults "
        "are no single change. Only tables that raise no alarm are broken.",
        "## Alarms of tables as they are", lab.table("tables|tables|alarms", alarms),
        "## Figures of tables as they are (certain matches)", lab.table("figure|50%|90%|95%|98%", told),
    )  # fmt: skip


def run(args: argparse.Namespace) -> None:
    """Break, check, write."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", NeurolensWarning)
    lenses = of_folder(args.folder, args.only, args.quiet)
    random.Random(args.seed).shuffle(lenses)
    left, groups = args.lenses, dict[str, list[Any]]()
    if args.alarms:
        for name, group, lens, profile in lab.counted(lenses, "lenses", args.quiet):
            try:
                rows = alarms_of(lens, profile)
            except NeurolensError:
                continue
            groups.setdefault(group, []).append([row | {"file": name} for row in rows])
        print(
            lab.write_results(args.out, "alarms", alarms_page(groups, args.folder.resolve().name), {"groups": groups})
        )
        return
    for name, group, lens, profile in lab.counted(lenses, "lenses", args.quiet):
        try:
            rows = rows_of(lens, profile, f"{args.seed} {name}", group == "certain" and left > 0)
        except NeurolensError:
            continue
        if group != "certain":
            rows = rows[:1]
        left -= any("said" in row for row in rows)
        groups.setdefault(group, []).append([row | {"file": name} for row in rows])
    print(lab.write_results(args.out, "faults", page(groups), {"machine": lab.machine(), "groups": groups}))
