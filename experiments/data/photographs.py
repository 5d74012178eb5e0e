"""A public collection of lens files against photographs: distortion, lateral colour and light, lens by lens.

The collection is OpticsDatabase (github.com/amegahed/OpticsDatabase, MIT licence): clone it, and name its folder. The
photographs are lensfun's profiles (package lensfunpy; CC BY-SA 3.0). A file counts where the match of its name with a
profile is certain or likely; `neurolens verify` says the same of one file. Writes photographs.md, photographs.json and
photographs.csv (a row for each file). Of a folder of our own lens files, which state what photographs said of each, it
writes photographs_library.md and .json: medians of the library.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
from scipy.stats import spearmanr  # type: ignore[import-untyped]

from experiments import lab
from experiments.lab import Row
from neurolens.base.errors import InputError, NeurolensError, NeurolensWarning
from neurolens.base.files import atomic_write_text
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.photographs.profiles import Profile, database
from neurolens.optics.photographs.rims import at_focal_length, fit_rims
from neurolens.optics.photographs.verify import DOUBTFUL_PERCENT, Verified, found_for, light_curves, verify
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.setting.focusing import infinity_states
from neurolens.optics.setting.rims import RimRule, derive_rims

PERCENTILES = (10, 25, 50, 75, 90)
BANDS = ("red", "blue")
WORSE = 0.02  # stops by which an aperture that was left out gets worse
SHARES = (0.3, 0.4, 0.45, 0.5, 0.55, 0.6, 0.7)  # of the pupil's height at the edge of the field, for derived rims

OPTIONS = (
    lab.option("folder", metavar="FOLDER", type=Path, help="clone of github.com/amegahed/OpticsDatabase, or lenses/"),
    lab.count("workers", 1, "processes of a thread each (default: 1)"), lab.ONLY, lab.out(),
)  # fmt: skip


def row_of(file: Path) -> Row | None:
    """What photographs say of a file; None where there is no profile for it, or it cannot be read."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", NeurolensWarning)
    row: Row = {"file": file.stem}
    try:
        lens = read_any(file)
        match, profiles, _ = found_for(lens)
        row |= {"profile": match.profile.model, "match": match.certainty, "f_number": lens.f_number}
        row["aspheres"] = sum(bool(s.figure.asphere or s.figure.conic) for s in lens.surfaces)
        began = time.process_time()
        found = verify(lens)
    except NeurolensError as error:
        return row | {"reason": str(error).removeprefix(f"{file}: ")} if "match" in row else None
    row |= {"seconds": time.process_time() - began} | figures(found)
    return row if row["zoom"] else row | fitted(lens, profiles[0]) | derived(lens, profiles[0])


def figures(found: Verified) -> Row:
    """The residuals of a lens: medians over the focal lengths of its profile; figures at the largest height."""
    curves = [c.distortion_percent for c in found.comparisons if c.distortion_percent is not None]
    focal = [c.focal_mm for c in found.comparisons]
    row: Row = {
        "crop": found.crop, "focal_mm": focal, "zoom": len(focal) > 1, "distortion": found.distortion_percent,
        "each": [c.rms for c in curves], "itself": _median([float(np.std(c.measured)) for c in curves]),
        "size": _median([c.size for c in found.comparisons]), "own": found.uncertainty_percent,
        "f8": found.light_stops(widest=False), "widest": found.light_stops(widest=True),
    }  # fmt: skip
    for band in ("red", "blue"):
        both = [c for c in (getattr(c, f"{band}_um") for c in found.comparisons) if c is not None]
        row[band] = [_median([float(getattr(c, kind)[-1]) for c in both]) for kind in ("measured", "computed")]
    return row


def fitted(lens: Lens, profile: Profile) -> Row:
    """Residuals of light at the two widest apertures: before, with rims fitted to all, and with it left out."""
    try:
        whole = fit_rims(lens, profile)
    except InputError:
        return {}
    found: Row = {"front": whole.front, "rear": whole.rear, "rings": len(whole.rings)}
    found["fitted"] = [(f, whole.before_stops[f], whole.after_stops[f]) for f in whole.before_stops]
    widest = sorted(whole.before_stops)[:2]
    if len(whole.before_stops) > 2:
        found["unused"] = [(f, whole.before_stops[f], fit_rims(lens, profile, [f]).after_stops[f]) for f in widest]
    return found


