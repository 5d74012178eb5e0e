"""Tilts and decentres of Zemax and CODE V: rigid motions by hand, files against each other, another program's rays."""

from pathlib import Path

import numpy as np
import pytest
import torch

from neurolens.base.errors import InputError
from neurolens.optics.lens.placement import CENTRED, Placement
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.readers.breaks import Step, Turn, placements
from neurolens.optics.readers.source import Line
from neurolens.optics.trace.rays import Rays, trace
from neurolens.studies.describe import glass_table

TURNS = ((0.05, -0.3, 0.0), (12.0, -7.0, 30.0))
ZEMAX_HEAD = """\
VERS 181022 258 36214
MODE SEQ
UNIT MM X W X CM MR CPMM
ENPD 10
WAVM 1 0.5876 1
SURF 0
  TYPE STANDARD
  DISZ INFINITY
SURF 1
  STOP
  TYPE STANDARD
  DISZ 1
  DIAM 5
"""
# Stop's u, v to x, y on the film, mm: Optiland 0.6.3, `surfaces.trace` on the file of the case.
THEIRS = {
    (0.0, 0.0): (-0.0017394676712304546, 0.08269957389486102),
    (3.0, 0.0): (0.08641611994683317, 0.08287582766330467),
    (0.0, 4.0): (-0.0012378633565049216, 0.1820451743314564),
    (-2.0, -2.5): (-0.05755186224883224, 0.012732798316193776),
}
CASE = Path(__file__).parents[4] / "shared" / "data" / "cases" / "2026-11-28" / "tilt.zmx"


def surface(number: int, curvature: float, thickness: float, more: str = "  DIAM 8\n") -> str:
    return f"SURF {number}\n  TYPE STANDARD\n  CURV {curvature}\n  DISZ {thickness}\n{more}"


def coordinate_break(number: int, values: tuple[float, ...], thickness: float = 0.0, order: int = 0) -> str:
    given = "".join(f"  PARM {k} {v}\n" for k, v in enumerate((*values, order), start=1))
    return f"SURF {number}\n  TYPE COORDBRK\n  DISZ {thickness}\n{given}"


def zemax(*rest: str) -> str:
    return ZEMAX_HEAD + "".join(rest)


def read(text: str, folder: Path, name: str = "lens.zmx") -> Lens:
    (folder / name).write_text(text)
    return read_any(folder / name)


def steps(*turns: Turn | None, thickness: float = 2.0) -> list[Step]:
    return [Step(Line("a.zmx", k, "SURF"), turn, thickness) for k, turn in enumerate(turns)]


def rigid(turn: Turn) -> np.ndarray:
    """The move and turn as one matrix [4, 4]."""
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = turn.placement.axes, turn.placement.moved_mm
    return whole


def test_a_break_and_its_opposite_leave_the_lens_centred() -> None:
    """Zemax: the same numbers, negative, tilts first. CODE V: REV behind a surface. Both undo a break, but between."""
    opposite = Placement(*(tuple(-v for v in part) for part in TURNS))  # type: ignore[arg-type]
    for back in (Turn(opposite, tilts_first=True), Turn(Placement(*TURNS), undoes=True)):
        found = placements(steps(None, Turn(Placement(*TURNS)), back, None, None, thickness=0.0))
        assert found[0] == found[3] == CENTRED
        assert found[1].moved_mm == pytest.approx(TURNS[0], abs=1e-12)
        np.testing.assert_allclose(found[1].axes, Placement(*TURNS).axes, atol=1e-12)
    alone = placements(steps(None, Turn(Placement(*TURNS), returns=True), None, None))
    assert alone[0] == alone[2] == CENTRED and alone[1].moved_mm == pytest.approx(TURNS[0], abs=1e-12)


def test_the_walk_is_a_product_of_rigid_motions() -> None:
    """Each surface seen from the film, by matrices [4, 4] multiplied in order."""
    one, two = Turn(Placement(*TURNS)), Turn(Placement((0.2, 0.1, -0.4), (-5.0, 3.0, 8.0)))
    found = placements(steps(one, None, two, None))
    step = np.eye(4)
    step[2, 3] = 2.0
    first = rigid(one)
    poses = [first, first @ step, first @ step @ step @ rigid(two), first @ step @ step @ rigid(two) @ step]
    for k, placement in enumerate(found):
        seen = np.linalg.inv(poses[-1]) @ poses[k]
        np.testing.assert_allclose(placement.axes, seen[:3, :3], atol=1e-12)
        np.testing.assert_allclose(placement.moved_mm, seen[:3, 3] + [0, 0, 2.0 * (3 - k)], atol=1e-12)


