"""`neurolens copies LENS --number N -o FOLDER`: copies of a lens as a workshop makes them, as lens files."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from neurolens.base.report import Report
from neurolens.base.settings import group, read_config, setting, whole, with_changes
from neurolens.cli import arguments as cli
from neurolens.cli.convert import write_checked
from neurolens.optics.setting.copies import Tolerances, copies_of, elements_of


@dataclass(frozen=True, kw_only=True)
class Copies(cli.Reporting):
    """Draw copies of a lens at random, whose elements are decentred and tilted, and whose radii, thicknesses, gaps and
    indices are off, and write each as a lens file. Every figure is normally distributed about that of the lens, with
    half of its limit as the standard deviation, and cut off at the limit."""

    epilog = """\
examples:
  neurolens copies laikin_double_gauss_50 --number 3 -o copies/
  neurolens copies laikin_double_gauss_50 --decentre 0.1 --tilt 0 --number 1 -o one/
  neurolens render grid --camera copies/laikin_double_gauss_50-001.toml --film 36x24 -o soft.exr"""
    kept = "lens files that were written are whole; the same command writes the same files"

    file: Path = cli.lens(positional=True)
    out: Path = cli.output_path("FOLDER", "folder of the lens files, which is made")
    number: int = setting(10, "copies", kind=whole(1, 10_000), metavar="N", common=True)
    seed: int = setting(0, "of the random draws", kind=whole(0))
    tolerances: Path | None = setting(
        None, "tolerances by the names of these options (decentre_mm = 0.02), instead of their defaults",
        metavar="FILE.toml", common=True,
    )  # fmt: skip
    limits: Tolerances = group("tolerances", unset=True)

    def _output(self, suffix: str | None = None) -> tuple[Path, str]:
        path = Path(f"{self.file.stem}-copies")
        return path, str(path)

    def run(self) -> int:
        """Write the files and tell where they are."""
        from neurolens.optics.readers.any_format import read_any

        lens = read_any(self.file)
        given = Tolerances() if self.tolerances is None else read_config(Tolerances, self.tolerances)
        limits = with_changes(given, self.limits)
        self.out.mkdir(parents=True, exist_ok=True)
        digits, files = max(3, len(str(self.number))), list[str]()
        for n, copy in enumerate(copies_of(lens, limits, self.number, self.seed), 1):
            write_checked(copy, path := self.out / f"{lens.lens_id}-{n:0{digits}}.toml")
            files.append(str(path))
        spans = [[e[0], e[-1]] for e in elements_of(lens)]
        return self.answer(Drawn(lens.name, self.seed, spans, limits, files))


@dataclass(frozen=True)
class Drawn(Report):
    """Copies that were drawn: the first and last surface of each element, what limits them, and their files."""

    lens: str
    seed: int
    elements: list[list[int]]
    tolerances: Tolerances
    files: list[str]

    def text(self) -> str:
        """Elements, limits and the files, from the first to the last."""
        spans = ", ".join(f"{first}-{last}" for first, last in self.elements)
        limits = ", ".join(f"{name} {value:g}" for name, value in asdict(self.tolerances).items())
        written = self.files[0] if len(self.files) == 1 else f"{self.files[0]} to {self.files[-1]}"
        return f"{self.lens}: elements of surfaces {spans}\nwithin {limits}\n{written}"
