"""`neurolens export`: source code of a model, a lens or a whole camera, or a model for what a scene fixes."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from neurolens import __version__
from neurolens.base.errors import InputError
from neurolens.base.files import atomic_path, atomic_write_text
from neurolens.base.lensname import is_model, split_kind
from neurolens.base.report import OPTIONAL, Report
from neurolens.base.settings import RANGE, changed, group, setting
from neurolens.cameras.build import make_camera
from neurolens.cameras.lenscamera import LensCamera
from neurolens.cameras.onnxlens import load_model
from neurolens.cameras.sampling import focus_m
from neurolens.cameras.shaders.blender_shader import shader_of
from neurolens.cameras.shaders.source import CAMERA_FRAME, camera_program, model_extras
from neurolens.cli import arguments as cli
from neurolens.graph.c import Extras
from neurolens.graph.shading import LANGUAGES
from neurolens.models import source
from neurolens.models.inverse import inverse_of
from neurolens.optics.lens.paraxial import film_z_mm
from neurolens.optics.lens.shot import BY_LENSES
from neurolens.optics.setting.focusing import best_focus_z_mm
from neurolens.optics.setting.states import set_lens

if TYPE_CHECKING:
    from neurolens.models.model import LensModel

_PARTS = ("ray", "transmittance", "stop", "vignetting", "path")
_CAMERA = "camera: what a whole camera is set to"
# Rays that measure the errors of an ONNX file with fixed inputs.
_HELD_OUT, _VIGNETTING = 20_000, 100_000
_FIXED = ("wavelengths", "film_z", "focus", "stop", "f_number")


@dataclass(frozen=True, kw_only=True)
class Export(cli.Reporting):
    """Write a model or a lens as source code, as C unless --to says otherwise: a self-contained C99 header (one
    function for a ray, one for arrays that compilers vectorise), a function in a shading language, or an ONNX file.

    The code has the model's domain guard, stop, rims, transmittance and status codes. A comment at the top holds the
    card; beside it stand constants, and the place of the film for a focus. For a model of a whole zoom (or of internal
    focus) the state is an argument. A lens file gives the exact lens, with the zoom, size and coating of the options.
    --to c-double keeps it within 1e-12 mm of the tracer. OSL is a camera of Blender's Cycles (4.5 and later), whose
    inputs are stop, focus, blades, zoom and more.

    With --whole-camera the code is the camera for one focus and stop: it takes a film point and two random numbers, and
    gives a weighted ray. The pupil's outline is a table in the file, or data beside it for most shading languages.

    Without the extra "train" (torch), models alone are written, whole, with nothing fixed."""

    epilog = """\
values fixed by a scene are folded into fewer operations (--fix, repeatable):
  wavelengths=450,550,650   one coefficient table per wavelength, chosen by the argument band (a single one:
                            no argument; an ONNX file takes one)
  film_z=59.2 | focus=2.0   film plane z in mm, or the object distance from the film in m that it focuses
  stop=4.5 | f_number=5.6   stop radius in mm, or the f-number it gives

