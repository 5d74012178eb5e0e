"""The card of a model file: how it is read, what must stand in it, and its lens and domain at any state.

A file is a complete ONNX model for other programs. This package neither parses nor runs its nodes: it reads the card
and the coefficients in the file's metadata, and builds the graph again from them (`models.file`).
`models.export` writes cards. Nothing here needs torch.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base.errors import InputError, ModelError
from neurolens.base.files import read_bytes
from neurolens.base.tomlfile import parse_json
from neurolens.graph.protobuf import walk
from neurolens.models.axes import Array, Axis, product, weights

# Metadata entries of a file, the card's own first words, and its most characters: the longest that ships has 64,000.
CARD_KEY, MODEL_KEY = "neurolens", "neurolens.coefficients"
CARD_KIND, CARD_SCHEMA = "neurolens.lens_model", 1
MAX_CARD = 2**20

# Transmittance of unpolarised light, with the polarisation that surfaces give to it.
POLARISED = "polarised"

_MAX_BYTES = 64 * 2**20
_MAX_ENTRIES = 100  # of metadata; models have two
_GRAPH, _METADATA, _KEY, _VALUE = 7, 14, 1, 2  # fields of ModelProto and of StringStringEntryProto
_MESSAGE = 2  # wire type
_ROUNDED = 0.01  # relative rounding of the source's own figures for the ends of a zoom
_FAR = 1e-9  # 1 / distance (1/m) that counts as infinity


def read_metadata(path: str | Path) -> dict[str, str]:
    """Return the metadata of a model file.

    Raises:
        ModelError: a file that is missing, too large, truncated, or no ONNX model, or with an entry that stands twice.
    """
    file = Path(path)
    try:
        data = read_bytes(file, _MAX_BYTES, "an exported lens model (.onnx)")
    except InputError as error:
        raise ModelError(str(error)) from None
    entries: dict[str, str] = {}
    try:
        graphs = 0
        for number, wire, value in walk(memoryview(data)):
            graphs += number == _GRAPH and wire == _MESSAGE
            if number == _METADATA:
                key, text = _entry(value)
                if key in entries or len(entries) == _MAX_ENTRIES:
                    raise ValueError(f"metadata: {key!r} stands twice, or more than {_MAX_ENTRIES} entries")
                entries[key] = text
        if graphs != 1:
            raise ValueError(f"{graphs} graphs, expected 1")
    except (ValueError, TypeError) as error:
        raise ModelError(f"{file}: truncated, or not an ONNX model ({error})") from error
    return entries


def _entry(data: Any) -> tuple[str, str]:
    """Return key and text of an entry of metadata. Raises ValueError or TypeError where it is none."""
    texts = {_KEY: "", _VALUE: ""}
    for number, wire, value in walk(memoryview(data)):
        if wire != _MESSAGE or number not in texts:
            raise ValueError("an entry of metadata with another field than its key and its text")
        texts[number] = bytes(value).decode("utf-8")
    return texts[_KEY], texts[_VALUE]


def read_card(path: str | Path) -> dict[str, Any]:
    """Return the card of a lens model's file; only its kind and its schema are checked.

    Raises:
        ModelError: as `read_metadata` and `card_in`.
    """
    return card_in(path, read_metadata(path))


def card_in(file: Any, metadata: dict[str, str], expected: str = CARD_KIND) -> dict[str, Any]:
    """Return the card in a file's metadata.

    Args:
        file: the name that an error shows.
        expected: the card's kind.

    Raises:
        ModelError: no card, one of more than `MAX_CARD` characters, that is not strict JSON, or of another kind or
            schema.
    """
    if CARD_KEY not in metadata:
        raise ModelError(f"{file}: no card: its metadata has no {CARD_KEY!r}, so this is no model made by neurolens")
    if len(metadata[CARD_KEY]) > MAX_CARD:
        raise ModelError(f"{file}: card: {len(metadata[CARD_KEY])} characters, expected at most {MAX_CARD}")
    try:
        card = parse_json(metadata[CARD_KEY], "card")
    except (ValueError, RecursionError) as error:
        raise ModelError(f"{file}: the card is not strict JSON ({error})") from error
    table = card if isinstance(card, dict) else {}
    for key, wanted in (("kind", expected), ("schema", CARD_SCHEMA)):
        if table.get(key) != wanted:
            raise ModelError(f"{file}: card: {key}: got {table.get(key)!r}, expected {wanted!r}")
    return table


def card_to_json(card: dict[str, Any]) -> str:
    """Return a card as strict JSON, in which a number that is not finite is an error, never the word NaN.

    Raises:
        InputError: a value that JSON cannot hold, with its place in the card; more than `MAX_CARD` characters, which no
            reader takes.
    """
    try:
        text = json.dumps(card, allow_nan=False)
    except (TypeError, ValueError) as error:
        field, value = _culprit(card, "")
        raise InputError("model card", field, value, "finite numbers, text, lists and dictionaries") from error
    if len(text) > MAX_CARD:
        raise InputError("model card", "length", f"({len(text)} characters)", f"at most {MAX_CARD}")
    return text


def _culprit(value: Any, path: str) -> tuple[str, Any]:
    """Return the place of the first value that JSON cannot hold, and the value."""
    items: Any = value.items() if isinstance(value, dict) else ()
    if isinstance(value, (list, tuple)):
        items = enumerate(value)
    for key, inner in items:
        try:
            json.dumps(inner, allow_nan=False)
        except (TypeError, ValueError):
            return _culprit(inner, f"{path}.{key}" if path else str(key))
    return path, value


# ---- what must stand in a card ----


def _is_number(value: Any) -> bool:
    """Return whether this is a number of JSON that a float holds."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    try:
        return math.isfinite(float(value))
    except OverflowError:  # an integer beyond every float
        return False


