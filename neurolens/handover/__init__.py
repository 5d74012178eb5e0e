"""A lens as files of the programs that follow a render: each module writes one standard, `shot.py` what all share.

The texts are templates of `templates/`, `handover.*.jinja`; the command is `cli/handover.py`.
"""
