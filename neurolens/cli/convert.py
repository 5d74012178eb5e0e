"""`neurolens convert FILE -o lens.toml`: a lens file of another program in our own format; and `neurolens glass`."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from neurolens.base.errors import InputError, pip_install, warned
from neurolens.base.files import atomic_path
from neurolens.base.lensname import lens_id_of
from neurolens.base.report import PART, Report
from neurolens.base.settings import group, setting, setting_of
from neurolens.cli import arguments as cli
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.assemble import first_order
from neurolens.optics.readers.source import ReadOptions

if TYPE_CHECKING:
    from neurolens.optics.lens.glass import Glass as Named
    from neurolens.optics.lens.paraxial import FirstOrderLight
    from neurolens.optics.lens.prescription import Lens


@dataclass(frozen=True, kw_only=True)
class Convert(cli.Reporting):
    """Read a lens file of any format, as of another program, and write it as a lens file of neurolens (.toml).

    Formats: Zemax (.zmx), CODE V (.seq), OSLO (.len, the simple ones), texts of the Optical Bench (.txt), FlareSim
    (.lens), the TOML of the Blender add-on Physical Camera, plain tables of four
    columns as in pbrt and appleseed (.dat, .txt), and JSON (our own, DeepLens, ISET). The content decides.
    What changes rays and is not supported is an error that names the line; what was left out, computed,
    assumed or doubtful is printed as a warning and kept in the notes of the new file. Rims that a file does
    not give, and the check of the lens against its own statements, are traced: they need the extra "train" (torch)."""

    epilog = """\
examples:
  neurolens convert leica_summilux_50mm_f1_4 --focal-length 85 -o summilux_85.toml
  neurolens convert experiments/fuzz_seeds/lens.zmx -o my_lens.toml
  neurolens convert wide.22mm.dat -o wide.toml --name "Wide angle 22 mm" --source "Smith p. 360"
  neurolens convert triplet.seq -o triplet.toml --half-field 20 --json"""
    kept = "only a finished lens file is written"

    file: Path = cli.lens(positional=True, metavar="FILE")
    out: Path = cli.output_path("OUT.toml", "lens file to write")
    force: bool = setting(False, "replace an existing file", common=True)
    focal_length_mm: float | None = setting_of(Shot, "focal_length_mm")
    unsaid: ReadOptions = group("what the file does not say")

    def _output(self, suffix: str | None = None) -> tuple[Path, str]:
        path = Path(f"{lens_id_of(self.file)}.toml")
        return path, str(path)

    def run(self) -> int:
        """Convert one file and print what was read."""
        if self.out.exists() and not self.force:
            raise InputError(self.out, "--output", "(an existing file)", "a new file, or --force to replace it")
        from neurolens.optics.readers.any_format import read_any

        with warned(self.file) as read:
            lens = read_any(self.file, self.unsaid)
        if read:  # the file keeps what else its source had, and what was assumed
            lens = replace(lens, notes="\n".join(filter(None, (lens.notes, "As converted by neurolens:", *read))))
        if self.focal_length_mm is not None:  # then it is no product
            lens = lens.scaled(self.focal_length_mm / first_order(lens).efl_mm)
            lens = replace(lens, name=f"{lens.name}, at {self.focal_length_mm:g} mm", believed_to_be="", measured=())
        write_checked(lens, self.out)
        return self.answer(_converted(lens, [*read, *_doubts(lens)], self.file, self.out))


def _doubts(lens: Lens) -> list[str]:
    """Return contradictions between the lens and statements of its file, as sentences."""
    if find_spec("torch") is None:
        return [f"the lens is not checked against its file's statements: that needs torch ({pip_install('train')})"]
    from neurolens.optics.setting.check import check_lens, doubts

    try:
        with warned():
            return doubts(check_lens(lens))
    except InputError as error:
        return [f"the lens cannot be checked: {error.field}: expected {error.expected}"]


def write_checked(lens: Lens, path: Path) -> None:
    """Write a lens file, and keep it only if it reads back as the same lens.

    Raises:
        InputError: it does not; the error names the file to be written.
    """
    from neurolens.optics.readers.lensfile import format_lens, read_lens

    with atomic_path(path) as temporary:
        temporary.write_text(format_lens(lens), encoding="utf-8")
        try:
            with warned():  # the reader of the other format has warned already
                back = read_lens(temporary)
        except InputError as error:
            raise InputError(path, error.field, error.value, error.expected) from None
        if replace(back, path=lens.path) != lens:
            raise InputError(path, "content", "(another lens when read back)", "the lens that was read")


@dataclass(frozen=True, kw_only=True)
class Converted(Report):
    """Figures of a converted lens in mm, and what its reader and its check said of it."""

    file: str
    output: str
    name: str
    source: str
    surfaces: int
    stop_surface: int
    light: FirstOrderLight = field(metadata=PART)
    efl_mm: float
    efl_x_mm: float | None
    back_focus_mm: float
    film_gap_mm: float
    f_number: float
    stated_f_number: float
    rims: str
    configurations: list[str]
    warnings: list[str]

    def text(self) -> str:
        """Return a line for each figure."""
        efl, back, gap = (f"{cli.number(v, 6)} mm" for v in (self.efl_mm, self.back_focus_mm, self.film_gap_mm))
        across = "" if self.efl_x_mm is None else f" (in y; {cli.number(self.efl_x_mm, 6)} mm in x)"
        lines = [
            self.name,
            self.source,
            f"surfaces      {self.surfaces}, stop on {self.stop_surface}; rims: {self.rims}",
            f"focal length  {efl}{across}",
            f"back focus    {back}; film tabled at {gap}",
            f"f-number      f/{cli.number(self.f_number)} by its stop, named f/{cli.number(self.stated_f_number)}",
            f"wavelength    {', '.join(cli.first_order_light(self.light))}",
            *([f"states        {', '.join(self.configurations)}"] if self.configurations else ()),
            *(f"warning: {text}" for text in self.warnings),
            f"written to {self.output}",
        ]
        return "\n".join(lines)


def _converted(lens: Lens, notes: list[str], file: Path, out: Path) -> Converted:
    """Return the figures of a lens that was converted from a file to another."""
    from neurolens.optics.lens import paraxial

    data, efl_mm = first_order(lens), {"x": math.inf, "y": math.inf}
    axis: Literal["x", "y"]
    for axis in ("x", "y"):
        with suppress(InputError):  # a cylinder has no power in one of its planes
            efl_mm[axis] = paraxial.first_order(lens, meridian=axis).efl_mm
    return Converted(
        file=str(file),
        output=str(out),
        name=lens.name,
        source=lens.source,
        surfaces=len(lens.surfaces),
        stop_surface=lens.stop_index,
        light=paraxial.light_of(lens),
        efl_mm=efl_mm["y"],
        efl_x_mm=efl_mm["x"] if lens.anamorphic else None,
        back_focus_mm=data.back_focus_mm,
        film_gap_mm=float(lens.surfaces[-1].thickness_mm),
        f_number=data.f_number,
        stated_f_number=lens.f_number,
        rims=lens.rims,
        configurations=[c.name for c in lens.configurations],
        warnings=notes,
    )


_NEAR_N_D, _NEAR_V_D = 0.01, 2.0  # a glass farther from a code than this has nothing to do with it
_TRANSMITTED_NM = (400.0, 450.0, 550.0, 700.0)
_PLATE_MM = 10.0


@dataclass(frozen=True, kw_only=True)
class Glass(cli.Reporting):
    """Look glasses up in the catalogue that ships with neurolens. It prints their index, their Abbe number, the
    wavelengths for which the maker states the index, and what 10 mm transmit inside (without reflections). A name finds
    the glass of every maker that uses it; the first of these is the one that a lens file gets. A six-digit code
    (517642) finds the nearest glasses, up to 0.01 in n_d and 2 in V_d away.
    """

    epilog = """\
