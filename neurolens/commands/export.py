"""`neurolens export MODEL`: source code of an exported model, or the same model for what a scene fixes."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens.base.errors import InputError
from neurolens.base.files import atomic_path, check_writable
from neurolens.commands.arguments import add_json
from neurolens.commands.output import answer

if TYPE_CHECKING:
    from neurolens.surrogates.model import LensModel
    from neurolens.surrogates.pairs import RayPairs
    from neurolens.surrogates.source import Written
    from neurolens.surrogates.specialise import Fix

_DESCRIPTION = """\
Write an exported model in another form: a self-contained C99 header (one function for a ray, one for
arrays that compilers vectorise), a GLSL function, or an ONNX file. Domain guard, stop, rims,
transmittance and status codes are those of the model; the card is a comment at the top.
Needs the extra "train" (torch); without it C and GLSL are written from the graph in the file,
whole and with nothing fixed."""
_EPILOG = """\
values fixed by a scene are folded into fewer operations (--fix, repeatable):
  wavelengths=450,550,650   one coefficient table per wavelength, chosen by the argument band (a single one:
                            no argument; an ONNX file takes one)
  film_z=59.2 | focus=2.0   film plane z in mm, or the object distance from the film in m that it focuses
  stop=4.5 | f_number=5.6   stop radius in mm, or the f-number it gives

examples:
  neurolens export models/laikin_double_gauss_50.ols-60.onnx --to c -o gauss.h
  neurolens export models/NAME.onnx --to glsl -o lens.glsl --fix wavelengths=450,550,650 --fix focus=2
  neurolens export runs/quickstart --to c -o ray.h --only ray
  neurolens export models/NAME.onnx --to onnx -o laser.onnx --fix wavelengths=633
  neurolens export models/NAME.onnx --to onnx -o lens.onnx --derivatives  # for ray differentials
  neurolens export models/NAME.onnx --to onnx -o a.onnx --inverse         # and a.stop.onnx, a.scene.onnx"""
_PARTS = ("ray", "transmittance", "stop", "vignetting")
_FIXED = ("wavelengths", "film_z", "focus", "stop", "f_number")
# Rays for the errors of an ONNX file with fixed inputs; rays to fit inverse maps.
_HELD_OUT, _VIGNETTING, _TRAIN = 20_000, 100_000, 15_000


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "export", help="source code (C, GLSL) of a model; fix what a scene fixes", description=_DESCRIPTION,
        epilog=_EPILOG,
    )  # fmt: skip
    parser.add_argument(
        "model", metavar="MODEL", type=Path, help="exported model (.onnx), or a run folder with one model"
    )
    parser.add_argument("--to", choices=("c", "glsl", "onnx"), required=True, help="form to write")
    parser.add_argument("-o", "--out", metavar="FILE", type=Path, required=True, help="file to write")
    parser.add_argument(
        "--fix", metavar="KEY=VALUE", action="append", default=[], help="a value fixed by the scene (see below)"
    )
    parser.add_argument(
        "--only", metavar="PARTS", default=",".join(_PARTS),
        help=f"comma-separated: {', '.join(_PARTS)} (default: all; the domain guard is always there)",
    )  # fmt: skip
    parser.add_argument("--name", metavar="WORD", help="of the function (default: the lens's id)")
    parser.add_argument("--derivatives", action="store_true", help="of ONNX: additional outputs for ray differentials")
    parser.add_argument(
        "--inverse", action="store_true",
        help="of ONNX: the inverse maps too (film and stop point to ray; scene ray to film), fitted and checked",
    )  # fmt: skip
    add_json(parser)
    parser.set_defaults(run=run, kept="nothing is written")


def run(args: argparse.Namespace) -> int:
    """Load, fix, write."""
    file = model_file(args.model)
    parts = _parts(args.only)
    given = _given(args.fix)
    if args.to == "onnx" and (args.name is not None or set(parts) != set(_PARTS)):
        raise InputError("neurolens export", "--only, --name", "(with --to onnx)", "neither: an ONNX file is whole")
    if args.to != "onnx" and (args.derivatives or args.inverse):
        raise InputError("neurolens export", "--derivatives, --inverse", f"(with --to {args.to})", "--to onnx")
    check_writable(args.out)
    if args.to != "onnx" and set(parts) == set(_PARTS) and not given and find_spec("torch") is None:
        from neurolens.surrogates.source import export_file

        return _answer(args, _about(export_file(file, args.out, args.to, args.name)))
    from neurolens.cameras.model import load_model
    from neurolens.surrogates.source import Parts, export_source
    from neurolens.surrogates.specialise import fixed_models
    from neurolens.surrogates.stored import load_fitted

    card = load_model(file).card
    model = load_fitted(file)
    fix = _fix(given, model)
    models = fixed_models(model, fix)
    if args.to == "onnx":
        _write_onnx(models, args.out, card if not given else None, args.derivatives)
        about: dict[str, Any] = _write_inverse(models[0], args.out) if args.inverse else {}
    else:
        asked = Parts(*(name in parts for name in _PARTS[1:]))
        written = export_source(models, args.out, args.to, card, parts=asked, fix=fix, name=args.name)
        about = _about(written, [m.domain.wavelength_nm[0] for m in models])
    return _answer(args, about)


