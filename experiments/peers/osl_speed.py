"""Nanoseconds of CPU a camera ray in Blender's Cycles: its own cameras, and shaders of ours.

In turn in one run of Blender, one thread: the built-in camera without and with depth of field, a thin lens written in
OSL, a polynomial of a 50 mm double Gauss (12 refractions) as a shader, a network of its error and one of a hundredth, a
polynomial of a 70-200 mm zoom (33 refractions), and both lenses exactly, with every surface traced. First with nothing
but a white sky, where a ray costs little beside the camera; then meshes and lamps, in the open, where most light leaves
after a bounce or two, and in a room. Blender's Python is a process of its own: what it takes to begin is measured by
pictures of a few rays, and taken off. Writes osl_speed.md and osl_speed.json.
"""

from __future__ import annotations

import argparse
import inspect
import json
import os
import re
import statistics
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from experiments import lab
from experiments.peers import osl_in_blender
from neurolens.base.errors import InputError
from neurolens.base.progress import Progress, Report
from neurolens.cli.blender import form_of
from neurolens.optics.lens.paraxial import first_order
from neurolens.programs.blender import Form

PYTHON = lab.ROOT / ".venv-blender" / "bin" / "python"
_GAUSS = "laikin_double_gauss_50"
BUILT_IN, DEPTH, THIN = "built-in", "built-in, depth of field", "thin lens in OSL"
POLYNOMIAL, NETWORK, CLOSE = "ols-36", "mlp-10x1", "mlp-16x2"
LONG = "ols-64 of 33 refractions"
GREY, GREY_NETWORK = f"{POLYNOMIAL}, one colour", f"{NETWORK}, one colour"  # without dispersion
EXACT, EXACT_LONG = "exact, 12 refractions", "exact, 33 refractions"
SHADERS = {
    POLYNOMIAL: lab.MODELS / f"{_GAUSS}.{POLYNOMIAL}.onnx",
    NETWORK: lab.MODELS / f"{_GAUSS}.{NETWORK}.onnx",
    CLOSE: lab.MODELS / f"{_GAUSS}.{CLOSE}.onnx",
    LONG: lab.MODELS / "ogawa_zoom_70_200.ols-64.onnx",
    EXACT: lab.LENSES / f"{_GAUSS}.toml",
    EXACT_LONG: lab.LENSES / "ogawa_zoom_70_200.toml",
}
_FOCAL_MM = 50.0
# The least that a camera in OSL does: a point of a disc by concentric squares, a ray through the point in focus, and
# the derivatives that Cycles would otherwise take itself.
THIN_LENS = """\
shader thin_lens(float focal_mm = 50.0, float f_number = 1.8,
    output point position = 0.0, output vector direction = 0.0, output color throughput = 1.0,
    output vector dPdx = 0.0, output vector dPdy = 0.0, output vector dDdx = 0.0, output vector dDdy = 0.0)
{
    point raster = camera_shader_raster_position(), pair = camera_shader_random_sample();
    vector right = Dx(raster), up = Dy(raster), sensor = vector(36.0, 24.0, 0.0);
    float focus_m = 1.0;
    getattribute("cam:sensor_size", sensor);
    getattribute("cam:focal_distance", focus_m);
    float a = 2.0 * pair[0] - 1.0, b = 2.0 * pair[1] - 1.0, reach = b, turn = 0.0;
    if (a * a > b * b) {
        reach = a;
        turn = M_PI_4 * (b / a);
    } else if (b != 0.0)
        turn = M_PI_2 - M_PI_4 * (a / b);
    reach *= 0.0005 * focal_mm / f_number;
    position = point(reach * cos(turn), reach * sin(turn), 0.0);
    float x = focus_m * sensor[0] / focal_mm, y = focus_m * sensor[1] / focal_mm;
    vector way = vector((raster[0] - 0.5) * x, (raster[1] - 0.5) * y, focus_m) - vector(position);
    float nearer = 1.0 / length(way);
    direction = way * nearer;
    vector by_x = vector(right[0] * x * nearer, 0.0, 0.0), by_y = vector(0.0, up[1] * y * nearer, 0.0);
    dDdx = by_x - direction * dot(direction, by_x);
    dDdy = by_y - direction * dot(direction, by_y);
}
"""


def _named(text: str) -> tuple[str, Path]:
    name, equals, file = text.partition("=")
    if not (name and equals and Path(file).is_file()):
        raise argparse.ArgumentTypeError(f"{text}: expected NAME=FILE.osl, a file that is there")
    return name, Path(file)