examples:
  neurolens export laikin_double_gauss_50.ols-60 --to c -o gauss.h
  neurolens export models/NAME.onnx --to glsl -o lens.glsl --fix wavelengths=450,550,650 --fix focus=2
  neurolens export models/ZOOM-range.states-64.onnx --to c -o zoom.h      # any focal length: NAME_at(zoom_mm)
  neurolens export lenses/NAME.toml --to c -o exact.h                     # every surface
  neurolens export models/NAME.onnx --to c -o cam.h --whole-camera --focus 2 --f-number 2.8 --derivatives
  neurolens export models/NAME.onnx --to osl -o lens.osl                  # for Blender; lenses/NAME.toml: exact
  neurolens export models/NAME.onnx --to onnx -o a.onnx --inverse         # and a.stop.onnx, a.scene.onnx"""
    model: str = cli.lens(
        also="; or a file of neurolens plan; --to onnx takes models alone", models=True, cameras=True, positional=True,
        metavar="MODEL",
    )  # fmt: skip
    to: Literal[(*source.WRITERS, source.OSL, "onnx")] = setting(  # type: ignore[valid-type]
        "c", "form to write (default: c)"
    )
    out: Path = cli.output_path("FILE", "file to write")
    fix: tuple[str, ...] = setting(
        (), "fix an input, as focus=2 or wavelengths=450,550,650; repeatable", metavar="KEY=VALUE", common=True
    )
    only: tuple[str, str, str, str, str] = setting(
        _PARTS, f"parts to write, of {','.join(_PARTS)} (default: all; the domain guard is always there)",
        kind=cli.words_of(_PARTS, "ray"), metavar="PARTS",
    )  # fmt: skip
    name: str | None = setting(None, "name of the function (default: the lens's id)")
    derivatives: bool = setting(False, "add outputs for ray differentials (with --to onnx or --whole-camera)")
    inverse: bool = setting(
        False,
        "write the inverse maps, too (film and stop point to ray; scene ray to film), fitted and checked "
        "(with --to onnx)",
    )
    whole_camera: bool = setting(
        False, "write the whole camera, from film to scene", old=("camera",), title=_CAMERA, common=True
    )
    film: tuple[float, float] = cli.film(title=_CAMERA)
    state: cli.LensState = group(_CAMERA, names={*BY_LENSES, *LensCamera.takes}, unset=True)

    def assumed(self) -> Any:
        """Assume a film for a whole camera alone, and the suffix of the language."""
        suffix = {"c": ".h", "c-double": ".h", "cuda": ".cuh", "vex": ".h"}.get(self.to, f".{self.to}")
        film = {"film": super().assumed()["film"]} if self.whole_camera else {}
        return film | {"out": ("--output", lambda: self._output(suffix))}

    def run(self) -> int:
        """Check the options, then load, fix and write."""
        file, fixed = Path(split_kind(self.model)[1]), _fixed(self.fix)
        if file.is_dir():
            raise InputError(file, "file", "(a folder)", "a model or a lens file, as FOLDER/models/NAME.onnx")
        whole = set(self.only) == set(_PARTS) and not fixed
        if self.to == "onnx" and (self.name is not None or set(self.only) != set(_PARTS)):
            self.refuse("--only, --name", "(with --to onnx)", "neither: an ONNX file is whole")
        if self.to != "onnx" and ((self.derivatives and not self.whole_camera) or self.inverse):
            self.refuse("--derivatives, --inverse", f"(with --to {self.to})", "--to onnx")
        if self.name is not None:
            source.checked_name(self.to, "", self.name)
        if self.to == "osl":
            if not whole or self.whole_camera or set(changed(self.state, unset=True)) - {"--zoom"}:
                options = "--fix, --only, --whole-camera, --focus, --f-number, ..."
                expected = "none of them: stop and focus are inputs of the shader, which is a whole camera"
                self.refuse(options, "(with --to osl)", expected)
            write: Callable[[Path], Exported] = self._write_osl
        elif self.whole_camera or not is_model(file):
            if self.to == "onnx" or not whole:
                what = "(a whole camera)" if self.whole_camera else "(a lens file)"
                self.refuse(str(file), what, "a model, or source code (--to c, glsl ...) without --fix, --only")
            write = self._write_camera if self.whole_camera else self._write_lens
            size = {"--focal-length", "--field"} if self.state.given.zoom != RANGE else set()
            self._check_state(size | {"--zoom", "--coating"}, "focus and stop are arguments of the function")
        else:
            write = partial(self._write_model, fixed=fixed)
            self._check_state(set(), "--fix sets focus and stop, the rest is the model's own")
        return self.answer(write(file))

    def _check_state(self, taken: Collection[str], said: str) -> None:
        """Refuse options of a lens's state that code without a film does not follow."""
        if not self.whole_camera and (left := sorted(changed(self.state, unset=True).keys() - taken)):
            self.refuse(", ".join(left), "(without --whole-camera)", f"left out: {said}")

    def _exported(self, **figures: Any) -> Exported:
        return Exported(self.out, self.to, self.out.stat().st_size, **figures)

    def _write_model(self, file: Path, fixed: dict[str, list[float]]) -> Exported:
        """Write a model as source code or ONNX, with some of its inputs fixed."""
        loaded = load_model(file)
        if loaded.axes and (self.to == "onnx" or fixed or set(self.only) != set(_PARTS)):
            expected = "source code (--to c, glsl ...), without --fix, --only"
            self.refuse(str(file), "(a model of many states)", expected)
        fix, models = _fixed_model(fixed, loaded.fitted) if fixed else (source.Fix(), loaded.file.nodes)
        if self.to == "onnx":
            _write_onnx_model(models, self.out, None if fixed else loaded.card, self.derivatives)
            return self._exported(inverse=_write_inverse(models[0], self.out) if self.inverse else None)
        kept = source.Parts(*(name in self.only for name in _PARTS[1:]))
        stop = fix.stop_radius_mm if kept.vignetting else models[0].domain.stop_radius_mm
        extras, notes = model_extras(loaded, film=fix.film_z_mm is None, stop_mm=stop)
        written = source.export_source(
            models, self.out, self.to, loaded.card, parts=kept, fix=fix, name=self.name, extras=extras, notes=notes
        )
        return self._source(written, [m.domain.wavelength_nm[0] for m in models])

    def _write_lens(self, file: Path) -> Exported:
        """Write the exact lens of a file as source code."""
        from neurolens.cameras.shaders.lens_source import write_lens

        return self._source(
            write_lens(file, self.out, self.to, self.state.shot(), name=self.name, progress=self.progress())
        )

    def _write_osl(self, file: Path) -> Exported:
        """Write a camera for Cycles."""
        shader = shader_of(file, zoom=self.state.given.zoom, name=self.name, quiet=self.quiet)
        atomic_write_text(self.out, shader.text)
        return self._exported(
            function=shader.name, inputs=shader.parameters, operations_per_ray=shader.operations, passing=shader.passing
        )

    def _write_camera(self, file: Path) -> Exported:
        """Write the whole camera of a model or a lens file as source code."""
        shot = self.state.shot(self.film, runtime="onnxruntime")
        camera: Any = make_camera(file, shot, self.progress())
        facts = camera.settings
        lens = facts["lens"] if "lens" in facts else facts["card"]["lens"]
        name = source.checked_name(self.to, f"{lens['id']}_camera", self.name)
        graph = camera.lens_graph()
        own_table = self.to not in LANGUAGES or LANGUAGES[self.to].own_table
        program = camera_program(camera.film, graph, self.derivatives, own_table=own_table)
        numbers = {key: facts[key] for key in ("efl_mm", "f_number", "film_z_mm", "stop_radius_mm")}
        constants = {
            "film_width_mm": self.film[0],
            "film_height_mm": self.film[1],
            **numbers,
            "pupil_z_mm": camera.film.outline.pupil_z_mm,
            "exposure": camera.film.exposure,
        }
        told = ", ".join(f"{key} {value:.6g}" for key, value in constants.items())
        comment = [
            f"{lens['name']}: a whole camera, written by neurolens {__version__} from {file.name}.",
            f"Lens data: sha256 {str(lens.get('sha256'))[:16]}. Focus {focus_m(camera, shot):g} m; {told}.",
            CAMERA_FRAME,
        ]
        if not own_table:
            table, beside = camera.film.outline.table, self.out.with_name(f"{self.out.name}.outline.f32")
            with atomic_path(beside) as temporary:
                temporary.write_bytes(table.astype("<f4").tobytes())
            size = f"{table.shape[1]} wide, {len(table)} high"
            comment.append(f"outline: one float a texel, {size}: {beside.name}, little-endian, line by line.")
        return self._source(
            source.write_program(program, self.out, self.to, name, source.lines_of(comment), Extras(constants))
        )

    def _source(self, written: source.Written, bands_nm: Sequence[float] = ()) -> Exported:
        """Return the answer of source code."""
        s = written.signature
        return self._exported(
            function=s.name, inputs=s.inputs, state=s.state, outputs=[*s.outputs, "status"],
            bands_nm=bands_nm if s.bands > 1 else [], operations_per_ray=written.operations,
        )  # fmt: skip


