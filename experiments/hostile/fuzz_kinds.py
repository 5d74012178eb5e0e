"""Kinds of hostile cases: which file of a folder is damaged, and which command then reads it.

A kind is a function of random numbers and a folder of good files (`fuzz_good.make_seeds`); it damages files there and
returns the words of a command, with small settings: a valid file goes all the way in a fraction of a second.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import shutil
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

from experiments import lab
from experiments.hostile.fuzz_damage import WORDS, damage, spoil
from neurolens import cli
from neurolens.cli.arguments import Parser

RIGHT = "right.txt"  # of a case: the picture of good files, and the one that is to be like it
SEEDS = lab.ROOT / "experiments" / "fuzz_seeds"
Chance = random.Random
Words = list[str]
_SMALL_FLARE = ("--width", "24", "--bins", "2", "--cell", "64", "--threads", "1", "--quiet")
_FILM = ("--width", "8", "--height", "6", "--film", "24x18", "--quiet")
PLATE, PLATE_FILM = (12, 8), "36x24"  # pixels; mm


def hurt(chance: Chance, folder: Path, name: str) -> None:
    """Damage a file of the folder; now and then something else stands in its place."""
    file = folder / name
    if chance.random() < 0.02:
        file.unlink()
        chance.choice((os.mkfifo, os.mkdir, partial(os.symlink, "/dev/zero")))(file)
    else:
        file.write_bytes(damage(chance, name, file.read_bytes()))


def _pick(chance: Chance, commands: Sequence[tuple[float, Sequence[str]]]) -> Words:
    """One of the commands by its weight: fast ones are run more often."""
    return list(chance.choices([words for _, words in commands], [weight for weight, _ in commands])[0])


def rendered(camera: str = "thin", *more: str) -> Words:
    return ["render", "scene.toml", "--camera", camera, "-o", "out.exr", "--threads", "1", "--quiet", *more]


def _flare(lens: str, *more: str) -> Words:
    return ["flare", lens, *more, *_SMALL_FLARE, "-o", "flare.exr"]


def _of_lens(chance: Chance, folder: Path) -> Words:
    hurt(chance, folder, "lens.toml")
    light = ("--light", "5,3")
    return _pick(
        chance,
        (
            (8, ("lens", "lens.toml", "good.toml")),
            (2, ("lens", "lens.toml", "--json")),
            (1, ("lens", "lens.toml", "--derive-rims")),
            *((2, ("analyse", "lens.toml", what)) for what in ("seidel", "distortion", "colour", "curvature")),
            *(
                (0.3, ("analyse", "lens.toml", what))
                for what in ("spots", "layout", "vignetting", "mtf", "psf", "fans")
            ),
            (4, rendered("thick:lens.toml")),
            (4, rendered("thin:lens.toml")),
            (0.5, rendered("lens.toml")),
            (0.3, rendered("fused:lens.toml")),
            (0.1, ("stmap", "lens.toml", *_FILM, "-o", "shot")),
            (0.02, ("handover", "lens.toml", *_FILM, "-o", "shot")),
            (0.3, ("export", "lens.toml", "--to", "c", "-o", "out.h", "--json")),
            (0.2, ("export", "lens.toml", "--to", "glsl", "-o", "out.glsl", "--json")),
            (0.5, _flare("lens.toml", *light)),
            (2, _flare("lens.toml", *light)[:4]),
            (0.5, ("models", "lens.toml")),
            (0.05, ("survey", "fold", "--no-fit", "-o", "new", "--jobs", "1", "--quiet")),
            (1, ("verify", "lens.toml", "--profile", "Canon EF 50mm f/1.8", "--lens-file", "out.toml")),
            (0.5, ("rims", "lens.toml", "--profile", "Canon EF 50mm f/1.4 USM", "-o", "out.toml")),
        ),
    )


def _of_zoom(chance: Chance, folder: Path) -> Words:
    hurt(chance, folder, "states.toml")
    return _pick(
        chance,
        (
            (4, ("lens", "states.toml", "good.toml")),
            (0.5, ("lens", "states.toml", "--zoom", "100", "--focus", "2")),
            (1, ("lens", "states.toml", "--focus-mode", "internal", "--focus", "1.5")),
            (2, rendered("thick:states.toml", "--zoom", "100")),
        ),
    )


def foreign() -> list[str]:
    """Lens files of other programs."""
    return sorted(file.name for file in SEEDS.iterdir() if file.stem in ("lens", "zoom"))


def _of_format(chance: Chance, folder: Path) -> Words:
    name = chance.choice(foreign())
    hurt(chance, folder, name)
    commands = [
        (8, ("convert", name, "-o", "out.toml")),
        (1, ("lens", name, "good.toml")),
        (1, rendered(f"thick:{name}")),
    ]
    return _pick(chance, commands)


def _of_glass(chance: Chance, folder: Path) -> Words:
    hurt(chance, folder, "own.agf")
    more = ("--glass", "own.agf")
    commands = [(3, ("glass", "OWN1", *more)), (1, ("convert", "lens.zmx", "-o", "out.toml", *more))]
    return _pick(chance, commands)


def _of_scene(chance: Chance, folder: Path) -> Words:
    hurt(chance, folder, "scene.toml")
    return _pick(chance, ((9, rendered()), (1, _flare("good.toml", "--lights", "scene.toml"))))


def _of_mesh(chance: Chance, folder: Path) -> Words:
    hurt(chance, folder, chance.choice(("tetra.obj", "tetra.obj", "tetra.mtl", "tetra.ply", "mixed.ply")))
    return rendered()


def _of_picture(chance: Chance, folder: Path) -> Words:
    name = chance.choice(
        ("tile.png", "tile.jpg", "tile.tif", "tile.webp", "mask.png", "sky.exr", "sky.hdr", "lamp.csv")
    )
    hurt(chance, folder, name)
    if name == "sky.hdr":
        (folder / "scene.toml").write_text((folder / "scene.toml").read_text().replace("sky.exr", name))
    return rendered("thin", *(("--aperture-mask", name) if name == "mask.png" else ()))


def _of_model(chance: Chance, folder: Path) -> Words:
    name = chance.choice(("model.onnx", "model.onnx", "network.onnx"))
    hurt(chance, folder, name)
    return _pick(
        chance,
        (
            (3, rendered(name)),
            *((1, ("export", name, "--to", to, "-o", f"out.{to}", "--json")) for to in ("glsl", "vex", "wgsl", "onnx")),
            (0.3, ("export", name, "--to", "c", "-o", "out.h", "--json")),
            (0.1, ("stmap", name, *_FILM, "-o", "shot")),
            (0.1, ("bokeh", name, *_FILM, "--distance", "2", "--grid", "1x1", "-o", "shot")),
            (0.02, ("handover", name, *_FILM, "-o", "shot")),
            (0.1, ("view", name, "--downloads", "glsl", "-o", "out.html", "--json")),
            (0.1, ("blender", "add", name, "--extension", "pack.zip", "--quiet")),
        ),
    )


def _of_listing(chance: Chance, folder: Path) -> Words:
    """A damaged model in a folder that `models` lists."""
    (folder / "models").mkdir()
    name = chance.choice(("model.onnx", "network.onnx"))
    hurt(chance, folder, name)
    shutil.copy(folder / name, folder / "models" / name) if (folder / name).is_file() else None
    return ["models", "cooke"]


def _of_experiment(chance: Chance, folder: Path) -> Words:
    hurt(chance, folder, "experiment.toml")
    return ["read", "experiment.toml"]


def _of_tile(chance: Chance, folder: Path) -> Words:
    names = sorted(file.name for file in folder.glob("tile.tile-*.exr"))
    hurt(chance, folder, chance.choice(names))
    return merging(*names)


def merging(*names: str) -> Words:
    """The command that puts tiles together."""
    return ["render", "--merge", *names, "-o", "out.exr"]


def _of_plate(chance: Chance, folder: Path) -> Words:
    name = chance.choice(("plate.exr", "half.exr", *LAYERED))
    hurt(chance, folder, name)
    if name in LAYERED:
        return defocused(name)
    if chance.random() < 0.3:
        more = ("--depth", "R", "--samples", "8", "-o", "out.exr")
        return ["defocus", name, "--lens", "thin", "--film", PLATE_FILM, *more]
    return plate(name)


def plate(name: str) -> Words:
    """The flare of a plate's lights."""
    return _flare("good.toml", "--image", name, "--film", PLATE_FILM, "--most", "2")