BLENDER = lab.option(
    "--blender-python", metavar="PATH", type=Path, default=PYTHON,
    help=f"a Python that has bpy (default: {PYTHON.relative_to(lab.ROOT)}, by make test-blender)",
)  # fmt: skip
OPTIONS = [
    BLENDER,
    lab.option(
        "--other", metavar="NAME=FILE.osl", type=_named, action="append", default=[],
        help="a camera of others, a shader as it is, under the white sky, too (repeatable)",
    ),
    lab.count("rounds", 15, "of the white sky (default: 15)"),
    lab.count("scene-rounds", 9, "of the other scenes (default: 9)"),
    lab.out(),
]  # fmt: skip


@dataclass(frozen=True)
class Stage:
    """A scene: pixels, samples, rounds, its cameras, and the one that they are divided by."""

    size: tuple[int, int]
    samples: int
    rounds: int
    cameras: tuple[str, ...]
    base: str

    @property
    def rays(self) -> int:
        return self.size[0] * self.size[1] * self.samples


def run(args: argparse.Namespace) -> int:
    """Write the shaders, race them, write the tables; 1 where a goal is missed."""
    python = checked_python(args.blender_python, "osl")
    lab.quiet_glasses()
    others = {name: file.read_text(encoding="utf-8") for name, file in args.other}
    cameras = (BUILT_IN, DEPTH, THIN, POLYNOMIAL, GREY, NETWORK, GREY_NETWORK)
    stages = {
        "sky": Stage((128, 96), 32, args.rounds, (BUILT_IN, DEPTH, THIN, *SHADERS, *others), THIN),
        "open": Stage((128, 86), 64, args.scene_rounds, cameras, DEPTH),
        "room": Stage((64, 43), 64, args.scene_rounds, cameras, DEPTH),
    }
    texts, operations = _shaders(args.quiet)
    with Progress({"race in Blender": 120.0}, quiet=args.quiet).stage("race in Blender") as report:
        results = race(python, texts | others, stages, report)
    rows = [row for name, stage in stages.items() for row in rows_of(name, stage, results["scenes"][name], operations)]
    met = goals(rows)
    data = {"machine": lab.machine(), "blender": results["blender"], "rows": rows, "goals": met}
    print(lab.write_results(args.out, "osl_speed", _page(results["blender"], stages, rows, met), data))
    return int(any(g.verdict == "missed" for g in met))


def _shaders(quiet: bool) -> tuple[dict[str, str | None], dict[str, int]]:
    """Texts by camera, None for Blender's own, and the operations of ours."""
    from neurolens.cameras.shaders.blender_shader import shader_of

    made = {name: shader_of(file, quiet=quiet) for name, file in SHADERS.items()}
    own: dict[str, str | None] = {BUILT_IN: None, DEPTH: None, THIN: THIN_LENS}
    own |= {grey: one_colour(made[model].text) for grey, model in ((GREY, POLYNOMIAL), (GREY_NETWORK, NETWORK))}
    return own | {k: s.text for k, s in made.items()}, {k: s.operations for k, s in made.items()}


def one_colour(shader: str) -> str:
    """A shader with its dispersion off.

    Raises:
        Unmeasured: it has none.
    """
    text = shader.replace("int dispersion = 2", "int dispersion = 0")
    if text == shader:
        raise lab.Unmeasured("the shader has no dispersion to switch off")
    return text


def camera(name: str, shader: str | None) -> lab.Row:
    """A camera as `osl_in_blender` takes it."""
    return {"name": name, "focal_mm": _FOCAL_MM, "depth_of_field": name != BUILT_IN, "shader": shader}


def race(python: Path, texts: Mapping[str, str | None], stages: Mapping[str, Stage], report: Report) -> lab.Row:
    """Race the cameras in Blender and return the times of `osl_in_blender`.

    Raises:
        Unmeasured: Blender's Python fails.
    """
    cameras = [camera(name, text) for name, text in texts.items()]
    return in_blender(python, {"cameras": cameras, "scenes": {n: asdict(stage) for n, stage in stages.items()}}, report)


def checked_python(path: Path, measurement: str) -> Path:
    """The Python of --blender-python.

    Raises:
        InputError: there is none.
    """
    if path.is_file():
        return path
    expected = "a Python with Blender as a module (bpy), which make test-blender sets up"
    raise InputError(f"experiments {measurement}", "--blender-python", str(path), expected)


