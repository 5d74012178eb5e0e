"""The folders are layers: imports go one way and in no circle, a render needs no torch, and the package stays small.

base <- graph <- modelfile <- optics <- models <- surrogates <- evaluate <- commands <- cli
                              optics <- analysis   <- evaluate
                    models <- cameras <- render    <- evaluate
                  surrogates, analysis, render <- flare <- evaluate <- frames
                                         render    <- mitsuba  <- evaluate
"""

import ast
import re
import subprocess
import sys
from collections import Counter
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MODULES = sorted((ROOT / "neurolens").rglob("*.py"))
MAX_LINES = 500

BASE = {"base"}
# What cameras need of optics: modules without torch, open to all parts.
TORCH_FREE_OPTICS = {f"neurolens.optics.{name}" for name in ("apertures", "film_plane", "sag", "shapes")}
# Models from their files, without torch, which cameras need. Whoever may import surrogates may import these, too.
MODELS = {f"neurolens.surrogates.{name}" for name in ("assemble", "cores", "file", "inverse", "lightfield", "model")}
# Parts of the package that each part may import, besides itself and the base.
PARTS = {
    "graph": set(),
    "modelfile": {"graph"},
    "optics": {"graph", "modelfile"},
    "readers": {"optics"},
    "analysis": {"optics"},
    "surrogates": {"graph", "modelfile", "optics"},
    "models": {"graph", "modelfile", "optics"},
    "cameras": {"graph", "modelfile", "models"},
    "render": {"cameras"},
    "mitsuba": {"cameras", "render"},
    "flare": {"graph", "modelfile", "optics", "analysis", "surrogates", "cameras", "render"},
    "evaluate": {
        *("graph", "modelfile", "optics", "analysis", "readers", "surrogates", "cameras", "render", "mitsuba", "flare")
    },
    "view": {"graph", "optics", "analysis", "cameras", "flare"},
    "blender": set(),
    "frames": {"optics", "readers", "cameras", "render", "flare", "evaluate"},
    "commands": {
        *("graph", "modelfile", "optics", "analysis", "readers", "surrogates", "cameras", "render", "mitsuba", "flare"),
        "blender",
        "evaluate",
        "frames",
        "view",
    },
    "cli": {"commands"},
}
# Packages from elsewhere that each part may import; what is not listed here is not restricted.
PACKAGES = {
    "base": {"numpy", "jinja2"},
    "graph": {"numpy"},  # and torch where it is handed tensors
    "modelfile": {"numpy"},
    "optics": {"numpy", "torch"},
    "analysis": {"numpy", "torch", "matplotlib"},
    "mitsuba": {"numpy"},
    "readers": set(),
    "cameras": {"numpy", "onnxruntime"},
    "render": {"numpy", "OpenEXR", "PIL"},
    "blender": {"bpy", "cycles"},  # of Blender's own Python, in the extension
}
# Besides those: the one camera that traces rays exactly, the maker of cameras, which imports it
# when one is asked for; the shapes of the stop, which are parts of graphs.
EXCEPTIONS: dict[str, tuple[set[str], set[str]]] = {
    "neurolens.base.cluster": (set(), {"dask", "distributed"}),  # where a cluster is asked for
    # Methods that take tensors: torch is loaded where one is called.
    "neurolens.surrogates.file": ({"surrogates"}, {"torch"}),
    "neurolens.surrogates.cores": ({"surrogates"}, {"torch"}),
    "neurolens.surrogates.model": ({"surrogates"}, {"torch"}),
    "neurolens.surrogates.inverse": ({"surrogates"}, {"torch"}),
    "neurolens.optics.apertures": ({"graph"}, set()),
    "neurolens.optics.sag": ({"optics"}, set()),
    "neurolens.optics.shapes": ({"optics"}, set()),
    "neurolens.cameras.exact": ({"optics"}, {"torch"}),
    "neurolens.cameras.outline_cache": ({"optics"}, {"torch"}),
    "neurolens.cameras.build": ({"optics", "readers"}, set()),
    "neurolens.cameras.field": ({"optics"}, set()),  # first-order data of lenses that are traced
}
# Modules that load torch; others load these when they are needed.
SLOW = {"neurolens.cameras.exact", "neurolens.cameras.outline_cache", "neurolens.commands.export_lens"}
# What loads in a base install: these parts, and what converts lens files, looks up glass and writes C.
LEAN = ("graph", "modelfile", "cameras", "render", "mitsuba", "frames", "commands", "cli", "base", "readers")
LEAN_MODULES = {
    *(f"neurolens.optics.{name}" for name in ("catalogue", "designs", "glass", "lensfile", "lenswriter", "paraxial")),
    *MODELS,
    "neurolens.surrogates.source",
}


