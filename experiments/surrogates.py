"""Every method on a set of lenses, or on the whole library: `neurolens bench` with lenses chosen here.

Without LENS: laikin_double_gauss_50 (a standard lens), ogawa_zoom_70_200 (a long zoom), schaefter_primoplan_100 (hard
for its aperture), horimoto_fisheye_16 and phone_lens_6 (steep aspheres).
"""

from __future__ import annotations

import argparse

from experiments import lab
from neurolens.base.errors import InputError
from neurolens.commands import bench
from neurolens.evaluate.describe import lens_files

DEFAULT_LENSES = (
    "laikin_double_gauss_50", "ogawa_zoom_70_200", "schaefter_primoplan_100", "horimoto_fisheye_16", "phone_lens_6"
)  # fmt: skip
OPTIONS = (
    lambda parser: bench.add_surrogate_arguments(parser, "*"),
    lab.option("--library", action="store_true", help="every lens file of lenses/"),
)


def run(args: argparse.Namespace) -> int:
    """As `neurolens bench` on the lenses chosen."""
    if args.library:
        if args.lenses:
            raise InputError("experiments surrogates", "LENS", args.lenses, "none beside --library")
        args.lenses = [str(file) for file in lens_files(lab.LENSES)]
    args.lenses = args.lenses or list(DEFAULT_LENSES)
    return bench.run_surrogates(args)
