"""What the project says of itself in several files agrees; the Python examples of its pages run."""

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from pins import EXTRAS, LOCKS, OLDEST, TABLE, cuda, pins, plain
from test_imports import statements

import neurolens
from neurolens.base import errors
from neurolens.base.errors import InputError

ROOT = Path(__file__).parents[1]
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = SETTINGS["project"]
FOLDERS = ("neurolens", "experiments", "tests")
IN_BLENDER = {"bpy", "bmesh", "cycles"}  # modules that Blender brings
# Distributions that nothing there imports: programs, their plugins, and cryptography, by which distributed makes keys.
TOOLS = {"pytest-xdist", "ruff", "mypy", "sphinx", "myst-parser", "pydata-sphinx-theme", "cryptography"}


def test_the_tested_versions_lie_in_the_ranges_that_are_declared() -> None:
    text = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    tested = dict(re.findall(r"^([^\s=]+)==(\S+)", text, re.MULTILINE))
    versions = {name.lower().replace("_", "-"): version for name, version in tested.items()}
    extras = PROJECT["optional-dependencies"]
    for line in [*PROJECT["dependencies"], *(line for extra in extras.values() for line in extra)]:
        wanted = Requirement(line)
        assert wanted.specifier.contains(versions[wanted.name.lower()]), line
        assert not any(s.operator == "==" for s in wanted.specifier), (
            f"{line}: a range, constraints.txt has the version"
        )


def test_every_pin_takes_every_python_that_is_promised() -> None:
    """What the packages ask for, as tests/pins.py wrote it down of the index: from the very first Python on."""
    asked = json.loads(TABLE.read_text(encoding="utf-8"))
    pinned = {f"{plain(name)}=={version}" for name, version in pins().items()}
    assert set(asked) == pinned, "constraints.txt has changed: run python tests/pins.py"
    oldest = SpecifierSet(PROJECT["requires-python"])
    assert OLDEST in oldest and "3.10.99" not in oldest
    for pin, wanted in asked.items():
        for python in (OLDEST, "3.11.2", "3.11.14", "3.12.0", "3.13.0"):
            assert python in SpecifierSet(wanted or ""), f"{pin} wants Python {wanted}, not {python}"


def test_locks_have_hashes_of_what_is_installed_at_the_pinned_versions() -> None:
    """Every package at the version of its pin, and none without a hash, as pip demands it."""
    wanted = {plain(name): version for name, version in pins().items() if not cuda(name)}
    locked = {}
    for lock in LOCKS:
        text = lock.read_text(encoding="utf-8")
        entries = re.split(r"\n(?=\S)", text)
        assert all(re.search(r" --hash=sha256:[0-9a-f]{64}$", entry, re.MULTILINE) for entry in entries)
        locked[lock.stem] = {plain(e.partition("==")[0]): e.partition("==")[2].split()[0] for e in entries}
    assert locked["base"].items() < locked["all"].items() <= wanted.items(), "run python tests/pins.py"
    extras = PROJECT["optional-dependencies"]
    for names, lines in (("base", PROJECT["dependencies"]), *(("all", extras[extra]) for extra in EXTRAS)):
        asked = {plain(Requirement(line).name) for line in lines} - {"torch"}
        assert asked <= set(locked[names]), names
    assert {*EXTRAS, "shading"} == set(extras) and "scipy" not in locked["base"]


def imported(text: str, tree: ast.Module) -> Iterator[str]:
    """Top-level names that a module imports, also by `import_module` and `importorskip` of a literal."""
    yield from re.findall(r"\b(?:import_module|importorskip)\(\s*[\"'](\w+)", text)
    for node in statements(tree.body):
        names: list[object] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names = [node.module]
        yield from (str(name).partition(".")[0] for name in names)


def own_environment(file: Path, tree: ast.Module, name: str) -> bool:
    """Whether a script runs where another package is installed by hand: mypy leaves it out, or its head says so."""
    excluded = any(re.search(p, file.relative_to(ROOT).as_posix()) for p in SETTINGS["tool"]["mypy"]["exclude"])
    return excluded or f"pip install {name}==" in (ast.get_docstring(tree) or "")


@pytest.mark.whole  # it reads all files
def test_what_is_imported_is_declared_and_what_is_declared_is_imported() -> None:
    def declared(*extras: str) -> set[str]:
        lines = [line for extra in extras for line in PROJECT["optional-dependencies"][extra]]
        return {plain(Requirement(line).name) for line in [*PROJECT["dependencies"], *lines]}

    every = set(PROJECT["optional-dependencies"])
    allowed = {
        "neurolens": declared(*every - {"dev", "docs"}),
        "experiments": declared(*every),
        "tests": declared(*every),
    }
    distributions, used, missing = packages_distributions(), set(TOOLS), []
    files = [file for folder in FOLDERS for file in sorted((ROOT / folder).rglob("*.py"))]
    ours = {*FOLDERS, *(file.stem for file in files if "tests" in file.parts)} | IN_BLENDER | sys.stdlib_module_names
    for file in files:
        text = file.read_text(encoding="utf-8")
        tree = ast.parse(text)
        for name in set(imported(text, tree)) - ours:
            wanted = {plain(one) for one in distributions.get(name, [name])}
            used |= wanted
            known = wanted & allowed[file.relative_to(ROOT).parts[0]] or own_environment(file, tree, name)
            missing += [] if known else [f"{file.relative_to(ROOT)}: {name}"]
    assert not missing
    assert declared(*every) - used == set(), "nothing imports these: declare them no longer"


# A command that would install the project which owns the name `neurolens` on PyPI.
STRANGER = re.compile(r"pip3? install\b[^\n`&;|]*?[\s'\"`]neurolens(?![\w*/.-])")


