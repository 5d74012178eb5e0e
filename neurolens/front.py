"""The Python front, `import neurolens as nl`: a lens as an object, and commands as calls.

A call takes what its command takes, by the same names with their units, and returns what --json prints.
"""

from __future__ import annotations

import inspect
import math
import os
from base64 import b64encode
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from neurolens.base import lensname
from neurolens.base.errors import InputError, installed, one_line
from neurolens.base.files import TemporaryFolder
from neurolens.base.progress import Progress
from neurolens.base.settings import setting_of
from neurolens.cameras.onnxlens import LensRays, OnnxLens
from neurolens.cli import arguments as cli, command
from neurolens.cli.calls import Answer, call, command_of, parameters, signature_of
from neurolens.models.file import read_model
from neurolens.optics.lens.shot import Shot
from neurolens.optics.setting.states import focus_of, set_lens
from neurolens.programs.hosts import rays

if TYPE_CHECKING:
    from neurolens.cameras.contract import Camera as MadeCamera
    from neurolens.optics.lens.prescription import Lens as Prescription
    from neurolens.optics.trace.rays import Towards

_LENS = "laikin_double_gauss_50"
EXAMPLES = {  # of each name: its docstring shows it, and a test runs it
    "find": "nl.find('double gauss')",
    "lens": f"nl.lens('{_LENS}').set(focus_m=2, f_number=4)",
    "camera": f"nl.camera('{_LENS}.ols-36', film=(36, 24), focus_m=2)",
    "load": f"nl.load('{_LENS}.ols-36').card['lens']['efl_mm']",
    "fit": f"nl.fit('{_LENS}', within_um=5, output='gauss')",
    "analyse": f"nl.analyse('{_LENS}', ['spots', 'distortion'], f_number=5.6)",
    "verify": "nl.verify('sony_sonnar_55', output='sonnar.png')",
    "plan": f"nl.plan('garden', '{_LENS}', budget='0.25px', no_fit=True)",
    "render": f"nl.render('room', '{_LENS}.ols-36', width=48, samples=4, output='room.exr')",
    "flare": f"nl.flare('{_LENS}', light=(15, 8), width=96, quick=True, output='flare.exr')",
    "defocus": f"nl.defocus('plate.exr', '{_LENS}.ols-36', film=(36, 24), focus_m=2, output='blurred.exr')",
    "bokeh": f"nl.bokeh('{_LENS}.ols-36', width=480, film=(36, 24), focus_m=2, distance=[1, 5], output='bokeh')",
    "convert": f"nl.convert('{_LENS}', focal_length_mm=85, output='gauss_85.toml')",
    "copies": f"nl.copies('{_LENS}', decentre_mm=0.1, number=2, output='copies')",
    "handover": f"nl.handover('{_LENS}.ols-36', width=96, film=(36, 20.25), focus_m=2, output='shot')",
    "stmap": f"nl.stmap('{_LENS}.ols-36', width=480, film=(36, 20.25), focus_m=2, output='shot')",
    "projection": f"nl.projection('{_LENS}.ols-36', width=480, film=(36, 24), projection='opencv')",
    "psf": f"nl.psf('{_LENS}', film=(36, 24), pixel_um=6, grid=(3, 1), f_number=[4, 8], output='gauss.npz')",
    "rays": f"nl.rays('{_LENS}.ols-36', (36, 24), width=48, focus_m=2, samples=4)['direction'].shape",
    "export": f"nl.export('{_LENS}.ols-36', to='c', output='lens.h')",
    "train": f"nl.train(lens='{_LENS}', within='5um', rounds=0, output='gauss')",
}


_ANSWERS = """\
Returns:
    a dictionary, the object that --json prints, whose keys carry their unit. Its .text is what the command prints, and
    its .rgb the picture that was written, linear [H, W, 3].

Raises:
    InputError: a value, a name or a file is not what is expected; the message says what is.
    ModelError: a model's file cannot be trusted.

"""


