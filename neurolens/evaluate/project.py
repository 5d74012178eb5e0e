"""Where the project's own lenses, experiments and models lie, for the tools that make and measure what ships."""

from __future__ import annotations

from pathlib import Path

from neurolens.base.errors import InputError


def project_root() -> Path:
    """The project's folder: that of the source, or else, for a package installed away from it, the working folder.

    Raises:
        InputError: neither has the folder experiments/.
    """
    for root in (Path(__file__).parents[2], Path.cwd()):
        if (root / "experiments").is_dir():
            return root
    raise InputError(Path.cwd(), "experiments/", "(missing)", "the project's folder as the working folder")
