"""Refine one spacing of a lens with gradients through the exact tracer, so that its spots shrink.

The lens is a textbook Cooke triplet whose rear air space was made 0.6 mm too long, as if a spacer were wrong. Free are
that space and the film's place; the loss is the mean square distance of rays from their field's centroid, over three
fields and three wavelengths. Rays start in front of the lens and fill the stop of the lens as it stands.
Writes refine_spacing.json.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import replace

import torch
from torch import Tensor

from experiments import lab
from neurolens import __version__
from neurolens.analysis.bundles import bundle
from neurolens.analysis.fields import Scene
from neurolens.base.files import write_json
from neurolens.optics.lensfile import read_lens
from neurolens.optics.prescription import Lens
from neurolens.optics.surfaces import Rays
from neurolens.optics.trace import trace

LENS = "lenses/cooke_triplet_50.toml"
SPACE = 3  # the space after this surface
WRONG_MM = 0.6
FIELDS_DEG = (0.0, 10.0, 15.0)
WAVELENGTHS_NM = (587.5618, 486.1327, 656.2725)
DIFFERENCE_MM = 1e-5


class Spots:
    """Landing points on the film of fixed rays from the scene, as a function of (space, film place) in mm."""

    def __init__(self, lens: Lens) -> None:
        self.lens = lens
        aimed = bundle(Scene(lens), FIELDS_DEG, WAVELENGTHS_NM)
        shape = aimed.status.shape
        self.start = Rays(*(c.reshape(-1) for c in aimed.start))
        self.wavelength_nm = torch.tensor(WAVELENGTHS_NM, dtype=torch.float64)[None, :, None].expand(shape).reshape(-1)
        self.counts = (aimed.status == 0).to(torch.float64)

    def land(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """x and y on the film, [fields, wavelengths, rays] mm."""
        surfaces = list(self.lens.surfaces)
        surfaces[SPACE] = replace(surfaces[SPACE], thickness_mm=values[0])
        rays = trace(replace(self.lens, surfaces=tuple(surfaces)), self.start, self.wavelength_nm, towards="film").rays
        reach = (values[1] - rays.z) / rays.dz
        shape = self.counts.shape
        return (rays.x + reach * rays.dx).reshape(shape), (rays.y + reach * rays.dy).reshape(shape)

    def loss(self, values: Tensor) -> Tensor:
        """Mean square distance from the centroid, mm^2, over fields of equal weight."""
        total = torch.zeros((), dtype=torch.float64)
        share = self.counts / self.counts.sum((1, 2), keepdim=True)
        for c in self.land(values):
            centre = (share * c).sum((1, 2), keepdim=True)
            total = total + (share * (c - centre) ** 2).sum() / len(FIELDS_DEG)
        return total


OPTIONS = (lab.out(),)


def run(args: argparse.Namespace) -> None:
    """Refine, check the gradient, write figures."""
    file_lens = read_lens(lab.ROOT / LENS)
    right_mm = float(file_lens.surfaces[SPACE].thickness_mm)
    rows = list(file_lens.surfaces)
    rows[SPACE] = replace(rows[SPACE], thickness_mm=right_mm + WRONG_MM)
    wrong = replace(file_lens, surfaces=tuple(rows)).at()
    spots = Spots(wrong)
    start = torch.tensor([right_mm + WRONG_MM, float(wrong.film_z_mm or 0.0)], dtype=torch.float64)
    refocused, _ = refine(spots, start, free=(False, True))
    began = time.perf_counter()
    refined, history = refine(spots, refocused, free=(True, True))
    record = {
        "lens": LENS,
        "space_after_surface": SPACE,
        "space_mm": {"file": right_mm, "wrong": float(start[0]), "refined": float(refined[0])},
        "rms_spot_um": {
            "wrong": rms_um(spots, start),
            "wrong, refocused": rms_um(spots, refocused),
            "refined": rms_um(spots, refined),
        },
        "gradient": gradients(spots, start),
        "evaluations": len(history),
        "seconds": time.perf_counter() - began,
        "fields_deg": FIELDS_DEG,
        "wavelengths_nm": WAVELENGTHS_NM,
        "versions": {"neurolens": __version__, "torch": torch.__version__},
    }
    write_json(args.out / "refine_spacing.json", record)
    print((args.out / "refine_spacing.json").read_text())


def refine(spots: Spots, start: Tensor, free: tuple[bool, bool]) -> tuple[Tensor, list[float]]:
    """The values of least loss near `start`, and the loss at every evaluation; values that are not free stay."""
    mask = torch.tensor(free, dtype=torch.float64)
    values = start.clone().requires_grad_(True)
    history: list[float] = []
    search = torch.optim.LBFGS(
        [values], lr=1.0, max_iter=60, tolerance_grad=1e-12, tolerance_change=1e-14, line_search_fn="strong_wolfe"
    )

    def evaluate() -> float:
        search.zero_grad()
        loss = spots.loss(values)
        loss.backward()
        assert values.grad is not None
        values.grad.mul_(mask)
        history.append(float(loss.detach()))
        return float(loss.detach())

    search.step(evaluate)
    return values.detach(), history


def gradients(spots: Spots, at: Tensor) -> dict[str, list[float]]:
    """The derivative of the loss (mm) by the tracer's gradients and by central differences."""
    held = at.clone().requires_grad_(True)
    (exact,) = torch.autograd.grad(spots.loss(held), held)
    steps = DIFFERENCE_MM * torch.eye(2, dtype=torch.float64)
    differences = [float((spots.loss(at + e) - spots.loss(at - e)) / (2 * DIFFERENCE_MM)) for e in steps]
    return {"autograd_mm": exact.tolist(), "central_differences_mm": differences}


def rms_um(spots: Spots, at: Tensor) -> float:
    """Root mean square spot radius over all fields, um."""
    return 1000 * math.sqrt(float(spots.loss(at)))
