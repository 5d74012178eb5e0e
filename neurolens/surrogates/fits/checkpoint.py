"""Checkpoints of a training: where it was, in one file, so that a killed run ends with the very same weights.

A .npz of plain arrays with a JSON header (no pickle), written whole or not at all, every few seconds. It is taken up
only by the very same fit: its header holds a fingerprint of the data and the settings.
"""

from __future__ import annotations

import hashlib
import json
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neurolens.base.files import atomic_path

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
        if self.path is None:
            return None
        try:
            with np.load(self.path, allow_pickle=False) as data:
                header = json.loads(data["header"].tobytes())
                if header["key"] != self.key:
                    return None
                arrays = [torch.from_numpy(data[f"a{i}"]) for i in range(header["arrays"])]
            state, self.spent_s = dict(header["state"]), float(header["spent_s"])
        except Exception:  # zip, JSON and numpy each have errors of their own; whatever is wrong, the fit starts afresh
            return None
        return state, arrays

    def save(self, state: dict[str, Any], arrays: list[Tensor], *, now: bool = False) -> None:
        """Write the state (JSON-able) and arrays, if the last write is some seconds ago or `now` asks for it."""
        if self.path is None or not (now or time.monotonic() - self._written >= EVERY_S):
            return
        header = {"key": self.key, "state": state, "spent_s": self.elapsed_s, "arrays": len(arrays)}
        packed: dict[str, Any] = {f"a{i}": a.numpy() for i, a in enumerate(arrays)}
        packed["header"] = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
        with atomic_path(self.path) as temporary, open(temporary, "wb") as stream:
            np.savez(stream, **packed)
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
        with suppress(Exception), np.load(file, allow_pickle=False) as data:
            total += float(json.loads(data["header"].tobytes())["spent_s"])
    return total


def clear(path: Path) -> None:
    """Remove the files of a model's training, once the model itself is written."""
    for file in _files(path):
        file.unlink()