@dataclass(frozen=True)
class Exported(Report):
    """A model, lens or camera as another program takes it.

    Attributes:
        bands_nm: the wavelengths of a function of several bands.
        passing: of a shader, the share of its samples that pass.
        inverse: the files of both inverse maps, with the share of rays that each finds.
    """

    file: Path
    to: str
    bytes: int
    function: str | None = field(default=None, metadata=OPTIONAL)
    inputs: Sequence[str] | None = field(default=None, metadata=OPTIONAL)
    state: Sequence[str] | None = field(default=None, metadata=OPTIONAL)
    outputs: Sequence[str] | None = field(default=None, metadata=OPTIONAL)
    bands_nm: Sequence[float] | None = field(default=None, metadata=OPTIONAL)
    operations_per_ray: int | None = field(default=None, metadata=OPTIONAL)
    passing: Mapping[float, float] | None = field(default=None, metadata=OPTIONAL)
    inverse: Mapping[str, Mapping[str, Any]] | None = field(default=None, metadata=OPTIONAL)

    def text(self) -> str:
        """Return the files."""
        maps = (self.inverse or {}).values()
        lines = [f"{m['file']}: finds {m['converged']:.3%} of the model's rays in three steps" for m in maps]
        return "\n".join([str(self.file), *lines])


