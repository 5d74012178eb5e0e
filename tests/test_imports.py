"""The folders are layers: imports go one way and in no circle, a render needs no torch, and the package stays small."""

import ast
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
MODULES = sorted((ROOT / "neurolens").rglob("*.py"))
MAX_LINES = 600  # of a module; it is split where its subject splits, not at a number

# The rooms of the package, each of which imports only those before it, and the front, which opens them all.
ROOMS = ("base", "graph", "optics", "models", "cameras", "pictures", "programs", "studies", "cli", "front")
# Packages from elsewhere that each part may import; what is not listed here is not restricted.
PACKAGES = {
    "base": {"numpy", "jinja2"},
    "graph": {"numpy"},  # and torch where it is handed tensors
    "optics.lens": {"numpy"},
    "optics.trace": {"numpy", "torch"},
    "optics.setting": {"numpy", "scipy", "torch"},
    "optics.analysis": {"numpy", "scipy", "torch", "matplotlib"},
    "programs.mitsuba": {"numpy"},
    "optics.readers": {"numpy"},
    "cameras": {"numpy", "onnxruntime"},
    "cameras.shaders": {"numpy"},
    "pictures.render": {"numpy", "OpenEXR", "PIL", "embreex"},
    "pictures.defocus": {"numpy", "OpenEXR"},
    "programs.blender": {"bpy", "cycles", "numpy"},  # of Blender's own Python, in the extension
}
EXCEPTIONS: dict[str, set[str]] = {
    "neurolens.base.cluster": {"dask", "distributed"},  # where a cluster is asked for
    "neurolens.cameras.exact": {"torch"},  # for light from the scene, and paths
}
# Modules that load torch or scipy; others load these when they are needed.
SLOW = {"neurolens.cameras.shaders.lens_source", "neurolens.cli.flare", "neurolens.cli.handover", "neurolens.cli.view"}
# What loads in a base install: these folders, models from their files, and what converts lens files.
LEAN = (
    "base", "graph", "optics.lens", "optics.readers", "cameras", "cameras.shaders", "pictures.render",
    "pictures.frames", "pictures.defocus", "programs.mitsuba", "cli",
)  # fmt: skip
LEAN_MODULES = {
    *(
        f"neurolens.optics.trace.{name}"
        for name in ("arithmetic", "arrays", "shapes", "surfaces", "tracegraph", "transmission")
    ),
    *(f"neurolens.optics.setting.{name}" for name in ("focusing", "pupils", "rims", "states")),
    *(f"neurolens.models.{name}" for name in ("assemble", "axes", "card", "copied", "cores", "file", "fitted")),
    *(f"neurolens.models.{name}" for name in ("inverse", "model", "source")),
}


# Statements that each room has, as the last issue left it: what a reader has to hold. A room that grows by more than
# SLACK pays by what it replaces, or an issue gives it more.
STATEMENTS = {
    "__init__": 23, "__main__": 4, "base": 1950, "graph": 2705, "optics": 10140, "models": 4580, "cameras": 4270,
    "pictures": 7635, "programs": 2720, "studies": 3075, "cli": 4265, "front": 208,
}  # fmt: skip
SLACK = 1.03


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def parsed(path: Path) -> list[Any]:
    """The statements of a module at its own level."""
    return ast.parse(path.read_text(encoding="utf-8")).body


def statements(body: list[Any]) -> Iterator[Any]:
    """All statements of a module; looking through their expressions, too, takes ten times as long."""
    for node in body:
        yield node
        for part in ("body", "orelse", "finalbody", "handlers", "cases"):
            yield from statements(getattr(node, part, []))


