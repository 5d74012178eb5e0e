"""A small network that corrects blur, trained on the point spread of real lenses or on random Zernike ones.

Both networks see as many pictures: dead leaves (discs of all sizes that hide each other), blurred by
`programs.blur.BlurredPairs`, with a sensor's noise. One has the point spread of 20 lenses of the library, wide open and
two stops down, over full frame, on pixels of 4 um. The other has 600 pupils with random Zernike terms 4 to 15 and
random colour errors, whose RMS radii of blur and f-numbers are drawn from those of the 20 lenses. Both are tested on
five other lenses, with other dead leaves and with the two photographs that scikit-learn brings. PSNR is that of values
as pictures have them (gamma 2.2). Writes deblur.md, deblur.json and deblur.jpg; what was made in between is kept in
runs/deblur. 6 CPU minutes.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.polynomial import chebyshev
from torch import Tensor, nn
from torch.utils.data import DataLoader

import neurolens as nl
from experiments import lab
from experiments.lab import Report, Row
from neurolens.base.files import write_arrays
from neurolens.base.find import read_index
from neurolens.models.cores import Array
from neurolens.optics.analysis.diffraction import spread
from neurolens.optics.analysis.exit_pupil import ExitPupil
from neurolens.pictures.render.settings import SensorSettings
from neurolens.programs.blur import BlurredPairs
from neurolens.programs.psf import read_psf

FOLDER = lab.ROOT / "runs" / "deblur"
KINDS = {"real": "20 real lenses", "zernike": "random Zernike"}
TRAIN, TEST = 20, 5
_PIXEL_MM, _SIDE, _GRID, _CLOSED = 0.004, 41, (5, 3), 4.0
_PUPILS, _NM, _ROOM, _COLOUR = 600, (610.0, 540.0, 460.0), 1.1, 0.3
_PATCH, _BATCH, _CHANNELS, _LAYERS, _RATE = 64, 8, 32, 5, 2e-3
_TEST_PATCH, _TESTED = 128, 16
_LEAVES, _SIZE = 4000, (300, 400)
SENSOR = SensorSettings(mosaic="none", electrons=5000)


def lenses() -> list[str]:
    """Return lens files by chance: primes for full frame, 24 to 135 mm, f/2.9 or faster, without doubts."""
    found = []
    for file, entry in sorted(read_index().items()):
        r = entry["row"]
        fits = r["verdict"] == "ok" and not r["cylinders"] and not r["states"] and (r["image_radius_mm"] or 0) >= 21.6
        if fits and 24 <= r["efl_mm"] <= 135 and r["f_number"] <= 2.9:
            found.append(file)
    return np.random.default_rng(55).permutation(found)[: TRAIN + TEST].tolist()


def real_files() -> list[Path]:
    """Return the point spread of each lens, made where it is missing."""
    files = []
    for name in lenses():
        file = FOLDER / f"{Path(name).stem}.npz"
        if not file.is_file():
            widest = float(read_index()[name]["row"]["f_number"]) * 1.001
            nl.psf(
                lab.LENSES / name, output=file, film=(36.0, 24.0), pixel_um=1000 * _PIXEL_MM, grid=_GRID, side=_SIDE,
                f_number=[widest, _CLOSED * widest], quiet=True,
            )  # fmt: skip
        files.append(file)
    return files


def radii_px(kernels: Array) -> Array:
    """Return the RMS radii [N] of kernels [N, side, side] about their centroids, in pixels."""
    at = np.arange(kernels.shape[-1], dtype=float)
    light = kernels / np.maximum(kernels.sum((1, 2), keepdims=True), 1e-30)
    each = [light.sum(k) for k in (1, 2)]
    return np.asarray(np.sqrt(sum(p @ at**2 - (p @ at) ** 2 for p in each)))


def zernike(x: Array, y: Array) -> Array:
    """Return Noll's Zernike polynomials 4 to 15."""
    r = x * x + y * y
    two, eight, ten = ((y * 2 * x, x * x - y * y), ((3 * r - 2) * y, (3 * r - 2) * x), 4 * r - 3)
    three = (3 * x * x * y - y**3, x**3 - 3 * x * y * y)
    four = (x**4 - 6 * x * x * y * y + y**4, 4 * (x**3 * y - x * y**3))
    parts = [
        math.sqrt(3) * (2 * r - 1), *(math.sqrt(6) * p for p in two), *(math.sqrt(8) * p for p in (*eight, *three)),
        math.sqrt(5) * (6 * r * r - 6 * r + 1), *(math.sqrt(10) * p for p in (ten * two[1], ten * two[0], *four)),
    ]  # fmt: skip
    return np.stack(parts)


