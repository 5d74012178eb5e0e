"""Pictures blurred by the point spread of a real lens, place by place, for torch: to train networks, or to invert.

Every point of the picture spreads its light by the point spread of its own place, which is mixed linearly from those of
the four places about it: y = sum over k of h_k * (w_k x), with w_k the shares of place k. The adjoint is x = sum over k
of w_k (h_k correlated with y). Convolutions are exact, by Fourier transforms of the part of the picture that a place
has a share of.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from neurolens.base.errors import InputError
from neurolens.pictures.defocus.diffraction import shares
from neurolens.pictures.render.images import read_picture
from neurolens.pictures.render.sensor import about as about_sensor, expose
from neurolens.pictures.render.settings import SensorSettings
from neurolens.programs.psf import Arrays, read_psf


class Blur:
    """The blur of a lens on a part of its picture, as a linear operator on tensors [C, H, W] of linear light.

    Gradients go through it. Light from beyond the part counts as dark. Point spread is scaled to the sum 1: the light
    that `inside` lacks is put back.

    Args:
        file: of `neurolens psf` (.npz), or what `read_psf` returns.
        size: height and width of the part, in pixels of the file.
        at_mm: (right, up) where the middle of the part lies in the picture of the lens.
        state: which f-number and which distance of the file, counted from 0.
        vignetting: whether light falls off towards the corners as through the lens.

    Raises:
        InputError: it is no such file, or has no such state, or the middle of the part lies beyond its film.
    """

    def __init__(
        self, file: Path | str | tuple[dict[str, Any], Arrays], size: tuple[int, int],
        at_mm: tuple[float, float] = (0.0, 0.0), state: tuple[int, int] = (0, 0), *, vignetting: bool = True,
    ) -> None:  # fmt: skip
        about, arrays = file if isinstance(file, tuple) else read_psf(Path(file))
        if not all(0 <= k < n for k, n in zip(state, arrays["psf"].shape[:2], strict=True)):
            raise InputError("blur", "state", state, f"below {arrays['psf'].shape[:2]}, the file's states")
        if not all(2 * abs(place) <= side for place, side in zip(at_mm, about["film_mm"], strict=True)):
            raise InputError("blur", "at_mm", at_mm, "a place on the film of {:g} x {:g} mm".format(*about["film_mm"]))
        psf, light, pixel_mm = arrays["psf"][state], arrays["light"][state], about["pixel_um"] / 1000
        self.size, self.channels, self.radius = size, psf.shape[2], psf.shape[-1] // 2
        height, width = size
        up = at_mm[1] + ((height - 1) / 2 - np.arange(height)) * pixel_mm
        right = at_mm[0] + (np.arange(width) - (width - 1) / 2) * pixel_mm
        rows = shares(-arrays["place_mm"][:, 0, 1], -up)
        columns = shares(arrays["place_mm"][0, :, 0], right)
        self._parts = []
        for (i, down, part), (j, across, other) in product(rows, columns):
            kernel = np.array(psf[i, j], np.float64)
            whole = kernel.sum((-2, -1), keepdims=True)
            kernel /= np.where(whole > 0, whole, 1)
            kernel *= light[i, j] if vignetting else 1
            self._parts.append((*down, *across, torch.from_numpy(part[:, None] * other), torch.from_numpy(kernel)))

    def __call__(self, sharp: Tensor) -> Tensor:
        """Return the blurred picture."""
        return self._applied(sharp, adjoint=False)

    def adjoint(self, blurred: Tensor) -> Tensor:
        """Return the adjoint applied to a picture: the inner products <A x, y> and <x, A* y> are equal."""
        return self._applied(blurred, adjoint=True)

    def _applied(self, picture: Tensor, adjoint: bool) -> Tensor:
        if picture.shape != (self.channels, *self.size) or not picture.is_floating_point():
            raise InputError(
                "blur", "picture", f"({picture.dtype} {tuple(picture.shape)})", f"floats {(self.channels, *self.size)}"
            )
        r, (height, width) = self.radius, self.size
        room = torch.nn.functional.pad(picture, (r, r, r, r))
        found = torch.zeros_like(room)
        for top, bottom, left, right, share, kernel in self._parts:
            h = kernel.to(picture)
            at = [slice(top, bottom + 2 * r), slice(left, right + 2 * r)]  # where the place's light goes
            own = slice(top + r, bottom + r), slice(left + r, right + r)
            weight = share.to(picture)
            shape = bottom - top + 2 * r, right - left + 2 * r
            if adjoint:
                spectrum = torch.fft.rfft2(room[:, at[0], at[1]]) * torch.fft.rfft2(h, s=shape).conj()
                seen = torch.fft.irfft2(spectrum, s=shape)[:, : bottom - top, : right - left]
                found[:, own[0], own[1]] += weight * seen
            else:
                spectrum = torch.fft.rfft2(weight * room[:, own[0], own[1]], s=shape) * torch.fft.rfft2(h, s=shape)
                found[:, at[0], at[1]] += torch.fft.irfft2(spectrum, s=shape)
        return found[:, r : r + height, r : r + width]


@dataclass
class BlurredPairs(Dataset[tuple[Tensor, Tensor]]):
    """Pairs of sharp and blurred patches of pictures, each at a random place and state of a random lens.

    A pair is determined by its number and the seed. Patches are [3, n, n] of linear sRGB. With a sensor the second has
    its noise and its colours: [3, n, n], or [1, n, n] of a mosaic, as light (electrons over those of value 1).

    Files are read once for their checksums, and a pair reads again what it needs: they may be larger than memory.

    Attributes:
        pictures: files (.exr, or .png and .jpg as sRGB) or arrays [H, W, 3] of linear sRGB, floats whose white is 1.
        files: of `neurolens psf` with channels R, G, B.
        patch: pixels a side. sensor: None leaves light as it is. length: pairs in an epoch; None is that of pictures.
        vignetting: as of `Blur`.

    Raises:
        InputError: there is no picture or file, or a picture is none of these, or smaller than a patch; a file is
            damaged, or has changed since.
        IndexError: the number of a pair is not below the length.
    """

    pictures: Sequence[Path | str | Any]
    files: Sequence[Path | str]
    patch: int = 128
    sensor: SensorSettings | None = None
    seed: int = 0
    length: int | None = None
    vignetting: bool = True

    def __post_init__(self) -> None:
        for name in ("pictures", "files"):
            if isinstance(given := getattr(self, name), str | Path) or not len(given):
                raise InputError("pairs", name, given, "a list of at least one")
        for name, least in (("patch", 1), ("seed", 0), ("length", 1)):
            if (number := getattr(self, name)) is not None and (number != int(number) or number < least):
                raise InputError("pairs", name, number, f"a whole number, at least {least}")
        self._lenses: list[tuple[dict[str, Any], Arrays, Path, int, Any]] = []
        for file in [Path(file).absolute() for file in self.files]:
            about, arrays = read_psf(file)
            if (psf := arrays.pop("psf")).shape[4] != 3:
                raise InputError(file, "channels", psf.shape[4], "three channels, R, G and B")
            # What goes to a worker is where the point spread lies in its file, not the point spread.
            mapping = psf.dtype, "r", psf.offset, psf.shape, "FC"[psf.flags.c_contiguous]  # type: ignore[attr-defined]
            self._lenses.append((about, arrays, file, file.stat().st_mtime_ns, mapping))

    def __len__(self) -> int:
        return self.length or len(self.pictures)

    def __getitem__(self, number: int) -> tuple[Tensor, Tensor]:
        """Return the sharp and the blurred patch of a number."""
        if not 0 <= number < len(self):
            raise IndexError(f"pair {number} of {len(self)}")  # which ends a loop over all
        random = np.random.default_rng([self.seed, number])
        picture = self.pictures[number % len(self.pictures)]
        if isinstance(picture, str | Path):
            picture = read_picture(Path("pairs"), "picture", Path(picture))
        picture = np.asarray(picture)
        if picture.shape[2:] != (3,) or picture.dtype.kind != "f":  # whole numbers, as PNG has them, are not linear
            expected = "floats [H, W, 3] of linear sRGB, or the name of a file"
            raise InputError("pairs", "picture", f"({picture.dtype} {picture.shape})", expected)
        if min(picture.shape[:2]) < self.patch:
            raise InputError("pairs", "picture", picture.shape, f"at least {self.patch} pixels a side")
        about, arrays, file, written, mapping = self._lenses[random.integers(len(self._lenses))]
        if file.stat().st_mtime_ns != written:
            raise InputError(file, "file", "(changed since)", "the file that it was at first")
        arrays = arrays | {"psf": np.memmap(file, *mapping)}
        n, d = (int(random.integers(count)) for count in arrays["psf"].shape[:2])
        free_mm = np.maximum(np.array(about["film_mm"]) - self.patch * about["pixel_um"] / 1000, 0)
        right, up = (free_mm * (random.random(2) - 0.5)).tolist()
        # Beyond its edges a picture is mirrored, so that light comes from there, too.
        room = arrays["psf"].shape[-1] // 2
        rows, columns = (
            size - 1 - np.abs((np.arange(self.patch + 2 * room) + corner - room) % (2 * size - 2) - size + 1)
            for size in picture.shape[:2]
            for corner in (int(random.integers(size - self.patch + 1)),)
        )
        around = torch.from_numpy(picture[rows[:, None], columns].astype(np.float32).transpose(2, 0, 1).copy())
        if not around.isfinite().all():
            raise InputError("pairs", "picture", "(not finite)", "finite numbers")
        blur = Blur((about, arrays), (len(rows), len(columns)), (right, up), (n, d), vignetting=self.vignetting)
        sharp, blurred = (v[:, room : room + self.patch, room : room + self.patch] for v in (around, blur(around)))
        if self.sensor is None:
            return sharp, blurred
        seed = int(random.integers(1 << 31))
        planes = np.stack([*expose(blurred.permute(1, 2, 0).numpy(), self.sensor, seed).values()])
        facts = about_sensor(self.sensor, seed)
        electrons = (planes - facts["black_level"]) * facts["electrons_per_number"]
        return sharp, torch.from_numpy((electrons / self.sensor.electrons).astype(np.float32))
