"""Lens cameras for torch: the rays of film points as tensors, with gradients.

The camera is a program of some hundred steps a ray (`graph.program`), and its gradients are another, its adjoint
(`graph.adjoint`). In float32 each runs as one compiled function, which a tensor passes once: as C on the CPU, where the
machine has a compiler, and as a CUDA kernel on a GPU, compiled by the NVRTC library that comes with torch. Elsewhere
torch takes the steps one by one.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.build import make_camera
from neurolens.cameras.lenscamera import CompiledProgram, LensCamera as _Camera, padded
from neurolens.cameras.lensfilm import whole_camera
from neurolens.graph.adjoint import OUTER, adjoint
from neurolens.graph.c import Signature
from neurolens.graph.compiler import has_compiler
from neurolens.graph.program import WAVELENGTH, Argument, Program, Step, row_names, rules_of
from neurolens.graph.scalars import lower
from neurolens.graph.shading import REGISTERS, Cuda
from neurolens.optics.lens.prescription import LINE_D_NM
from neurolens.optics.lens.shot import Shot

# steps of derivatives by settings, as a share of the setting; for focus at least so much, in 1/m
_SHARE, _LEAST = 0.03, 3e-3
_GIVEN = (*row_names("film_mm", 2), *row_names("square", 2), WAVELENGTH)
_FOUND = (*row_names("ray", 6), "weight")
_AWAY = 2.0  # of these steps from the shot's setting: beyond, rays are no longer taken as linear in it
# From rows [R, N] of rays to results [R, N] in the order of a program's outputs.
Run = Callable[[Tensor], Tensor]
_THREADS, _MOST = 128, 2**30  # threads of a block of a kernel; the most rays of a call, whose number is an int of C


class LensRays(NamedTuple):
    """Rays of N film points in the camera's frame, or in the world if the camera has a pose.

    The camera's frame is in metres, with its origin at the film's centre, looking along -z, y up.

    Attributes:
        origin: [N, 3]. direction: [N, 3] of unit length; along the axis where the ray did not pass.
        weight: [N] factor on the ray's radiance: a film point's value is the mean of weight times radiance over its
            rays. 0 where the ray did not pass.
    """

    origin: Tensor
    direction: Tensor
    weight: Tensor
    status: Tensor


class LensCamera:
    """The camera of a lens or of its model, for torch::

        camera = LensCamera("models/laikin_double_gauss_50.ols-60.onnx", Shot((36.0, 24.0), focus_m=2.0))
        film = camera.film_points(torch.tensor([[320.0, 240.0]]), (960, 640))
        rays = camera(film, torch.rand(1, 2), pose=torch.eye(4))

    Rays are differentiable once by film points, random numbers, wavelengths and poses, and by the settings of a call:
    `focus_m`, `f_number` and `zoom`. A setting also moves the pupil, whose points the random numbers choose. The
    derivative by a setting is the difference between two cameras, one a step below and one a step above the shot. A
    step is 3% of 1 / f-number, of the zoom, or of 1 / focus (there at least 0.003 1/m). Within two steps rays are
    linear in the setting; farther away, make another camera.

    Args:
        camera: a lens file, a model, or another name that `make_camera` takes for one of these.
        shot: the settings of the camera.
        device, dtype: those of all results; what is given is converted to them. float64 on the CPU is for checks.

    Raises:
        InputError, ModelError: as `make_camera`; the camera has no lens.
    """

    def __init__(
        self, camera: str | Path, shot: Shot, *, device: str | torch.device = "cpu", dtype: torch.dtype = torch.float32
    ) -> None:
        self.spec, self.shot = str(camera), shot
        # the device with its number, where it is a GPU
        self.device, self.dtype = torch.empty(0, device=device).device, dtype
        self._sides: dict[str, _Sides] = {}
        self._lens = self._made(shot)

    def film_points(self, pixels: Tensor, size: tuple[int, int]) -> Tensor:
        """Return film points [N, 2] (mm) of places [N, 2], from the upper left, in a picture of `size` pixels.

        The middle of the first pixel is at (0.5, 0.5); the picture on the film stands on its head.
        """
        width, height = self.shot.film_mm
        places = pixels.to(self.device, self.dtype)
        half = places.new_tensor([width / 2, -height / 2])
        return half - places * places.new_tensor([width / size[0], -height / size[1]])

    def __call__(
        self,
        film_mm: Tensor,
        square: Tensor,
        wavelength_nm: Tensor | float = LINE_D_NM,
        *,
        pose: Tensor | None = None,
        **settings: Tensor | float,
    ) -> LensRays:
        """Return the rays of film points.

        Args:
            film_mm: [N, 2], lens frame: x right and y up as the camera looks.
            square: [N, 2] random numbers from 0 to 1, which choose the point in the pupil.
            wavelength_nm: [N], or one number.
            pose: [3, 4] or [4, 4], or one for each ray, from the camera's frame to the world.
            settings: `focus_m`, `f_number`, `zoom` (mm), each one number that replaces the shot's.

        Raises:
            InputError: tensors have other shapes; the camera does not have a setting, or the setting is too far from
                the shot's.
        """
        count = len(film_mm)
        film, places, light = (
            torch.as_tensor(t, dtype=self.dtype, device=self.device) for t in (film_mm, square, wavelength_nm)
        )
        _check_shape("film_mm", film, (count, 2))
        _check_shape("square", places, (count, 2))
        _check_shape("wavelength_nm", light, (), (count,))
        if pose is not None:
            pose = pose.to(self.device, self.dtype)
            _check_shape("pose", pose, *((*rays, rows, 4) for rays in ((), (count,)) for rows in (3, 4)))
        names = tuple(settings)
        moves = [self._coordinate(name, settings[name]) for name in names]
        found: tuple[Tensor, ...] = _Rays.apply(self, names, film, places, light.expand(count), *moves)
        origin, direction, weight, status = found[0].T, found[1].T, found[2], found[3]
        if settings:  # steps along tangents make directions longer
            direction = torch.nn.functional.normalize(direction, dim=1)
        if pose is not None:
            turn, place = pose[..., :3, :3], pose[..., :3, 3]
            # Not by a product of matrices, which torch may compute with fewer digits.
            origin = (turn * origin[..., None, :]).sum(-1) + place
            direction = (turn * direction[..., None, :]).sum(-1)
        return LensRays(origin, direction, weight, status)

    def _coordinate(self, name: str, value: Tensor | float) -> Tensor:
        """Return how far a setting is from the shot's, in the coordinate in which rays are linear."""
        if name not in ("focus_m", "f_number", "zoom"):
            raise InputError("LensCamera", name, value, "one of focus_m, f_number, zoom")
        number = torch.as_tensor(value).double().cpu()
        if number.numel() != 1:
            raise InputError("LensCamera", name, tuple(number.shape), "one number")
        number, start = number.reshape(()), self._start(name)
        moved = (number if name == "zoom" else 1 / number) - start
        low, high = (_AWAY * end for end in self._beside(name).ends)
        if not low * (1 + 1e-6) <= float(moved.detach()) <= high * (1 + 1e-6):
            ends = [v if name == "zoom" else 1 / v if v > 0 else math.inf for v in (start + low, start + high)]
            expected = f"a number from {min(ends):.6g} to {max(ends):.6g}: beyond, make another camera"
            raise InputError("LensCamera", name, float(number.detach()), expected)
        return moved

    def _start(self, name: str) -> float:
        if name == "focus_m":
            return 1 / self.shot.focus_m
        if name == "zoom":
            if not isinstance(self.shot.zoom, (int, float)):
                raise InputError("LensCamera", "zoom", self.shot.zoom, "a shot whose zoom is a focal length in mm")
            return float(self.shot.zoom)
        return 1 / float(self._lens.camera.settings["f_number"])

    def _step(self, name: str) -> float:
        return max(_SHARE * abs(self._start(name)), _LEAST if name == "focus_m" else 0.0)

    def _beside(self, name: str) -> _Sides:
        """Return the lenses below and above a setting, which are made once."""
        if name not in self._sides:
            start, step = self._start(name), self._step(name)
            found, ends = [], []
            for end in (-step, step):
                try:
                    found.append(self._made(self._at(name, start + end)))
                    ends.append(end)
                except InputError:  # beyond what the lens or its model can do
                    found.append(self._lens)
                    ends.append(0.0)
            if ends[0] == ends[1]:
                raise InputError("LensCamera", name, "(at its only value)", "a setting that this camera can change")
            self._sides[name] = _Sides(found[0], found[1], (ends[0], ends[1]))
        return self._sides[name]

    def _at(self, name: str, coordinate: float) -> Shot:
        shot = replace(self.shot, clamp_f_number=False)
        if name == "zoom":
            return replace(shot, zoom=coordinate)
        if coordinate < 0:
            raise InputError("LensCamera", name, coordinate, "at most infinity")
        value = 1 / coordinate if coordinate else math.inf
        return replace(shot, focus_m=value) if name == "focus_m" else replace(shot, f_number=value)

    def _made(self, shot: Shot) -> _Lens:
        return _Lens(self.spec, shot, self.device, self.dtype)


