"""What the pages of flare measure: costs of habits against none, and another tracer's words."""

import math
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from experiments import coatings, flare_gallery, flare_speed, lab
from neurolens.base.errors import InputError
from neurolens.cli import build_parser
from neurolens.flare.ghosts import coated
from neurolens.optics.lensfile import read_lens
from neurolens.optics.prescription import Lens
from neurolens.optics.states import set_lens
from neurolens.render.spectrum import SpectralRange


def triplet() -> Lens:
    return set_lens(read_lens(lab.LENSES / "cooke_triplet_50.toml"), focus_m=math.inf)


def test_no_habit_costs_nothing_and_a_filter_only_light(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coatings, "_SPECTRAL", SpectralRange(400.0, 700.0, bins=3))
    lens = triplet()
    truth = coatings.seen_by(coated(lens, "multi-layer"), lens)
    same = coatings.cost_of("same", truth, truth)
    assert same.light == same.low == same.high == 1
    assert same.gone == same.place_um == same.all_um == same.colour == same.delta_e == same.all_colour == 0
    # Half the light of ghosts, the same image.
    half = coatings.cost_of("half", truth, replace(truth, xyz=truth.xyz / 2))
    assert half.light == pytest.approx(0.5) and half.delta_e == pytest.approx(0, abs=1e-9) and half.place_um == 0
    assert coatings.spheres_of(lens).surfaces == lens.surfaces
    one = coatings.cost_of("one", truth, coatings.seen_by(coated(lens, "quarter-wave"), lens))
    assert one.light > 2 and one.low < one.light < one.high and one.delta_e > 5


def test_delta_e_of_known_colours() -> None:
    """Equal at any brightness; red against white of its luminance by CIE 15's formulas."""
    white = np.array([0.9504559, 1.0, 1.0890578])
    red = np.array([0.4123908, 0.2126390, 0.0193308])
    assert coatings._delta_e(white, 3 * white) == pytest.approx(0, abs=1e-9)
    a = 500 * (66 / 116) * ((red[0] / red[1] / white[0]) ** (1 / 3) - 1)
    t = (66 / 116) ** 3 * red[2] / red[1] / white[2]
    b = 200 * (66 / 116 - (t ** (1 / 3) if t > (6 / 29) ** 3 else t / (3 * (6 / 29) ** 2) + 4 / 29))
    assert coatings._delta_e(white, red) == pytest.approx(math.hypot(a, b), rel=1e-4)


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
        made = {build_parser().parse_args(shlex.split(command)[1:]).out.stem for command in picture.commands}
        shown = {file.partition(".0")[0] for panel in picture.panels for file in (*panel.files, panel.over) if file}
        assert made <= shown <= made | before
        before |= made


def test_published_pictures_are_large_to_look_at_and_small_to_keep() -> None:
    for picture in flare_gallery.PICTURES:
        file = lab.RESULTS / "flare" / f"{picture.name}.jpg"
        with Image.open(file) as opened:
            assert opened.width >= 1280 and file.stat().st_size <= 700_000
