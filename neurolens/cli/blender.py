"""`neurolens blender`: the extension for Blender, packed with lenses, and lenses of your own in it."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from neurolens.base.errors import warn
from neurolens.base.files import check_writable
from neurolens.base.files import library as shipped
from neurolens.base.settings import setting
from neurolens.cli.arguments import Command, Parser, Reporting, check_suffix, lens, output_path


@dataclass(frozen=True, kw_only=True)
class Blender(Command):
    """Real lenses as cameras of Blender's Cycles (4.5 and later): an extension with a panel at the
    camera's data, where a lens is put on with one click and taken off with one."""

    about: ClassVar[str] = "the extension for Blender, and lenses in it"

    @classmethod
    def add_options(cls, parser: Parser) -> None:
        """Add its actions to its parser."""
        actions = parser.add_subparsers(metavar="ACTION", required=True, parser_class=Parser)
        for action in (Build, Add):
            action.add_parser(actions)


@dataclass(frozen=True, kw_only=True)
class Build(Reporting):
    """Pack the extension with a folder of models and with the lens files of the folder lenses/ beside it: of each
    lens the best polynomial, the best network and the exact lens, every surface traced.
    What cannot be a shader is left out and said.

    Finished lenses are kept: a build that was stopped goes on where it was, and a second one is quick.

    Install it in Blender: Edit > Preferences > Get Extensions > Install from Disk."""

    about: ClassVar[str] = "pack the extension as a zip"
    kept: ClassVar[str] = "no zip was written; finished shaders are kept for the next run"
    called: ClassVar[str] = "neurolens blender build"

    out: Path = output_path("OUT.zip", "default: neurolens.zip", Path("neurolens.zip"))
    models: Path | None = setting(None, "default: the models that ship", metavar="DIR")
    lens: tuple[str, ...] = setting(
        (), "only this lens, repeatable: LENS of LENS.ols-64.onnx or of LENS.toml (default: all)", metavar="LENS"
    )
    no_exact: bool = setting(False, "leave exact lenses out")
    jobs: int = setting(
        min(8, os.cpu_count() or 1),
        "processes that make shaders, each of a core and 0.5 GB (default: all cores, at most 8)", within=(1, 64),
    )  # fmt: skip

    def run(self) -> int:
        """Pack the extension."""
        check_suffix(self.out, "--output", (".zip",))
        check_writable(self.out)
        folder = self.models or shipped() / "models"  # of the installation as it is now
        if not folder.is_dir():
            self.refuse("--models", str(folder), "a folder of models that exists")
        from neurolens.blender.pack import write_pack
        from neurolens.cli.blender_lenses import forms_of, library, packed_of, stated_lens
        from neurolens.readers.any_format import read_any

        began, packed = time.perf_counter(), []
        lens_folder = folder.parent / "lenses"
        places = list(library(folder, lens_folder, self.lens))
        if not places:
            self.refuse("--models", str(folder), "a folder with models (.onnx)")
        exact = [] if self.no_exact else [lens_file for _, lens_file in places if lens_file is not None]
        files = [
            *exact,
            *(file for models, _ in places for file in models),
        ]  # exact lenses take longest, so they go first
        progress = self.progress()
        with progress.stage("shaders") as report:
            forms, left = forms_of(files, self.jobs, report)
        with progress.stage("thumbnails") as report:
            for models, lens_file in places:
                own = [f for f in (*models, lens_file) if f is not None and f in forms]
                if own:
                    lens = stated_lens(own[0], lens_folder) if lens_file is None else read_any(lens_file)
                    packed.append(packed_of(own, [forms[f] for f in own], lens=lens))
                report(len(packed) / len(places))
        for why in left.values():
            warn(f"left out: {why}")
        if not packed:
            self.refuse("--models", str(folder), "a folder with a model for a shader")
        write_pack(self.out, packed)
        data = {
            "file": str(self.out),
            "bytes": self.out.stat().st_size,
            "lenses": {p.lens_id: [f.model or f.kind for f in p.forms] for p in packed},
            "left_out": {file.name: why for file, why in left.items()},
            "seconds": time.perf_counter() - began,
        }
        return self.answer(
            data, lambda: f"{self.out}: {len(packed)} lenses, {sum(len(p.forms) for p in packed)} shaders"
        )


@dataclass(frozen=True, kw_only=True)
class Add(Reporting):
    """Put a model (.onnx) or a lens file of any format into the extension: into the user folder of an installed
    one (the newest Blender of this machine that has it), or into a zip. A form of a lens replaces the one
    that was there. In Blender, "Read Lenses Again" in the panel shows it."""

    about: ClassVar[str] = "put a lens into the extension"
    kept: ClassVar[str] = "nothing was added"
    called: ClassVar[str] = "neurolens blender add"

    file: Path = lens(models=True, positional=True)
    extension: Path | None = setting(
        None, "a packed extension, or a user folder of one", metavar="ZIP|DIR", old=("to",)
    )
    zoom: str | None = setting(
        None, "state of a zoom, by name or focal length in mm; range: a setting", metavar="STATE"
    )

    def run(self) -> int:
        """Add a lens."""
        from neurolens.blender.pack import add_to_folder, add_to_zip, check_takes, user_folders
        from neurolens.cli.blender_lenses import form_of, packed_of

        to = self.extension
        if to is None:
            to = next(iter(user_folders()), None)
        if to is None:
            expected = "a zip or a folder: no Blender of this machine has the extension installed"
            self.refuse("--extension", "(missing)", expected)
        check_takes(to)
        form = form_of(self.file, zoom=self.zoom, quiet=self.quiet)
        lens = packed_of([self.file], [form], zoom=self.zoom)
        (add_to_zip if to.suffix == ".zip" else add_to_folder)(to, lens)
        data = {"lens": lens.lens_id, "to": str(to), "forms": [f.model or f.kind for f in lens.forms]}
        return self.answer(data, lambda: f"{lens.name} ({', '.join(data['forms'])}) is in {to}")