examples:
  neurolens glass N-BK7 "F2 (CDGM)" PMMA
  neurolens glass 517642 --json"""

    name: tuple[str, ...] = setting(
        ..., '"N-BK7", "Schott:N-BK7", or a code such as 517642', positional=True, metavar="NAME", nargs="+"
    )

    def run(self) -> int:
        """Print the requested glasses."""
        from neurolens.optics.lens import glass as catalogue

        glasses: list[catalogue.Glass] = []
        for name in self.name:
            if figures := catalogue.figures_of_code(re.sub("[./]", "", name)):
                n_d, V_d = figures
                first, *others = catalogue.by_code(name, 6)
                found = [g for g in (first, *others) if abs(g.n_d - n_d) <= _NEAR_N_D and abs(g.V_d - V_d) <= _NEAR_V_D]
                if not found:
                    near = f"the nearest is {first} (n_d {first.n_d:.4f}, V_d {first.V_d:.1f})"
                    expected = f"a code within {_NEAR_N_D:g} in n_d and {_NEAR_V_D:g} in V_d of a glass; {near}"
                    raise InputError("argument", "NAME", name, expected)
                glasses += found
            else:
                catalogue.find(name, "argument", "NAME")
                glasses += catalogue.same_name(name)
        return self.answer(Glasses([GlassFigures.of(glass) for glass in dict.fromkeys(glasses)]))


@dataclass(frozen=True)
class GlassFigures:
    """Figures of one glass; internal transmittance is by wavelength in nm, empty where the source has none."""

    glass: str
    n_d: float
    V_d: float
    form: str
    coefficients: Sequence[float]
    range_nm: Sequence[float]
    internal_transmittance_10mm: Mapping[str, float]

    @staticmethod
    def of(glass: Named) -> GlassFigures:
        """Return the figures of a glass of a catalogue."""
        waves = _TRANSMITTED_NM if glass.absorption else ()
        through = {f"{nm:.0f}": math.exp(-_PLATE_MM * glass.absorption_per_mm(nm)) for nm in waves}
        range_nm = [1000 * v for v in glass.range_um]
        return GlassFigures(str(glass), glass.n_d, glass.V_d, glass.form, glass.coefficients, range_nm, through)

    def cells(self) -> list[str]:
        """Return the row of a table."""
        through = [self.internal_transmittance_10mm.get(f"{nm:.0f}") for nm in _TRANSMITTED_NM]
        return [self.glass, f"{self.n_d:.6f}", f"{self.V_d:.2f}", *map(cli.number, [*self.range_nm, *through])]


@dataclass(frozen=True)
class Glasses(Report):
    """The figures of the glasses that a command names."""

    glasses: Sequence[GlassFigures]

    def text(self) -> str:
        """Return a row for each glass."""
        header = ("glass", "n_d", "V_d", "nm from", "to", *(f"10 mm at {nm:.0f} nm" for nm in _TRANSMITTED_NM))
        return cli.table(header, [glass.cells() for glass in self.glasses])
