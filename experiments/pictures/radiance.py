"""A radiance field that is trained on photographs through a 50 mm f/1.4: pinhole, thin lens and the lens side by side.

The 28 photographs of 144 x 96 pixels are of striped balls in a cube of 40 cm, from 70 cm, wide open, traced through the
lens file at one wavelength. A grid of densities and colours is trained on 24 of them with each camera, the lens as its
model; the other four are drawn by the field and the same camera. Pinhole and thin lens are calibrated without error:
they have the lens's distortion, centre of projection, pupil and vignetting (a film point's mean weight). Sharp pictures
are the pinhole's. Writes radiance.md, radiance.json and for each camera a row of pictures of the first view: the
photograph, what is drawn, the sharp truth, and what is drawn of that.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor
from torch.nn import functional as F
from torch.quasirandom import SobolEngine

from experiments import lab
from neurolens.optics.lens.shot import Shot
from neurolens.programs.torch import LensCamera

LENS, MODEL = "lenses/leica_summilux_m_50mm_f1_4.toml", "models/leica_summilux_m_50mm_f1_4.ols-64.onnx"
FOCUS, NM, HALF, SIZE = 0.7, 550.0, 0.2, (144, 96)
SHOT = Shot((36.0, 24.0), focus_m=FOCUS, f_number=1.4)
GREY, TRAINED, HELD = 0.1, 24, 4  # the colour around the balls, photographs to train with and to draw
PIXELS, RAYS, SAMPLES, SHOWN_RAYS = 1024, 4, 48, 32
CELLS = (32, 64, 96)  # a side, in the first quarter of the training, the second, and then
Camera = Callable[[Tensor, Tensor], tuple[Tensor, ...]]  # film points, random numbers: origins, directions, weights


def poses(count: int, seed: float) -> Tensor:
    """Cameras [count, 3, 4] whose film is as far from the middle of the cube as the focus, on a cap of 50 degrees."""
    k = torch.arange(count) + 0.5
    cos, turn = 1 - (1 - math.cos(math.radians(50.0))) * k / count, 2.399963 * k + seed
    sin = (1 - cos**2).sqrt()
    back = torch.stack([sin * turn.cos(), sin * turn.sin(), cos], 1)
    right = F.normalize(torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]).expand_as(back), back), dim=1)
    return torch.stack([right, torch.linalg.cross(back, right), back, FOCUS * back], 2)


def scene(origin: Tensor, direction: Tensor) -> Tensor:
    """The colours [N, 3] that rays see, which do not depend on the direction of sight."""
    g = torch.Generator().manual_seed(4)
    radius = 0.012 + 0.024 * torch.rand(60, generator=g)
    centre = (2 * torch.rand(60, 3, generator=g) - 1) * (HALF - 0.01 - radius[:, None])
    colours = 0.05 + 0.95 * torch.rand(60, 2, 3, generator=g)
    near, seen = torch.full((len(origin),), math.inf), torch.full((len(origin), 3), GREY)
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


def calibrated(lens: Camera, open_: float) -> Camera:
    """A thin lens with the distortion, pupil and vignetting of a lens, or with `open_` = 0 a pinhole."""
    # The centre of projection is where a ray through the middle of the pupil crosses the axis.
    origin, direction, *_ = lens(torch.tensor([[3.0, 0.0]]), torch.full((1, 2), 0.5))
    z = float((origin - direction * origin[:, :1] / direction[:, :1])[0, 2])
    square = SobolEngine(2, scramble=True, seed=1).draw(1024)
    origin, direction, weight, *_ = lens(torch.zeros(1024, 2), square)
    radius = float((origin + direction * ((z - origin[:, 2:]) / direction[:, 2:]))[weight > 0, :2].norm(dim=1).max())
    # Where the rays of film points meet in the plane of focus, and their mean weight.
    film = torch.cartesian_prod(torch.linspace(-11.9, 11.9, 25), torch.linspace(-17.9, 17.9, 37)).flip(1)
    film = film.repeat_interleave(256, 0)
    origin, direction, weight, *_ = lens(film, square[:256].repeat(25 * 37, 1))
    meet = origin + direction * ((-FOCUS - origin[:, 2:]) / direction[:, 2:])
    table = torch.cat([(meet[:, :2] * weight[:, None]), weight[:, None]], 1).reshape(25, 37, 256, 3).mean(2)
    table = torch.cat([table[..., :2] / table[..., 2:], table[..., 2:]], 2).permute(2, 0, 1)[None]

    def rays(film: Tensor, square: Tensor) -> tuple[Tensor, ...]:
        at = (film / film.new_tensor([17.9, 11.9]))[None, :, None]
        places = F.grid_sample(table, at, mode="bicubic", align_corners=True, padding_mode="border")[0, :, :, 0]
        angle, r = 2 * math.pi * square[:, 0], open_ * radius * square[:, 1].sqrt()
        origin = torch.stack([r * angle.cos(), r * angle.sin(), torch.full_like(r, z)], 1)
        target = torch.cat([places[:2].T, torch.full_like(r, -FOCUS)[:, None]], 1)
        return origin, F.normalize(target - origin, dim=1), places[2]

    return rays


def field(grid: Tensor, origin: Tensor, direction: Tensor) -> Tensor:
    """The colours [N, 3] of rays through a grid of densities and colours."""
    steps = torch.where(direction.abs() < 1e-6, 1e-6, direction)
    ends = torch.stack([(-HALF - origin) / steps, (HALF - origin) / steps])
    first, last = ends.amin(0).amax(1).clamp(min=0), ends.amax(0).amin(1)
    width = (last - first).clamp(min=0) / SAMPLES
    t = first[:, None] + width[:, None] * (torch.arange(SAMPLES) + torch.rand(len(origin), SAMPLES))
    at = (origin[:, None] + t[..., None] * direction[:, None]) / HALF
    found = F.grid_sample(grid, at[None, :, :, None], align_corners=True)[0, ..., 0]
    depth = 100 * F.softplus(found[0]) * width[:, None]
    left = torch.exp(-torch.cumsum(depth, 1))
    share = torch.cat([torch.ones_like(left[:, :1]), left[:, :-1]], 1) - left
    return (share * torch.sigmoid(found[1:])).sum(2).T + GREY * left[:, -1:]


def picture(camera: Camera, see: Callable[..., Tensor], pose: Tensor, rays: int) -> Tensor:
    """Colours [pixels, 3] of a photograph."""
    corners = torch.cartesian_prod(torch.arange(SIZE[1]), torch.arange(SIZE[0])).flip(1)
    total = torch.zeros(len(corners), 3)
    for k in range(0, rays, 4):
        numbers = SobolEngine(4, scramble=True, seed=k).draw(4 * len(corners)).reshape(4, -1, 4)
        pixels = (corners + numbers[..., :2]).reshape(-1, 2)
        total += seen(camera, see, pixels, pose, numbers[..., 2:].reshape(-1, 2)).reshape(4, -1, 3).sum(0)
    return total / rays


def seen(camera: Camera, see: Callable[..., Tensor], pixels: Tensor, pose: Tensor, square: Tensor) -> Tensor:
    """Weight times colour [N, 3] of rays from places in the picture; one pose, or one for each ray."""
    film = torch.tensor([18.0, -12.0]) - pixels * torch.tensor([36.0 / SIZE[0], -24.0 / SIZE[1]])
    origin, direction, weight, *_ = camera(film, square)
    turn = pose[..., :3]
    origin = (turn @ origin[..., None])[..., 0] + pose[..., 3]
    return weight[:, None] * see(origin, (turn @ direction[..., None])[..., 0])


def train(camera: Camera, photographs: Tensor, where: Tensor, steps: int, report: Any) -> Tensor:
    torch.manual_seed(1)
    grid = torch.tensor([-2.0, 0.0, 0.0, 0.0]).reshape(1, 4, 1, 1, 1).repeat(1, 1, 2, 2, 2)
    for step in range(steps):
        if step in (stages := (0, steps // 4, steps // 2)):
            stage = stages.index(step)
            finer = F.interpolate(grid.detach(), (CELLS[stage],) * 3, mode="trilinear", align_corners=True)
            grid = finer.requires_grad_()
            optimiser = torch.optim.Adam([grid], lr=(0.1, 0.1, 0.05)[stage], eps=1e-15)
        view, pixel = torch.randint(TRAINED, (PIXELS,)), torch.randint(SIZE[0] * SIZE[1], (PIXELS,))
        corner = torch.stack([pixel % SIZE[0], pixel // SIZE[0]], 1)
        places = (corner + torch.rand(RAYS, PIXELS, 2)).reshape(-1, 2)
        found = seen(camera, partial(field, grid), places, where[view].repeat(RAYS, 1, 1), torch.rand(len(places), 2))
        # The product of two halves: the square of one mean would punish the variance of its rays, which is blur.
        one, two = found.reshape(2, RAYS // 2, PIXELS, 3).mean(1) - photographs[view, pixel]
        optimiser.zero_grad()
        (one * two).mean().backward()
        optimiser.step()
        report((step + 1) / steps)
    return grid.detach()


@cache
def photographs() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Photographs [24, pixels, 3] and where they were taken, and those that are kept back."""
    exact = partial(LensCamera(lab.ROOT / LENS, SHOT), wavelength_nm=NM)
    where, views = poses(TRAINED, 0.0), poses(HELD, 1.0)
    taken, held = ([picture(exact, scene, pose, SHOWN_RAYS) for pose in of] for of in (where, views))
    return torch.stack(taken), where, torch.stack(held), views