def derived(lens: Lens, profile: Profile) -> Row:
    """Light at the widest aperture with rims by the rule, by share: root mean square and mean difference, stops."""
    if not profile.light:
        return {}
    focal_mm = profile.light[0].focal_mm
    lens, lights = at_focal_length(lens, focal_mm), profile.light_at(focal_mm)[:1]
    edged = replace(lens, image_radius_mm=lens.image_radius_mm or profile.half_diagonal_mm)
    found = []
    for share in SHARES:
        try:
            ruled = replace(derive_rims(edged, RimRule(share))[0], film_z_mm=lens.film_z_mm)
            curve = light_curves(ruled, profile, lights)[lights[0].f_number]
        except InputError:  # a field that no chief ray reaches
            return {}
        found.append((curve.rms, float(np.nanmean(curve.computed - curve.measured))))
    return {"derived": found}


def _median(values: Sequence[float]) -> float:
    known = [v for v in values if np.isfinite(v)]
    return float(np.median(known)) if known else float("nan")


def _line(name: str, values: Iterable[float], form: str = ".3f") -> list[str]:
    known = np.array([v for v in values if np.isfinite(v)])
    found = [format(v, form) for v in np.percentile(known, PERCENTILES)] if len(known) else ["-"] * len(PERCENTILES)
    return [name, str(len(known)), *found]


def _table_of(name: str, some: list[Row]) -> str:
    """The percentiles of all comparisons of primes, or of zooms."""
    certain = [r for r in some if r["match"] == "certain"]
    sound = [r for r in certain if r["distortion"] <= DOUBTFUL_PERCENT]
    lines = [
        _line("distortion, % of the height", (r["distortion"] for r in some)),
        _line("the same, certain matches", (r["distortion"] for r in certain)),
        _line("... that `verify` does not doubt", (r["distortion"] for r in sound)),
        _line("the distortion itself", (r["itself"] for r in certain)),
        _line("two cameras with one lens", (r["own"] for r in certain)),
        _line("light near f/8, stops", (r["f8"] for r in certain)),
        _line("light at the widest aperture", (r["widest"] for r in certain)),
        *(_line(f"{band} beside green, µm", (abs(r[band][0] - r[band][1]) for r in sound), ".1f") for band in BANDS),
        *(_line(f"{band} itself, µm", (abs(r[band][0]) for r in sound), ".1f") for band in BANDS),
    ]
    alike = []
    for band in BANDS:
        pairs = np.array([r[band] for r in sound if np.isfinite(r[band]).all()])
        if len(pairs) > 2:
            alike.append(f"{band} {spearmanr(*pairs.T).statistic:.2f}")
    header = "what|lenses|" + "|".join(f"{q}%" for q in PERCENTILES)
    ranks = f"Rank correlation of measured and computed lateral colour: {', '.join(alike)}."
    return lab.page(f"## {name}", lab.table(header, lines), ranks if alike else "")


def _rims_of(some: list[Row]) -> str:
    """What fitted rims are worth, at apertures that they were fitted to and at others."""
    fits = [r["fitted"] for r in some if r.get("fitted")]
    unused = [r["unused"] for r in some if r.get("unused")]
    names = ("widest aperture", "next aperture")
    lines = []
    for k, name in enumerate(names):
        lines.append(_line(f"{name}: before", (f[k][1] for f in fits if len(f) > k)))
        lines.append(_line(f"{name}: fitted to all", (f[k][2] for f in fits if len(f) > k)))
        lines.append(_line(f"{name}: fitted to all others", (u[k][2] for u in unused)))
    worse = [[after > before + WORSE for _, before, after in u] for u in unused]
    rings = sum(r["rings"] > 0 for r in some if r.get("fitted"))
    header = "light, stops (root mean square over heights)|lenses|" + "|".join(f"{q}%" for q in PERCENTILES)
    note = ""
    if worse:
        share = " and ".join(f"{100 * v:.0f}% ({n})" for v, n in zip(np.mean(worse, axis=0), names, strict=True))
        note = (
            f"Each of the two widest apertures of {len(worse)} lenses was left out once: {share} of the lenses get "
            f"worse there by over {WORSE} stops. The next-widest lies between apertures that were used, the widest "
            f"lies beyond them. {rings} of {len(fits)} lenses get a ring."
        )
    return lab.page("## Rims fitted to photographs (primes)", lab.table(header, lines), note)


