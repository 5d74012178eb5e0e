"""Lenses written in the formats of other programs, to their public definitions, for the readers to read back.

Each writer raises `CannotSay` for what its format has no words for.
"""

import json
import math
from dataclasses import replace

import pytest
import torch

from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.trace.rays import Rays, trace


class CannotSay(Exception):
    """The format has no words for this lens."""


def plain(lens: Lens) -> Lens:
    """The lens with media by n_d and V_d alone, bare, and without a focused film."""
    rows = (replace(s, glass=None, material=None, coating=None, absorption_per_mm=0.0) for s in lens.surfaces)
    return replace(lens, surfaces=tuple(rows), film_z_mm=None)


def swapped(old: str, new: str, text: str) -> str:
    """A text with its first `old`, which must be there, replaced."""
    assert old in text
    return text.replace(old, new, 1)


def pupil_mm(lens: Lens) -> float:
    return first_order(lens).entrance_pupil_diameter_mm


def zmx(lens: Lens) -> str:
    """Zemax, with configurations."""
    lines = ["VERS 140730 73 26155", "MODE SEQ", f"NAME {lens.name}", "UNIT MM X W X CM MR CPMM", "FLOA"]
    lines += ["ENVD 2.0E+1 1 0", "SURF 0", "  TYPE STANDARD", '  CURV 0.0 0 0 0 0 ""', "  DISZ INFINITY"]
    for k, s in enumerate(lens.surfaces, start=1):
        lines += [f"SURF {k}", *(["  STOP"] if s.stop else []), *_zmx_shape(s, k), f"  DISZ {s.thickness_mm!r}"]
        if s.n_d != 1:
            lines.append(f"  GLAS ___BLANK 1 0 {s.n_d!r} {s.V_d or 0!r} 0 0 0 0 0 0")
        lines.append(f'  DIAM {s.semi_diameter_mm!r} 1 0 0 1 ""')
    last = len(lens.surfaces) + 1
    lines += [f"SURF {last}", "  TYPE STANDARD", '  CURV 0.0 0 0 0 0 ""', "  DISZ 0", "BLNK", "EFFL 0 2 0 0 0 0 0"]
    lines.append(f"MNUM {max(1, len(lens.configurations))} 1")
    for place, c in enumerate(lens.configurations, start=1):
        lines.append(f'LTTL 0 {place} "{c.name}" 0 0 0 1 1 1 0 0')
        lines.append(f'THIC 0 {place} {c.object_distance_mm or 1e10!r} 0 0 0 1 1 1 0 0 "" 0')
        lines += [f'THIC {k + 1} {place} {t!r} 0 0 0 1 1 1 0 0 "" 0' for k, t in c.thickness_mm]
        opening = c.stop_diameter_mm or 2 * lens.stop_radius_mm
        lines.append(f'SDIA {lens.stop_index + 1} {place} {opening / 2!r} 0 0 0 1 1 1 0 0 "" 0')
    return "\n".join(lines) + "\n"


def _zmx_shape(s: Surface, k: int) -> list[str]:
    terms = dict(s.figure.asphere)
    curvature = 0.0 if math.isinf(s.radius_mm) else 1 / s.radius_mm
    conic = [f"  CONI {s.figure.conic!r}"] if s.figure.conic else []
    if s.figure.axis == "y":
        return ["  TYPE TOROIDAL", f'  CURV {curvature!r} 0 0 0 0 ""', "  PARM 1 0", *conic]
    if s.figure.axis == "x" and k % 2:
        return ["  TYPE TOROIDAL", "  CURV 0.0", f"  PARM 1 {s.radius_mm!r}"]
    if s.figure.axis == "x":
        return ["  TYPE BICONICX", "  CURV 0.0", f"  PARM 1 {s.radius_mm!r}", f"  PARM 2 {s.figure.conic!r}"]
    if not terms:
        return ["  TYPE STANDARD", f'  CURV {curvature!r} 0 0 0 0 ""', *conic]
    for kind, powers in (("EVENASPH", range(2, 17, 2)), ("ODDASPHE", range(1, 9))):
        if set(terms) <= set(powers):
            numbers = [f"  PARM {n} {terms.get(p, 0)!r}" for n, p in enumerate(powers, start=1)]
            return [f"  TYPE {kind}", f"  CURV {curvature!r}", *numbers, *conic]
    raise CannotSay(terms)