def measure(name: str, steps: int, folder: Path, report: Any) -> lab.Row:
    """Train with a camera, and draw the photographs that were kept back and sharp pictures of the same views."""
    photos, where, held, views = photographs()
    lens = partial(LensCamera(lab.ROOT / MODEL, SHOT), wavelength_nm=NM)
    sharp = calibrated(lens, 0.0)
    cameras: dict[str, Camera] = {"lens": lens, "thin lens": calibrated(lens, 1.0), "pinhole": sharp}
    start = time.process_time()
    see = partial(field, train(cameras[name], photos, where, steps, report))
    seconds = time.process_time() - start
    drawn, clear, wanted = (
        torch.stack([picture(c, of, pose, SHOWN_RAYS) for pose in views])
        for c, of in ((cameras[name], see), (sharp, see), (sharp, scene))
    )
    four = torch.stack([p[0].reshape(SIZE[1], SIZE[0], 3) for p in (held, drawn, wanted, clear)]).transpose(0, 1)
    shown = (four.reshape(SIZE[1], -1, 3).clamp(0, 1) ** (1 / 2.2) * 255).byte().numpy()
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(shown).save(folder / f"radiance_{name.split()[0]}.png")
    errors = [float(-10 * torch.log10((a - b).square().mean())) for a, b in ((drawn, held), (clear, wanted))]
    return {"camera": name, "steps": steps, "psnr_db": errors[0], "sharp_db": errors[1], "cpu_s": seconds}


def page(rows: list[lab.Row]) -> str:
    shown = lab.columns(
        ("trained and drawn with", "camera"), ("photographs kept back, PSNR dB", "psnr_db", ".2f"),
        ("sharp pictures of their views, PSNR dB", "sharp_db", ".2f"), ("steps", "steps"), ("CPU s", "cpu_s", ".0f"),
    )  # fmt: skip
    command, table = "`python -m experiments radiance`", lab.table(shown, rows)
    shown_too = (f"![{name}](radiance_{name.partition(' ')[0]}.png)" for name in ("lens", "thin lens", "pinhole"))
    return lab.page("# A radiance field from photographs", command, str(__doc__), lab.machine_line(), table, *shown_too)


OPTIONS = (lab.count("steps", 400, "of training (default 400)"), lab.AGAIN, lab.out())


def run(args: argparse.Namespace) -> None:
    """Train with each camera; the table is written after each."""
    names = ("lens", "thin lens", "pinhole")
    lab.resume(
        args, "radiance", {name: name for name in names},
        lambda name, report: measure(name, args.steps, args.out, report),
        lambda row: row["camera"], page, listed="rows", again=args.restart, seconds=100.0, order=names,
    )  # fmt: skip