def random_pupils(f_number: float, radius_mm: float, random: np.random.Generator) -> list[ExitPupil]:
    """Return pupils of red, green and blue, whose rays in green have an RMS radius on the film."""
    nodes, half = chebyshev.chebpts1(9), np.full(2, _ROOM / (2 * f_number))
    u, v = np.meshgrid(nodes, nodes, indexing="ij")
    inverse = np.linalg.inv(chebyshev.chebvander(nodes, 8))
    shape = zernike(_ROOM * u, _ROOM * v)
    order = np.array([2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 4])
    wave = np.tensordot(random.normal(size=12) / order, shape, 1)
    colours = [random.normal(size=3) * _COLOUR * on for on in (1.0, 0.0, 1.0)]
    disc = np.stack([u, v])[:, np.hypot(u, v) * _ROOM <= 1]
    found = list[ExitPupil]()
    for nm, (focus, right, up) in zip(_NM, colours, strict=True):
        figures = np.zeros((15, 15, 4))
        own = wave + focus / 2 * shape[0] + right * u + up * v
        figures[:9, :9, 0] = inverse @ own @ inverse.T
        figures[0, 0, 1], figures[1, 0, 2], figures[0, 1, 3] = 1.0, _ROOM, _ROOM
        found.append(
            ExitPupil(nm, np.zeros(2), np.zeros(2), half, figures, (1.0,), None, np.zeros((2, 1)), np.zeros((2, 2)))
        )
    hits = found[1].hits(disc)
    scale = radius_mm / float(np.sqrt(hits.var(1).sum()))
    for p in found:
        p.figures[..., 0] *= scale
        object.__setattr__(p, "hits_mm", p.hits(disc))
    return found


def zernike_file(real: Sequence[Path]) -> Path:
    """Return the file of random point spread, whose sizes and f-numbers are those of real ones."""
    file = FOLDER / "zernike.npz"
    if file.is_file():
        return file
    sizes, numbers = list[Array](), list[float]()
    for path in real:
        _, arrays = read_psf(path)
        for n, f_number in enumerate(arrays["f_number"]):
            kernels = arrays["psf"][n, :, :, :, 1].reshape(-1, _SIDE, _SIDE).astype(float)
            sizes.append(radii_px(kernels))
            numbers += [float(f_number)] * len(kernels)
    every, random = np.concatenate(sizes), np.random.default_rng(4)
    psf = []
    for k in random.integers(len(every), size=_PUPILS):
        pupils = random_pupils(numbers[k], float(every[k]) * _PIXEL_MM, random)
        psf.append(spread(pupils, np.eye(3), _PIXEL_MM, _SIDE).light)
    one = np.ones((_PUPILS, 1, 1, 1))
    arrays = {
        "psf": np.array(psf, np.float32)[:, None, None, None], "centre_mm": np.zeros((_PUPILS, 1, 1, 1, 2)),
        "inside": np.array(psf).sum((2, 3))[:, None, None, None], "light": one, "by_rays": one < 0, "differs": 0 * one,
        "place_mm": np.zeros((1, 1, 2)), "f_number": np.ones(_PUPILS), "distance_m": np.full(1, np.inf),
    }  # fmt: skip
    write_arrays(file, {"pixel_um": 1000 * _PIXEL_MM, "film_mm": (36.0, 24.0)}, arrays)
    return file


