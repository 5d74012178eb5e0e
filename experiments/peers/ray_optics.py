"""Lens files as ray-optics 0.9.8 reads and traces them; run by `python -m experiments collection`.

This script runs in the environment of ray-optics: it imports nothing of neurolens.

Each line of the standard input is a task in JSON, each line of the output its answer, in the same order:

    {"file", "wavelength_nm", "fields_deg", "stop_z_mm", "mend", "index"}
    {"efl_mm", "back_mm", "film_mm", "rays": [efl, back], "states": [[efl, back]], "heights_mm", "index", "mended"}
    {"error"}

Lengths along the axis count from the last surface at which the medium changes; `stop_z_mm`, for files that mark no
stop, counts from the first. "rays" has focal length and back focus once more, by real rays near the axis, and so has
"states" for every configuration of the file. With "mend", what ray-optics is known to read wrongly is put right first,
and "mended" says what: terms of XASPHERE (which it leaves out), the normalisation radius of XOSPHERE (left out), and,
where they differ, the indices of the task (of glasses that ray-optics does not know and replaces).
"""

import io
import json
import math
import signal
import sys
import warnings
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import rayoptics.environment  # noqa: F401  (sets the program up)
from opticalglass.opticalmedium import ConstantIndex
from rayoptics.elem.profiles import EvenPolynomial
from rayoptics.parax.firstorder import compute_principle_points, paraxial_trace
from rayoptics.raytr.raytrace import trace_raw
from rayoptics.raytr.traceerror import TraceError
from rayoptics.zemax import zmxread

SECONDS = 60  # for one file
STEPS, LEAST_STEP = 3, 1e-6  # steps to the first field; the least step before the search gives up, in radians
NEAR_AXIS = 1e-4  # height of a ray near the axis, as a share of the focal length
SAME_INDEX = 1e-7
FIELD_LINES = ("XFLN", "YFLN", "XFLD", "YFLD")  # left out: the search for their chief rays fails for some fisheyes


