"""What the project says of itself in several files agrees; the Python examples of its pages run."""

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import neurolens
from neurolens.base.errors import InputError

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


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


def test_licence_citation_and_changes_are_there_and_name_this_version() -> None:
    assert PROJECT["license"] == "MIT" and (ROOT / "LICENSE").read_text(encoding="utf-8").startswith("MIT License")
    assert "CC0" in (ROOT / "lenses" / "LICENSE").read_text(encoding="utf-8")
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