def leaves(seed: int) -> Array:
    """Return dead leaves [H, W, 3] in linear light: discs with radii of the density r^-3, the last in front."""
    random, (height, width) = np.random.default_rng([7, seed]), (2 * n for n in _SIZE)
    found = np.zeros((height, width, 3))
    for k in range(_LEAVES):
        radius = 4 / math.sqrt(1 - random.random() * (1 - (4 / 240) ** 2)) if k > 40 else 300.0
        x, y, value = (
            random.random() * width,
            random.random() * height,
            0.05 + 0.95 * random.random() * (1 - 0.5 * random.random(3)),
        )
        rows, columns = (
            slice(max(int(c - radius), 0), min(int(c + radius) + 2, n)) for c, n in ((y, height), (x, width))
        )
        j, i = np.ogrid[rows, columns]
        texture = 1 + 0.15 * np.sin(random.random() * j + random.random() * i + random.random())
        inside = (i - x) ** 2 + (j - y) ** 2 <= radius**2
        found[rows, columns][inside] = (value * texture[..., None])[inside]
    linear = np.clip(found, 0, 1) ** 2.2
    return np.asarray(linear.reshape(_SIZE[0], 2, _SIZE[1], 2, 3).mean((1, 3)), np.float32)


def photographs() -> list[Array]:
    """Return the two photographs of scikit-learn (CC BY 2.0) in linear light, at half size, which hides their noise."""
    from sklearn.datasets import load_sample_images

    found = [(image[:426].astype(np.float32) / 255) ** 2.2 for image in load_sample_images().images]
    return [image.reshape(213, 2, 320, 2, 3).mean((1, 3)).astype(np.float32) for image in found]


def shown(light: Tensor) -> Tensor:
    """Return values as pictures have them, of linear light."""
    return torch.clamp(light, 0, 1) ** (1 / 2.2)


class Corrector(nn.Module):
    """Five convolutions, whose sum is added to the picture."""

    def __init__(self) -> None:
        super().__init__()
        sizes = [3, *[_CHANNELS] * (_LAYERS - 1), 3]
        self.layers = nn.ModuleList(nn.Conv2d(a, b, 3, padding=1) for a, b in zip(sizes, sizes[1:], strict=False))

    def forward(self, picture: Tensor) -> Tensor:
        """Return corrected pictures [N, 3, H, W]."""
        found = picture
        for k, layer in enumerate(self.layers):
            found = layer(found) if k == len(self.layers) - 1 else torch.relu(layer(found))
        return picture + found


