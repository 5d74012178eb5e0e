"""Texts and files of lenses as one stream of printable characters, which `page/packed.js` unpacks: a fifth of gzip's.

C, GLSL and OSL of lenses say much the same with temporaries of other numbers. Counted from the line's own number most
lines of one are lines of the others; LZMA, unlike gzip, looks back far enough to find them.
"""

from __future__ import annotations

import lzma
import re
from collections.abc import Iterable

import numpy as np

from neurolens.graph.osl import TEMPORARY, urgent

# Of 91 characters two hold 13 bits; none ends an element of HTML, begins an entity or an escape.
CHARACTERS = "".join(chr(code) for code in range(33, 127) if chr(code) not in "&<\\")
FILTERS = [
    {"id": lzma.FILTER_LZMA1, "preset": 9 | lzma.PRESET_EXTREME, "dict_size": 1 << 22, "lc": 3, "lp": 0, "pb": 0}
]
_STEPS = re.compile(r"(?:^    float t\d+ = .*\n)+", re.M)
_UNTOLD = re.compile(r"\x01|\bt\d+-")  # what `_counted` could not give back


def packed(data: bytes) -> str:
    """Bytes as LZMA (raw, lc 3, lp 0, pb 0) in `CHARACTERS`, 13 bits a pair, high bits and characters first."""
    bits = np.unpackbits(np.frombuffer(lzma.compress(data, lzma.FORMAT_RAW, filters=FILTERS), np.uint8))
    values = np.pad(bits, (0, -bits.size % 13)).reshape(-1, 13) @ (1 << np.arange(12, -1, -1))
    return np.array(list(CHARACTERS))[np.stack(np.divmod(values, len(CHARACTERS)), 1)].tobytes().decode("utf-32-le")


def packed_parts(parts: Iterable[tuple[str, str | bytes]]) -> tuple[str, list[tuple[str, int, int, int]]]:
    """The stream of named parts, and of each its name, place and bytes there, and how it is told: 0 as it is, 1 with
    temporaries counted, 2 in their turn, too, where it has its steps by `urgent`."""
    data, found = b"", []
    for name, part in parts:
        how = int(isinstance(part, str) and not _UNTOLD.search(part))
        if isinstance(part, str):
            in_turn = _STEPS.sub(lambda steps: "".join(sorted(steps[0].splitlines(True), key=_own)), part)
            if how and in_turn != part == _STEPS.sub(lambda steps: "".join(urgent(steps[0].splitlines(True))), in_turn):
                how, part = 2, in_turn
            part = (_counted(part) if how else part).encode()
        found.append((name, len(data), len(part), how))
        data += part
    return packed(data), found


def _own(line: str) -> int:
    return int(TEMPORARY.findall(line)[0])


def _counted(text: str) -> str:
    """Each line's first temporary counted from that of the line before (one more is not said), others back from it."""
    before, lines = 0, []
    for line in text.split("\n"):
        numbers = [int(n) for n in TEMPORARY.findall(line)]
        if numbers:
            steps = [numbers[0] - before, *(numbers[0] - n for n in numbers[1:])]
            between, before = TEMPORARY.split(line)[::2], numbers[0]
            line = between[0] + "".join(
                f"\x01{'' if step == 1 else step}{text}" for step, text in zip(steps, between[1:], strict=True)
            )
        lines.append(line)
    return "\n".join(lines)
