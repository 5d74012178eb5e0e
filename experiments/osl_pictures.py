"""One scene in Blender's Cycles: its own depth of field beside lenses of the library as shaders.

Each lens stands where its subject is as large as in the other pictures, at its widest stop; Cycles's own camera stands
there too, with the same focal length, f-number and sensor (of the anamorphic lens: its squeeze as the ratio of the
aperture; of the fisheye: the equisolid panorama). Every picture is denoised by Cycles's OpenImageDenoise. Writes
README.md and a JPEG a lens.
"""

from __future__ import annotations

import argparse
import os
import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments import lab
from experiments.osl_speed import BLENDER, checked_python, in_blender
from neurolens.base.progress import Progress
from neurolens.blender.pack import Form
from neurolens.cli.blender_lenses import form_of
from neurolens.lens.paraxial import first_order

_MOST_BYTES = 240_000  # of a picture
_QUALITIES = (90, 85, 80, 70)
_GAP = 4  # pixels between the two pictures


@dataclass(frozen=True)
class Shot:
    """A lens and its picture.

    Attributes:
        model: a file of models/; of a lens whose groups focus, its file in lenses/ and the `state` of its focal length.
        title, shows: for the page. focus_m: distance of the subject. size: in pixels. sensor_mm: its width.
        squeeze: of an anamorphic lens; pixels are so much higher than wide.
        fisheye: whether Cycles's own camera is its equisolid panorama.
    """

    model: str
    title: str
    shows: str
    focus_m: float
    size: tuple[int, int] = (640, 426)
    sensor_mm: float = 36.0
    squeeze: float = 1.0
    fisheye: bool = False
    state: str | None = None

    @property
    def name(self) -> str:
        return self.model.split(".")[0]


SHOTS = (
    Shot("laikin_double_gauss_50.ols-60", "Double Gauss 50 mm f/1.8",
         "discs are cut to cat's eyes towards the corners, which darken", 0.75),
    Shot("merte_biotar_100.ols-64", "Biotar 100 mm f/1.4",
         "the background swirls: cat's eyes turn about the middle", 1.42),
    Shot("sigler_telephoto_100.ols-64", "Telephoto 100 mm f/5.4",
         "its film moves far for a subject this near, which makes the picture larger; corners darken", 1.42),
    Shot("cooke_anamorphic_42", "Anamorphic 42 mm f/2.4, its squeeze of two undone",
         "upright ovals; every surface traced, focused by its groups (glass by n_d and V_d, without absorption)",
         0.9, (640, 266), 20.6, 2.0, state="0.74m"),
    Shot("horimoto_fisheye_16.ols-64", "Fisheye 16 mm f/2.8, 180 degrees",
         "nearly the panorama, with its own corners", 0.25, fisheye=True),
    Shot("nikon_zoom_70_200.ols-64", "Zoom 70-200 mm f/2.8 at 71.5 mm",
         "nearly a thin lens: corners darken, and discs there are cut a little", 1.05),
)  # fmt: skip

OPTIONS = [
    BLENDER,
    lab.count("samples", 64, "of a pixel (default: 64)"),
    lab.ONLY,
    lab.out(lab.RESULTS / "blender", "folder for the page"),
]


def run(args: argparse.Namespace) -> None:
    """Render all, write the pictures and the page."""
    python = checked_python(args.blender_python, "osl-pictures")
    lab.quiet_glasses()
    shots = lab.chosen(SHOTS, lambda shot: shot.name, args.only, "osl-pictures")
    with tempfile.TemporaryDirectory(prefix="neurolens-osl-") as folder:
        plan = []
        for shot in shots:
            form = _form(shot, Path(folder), args.quiet)
            for text in (None, form.osl):
                plan.append(planned(shot, form.f_number, text, args.samples, Path(folder)))
        with Progress(quiet=args.quiet).stage("pictures") as report:
            told = in_blender(python, {"cameras": [], "scenes": {}, "shots": plan}, report)
        args.out.mkdir(parents=True, exist_ok=True)
        for shot in shots:
            _write_pair(args.out / f"{shot.name}.jpg", Path(folder), shot)
    rows, load = [_row(shot, told["shots"]) for shot in shots], os.getloadavg()[0]
    data = {"machine": lab.machine(), "load": load, "blender": told["blender"], "samples": args.samples, "rows": rows}
    print(lab.write_results(args.out, "README", _page(data, shots), data))