class Model:
    """A sequential model of ray-optics at one wavelength; `index` and `thickness` count from the object."""

    def __init__(self, task):
        raw = Path(task["file"]).read_bytes()
        text = raw.decode("utf-16" if raw[:2] in (b"\xff\xfe", b"\xfe\xff") else "latin-1")
        lines = [line.split() for line in text.splitlines() if line.split()[:1] and line.split()[0] not in FIELD_LINES]
        lines = list(map(filled_up, lines))
        self.wavelength_nm, self.mended, self.film_at_focus = task["wavelength_nm"], [], False
        if task.get("mend"):
            lines = self.with_ends(lines)
        if not any(words[0] in ("WAVM", "WAVL") for words in lines):
            lines = [["WAVM", "1", str(self.wavelength_nm / 1000), "1"], *lines]
        self.lines = lines
        self.model, _ = zmxread.read_lens(Path(task["file"]), "\n".join(map(" ".join, lines)))
        self.sequence = self.model["seq_model"]
        wavelengths = self.model["osp"]["wvls"]
        wavelengths.set_from_list([[self.wavelength_nm, 1.0]])
        wavelengths.reference_wvl = 0
        if task.get("mend"):
            self.mend(blocks_of(lines))
        self.update()
        if task.get("mend") and len(task["index"]) == len(self.changes):
            self.replace_indices(task["index"])
            self.update()
        if self.film_at_focus:
            self.sequence.gaps[-1].thi = self.first_order()[1]
            self.update()
        self.stop = self.sequence.stop_surface or self.marked_stop(lines) or self.nearest(task.get("stop_z_mm"))

    def update(self):
        self.model.update_model()
        self.index = [float(n[0]) for n in self.sequence.rndx]
        self.set_thickness([float(gap.thi) for gap in self.sequence.gaps])
        self.changes = [k for k in range(1, len(self.index)) if self.index[k] != self.index[k - 1]]
        self.first, self.last = self.changes[0], self.changes[-1]
        self.z = [0.0, *map(float, np.cumsum([0.0, *self.thickness[1:]]))]

    def with_ends(self, lines):
        """The lines with an object at infinity and an image surface, which some files lack.

        Their first surface is then SURF 1, or has a glass and a finite thickness, and their last one has a thickness,
        or is curved and has glass in front. Where it has none, the film is placed in the focus.
        """
        starts = [k for k, words in enumerate(lines) if words[0] == "SURF"]
        blocks = [{w[0]: w for w in lines[a:b]} for a, b in zip(starts, [*starts[1:], len(lines)], strict=True)]
        first, before, last = blocks[0], blocks[-2], blocks[-1]
        if first["SURF"][1] != "0" or ("GLAS" in first and first["DISZ"][1] != "INFINITY"):
            lines = [*lines[: starts[0]], ["SURF", "0"], ["DISZ", "INFINITY"], *lines[starts[0] :]]
            self.mended.append("no object surface in the file")
        curved = float(last.get("CURV", ["", "0"])[1]) != 0
        behind = float(last["DISZ"][1])
        if behind != 0 or "GLAS" in last or ("GLAS" in before and (curved or self.mended)):
            lines = [*lines, ["SURF", str(len(blocks))], ["DISZ", "0"]]
            self.mended.append("no image surface in the file")
            self.film_at_focus = behind == 0
        return lines

    def mend(self, blocks):
        """Put right how aspheres were read."""
        for k, (kind, parameters, extra) in enumerate(blocks):
            profile = self.sequence.ifcs[k].profile
            radius, terms = extra.get(2, 1.0), [extra[n] for n in sorted(extra) if n > 2]
            if kind == "XASPHERE":
                terms = terms or [parameters.get(n, 0.0) for n in range(1, 9)]
                scaled = [a / radius ** (2 * i) for i, a in enumerate(terms, start=1)]
                shape = EvenPolynomial(c=profile.cv, cc=getattr(profile, "cc", 0.0), coefs=scaled)
                self.sequence.ifcs[k].profile = shape
                self.mended.append("the terms of XASPHERE, which it leaves out")
            elif kind == "XOSPHERE" and radius != 1:
                profile.coefs = [a / radius**i for i, a in enumerate(terms, start=1)]
                self.mended.append("the normalisation radius of XOSPHERE, which it leaves out")

    def replace_indices(self, wanted):
        """Take the given index behind each surface where the medium changes and they differ."""
        gaps, ends = self.sequence.gaps, [*self.changes[1:], len(self.index)]
        for k, end, n in zip(self.changes, ends, wanted, strict=True):
            if abs(self.index[k] - n) > SAME_INDEX:
                self.mended.append(f"the index of a glass that it replaces ({self.index[k]:.5f} instead of {n:.5f})")
                for gap in gaps[k:end]:
                    gap.medium = ConstantIndex(n, "mended")

    def marked_stop(self, lines):
        """The surface that the file marks: ray-optics forgets a stop on the first one."""
        surface = -1
        for words in lines:
            surface += words[:1] == ["SURF"]
            if words[:1] == ["STOP"]:
                return surface
        return None

    def nearest(self, z_mm):
        if z_mm is None:
            return None
        return min(range(1, len(self.z)), key=lambda k: abs(self.z[k] - self.z[self.first] - z_mm))

    def set_thickness(self, thickness):
        """Take these thicknesses for real rays; the object's plane moves to the first vertex: 1e10 mm cost digits."""
        s, self.thickness = self.sequence, thickness
        nothing = (np.identity(3), np.zeros(3))
        shifts = [nothing, *((np.identity(3), np.array([0.0, 0.0, t])) for t in thickness[1:]), nothing]
        columns = s.ifcs, [*s.gaps, None], shifts, [*self.index, self.index[-1]], [*s.z_dir, s.z_dir[-1]]
        self.path = [list(row) for row in zip(*columns, strict=True)]

    def first_order(self):
        """Focal length, back focus, and distance of the film, from the last surface at which the medium changes."""
        path = self.sequence.path(wl=self.wavelength_nm)
        _, _, info = compute_principle_points(path, 0.0, self.index[0], self.index[-1])
        efl, back_focus = info[1], info[8]
        behind = sum(self.thickness[self.last : -1])
        return efl, back_focus + behind, behind + self.thickness[-1]

    def near_axis(self, efl):
        """The same focal length and back focus by real rays parallel to the axis, extrapolated to height 0.

        An r^3 term of an asphere makes an error that grows with the height, all others one with its square.
        """
        found = []
        for height in (abs(efl) * NEAR_AXIS / 2**k for k in range(3)):
            ray = self.trace(0.0, height, 0.0)
            (_, y, z), way = ray[self.last][0], ray[self.last][1]
            slope = way[1] / way[2]
            found.append(np.array([-height / slope, z - y / slope]))
        wide, middle, narrow = found
        return [float(v) for v in (4 * (2 * narrow - middle) - (2 * middle - wide)) / 3]

    def states(self, efl):
        """Focal length and back focus in every configuration of the file, whose operands THIC replace thicknesses."""
        tabled, states = self.thickness, {}
        for words in self.lines:
            if words[:1] == ["THIC"] and words[1] != "0":
                states.setdefault(int(words[2]), {})[int(words[1])] = float(words[3])
        found = []
        for n in sorted(states) if len(states) > 1 else ():
            self.set_thickness([states[n].get(k, t) for k, t in enumerate(tabled)])
            found.append(self.near_axis(efl))
        self.set_thickness(tabled)
        return found

    def entrance_pupil(self):
        """Distance behind the first vertex, on the axis."""
        p, q = paraxial_trace(self.sequence.path(wl=self.wavelength_nm), 1, [1.0, 0.0], [0.0, 1.0])
        return float(q[self.stop][0] / p[self.stop][0]) if p[self.stop][0] else 1e6

    def trace(self, field, offset, pupil):
        """A meridional ray at an angle to the axis that passes the axial point `pupil` at a distance of `offset`."""
        way = np.array([0.0, math.sin(field), math.cos(field)])
        start = np.array([0.0, offset * math.cos(field), pupil - offset * math.sin(field)])
        with np.errstate(all="raise"):
            return trace_raw(iter(self.path), start, way, self.wavelength_nm, intersect_obj=False)[0]

    def chief_heights(self, fields_deg):
        """Image heights of the rays through the middle of the stop; None from where no such ray is reached."""
        pupil, heights, field, offsets = self.entrance_pupil(), [], 0.0, [(0.0, 0.0)]
        step = math.radians(fields_deg[0]) / STEPS if fields_deg else 0.0
        for wanted in (math.radians(f) for f in fields_deg):
            while field < wanted and step > LEAST_STEP:
                there = wanted if field + 1.01 * step > wanted else field + step
                offset = self.offset_at(there, pupil, extrapolated(offsets, there))
                if offset is None:
                    step /= 2
                else:
                    field = there
                    offsets.append((there, offset))
            heights.append(float(self.trace(wanted, offsets[-1][1], pupil)[-1][0][1]) if field >= wanted else None)
        return heights

    def offset_at(self, field, pupil, guess):
        return root(lambda b: self.trace(field, b, pupil)[self.stop][0][1], guess, 1e-6 * max(1.0, abs(self.z[-1])))


