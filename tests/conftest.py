"""Order of the tests: slow ones are last in their file, sweeps run with NEUROLENS_WHOLE=1; races are short, and a small
scene is at hand."""

import gc
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from hypothesis import settings
from shipped import WHOLE

from neurolens import cli
from neurolens.base.progress import Progress
from neurolens.cameras import build
from neurolens.cameras.contract import Camera
from neurolens.graph import compiler
from neurolens.optics.lens.shot import Shot

# A ball in white light.
SCENE = """\
[camera]
position_m = [0.0, 0.0, 2.0]
look_at_m = [0.0, 0.0, 0.0]
focus_m = 2.0
f_number = 4.0
width = 32
height = 18
samples = 2

[environment]
colour = [1.0, 1.0, 1.0]

[materials]
grey = { kind = "diffuse", reflectance = [0.5, 0.5, 0.5] }

[[spheres]]
centre_m = [0.4, 0.0, 0.0]
radius_m = 0.1
material = "grey"
"""

# A busy machine is no failure: no example has a time limit.
settings.register_profile(
    "neurolens", settings.get_profile("default"), deadline=None, max_examples=100 if WHOLE else 30
)
settings.load_profile("neurolens")


def pytest_configure(config: pytest.Config) -> None:
    # Many shipped tables state too little; what is warned of has tests of its own.
    config.addinivalue_line("filterwarnings", "ignore::neurolens.base.errors.NeurolensWarning")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    left_out = [] if WHOLE else [item for item in items if item.get_closest_marker("whole")]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if not item.get_closest_marker("whole")]
    files = {path: k for k, path in enumerate(dict.fromkeys(item.path for item in items))}
    items.sort(key=lambda item: (files[item.path], item.get_closest_marker("slow") is not None))


def pytest_collection_finish() -> None:
    gc.freeze()  # what is imported and collected stays: no need to look through it again and again
    gc.set_threshold(50_000)  # graphs are tens of thousands of tuples, of which few are garbage


@pytest.fixture(autouse=True, scope="session")
def quick_races() -> Iterator[None]:
    """The command line is made once; races are of few rays and samples, their C compiled with less effort, for no test
    judges a clock."""
    flags = ("-std=c99", "-O0", "-march=native")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiler, "FLAGS", tuple(flag.replace("-O3", "-Og") for flag in compiler.FLAGS))
        # What is compiled and searched for one test is there for the next, in both processes.
        patch.setattr(compiler, "_KEPT", 4096)
        patch.setattr("neurolens.cameras.exact._KEPT", 4096)
        patch.setattr("neurolens.models.pairs._BATCH", 16384)  # fits here take a few thousand rays
        patch.setattr("experiments.speed.compiled_source.CompiledSource.__init__.__defaults__", (flags, False, ()))
        patch.setattr("experiments.speed.compiled_source.program_candidate.__defaults__", (None, flags, False))
        patch.setattr(cli.main, "__defaults__", (None, cache(cli.build_parser)))
        patch.setattr("neurolens.studies.speed.POOL", 16384)
        patch.setattr("neurolens.studies.speed._SAMPLES", 1)
        patch.setattr("neurolens.studies.plan.costs._STRIP_PATHS", 12_000)
        yield


@pytest.fixture
def one_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands of a test that ask for the same camera share it: each would write and open the same programs again."""

    @cache
    def made(spec: str, shot: Shot) -> Camera:
        return build.make_camera(spec, shot)

    def shared(spec: str | Path, shot: Shot, progress: Progress | None = None) -> Camera:
        return made(str(spec), shot)

    monkeypatch.setattr("neurolens.pictures.frames.make_camera", shared)
    monkeypatch.setattr("neurolens.cli.arguments.camera", lambda name, shot, progress: made(name, shot))


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A small scene file, for the command line."""
    path = tmp_path / "ball.toml"
    path.write_text(SCENE)
    return path


@pytest.fixture
def no_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trainings without the plots of their report, which take longer to draw than small models to fit."""
    monkeypatch.setattr("neurolens.studies.train._draw", lambda *_: [])
