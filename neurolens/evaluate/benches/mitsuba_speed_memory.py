"""Memory of a render by the size of its picture, each in a process of its own.

    python -m neurolens.evaluate.benches.mitsuba_speed_memory experiments/scenes/room.toml 512 4

prints one JSON object for a picture 512 pixels wide with 4 samples a pixel, by one worker. Linux only: it reads /proc.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from neurolens.base.errors import NeurolensError
from neurolens.evaluate.benches.mitsuba_speed_profile import thin_camera
from neurolens.render.renderer import render
from neurolens.render.scene import load_scene

_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class Unmeasured(NeurolensError):
    """Memory cannot be measured here; the message says why."""


def memory_of(scene: Path, width: int, samples: int) -> dict[str, Any]:
    """Render `scene` in a child process.

    Returns: width, height, samples, growth_mb (highest resident memory while rendering, less that before).

    Raises:
        Unmeasured: no /proc, or the child failed.
    """
    command = [sys.executable, "-m", __spec__.name, str(scene), str(width), str(samples)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise Unmeasured(f"rendering {width} pixels wide in a child process: {done.stderr.strip().splitlines()[-1:]}")
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def _measure(path: Path, width: int, samples: int) -> dict[str, Any]:
    scene = load_scene(path)
    camera = thin_camera(scene)
    height = round(width * camera.film_mm[1] / camera.film_mm[0])
    render(scene, camera, width=64, height=36, samples=1, threads=1)  # what numpy sets up once
    _RESET.write_text("5")  # the highest mark starts from here
    before = _kilobytes("VmRSS")
    render(scene, camera, width=width, height=height, samples=samples, threads=1)
    grown = (_kilobytes("VmHWM") - before) * 1024 / 1e6
    return {"width": width, "height": height, "samples": samples, "growth_mb": grown}


def _kilobytes(field: str) -> int:
    line = next(line for line in _STATUS.read_text().splitlines() if line.startswith(field))
    return int(line.split()[1])


def main() -> int:
    """Print the figures of one size."""
    print(json.dumps(_measure(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
