"""Ghosts as graphs: against the compiled tracer, and the discs of the front that hold their light."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shipped import whole

from neurolens.base.errors import InputError
from neurolens.graph.interpret import evaluate
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.designs import coated
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens
from neurolens.pictures.flare.ghosts import GhostTracer, entrances, ghost_graphs, ghost_pairs
from neurolens.pictures.flare.lights import Light, light_rays
from neurolens.pictures.flare.steps import entering

LENSES = Path(__file__).parents[3] / "lenses"
SINE = math.sin(math.radians(30))


def lens_of(name: str) -> Lens:
    return set_lens(read_lens(LENSES / f"{name}.toml"), focus_m=math.inf)


@pytest.mark.parametrize(
    ("name", "every"), [("brendel_tessar_100", 1), ("phone_lens_6", 3), *whole(("cooke_anamorphic_42", 1))]
)
def test_graphs_are_the_traced_ghosts(name: str, every: int) -> None:
    """At wavelengths between those of the series, also through a stop that is closed; coatings and aspheres, too. The
    three that put the most light on the film, of all ghosts or of one in `every`."""
    lens = lens_of(name)
    lens = coated(lens, "multi-layer") if name == "brendel_tessar_100" else lens
    found = entrances(GhostTracer(lens, ghost_pairs(lens)[::every]), SINE, 22.0, 550.0)[:3]
    graphs = ghost_graphs(lens, [ghost.pair for ghost in found], (400.0, 700.0))
    rng = np.random.default_rng(1)
    for share in (1.0, 0.6):
        closed = replace(lens, surfaces=tuple(
            replace(s, diameter_mm=share * s.diameter_mm) if s.stop else s for s in lens.surfaces
        ))  # fmt: skip
        tracer = GhostTracer(closed)
        for ghost, graph in zip(found, graphs, strict=True):
            p, u = rng.uniform(-0.6, 0.6, (2, 2, 2000))
            d, place = SINE * p, ghost.chief_mm[:, None] * p + ghost.scale_mm[:, None] * u
            nm = 463.0
            given = {"entering": np.stack([*d, *place, np.full(2000, nm)])}
            given["stop_radius_mm"] = np.array([[closed.stop_radius_mm]])
            mine = evaluate(graph, given)["arriving"]
            rays = np.stack([*place, 0 * place[0], *d, np.sqrt(1 - (d**2).sum(0))])
            exact = tracer.follow(entering(rays), nm, only=[ghost.pair], reach=np.inf).rows[0].astype(np.float64)
            lit = (exact[3] < 0.999) & (mine[3] < 0.999)
            assert lit.sum() > 100 and not ((exact[3] < 0.999) & (mine[3] > 1.001)).any()
            np.testing.assert_allclose(mine[:2, lit], exact[:2, lit], atol=0.03)
            np.testing.assert_allclose(mine[2, lit], exact[2, lit], rtol=3e-3)


def test_discs_hold_the_light_of_their_ghosts() -> None:
    lens = lens_of("brendel_tessar_100")
    tracer = GhostTracer(lens)
    found = entrances(tracer, SINE, 22.0, 550.0)
    assert [ghost.light for ghost in found] == sorted((ghost.light for ghost in found), reverse=True)
    rays, _ = light_rays(lens, Light(12.0, 0.0), 0, 1 << 14)
    p = np.array(rays[3:5, :1]) / SINE
    at_front = rays[:2] - rays[3:5] * (rays[2] / rays[5])
    traced = tracer.trace(rays, 550.0)
    for ghost in found:
        row = tracer.pairs.index(ghost.pair)
        lit = (traced.power[row] > 0) & (np.hypot(*traced.film_xy_mm[row]) < 22.0)
        u = (at_front[:, lit] - ghost.chief_mm[:, None] * p) / ghost.scale_mm[:, None]
        assert (np.hypot(*u) < 1).mean() > 0.999 if lit.any() else True


def test_a_mask_in_the_stop_is_refused() -> None:
    masked = replace(lens_of("brendel_tessar_100"), aperture=Aperture(mask=np.eye(8)))
    with pytest.raises(InputError, match="mask"):
        ghost_graphs(masked, [], (400.0, 700.0))