def planned(shot: Shot, f_number: float, shader: str | None, samples: int, folder: Path) -> lab.Row:
    """A picture as `osl_in_blender` takes it; without a shader, of Cycles's own camera."""
    own = shader is None
    name = f"{shot.name}.{'cycles' if own else 'lens'}"
    stretched = shot.squeeze if own else 1.0  # it takes the picture as it is shown
    camera = {
        "name": name, "focal_mm": focal_mm(shot), "depth_of_field": True, "shader": shader,
        "sensor_mm": shot.sensor_mm * stretched, "f_number": f_number,
    }  # fmt: skip
    return {
        "name": name, "file": str(folder / f"{name}.png"), "size": shot.size, "samples": samples, "camera": camera,
        "focus_m": shot.focus_m, "pixel_aspect": shot.squeeze / stretched, "aperture_ratio": stretched,
        "fisheye": own and shot.fisheye,
    }  # fmt: skip


def _form(shot: Shot, folder: Path, quiet: bool) -> Form:
    """The shader of a model, or of a lens file without what names its glass: shaders of exact lenses absorb nothing."""
    if shot.state is None:
        model = lab.MODELS / f"{shot.model}.onnx"
        return form_of(model, quiet=quiet)
    clear = folder / f"{shot.name}.toml"
    named = (lab.LENSES / clear.name).read_text(encoding="utf-8")
    clear.write_text(re.sub(r', (material|glass) = "[^"]*"', "", named), encoding="utf-8")
    return form_of(clear, quiet=quiet)


def focal_mm(shot: Shot) -> float:
    """Focal length (vertical, of an anamorphic lens)."""
    return float(first_order(lab.lens_of(shot.name, zoom=shot.state)).efl_mm)


def _write_pair(file: Path, folder: Path, shot: Shot) -> None:
    """Both pictures side by side, Cycles's own on the left, each with its name."""
    from PIL import Image

    labels = {"cycles": "Cycles's own", "lens": shot.title.split(",")[0]}
    files = {kind: Image.open(folder / f"{shot.name}.{kind}.png").convert("RGB") for kind in labels}
    both = lab.sheet([lab.labelled(picture, labels[kind]) for kind, picture in files.items()], 2, _GAP)
    lab.write_small(file, [(both, {"quality": quality, "optimize": True}) for quality in _QUALITIES], _MOST_BYTES)


def _row(shot: Shot, seconds: dict[str, float]) -> lab.Row:
    own, lens = (seconds[f"{shot.name}.{kind}"] for kind in ("cycles", "lens"))
    return {"model": shot.model, "title": shot.title, "pixels": list(shot.size), "cycles_s": own, "lens_s": lens}


_COLUMNS = lab.columns(
    ("lens", "title"),
    ("model", "model"),
    ("pixels", lambda r: "{} x {}".format(*r["pixels"])),
    ("Cycles's own, s of CPU", "cycles_s", ".0f"),
    ("the lens, s of CPU", "lens_s", ".0f"),
)


def _page(data: lab.Row, shots: Sequence[Shot]) -> str:
    samples = data["samples"]
    command = f"`python -m experiments osl-pictures --samples {samples}`"
    head = f"{command}: Blender {data['blender']}, one thread, {samples} samples a pixel, denoised; "
    head += f"load average {data['load']:.0f}; {lab.machine_line()}"
    parts = ["Left Cycles's own depth of field, right the lens."]
    for shot in shots:
        parts += [f"## {shot.title}", f"Right: {shot.shows}.", f"![{shot.title}: Cycles, the lens]({shot.name}.jpg)"]
    return lab.page("# Lenses in Cycles", __doc__ or "", head, *parts, "## Seconds", lab.table(_COLUMNS, data["rows"]))