def _of_lights(chance: Chance, folder: Path) -> Words:
    name = chance.choice(("lights.csv", "lights.json", "keys.csv", "keys.json"))
    hurt(chance, folder, name)
    frames = ("--frames", "1:2", "--key", name)
    if name.startswith("keys"):
        return rendered("thin", *frames) if chance.random() < 0.8 else _flare("good.toml", "--light", "5,3", *frames)
    return _flare("good.toml", "--lights", name)


def _of_archive(chance: Chance, folder: Path) -> Words:
    hurt(chance, folder, chance.choice(("pack.zip", "pack.zip", "user/lenses.json")))
    return ["blender", "add", "model.onnx", "--extension", chance.choice(("pack.zip", "user")), "--quiet"]


def _of_kept(chance: Chance, folder: Path) -> Words:
    """The files that an interrupted or an earlier run has left."""
    records = sorted(str(file.relative_to(folder)) for file in folder.glob("done/records/*.json"))
    commands = {
        "out.exr.part": rendered("thin", "--samples", "16"),
        **{name: ["survey", "fold", "--no-fit", "-o", "done", "--quiet"] for name in records},
    }
    rare = [{"out.exr.part": 3}.get(name.partition("/")[0], 0.2) for name in commands]
    (name,) = chance.choices(list(commands), rare)
    (folder / "kept.part").rename(folder / "out.exr.part")
    hurt(chance, folder, name)
    return commands[name]


