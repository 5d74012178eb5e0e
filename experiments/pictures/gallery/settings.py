"""The contents of a file of experiments/gallery: an effect and its panels, each a shot through one state of a lens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from neurolens.base.errors import InputError
from neurolens.base.settings import from_dict
from neurolens.base.tomlfile import read_toml, suggestion
from neurolens.models.fit import ModelSettings
from neurolens.optics.lens.shot import FocusMode, Vignetting

COLUMNS = ("exact", "surrogate", "thin")


@dataclass(frozen=True)
class Panel:
    """One row of a figure.

    Attributes:
        label: what differs from the other rows.
        lens, scene, model, aperture_mask: files beside the effect's. model: a shipped one; None fits one.
        focal_length_mm, field_deg, zoom, focus_mode: see `set_lens`.
        widen: factor on all rims but the stop's, where an effect asks for more than the lens lets through; no rim
            comes nearer than 5% to its surface's radius of curvature.
        f_number: None takes the scene's, else the lens's own.
        focus_m: from the film; None takes the scene's. film_offset_mm: away from the lens, after focusing.
        film_tilt_deg: of the film of the exact lens and of models, as of `neurolens.optics.lens.shot`.
        film_mm: None takes the scene's. window_mm: the part that is drawn: centre x and y as printed (x right, y up),
            width and height; None draws all of it.
        width, samples: of the picture.
        exposure: stops, or "auto": the exact picture's 99.5th percentile becomes nine tenths of white.
        blades, blade_rotation_deg, blade_curvature, aperture_mask: shape of the stop; see `Aperture`.
        vignetting: the parts of the light fall-off that the camera keeps; see `neurolens.cameras.reduced`.
        fit: settings of the surrogate.
        options: numbers that the effect's measure asks for, by name.
    """

    label: str
    lens: Path
    scene: Path
    focal_length_mm: float | None = None
    field_deg: float | None = None
    zoom: str | float | None = None
    focus_mode: FocusMode = "paraxial"
    widen: float = 1.0
    f_number: float | None = None
    focus_m: float | None = None
    film_offset_mm: float = 0.0
    film_tilt_deg: float = 0.0
    film_mm: tuple[float, float] | None = None
    window_mm: tuple[float, float, float, float] | None = None
    width: int = 240
    samples: int = 64
    exposure: float | Literal["auto"] = 0.0
    blades: int | None = None
    blade_rotation_deg: float | None = None
    blade_curvature: float | None = None
    aperture_mask: Path | None = None
    model: Path | None = None
    vignetting: Vignetting = "both"
    fit: ModelSettings = ModelSettings(terms=64)
    options: dict[str, float] | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.widen <= 4:
            raise InputError("settings", "widen", self.widen, "a factor from 1 to 4")
        for field, most in (("width", 2048), ("samples", 1 << 16)):
            if not 1 <= getattr(self, field) <= most:
                raise InputError("settings", field, getattr(self, field), f"an integer from 1 to {most}")
        sizes = (*(self.film_mm or ()), *(self.window_mm or ())[2:])
        if not all(0 < size < 1e4 for size in sizes):
            raise InputError("settings", "film_mm, window_mm", sizes, "widths and heights in mm above 0")

    def option(self, name: str, default: float) -> float:
        """A number for the measure."""
        return (self.options or {}).get(name, default)

    def files(self) -> list[Path]:
        """The files that the panel is made from."""
        named = (self.lens, self.scene, self.aperture_mask, self.model)
        return [file for file in named if file is not None]


@dataclass(frozen=True)
class Effect:
    """A figure of the gallery.

    Attributes:
        title, text: for the page. source: what it is after (thesis and figure), and what differs from there.
        measure: name in `measures.MEASURES`.
        columns: cameras of every row, names in `cameras.CAMERAS`; where exact and surrogate are among them, their
            difference comes last.
        path: of the file.
    """

    title: str
    text: str
    source: str
    measure: str
    panel: tuple[Panel, ...]
    columns: tuple[str, ...] = COLUMNS
    path: Path = Path("effect")

    @property
    def name(self) -> str:
        return self.path.stem


def read_effect(path: str | Path) -> Effect:
    """Read an effect: [shot] holds what all panels share, each [[panel]] what it has of its own.

    Raises:
        InputError: file, field, value and what was expected; no panel, two of one label.
    """
    path = Path(path)
    tables = read_toml(path)
    shared, panels = tables.pop("shot", {}), tables.get("panel", [])
    if not isinstance(shared, dict) or not isinstance(panels, list) or not all(isinstance(p, dict) for p in panels):
        raise InputError(path, "shot, panel", "(no such form)", "a table [shot] and tables [[panel]]")
    merged: dict[str, Any] = {**tables, "panel": [{**shared, **panel} for panel in panels]}
    effect = from_dict(Effect, merged, path)
    labels = [panel.label for panel in effect.panel]
    if not labels or len({*labels}) < len(labels):
        raise InputError(path, "panel", labels, "at least one [[panel]], each with a label of its own")
    return replace(effect, panel=tuple(_beside(path, panel) for panel in effect.panel), path=path)


def _beside(path: Path, panel: Panel) -> Panel:
    names = ("lens", "scene", "aperture_mask", "model")
    placed = {name: path.parent / file for name in names if (file := getattr(panel, name)) is not None}
    return replace(panel, **placed)


def find_effects(folder: Path, names: Sequence[str] = ()) -> list[Path]:
    """The files of the effects named, or of all, in the gallery's order (that of their names).

    Raises:
        InputError: a name that no file has, a folder without effects.
    """
    files = {file.stem: file for file in sorted(folder.glob("*.toml"))}
    if not files:
        raise InputError(folder, "effects", "(none)", "a folder of effect files (.toml)")
    for name in names:
        if name not in files:
            known = ", ".join(files)
            raise InputError("gallery", "EFFECT", name, f"one of: {known}{suggestion(name, list(files))}")
    return [file for stem, file in files.items() if not names or stem in names]