def _about(written: Written, bands_nm: Sequence[float] = ()) -> dict[str, Any]:
    """What --json tells of source code."""
    s = written.signature
    return {
        "function": s.name,
        "inputs": s.inputs,
        "outputs": [*s.outputs, "status"],
        "bands_nm": bands_nm if s.bands > 1 else [],
        "operations_per_ray": written.operations,
    }


def _answer(args: argparse.Namespace, about: dict[str, Any]) -> int:
    data = {"file": str(args.out), "to": args.to, "bytes": args.out.stat().st_size, **about}
    maps = about.get("inverse", {}).values()
    said = [f"{m['file']}: finds {m['converged']:.3%} of the model's rays in three steps" for m in maps]
    return answer(args, data, lambda: "\n".join([str(args.out), *said]))


def model_file(path: Path) -> Path:
    """The model that a path names: a file, or the one model of a run folder.

    Raises:
        InputError: a folder that holds none, or several.
    """
    if not path.is_dir():
        return path
    files = sorted(p for folder in (path, path / "models") for p in folder.glob("*.onnx"))
    # Inverse maps and unfinished files of an interrupted run lie beside models.
    found = [p for p in files if not p.name.startswith(".") and not p.name.endswith((".stop.onnx", ".scene.onnx"))]
    if len(found) != 1:
        names = ", ".join(str(p) for p in found) or "(none)"
        raise InputError("neurolens export", str(path), f"({names})", "one exported model: name its file")
    return found[0]


def _parts(text: str) -> list[str]:
    parts = [word.strip() for word in text.split(",")]
    unknown = [p for p in parts if p not in _PARTS]
    if unknown or "ray" not in parts:
        raise InputError("neurolens export", "--only", text, f"ray, and of {', '.join(_PARTS[1:])} what is wanted")
    return parts


def _given(texts: list[str]) -> dict[str, list[float]]:
    found: dict[str, list[float]] = {}
    for text in texts:
        key, _, value = text.partition("=")
        try:
            numbers = [float(v) for v in value.split(",")]
        except ValueError:
            numbers = []
        infinite = key == "focus"
        good = bool(numbers) and all(v > 0 and (infinite or math.isfinite(v)) for v in numbers)
        if key not in _FIXED or key in found or not good or (key != "wavelengths" and len(numbers) > 1):
            expected = f"KEY=NUMBER with KEY of {', '.join(_FIXED)} (wavelengths: a list), each once, above 0"
            raise InputError("neurolens export", "--fix", text, expected)
        found[key] = numbers
    for pair in (("film_z", "focus"), ("stop", "f_number")):
        if all(key in found for key in pair):
            raise InputError("neurolens export", "--fix", f"(both {' and '.join(pair)})", "one of them")
    return found


def _fix(given: dict[str, list[float]], model: LensModel) -> Fix:
    from neurolens.optics.paraxial import film_z_mm
    from neurolens.surrogates.specialise import Fix

    film_z = given.get("film_z", [None])[0]
    stop = given.get("stop", [None])[0]
    if "focus" in given:
        film_z = film_z_mm(model.lens, given["focus"][0])
    if "f_number" in given:
        stop = model.lens.at(f_number=given["f_number"][0]).stop_radius_mm
    return Fix(tuple(given.get("wavelengths", ())), film_z, stop)


def _write_onnx(models: tuple[LensModel, ...], out: Path, card: dict[str, Any] | None, derivatives: bool) -> None:
    """The graph with its card: the errors of the card given, or measured anew for what was fixed."""
    from neurolens.cameras.model import load_model
    from neurolens.evaluate.measure import fresh_rays, measure_on
    from neurolens.surrogates.export import export_onnx

    if len(models) > 1:
        wavelengths = [m.domain.wavelength_nm[0] for m in models]
        raise InputError("neurolens export", "--fix wavelengths", wavelengths, "one wavelength for an ONNX file")
    model = models[0]
    if card is not None:
        export_onnx(model, out, card["errors"], derivatives=derivatives)
        return
    seed, held_out = _seed(model), _pairs(model, train=1).held_out
    with atomic_path(out) as measured:  # a file without its errors never has the final name
        export_onnx(model, measured, {})
        rays = fresh_rays(model.lens, model.domain, held_out, count=_VIGNETTING, seed=seed + 1)
        errors = measure_on(rays, load_model(measured))
        export_onnx(model, measured, errors, derivatives=derivatives)


def _write_inverse(model: LensModel, out: Path) -> dict[str, Any]:
    """Both inverse maps beside the model's file: their files, and the share of fresh rays that each finds."""
    from neurolens.cameras.model import load_model
    from neurolens.surrogates.export import export_inverse
    from neurolens.surrogates.inverse_fit import convergence, fit_inverse

    pairs = _pairs(model, train=_TRAIN)
    inverse = fit_inverse(model, pairs)
    found = convergence(inverse, pairs.held_out.inputs)
    files = export_inverse(inverse, out, load_model(out).card["errors"])
    return {"inverse": {n: {"file": str(f), **found[n]} for n, f in zip(("stop", "scene"), files, strict=True)}}


def _seed(model: LensModel) -> int:
    from neurolens.evaluate.measure import FRESH

    return int(model.settings.get("rays_seed") or 0) + FRESH


def _pairs(model: LensModel, train: int) -> RayPairs:
    from neurolens.surrogates.pairs import PairSettings, make_pairs

    settings = PairSettings(train=train, held_out=_HELD_OUT, rim=train, seed=_seed(model))
    return make_pairs(model.lens, model.domain, settings)