def _goals_of(some: list[Row]) -> str:
    """The goals that primes were to reach, and what they reached."""
    certain = [r for r in some if r["match"] == "certain"]
    sound = [r["distortion"] for r in certain if r["distortion"] <= DOUBTFUL_PERCENT]
    fits, unused = ([r[name] for r in some if r.get(name)] for name in ("fitted", "unused"))
    worse = np.mean([[100.0 * (after > before + WORSE) for _, before, after in u] for u in unused], axis=0)
    goals = [
        ("distortion of tables that `verify` does not doubt, %: median", 0.075, np.median(sound)),
        ("the same: 90%", 0.25, np.percentile(sound, 90)),
        ("light near f/8, stops: median", 0.06, np.nanmedian([r["f8"] for r in certain])),
        ("widest aperture, rims fitted to all, stops: median", 0.07, np.median([f[0][2] for f in fits])),
        ("next aperture, left out of the fit, stops: median", 0.07, np.median([u[1][2] for u in unused])),
        (f"next apertures left out that get worse by over {WORSE} stops, %", 5.0, worse[1]),
        (f"widest apertures left out that get worse by over {WORSE} stops, %", 5.0, worse[0]),
    ]
    rows = [[what, f"{goal:g}", f"{found:.2g}", "yes" if found <= goal else "no"] for what, goal, found in goals]
    why = (
        "The widest aperture is seen by rims that no narrower one is cut by: without it, their place is a guess. Tried "
        "once, and not taken: a preference for the table's rims that is 10 or 30 times as strong (65 lenses) leaves "
        "the last share at 20 to 22% and takes the fit to all apertures from 0.065 to 0.081 stops; half of the change "
        "(127 lenses) makes it 9%, but the residual there from 0.131 to 0.148 stops (90%: 0.286 to 0.446) and at the "
        "next aperture, which is used, from 0.05 to 0.09."
    )
    return lab.page("## Goals (primes)", lab.table("what|at most|found|met", rows), why if worse[0] > 5 else "")


def _derived_of(some: list[Row]) -> str:
    """What the rule for tables without diameters is worth, by the share of the pupil that it keeps."""
    known = [r for r in some if r["match"] == "certain" and np.isfinite(r.get("derived", np.nan)).all()]
    lines = [_line("the collection's own rims", (r["widest"] for r in known))]
    for k, share in enumerate(SHARES):
        lines.append(_line(f"share {share:g}", (r["derived"][k][0] for r in known)))
        lines.append(_line(f"share {share:g}: computed less measured", (r["derived"][k][1] for r in known)))
    header = "light at the widest aperture, stops|lenses|" + "|".join(f"{q}%" for q in PERCENTILES)
    note = "A share is the part of the pupil's height that the rule keeps at the edge of the field. It takes 0.5."
    return lab.page("## Rims derived by the rule (primes, certain matches)", lab.table(header, lines), note)


def page(rows: list[Row]) -> str:
    """The tables of percentiles, and the lenses that differ most."""
    good = [r for r in rows if "reason" not in r]
    primes, zooms = [r for r in good if not r["zoom"]], [r for r in good if r["zoom"]]
    seconds = np.array([r["seconds"] / len(r["focal_mm"]) for r in good])
    worst = sorted((r for r in good if np.isfinite(r["distortion"])), key=lambda r: -r["distortion"])[:20]
    told = [[r["file"], r["profile"], r["match"], f"{r['distortion']:.2f}", f"{r['itself']:.2f}"] for r in worst]
    refused = [[r["file"], r["profile"], r["reason"]] for r in rows if "reason" in r]
    return lab.page(
        "# A public collection against photographs",
        f"`python -m experiments photographs FOLDER`: {len(good)} lenses of OpticsDatabase with a profile of lensfun "
        f"({len(primes)} primes, {len(zooms)} zooms); {np.median(seconds):.1f} s of CPU a lens and focal length "
        f"(median), {seconds.max():.1f} at most; {lab.machine_line()}",
        "Differences are root mean squares over image heights; of a zoom, medians over focal lengths. Colour is that "
        "at the largest height, of lenses whose distortion `verify` does not doubt.",
        _goals_of(primes) if any(r.get("unused") for r in primes) else "",
        _table_of("Primes", primes), _table_of("Zooms", zooms), _rims_of(primes), _derived_of(primes),
        "## The twenty that differ most in distortion",
        lab.table("file|profile|match|difference, %|distortion itself, %", told),
        "## Not compared" if refused else "", lab.table("file|profile|why", refused) if refused else "",
    )  # fmt: skip