def seq(lens: Lens) -> str:
    """CODE V, with zoom positions."""
    lines = ['RDM;LEN "VERSION: 11.2"', f"TITLE '{lens.name}' ! a comment; with marks", f"EPD {pupil_mm(lens)!r}"]
    lines += ["DIM M", "WL 656.3 587.6 486.1", "REF 2; WTW 1 1 1", "SO 0.0 0.1e14"]
    for s in lens.surfaces:
        lines += [_seq_row(s), *(["  STO"] if s.stop else []), *_seq_shape(s), f"  CIR {s.semi_diameter_mm!r}"]
    lines.append("SI 0.0 0.0")
    if lens.configurations:
        states, stop = lens.configurations, lens.stop_index + 1
        lines.append(f"ZOO {len(states)}")
        lines += [f"TIT Z{place} '{c.name}'" for place, c in enumerate(states, start=1)]
        for k in sorted({k for c in states for k, _ in c.thickness_mm}):
            gaps = [dict(c.thickness_mm).get(k, lens.surfaces[k].thickness_mm) for c in states]
            # Long commands run on.
            lines += [f"ZOO THI S{k + 1} {gaps[0]!r} &", " " + " ".join(map(repr, gaps[1:]))]
        lines.append("ZOO THI SO " + " ".join(repr(c.object_distance_mm or 1e13) for c in states))
        openings = [(c.stop_diameter_mm or 2 * lens.stop_radius_mm) / 2 for c in states]
        lines.append(f"ZOO CIR S{stop} " + " ".join(map(repr, openings)))
        lines.append("ZOO THC S1 " + " ".join("100" for _ in states))
    return "\n".join([*lines, "GO", ""])


def _seq_row(s: Surface) -> str:
    radius = 0.0 if math.isinf(s.radius_mm) or s.figure.axis == "x" else s.radius_mm
    glass = "" if s.n_d == 1 else f" {s.n_d!r}" if s.V_d is None else f" {s.n_d!r}:{s.V_d!r}"
    return f"S {radius!r} {s.thickness_mm!r}{glass}"


def _seq_shape(s: Surface) -> list[str]:
    if s.figure.axis:
        if s.figure.conic:
            raise CannotSay("conic cylinder")
        return ["  YTO", *([f"  CUX {1 / s.radius_mm!r}"] if s.figure.axis == "x" else [])]
    letters = {4 + 2 * k: letter for k, letter in enumerate("ABCDEFGHJ")}
    if any(p not in letters for p, _ in s.figure.asphere):
        raise CannotSay(s.figure.asphere)
    if s.figure.asphere:
        return ["  ASP", f"  K {s.figure.conic!r}; " + "; ".join(f"{letters[p]} {a!r}" for p, a in s.figure.asphere)]
    return ["  CON", f"  K {s.figure.conic!r}"] if s.figure.conic else []


def osl(lens: Lens) -> str:
    """OSLO: one index a glass, four terms an asphere."""
    lines = [
        "// OSLO 6.1 31567 0 0",
        f'LEN NEW "{lens.name}" 50 {len(lens.surfaces) + 1}',
        f"EBR {pupil_mm(lens) / 2!r}",
    ]
    lines += ['DES "somebody"', "UNI 1.0", 'SNO1 "a note; with // marks"', "AIR", "TH 1.0e+20", "NXT // SRF 1"]
    for k, s in enumerate(lens.surfaces, start=1):
        if s.figure.axis or s.V_d is not None or any(p not in (4, 6, 8, 10) for p, _ in s.figure.asphere):
            raise CannotSay(s)
        medium = "AIR" if s.n_d == 1 else f"GLA {s.n_d!r}"
        radius = [] if math.isinf(s.radius_mm) else [f"CV {1 / s.radius_mm!r}" if k % 2 else f"RD {s.radius_mm!r}"]
        shape = [f"CC {s.figure.conic!r}"] if s.figure.conic else []
        shape += [f"{ {4: 'AD', 6: 'AE', 8: 'AF', 10: 'AG'}[p] } {a!r}" for p, a in s.figure.asphere]
        lines += [medium, *radius, f"TH {s.thickness_mm!r}; AP {'CHK ' if k % 3 else ''}{s.semi_diameter_mm!r}"]
        lines += [*shape, *(["AST"] if s.stop else []), "NXT"]
    return "\n".join([*lines, "AIR", "WV 0.58756 0.48613 0.65627", f"END {len(lens.surfaces) + 1}", ""])


