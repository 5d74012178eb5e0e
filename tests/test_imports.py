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

# Folders that each folder may import, besides itself and base.
PARTS = {
    "graph": "",
    "lens": "graph",
    "trace": "graph lens",
    "setting": "lens trace",
    "readers": "lens trace setting",
    "surrogates": "graph lens trace setting",
    "analysis": "lens trace setting",
    "photographs": "lens trace setting analysis",
    "cameras": "graph lens trace setting readers surrogates",
    "shaders": "graph lens trace setting readers surrogates cameras",
    "render": "graph lens cameras",
    "mitsuba": "lens cameras render",
    "flare": "graph lens trace analysis surrogates cameras render",
    "defocus": "graph lens cameras render flare",
    "study": "graph lens trace setting readers analysis surrogates cameras render flare photographs",
    "plan": "graph lens setting analysis surrogates cameras shaders render flare study",
    "handover": "analysis cameras render",
    "view": "graph lens trace analysis cameras shaders flare",
    "blender": "",
    "frames": "lens readers cameras render flare",
    "torch": "graph lens cameras",
    "hosts": "graph lens cameras render",
    "cli": "graph lens trace setting readers analysis surrogates cameras shaders render mitsuba flare study plan view"
    " blender frames photographs defocus handover hosts",
    "front": "lens trace readers surrogates cameras study cli hosts",
    "__init__": "front",  # when a name of it is asked for
}
# Packages from elsewhere that each part may import; what is not listed here is not restricted.
PACKAGES = {
    "base": {"numpy", "jinja2"},
    "graph": {"numpy"},  # and torch where it is handed tensors
    "lens": {"numpy"},
    "trace": {"numpy", "torch"},
    "setting": {"numpy", "scipy", "torch"},
    "analysis": {"numpy", "scipy", "torch", "matplotlib"},
    "mitsuba": {"numpy"},
    "readers": {"numpy"},
    "cameras": {"numpy", "onnxruntime"},
    "shaders": {"numpy"},
    "render": {"numpy", "OpenEXR", "PIL", "embreex"},
    "defocus": {"numpy", "OpenEXR"},
    "blender": {"bpy", "cycles", "numpy"},  # of Blender's own Python, in the extension
}
EXCEPTIONS: dict[str, set[str]] = {
    "neurolens.base.cluster": {"dask", "distributed"},  # where a cluster is asked for
    "neurolens.cameras.exact": {"torch"},  # for light from the scene, and paths
}
# Modules that load torch or scipy; others load these when they are needed.
SLOW = {"neurolens.shaders.lens_source", "neurolens.cli.flare", "neurolens.cli.handover", "neurolens.cli.view"}
# What loads in a base install: these folders, models from their files, and what converts lens files.
LEAN = ("base", "graph", "lens", "readers", "cameras", "shaders", "render", "mitsuba", "frames", "defocus", "cli")
LEAN_MODULES = {
    *(
        f"neurolens.trace.{name}"
        for name in ("arithmetic", "arrays", "shapes", "surfaces", "tracegraph", "transmission")
    ),
    *(f"neurolens.setting.{name}" for name in ("focusing", "pupils", "rims", "states")),
    *(f"neurolens.surrogates.{name}" for name in ("assemble", "axes", "card", "cores", "file", "inverse")),
    *(f"neurolens.surrogates.{name}" for name in ("model", "source")),
}


# Lines of Python that the package should have, as the last issue set them; a feature that needs more pays by what it
# replaces. The test fails beyond SLACK times that: a sum without slack made each useful change a change of the number.
MOST_LINES, MOST_MODULES, SLACK = 58405, 202, 1.03


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def statements(body: list[Any]) -> Iterator[Any]:
    """All statements of a module; looking through their expressions, too, takes ten times as long."""
    for node in body:
        yield node
        for part in ("body", "orelse", "finalbody", "handlers", "cases"):
            yield from statements(getattr(node, part, []))


def imported(path: Path) -> set[str]:
    """Dotted names of everything a module imports, anywhere in it."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    package = module_name(path).split(".")
    if path.name != "__init__.py":
        package = package[:-1]
    names = set()
    for node in statements(tree.body):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            origin = ".".join([*above, *([node.module] if node.module else [])])
            names |= {f"{origin}.{alias.name}" for alias in node.names}
    return names


TYPES_ALONE = re.compile(r"^if TYPE_CHECKING:\n(?:(?: .*)?\n)+", re.MULTILINE)


@cache
def imports() -> dict[str, set[str]]:
    """What each module imports, by its name."""
    return {module_name(path): imported(path) for path in MODULES}


def part_of(module: str) -> str:
    """The folder of a module below the package."""
    return module.split(".")[1] if "." in module else "__init__"


def test_imports_go_one_way() -> None:
    wrong = []
    for module, names in imports().items():
        part = part_of(module)
        assert part in {*PARTS, "base", "__init__", "__main__"}, f"{module}: give this folder its place in {__name__}"
        packages = {name.split(".")[0] for name in names} - set(sys.stdlib_module_names) - {"neurolens"}
        if part in PACKAGES:
            wrong += [
                f"{module} imports {p}" for p in sorted(packages - PACKAGES[part] - EXCEPTIONS.get(module, set()))
            ]
        if part != "__main__":
            # `from neurolens import __version__` is open to all.
            parts = {part_of(name) for name in names if name.startswith("neurolens.")} - {"__version__"}
            wrong += [f"{module} imports {p}" for p in sorted(parts - {part, "base", *PARTS.get(part, "").split()})]
    assert not wrong


def test_no_imports_go_in_a_circle() -> None:
    """Those inside functions count, too; those for types alone do not."""
    graph, known = {}, imports().keys()
    for path in MODULES:
        text = TYPES_ALONE.sub("", path.read_text(encoding="utf-8"))
        found = set()
        for node in statements(ast.parse(text).body):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("neurolens"):
                names = {f"{node.module}.{alias.name}" for alias in node.names}
                found |= names & known or {str(node.module)}
        graph[module_name(path)] = (found & known) - {module_name(path), "neurolens"}
    assert sum(map(len, graph.values())) > len(graph)
    try:
        list(TopologicalSorter(graph).static_order())
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_the_package_keeps_within_its_budget_of_lines() -> None:
    lines = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in MODULES}
    assert not [str(path) for path, count in lines.items() if count > MAX_LINES]
    by_part = Counter[str]()
    for path, count in lines.items():
        by_part[path.relative_to(ROOT).parts[1]] += count
    table = "\n".join(f"{count:6} {part}" for part, count in by_part.most_common())
    print(f"{sum(lines.values()):6} lines of {MOST_LINES}, {len(lines)} modules of {MOST_MODULES}\n{table}")
    assert sum(lines.values()) <= SLACK * MOST_LINES, f"beyond {SLACK} times {MOST_LINES} lines:\n{table}"
    assert len(lines) <= SLACK * MOST_MODULES, f"beyond {SLACK} times {MOST_MODULES} modules:\n{table}"


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