def in_blender(python: Path, plan: lab.Row, report: Report) -> lab.Row:
    """Run a plan in Blender and return the results of `osl_in_blender`.

    Raises:
        Unmeasured: Blender's Python fails.
    """
    with tempfile.TemporaryDirectory(prefix="neurolens-osl-") as folder:
        planned, result, said = (Path(folder) / name for name in ("plan.json", "result.json", "stderr"))
        planned.write_text(json.dumps(plan), encoding="utf-8")
        command = [str(python), osl_in_blender.__file__, str(planned), str(result)]
        user = {"BLENDER_USER_RESOURCES": folder, "PYTHONPATH": ""}
        with said.open("w") as errors, subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=errors, text=True, env=os.environ | user
        ) as child:  # fmt: skip
            try:
                for line in child.stdout or ():
                    if line.startswith("share "):
                        report(float(line.split()[1]))
            except BaseException:
                child.kill()  # or leaving the block would wait for it
                raise
        if child.returncode != 0:
            last = said.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1:]
            raise lab.Unmeasured(f"{python}: {''.join(last) or child.returncode}")
        found: lab.Row = json.loads(result.read_text(encoding="utf-8"))
        return found


def rows_of(scene: str, stage: Stage, times: Mapping[str, Any], operations: Mapping[str, int]) -> list[lab.Row]:
    """The rows of a scene, from the seconds of full and of tiny pictures by camera.

    `begin_ms` is what a picture takes before its first ray, `ns_min` and `ns_median` are ns of CPU a ray; `over` and
    `over_median` are the least over the least of the scene's base, and the median of that ratio in the turns.

    Raises:
        Unmeasured: rays take no longer than beginning does.
    """
    begin = {name: min(t["tiny"]) for name, t in times.items()}
    ns = {name: [1e9 * (s - begin[name]) / stage.rays for s in t["full"]] for name, t in times.items()}
    base = ns[stage.base]
    if min(map(min, ns.values())) <= 0:
        raise lab.Unmeasured("what Blender takes to begin hides the rays: the machine is too busy, or they are too few")
    rows: list[lab.Row] = []
    for name, own in ns.items():
        ratios = [a / b for a, b in zip(own, base, strict=True)]
        row = {"scene": scene, "camera": name, "operations": operations.get(name), "error_um": _error_um(name)}
        row |= {"begin_ms": 1e3 * begin[name], "ns_min": min(own), "ns_median": statistics.median(own)}
        rows.append(row | {"over": min(own) / min(base), "over_median": statistics.median(ratios)})
    return rows


def _error_um(camera: str) -> float | None:
    """RMS on rays that the model has not seen, of its card; 0 where every surface is traced."""
    from neurolens.cameras.onnxlens import load_model

    file = SHADERS.get(camera)
    if file is None:
        return None
    return 0.0 if file.suffix == ".toml" else float(load_model(file).card["errors"]["rms_um"])


def goals(rows: Sequence[lab.Row]) -> list[lab.Goal]:
    """The goals, by the least times."""
    ns = {(r["scene"], r["camera"]): r["ns_min"] for r in rows}

    def ratio(text: str, wanted: float, over: tuple[str, str], under: tuple[str, str], least: bool = False) -> lab.Goal:
        return lab.Goal(text, wanted, ns[over] / ns[under] if over in ns and under in ns else None, least)

    model, thin = ("sky", POLYNOMIAL), ("sky", THIN)
    slow = [ratio(f"{_HEADINGS[s].lower()}: {m} over Cycles's depth of field", 1.05, (s, m), (s, DEPTH))
            for s in ("room", "open") for m in (POLYNOMIAL, GREY, NETWORK, GREY_NETWORK)]  # fmt: skip
    return [
        ratio(f"{POLYNOMIAL} over the thin lens in OSL", 1.3, model, thin),
        ratio(f"{NETWORK} over the thin lens in OSL", 1.6, ("sky", NETWORK), thin),
        ratio(f"{EXACT} over {POLYNOMIAL}", 5.0, ("sky", EXACT), model, True),
        ratio(f"{EXACT} over {NETWORK}", 5.0, ("sky", EXACT), ("sky", NETWORK), True),
        ratio(f"{EXACT_LONG} over {LONG}", 12.0, ("sky", EXACT_LONG), ("sky", LONG), True),
        *slow,
    ]