def dat(lens: Lens) -> str:
    """pbrt: comments, and the stop as a row of radius 0."""
    return f"# {lens.name}\n#   Radius  sep  n  aperture\n" + _table(lens, stop_index="0")


def txt(lens: Lens) -> str:
    """appleseed: the count of rows first, and the stop as a row of index 0."""
    return f"# {lens.name}\n{len(lens.surfaces)}\n" + _table(lens, stop_index="0")


def _table(lens: Lens, stop_index: str) -> str:
    rows = []
    for s in lens.surfaces:
        flat = math.isinf(s.radius_mm)
        if (
            s.figure.axis
            or s.figure.conic
            or s.figure.asphere
            or s.V_d is not None
            or (s.stop and not (flat and s.n_d == 1))
        ):
            raise CannotSay(s)
        n = stop_index if s.stop else repr(s.n_d)
        rows.append(f"{0.0 if flat else s.radius_mm!r}\t{s.thickness_mm!r}  {n} {s.diameter_mm!r} # a row\n")
    return "".join(rows)


def js(lens: Lens) -> str:
    """The JSON of ../shared/data/README.md."""
    rows = [
        {
            "radius_mm": 0.0 if math.isinf(s.radius_mm) else s.radius_mm,
            "thickness_mm": s.thickness_mm,
            "material": None,
            "n_d": None if s.n_d == 1 else s.n_d,
            "V_d": s.V_d,
            "diameter_mm": s.diameter_mm,
            "stop": s.stop,
            "conic": s.figure.conic,
            "aspheric_coefficients": {str(p): a for p, a in s.figure.asphere},
            "shape": f"cyl-{s.figure.axis}"
            if s.figure.axis
            else "asphere"
            if s.figure.asphere or s.figure.conic
            else "sphere",
        }
        for s in lens.surfaces
    ]
    states = [
        {
            "name": c.name,
            "efl_mm": c.efl_mm,
            "f_number": c.f_number,
            "object_distance_mm": c.object_distance_mm,
            "thickness_overrides": {str(k): t for k, t in c.thickness_mm},
            **({"stop_diameter_mm": c.stop_diameter_mm} if c.stop_diameter_mm else {}),
        }
        for c in lens.configurations
    ]
    head = {"name": lens.name, "designer": None, "source": lens.source, "f_number": lens.f_number, "efl_mm": None}
    return json.dumps({**head, "surfaces": rows, "configurations": {"configs": states} if states else None})


WRITERS = {".zmx": zmx, ".seq": seq, ".len": osl, ".dat": dat, ".txt": txt, ".json": js}


def optical_bench(lens: Lens) -> str:
    """The text of the Optical Bench, for one state."""
    head = ["[descriptive data]", f"title\t{lens.name}", "[constants]"]
    gaps, rows, aspheres = [], [], []
    odd = any(p % 2 for s in lens.surfaces for p, _ in s.figure.asphere)
    squares = any(p == 2 for s in lens.surfaces for p, _ in s.figure.asphere)
    if odd and squares:
        raise CannotSay("odd powers and the 2nd")
    powers = [*([2] if squares else []), *(range(3, 41) if odd else range(4, 41, 2))]
    head += ["AsphericalOddCount\t19"] * odd + ["AsphericalA2"] * squares
    for k, s in enumerate(lens.surfaces):
        if s.figure.axis or (s.stop and not math.isinf(s.radius_mm)):
            raise CannotSay(s)
        radius = "AS" if s.stop else "Infinity" if math.isinf(s.radius_mm) else repr(s.radius_mm)
        gap = f"d{k + 1}" if k % 3 == 1 else repr(s.thickness_mm)
        gaps += [f"d{k + 1}\t{s.thickness_mm!r}"] * (k % 3 == 1)
        medium = ("", "") if s.n_d == 1 else (repr(s.n_d), "" if s.V_d is None else repr(s.V_d))
        rows.append(f"{k + 1}\t{radius}\t{gap}\t{medium[0]}\t{s.diameter_mm!r}\t{medium[1]}")
        if s.figure.conic or s.figure.asphere:
            terms = dict(s.figure.asphere)
            if not set(terms) <= set(powers) or (s.figure.conic and s.stop):
                raise CannotSay(s)
            aspheres.append(
                f"{k + 1}\t{radius}\t{s.figure.conic!r}\t" + "\t".join(repr(terms.get(p, 0.0)) for p in powers)
            )
    n = first_order(lens).f_number
    head += ["[variable distances]", f"F-Number\t{n!r}", "Magnification\t0", "d0\tInfinity", *gaps]
    return "\n".join([*head, "[lens data]", *rows, "[aspherical data]", *aspheres, "[figure]", "anything", ""])