# Lines of Python that the package may have; a feature that needs more pays by what it replaces.
MOST_LINES, MOST_MODULES = 59550, 296


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(path: Path) -> set[str]:
    """Dotted names of everything a module imports, anywhere in it."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    package = module_name(path).split(".")
    if path.name != "__init__.py":
        package = package[:-1]
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            origin = ".".join([*above, *([node.module] if node.module else [])])
            names |= {f"{origin}.{alias.name}" for alias in node.names}
    return names


TYPES_ALONE = re.compile(r"^if TYPE_CHECKING:\n(?:(?: .*)?\n)+", re.MULTILINE)
IMPORTED = {module_name(path): imported(path) for path in MODULES}


def part_of(module: str) -> str:
    """First folder or module below the package; "base" for the modules that everybody may import."""
    if ".".join(module.split(".")[:3]) in MODELS:
        return "models"
    name = module.split(".")[1] if "." in module else "__init__"
    shared = ".".join(module.split(".")[:3]) in TORCH_FREE_OPTICS
    return "base" if shared or name in BASE else name


def test_imports_go_one_way() -> None:
    wrong = []
    for module, names in IMPORTED.items():
        part = part_of(module)
        assert part in {*PARTS, "base", "__init__", "__main__"}, f"{module}: give this part its place in {__name__}"
        own_parts, own_packages = EXCEPTIONS.get(module, (set(), set()))
        packages = {name.split(".")[0] for name in names} - set(sys.stdlib_module_names) - {"neurolens"}
        if part in PACKAGES:
            wrong += [f"{module} imports {p}" for p in sorted(packages - PACKAGES[part] - own_packages)]
        if part != "__main__":
            # `from neurolens import __version__` is open to all.
            parts = {part_of(name) for name in names if name.startswith("neurolens.")} - {"__version__"}
            allowed = {part, "base"} | PARTS.get(part, set()) | own_parts
            allowed |= {"models"} if "surrogates" in allowed else set()
            wrong += [f"{module} imports {p}" for p in sorted(parts - allowed)]
    assert not wrong


def test_no_imports_go_in_a_circle() -> None:
    """Those inside functions count, too; those for types alone do not."""
    graph = {}
    for path in MODULES:
        text = TYPES_ALONE.sub("", path.read_text(encoding="utf-8"))
        found = set()
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("neurolens"):
                found |= {f"{node.module}.{alias.name}" for alias in node.names} | {str(node.module)}
        graph[module_name(path)] = (found & IMPORTED.keys()) - {module_name(path), "neurolens"}
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
    assert sum(lines.values()) <= MOST_LINES and len(lines) <= MOST_MODULES, table


def test_cameras_renderer_and_command_line_load_without_the_training_packages() -> None:
    wanted = [m for m in map(module_name, MODULES) if part_of(m) in LEAN or m in LEAN_MODULES]
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
    code = (
        "import sys; sys.modules['numpy'] = None; from neurolens.cli import build_parser; build_parser().format_help()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr


def test_exact_cameras_start_without_torchs_compiler() -> None:
    """It takes longer to load than all the rest."""
    code = "import sys, neurolens.cameras.exact; assert 'torch._dynamo' not in sys.modules"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