def _of_words(chance: Chance, folder: Path) -> Words:
    fine = (
        rendered(), rendered("thick:lens.toml"), rendered("model.onnx"), merging("tile.tile-1-of-2.exr"),
        ["lens", "lens.toml"], ["glass", "N-BK7"], ["convert", "lens.zmx", "-o", "out.toml"], ["models", "cooke"],
        ["export", "model.onnx", "--to", "c", "-o", "out.h", "--json"], ["analyse", "lens.toml", "seidel"],
        _flare("lens.toml", "--light", "5,3"), ["stmap", "thin", *_FILM, "-o", "shot"],
        ["handover", "thin", *_FILM, "-o", "shot"],
        ["projection", "thin", *_FILM, "--projection", "opencv"],
        ["evaluate", "model.onnx", "--rays", "1000", "--quiet"],
        ["blender", "add", "model.onnx", "--extension", "pack.zip", "--quiet"],
        ["view", "model.onnx", "--downloads", "glsl"],
        ["survey", "fold", "--no-fit", "-o", "new", "--quiet"], ["plan", "scene.toml", "--lens", "missing"],
        ["train", "missing.toml"], ["mitsuba", "cornell-box"], ["verify", "lens.toml"], ["rims", "lens.toml"],
    )  # fmt: skip
    words = list(chance.choice(fine))
    options = [o for o in parsers()[words[0]] if o not in _LONG]
    for _ in range(chance.choice((1, 1, 2))):
        if options and chance.random() < 0.7:
            words += [chance.choice(options), chance.choice((*WORDS, "0.5", "2", "4", "40", "all", "x.png"))]
        else:
            words[chance.randrange(1, len(words))] = chance.choice((*WORDS, *options))
    return [word.replace("\\udc00", "\udc00") for word in words]


# Their value may be any amount of work, or of a network; help is no work at all.
_LONG = "--help -h --samples --max-depth --dask --rays --photons --glare --ghosts --models".split()


@cache
def parsers() -> dict[str, list[str]]:
    """Options of each command."""
    kinds = next(a for a in cli.build_parser()._actions if isinstance(a, argparse._SubParsersAction))
    return {name: [o for a in p._actions for o in a.option_strings] for name, p in kinds.choices.items()}