def trained(kind: str, seed: int, steps: int, report: Report) -> Corrector:
    """Train a network on pairs of one kind."""
    real = real_files()[:TRAIN]
    files = real if kind == "real" else [zernike_file(real)]
    pairs = BlurredPairs(
        [leaves(k) for k in range(24)], files, _PATCH, SENSOR, 100 + seed, steps * _BATCH, vignetting=False
    )
    torch.manual_seed(seed)
    network = Corrector()
    optimiser = torch.optim.Adam(network.parameters(), _RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for step, (sharp, blurred) in enumerate(DataLoader(pairs, _BATCH)):
        loss = (network(shown(blurred)) - shown(sharp)).abs().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        report((step + 1) / steps)
    return network


def tests() -> Iterator[tuple[str, str, BlurredPairs]]:
    """Give lens, kind of picture and pairs."""
    pictures = {"leaves": [leaves(1000 + k) for k in range(4)], "photographs": photographs()}
    for file in real_files()[TRAIN:]:
        for name, some in pictures.items():
            yield file.stem, name, BlurredPairs(some, [file], _TEST_PATCH, SENSOR, 999, _TESTED, vignetting=False)


def measure(kind: str, seed: int, steps: int, report: Report) -> Row:
    """Return the PSNR of a network by lens and picture, and of blurred pictures; the restored example is kept."""
    begun = lab.cpu_s()
    network = trained(kind, seed, steps, report)
    took, row = lab.cpu_s() - begun, list[Row]()
    for lens, pictures, pairs in tests():
        both = [pairs[k] for k in range(len(pairs))]
        sharp, blurred = (shown(torch.stack(some)) for some in zip(*both, strict=True))
        with torch.no_grad():
            found = network(blurred).clamp(0, 1)
        row.append({"lens": lens, "pictures": pictures, "blurred": _psnr(blurred, sharp), "psnr": _psnr(found, sharp)})
        if pictures == "photographs" and seed == 0:
            example = {"sharp": sharp[:2], "blurred": blurred[:2], kind: found[:2]}
            np.savez(FOLDER / f"example_{kind}_{lens}.npz", **{name: part.numpy() for name, part in example.items()})
    return {"kind": kind, "seed": seed, "steps": steps, "cpu_s": took, "tests": row}


def _psnr(found: Tensor, sharp: Tensor) -> float:
    """Return the mean over pictures, in decibels."""
    return float((-10 * torch.log10(((found - sharp) ** 2).mean((1, 2, 3)))).mean())


def page(rows: Sequence[Row]) -> str:
    """Return the page: PSNR by lens and picture, as the mean of seeds and half their range."""
    made, by = list[Row](), dict[tuple[str, str], dict[str, Any]]()
    for row in rows:
        for t in row["tests"]:
            entry = by.setdefault((t["pictures"], t["lens"]), {"blurred": t["blurred"], **{k: [] for k in KINDS}})
            entry[row["kind"]].append(t["psnr"])
    for (pictures, lens), entry in sorted(by.items()):
        made.append({"lens": lens, "pictures": pictures, "blurred": entry["blurred"]})
        for kind in KINDS:
            values = entry[kind]
            made[-1][kind] = f"{np.mean(values):.2f} +- {np.ptp(values) / 2:.2f}" if values else None
        if all(entry[kind] for kind in KINDS):
            made[-1]["gain"] = float(np.mean(entry["real"]) - np.mean(entry["zernike"]))
    columns = lab.columns(
        ("pictures", "pictures"), ("lens", "lens"), ("blurred, dB", "blurred", ".2f"),
        *((f"trained on {text}", kind) for kind, text in KINDS.items()), ("real less Zernike", "gain", "+.2f"),
    )  # fmt: skip
    gains = [m["gain"] for m in made if "gain" in m]
    said = ""
    if gains:
        said = (
            f"Real lenses are ahead in {sum(g > 0 for g in gains)} of {len(gains)} rows, by {np.mean(gains):+.2f} dB "
        )
        said += "in the mean."
    seeds, steps = len({r["seed"] for r in rows}), {r["steps"] for r in rows}
    return lab.page(
        "# Blur corrected by a small network\n\n`python -m experiments deblur`\n\n"
        f"Two networks of {_LAYERS} layers and "
        f"{_CHANNELS} channels see {_BATCH} patches of {_PATCH} pixels a step, "
        f"{max(steps, default=0)} steps, {seeds} seeds: +- is half the range of these. "
        f"This is small: no tuning, and few steps. {said}",
        lab.table(columns, made, "-"),
        "![A photograph (danielbuechele, CC BY 2.0) through three lenses that neither network saw](deblur.jpg)",
    )  # fmt: skip


def draw(folder: Path) -> None:
    """Draw the examples: sharp, blurred, and corrected by each network."""
    from PIL import Image

    tiles = []
    for file in real_files()[TRAIN : TRAIN + 3]:
        parts = {kind: FOLDER / f"example_{kind}_{file.stem}.npz" for kind in KINDS}
        if not all(p.is_file() for p in parts.values()):
            return
        read = {kind: np.load(p) for kind, p in parts.items()}
        for name in ("sharp", "blurred", "zernike", "real"):
            picture = read["zernike" if name == "zernike" else "real"][name][0].transpose(1, 2, 0)
            big = Image.fromarray(np.uint8(255 * picture + 0.5)).resize((256, 256), Image.Resampling.NEAREST)
            tiles.append(
                lab.labelled(big, {**KINDS, "zernike": "by random Zernike", "real": "by real lenses"}.get(name, name))
            )
    lab.write_small(folder / "deblur.jpg", [(lab.sheet(tiles, 4, 6), {"quality": q}) for q in (90, 80, 70)], 200_000)


OPTIONS = (
    lab.count("steps", 700, "of training (default: 700)"),
    lab.count("seeds", 2, "networks of each kind (default: 2)"),
    lab.AGAIN,
    lab.out(),
)


def run(args: argparse.Namespace) -> None:
    """Train what is missing, and write the table after each network."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    items = {(kind, f"seed {seed}"): (kind, seed) for seed in range(args.seeds) for kind in KINDS}
    lab.resume(
        args, "deblur", items, lambda item, report: measure(*item, args.steps, report),
        lambda r: (r["kind"], f"seed {r['seed']}"), page, listed="networks", facts={"steps": args.steps},
        again=args.restart, seconds=200,
    )  # fmt: skip
    draw(args.out)
