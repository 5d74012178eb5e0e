"""What the pages of flare measure, and another tracer's words."""

import math
import shlex
from pathlib import Path

import pytest

from experiments import flare_gallery, flare_speed, lab
from neurolens.base.errors import InputError
from neurolens.cli import build_parser
from neurolens.lens.prescription import Lens
from neurolens.readers.lensfile import read_lens
from neurolens.setting.states import set_lens


def triplet() -> Lens:
    return set_lens(read_lens(lab.LENSES / "cooke_triplet_50.toml"), focus_m=math.inf)


def test_another_tracer_is_asked(tmp_path: Path) -> None:
    flare_speed._write_inputs(triplet(), tmp_path)
    rows = (tmp_path / "ours.lens").read_text().split("surfaces:\n")[1].splitlines()
    assert len(rows) == len(triplet().surfaces) and sum("stop" in row for row in rows) == 1
    program = tmp_path / "flaresim"
    program.write_text("#!/bin/sh\necho 'Ghost rendering total: 0.2 s  (12/345 rays, 3.5%)'\n")
    program.chmod(0o755)
    seconds, rays, arriving = flare_speed._flaresim(program, tmp_path, 16)
    assert seconds >= 0 and (rays, arriving) == (345, 12)
    program.write_text("#!/bin/sh\necho something else\n")
    for binary in (program, tmp_path / "none"):
        with pytest.raises(InputError, match="flaresim"):
            flare_speed._flaresim(binary, tmp_path, 16)


def test_commands_of_pictures_are_commands_and_make_what_they_show() -> None:
    before = set[str]()
    for picture in flare_gallery.PICTURES:
        made = {build_parser().parse_args(shlex.split(command)[1:]).output.stem for command in picture.commands}
        shown = {file.partition(".0")[0] for panel in picture.panels for file in (*panel.files, panel.over) if file}
        assert made <= shown <= made | before
        before |= made