def _fixed(texts: Sequence[str]) -> dict[str, list[float]]:
    """Return the numbers of --fix by name."""
    fixed: dict[str, list[float]] = {}
    for text in texts:
        key, _, value = text.partition("=")
        numbers = cli.floats(value)
        good = bool(numbers) and all(v > 0 and (key == "focus" or math.isfinite(v)) for v in numbers)
        if key not in _FIXED or key in fixed or not good or (key != "wavelengths" and len(numbers) > 1):
            expected = f"KEY=NUMBER with KEY of {', '.join(_FIXED)} (wavelengths: a list), each once, above 0"
            raise InputError("neurolens export", "--fix", text, expected)
        fixed[key] = numbers
    for pair in (("film_z", "focus"), ("stop", "f_number")):
        if all(key in fixed for key in pair):
            raise InputError("neurolens export", "--fix", f"(both {' and '.join(pair)})", "one of them")
    return fixed


def _fixed_model(fixed: dict[str, list[float]], model: LensModel) -> tuple[source.Fix, tuple[LensModel, ...]]:
    """Return the quantities that --fix sets, and the models in which they are fixed."""
    film_z = fixed.get("film_z", [None])[0]
    stop = fixed.get("stop", [None])[0]
    if "f_number" in fixed:
        stop = set_lens(model.lens, f_number=fixed["f_number"][0]).stop_radius_mm
    if "focus" in fixed:
        focus_m, lens = fixed["focus"][0], model.lens if stop is None else model.lens.with_stop_radius(stop)
        source.Fix(film_z_mm=film_z_mm(lens, focus_m)).check(model.domain)
        near, far = model.domain.film_z_mm
        film_z = min(max(best_focus_z_mm(lens, focus_m), near), far)
    fix = source.Fix(tuple(fixed.get("wavelengths", ())), film_z, stop)
    return fix, source.fixed_models(model, fix)


def _write_onnx_model(models: tuple[LensModel, ...], out: Path, card: dict[str, Any] | None, derivatives: bool) -> None:
    """Write a model as ONNX, with the errors of its card, or with new ones where something was fixed (None)."""
    from neurolens.models.export import export_onnx
    from neurolens.models.pairs import passing_rays
    from neurolens.studies.measure import FRESH, fresh_rays, measure_on

    if len(models) > 1:
        wavelengths = [m.domain.wavelength_nm[0] for m in models]
        raise InputError("neurolens export", "--fix wavelengths", wavelengths, "one wavelength for an ONNX file")
    model = models[0]
    if card is not None:
        export_onnx(model, out, card["errors"], derivatives=derivatives)
        return
    seed = int(model.settings.get("rays_seed") or 0) + FRESH
    held_out = passing_rays(model.lens, model.domain, _HELD_OUT, seed)
    with atomic_path(out) as measured:  # a file without its errors never has the final name
        export_onnx(model, measured, {})
        rays = fresh_rays(model.lens, model.domain, held_out, count=_VIGNETTING, seed=seed + 1)
        export_onnx(model, measured, measure_on(rays, load_model(measured)), derivatives=derivatives)


def _write_inverse(model: LensModel, out: Path) -> Mapping[str, Mapping[str, float | str]]:
    """Write both inverse maps beside the model's file; return their files and the share of rays that each finds."""
    from neurolens.models.export import export_inverse

    return export_inverse(inverse_of(model), out, load_model(out).card["errors"])
