"""The files of a training's states (`base.kept`), so that a killed run ends with the very same weights."""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neurolens.base.kept import read_arrays

SCHEMA = 1
EVERY_S = 3.0


def fingerprint(tensors: list[Tensor], settings: dict[str, Any]) -> str:
    """SHA-256 of everything that decides the weights: the data, the settings and the version of torch."""
    digest = hashlib.sha256(json.dumps([settings, str(torch.__version__), SCHEMA], sort_keys=True).encode())
    for tensor in tensors:
        digest.update(str(tuple(tensor.shape)).encode())
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()


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
