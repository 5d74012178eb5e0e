"""Writes data/pins.json: which Pythons each package of constraints.txt asks for, as pip reads it of the index.

Run it after every change of a pin: `python tests/pins.py`. The first Python that we promise stands for all in pip's
question, so that a pin which does not take it fails here already, under the name of the package. Nothing is installed.
"""

import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
PINS, TABLE, OLDEST = HERE.parent / "constraints.txt", HERE / "data" / "pins.json", "3.11.0"


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
    TABLE.write_text(json.dumps(dict(sorted(asked.items())), indent=1) + "\n", encoding="utf-8")
    print(f"{TABLE}: {len(asked)} packages")