def test_no_text_tells_anybody_to_install_the_other_neurolens() -> None:
    for line in ("pip install 'neurolens[mitsuba]'", "pip install -U neurolens", 'pip install "neurolens>=0.1"'):
        assert STRANGER.search(line)
    for line in (f"pip install '{neurolens.DISTRIBUTION}[train]'", "pip install neurolens_camera-*.whl"):
        assert not STRANGER.search(line)
    assert PROJECT["name"] == neurolens.DISTRIBUTION != "neurolens"
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("no git, or no checkout")
    found = []
    for name in set(listed.stdout.split("\0")) - {"", "tests/test_project.py"}:
        if (ROOT / name).is_file() and b"\0" not in (data := (ROOT / name).read_bytes()):
            found += [f"{name}: {m[0]}" for m in STRANGER.finditer(data.decode("utf-8", "replace"))]
    assert not found


def test_what_an_extra_brings_is_what_messages_name() -> None:
    """Packages by the names that are imported, such as flip_evaluator, and the command for a checkout and a wheel."""
    extras = PROJECT["optional-dependencies"]
    for package, extra in errors.EXTRAS.items():
        brought = {Requirement(line).name.lower().replace("-", "_") for line in extras[extra]}
        assert package in brought
    lacking = ModuleNotFoundError("No module named 'torch.nn'", name="torch.nn")
    assert errors.missing(lacking).endswith("pip install '.[train]'")
    assert not errors.missing(ModuleNotFoundError("No module named 'antigravity'", name="antigravity"))
    assert not errors.missing(ValueError("torch"))


def test_an_installed_wheel_names_itself_by_its_own_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(errors, "__file__", str(tmp_path / "lib" / "neurolens" / "base" / "errors.py"))
    assert errors.pip_install("dask") == f"pip install '{neurolens.DISTRIBUTION}[dask]'"


def test_commands_refuse_to_run_under_the_other_neurolens(tmp_path: Path) -> None:
    """pip writes its files over ours where both are installed: its __init__.py, while our folders stay."""
    shutil.copytree(ROOT / "neurolens", tmp_path / "neurolens", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "neurolens" / "__init__.py").write_text('"""Another project."""\n__version__ = "0.1.1"\n')
    code = "import sys; from neurolens.cli import main; sys.exit(main(['glass', 'N-BK7']))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert "another project" in done.stderr and "pip uninstall neurolens" in done.stderr


def test_licence_citation_and_changes_are_there_and_name_this_version() -> None:
    assert PROJECT["license"] == "MIT" and (ROOT / "LICENSE").read_text(encoding="utf-8").startswith("MIT License")
    licence = (ROOT / "lenses" / "LICENSE").read_text(encoding="utf-8")
    lenses = [tomllib.loads(file.read_text(encoding="utf-8")) for file in sorted((ROOT / "lenses").glob("*.toml"))]
    fitted = sum(lens["rims"] == "photographs" for lens in lenses)
    measured = sum("measured" in lens for lens in lenses)
    readme = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    assert "CC0" in licence and "Attribution-ShareAlike 3.0" in licence
    assert f"In {fitted} files the diameters" in licence and f"{measured} files have a table" in licence
    assert f"diameters of {fitted} lens files and the tables `[measured]` of {measured} come" in readme
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {neurolens.__version__}\n" in citation and "\nlicense: MIT\n" in citation
    assert f"\n## {neurolens.__version__}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert (ROOT / "neurolens" / "py.typed").exists()


EXAMPLES = [
    pytest.param(code, id=f"{page}-{k}")
    for page in ("README.md", "neurolens/README.md")
    for k, code in enumerate(re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.S))
]


@pytest.mark.parametrize("code", EXAMPLES)
def test_examples_run(code: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(ROOT)
    exec(compile(code, "example", "exec"), {})  # noqa: S102 - our own pages
    assert capsys.readouterr().out


def test_an_installed_package_holds_the_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the wheel's data files are, laid out as an installation has them, is what names find."""
    from neurolens.base import files
    from neurolens.base.lensname import resolve

    data = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]["data-files"]
    for folder, patterns in data.items():
        (tmp_path / "env" / folder).mkdir(parents=True)
        for found in (f for pattern in patterns for f in ROOT.glob(pattern)):
            (tmp_path / "env" / folder / found.name).write_bytes(found.read_bytes())
    monkeypatch.setattr(files, "__file__", str(tmp_path / "env" / "lib" / "neurolens" / "base" / "files.py"))
    monkeypatch.setattr(files.sys, "prefix", str(tmp_path / "env"))
    assert files.library() == tmp_path / "env" / "share" / "neurolens"
    for name in ("laikin_double_gauss_50", "laikin_double_gauss_50.mlp-16x2", "isshiki_fisheye_10.mlp-16x2"):
        assert Path(str(resolve(name))).is_file()
    assert (files.library() / "experiments" / "scenes" / "lights.toml").is_file()
    with pytest.raises(InputError, match="missing"):
        resolve("no_such_lens")


def test_files_beside_the_modules_are_in_the_wheel() -> None:
    """C, templates, scripts, styles and tables: every file of the package that git knows is package data."""
    data = SETTINGS["tool"]["setuptools"]["package-data"]
    folders = {ROOT / name.replace(".", "/"): patterns for name, patterns in data.items()}
    packed = {file for folder, patterns in folders.items() for pattern in patterns for file in folder.glob(pattern)}
    listed = subprocess.run(["git", "ls-files", "neurolens"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("no git, or no checkout")
    beside = {ROOT / line for line in listed.stdout.splitlines() if not line.endswith(".py")}
    assert len(beside) > 20 and {file for file in beside if file.is_file()} - packed == {ROOT / "neurolens/README.md"}
