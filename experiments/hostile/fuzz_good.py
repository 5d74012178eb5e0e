"""Good files for hostile cases: one of each kind, and the pictures that commands write from them."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR

from experiments import lab
from experiments.hostile.fuzz_kinds import (
    HANDOVER,
    LAYERED,
    PLATE,
    SEEDS,
    SHOWN,
    Words,
    defocused,
    merging,
    rendered,
    with_picture,
)  # fmt: skip


def make_seeds(folder: Path, kinds: set[str], run: Callable[[Path, Words], tuple[int, str]]) -> None:
    """Fill a new folder with one good file of each kind, those of some kinds by commands.

    Raises:
        RuntimeError: a command refuses good files; then every case would be refused.
    """

    def done(words: Words) -> None:
        code, said = run(folder, words)
        if code:
            raise RuntimeError(f"{' '.join(words)}: {said}")

    shutil.copytree(SEEDS, folder)
    scene = folder / "scene.toml"
    scene.write_text(
        scene.read_text().replace('aperture_mask = "mask.png"\n', "")
    )  # whose area takes a tenth of a second
    lens, models = lab.LENSES / "cooke_triplet_50.toml", lab.MODELS / "cooke_triplet_50"
    (folder / "fold").mkdir()
    for place in ("lens.toml", "fold/lens.toml"):
        shutil.copy(lens, folder / place)
    shutil.copy(lab.LENSES / "thorlabs_lb1471_biconvex_50.toml", folder / "good.toml")  # with one ghost
    shutil.copy(lab.LENSES / "nikon_zoom_80_200.toml", folder / "states.toml")
    shutil.copy(folder / "lens.zmx", folder / "fold" / "=lens.zmx")
    shutil.copy(f"{models}.ols-64.onnx", folder / "model.onnx")
    shutil.copy(f"{models}.mlp-16x2.onnx", folder / "network.onnx")
    _plates(folder)
    _pack(folder)
    done(["read", "experiment.toml"])
    done(rendered("thin", "--keep-checkpoint", "--samples", "16"))
    (folder / "out.exr.part").rename(folder / "kept.part")
    for k in (1, 2):
        done(rendered("thin", "--tile", f"{k}/2", "-o", "tile.exr"))
    _layered(folder)
    _right(folder, done)
    done(["survey", "fold", "--no-fit", "-o", "done", "--quiet"])
    if "long runs" in kinds:
        done(["train", "experiment.toml", "-o", "run", "--rounds", "0", "--quiet"])
    for made in (*folder.glob("out.*"), *folder.glob("tile*.png")):
        if made.name != "tile.png":
            made.unlink()
    os.mkfifo(folder / "fifo")


def _plates(folder: Path) -> None:
    """Plates with two lights."""
    from neurolens.pictures.render.pictures import write_exr

    plate = np.full((*PLATE[::-1], 3), 0.1)
    plate[2, 3] = plate[5, 8:10] = 50.0
    write_exr(folder / "plate.exr", plate, metadata={"film_mm": [36, 24]}, layers={"depth": plate[..., 0]})
    write_exr(folder / "half.exr", plate, half=True)


def _layered(folder: Path) -> None:
    """A plate of two parts, and a deep one."""
    header = {"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.scanlineimage}
    wide, high = PLATE
    flat = {c: np.round(np.linspace(k, 1, wide * high), 1).reshape(high, wide) for k, c in enumerate("RGB")}
    layers = {z: {c: v.astype(np.float32) for c, v in (flat | {"Z": np.full((high, wide), z)}).items()} for z in (2, 8)}
    parts = [OpenEXR.Part(dict(header), dict(planes), name=f"at {z}") for z, planes in layers.items()]
    OpenEXR.File(parts).write(str(folder / "parts.exr"))
    deep = {c: np.empty((high, wide), object) for c in "RGBZ"}
    for y, x in np.ndindex(high, wide):
        for c in deep:
            deep[c][y, x] = np.array([layers[z][c][y, x] for z in (2, 8)][: 1 + x % 2])
    OpenEXR.File(header | {"type": OpenEXR.deepscanline}, deep).write(str(folder / "deep.exr"))


def _right(folder: Path, done: Callable[[Words], None]) -> None:
    """The pictures that commands of the kinds "cut ..." write from good files, by the names of these in right/."""
    (folder / "right").mkdir()

    def keep(name: str, out: str = "out.exr") -> None:
        shutil.copy(folder / out, folder / "right" / f"{name.replace('/', '-')}.exr")

    scene = (folder / "scene.toml").read_text()
    for name in SHOWN:
        done(with_picture(folder, name))
        keep(name)
    (folder / "scene.toml").write_text(scene)
    for name in LAYERED:
        done(defocused(name))
        keep(name)
    done(rendered("thin", "--samples", "16"))
    keep("out.exr.part")
    tiles = sorted(file.name for file in folder.glob("tile.tile-*.exr"))
    done(merging(*tiles))
    for name in tiles:
        keep(name)
    done(HANDOVER)
    for file in sorted(folder.glob("maps/*.exr")):
        keep(name := str(file.relative_to(folder)), name)


def _pack(folder: Path) -> None:
    """The extension with one lens, as a zip and as a user folder."""
    from neurolens.programs.blender import Form, PackedLens, add_lens, write_pack

    form = Form("polynomial", "ols-36", "shader", 1.0, 21.6, 1.8, 0.7)
    lens = PackedLens("gauss", "Gauss", 50.0, 1.8, "US 2 1973", b"PNG", [form])
    write_pack(folder / "pack.zip", [lens])
    add_lens(folder / "user", lens)
