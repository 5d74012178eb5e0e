"""A headless Chromium, which `make test-web` names in NEUROLENS_BROWSER; tests that need it are skipped without it."""

import os
from collections.abc import Iterator
from typing import Any

import pytest

FLAGS = [
    "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader", "--use-vulkan=swiftshader",
    "--enable-features=Vulkan",
]  # fmt: skip


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """The browser, with WebGL and WebGPU in software."""
    path = os.environ.get("NEUROLENS_BROWSER")
    if not path:
        pytest.skip("no browser is named (NEUROLENS_BROWSER, see make test-web)")
    sync_api = pytest.importorskip("playwright.sync_api", reason="no playwright (pip install '.[web]')")
    with sync_api.sync_playwright() as play:
        found = play.chromium.launch(executable_path=path, args=FLAGS)
        yield found
        found.close()