class _Lens:
    """The camera of one shot as a program, and how it runs here: forwards, and by its adjoint backwards."""

    def __init__(self, spec: str, shot: Shot, device: torch.device, dtype: torch.dtype) -> None:
        camera = make_camera(spec, shot)
        if not isinstance(camera, _Camera):
            raise InputError(
                "LensCamera", "camera", spec, "a lens file or a model, with all of its dispersion and light"
            )
        compiled = device.type == "cpu" and dtype == torch.float32 and has_compiler()
        self.camera: _Camera = camera.compiled() if compiled else camera
        self.compiled, self.device, self.dtype = compiled, device, dtype
        lens = camera.lens_graph()
        graph, self._numbers = whole_camera(camera.film, lens, mask_too=True)
        self._tables = {"outline": camera.film.outline.table}
        if lens.aperture is not None and lens.aperture.mask is not None:
            self._tables["mask"] = lens.aperture.table
        self.program, self._backwards = lower(graph), dict[bool, Run]()

    def outputs(self, film: Tensor, square: Tensor, light: Tensor) -> tuple[Tensor, ...]:
        """Return origins and directions [3, N], weights and status [N], for film and square [N, 2] and light [N]."""
        if self.compiled:  # numpy transposes arrays of two columns ten times as fast as torch
            points, places = (np.ascontiguousarray(t.numpy().T) for t in (film, square))
            rays = self.camera.sample(points, places, np.ascontiguousarray(light.numpy()))
            return tuple(map(torch.from_numpy, (rays.origin_m, rays.direction, rays.weight, rays.status)))
        found = self.forward(torch.stack([*film.T, *square.T, light]))
        ray, weight, status = found[:6], found[6], found[7].int()
        passed, ahead = status == st.PASSED, film.new_tensor([[0], [0], [-1]])
        return torch.where(passed, ray[:3], 0.0), torch.where(passed, ray[3:], ahead), weight, status

    def gradients(
        self, film: Tensor, square: Tensor, light: Tensor, outer: Sequence[Tensor], by_light: bool = True
    ) -> tuple[Tensor | None, ...]:
        """Return a number's gradients [N, 2], [N, 2], [N] by the inputs of `outputs`, from those by the results.

        Those by the wavelength are None unless `by_light`: glasses and coatings have as many steps as the ray itself.
        """
        by = self.backward(by_light)(torch.stack([*film.T, *square.T, light, *outer[0], *outer[1], outer[2]]))
        return by[0:2].T, by[2:4].T, by[4] if by_light else None

    @cached_property
    def forward(self) -> Run:
        """Return the function that takes inputs, as rows [5, N], to rays."""
        return self._run(self.program, _GIVEN)

    def backward(self, by_light: bool) -> Run:
        """Return the function that takes rows [12, N], inputs and gradients by results, to gradients by inputs."""
        if by_light not in self._backwards:
            program = self.adjoint(by_light)
            self._backwards[by_light] = self._run(program, (*_GIVEN, *(f"{OUTER}{name}" for name in _FOUND)))
        return self._backwards[by_light]

    def adjoint(self, by_light: bool) -> Program:
        """Return the program of the gradients by the inputs, with or without the wavelength."""
        registers = 0 if self.device.type == "cpu" else REGISTERS
        return adjoint(self.program, _FOUND, _GIVEN if by_light else _GIVEN[:-1], registers)

    def _run(self, program: Program, rows: Sequence[str]) -> Run:
        """Return a program as a function of rows [R, N] of these names: a kernel on a GPU, C on the CPU, or torch."""
        if self.dtype == torch.float32 and "mask" not in self._tables and self.device.type == "cpu":
            with suppress(InputError):
                return self._as_c(program, rows)
        runner = on_gpu if self.dtype == torch.float32 and has_kernels(self.device) else step_by_step
        numbers, tables = ({k: self._tensor(v) for k, v in given.items()} for given in (self._numbers, self._tables))
        return runner(program, rows, numbers, tables)

    def _as_c(self, program: Program, names: Sequence[str]) -> Run:
        table, single = self._tables["outline"], program.with_single_cells()
        made = CompiledProgram(single, dict.fromkeys(program.outputs, 1), self._numbers, padded(table, table.shape[1]))

        def run(rows: Tensor) -> Tensor:
            found = made({name: row[None] for name, row in zip(names, rows.numpy(), strict=True)})
            return torch.from_numpy(np.concatenate([found[name] for name in program.outputs], dtype=np.float32))

        return run

    def _tensor(self, numbers: Any) -> Tensor:
        return torch.tensor(numbers, dtype=self.dtype, device=self.device).contiguous()