def flaresim(lens: Lens) -> str:
    """A .lens file with semi-diameters, as the format has them."""
    rows = []
    for s in lens.surfaces:
        if s.figure.conic or s.figure.asphere or (s.stop and not math.isinf(s.radius_mm)):
            raise CannotSay(s)
        radius = "stop" if s.stop else "0" if math.isinf(s.radius_mm) else repr(s.radius_mm)
        kind = {None: "", "x": "cyl_y", "y": "cyl_x"}[s.figure.axis]
        rows.append(f"  {radius} {s.thickness_mm!r} {s.n_d!r} {s.V_d or 0.0!r} {s.semi_diameter_mm!r} 1 {kind} # row")
    return "\n".join(["# A comment", f"name: {lens.name}", "focal_length: 0", "", "surfaces:", *rows, ""])


def camera_toml(lens: Lens) -> str:
    """The TOML of a lens camera for Blender."""
    kinds = {None: "spherical", "x": "cylindrical_x", "y": "cylindrical_y"}
    text = f'[lens]\nname = "{lens.name}"\nfocal_length = {first_order(lens).efl_mm!r}\nmax_fstop = '
    text += f'{first_order(lens).f_number!r}\ncoating = "multi"\n'
    for s in lens.surfaces:
        terms = dict(s.figure.asphere)
        if any(p % 2 or p < 4 for p in terms) or (s.stop and not math.isinf(s.radius_mm)):
            raise CannotSay(s)
        curved = bool(terms or s.figure.conic)
        if curved and s.figure.axis:
            raise CannotSay(s)
        kind = "stop" if s.stop else "aspheric" if curved else kinds[s.figure.axis]
        text += f'[[surface]]\ntype = "{kind}"\nradius = {0.0 if math.isinf(s.radius_mm) else s.radius_mm!r}\n'
        text += f"thickness = {s.thickness_mm!r}\nior = {s.n_d!r}\naperture = {s.diameter_mm!r}\n"
        text += f"abbe_v = {s.V_d or 0.0!r}\n"
        if curved:
            listed = [terms.get(p, 0.0) for p in range(4, max(terms, default=2) + 1, 2)]
            text += f"conic = {s.figure.conic!r}\naspheric_coeffs = {listed!r}\n"
    return text


# Rims of these are somebody's measures of a drawing.
DRAWN = {".bench.txt": optical_bench, ".lens": flaresim, ".camera.toml": camera_toml}


def beam(lens: Lens, count: int = 60) -> Rays:
    """Light from the scene at up to 6 degrees to each side, over the entrance pupil and a little beyond it."""
    g = torch.Generator().manual_seed(1)
    u = 2 * torch.rand((4, count), generator=g, dtype=torch.float64) - 1
    d = torch.stack([0.1 * u[0], 0.1 * u[1], torch.ones(count, dtype=torch.float64)])
    d = d / d.norm(dim=0)
    pupil = first_order(lens)
    semi = 0.55 * pupil.entrance_pupil_diameter_mm
    start = torch.stack([semi * u[2], semi * u[3], torch.full_like(u[0], pupil.entrance_pupil_z_mm)])
    # Back to well in front of the lens.
    travel = (pupil.entrance_pupil_z_mm + lens.surfaces[0].diameter_mm) / d[2]
    return Rays(*(start - travel * d), *d)


def assert_same_optics(found: Lens, expected: Lens) -> None:
    """Paraxial figures in both meridians to 1e-9, and real rays to 1e-9 mm of a 50 mm lens with the same endings."""
    for axis in ("x", "y"):
        a, b = (first_order(lens, meridian=axis) for lens in (found, expected))
        for key in ("efl_mm", "back_focus_mm", "entrance_pupil_diameter_mm", "front_focal_z_mm"):
            assert getattr(a, key) == pytest.approx(getattr(b, key), rel=1e-9, abs=1e-9), key
    rays = beam(expected)
    for wavelength_nm in (587.5618, 450.0):
        there, here = (trace(lens, rays, wavelength_nm, towards="film") for lens in (found, expected))
        assert torch.equal(there.status, here.status)
        tolerance = 2e-11 * abs(first_order(expected).efl_mm)
        for p, q in zip(there.rays, here.rays, strict=True):
            assert (p - q).abs().max() < tolerance + 1e-12
        assert (here.status == 0).any()
