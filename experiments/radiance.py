"""A radiance field that is trained on photographs through a 50 mm f/1.4: pinhole, thin lens and the lens side by side.

The photographs are of striped balls in a cube of 40 cm, from 70 cm, wide open, traced through the lens file at one
wavelength. A grid of densities and colours is trained on them with each camera, the lens as its model, and photographs
from other places are drawn by the field and the camera it was trained with. A calibrated camera has the lens's own
distortion, centre of projection, pupil and vignetting (the mean weight of a film point), as a calibration without
error gives them; a nominal one is an ideal camera of 50 mm. Writes radiance.md, radiance.json and radiance.png.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F
from torch.quasirandom import SobolEngine

from experiments import lab
from neurolens.cameras.build import make_camera
from neurolens.lens.shot import Shot
from neurolens.torch import LensCamera

LENS, MODEL = "lenses/leica_summilux_m_50mm_f1_4.toml", "models/leica_summilux_m_50mm_f1_4.ols-64.onnx"
FOCUS, NM, HALF, SIZE = 0.7, 550.0, 0.2, (144, 96)
SHOT = Shot((36.0, 24.0), focus_m=FOCUS, f_number=1.4)
GREY, TRAINED, HELD = 0.1, 24, 4  # the colour around the balls, photographs to train with and to draw
PIXELS, RAYS, SAMPLES, SHOWN_RAYS = 1024, 4, 48, 32
Camera = Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]  # film, square: origins, directions, weights


def poses(count: int, seed: float) -> Tensor:
    """Cameras [count, 3, 4] whose film is as far from the middle of the cube as the focus, on a cap of 50 degrees."""
    k = torch.arange(count) + 0.5
    cos, turn = 1 - (1 - math.cos(math.radians(50.0))) * k / count, 2.399963 * k + seed
    sin = (1 - cos**2).sqrt()
    back = torch.stack([sin * turn.cos(), sin * turn.sin(), cos], 1)
    right = F.normalize(torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]).expand_as(back), back), dim=1)
    return torch.stack([right, torch.linalg.cross(back, right), back, FOCUS * back], 2)


def balls() -> tuple[Tensor, Tensor, Tensor]:
    """Centres [60, 3] in metres, radii, and two colours of stripes each [60, 2, 3]."""
    g = torch.Generator().manual_seed(4)
    radius = 0.012 + 0.024 * torch.rand(60, generator=g)
    centre = (2 * torch.rand(60, 3, generator=g) - 1) * (HALF - 0.01 - radius[:, None])
    return centre, radius, 0.05 + 0.95 * torch.rand(60, 2, 3, generator=g)


def scene(origin: Tensor, direction: Tensor) -> Tensor:
    """The colours [N, 3] that rays see, which do not depend on the direction of sight."""
    centre, radius, colours = balls()
    near = torch.full((len(origin),), math.inf)
    seen = torch.full((len(origin), 3), GREY)
    for c, r, two in zip(centre, radius, colours, strict=True):
        away = origin - c
        half = (away * direction).sum(1)
        root = half**2 - (away**2).sum(1) + r**2
        t = -half - root.clamp(min=0).sqrt()
        hit = torch.nonzero((root > 0) & (t < near))[:, 0]
        near[hit] = t[hit]
        at = (away[hit] + t[hit, None] * direction[hit]) / r
        seen[hit] = two[(torch.sin(9 * at[:, 0] + 5 * at[:, 1]) > 0).long()]
    return seen


def of_lens(file: str) -> Camera:
    lens = LensCamera(lab.ROOT / file, SHOT)
    return lambda film, square: lens(film, square, NM)[:3]


def nominal(kind: str) -> Camera:
    camera = make_camera(kind, SHOT)

    def rays(film: Tensor, square: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        found = camera.sample(film.T.numpy(), square.T.numpy(), np.full(len(film), NM, np.float32))
        return torch.from_numpy(found.origin_m.T), torch.from_numpy(found.direction.T), torch.from_numpy(found.weight)

    return rays


def calibrated(lens: Camera, open_: float) -> Camera:
    """A thin lens with the distortion, pupil and vignetting of a lens, or with `open_` = 0 a pinhole."""
    # The centre of projection is where a ray through the middle of the pupil crosses the axis.
    origin, direction, _ = lens(torch.tensor([[3.0, 0.0]]), torch.full((1, 2), 0.5))
    z = float((origin - direction * origin[:, :1] / direction[:, :1])[0, 2])
    square = SobolEngine(2, scramble=True, seed=1).draw(1024)
    origin, direction, weight = lens(torch.zeros(1024, 2), square)
    radius = float((origin + direction * ((z - origin[:, 2:]) / direction[:, 2:]))[weight > 0, :2].norm(dim=1).max())
    # Where the rays of film points meet in the plane of focus, and their mean weight.
    x, y = torch.meshgrid(torch.linspace(-17.9, 17.9, 37), torch.linspace(-11.9, 11.9, 25), indexing="xy")
    film = torch.stack([x, y], 2).reshape(-1, 1, 2).expand(-1, 256, -1).reshape(-1, 2)
    origin, direction, weight = lens(film, square[:256].repeat(25 * 37, 1))
    meet = origin + direction * ((-FOCUS - origin[:, 2:]) / direction[:, 2:])
    table = torch.cat([(meet[:, :2] * weight[:, None]), weight[:, None]], 1).reshape(25, 37, 256, 3).mean(2)
    table = torch.cat([table[..., :2] / table[..., 2:], table[..., 2:]], 2).permute(2, 0, 1)[None]

    def rays(film: Tensor, square: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        at = (film / film.new_tensor([17.9, 11.9]))[None, :, None]
        places = F.grid_sample(table, at, mode="bicubic", align_corners=True, padding_mode="border")[0, :, :, 0]
        angle, r = 2 * math.pi * square[:, 0], open_ * radius * square[:, 1].sqrt()
        origin = torch.stack([r * angle.cos(), r * angle.sin(), torch.full_like(r, z)], 1)
        target = torch.cat([places[:2].T, torch.full_like(r, -FOCUS)[:, None]], 1)
        return origin, F.normalize(target - origin, dim=1), places[2]

    return rays


class Field(torch.nn.Module):
    """Densities and colours on a grid of the cube."""

    def __init__(self, cells: int = 32) -> None:
        super().__init__()
        self.grid = torch.nn.Parameter(
            torch.cat([torch.full((1, 1, *[cells] * 3), -2.0), torch.zeros(1, 3, *[cells] * 3)], 1)
        )

    def refine(self, cells: int) -> None:
        with torch.no_grad():
            finer = F.interpolate(self.grid, (cells,) * 3, mode="trilinear", align_corners=True)
        self.grid = torch.nn.Parameter(finer)

    def forward(self, origin: Tensor, direction: Tensor) -> Tensor:
        """The colours [N, 3] of rays."""
        steps = torch.where(direction.abs() < 1e-6, 1e-6, direction)
        ends = torch.stack([(-HALF - origin) / steps, (HALF - origin) / steps])
        first, last = ends.amin(0).amax(1).clamp(min=0), ends.amax(0).amin(1)
        width = (last - first).clamp(min=0) / SAMPLES
        t = first[:, None] + width[:, None] * (torch.arange(SAMPLES) + torch.rand(len(origin), SAMPLES))
        at = (origin[:, None] + t[..., None] * direction[:, None]) / HALF
        found = F.grid_sample(self.grid, at[None, :, :, None], align_corners=True)[0, ..., 0]
        depth = 100 * F.softplus(found[0]) * width[:, None]
        left = torch.exp(-torch.cumsum(depth, 1))
        share = torch.cat([torch.ones_like(left[:, :1]), left[:, :-1]], 1) - left
        return (share * torch.sigmoid(found[1:])).sum(2).T + GREY * left[:, -1:]


def picture(camera: Camera, see: Callable[[Tensor, Tensor], Tensor], pose: Tensor, rays: int) -> Tensor:
    """Colours [pixels, 3] of a photograph."""
    x, y = torch.meshgrid(torch.arange(SIZE[0]), torch.arange(SIZE[1]), indexing="xy")
    corners = torch.stack([x, y], 2).reshape(-1, 2)
    total = torch.zeros(len(corners), 3)
    for k in range(0, rays, 4):
        numbers = SobolEngine(4, scramble=True, seed=k).draw(4 * len(corners)).reshape(4, -1, 4)
        pixels = (corners + numbers[..., :2]).reshape(-1, 2)
        total += seen(camera, see, pixels, pose, numbers[..., 2:].reshape(-1, 2)).reshape(4, -1, 3).sum(0)
    return total / rays


def seen(
    camera: Camera, see: Callable[[Tensor, Tensor], Tensor], pixels: Tensor, pose: Tensor, square: Tensor
) -> Tensor:
    """Weight times colour [N, 3] of rays from places in the picture; one pose, or one for each ray."""
    film = torch.tensor([18.0, -12.0]) - pixels * torch.tensor([36.0 / SIZE[0], -24.0 / SIZE[1]])
    origin, direction, weight = camera(film, square)
    turn = pose[..., :3]
    origin, direction = (turn @ origin[..., None])[..., 0] + pose[..., 3], (turn @ direction[..., None])[..., 0]
    return weight[:, None] * see(origin, direction)


def train(camera: Camera, photographs: Tensor, where: Tensor, steps: int, report: Any) -> Field:
    torch.manual_seed(1)
    field = Field()
    optimiser = torch.optim.Adam(field.parameters(), lr=0.1, eps=1e-15)
    for step in range(steps):
        if step in (steps // 4, steps // 2):
            field.refine(64 if step < steps // 2 else 96)
            optimiser = torch.optim.Adam(field.parameters(), lr=0.1 if step < steps // 2 else 0.05, eps=1e-15)
        view, pixel = torch.randint(TRAINED, (PIXELS,)), torch.randint(SIZE[0] * SIZE[1], (PIXELS,))
        corner = torch.stack([pixel % SIZE[0], pixel // SIZE[0]], 1)
        places = (corner + torch.rand(RAYS, PIXELS, 2)).reshape(-1, 2)
        found = seen(camera, field, places, where[view].repeat(RAYS, 1, 1), torch.rand(len(places), 2))
        # The product of two halves: the square of one mean would punish the variance of its rays, which is blur.
        one, two = found.reshape(2, RAYS // 2, PIXELS, 3).mean(1) - photographs[view, pixel]
        optimiser.zero_grad()
        (one * two).mean().backward()
        optimiser.step()
        report((step + 1) / steps)
    return field
