"""Finds lenses of the library by words: product, maker, focal length, f-number, mount, year, character, nickname.

lenses/index.jsonl tells what each lens is, and lenses/nicknames.jsonl what people call it; no lens file is read.
"""

from __future__ import annotations

import json
import math
import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

from neurolens.base.files import library

INDEX = "index.jsonl"  # in lenses/: a line a lens, {file, sha256, row}, by `python -m experiments lens-index`
NICKNAMES = "nicknames.jsonl"  # a line a nickname: {said: [what people say], means: words of a lens, about: a sentence}
CHARACTER = {  # what a lens is known for: the figure of `studies.describe`, and its heading; strongest first
    "cats-eye": ("cats_eye", "cat's eye"), "swirl": ("swirl", "swirl"), "bubbles": ("bubble", "bubbles"),
    "softness": ("softness_um", "soft um"), "flare": ("flare", "flare"),
}  # fmt: skip
_NEAR, _LONGEST = 3, 300  # lenses that are offered where none has all words; characters of a query that count
# how well a word agrees: it is one of a lens's words, begins one, or stands inside its name
_WHOLE, _BEGUN, _INSIDE = 3, 2, 1
_LIKE = 0.5  # share of a query's mean word: a lens that is less alike is not near
_IDLE = {"lens", "lenses", "mount", "the", "f", "mm"}  # words that people type, and that tell no lens from another
# What makers' names say of a lens's kind in other words: Nikon's PC and Canon's TS-E tilt and shift; Micro is macro.
_KINDS = {r"\b(?:pc|ts-e|t/s)\b": "tilt shift", r"\b(?:micro|makro)\b": "macro"}
# A query with a sign that no name of a lens has is code, or a mistake: its words are not taken for those of lenses.
_NO_NAME = re.compile(r"[^\w\s./*()\[\],:'\N{RIGHT SINGLE QUOTATION MARK}&+-]")
_N = r"\d{1,6}(?:\.\d+)?"
_TOKEN = re.compile(
    rf"(?:\b[ft]/ ?|\b[ft](?=\d)|\b1:(?=[2-9]|\d\.))({_N})(?:-{_N})?|((?:18|19|20)\d0)'?s\b|({_N})-({_N}) ?mm"
    rf"|({_N}) ?(mm|cm)|({_N})|([^\W\d_]+)"
)


def words_of(text: str) -> list[str]:
    """Split a text as photographers read it: "Zoom-Nikkor 80-200mm F4.5" gives zoom, nikkor, 80-200mm, f/4.5.

    Accents and capitals do not count; T-stops count as f-numbers; a number without a unit stays one.
    """
    bare = re.sub(r"(?<=\d),(?=\d)|(?<=[\W_]f\d)_(?=\d)", ".", _plain(text)).replace("_", " ")
    bare = re.sub(rf"(?<![a-z\d/.])({_N})/({_N})", _as_stop, bare)
    bare = re.sub(r"(?<=[a-z])(?=\d)(?<!\b[ft])", " ", bare)  # splits rf50
    found = []
    for stop, decade, low, high, length, unit, number, word in _TOKEN.findall(bare):
        if stop:
            found.append(f"f/{float(stop):g}")
        elif low:
            found.append(f"{float(low):g}-{float(high):g}mm")
        elif length:
            found.append(f"{float(length) * (10 if unit == 'cm' else 1):g}mm")
        else:
            found.append(f"{decade}s" if decade else f"{float(number):g}" if number else word)
    return found


def _plain(text: str) -> str:
    split = unicodedata.normalize("NFKD", text[:_LONGEST].replace("\N{EN DASH}", "-")).casefold()
    return "".join(c for c in split if not unicodedata.combining(c))


def _as_stop(found: re.Match[str]) -> str:
    """Mark the f-number in 50/1.2 or 1.2/50, as lenses are engraved."""
    low, high = sorted(found.groups(), key=float)
    return f"{high} f/{low}"


@dataclass(frozen=True)
class Entry:
    """A lens of the library.

    Attributes:
        lens: its name in lenses/.
        row: its row of the index; empty without one.
        own: the words of its own name.
        words: all its words.
        mounts: those that its mounts alone have, which weigh less: a Sigma for Canon EF is no Canon.
    """

    lens: str
    row: Mapping[str, Any]
    own: frozenset[str]
    words: frozenset[str]
    mounts: frozenset[str]

    @classmethod
    def of(cls, lens: str, row: Mapping[str, Any]) -> Entry:
        """Make the entry of a lens.

        Its words come from engraved figures, or from computed ones where none is engraved.
        """
        own = words_of(name := str(row.get("believed_to_be") or row.get("name") or lens))
        kinds = [
            "anamorphic" if row.get("efl_x_mm") else "",
            *(k for n, k in _KINDS.items() if re.search(n, _plain(name))),
        ]
        more = words_of(" ".join([*(str(row.get(key) or "") for key in ("name", "maker")), lens, *kinds]))
        spans = [word[:-2].split("-") for word in own if re.fullmatch(rf"{_N}-{_N}mm", word)]
        more += [*(end for span in spans for end in span), "zoom" if spans else "prime"]
        more += [f"{row['year']}", f"{row['year'] // 10}0s"] if row.get("year") else []
        more += [] if "f/" in " ".join(own) or not row.get("f_number") else [f"f/{row['f_number']:.2g}"]
        mounts = frozenset(words_of(row.get("mount") or "")).difference(own, more)
        return cls(lens, row, frozenset(own), mounts.union(own, more), mounts)

    @property
    def name(self) -> str:
        """The product's name, or where there is none the design's."""
        return str(self.row.get("believed_to_be") or self.row.get("name") or self.lens)

    @cached_property
    def _letters(self) -> str:
        return "".join(words_of(self.name))

    def strength(self, character: str) -> float:
        """Return how much of a character (a key of `CHARACTER`) the lens has; -inf where that is not known."""
        figures = self.row.get("character") or {}
        value = figures.get(CHARACTER[character][0]) if figures.get("cats_eye") is not None else None  # a condenser
        return -math.inf if value is None else -value if character == "cats-eye" else float(value)

    def agrees(self, word: str) -> int:
        """Return how well a word of a query agrees with the lens, 0 for not at all."""
        if not self.words.isdisjoint({word, f"{word}mm", f"f/{word}"} if word[0].isdigit() else {word}):
            return _BEGUN if word in self.mounts else _WHOLE
        if not word.isalpha() or len(word) < 3:
            return 0
        begun = any(own.startswith(word) or (len(own) > 3 and word in (own + "s", own + "es")) for own in self.words)
        return _BEGUN * begun or _INSIDE * (len(word) > 4 and word in self._letters)