def filled_up(words):
    """A line with the numbers that ray-optics needs and the file leaves out: the kind of a rim, an Abbe number."""
    wanted = {"DIAM": 3, "GLAS": 6 if "___BLANK" in words else 0}.get(words[0], 0)
    return words + ["0"] * (wanted - len(words))


def blocks_of(lines):
    """Type, PARM and XDAT of each surface."""
    blocks = []
    for words in lines:
        if words[:1] == ["SURF"]:
            blocks.append(["STANDARD", {}, {}])
        elif blocks and words[:1] == ["TYPE"]:
            blocks[-1][0] = words[1]
        elif blocks and words[:1] in (["PARM"], ["XDAT"]):
            blocks[-1][1 if words[0] == "PARM" else 2][int(words[1])] = float(words[2])
    return blocks


def extrapolated(points, x):
    """The line through the last two points, at x."""
    (a, ya), (b, yb) = points[-2:] if len(points) > 1 else (points[-1], points[-1])
    return yb if a == b else yb + (yb - ya) * (x - b) / (b - a)


def root(function, guess, step):
    """A zero near a guess by secants, or None."""
    try:
        a, b = guess, guess + step
        fa, fb = function(a), function(b)
        for _ in range(50):
            if abs(fb) < 1e-12 or fa == fb:
                break
            a, b, fa = b, b - fb * (b - a) / (fb - fa), fb
            fb = function(b)
        return b if abs(fb) < 1e-9 else None
    except (TraceError, FloatingPointError, ValueError, ZeroDivisionError):
        return None


def answer(task):
    """The data of one file."""
    model = Model(task)
    efl, back, film = map(float, model.first_order())
    return {
        "efl_mm": efl,
        "back_mm": back,
        "film_mm": film,
        "rays": model.near_axis(efl),
        "states": model.states(efl),
        "heights_mm": [] if model.stop is None else model.chief_heights(task["fields_deg"]),
        "index": [model.index[k] for k in model.changes],
        "mended": list(dict.fromkeys(model.mended)),
    }


def late(*_):
    raise TimeoutError(f"more than {SECONDS} s")


def main():
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGALRM, late)
    out = sys.stdout
    for line in sys.stdin:
        signal.alarm(SECONDS)
        try:
            with redirect_stdout(io.StringIO()):  # ray-optics prints much
                found = answer(json.loads(line))
        except Exception as error:  # whatever ray-optics raises is its answer
            found = {"error": f"{type(error).__name__}: {error}"[:300]}
        signal.alarm(0)
        out.write(json.dumps(found) + "\n")
        out.flush()


if __name__ == "__main__":
    main()