class Call:
    """A function of the front, which runs a command."""

    def __init__(self, name: str, run: Callable[..., Any], doc: str, signature: inspect.Signature) -> None:
        self._run, self.__name__, self.__doc__, self.__signature__ = run, name, doc, signature

    def __call__(self, *given: Any, **named: Any) -> Any:
        with installed():
            return self._run(*given, **named)

    def __repr__(self) -> str:
        return f"neurolens.{self.__name__}{self.__signature__}"


def of(name: str) -> Call:
    """Make the function of the front that has this name; its docstring has the parameters and an example."""
    example = f"Example::\n\n    >>> import neurolens as nl\n    >>> {EXAMPLES[name]}\n"
    others: dict[str, Callable[..., Any]] = {"load": load, "fit": fit, "rays": rays}
    if (own := others.get(name)) is not None:
        return Call(
            name, _rays if name == "rays" else own, f"{inspect.getdoc(own)}\n\n{example}", inspect.signature(own)
        )
    chosen = {"lens": Lens, "camera": Camera}.get(name)
    reads = chosen.reads if chosen else command(name)
    listed = "\n".join(f"    {key}: {action.help}" for key, action in parameters(reads)[1].items())
    doc = f"{inspect.getdoc(chosen or reads)}\n\nParameters:\n{listed}\n\n{'' if chosen else _ANSWERS}{example}"
    return Call(name, chosen.make if chosen else partial(run_command, reads), doc, signature_of(reads))


@installed()
def run_command(cls: type[cli.Command], *given: Any, **named: Any) -> Answer:
    """Run a command; a lens or camera among the values brings its settings."""
    for value in (*given, *named.values()):
        for one in value if isinstance(value, list) else [value]:
            named = {**_settings(one), **named}
    return call(cls, given, named)


def _settings(value: Any) -> Mapping[str, Any]:
    return value.settings if isinstance(value, _Chosen) else {}


def _rays(*given: Any, **named: Any) -> dict[str, Any]:
    """Return rays with the settings that a lens or camera brings, where the call itself gives none of the same name."""
    brought = getattr(given[0] if given else named.get("camera"), "of_shot", {})
    return rays(*given, **{k: v for k, v in brought.items() if k != "film" or len(given) < 2} | named)


@dataclass(frozen=True, repr=False)
class _Chosen:
    """A name and its settings; every call that takes a lens takes both from it."""

    name: str
    settings: Mapping[str, Any]
    reads: ClassVar[type[cli.Command]]  # the command whose parser reads the settings

    @classmethod
    def make(cls, name: str | os.PathLike[str], **settings: Any) -> Self:
        """Make one from a name, or from another one and its settings; mistakes are raised here."""
        settings = {**_settings(name), **settings}
        return cls(os.fspath(name), {key: value for key, value in settings.items() if value is not None})

    def __post_init__(self) -> None:
        _ = self._read

    def __fspath__(self) -> str:
        return self.name

    def __repr__(self) -> str:
        settings = "".join(f", {key}={value!r}" for key, value in self.settings.items())
        return f"{self.reads.called}({self.name!r}{settings})"

    @cached_property
    def _read(self) -> Any:
        return command_of(self.reads, (self.name,), self.settings)

    @property
    def of_shot(self) -> dict[str, Any]:
        """The settings that are given, by the names of `Shot`; a camera's film is named "film"."""
        return {k: v for k, v in vars(self._read).items() if k == "film"} | self._read.state.shot().given

    def set(self, **settings: Any) -> Self:
        """Return the same with further settings; None takes one away. Raises InputError for one that cannot be."""
        return self.make(self, **settings)


@dataclass(frozen=True, kw_only=True)
class _ReadLens(cli.Command):
    """Holds what `nl.lens` takes."""

    called: ClassVar[str] = "nl.lens"
    file: Path = cli.lens(positional=True)
    glass: tuple[Path, ...] = setting_of(cli.Reporting, "glass", ())
    state: cli.LensState = cli.lens_state()


@dataclass(frozen=True, kw_only=True)
class _ReadCamera(cli.Command):
    """Holds what `nl.camera` takes."""

    called: ClassVar[str] = "nl.camera"
    camera: str = cli.lens(models=True, cameras=True, positional=True)
    film: tuple[float, float] = cli.film()
    state: cli.LensState = cli.camera_state()