def _of_large(chance: Chance, folder: Path) -> Words:
    """A text file grown to 1 MB by one thing repeated."""
    commands = {
        "lens.toml": rendered("thick:lens.toml"),
        **{name: rendered() for name in ("scene.toml", "tetra.obj", "tetra.mtl", "lamp.csv")},
        "experiment.toml": ["read", "experiment.toml"],
        "lights.csv": _flare("good.toml", "--lights", "lights.csv"),
        **{name: ["convert", name, "-o", "out.toml"] for name in foreign()},
    }
    name = chance.choice(list(commands))
    data = (folder / name).read_bytes()
    m = chance.choice(list(re.finditer(rb"[\w.+-]+|[\s\"'=,{}\[\]/:]", data)))
    units = b" ,1,a,\n,.,a.,[,(,\",',\\,0 ,1e".split(b",")
    unit = chance.choice((m[0], b",", *units, chance.choice(data.splitlines(keepends=True))))
    at = chance.choice((m.start(), m.end(), data.find(b"\n", m.end()) + 1))
    (folder / name).write_bytes(data[:at] + unit * (960_000 // len(unit)) + data[at:])
    return commands[name]


def _of_long_runs(chance: Chance, folder: Path) -> Words:
    """Commands that take seconds when their files are good."""
    made = sorted(str(file.relative_to(folder)) for file in folder.glob("run/models/*"))
    files = ("scene.toml", "lens.toml", "model.onnx", "experiment.toml", chance.choice(made), chance.choice(made))
    name = chance.choice(files)
    hurt(chance, folder, name)
    lens = ("--lens", "lens.toml", "--quiet", "--no-fit")
    by_file: dict[str, tuple[tuple[float, Sequence[str]], ...]] = {
        "model.onnx": (
            (1, ("evaluate", "model.onnx", "--rays", "1000", "--quiet")),
            (1, ("export", "model.onnx", "--to", "osl", "-o", "out.osl", "--json")),
            (1, ("projection", "model.onnx", *_FILM, "--projection", "f-theta", "-o", "shot")),
        ),
        "scene.toml": (
            (1, ("plan", "scene.toml", *lens)),
            (1, ("plan", "scene.toml", *lens, "--explain")),
        ),
        "lens.toml": (
            (1, ("view", "lens.toml", "--json")),
            (1, ("projection", "lens.toml", *_FILM, "--projection", "opencv", "-o", "shot")),
        ),
    }
    train = (1.0, ("train", "experiment.toml", "-o", "run", "--rounds", "0", "--quiet"))
    return _pick(chance, by_file.get(name, (train,)))


def _cut(chance: Chance, folder: Path, name: str, words: Words, out: str = "out.exr") -> Words:
    """Spoil a file of a command whose picture is known (`fuzz_good.make_seeds`), and say where both are."""
    file = folder / name
    file.write_bytes(spoil(chance, file.read_bytes(), name != "sky.exr"))  # too small to be deflated
    (folder / RIGHT).write_text(f"right/{name.replace('/', '-')}.exr {out}")
    return words


def _cut_picture(chance: Chance, folder: Path) -> Words:
    name = chance.choice(SHOWN)
    return _cut(chance, folder, name, with_picture(folder, name))


def with_picture(folder: Path, name: str) -> Words:
    """The picture of a scene that one file lights or clothes."""
    if name == "sky.hdr":
        (folder / "scene.toml").write_text((folder / "scene.toml").read_text().replace("sky.exr", name))
    return rendered()


def defocused(name: str) -> Words:
    return ["defocus", name, "--lens", "thin", "--film", PLATE_FILM, "--samples", "8", "--quiet", "-o", "out.exr"]


def _cut_plate(chance: Chance, folder: Path) -> Words:
    name = chance.choice(LAYERED)
    return _cut(chance, folder, name, defocused(name))


def _cut_tile(chance: Chance, folder: Path) -> Words:
    names = sorted(file.name for file in folder.glob("tile.tile-*.exr"))
    return _cut(chance, folder, chance.choice(names), merging(*names))


def _cut_checkpoint(chance: Chance, folder: Path) -> Words:
    (folder / "kept.part").rename(folder / "out.exr.part")
    return _cut(chance, folder, "out.exr.part", rendered("thin", "--samples", "16"))


def _cut_map(chance: Chance, folder: Path) -> Words:
    """A map that an earlier hand-over wrote: it is written again, or it is whole."""
    name = chance.choice(sorted(str(file.relative_to(folder)) for file in folder.glob("maps/*.exr")))
    return _cut(chance, folder, name, HANDOVER, name)


LAYERED = ("parts.exr", "deep.exr")
SHOWN = ("tile.png", "tile.jpg", "tile.tif", "tile.webp", "sky.exr", "sky.hdr")
HANDOVER = ["handover", "thin", *_FILM, "-o", "maps"]
KINDS: dict[str, tuple[float, Callable[[Chance, Path], Words]]] = {
    "lens": (12, _of_lens),
    "zoom": (3, _of_zoom),
    "format": (16, _of_format),
    "glass": (3, _of_glass),
    "scene": (12, _of_scene),
    "mesh": (6, _of_mesh),
    "picture": (6, _of_picture),
    "model": (6, _of_model),
    "listing": (1, _of_listing),
    "experiment": (5, _of_experiment),
    "tile": (6, _of_tile),
    "plate": (3, _of_plate),
    "lights": (3, _of_lights),
    "archive": (4, _of_archive),
    "kept": (4, _of_kept),
    "words": (7, _of_words),
    "cut picture": (3, _cut_picture),
    "cut plate": (3, _cut_plate),
    "cut tile": (3, _cut_tile),
    "cut checkpoint": (3, _cut_checkpoint),
    "cut map": (0.3, _cut_map),
    "large": (0.8, _of_large),
    "long runs": (0.1, _of_long_runs),
}


def chosen(seed: int, case: int, only: str = "") -> tuple[Chance, str]:
    """The random numbers of a case, and its kind."""
    chance = Chance(f"{seed}/{case}")
    names = [name for name in KINDS if only in name]
    return chance, chance.choices(names, [KINDS[name][0] for name in names])[0]


# ---- The commands. ---------------------------------------------------------------------------------------------------


def build() -> Parser:
    """The command line, and `read EXPERIMENT`: an experiment with its lens, domain and scenes; nothing runs."""
    from neurolens.pictures.render.scene import load_scene
    from neurolens.studies.experiment import read_experiment

    def read(args: argparse.Namespace) -> int:
        experiment = read_experiment(args.file)
        experiment.domain.of(experiment.lens.read())
        for scene in experiment.render.scenes:
            load_scene(scene)
        return 0

    parser = cli.build_parser()
    kinds = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    reader = kinds.add_parser("read")
    reader.add_argument("file", type=Path)
    reader.set_defaults(run=read, kept="nothing")
    return parser


def shorten() -> None:
    """Replace steps that take long and read no further file: a survey's processes, a shader's pupil, the models of the
    library, the field of the good lens of plates, which is made once."""
    from neurolens.base.tasks import Here
    from neurolens.cameras.onnxlens import load_model
    from neurolens.cli import blender, flare, models, train
    from neurolens.programs.blender import Form

    def form_of(file: Path, **_: Any) -> Form:
        card = load_model(file).card
        return Form("polynomial", card["fit"]["method"], "shader", 1.0, 21.6, 2.0, 0.7)

    fields: dict[tuple[Any, ...], Any] = {}
    field_of = flare.Shots._field

    def field(shots: flare.Shots, args: Any, *rest: Any) -> Any:
        if args.file != Path("good.toml"):
            return field_of(shots, args, *rest)
        key = args.film, args.state
        if key not in fields:
            fields[key] = field_of(shots, args, *rest)
        return fields[key]

    flare.Shots._field = field  # type: ignore[assignment,method-assign]
    train.Processes = lambda *_: Here()  # type: ignore[assignment,misc]
    blender.form_of = form_of
    models._places = lambda: [place for place in [Path("models")] if place.is_dir()]