def imported(path: Path) -> set[str]:
    """Dotted names of everything a module imports, anywhere in it."""
    package = module_name(path).split(".")
    if path.name != "__init__.py":
        package = package[:-1]
    names = set()
    for node in statements(parsed(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            origin = ".".join([*above, *([node.module] if node.module else [])])
            names |= {f"{origin}.{alias.name}" for alias in node.names}
    return names


@cache
def imports() -> dict[str, set[str]]:
    """What each module imports, by its name."""
    return {module_name(path): imported(path) for path in MODULES}


def room_of(module: str) -> str:
    return module.split(".")[1] if "." in module else "__init__"


def part_of(module: str) -> str:
    """The innermost folder of a module, below the package."""
    folder = module if (ROOT / module.replace(".", "/")).is_dir() else module.rpartition(".")[0]
    return folder.partition(".")[2]


def test_imports_go_one_way() -> None:
    wrong = []
    for module, names in imports().items():
        packages = {name.split(".")[0] for name in names} - set(sys.stdlib_module_names) - {"neurolens"}
        if part_of(module) in PACKAGES:
            known = PACKAGES[part_of(module)] | EXCEPTIONS.get(module, set())
            wrong += [f"{module} imports {p}" for p in sorted(packages - known)]
        if (room := room_of(module)) in ("__init__", "__main__"):
            continue
        assert room in ROOMS, f"{module}: give this room its place in {__name__}"
        # `from neurolens import __version__` is open to all.
        rooms = {room_of(name) for name in names if name.startswith("neurolens.")} & {*ROOMS}
        wrong += [f"{module} imports {r}" for r in sorted(rooms) if ROOMS.index(r) > ROOMS.index(room)]
    assert not wrong


@cache
def import_graph() -> dict[str, set[str]]:
    """The modules that each module imports, inside functions and for types alone, too."""
    graph, known = {}, imports().keys()
    for path in MODULES:
        found = set()
        for node in statements(parsed(path)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("neurolens"):
                names = {f"{node.module}.{alias.name}" for alias in node.names}
                found |= names & known or {str(node.module)}
        graph[module_name(path)] = (found & known) - {module_name(path), "neurolens"}
    return graph


def test_no_imports_go_in_a_circle() -> None:
    assert sum(map(len, import_graph().values())) > len(import_graph())
    try:
        list(TopologicalSorter(import_graph()).static_order())
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_training_reaches_no_renderer() -> None:
    """Only who wants the pictures of an experiment hands it what renders them."""
    reached, waiting = set[str](), ["neurolens.studies.train"]
    while waiting:
        new = import_graph()[waiting.pop()] - reached
        reached |= new
        waiting += new
    assert "neurolens.models.fit" in reached and not [m for m in reached if m.startswith("neurolens.pictures")]


def test_rooms_keep_within_their_bounds() -> None:
    found = Counter[str]()
    for path in MODULES:
        assert len(path.read_text(encoding="utf-8").splitlines()) <= MAX_LINES, path
        found[room_of(module_name(path))] += sum(isinstance(node, ast.stmt) for node in statements(parsed(path)))
    print("\n".join(f"{count:6} of {STATEMENTS.get(room)} statements in {room}" for room, count in found.items()))
    assert {room: count for room, count in found.items() if count > SLACK * STATEMENTS[room]} == {}


def test_cameras_renderer_and_command_line_load_without_the_training_packages() -> None:
    wanted = [m for m in imports() if part_of(m) in LEAN or m in LEAN_MODULES]
    wanted = [m for m in wanted if m not in SLOW]
    forbidden = ["torch", "sklearn", "onnx", "matplotlib", "scipy", "flip_evaluator", "mitsuba", "drjit"]
    code = (
        f"import importlib, sys\n"
        f"sys.modules.update(dict.fromkeys({forbidden!r}))\n"  # None makes an import fail
        f"for name in {wanted!r}: importlib.import_module(name)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr


def test_help_of_the_command_line_loads_not_even_numpy() -> None:
    code = "import sys; sys.modules['numpy'] = None; from neurolens.cli import build_parser as b; b('').format_help()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.whole  # how fast a camera starts
def test_exact_cameras_start_without_torchs_compiler() -> None:
    """It takes longer to load than all the rest."""
    code = "import sys, neurolens.cameras.exact; assert 'torch._dynamo' not in sys.modules"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr


def test_the_range_of_light_stands_once() -> None:
    assert [f.name for f in MODULES if re.search(r"\(?400(\.0)?, 700(\.0)?\b", f.read_text())] == ["settings.py"]
