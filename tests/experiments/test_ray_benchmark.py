"""The benchmark of lens rays: every program that is here answers the same rays alike; figures of known errors."""

import numpy as np
import pytest

from experiments.peers import rays
from experiments.peers.ray_peers import PEERS, Found, Peer, Task, table_of
from neurolens.optics.lens.figures import Cylinder, Figure, Ideal
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.studies.speed import Unavailable

COUNT = 600
NAMES = ("laikin_double_gauss_50", "canon_aspheric_50")


@pytest.fixture(scope="module", params=NAMES)
def task(request: pytest.FixtureRequest) -> Task:
    return rays.task_of(request.param, COUNT)


@pytest.mark.parametrize("peer", PEERS, ids=lambda p: f"{p.name}, {p.precision}")
def test_programs_of_others_agree_with_ours_where_they_are_installed(peer: Peer, task: Task) -> None:
    count = 40 if peer.most < COUNT else COUNT
    try:
        call, read = peer.adapter(task.part(0, count))
        found = read(call())
    except Unavailable as reason:
        pytest.skip(str(reason))
    exact = Found(*(a[..., :count] for a in rays.reference(task)))
    got = rays.errors(found, exact, 50.0)
    assert 0.2 < exact.passes.mean() < 0.9  # both kinds of rays
    assert got["other"] == 0
    # Their float64 solves aspheres to 1e-7 mm or so; float32 has 24 bits of some 100 mm.
    assert got["position_um"] < (1e-2 if peer.precision == "float64" else 0.1)
    assert got["direction_urad"] < (1e-2 if peer.precision == "float64" else 3.0)


def test_our_own_rows_agree(task: Task) -> None:
    name = next(n for n in NAMES if table_of(rays.lab.lens_of(n)) == task.faces)
    exact = rays.reference(task)
    for entry in rays.ours(name, task, compiled=False):
        if entry.family == "exact, ours":
            got = rays.errors(rays.answer(entry, task, 200), exact, 50.0)
            assert got["other"] == 0 and got["rays"] == COUNT
            assert got["film_um"] < 0.1, entry.key
            assert (got["film_um"] == 0) == (entry.precision == "float64")


def test_a_turned_table_is_the_same_lens(task: Task) -> None:
    """Rims and stop lie where they lay, and a ray meets the last plane at the same place."""
    faces, start, way, back = task.turned()
    assert [f.rim for f in faces] == [f.rim for f in task.faces[::-1]]
    assert [f.stop for f in faces] == [f.stop for f in task.faces[::-1]]
    assert (way[2] > 0).all() and (start[2] < 0).all()
    z = np.cumsum([0.0, *(f.gap for f in faces[:-1])])
    vertices = np.cumsum([0.0, *(f.gap for f in task.faces[:-1])])
    assert np.allclose(z, vertices[-1] - vertices[::-1])
    # Between two vertices lies the same medium.
    behind = [f.index for f in task.faces[:-1]]
    assert [f.index for f in faces] == [*behind[::-1], 1.0]
    assert all(np.allclose(a, b) for a, b in zip(back(start, way), (task.start, task.way), strict=True))


def test_errors_are_those_that_were_made() -> None:
    """A direction is 3 mrad off, a point 4 um aside and moved along its ray (no error), one ray of four blocked."""
    way = np.array([[0.0], [0.0], [-1.0]]) * np.ones(4)
    exact = Found(np.zeros((3, 4)), way, np.array([True, True, True, False]))
    turned = np.array([[np.sin(3e-3)], [0.0], [-np.cos(3e-3)]]) * np.ones(4)
    moved = Found(np.array([[0.004], [0.0], [7.0]]) * np.ones(4), turned, np.array([True, True, False, False]))
    got = rays.errors(moved, exact, -50.0)
    assert got["direction_urad"] == pytest.approx(3000, rel=1e-9)
    assert got["film_um"] == pytest.approx(150, rel=1e-9)
    assert got["position_um"] == pytest.approx(4, rel=1e-9)
    assert got["other"] == 0.25 and got["rays"] == 4


def test_a_lens_that_others_cannot_describe_is_refused() -> None:
    for figure in (Cylinder(cylinder="x"), Figure(asphere=((3, 1e-5),)), Ideal(focal_mm=50.0)):
        lens = Lens(
            "odd",
            "test",
            (Surface(50.0, 5.0, 20.0, n_d=1.5, figure=figure), Surface(-50.0, 45.0, 20.0, stop=True)),
            2.0,
        )
        with pytest.raises(Unavailable, match="even aspheres"):
            table_of(lens)
