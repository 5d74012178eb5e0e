"""The folders are layers: imports go one way, a render needs no torch, and modules stay short enough to read.

base <- graph <- modelfile <- optics <- surrogates <- evaluate <- commands <- cli
                              optics <- analysis   <- evaluate
                 modelfile <- cameras <- render    <- evaluate
                  surrogates, analysis, render <- flare <- evaluate <- frames <- commands
                                         render    <- mitsuba  <- evaluate
"""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MODULES = sorted((ROOT / "neurolens").rglob("*.py"))
MAX_LINES = 500

BASE = {"base"}
# What cameras need of optics: modules without torch, open to all parts.
TORCH_FREE_OPTICS = {f"neurolens.optics.{name}" for name in ("apertures", "film_plane", "sag")}
# Parts of the package that each part may import, besides itself and the base.
PARTS = {
    "graph": set(),
    "modelfile": {"graph"},
    "optics": {"graph", "modelfile"},
    "readers": {"optics"},
    "analysis": {"optics"},
    "surrogates": {"graph", "modelfile", "optics"},
    "cameras": {"graph", "modelfile"},
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
    "base": {"numpy"},
    "graph": {"numpy"},  # and torch where it is handed tensors
    "modelfile": {"numpy"},
    "optics": {"numpy", "torch"},
    "analysis": {"numpy", "torch", "matplotlib"},
    "mitsuba": {"numpy"},
    "readers": set(),
    "cameras": {"numpy", "onnxruntime", "onnx"},  # onnx when a camera is first asked for rays: it loads slowly
    "render": {"numpy", "OpenEXR", "PIL"},
    "blender": {"bpy", "cycles"},  # of Blender's own Python, in the extension
}
# Besides those: the writer of ONNX; the one camera that traces rays exactly, the maker of cameras, which imports it
# when one is asked for; the shapes of the stop, which are parts of graphs.
EXCEPTIONS: dict[str, tuple[set[str], set[str]]] = {
    "neurolens.base.cluster": (set(), {"dask", "distributed"}),  # where a cluster is asked for
    "neurolens.graph.onnx": (set(), {"onnx"}),
    "neurolens.optics.apertures": ({"graph"}, set()),
    "neurolens.optics.sag": ({"optics"}, set()),  # for a type
    "neurolens.cameras.exact": ({"optics"}, {"torch"}),
    "neurolens.cameras.outline_cache": ({"optics"}, {"torch"}),
    "neurolens.cameras.build": ({"optics", "readers"}, set()),
    "neurolens.cameras.field": ({"optics"}, set()),  # first-order data of lenses that are traced
}
# Modules that load torch or onnx; others load these when they are needed.
SLOW = {"neurolens.cameras.exact", "neurolens.cameras.outline_cache", "neurolens.commands.export_lens"}
SLOW |= {"neurolens.graph.onnx"}
# What loads in a base install: these parts, and what converts lens files, looks up glass and writes C.
LEAN = ("graph", "modelfile", "cameras", "render", "mitsuba", "frames", "commands", "cli", "base", "readers")
LEAN_MODULES = {
    *(f"neurolens.optics.{name}" for name in ("catalogue", "designs", "glass", "lensfile", "lenswriter", "paraxial")),
    "neurolens.surrogates.source",
}


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(path: Path) -> set[str]:
    """Dotted names of everything a module imports, anywhere in it."""
    package = module_name(path).split(".")
    if path.name != "__init__.py":
        package = package[:-1]
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            origin = ".".join([*above, *([node.module] if node.module else [])])
            names |= {f"{origin}.{alias.name}" for alias in node.names}
    return names


def part_of(module: str) -> str:
    """First folder or module below the package; "base" for the modules that everybody may import."""
    name = module.split(".")[1] if "." in module else "__init__"
    shared = ".".join(module.split(".")[:3]) in TORCH_FREE_OPTICS
    return "base" if shared or name in BASE else name


@pytest.mark.parametrize("path", MODULES, ids=module_name)
def test_imports_go_one_way(path: Path) -> None:
    module = module_name(path)
    part = part_of(module)
    assert part in {*PARTS, "base", "__init__", "__main__"}, f"{module}: give this part its place in {__name__}"
    own_parts, own_packages = EXCEPTIONS.get(module, (set(), set()))
    packages = {name.split(".")[0] for name in imported(path)} - set(sys.stdlib_module_names) - {"neurolens"}
    if part in PACKAGES:
        assert packages <= PACKAGES[part] | own_packages, f"{module} imports {packages}"
    if part != "__main__":
        # `from neurolens import __version__` is open to all.
        parts = {part_of(name) for name in imported(path) if name.startswith("neurolens.")} - {"__version__"}
        allowed = {part, "base"} | PARTS.get(part, set()) | own_parts
        assert parts <= allowed, f"{module} imports {sorted(parts - allowed)}"


@pytest.mark.parametrize("path", MODULES, ids=module_name)
def test_modules_stay_short(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= MAX_LINES


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
