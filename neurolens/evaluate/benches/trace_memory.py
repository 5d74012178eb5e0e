"""Memory that tracing takes beyond its rays and its results, by number of rays: each size in a process of its own.

    python -m neurolens.evaluate.benches.trace_memory lenses/laikin_double_gauss_50.toml 1000000

prints one JSON object. Linux only: it reads /proc.
"""

from __future__ import annotations

import json
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import torch

from neurolens.base.errors import NeurolensError
from neurolens.evaluate.benches.trace_speed import film_rays, launched
from neurolens.optics.lensfile import read_lens
from neurolens.optics.trace import Rays, trace

SIZES = (100_000, 1_000_000, 10_000_000)
_PART = 65536
_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class Unmeasured(NeurolensError):
    """Memory cannot be measured here; the message says why."""


def memory_of(lens_file: Path, count: int) -> dict[str, Any]:
    """Trace `count` float32 rays in a child process.

    Returns: rays, results_mb (the tensors that come out), growth_mb (highest resident memory while tracing, less that
        before), working_mb (growth less results: what tracing itself needs).

    Raises:
        Unmeasured: no /proc, or the child failed.
    """
    command = [sys.executable, "-m", __spec__.name, str(lens_file), str(count)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise Unmeasured(f"tracing {count} rays in a child process: {done.stderr.strip().splitlines()[-1:]}")
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def _measure(lens_file: Path, count: int) -> dict[str, Any]:
    torch.set_num_threads(1)
    lens = read_lens(lens_file).at()
    rays, wavelength = _rays(lens, count)
    with torch.no_grad():
        trace(lens, Rays(*(c[:_PART] for c in rays)), wavelength[:_PART])  # what torch sets up once
        _RESET.write_text("5")  # the highest mark starts from here
        before = _kilobytes("VmRSS")
        out = trace(lens, rays, wavelength)
        growth = _kilobytes("VmHWM") - before
    results = sum(c.element_size() * c.nelement() for c in (*out.rays, out.status)) / 1e6
    grown = growth * 1024 / 1e6
    return {"rays": count, "results_mb": results, "growth_mb": grown, "working_mb": grown - results}


def _rays(lens: Any, count: int) -> tuple[Rays, torch.Tensor]:
    """Float32 rays, the same few again and again, made without temporaries of their size."""
    start, wavelength = launched(lens, film_rays(lens, _PART), torch.float32)
    columns = [torch.empty(count) for _ in range(7)]
    for i in range(0, count, _PART):
        for column, part in zip(columns, (*start, wavelength), strict=True):
            column[i : i + _PART] = part[: min(_PART, count - i)]
    return Rays(*columns[:6]), columns[6]


def _kilobytes(field: str) -> int:
    line = next(line for line in _STATUS.read_text().splitlines() if line.startswith(field))
    return int(line.split()[1])


def main() -> int:
    """Print the figures of one size."""
    warnings.simplefilter("ignore")
    print(json.dumps(_measure(Path(sys.argv[1]), int(sys.argv[2]))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
