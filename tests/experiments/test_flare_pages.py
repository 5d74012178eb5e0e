"""What the pages of flare show."""

import shlex

from experiments import flare_gallery
from neurolens.cli import build_parser


def test_commands_of_pictures_are_commands_and_make_what_they_show() -> None:
    before = set[str]()
    for picture in flare_gallery.PICTURES:
        made = {build_parser().parse_args(shlex.split(command)[1:]).output.stem for command in picture.commands}
        shown = {file.partition(".0")[0] for panel in picture.panels for file in (*panel.files, panel.over) if file}
        assert made <= shown <= made | before
        before |= made