def _check_shape(name: str, tensor: Tensor, *shapes: tuple[int, ...]) -> None:
    if tuple(tensor.shape) not in shapes:
        expected = "a tensor of shape " + " or ".join(map(str, shapes))
        raise InputError("LensCamera", name, tuple(tensor.shape), expected)


class _Sides(NamedTuple):
    """Lenses below and above a setting, and how far each is from it; where there is none, the shot's own at 0."""

    low: _Lens
    high: _Lens
    ends: tuple[float, float]


class _Rays(torch.autograd.Function):
    """Applies `_Lens.outputs` to inputs of its camera, and to how far settings are from the shot's."""

    @staticmethod
    def forward(
        ctx: Any,
        camera: LensCamera,
        names: tuple[str, ...],
        film: Tensor,
        square: Tensor,
        light: Tensor,
        *moves: Tensor,
    ) -> tuple[Tensor, ...]:
        given = [t.detach() for t in (film, square, light)]
        *found, status = camera._lens.outputs(*given)
        slopes = []
        for name, moved in zip(names, moves, strict=True):
            low, high, (start, end) = camera._beside(name)
            (*before, status_before), (*after, status_after) = low.outputs(*given), high.outputs(*given)
            passed = (status_before == st.PASSED) & (status_after == st.PASSED) & (status == st.PASSED)
            slope = [torch.where(passed, (b - a) / (end - start), 0.0) for a, b in zip(before, after, strict=True)]
            found = [value + float(moved) * by for value, by in zip(found, slope, strict=True)]
            slopes += slope
        ctx.lens = camera._lens
        ctx.save_for_backward(*given, status, *slopes)
        ctx.mark_non_differentiable(status)
        return *found, status

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *outer: Tensor) -> tuple[Any, ...]:
        *given, status = ctx.saved_tensors[:4]
        slopes, outer = ctx.saved_tensors[4:], outer[:3]
        wanted: tuple[Tensor | None, ...] = (None, None, None)
        if any(ctx.needs_input_grad[2:5]):
            wanted = ctx.lens.gradients(*given, outer, by_light=ctx.needs_input_grad[4])
        passed = status == st.PASSED
        pairs = zip(slopes, outer * (len(slopes) // 3), strict=True)
        totals = [torch.where(passed, by * o, 0.0).sum().double().cpu() for by, o in pairs]
        return None, None, *wanted, *(sum(totals[k : k + 3]) for k in range(0, len(totals), 3))


# ---- A program on tensors. -------------------------------------------------------------------------------------------

_RULES = rules_of(torch) | {
    "clamp": lambda x, limit: x.clamp(-limit, limit),
    "select": lambda a, b, x, y: _chosen(a <= b, x, y, torch.result_type(a, b)),
}


def _chosen(first: Tensor, x: Any, y: Any, dtype: torch.dtype) -> Tensor:
    if isinstance(x, Tensor) or isinstance(y, Tensor):
        return torch.where(first, x, y)
    return first.to(dtype) * (x - y) + y  # from two numbers `where` would make float32


def has_kernels(device: torch.device) -> bool:
    """Return whether `on_gpu` can run on a device: an NVIDIA GPU, and a torch that compiles kernels (2.11 does)."""
    return device.type == "cuda" and torch.version.cuda is not None and hasattr(torch.cuda, "_compile_kernel")


def on_gpu(program: Program, rows: Sequence[str], numbers: Mapping[str, Tensor], tables: Mapping[str, Tensor]) -> Run:
    """Return the program as one CUDA kernel, in float32.

    Args:
        rows: names of the inputs of a ray, in the order of the rows that the function takes.
        numbers: inputs of the call. tables: [cells, columns] that lookups read. Both are on the GPU.
    """
    s, device = Signature.of(program, "lens"), next(iter(tables.values())).device
    kernel = _kernel(Cuda(program, "lens").kernel(), device)
    call = torch.stack([numbers[name] for name in s.per_call]) if s.per_call else None
    given = [part for name in s.tables for part in (tables[name], len(tables[name]))]
    order = [rows.index(name) for name in s.per_ray]
    kept, results = order == list(range(len(rows))), len(program.outputs)

    def run(rays: Tensor) -> Tensor:
        if rays.shape[1] > _MOST:
            return torch.cat([run(some) for some in rays.split(_MOST, 1)], 1)
        count, found = rays.shape[1], rays.new_empty((results, rays.shape[1]))
        if count:
            rays = (rays if kept else rays[order]).contiguous()
            with torch.cuda.device(device):
                blocks = -(-count // _THREADS)
                kernel((blocks, 1, 1), (_THREADS, 1, 1), [rays, rays if call is None else call, *given, found, count])
        return found

    return run


@cache
def _kernel(text: str, device: torch.device) -> Any:
    with torch.cuda.device(device):
        return torch.cuda._compile_kernel(text, "lens_rays")


def step_by_step(
    program: Program, rows: Sequence[str], numbers: Mapping[str, Tensor], tables: Mapping[str, Tensor]
) -> Run:
    """Return the program as a function that takes one step after the other, in the precision of the rays.

    Arguments are those of `on_gpu`.
    """
    live = program.live()
    uses = Counter(a for k in live for a in program.steps[k].arguments if isinstance(a, int))
    uses.update(e.argument for e in program.outputs.values() if isinstance(e.argument, int))

    def run(rays: Tensor) -> Tensor:
        found: dict[int, Any] = {}
        left = Counter(uses)

        def value(argument: Argument) -> Any:
            return argument[0] if isinstance(argument, tuple) else found[argument]

        for k in live:
            step = program.steps[k]
            if step.kind == "input":
                found[k] = numbers[step.name] if step.per_call else rays[rows.index(step.name)]
                continue
            given = [value(a) for a in step.arguments]
            found[k] = (
                _looked_up(tables[step.name], step, given) if step.kind == "lookup" else _RULES[step.kind](*given)
            )
            for a in step.arguments:
                if isinstance(a, int):
                    left[a] -= 1
                    if not left[a]:  # its memory serves later steps
                        del found[a]
        return torch.stack([value(e.argument) + torch.zeros_like(rays[0]) for e in program.outputs.values()])

    return run


def _looked_up(table: Tensor, step: Step, given: Sequence[Any]) -> Any:
    total: Any = 0.0
    for index, weights in step.at_indices(given):
        cell = index.nan_to_num().long().clamp(0, len(table) - 1)
        columns = range(step.column, table.shape[1], step.columns)
        total = total + sum(w * table[cell, column] for w, column in zip(weights, columns, strict=True))
    return total
