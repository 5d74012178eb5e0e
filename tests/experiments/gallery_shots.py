"""Cameras of gallery shots for tests: the exact lens, a shipped surrogate and the thin lens, without pictures."""

from pathlib import Path
from typing import Any

import numpy as np

from experiments.pictures.gallery.cameras import CAMERAS, Shot, Surrogate, View, shot_of, surrogate_of
from experiments.pictures.gallery.measures import MEASURES
from experiments.pictures.gallery.settings import Panel
from neurolens.pictures.render.scene import scene_from_tables

ROOT = Path(__file__).parents[2]
GALLERY = ROOT / "experiments" / "gallery"


def shot(lens: str, *, focus_m: float, wavelengths_nm: tuple[float, float] = (550.0, 550.0), **panel: Any) -> Shot:
    """A shot through lenses/`lens`.toml, or a file of the gallery's own lenses."""
    file = ROOT / "lenses" / f"{lens}.toml"
    if not file.exists():
        file = GALLERY / "lenses" / f"{lens}.toml"
    if "model" in panel:
        panel["model"] = ROOT / "models" / f"{lens}{panel['model']}.onnx"
    camera = {
        "position_m": [0, 0, 0],
        "look_at_m": [0, 0, -1],
        "focus_m": focus_m,
        "wavelengths_nm": list(wavelengths_nm),
    }
    panel.setdefault("film_mm", (36.0, 24.0))
    return shot_of(Panel("test", file, Path("scene"), **panel), scene_from_tables({"camera": camera}))


def view(taken: Shot, column: str, surrogate: Surrogate | None = None) -> View:
    """What a measure of camera rays is given; no picture."""
    return View(taken, CAMERAS[column](taken, surrogate), column, np.zeros((1, 1, 3), np.float32))


def measured(taken: Shot, name: str, columns: tuple[str, ...] = ("exact",)) -> dict[str, dict[str, float]]:
    """What a measure finds, by column. A shot with a model is sampled over that model's pupil."""
    surrogate = None if taken.panel.model is None else shipped(taken)
    return {column: MEASURES[name](view(taken, column, surrogate)) for column in columns}


def shipped(taken: Shot) -> Surrogate:
    """The shipped model that the shot names."""
    return surrogate_of([taken], Path("unused"), lambda fraction, seconds_left=None: None)
