"""`neurolens rays LENS -o OUT.npz`: the rays of a lens as arrays for programs that take any ray for any pixel."""

import json
import math
import os
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.files import atomic_path, write_arrays
from neurolens.base.report import Report
from neurolens.base.settings import group
from neurolens.cli import arguments as cli
from neurolens.cli.keys import ALL_KEYS, Frames, frames_group, numbered
from neurolens.cli.stmap import PictureCommand
from neurolens.pictures.render.film import PixelGrid, check_memory
from neurolens.pictures.render.pictures import write_channels
from neurolens.programs.hosts import BYTES_A_RAY, HOSTS, USUAL_PX, Arrays, Host, RayJob, RaySettings

_MOST_LAYERS = 64  # samples that an EXR may have as layers


@dataclass(frozen=True, kw_only=True)
class Rays(PictureCommand):
    """Write the rays of a camera for another program: origin, direction, weight and wavelength of 16 samples of every
    pixel, in the frame of OpenGL unless --to names a program. A lens is focused at infinity with its widest stop.

    The value of a pixel is the mean of weight times radiance over its samples. Film, pupil and light are sampled
    together, and one seed gives the same rays to every program.

      OUT.npz          arrays of numpy (numpy.load); about.json in it says how they were made
      OUT.safetensors  the same for torch and jax, without a copy; needs the extra "rays"
      OUT.exr          a picture: origin.X, direction.X, ...; of several samples layers s0, s1, ...

    In Python neurolens.rays gives the same arrays, on any device of torch."""

    epilog = f"""{cli.CAMERAS_HELP}

examples:
  neurolens rays laikin_double_gauss_50 --width 480 --film 36x24 --focus 1.5 --to newton -o rays.npz
  neurolens rays models/NAME.onnx --width 1920 --film 36x24 --samples 4 --compact -o rays.safetensors
  neurolens rays laikin_double_gauss_50 --width 480 --film 36x24 --frames 1:48 --key focus=1:1.2,48:3 -o pull.npz"""

    usual_px = USUAL_PX
    out: Path = cli.output_path("OUT.npz", "file to write: .npz, .safetensors or .exr")
    rays: RaySettings = group("rays")
    frames: Frames = frames_group("rays of these frames, OUT.0001.npz and so on", ALL_KEYS)

    def run(self) -> int:
        """Make and write the rays of every frame."""
        write, progress = self._writer(), self.progress()
        fixed = vars(self.state.given) | vars(self.rays)
        rows, made = list[RayFile](), None
        for _, digits, values in self.frames.states(fixed, self.called, ALL_KEYS):
            place = {name: values.pop(name) for name in ("position_m", "look_at_m") if name in values}
            state = self.state.at(**values)
            if made is None or made[0] != state:
                made = state, *self.make(state, progress, None, self.rays.light_nm)
            job = RayJob(made[1], PixelGrid(*self.picture, self.film), replace(self.rays, **place), made[2].focus_m)
            path = numbered(self.out, digits)
            with ExitStack() as stack, progress.stage(f"rays {path}") as report:
                began = time.process_time()
                arrays = job.arrays(lambda shape, kind: self._on_disk(stack, shape, kind), report)
                spent = time.process_time() - began
                write(path, arrays, job.about)
            count = int(np.prod(self.picture)) * self.rays.samples
            shapes, off = {name: array.shape for name, array in arrays.items()}, job.compact_px
            rows.append(RayFile(
                path, count, path.stat().st_size / count, job.passed, 1e9 * spent / count,
                off if self.rays.compact else None, shapes,
            ))  # fmt: skip
        return self.answer(RayFiles(self.camera, self.rays.to, rows))

    def _on_disk(self, files: ExitStack, shape: tuple[int, ...], kind: Any) -> NDArray[Any]:
        """Return an array in a nameless file beside the output: what is made waits there, not in memory."""
        file = files.enter_context(tempfile.TemporaryFile(dir=self.out.parent))
        if hasattr(os, "posix_fallocate"):  # else a full disk would end the process, not the command
            size = max(1, math.prod(shape) * np.dtype(kind).itemsize)
            try:
                os.posix_fallocate(file.fileno(), 0, size)
            except OSError as error:
                needed = f"{error.strerror}, for {size / 1e9:.3g} GB that wait in its folder"
                raise OSError(error.errno, needed, str(self.out)) from None
        return np.memmap(file, kind, "w+", shape=shape)

    def _writer(self) -> Callable[[Path, Arrays, dict[str, Any]], None]:
        """Return what writes the arrays, chosen and checked before they are made."""
        kind, asked = self.out.suffix.lower(), self.rays
        if kind == ".npz":
            return lambda path, arrays, about: write_arrays(path, about, arrays)
        if kind == ".safetensors":
            from safetensors.numpy import save_file

            def tensors(path: Path, arrays: Arrays, about: dict[str, Any]) -> None:
                with atomic_path(path) as temporary:
                    mode = temporary.stat().st_mode  # the library makes files that only their owner can read
                    save_file(dict(arrays), temporary, {"neurolens": json.dumps(about)})
                    temporary.chmod(mode)

            return tensors
        if asked.compact or asked.samples > _MOST_LAYERS:
            self.refuse("--output", self.out, f"no --compact and at most {_MOST_LAYERS} samples in an EXR: .npz")
        check_memory(*self.picture, BYTES_A_RAY * asked.samples)
        host = HOSTS[asked.to]
        return lambda path, arrays, about: write_channels(path, channels(arrays, host), None, about)


def channels(arrays: Arrays, host: Host) -> Arrays:
    """Return the arrays of a host as channels [H, W] of an EXR; each of several samples is a layer."""
    planes = Arrays()
    for name, array in host.views({k: v for k, v in arrays.items() if k != "to_world"}).items():
        if array.ndim == 2:
            planes[name] = array
            continue
        whole = array if array.ndim == 4 else array[..., None]
        for sample, k in np.ndindex(whole.shape[2:]):
            layer = f"s{sample}.{name}" if whole.shape[2] > 1 else name
            axis = "" if array.ndim == 3 else "." + ("RGB" if name == "weight" else "XYZ")[k]
            planes[layer + axis] = whole[:, :, sample, k]
    return planes


@dataclass(frozen=True)
class RayFile:
    """The rays of a frame.

    Attributes:
        passed: share of the rays that pass.
        compact_px: by how many pixels --compact moves points in the plane in focus, at most.
        arrays: the shape of each array.
    """

    file: Path
    rays: int
    bytes_a_ray: float
    passed: float
    cpu_ns_a_ray: float
    compact_px: float | None
    arrays: Mapping[str, tuple[int, ...]]

    def text(self) -> str:
        """Return a line, and a line of the arrays."""
        shapes = [f"{name} [{', '.join(map(str, shape))}]" for name, shape in self.arrays.items() if shape]
        off = "" if self.compact_px is None else f", off by at most {self.compact_px:.2g} pixels in the plane in focus"
        cost = f"{cli.number(self.cpu_ns_a_ray, 3)} CPU ns and {self.bytes_a_ray:.3g} bytes each{off}"
        return f"{self.file}: {self.rays} rays, {100 * self.passed:.3g}% pass, {cost}\n  {', '.join(shapes)}"


@dataclass(frozen=True)
class RayFiles(Report):
    """The rays of all frames, for the program `to`."""

    camera: str
    to: str
    frames: Sequence[RayFile]

    def text(self) -> str:
        """Return the lines of each file."""
        return "\n".join(frame.text() for frame in self.frames)
