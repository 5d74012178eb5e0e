"""Patterns on flat surfaces: checker, lines, pictures; and pictures on meshes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.render.scenetables import Texture
from neurolens.render.spectrum import Index, Palette, SpectralRange

Frame = NDArray[np.float64]
_STEEPEST = 1e25  # pictures or cells a metre; times the farthest point still finite in float32


def _frame(origin: Frame, u: Frame, v: Frame, size: tuple[float, float]) -> Frame:
    """Coordinates in metres along unit vectors u and v as affine functions of a point, [2, 4], and the size [2, 1]."""
    rows = [[*axis, -(origin @ axis), length] for axis, length in zip((u, v), size, strict=True)]
    return np.array(rows)


def quad_frame(corner: Frame, edge_u: Frame, edge_v: Frame) -> Frame:
    """From the corner of a rectangle along its edges."""
    lengths = float(np.linalg.norm(edge_u)), float(np.linalg.norm(edge_v))
    return _frame(corner, edge_u / lengths[0], edge_v / lengths[1], lengths)


def plane_frame(point: Frame, normal: Frame) -> Frame:
    """From a point of a plane along the axes of the scene as far as they lie in it: x first, else z."""
    axis = np.eye(3)[2 if abs(normal[0]) > 0.9 else 0]
    u = axis - normal * (axis @ normal)
    u /= np.linalg.norm(u)
    return _frame(point, u, np.cross(normal, u), (1.0, 1.0))


def disc_frame(centre: Frame, normal: Frame, radius: float) -> Frame:
    """The frame of a disc's texture, from the lower left corner of the square around the disc."""
    frame = plane_frame(centre, normal)
    frame[:, 3] += radius
    frame[:, 4] = 2 * radius
    return frame


def box_frame(low: Frame, axis: int) -> Frame:
    """From the lowest corner of a box along the axes of a face: x or z across, y up; x and z on floor and ceiling."""
    u, v = {0: (2, 1), 1: (0, 2), 2: (0, 1)}[axis]
    return _frame(low, np.eye(3)[u], np.eye(3)[v], (1.0, 1.0))


def triangle_frames(planes: Frame, uv: Frame) -> Frame:
    """Texture coordinates [T, 3 corners, 2] of triangles as affine functions of a point, [T, 2, 5], in pictures.

    `planes`: [T, 3, 4] from `neurolens.render.mesh.triangle_planes`; rows 1 and 2 are the weights of corners 1 and 2.
    """
    step = uv[:, 1:] - uv[:, :1]  # [T, 2, 2]
    rows = np.einsum("tkc,tkj->tcj", step, planes[:, 1:])
    rows[:, :, 3] += uv[:, 0]
    return np.concatenate([rows, np.ones((len(uv), 2, 1))], axis=2)


class TextureTable:
    """The textures of a scene, looked up by surface.

    Args:
        textures: by name. images: linear RGB [H, W, 3] of those of kind "image".
        surfaces: for surfaces in a row how many, the name of their texture and their frames [count, 2, 5] (one of the
            functions above), or None. palette: with the rows of their colours.
    """

    def __init__(
        self,
        textures: dict[str, Texture],
        images: dict[str, FloatArray],
        surfaces: Sequence[tuple[int, str | None, Frame | None]],
        palette: Palette,
        spectral: SpectralRange,
    ) -> None:
        self._textures = list(textures.items())
        self._images, self._palette = images, palette
        self._basis = spectral.rotated(spectral.basis.astype(np.float32))
        numbers = {name: k for k, name in enumerate(textures)}
        self._rows = [np.array([palette.colour(c) for c in t.colours or ()], np.intp) for t in textures.values()]
        total = sum(count for count, _, _ in surfaces)
        self._number, self._frames = np.full(total, -1), np.zeros((2, 4, total), np.float32)
        first = 0
        for count, name, frames in surfaces:
            if name is not None and frames is not None:
                texture, rows = textures[name], slice(first, first + count)
                cell = texture.cell_m
                size = texture.size_m or ((cell, cell) if cell else frames[0, :, 4])
                self._number[rows] = numbers[name]
                # In cells, or in pictures.
                scaled = np.clip(frames[:, :, :4] / np.array(size)[:, None], -_STEEPEST, _STEEPEST)
                self._frames[:, :, rows] = np.moveaxis(scaled, 0, -1)
            first += count
        self._used = bool(np.any(self._number >= 0))

    def apply(self, value: FloatArray, surface: Index, point: FloatArray, bins: Index) -> None:
        """Write the reflectance at points [3, N] into `value` [lanes, N] where surfaces [N] have a texture."""
        if not self._used:
            return
        number = self._number.take(surface)
        for k, (name, texture) in enumerate(self._textures):
            rows = np.flatnonzero(number == k)
            if not rows.size:
                continue
            at, frame = point.take(rows, axis=1), self._frames.take(surface[rows], axis=2)
            u, v = frame[:, 0] * at[0] + frame[:, 1] * at[1] + frame[:, 2] * at[2] + frame[:, 3]
            if texture.kind == "image":
                value[:, rows] = self._picture(self._images[name], u, v, bins[rows])
                continue
            if texture.kind == "checker":
                # 2e-4 of a cell of slack: a shape that begins on a cell's edge shows no speckle of rounding there.
                which = (np.floor(u + 2e-4).astype(np.intp) + np.floor(v + 2e-4).astype(np.intp)) & 1
            else:
                reach = np.float32(0.5 * (texture.line_m or 0) / (texture.cell_m or 1))
                on_line = (np.abs(u - np.rint(u)) <= reach) | (np.abs(v - np.rint(v)) <= reach)
                which = 1 - on_line.astype(np.intp)
            value[:, rows] = self._palette.look_up(self._rows[k].take(which), bins[rows])

    def _picture(self, image: FloatArray, u: FloatArray, v: FloatArray, bins: Index) -> FloatArray:
        """Reflectance [lanes, N] of the texel at (u, v), in pictures from the lower left corner."""
        height, width = image.shape[:2]
        column = ((u - np.floor(u)) * width).astype(np.intp)
        row = ((1 - (v - np.floor(v))) * height).astype(np.intp)
        rgb = image[np.minimum(row, height - 1), np.minimum(column, width - 1)]
        return np.einsum("nc,lcn->ln", rgb, self._basis.take(bins, axis=-1))