def test_an_element_between_two_breaks_is_a_group_that_is_moved(tmp_path: Path) -> None:
    """As the program's own tool writes it: break, element, back to the pivot, opposite break, on to the next one."""
    values = (0.05, -0.1, 0.4, -0.3, 0.0)
    lens = read(
        zemax(
            coordinate_break(2, values),
            surface(3, 0.02, 4, "  GLAS N-BK7 0 0 1.5168 64.17\n  DIAM 8\n"),
            surface(4, -0.02, -4),
            coordinate_break(5, tuple(-v for v in values), order=1),
            surface(6, 0, 4 + 10, ""),
            surface(7, 0.01, 3, "  GLAS N-SF6 0 0 1.8052 25.36\n  DIAM 9\n"),
            surface(8, 0, 40, "  DIAM 9\n"),
            surface(9, 0, 0, ""),
        ),
        tmp_path,
    )
    group = Placement((0.05, -0.1, 0.0), (0.4, -0.3, 0.0))
    assert [s.thickness_mm for s in lens.surfaces] == [1, 4, 10, 3, 40]
    assert lens.decentred == [1, 2]
    for k, z in ((1, 0.0), (2, 4.0)):
        wanted = CENTRED.in_group(group, z)
        np.testing.assert_allclose(lens.surfaces[k].placement.moved_mm, wanted.moved_mm, atol=1e-12)
        np.testing.assert_allclose(lens.surfaces[k].placement.axes, wanted.axes, atol=1e-12)


CODE_V = """\
RDM;LEN
TITLE 'a copy'
EPD 10
DIM M
WL 587.6
SO 0 1e11
S 0 1
  STO
  CIR 5
S 50 4 NBK7_SCHOTT
  XDE 0.05; ADE -0.4; BDE 0.3
  CIR 8
S -50 46
  CIR 8
  {back}
SI 0 0
GO
"""


OSLO = """\
LEN NEW "a copy" 50 4
EBR 5
UNI 1
AIR
TH 1e20
NXT
AIR; TH 1; AP 5; AST
NXT
GLA BK7; RD 50; TH 4; AP 8; DT 1; DCX 0.05; TLA -0.4; TLB 0.3
NXT
AIR; RD -50; TH 46; AP 8
NXT
AIR
WV 0.5876
END 4
"""


def test_code_v_turns_left_handed_and_zemax_right_handed(tmp_path: Path) -> None:
    ours = read(CODE_V.format(back=""), tmp_path, "a.seq")
    theirs = read(
        zemax(
            coordinate_break(2, (0.05, 0, 0.4, -0.3, 0)),
            surface(3, 0.02, 4, "  GLAS N-BK7 0 0 1.5168 64.17\n  DIAM 8\n"),
            surface(4, -0.02, 46),
            surface(5, 0, 0, ""),
        ),
        tmp_path,
    )
    assert [s.placement for s in ours.surfaces] == [s.placement for s in theirs.surfaces]
    assert [s.placement for s in read(OSLO, tmp_path, "a.len").surfaces] == [s.placement for s in ours.surfaces]
    assert ours.decentred == [0], "the film goes with the element: from it, the stop is decentred"
    restored = CODE_V.replace("S -50 46", "S -50 -4").format(back="S 0 50; XDE 0.05; ADE -0.4; BDE 0.3; REV")
    lens = read(restored, tmp_path, "b.seq")
    assert lens.decentred == [1, 2] and lens.surfaces[2].thickness_mm == 46
    assert glass_table(lens)[1].words() == "decentred by 0.05 0 mm, tilted by 0.4 -0.3 degrees"


def test_optiland_finds_the_same_image(tmp_path: Path) -> None:
    """Optiland 0.6.3 reads the file of the case and traces the stop's rays to the film: x, y in the film's axes, mm."""
    if not CASE.exists():
        pytest.skip("no ../shared")
    lens = read_any(CASE)
    stop, nm = lens.surfaces[0].placement, lens.reference_nm
    for (u, v), wanted in THEIRS.items():
        start = stop.axes @ np.array([u, v, 0.0]) + stop.moved_mm
        ray = torch.tensor([*start, *stop.axes[:, 2]], dtype=torch.float64)[:, None]
        done = trace(lens, Rays(*ray), torch.tensor([587.6], dtype=torch.float64), towards="film").rays
        reach = (lens.vertices_mm[-1] - done.z) / done.dz
        found = [(done.x + reach * done.dx).item(), (done.y + reach * done.dy).item()]
        assert found == pytest.approx(wanted, abs=2e-6), (u, v, nm)


def test_what_breaks_cannot_say(tmp_path: Path) -> None:
    far = zemax(coordinate_break(2, (0, 0, 75, 0, 0)), surface(3, 0.02, 4), surface(4, 0, 0, ""))
    with pytest.raises(InputError, match=r"tilt from the film's axis: got .*at most 60"):
        read(far, tmp_path)
    with pytest.raises(InputError, match=r"BEN: got .*a bend belongs to a mirror"):
        read(CODE_V.format(back="ADE 4; BEN"), tmp_path, "c.seq")