class Lens(_Chosen):
    """A lens by its name or file, zoomed, stopped down and focused; notebooks draw it. `trace`, `analyse`, `describe`
    and `draw` need the extra "train" (torch).

    Raises:
        InputError: there is no such lens (the error names the nearest), or it cannot have a setting.
    """

    reads = _ReadLens

    def __post_init__(self) -> None:
        _ = self.prescription

    @cached_property
    def _tabled(self) -> Prescription:
        from neurolens.optics.readers.any_format import read_any

        with self._glasses():
            return read_any(self._read.file)

    def _glasses(self) -> AbstractContextManager[None]:
        """Return a block in which the lens's own glasses are known."""
        return cli.more_glasses(self._read.glass)

    @cached_property
    def prescription(self) -> Prescription:
        """The surfaces, gaps and glasses of the lens in this state."""
        tabled = self._tabled
        with self._glasses():
            return set_lens(tabled, self._read.state.shot())

    @cached_property
    def _figures(self) -> Mapping[str, float]:
        from neurolens.cameras.exact import state_of

        lens = self.prescription
        with self._glasses():
            return state_of(lens, Shot.wavelength_nm)

    @property
    def focal_length_mm(self) -> float:
        """The focal length at the d line; of an anamorphic lens, that along y."""
        return self._figures["effective_focal_length_mm"]

    @property
    def f_number(self) -> float:
        """The focal length over the diameter of the entrance pupil."""
        return self._figures["f_number"]

    @property
    def t_stop(self) -> float:
        """The f-number of a lens without loss that sends as much light of the d line to the axis."""
        return self._figures["t_stop"]

    @property
    def focus_m(self) -> float:
        """The distance from the film to the object in focus, or inf."""
        lens = self.prescription
        with self._glasses():
            return focus_of(lens, self._read.state.shot())

    @installed()
    def trace(self, rays: ArrayLike, wavelength_nm: ArrayLike | None = None, towards: Towards = "scene") -> LensRays:
        """Trace rays through every surface; the answer has the form of a model's answer, in float64.

        Args:
            rays: [6, N], x, y, z in mm and the unit direction, lens frame.
            wavelength_nm: a number, or [N], one for each ray; None takes the reference wavelength of the lens, for most
                lenses the d line.
            towards: "scene" for camera rays, which travel towards -z, or "film".

        Raises:
            InputError: an array of another shape, or what `neurolens.optics.trace.rays.trace` raises.
        """
        import torch

        from neurolens.optics.trace.rays import trace
        from neurolens.optics.trace.surfaces import Rays

        if (array := np.array(rays, np.float64)).ndim != 2 or len(array) != 6:
            raise InputError("Lens.trace", "rays", f"({array.shape})", "an array (6, N)")
        lens, start, stop = self.prescription, Rays(*torch.from_numpy(array)), self.prescription.stop_index
        light: Any = None if wavelength_nm is None else np.array(wavelength_nm, np.float64)
        if light is not None:
            light = torch.from_numpy(light) if light.ndim else float(light)
        with self._glasses():
            done = trace(lens, start, light, towards=towards, transmittance=True, record=(stop,))
        crossing, through = done.crossings[stop], done.transmittance
        assert through is not None
        columns = (torch.stack(list(done.rays)), through, torch.stack([crossing.x, crossing.y]), done.status)
        return LensRays(*(column.numpy() for column in columns))

    def analyse(self, *what: str, **options: Any) -> Answer:
        """Analyse the lens: spots, mtf, distortion and more, by these names, or all without any; see `nl.analyse`."""
        return run_command(command("analyse"), self, list(what), **options)

    def describe(self, **options: Any) -> Answer:
        """Return what `neurolens lens` prints: pupils, image circle, what stops light, surfaces, doubts."""
        return run_command(command("lens"), self, **options)

    def draw(self, output: str | Path) -> None:
        """Draw the section of the lens with rays, as PNG, PDF or SVG."""
        self.describe(layout=output)

    def __repr__(self) -> str:
        size = f"{self.focal_length_mm:.4g} mm f/{self.f_number:.3g}, T{self.t_stop:.3g}"
        focus = "infinity" if math.isinf(self.focus_m) else f"{self.focus_m:g} m"
        return f"{one_line(self.prescription.name, 200)}: {size}, focus at {focus}"

    @cached_property
    def _png(self) -> bytes | None:  # None without the packages that draw
        with TemporaryFolder() as folder, suppress(ModuleNotFoundError):
            call(command("lens"), (self,), {**self.settings, "layout": (file := Path(folder) / "lens.png")})
            return file.read_bytes()
        return None

    def _repr_png_(self) -> bytes | None:
        return self._png

    def _repr_html_(self) -> str:
        from neurolens.base.html import html

        return html("notebook.html", text=repr(self), picture=self._png and b64encode(self._png).decode())


