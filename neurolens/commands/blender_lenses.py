"""Lenses for Blender's extension, of models and lens files: their shaders, facts and thumbnails."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens.base.errors import InputError
from neurolens.blender.pack import Form, PackedLens
from neurolens.commands.blender_kept import kept_form
from neurolens.commands.export_osl import shader_of

if TYPE_CHECKING:
    from neurolens.optics.prescription import Lens

_SIDE_IN, _DOTS = 2.56, 100  # of a thumbnail: 256 pixels
_NETWORK = "mlp"


def form_of(file: Path, *, zoom: str | None = None, quiet: bool = False) -> Form:
    """The shader of a model (.onnx) or of a lens file (.toml), with its facts; kept between runs.

    Raises:
        InputError: neither; a lens that cannot be a shader. ModelError: a broken model.
    """
    if file.suffix not in (".onnx", ".toml"):
        raise InputError(file, "file", file.suffix or "(no suffix)", "a model (.onnx) or a lens file (.toml)")
    return kept_form(file, zoom, lambda: _made_form(file, zoom, quiet))


def _made_form(file: Path, zoom: str | None, quiet: bool) -> Form:
    shader = shader_of(file, zoom=zoom, quiet=quiet)
    kind, model, error, poor = "exact", "", None, []
    if file.suffix == ".onnx":
        card = _card(file)
        model, error = str(card["fit"]["method"]), float(card["errors"]["rms_um"])
        kind = "network" if _family(card).startswith(_NETWORK) else "polynomial"
        poor = list(card["errors"].get("poor") or ())
    return Form(
        kind, model, shader.text, error, shader.film_radius_mm, shader.f_number, shader.nearest_m, poor,
        [] if zoom is None else [f"The zoom stands at {zoom}"],
    )  # fmt: skip


def packed_of(
    files: Sequence[Path],
    *,
    lens: Lens | None = None,
    zoom: str | None = None,
    quiet: bool,
    report: Callable[[float], object] = lambda share: None,
) -> PackedLens:
    """A lens of the menu from files of one lens; `lens` is its prescription, for the thumbnail, where it is at hand.

    Raises:
        InputError: as `form_of`.
    """
    forms = []
    for file in files:
        forms.append(form_of(file, zoom=zoom, quiet=quiet))
        report(len(forms) / len(files))
    first = files[0]
    if first.suffix == ".onnx":
        card = _card(first)["lens"]
        name, efl, f_number, source = card["name"], card["efl_mm"], card["f_number"], str(card.get("source") or "")
    else:
        from neurolens.optics.lensfile import read_lens
        from neurolens.optics.paraxial import first_order

        lens = read_lens(first).at(zoom=zoom)
        data = first_order(lens)
        name, efl, f_number, source = lens.name, data.efl_mm, data.f_number, lens.source
    picture = None if lens is None else thumbnail(lens)
    return PackedLens(key_of(first), str(name), float(efl), float(f_number), source, picture, forms)


def key_of(file: Path) -> str:
    """Name of a lens in the menu's files: of `NAME.ols-64.onnx` and `NAME.toml`, NAME."""
    return file.name.split(".")[0]


def library(folder: Path, lenses: Path, chosen: Sequence[str]) -> Iterator[tuple[list[Path], Path | None]]:
    """Of every lens of a folder of models, the best polynomial, the best network, and its lens file, if it has one.

    Args:
        folder: of models. lenses: of lens files. chosen: names of lenses, all where empty.

    Raises:
        InputError: a name that no model has.
    """
    known: dict[str, dict[str, tuple[float, Path]]] = {}
    for file in sorted(folder.glob("*.onnx")):
        card = _card(file)
        kind = "network" if _family(card).startswith(_NETWORK) else "polynomial"
        mine = known.setdefault(key_of(file), {})
        error = float(card["errors"]["rms_um"])
        if kind not in mine or error < mine[kind][0]:
            mine[kind] = error, file
    for name in chosen:
        if name not in known:
            raise InputError("neurolens blender build", "--lens", name, f"one of: {', '.join(known)}")
    for key, kinds in known.items():
        if not chosen or key in chosen:
            lens_file = lenses / f"{key}.toml"
            files = [kinds[kind][1] for kind in ("polynomial", "network") if kind in kinds]
            yield files, lens_file if lens_file.is_file() else None


def thumbnail(lens: Lens) -> bytes | None:
    """The section of a lens as a PNG of 256 by 256 pixels; None where torch or matplotlib is missing."""
    if find_spec("torch") is None or find_spec("matplotlib") is None:
        return None
    from neurolens.analysis.fields import Scene
    from neurolens.analysis.layout import draw_section, layout_profile
    from neurolens.analysis.plot_style import new_figure, style

    with style():
        figure = new_figure(_SIDE_IN, _SIDE_IN)
        figure.set_layout_engine("none")
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        draw_section(axes, layout_profile(Scene(lens.at(), axis="y")), lw=0.5)
        axes.set_axis_off()
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=_DOTS, facecolor="white", metadata={"Software": None})
    return buffer.getvalue()


def _card(file: Path) -> dict[str, Any]:
    from neurolens.modelfile.onnxfile import read_checked

    return read_checked(file)[1]


def _family(card: dict[str, Any]) -> str:
    return str(card["fit"]["settings"].get("method", card["fit"]["method"]))
