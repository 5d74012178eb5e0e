"""Checkpoints of a training (see `base.kept`), so that a killed run ends with the very same weights.

One is written every few seconds. Only the very same fit goes on from it: it holds a fingerprint of data and settings.
"""

from __future__ import annotations

import hashlib
import json
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neurolens.base.kept import read_arrays, write_arrays

SCHEMA = 1
EVERY_S = 3.0


def fingerprint(tensors: list[Tensor], settings: dict[str, Any]) -> str:
    """SHA-256 of everything that decides the weights: the data, the settings and the version of torch."""
    digest = hashlib.sha256(json.dumps([settings, str(torch.__version__), SCHEMA], sort_keys=True).encode())
    for tensor in tensors:
        digest.update(str(tuple(tensor.shape)).encode())
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()


@dataclass
class Checkpoint:
    """One file of one training. Without a path nothing is kept.

    Attributes:
        path: of the file.
        key: `fingerprint` of the training.
        spent_s: seconds of training up to the last save, those of earlier runs included.
    """

    path: Path | None
    key: str
    spent_s: float = 0.0

    def __post_init__(self) -> None:
        self._begin = self._written = time.monotonic()

    @property
    def elapsed_s(self) -> float:
        """Seconds of training so far, those of earlier runs included."""
        return self.spent_s + time.monotonic() - self._begin

    def load(self) -> tuple[dict[str, Any], list[Tensor]] | None:
        """State and arrays as saved, or None where there is no file, or a damaged one, or one of another training."""
        with suppress(OSError, ValueError):
            if self.path is not None:
                with read_arrays(self.path) as (about, read):
                    if about["key"] == self.key:
                        arrays = [torch.from_numpy(read(f"a{i}")) for i in range(about["arrays"])]
                        state, self.spent_s = dict(about["state"]), float(about["spent_s"])
                        return state, arrays
        return None

    def save(self, state: dict[str, Any], arrays: list[Tensor], *, now: bool = False) -> None:
        """Write the state (JSON-able) and arrays, if the last write is some seconds ago or `now` asks for it."""
        if self.path is None or not (now or time.monotonic() - self._written >= EVERY_S):
            return
        about = {"key": self.key, "state": state, "spent_s": self.elapsed_s, "arrays": len(arrays)}
        write_arrays(self.path, about, {f"a{i}": array.numpy() for i, array in enumerate(arrays)})
        self._written = time.monotonic()


def of_zone(path: Path | None, zone: int) -> Path | None:
    """The file of the zone-th fit (from 0) of a model; the first keeps the name."""
    return path if path is None or zone == 0 else path.with_name(f"{path.stem}.{zone}{path.suffix}")


def _files(path: Path) -> list[Path]:
    return [f for f in (path, *path.parent.glob(f"{path.stem}.*{path.suffix}")) if f.is_file()]


def spent_s(path: Path | None) -> float:
    """Seconds that a model's training took, all runs of it together; 0 where nothing tells."""
    total = 0.0
    for file in [] if path is None else _files(path):
        with suppress(OSError, ValueError), read_arrays(file) as (about, _):
            total += float(about["spent_s"])
    return total


def clear(path: Path) -> None:
    """Remove the files of a model's training, once the model itself is written."""
    for file in _files(path):
        file.unlink()