class Camera(_Chosen):
    """A lens, a model or an ideal camera by its name, set for a shot; nl.render takes it with all its settings.

    Raises:
        InputError: there is no such lens (the error names the nearest), or it has no such setting.
    """

    reads = _ReadCamera

    @cached_property
    def made(self) -> MadeCamera:
        """The camera itself, from film points and random numbers to weighted rays; see `neurolens.cameras.contract`.

        Raises:
            InputError: a setting that this kind of camera does not have.
        """
        return cli.camera(self._read.camera, self._read.state.shot(self._read.film), Progress(quiet=True))


class Model(OnnxLens):
    """An exported model: `card` tells what it stands for, how exact it is and where, and `rays` traces camera rays."""

    def __fspath__(self) -> str:
        return str(self.path)

    def __repr__(self) -> str:
        return f"{self.path}: {self.card['fit']['method']} of {self.card['lens']['name']}"

    def export(self, to: str, output: str | Path, **options: Any) -> Answer:
        """Write the model in another form, "c", "glsl", "osl" and more; see `nl.export`."""
        return run_command(command("export"), self, to=to, output=output, **options)


def load(model: str | os.PathLike[str]) -> Model:
    """Load an exported model by its file, or by the name of one that ships, and check it; torch is not needed.

    The model has `card`, `rays` and `export`, and every call takes it where a model is named.

    Raises:
        InputError: there is no such model.
        ModelError: the file cannot be trusted.
    """
    file = lensname.resolve(os.fspath(model), cameras=False).file
    if file is None or not lensname.is_model(file):
        expected = "an exported model (.onnx): `neurolens models` lists those that ship, nl.fit makes one of a lens"
        raise InputError("nl.load", "model", str(file or model), expected)
    return Model(read_model(file))


def fit(lens: str | os.PathLike[str], within_um: float | None = None, **options: Any) -> Model:
    """Fit models to a lens as `nl.train` does, without timing them, and load the one to use: a minute, as a rule.

    Args:
        lens: a name, a file, or a lens that is set, whose zoom, f-number and focal length count.
        within_um: the film-equivalent RMS error wanted, on rays that the fit has not seen; the smallest model within it
            is loaded.
        options: further ones of `nl.train`, such as output, the folder of the run, set, a mapping, and
            phase=True for the optical path.

    Raises:
        InputError: a setting that models do not have, or no model is within the error.
    """
    from neurolens.studies.pages import CLOSE_UM, to_use

    state = {key: value for key, value in _settings(lens).items() if key != "focus_m"}  # a model holds any focus
    kept = {f"lens.{key}": state.pop(key) for key in ("zoom", "f_number", "focal_length_mm") if key in state}
    options = {"rounds": 0, **state, **options, "set": {**kept, **options.get("set", {})}}
    within = None if within_um is None else f"{within_um}um"
    run = call(command("train"), (), {"lens": os.fspath(lens), "within": within, **options})
    if run.code:
        least = f"at least {run['target']['rms_um']:.3g}, the error of the closest model"
        raise InputError("nl.fit", "within_um", within_um, least)
    best = to_use(run["models"], within_um or CLOSE_UM)
    return load(Path(run["folder"]) / (best or run["models"][0])["file"])