def _is_positive(value: Any) -> bool:
    """Return whether a number and its reciprocal are above 0 in float32, too."""
    return _is_number(value) and 1e-30 <= value <= 1e30


def _is_integer(value: Any, least: int, most: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= most


def _is_list(value: Any, holds: Callable[[Any], bool], least: int = 0, most: float = math.inf) -> bool:
    return isinstance(value, list) and least <= len(value) <= most and all(map(holds, value))


def _are_errors(value: Any, depth: int = 3) -> bool:
    """Return whether these are figures by name, with tables inside for parts of the rays; lists are for readers."""
    return isinstance(value, dict) and all(
        v is None
        or isinstance(v, (bool, str, list))
        or (_is_number(v) and v >= 0)
        or (depth > 0 and _are_errors(v, depth - 1))
        for v in value.values()
    )


Rule = tuple[Callable[[Any], bool], str]
_NUMBER: Rule = (_is_number, "a finite number")
_POSITIVE: Rule = (_is_positive, "a finite number above 0")
_TEXT: Rule = (lambda v: isinstance(v, str), "a text")
_TABLE: Rule = (lambda v: isinstance(v, dict), "a table")
_NUMBERS: Rule = (lambda v: _is_list(v, _is_number, 2), "a list of two or more finite numbers")
_RISING: Rule = (lambda v: _is_list(v, _is_positive, 2, 2) and v[0] <= v[1], "two numbers above 0, rising")

# Places that everything later may read, and what must be there. A table comes before what is in it.
_LENS_AND_DOMAIN: dict[str, Rule] = {
    "lens": _TABLE,
    **dict.fromkeys(("lens.id", "lens.name", "lens.sha256"), _TEXT),
    "lens.dispersive": (lambda v: isinstance(v, bool), "true or false"),
    "lens.efl_mm": (lambda v: _is_number(v) and v != 0, "a finite number other than 0"),
    **dict.fromkeys(("lens.f_number", "lens.stop_radius_mm"), _POSITIVE),
    **dict.fromkeys((f"lens.{at}_z_mm" for at in ("front_principal", "rear_principal", "infinity_film")), _NUMBER),
    "domain": _TABLE,
    **dict.fromkeys(("domain.film_radius_mm", "domain.pupil_radius_mm", "domain.stop_radius_mm"), _POSITIVE),
    **dict.fromkeys(("domain.film_z_mm", "domain.wavelength_nm"), _RISING),
    "domain.focus_m": (
        lambda v: _is_list(v, lambda d: d == "inf" or _is_positive(d), 2, 2),
        'two distances above 0, or "inf"',
    ),
    "domain.pupil_z_mm": _NUMBER,
    "domain.bounds": _TABLE,
    "domain.bounds.pupil_z_mm": _NUMBER,
    **dict.fromkeys(("domain.bounds.film_radius_mm", "domain.bounds.disc_mm"), _POSITIVE),
    **dict.fromkeys((f"domain.bounds.{name}_mm" for name in ("low", "high", "half")), _NUMBERS),
}
_RULES: dict[str, Rule] = {
    **_LENS_AND_DOMAIN,
    "transmittance": (lambda v: v == POLARISED, f'"{POLARISED}"'),
    "fit": _TABLE,
    "fit.method": _TEXT,
    "fit.settings": _TABLE,
    "errors": (_are_errors, "a table of figures from 0 up, of tables of such, of texts and lists"),
}
_NODE_RULES = {**_LENS_AND_DOMAIN, "lens.film_z_mm": _NUMBER}
_OPTIONAL: dict[str, Rule] = {
    "lens.stop_surface": (lambda v: _is_integer(v, 0, 9999), "an integer"),
    "lens.index_ratio": _POSITIVE,
    "lens.coatings": _TEXT,
    "domain.nearest_m": (lambda v: v is None or _is_positive(v), "a number above 0, or null"),
    "errors.poor": (lambda v: _is_list(v, lambda t: isinstance(t, str)), "a list of texts"),
    "fit.settings.rays_seed": (
        lambda v: v is None or _is_integer(v, -(2**53), 2**53),
        "an integer up to 2^53, or null",
    ),
}


def check_card(file: Any, card: Mapping[str, Any]) -> None:
    """Check a card.

    Args:
        file: what an error names.

    Raises:
        ModelError: something is missing or wrong; the message names the first such place and what belongs there.
    """
    _check_places(f"{file}: card", card, _RULES)
    if card.get("states") is None:
        return
    states = card["states"]
    try:
        axes = axes_of(card)
        names = [a.name for a in axes]
        if not axes or len(set(names)) < len(names) or not set(names) <= {"zoom", "focus"}:
            raise InputError("card", "states.axes", names, "zoom, focus, or both")
        nodes, count = states["nodes"], len(product(axes))
        if not isinstance(nodes, list) or len(nodes) != count:
            raise InputError("card", "states.nodes", f"({len(nodes)})", f"a list of {count}")
        for node in nodes:
            _check_places(f"{file}: card: states.nodes", node, _NODE_RULES)
        for reference in states["reference"]:
            weights(axes, [float(v) for v in reference["state"]])
        card_at(card, axes, default_state(card))
    except (InputError, KeyError, TypeError, ValueError, ArithmeticError, AttributeError) as error:
        raise ModelError(f"{file}: card: states: {type(error).__name__}: {error}") from error


def _check_places(where: str, card: Mapping[str, Any], rules: Mapping[str, Rule]) -> None:
    for path, (holds, expected) in {**rules, **_OPTIONAL}.items():
        *tables, last = path.split(".")
        # All tables but the last are there, for they have rules of their own; a node has the lens and the domain alone.
        table = reduce(lambda table, key: table.get(key, {}), tables, card)
        if path in _OPTIONAL and last not in table:
            continue
        if last not in table or not holds(table[last]):
            shown = repr(table[last])[:80] if last in table else "(missing)"
            raise ModelError(f"{where}: {path}: got {shown}, expected {expected}")
    try:
        pupil_rows(card["domain"]["bounds"])
    except (InputError, ValueError, OverflowError) as error:
        raise ModelError(f"{where}: domain.bounds: {error}") from error


@np.errstate(over="ignore")
def pupil_rows(bounds: Mapping[str, Any]) -> NDArray[np.float32]:
    """Return low, high and half [3, R] of the boxes in a card's bounds.

    Raises:
        InputError: the bounds are not three lists of equal length, or float32 cannot hold their numbers.
    """
    rows = np.array([bounds["low_mm"], bounds["high_mm"], bounds["half_mm"]], dtype=np.float32)
    if rows.ndim != 2 or rows.shape[1] < 2 or not np.isfinite(rows).all():
        raise InputError("pupil bounds", "low_mm, high_mm, half_mm", rows.shape, "three lists of finite numbers")
    return rows


# ---- states of a zoom, or of internal focus ----


def axes_of(card: Mapping[str, Any]) -> tuple[Axis, ...]:
    """Return the state axes of a checked card; none for a model of one state."""
    states = card.get("states")
    return tuple(Axis.from_dict(a) for a in states["axes"]) if states else ()


def default_state(card: Mapping[str, Any]) -> tuple[float, ...]:
    """Return the state whose lens and domain stand in the card itself."""
    states = card.get("states")
    return tuple(float(v) for v in states["default"]) if states else ()


def card_at(card: Mapping[str, Any], axes: Sequence[Axis], state: Sequence[float]) -> dict[str, Any]:
    """Return the card with its lens and domain at a state, mixed from their tables at the nodes.

    What the graph uses as a square is mixed as a square, and what it uses as a reciprocal as a reciprocal. So table and
    graph agree to rounding.

    Raises:
        InputError: another number of values than axes, or one out of range.
    """
    nodes, w = card["states"]["nodes"], weights(axes, state)
    lens = _mix_lens([n["lens"] for n in nodes], w)
    return {**card, "lens": lens, "domain": mix_domain([n["domain"] for n in nodes], w)}


def state_for(
    path: Any, axes: Sequence[Axis], state: Sequence[float], zoom: str | float | None, focus_m: float
) -> tuple[float, ...]:
    """Return the state for a photographer's settings.

    Args:
        path: what an error names.
        axes, state: of the model, and its present state.
        zoom: name of a state of the source, or a focal length in mm; None leaves it as it is.
        focus_m: distance from the film to the object, for internal focus.

    Raises:
        InputError: a zoom position or an internal focus that the model does not have.
    """
    values = dict(zip((a.name for a in axes), state, strict=True))
    for axis in axes:
        if axis.name == "zoom" and zoom is not None:
            values["zoom"] = _zoom_mm(path, axis, zoom)
        elif axis.name == "focus":
            values["focus"] = min(max(1 / focus_m, axis.range[0]), axis.limits[1])
            if 1 / focus_m > axis.limits[1]:
                expected = f"at least {1 / axis.range[1]:.4g} m, the model's near limit"
                raise InputError(path, "focus_m", focus_m, expected)
    if zoom is not None and "zoom" not in values:
        raise InputError(path, "zoom", zoom, "left out: the model is of one zoom position")
    return tuple(values.values())


def _zoom_mm(path: Any, axis: Axis, zoom: str | float) -> float:
    """Return the focal length of a zoom position, which is a name in the source or a number within the range."""
    low, high = axis.range
    named = dict(axis.stated)
    try:
        value = named[zoom] if isinstance(zoom, str) and zoom in named else float(zoom)
    except ValueError:
        value = float("nan")
    if not low * (1 - _ROUNDED) <= value <= high * (1 + _ROUNDED):
        expected = f"a focal length from {low:.5g} to {high:.5g} mm, or one of: {', '.join(named)}"
        raise InputError(path, "zoom", zoom, expected)
    return min(max(value, low), high)


def mix_domain(nodes: Sequence[Mapping[str, Any]], weights: Array) -> dict[str, Any]:
    """Mix the domain (as `models.fitted.Domain.to_dict` writes it) of a state from nodes with weights [K].

    Wavelengths and the nearest object are those of the first node; the distances in focus are mixed as 1 / distance.
    """
    bounds = [n["bounds"] for n in nodes]
    mixed = _mixed_fields(nodes, weights, "film_z_mm", "pupil_z_mm", "stop_radius_mm")
    for key in ("film_radius_mm", "pupil_radius_mm"):
        mixed[key] = math.sqrt(_mixed([float(n[key]) ** 2 for n in nodes], weights))
    nearness = [_mixed([1 / float(n["focus_m"][i]) for n in nodes], weights) for i in (0, 1)]
    mixed["focus_m"] = [1 / v if v > _FAR else "inf" for v in nearness]
    table = _mixed_fields(bounds, weights, "low_mm", "high_mm", "half_mm", "disc_mm")
    table |= {k: mixed[k] for k in ("pupil_z_mm", "film_radius_mm")}
    return {**nodes[0], **mixed, "bounds": {**bounds[0], **table}}


def _mix_lens(nodes: Sequence[Mapping[str, Any]], weights: Array) -> dict[str, Any]:
    """Mix the card's table of the lens at a state.

    The power 1 / f, the front focal distance over f and the back focal plane are sums of products of the gaps: they
    are mixed, and the principal planes follow.
    """
    linear = _mixed_fields(nodes, weights, "f_number", "stop_radius_mm", "film_z_mm", "infinity_film_z_mm")
    efl, ratio = 1 / _mixed([1 / n["efl_mm"] for n in nodes], weights), float(nodes[0].get("index_ratio", 1.0))
    focal = [(n["front_principal_z_mm"] - ratio * n["efl_mm"]) / n["efl_mm"] for n in nodes]
    pupils = [n.get("exit_pupil_z_mm", "inf") for n in nodes]
    return {
        **nodes[0],
        **linear,
        "efl_mm": efl,
        "front_principal_z_mm": efl * _mixed(focal, weights) + ratio * efl,
        "rear_principal_z_mm": linear["infinity_film_z_mm"] - efl,
        "exit_pupil_z_mm": "inf" if "inf" in pupils else _mixed(pupils, weights),
    }


def _mixed_fields(tables: Sequence[Mapping[str, Any]], weights: Array, *names: str) -> dict[str, Any]:
    return {name: _mixed([table[name] for table in tables], weights) for name in names}


def _mixed(values: Sequence[ArrayLike], weights: Array) -> Any:
    """Return the weighted sum of numbers or lists; exactly a node's value where its weight is 1."""
    total = weights @ np.asarray(values, dtype=np.float64)
    return float(total) if total.ndim == 0 else total.tolist()
