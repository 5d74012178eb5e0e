"""`neurolens psf LENS -o OUT.npz`: point spread of a lens by diffraction over film, distance and f-number."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from neurolens.base.errors import note, warn
from neurolens.base.files import forget_parts, how_to_resume, write_arrays
from neurolens.base.lensname import is_model
from neurolens.base.report import Report
from neurolens.base.settings import (
    F_NUMBER,
    WAVELENGTH_NM,
    between,
    group,
    listed,
    positive,
    said,
    setting,
    wavelengths_nm,
)
from neurolens.base.tasks import Here
from neurolens.cameras.onnxlens import load_model
from neurolens.cli import arguments as cli
from neurolens.cli.stmap import whole_pair
from neurolens.optics.lens.glass import check_light
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.shot import BY_LENSES
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.setting.states import focus_of, set_lens
from neurolens.pictures.defocus.diffraction import MOST_PX, Channels, channels_of, places_of
from neurolens.pictures.render.pictures import write_channels
from neurolens.programs.psf import (
    Arrays,
    PsfTask,
    about,
    channels_of_exr,
    library_of,
)

_ACROSS = 6000  # pixels of a picture whose pixels are not given


@dataclass(frozen=True, kw_only=True)
class PointSpread(cli.Reporting):
    """Write the point spread of a lens: how the light of a point lies on the pixels, by diffraction, over the film.

      OUT.npz   arrays of numpy, rows and columns as in the upright picture; about.json in it says what they are
      OUT.exr   an atlas for each f-number, distance and channel, to be looked at

    Waves are summed over the exact pupil, with its vignetting, blades, aberrations and losses in glass. Far out of
    focus, where fringes are finer than pixels, rays are counted instead, and the file says where. Each distance and
    f-number is a part that is kept until the file is written: the same command goes on. A model with optical path
    (train --phase) takes the place of traced rays. Needs the extra "train" (torch).

    In Python `neurolens.programs.blur` blurs pictures by such a file."""

    epilog = """\