_COLUMNS = lab.columns(
    ("camera", "camera"),
    ("operations", "operations"),
    ("RMS error, um", "error_um", ".2g"),
    ("ns a ray, min", "ns_min", ".0f"),
    ("median", "ns_median", ".0f"),
    ("over the base, min", "over", ".2f"),
    ("median of turns", "over_median", ".2f"),
    ("to begin, ms", "begin_ms", ".0f"),
)
_HEADINGS = {"sky": "A white sky", "open": "In the open", "room": "A room"}
_NOTE = """\
A few of a hundred rays of a real lens end in it and cost no more: at f/1.8, by our shaders, 3 to 4. Rays that have a
colour weigh up to 3 in one channel and less in the others, and Cycles ends a path by chance of its brightest channel:
their paths are longer, and less is left to that chance. One colour is the camera's own cost.
"""


def _page(blender: str, stages: Mapping[str, Stage], rows: Sequence[lab.Row], met: Sequence[lab.Goal]) -> str:
    parts = []
    for name, s in stages.items():
        setting = f"{s.size[0]} x {s.size[1]} pixels, {s.samples} samples, {s.rounds} rounds; the base: {s.base}."
        parts += [f"## {_HEADINGS[name]}", setting, lab.table(_COLUMNS, [r for r in rows if r["scene"] == name], "–")]
    head = f"Blender {blender}; {lab.machine_line()}"
    return lab.page("# Cameras in Cycles", __doc__ or "", head, *parts, _NOTE, lab.goal_table("Goal", met))


# ---- Pictures. -------------------------------------------------------------------------------------------------------

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
         "upright ovals; every surface traced, focused by its groups (glass by n_d and V_d, without "
         "absorption)", 1.05, (640, 266), 20.6, 2.0, state="0.74m"),
    Shot("horimoto_fisheye_16.ols-64", "Fisheye 16 mm f/2.8, 180 degrees",
         "nearly the panorama, with its own corners", 0.25, fisheye=True),
    Shot("nikon_zoom_70_200.ols-64", "Zoom 70-200 mm f/2.8 at 71.5 mm",
         "nearly a thin lens: corners darken, and discs there are cut a little", 1.05),
)  # fmt: skip

PICTURES_OPTIONS = [
    BLENDER,
    lab.count("samples", 64, "of a pixel (default: 64)"),
    lab.ONLY,
    lab.out(lab.RESULTS / "blender", "folder for the page"),
]


def run_pictures(args: argparse.Namespace) -> None:
    """One scene in Blender's Cycles: its own depth of field beside lenses of the library as shaders.

    Each lens stands where its subject is as large as in the other pictures, at its widest stop. Cycles's own camera
    stands there, too, with the same focal length, f-number and sensor. For the anamorphic lens its aperture has the
    ratio of the squeeze; for the fisheye it is the equisolid panorama. Cycles's OpenImageDenoise denoises every
    picture. Writes README.md and a JPEG a lens.
    """
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
            results = in_blender(python, {"cameras": [], "scenes": {}, "shots": plan}, report)
        args.out.mkdir(parents=True, exist_ok=True)
        for shot in shots:
            _write_pair(args.out / f"{shot.name}.jpg", Path(folder), shot)
    rows, load = [_row(shot, results["shots"]) for shot in shots], os.getloadavg()[0]
    data = {
        "machine": lab.machine(),
        "load": load,
        "blender": results["blender"],
        "samples": args.samples,
        "rows": rows,
    }
    print(lab.write_results(args.out, "README", _pictures_page(data, shots), data))


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
    return form_of(clear, zoom=shot.state, quiet=quiet)


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


_PICTURE_COLUMNS = lab.columns(
    ("lens", "title"),
    ("model", "model"),
    ("pixels", lambda r: "{} x {}".format(*r["pixels"])),
    ("Cycles's own, s of CPU", "cycles_s", ".0f"),
    ("the lens, s of CPU", "lens_s", ".0f"),
)


def _pictures_page(data: lab.Row, shots: Sequence[Shot]) -> str:
    samples = data["samples"]
    command = f"`python -m experiments osl-pictures --samples {samples}`"
    head = f"{command}: Blender {data['blender']}, one thread, {samples} samples a pixel, denoised; "
    head += f"load average {data['load']:.0f}; {lab.machine_line()}"
    parts = ["Left Cycles's own depth of field, right the lens."]
    for shot in shots:
        parts += [f"## {shot.title}", f"Right: {shot.shows}.", f"![{shot.title}: Cycles, the lens]({shot.name}.jpg)"]
    return lab.page(
        "# Lenses in Cycles",
        inspect.getdoc(run_pictures) or "",
        head,
        *parts,
        "## Seconds",
        lab.table(_PICTURE_COLUMNS, data["rows"]),
    )
