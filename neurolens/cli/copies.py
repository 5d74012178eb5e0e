"""`neurolens copies LENS --number N -o FOLDER`: copies of a lens as a workshop makes them, as lens files or models."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from neurolens.base.lensname import is_model
from neurolens.base.report import Report
from neurolens.base.settings import group, setting, whole, with_changes
from neurolens.cli import arguments as cli
from neurolens.cli.convert import write_checked
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.setting.copies import Tolerances, copies_of, copy_name, draws_of, elements_of


@dataclass(frozen=True, kw_only=True)
class Copies(cli.Reporting):
    """Draw copies of a lens at random, whose elements are decentred and tilted, and whose radii, thicknesses, gaps and
    indices are off, and write each as a lens file. Every figure is normally distributed about that of the lens, with
    half of its limit as the standard deviation, and cut off at the limit.

    Of a model (a polynomial of a round lens) the copies are models, whose cards state their errors. NAME-copies.onnx is
    the model with its derivatives by all of these figures; from it more copies are made without another fit."""

    epilog = """\
examples:
  neurolens copies laikin_double_gauss_50 --number 3 -o copies/
  neurolens copies laikin_double_gauss_50 --decentre 0.1 --tilt 0 --number 1 -o one/
  neurolens copies models/laikin_double_gauss_50.ols-60.onnx --number 3 -o copies/
  neurolens render grid --camera copies/laikin_double_gauss_50-001.toml --film 36x24 -o soft.exr"""
    kept = "files that were written are whole; the same command writes the same files"

    file: Path = cli.lens(models=True, positional=True)
    out: Path = cli.output_path("FOLDER", "folder of the files, which is made")
    number: int = setting(10, "copies", kind=whole(1, 10_000), metavar="N", common=True)
    seed: int = setting(0, "seed of the random draws", kind=whole(0))
    tolerances: Path | None = setting(
        None, "tolerances by the names of these options, as decentre_mm = 0.02 (default: the word default, for theirs)",
        metavar="FILE.toml", common=True,
    )  # fmt: skip
    limits: Tolerances = group("tolerances", unset=True)

    def _output(self, suffix: str | None = None) -> tuple[Path, str]:
        path = Path(f"{self.file.stem}-copies")
        return path, str(path)

    def run(self) -> int:
        """Write the files and tell where they are."""
        limits = with_changes(Tolerances.read(self.tolerances), self.limits)
        lens, written = self._models(limits) if is_model(self.file) else self._lenses(limits)
        self.out.mkdir(parents=True, exist_ok=True)
        files = [str(path) for path in written]
        return self.answer(Drawn(lens.name, self.seed, [[e[0], e[-1]] for e in elements_of(lens)], limits, files))

    def _path(self, stem: str, n: int, suffix: str) -> Path:
        return self.out / f"{stem}-{n:0{max(3, len(str(self.number)))}}{suffix}"

    def _lenses(self, limits: Tolerances) -> tuple[Lens, Iterator[Path]]:
        """Return the lens, and the paths of the lens files as they are written."""
        from neurolens.optics.readers.any_format import read_any

        lens = read_any(self.file)

        def written() -> Iterator[Path]:
            for n, copy in enumerate(copies_of(lens, limits, self.number, self.seed), 1):
                write_checked(copy, path := self._path(lens.lens_id, n, ".toml"))
                yield path

        return lens, written()

    def _models(self, limits: Tolerances) -> tuple[Lens, Iterator[Path]]:
        """Return the lens of a model, and the paths of the models as they are written."""
        from neurolens.models.copied import Perturbed, copy_of
        from neurolens.models.export import export_onnx
        from neurolens.models.file import as_stored, read_model
        from neurolens.models.perturbations import copy_errors, with_perturbations, with_reach

        stored = read_model(self.file)
        if stored.axes:
            self.refuse(str(self.file), "(a model of many states)", "a model of one state of a lens")
        (model,), stem = stored.nodes, self.file.stem.removesuffix("-copies")
        lens = model.lens

        def written() -> Iterator[Path]:
            ready = model
            if not isinstance(model.core, Perturbed):
                (ready,) = as_stored([with_perturbations(model, limits)])
                ready, errors = with_reach(ready, limits)
                export_onnx(ready, self.out / f"{stem}-copies.onnx", stored.card["errors"] | {"copies": errors})
            for n, (off, exact) in enumerate(draws_of(lens, limits, self.number, self.seed), 1):
                copy = copy_of(ready, off, copy_name(lens, n))
                yield export_onnx(copy, self._path(stem, n, ".onnx"), copy_errors(ready, copy, exact))

        return lens, written()


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
