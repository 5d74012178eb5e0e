"""The metadata of exported model files, which is all that this package reads of them.

A file is a complete ONNX model for other programs. Its nodes are neither parsed nor run here: the card and the
coefficients in its metadata say what the model is, and its graph is built again from them (`surrogates.file`).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError, ModelError
from neurolens.base.files import read_bytes
from neurolens.base.tomlfile import parse_json
from neurolens.graph.protobuf import walk
from neurolens.surrogates.cardkeys import CARD_KEY, CARD_KIND, CARD_SCHEMA, MAX_CARD

MAX_BYTES = 64 * 2**20
MAX_ENTRIES = 100  # of metadata; models have two
_GRAPH, _METADATA, _KEY, _VALUE = 7, 14, 1, 2  # fields of ModelProto and of StringStringEntryProto
_MESSAGE = 2  # wire type


def read_metadata(path: str | Path) -> dict[str, str]:
    """The metadata of a model file.

    Raises:
        ModelError: a file that is missing, too large, truncated, or no ONNX model, or with an entry that stands twice.
    """
    file = Path(path)
    try:
        data = read_bytes(file, MAX_BYTES, "an exported lens model (.onnx)")
    except InputError as error:
        raise ModelError(str(error)) from None
    entries: dict[str, str] = {}
    try:
        graphs = 0
        for number, wire, value in walk(memoryview(data)):
            graphs += number == _GRAPH and wire == _MESSAGE
            if number == _METADATA:
                key, text = _entry(value)
                if key in entries or len(entries) == MAX_ENTRIES:
                    raise ValueError(f"metadata: {key!r} stands twice, or more than {MAX_ENTRIES} entries")
                entries[key] = text
        if graphs != 1:
            raise ValueError(f"{graphs} graphs, expected 1")
    except (ValueError, TypeError) as error:
        raise ModelError(f"{file}: truncated, or not an ONNX model ({error})") from error
    return entries


def _entry(data: Any) -> tuple[str, str]:
    """Key and text of an entry of metadata. Raises ValueError, TypeError: it is none."""
    texts = {_KEY: "", _VALUE: ""}
    for number, wire, value in walk(memoryview(data)):
        if wire != _MESSAGE or number not in texts:
            raise ValueError("an entry of metadata with another field than its key and its text")
        texts[number] = bytes(value).decode("utf-8")
    return texts[_KEY], texts[_VALUE]


def read_card(path: str | Path) -> dict[str, Any]:
    """The card of a lens model's file; only its kind and its schema are checked.

    Raises:
        ModelError: as `read_metadata` and `card_in`.
    """
    return card_in(path, read_metadata(path))


def card_in(file: Any, metadata: dict[str, str], expected: str = CARD_KIND) -> dict[str, Any]:
    """The card in a file's metadata.

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
    kind = card.get("kind") if isinstance(card, dict) else None
    if kind != expected:
        raise ModelError(f"{file}: card: kind: got {kind!r}, expected {expected!r}")
    if card.get("schema") != CARD_SCHEMA:
        raise ModelError(f"{file}: card: schema: got {card.get('schema')!r}, expected {CARD_SCHEMA}")
    return card