@dataclass(frozen=True)
class Found:
    """The lenses that a query finds.

    Attributes:
        hits: the lenses that have all words of the query, best first.
        chosen: the one that is meant, if one is.
        near: the nearest lenses, where none has all words.
        notes: sentences about nicknames in the query.
    """

    hits: Sequence[Entry]
    chosen: Entry | None
    near: Sequence[Entry] = ()
    notes: Sequence[str] = ()


def find(text: str) -> Found:
    """Find the lenses of the library that have all words of a query; if it names a character, the strongest come first.

    Of lenses that agree equally well, products come before designs, and a lens with few words in its name that the
    query leaves out comes before one with many. One lens is chosen where it agrees better than all others, or where its
    whole name is given. A query with a sign that names lack, such as @SUM(1), finds none.
    """
    words, notes = _translated(text)
    sorts = [word for word in words if word in CHARACTER]
    words = [word for word in words if word not in {*CHARACTER, *_IDLE}]
    if not words and not sorts:
        return Found((), None)
    lenses, sound = entries(), not _NO_NAME.search(_plain(text))

    def key(entry: Entry) -> tuple[Any, ...]:
        said = {form for word in words for form in (word, f"{word}mm", f"f/{word}")}
        left = len(entry.own - said)
        whole = bool(words) and not left
        strong, design = [-entry.strength(sort) for sort in sorts], not entry.row.get("believed_to_be")
        return -sum(map(entry.agrees, words)) - whole, strong, design, left, entry.name

    hits = sorted((entry for entry in lenses if sound and all(map(entry.agrees, words))), key=key)
    if hits:
        alone = len(hits) == 1 or (key(hits[0])[0] < key(hits[1])[0])
        return Found(hits, hits[0] if alone else None, notes=notes)
    near = {entry.lens: sum(max(_alike(word, own) for own in entry.words) for word in words) for entry in lenses}
    nearest = sorted(lenses, key=lambda entry: (-near[entry.lens], key(entry)))[:_NEAR]
    return Found((), None, [entry for entry in nearest if near[entry.lens] > _LIKE * len(words)], notes)


def _alike(a: str, b: str) -> float:
    """Return how alike two words are, from 0 to 1; numbers are compared by their ratio."""
    x, y = (re.match(rf"(f/)?({_N})(?:-{_N})?(mm)?", word) for word in (a, b))
    if x is None or y is None:
        return SequenceMatcher(None, a, b).ratio() if x is y else 0.0
    kinds = {kind for m in (x, y) if (kind := m[1] or m[3])}
    low, high = sorted((float(x[2]), float(y[2])))
    return low / high if len(kinds) == 1 and high else float(a == b)


def nicknames() -> list[dict[str, Any]]:
    """Return the table of nicknames: what is said (a list), the words that are meant, and a sentence about them."""
    return _lines(NICKNAMES)


def said_of(entry: Entry) -> list[str]:
    """Return what people call a lens of the library."""
    return [said for row in nicknames() for said in row["said"] if all(map(entry.agrees, words_of(row["means"])))]


def _translated(text: str) -> tuple[list[str], list[str]]:
    """Return the words of a query, with nicknames replaced by what they mean, and the notes about these."""
    asked, notes = f" {' '.join(words_of(text))} ", list[str]()
    table = [(f" {' '.join(words_of(said))} ", row) for row in nicknames() for said in row["said"]]
    for said, row in sorted(table, key=lambda pair: -len(pair[0])):
        if said in asked:
            means = row["means"]
            asked = asked.replace(said, f" {means if means in CHARACTER else ' '.join(words_of(means))} ")
            notes += [row["about"]] if row.get("about") else []
    return asked.split(), notes


def read_index() -> dict[str, dict[str, Any]]:
    """Return the entries of the library's index by file; none without an index."""
    return {entry["file"]: entry for entry in _lines(INDEX)}


def _lines(name: str) -> list[dict[str, Any]]:
    file = library() / "lenses" / name
    return [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()] if file.is_file() else []


def entries() -> Sequence[Entry]:
    """Return the lenses of the library, by name; they are read again where a file or the index has changed."""
    folder = library() / "lenses"
    return _entries(folder, *(path.stat().st_mtime_ns if path.exists() else 0 for path in (folder, folder / INDEX)))


@lru_cache(maxsize=1)
def _entries(folder: Path, *_stamps: int) -> Sequence[Entry]:
    index = read_index()
    return [Entry.of(f.stem, index.get(f.name, {"row": {}})["row"]) for f in sorted(folder.glob("*.toml"))]