examples:
  neurolens psf laikin_double_gauss_50 -o gauss.npz --plot gauss.png
  neurolens psf laikin_double_gauss_50 --film 36x24 --pixel-um 4 --grid 9x7 --focus 2 --distance 1.5,2,inf \\
      --f-number 2,4,8 -o gauss.npz
  neurolens psf phone_lens_6 --pixel-um 1 --wavelengths 450,550,650 --dask local:2 -o phone.npz"""
    called = "neurolens psf"
    intermixed = True

    file: Path = cli.lens(also="; models need the optical path (train --phase)", models=True, positional=True)
    out: Path = cli.output_path("OUT.npz", "file to write: .npz or .exr")
    film: tuple[float, float] = cli.film()
    pixel_um: float = setting(
        None, f"size of a pixel (default: the film's width / {_ACROSS})", option="pixel-um", within=(0.05, 1000),
        metavar="UM", common=True, assumed=True,
    )  # fmt: skip
    grid: tuple[int, int] = setting(
        (9, 7), "columns and rows of places in the picture (default: 9x7)", kind=whole_pair("COLUMNSxROWS", 64),
        metavar="CxR", common=True,
    )  # fmt: skip
    distance: tuple[tuple[float, ...], ...] | None = setting(
        None, "distances of things from the film in metres, or inf (default: what is in focus)",
        kind=listed(positive("a distance in metres", infinite=True)), nargs="+", metavar="M", common=True,
    )  # fmt: skip
    f_number: tuple[tuple[float, ...], ...] | None = setting(
        None, "focal length over entrance-pupil diameter at infinity focus (default: the widest)",
        kind=listed(between(*F_NUMBER, "f-numbers")), nargs="+", metavar="N", common=True,
    )  # fmt: skip
    channels: Literal["rgb", "mono"] = setting(
        "rgb", "rgb: the channels of a Bayer sensor, by the film's response; mono: one of all light (default: rgb)"
    )
    wavelengths: tuple[tuple[float, ...], ...] | None = setting(
        None, f"a channel for each of these, {said(WAVELENGTH_NM)} nm, in place of R, G and B",
        kind=wavelengths_nm, nargs="+", metavar="NM", old=("wavelength",),
    )  # fmt: skip
    side: int | None = setting(
        None, f"pixels along a side of the point spread, an odd number (default: what holds the light, to {MOST_PX})",
        within=(3, MOST_PX), metavar="PIXELS",
    )  # fmt: skip
    plot: Path | None = cli.plot_path("draw the point spread over the picture")
    dask: str | None = cli.dask()
    state: cli.LensState = group("state of the lens", names=tuple(n for n in BY_LENSES if n != "f_number"), unset=True)

    def assumed(self) -> Any:
        """Return the values that a shot assumes, and the pitch of a pixel that follows from the film."""
        return super().assumed() | {"pixel_um": ("--pixel-um", self._pixel)}

    def _pixel(self) -> tuple[float, str]:
        pixel = float(f"{1000 * (self.film or self._film()[0])[0] / _ACROSS:.3g}")
        return pixel, f"{pixel:g}"

    def run(self) -> int:
        """Compute the parts that are missing, then write the file."""
        from neurolens.base.cluster import Dask

        write = self._writer()
        if self.side is not None and self.side % 2 == 0:
            self.refuse("--side", self.side, "an odd number of pixels")
        if self.wavelengths and self.channels != "rgb":
            self.refuse("--channels", self.channels, "none beside --wavelengths, which are channels of their own")
        began, shot = time.process_time(), self.state.shot()
        loaded = load_model(self.file) if is_model(self.file) else None
        model, tabled = (loaded.fitted, loaded.fitted.lens) if loaded else (None, read_any(self.file))
        lenses = {}
        for number in dict.fromkeys(_flat(self.f_number)) or (None,):
            lens = set_lens(tabled, replace(shot, f_number=number))
            lenses[number or float(f"{float(first_order(lens).f_number):.4g}")] = lens
        focus = focus_of(lens, shot)
        distances = tuple(dict.fromkeys(_flat(self.distance))) or (focus,)
        waves: Channels = {f"nm{nm:g}": (nm,) for nm in _flat(self.wavelengths)}
        waves = waves or channels_of(self.channels, lens)
        for nm in {nm for some in waves.values() for nm in some}:
            check_light(lens, nm)
        places = *places_of(self.film, self.grid), (0.0, 0.0)
        task = PsfTask(lens, focus, places, tuple(waves.values()), self.pixel_um / 1000, self.side, model)
        folder = self.out.with_name(f"{self.out.name}.parts")
        with cli.keeps(how_to_resume(folder)), Here() if self.dask is None else Dask(self.dask) as executor:
            arrays = library_of(lenses, distances, task, self.grid, executor, folder, self.progress())
        settings = {"film_mm": self.film, "pixel_um": self.pixel_um, "focus_m": focus, "state": self.state.given.given}
        if loaded:
            settings["model"] = {"file": self.file.name, "errors": loaded.card["errors"]}
        facts = about(lens, settings, waves)
        write(arrays, facts)
        forget_parts(folder, "[!.]*.npz")  # another run may be about to write one
        if self.plot is not None:
            from neurolens.optics.analysis.plots import plot_point_spread

            plot_point_spread(arrays, self.pixel_um, self.plot, lens.name, facts["channels"])
        count = int(np.prod(arrays["psf"].shape[:4]))
        lit = arrays["light"] > 0
        inside = float(arrays["inside"][lit].min(initial=1))
        found = Spread(
            file=str(self.out), lens=lens.lens_id, psfs=count, side_px=arrays["psf"].shape[-1], channels=list(waves),
            by_rays=int(arrays["by_rays"].sum()), plot=None if self.plot is None else str(self.plot),
            least_inside=inside, cpu_s_a_psf=None if self.dask else (time.process_time() - began) / count,
        )  # fmt: skip
        if not lit.all():
            dark = f"{count - int(lit.sum())} of {count} point spreads are dark: no light arrives"
            warn(f"{dark}, or the model knows no image there: trace the lens file") if loaded else note(dark)
        if inside < 0.9:
            note(f"at some places {1 - inside:.0%} of the light lies beyond {found.side_px} pixels")
        return self.answer(found)

    def _writer(self) -> Callable[[Arrays, Mapping[str, Any]], None]:
        """Return what writes the file, chosen before the work."""
        if (kind := self.out.suffix.lower()) == ".npz":
            return lambda arrays, facts: write_arrays(self.out, facts, arrays)
        if kind != ".exr":
            self.refuse("--output", self.out, "a file of the kind .npz or .exr")
        return lambda arrays, facts: write_channels(
            self.out, channels_of_exr(arrays, list(facts["channels"])), None, facts
        )


def _flat(values: tuple[tuple[float, ...], ...] | None) -> list[float]:
    return [value for some in values or () for value in some]


@dataclass(frozen=True, kw_only=True)
class Spread(Report):
    """A file of point spreads that was written, and what it took."""

    file: str
    lens: str
    psfs: int
    side_px: int
    channels: list[str]
    by_rays: int
    plot: str | None
    least_inside: float
    cpu_s_a_psf: float | None

    def text(self) -> str:
        """Return sentences on what the file holds and how it was made."""
        how = f"{self.by_rays} of them by rays, " if self.by_rays else ""
        how += f"{cli.number(self.cpu_s_a_psf, 2)} CPU s each" if self.cpu_s_a_psf else "made on a cluster"
        return (
            f"{self.file}: {self.psfs} point spread{'s' * (self.psfs > 1)} of {', '.join(self.channels)}, "
            f"{self.side_px} pixels a side, "
            f"{how}; at least {self.least_inside:.1%} of the light inside"
        )
