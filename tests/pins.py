"""Writes what the index says of the pins of constraints.txt: the Pythons that each takes, and hashes of its files.

Run it after every change of a pin, where the package uv is installed: `python tests/pins.py`. It installs nothing.

data/pins.json: the Pythons, as pip reads them. The first Python that we promise stands for all in pip's question, so
that a pin which does not take it fails here already, under the name of the package.

data/base.lock, data/all.lock: files for `pip install --require-hashes -r`, with the hashes of pins for all platforms
and Pythons; of the base install, and of all extras but "shading". torch and its CUDA libraries are left out:
builds for the CPU come from another index, whose files are other files.
"""

import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
PINS, TABLE, OLDEST = HERE.parent / "constraints.txt", HERE / "data" / "pins.json", "3.11.0"
DATA = TABLE.parent
EXTRAS = (
    "train",
    "dev",
    "docs",
    "mitsuba",
    "rays",
    "photographs",
    "dask",
    "usd",
    "web",
)  # without "shading", which only tests use
LOCKS: dict[Path, tuple[str, ...]] = {DATA / "base.lock": (), DATA / "all.lock": EXTRAS}


def cuda(name: str) -> bool:
    """Whether torch and what it brings for CUDA: packages without hashes here."""
    return name.startswith(("torch", "triton", "cuda-", "nvidia-"))


def pins() -> dict[str, str]:
    """The version of each package, by its name as constraints.txt writes it."""
    return dict(re.findall(r"^([^\s=#]+)==([^\s;]+)", PINS.read_text(encoding="utf-8"), re.M))


def plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "report.json")
        question = ["--dry-run", "--no-deps", "--only-binary=:all:", "--python-version", OLDEST, "--target", folder]
        wanted = [f"{name}=={version}" for name, version in pins().items()]
        command = [sys.executable, "-m", "pip", "install", "-q", *question, "--report", report, *wanted]
        done = subprocess.run(command, stderr=subprocess.PIPE, text=True)
        if done.returncode:
            sys.exit(done.stderr)
        found = [one["metadata"] for one in json.loads(report.read_text(encoding="utf-8"))["install"]]
    if yanked := [line for line in done.stderr.splitlines() if "yanked" in line]:
        sys.exit("\n".join(["withdrawn by its maker:", *yanked]))
    asked = {
        f"{plain(one['name'])}=={one['version'].partition('+')[0]}": one.get("requires_python", "") for one in found
    }
    left_out = [f"--no-emit-package={name}" for name in pins() if cuda(name)]
    options = ["-q", "--upgrade", "--universal", "--generate-hashes", "--no-annotate", "--no-header", *left_out]
    options += [f"--python-version={OLDEST}", "-c", str(PINS), str(PINS.with_name("pyproject.toml"))]
    for lock, extras in LOCKS.items():
        command = [sys.executable, "-m", "uv", "pip", "compile", *options, *(f"--extra={extra}" for extra in extras)]
        subprocess.run([*command, "-o", str(lock)], check=True)
        print(lock)
    TABLE.write_text(json.dumps(dict(sorted(asked.items())), indent=1) + "\n", encoding="utf-8")
    print(f"{TABLE}: {len(asked)} packages")