COLUMNS = lab.columns(
    ("file", "file"), ("profile", "profile"), ("match", "match"), ("crop", "crop", ".3g"),
    ("focal lengths mm", lambda r: " ".join(f"{f:g}" for f in r.get("focal_mm", ()))), ("aspheres", "aspheres"),
    ("distortion %", "distortion", ".3f"), ("itself %", "itself", ".3f"),
    ("size", "size", ".3f"), ("two cameras %", "own", ".3f"),
    ("light f/8", "f8", ".3f"), ("light widest", "widest", ".3f"),
    *((f"{band} {kind} um", lambda r, b=band, k=k: r[b][k] if b in r else None, ".1f")
      for band in BANDS for k, kind in enumerate(("measured", "computed"))),
    *((f"light {name} {which}", lambda r, k=k, j=j: r["fitted"][k][j] if len(r.get("fitted", ())) > k else None, ".3f")
      for k, name in enumerate(("widest", "next")) for j, which in ((1, "before"), (2, "fitted"))),
    *((f"light {name} left out", lambda r, k=k: r["unused"][k][2] if r.get("unused") else None, ".3f")
      for k, name in enumerate(("widest", "next"))),
    ("front rims", "front", ".3f"), ("rear rims", "rear", ".3f"), ("rings", "rings"),
    ("reason", "reason"),
)  # fmt: skip


STATED = {
    "distortion_percent": "distortion, % of the height",
    "light_f8_stops": "light near f/8, stops",
    "light_widest_stops": "light at the widest aperture",
}


def of_library(lenses: Sequence[Lens]) -> dict[str, dict[str, list[float]]]:
    """What the files state of certain matches: of primes and zooms, the figures of `STATED`."""
    found: dict[str, dict[str, list[float]]] = {kind: {key: [] for key in STATED} for kind in ("primes", "zooms")}
    for lens in lenses:
        measured = dict(lens.measured)
        zoom = len({c.efl_mm for c in infinity_states(lens)}) > 1
        for key in STATED if measured.get("match") == "certain" else ():
            if key in measured:
                found["zooms" if zoom else "primes"][key].append(float(measured[key]))
    return found


def library_page(found: dict[str, dict[str, list[float]]], count: int) -> str:
    """The percentiles of what the files state."""
    header = "what|lenses|" + "|".join(f"{q}%" for q in PERCENTILES)
    parts = [
        (f"## {kind.capitalize()}", lab.table(header, [_line(STATED[key], v) for key, v in figures.items()]))
        for kind, figures in found.items()
    ]
    return lab.page(
        "# The library against photographs",
        f"`python -m experiments photographs lenses`: what {count} lens files state of photographs, where the match "
        "with a profile of lensfun is certain. Differences are root mean squares over heights; of a zoom, medians "
        "over focal lengths. Lenses that their photographs contradict are left out of the library, and many rims are "
        "fitted to the same photographs.",
        *(text for part in parts for text in part),
    )


def run(args: argparse.Namespace) -> None:
    """Compare every file that has a profile, and write."""
    if own := sorted(args.folder.glob("*.toml")):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NeurolensWarning)
            lenses = [read_any(file) for file in own]
        stated = of_library(lenses)
        print(lab.write_results(args.out, "photographs_library", library_page(stated, len(own)), {"figures": stated}))
        return
    files = sorted(p for p in args.folder.rglob("*") if p.suffix.lower() == ".zmx")
    if not files:
        raise InputError(args.folder, "files", "(no .zmx)", "a clone of OpticsDatabase")
    files = lab.chosen(files, lambda p: p.stem, args.only, "photographs")
    database()  # once, for all processes
    with ProcessPoolExecutor(args.workers, mp_context=get_context("fork")) as pool:
        found = pool.map(row_of, files, chunksize=4)
        rows = [row for _ in lab.counted(files, "files", args.quiet) if (row := next(found)) is not None]
    print(lab.write_results(args.out, "photographs", page(rows), {"machine": lab.machine(), "rows": rows}))
    atomic_write_text(args.out / "photographs.csv", lab.csv_text(COLUMNS, rows))
