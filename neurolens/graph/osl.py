"""Programs as Open Shading Language: one camera shader of Blender's Cycles.

A shader calls no functions of others, has no structs and no literals with a suffix. What it reads from the renderer is
text of the caller; everything between these numbers and the outputs is the program.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from neurolens.graph.c import Writer, comment_of, literal
from neurolens.graph.program import Mixture, Program

TEMPORARY = re.compile(r"\bt(\d+)\b")
_SUFFIX = re.compile(r"(\d\.?(?:e[+-]\d+)?)f\b")
_STATEMENTS, _TOGETHER = 9000, 64  # the compiler of OSL takes 10,000; numbers that a statement declares beyond that
_KINDS = {"position": "point", "throughput": "color"}


@dataclass(frozen=True)
class Parameter:
    """A number that the user of a shader sets.

    Attributes:
        name, label, help: what code and users call it, and what it does. default: an int makes it one.
        low, high: of the slider. widget: "boolean", or "mapper" with `options` (NAME:NUMBER|...).
    """

    name: str
    label: str
    help: str
    default: float
    low: float = 0.0
    high: float = 1.0
    widget: str = ""
    options: str = ""

    def text(self) -> str:
        """Its declaration."""
        kind = "int" if isinstance(self.default, int) else "float"
        metadata = [f'string label = "{self.label}"', f'string help = "{self.help}"']
        if self.widget:
            metadata.append(f'string widget = "{self.widget}"')
        else:
            metadata += [f"{kind} {k} = {_number(value, kind)}" for k, value in (("min", self.low), ("max", self.high))]
        metadata += [f'string options = "{self.options}"'] * bool(self.options)
        return f"{kind} {self.name} = {_number(self.default, kind)}\n        [[ {', '.join(metadata)} ]]"


class _Writer(Writer):
    """Choices are functions: otherwise they are branches, which cost a tenth of a whole camera."""

    texts: ClassVar = Writer.texts | {
        "sqrt": "sqrt({0})", "floor": "floor({0})", "max": "max({0}, {1})", "min": "min({0}, {1})",
        "clamp": "max(min({0}, {1}), -{1})", "select": "select({3}, {2}, {0} <= {1})", "fma": "{0} * {1} + {2}",
    }  # fmt: skip
    place = "c{}"
    lookup = "{table}[{width} * clamp(int({index}), 0, {cells} - 1) + {place}]"


def write_osl(
    program: Program,
    name: str,
    comment: Sequence[str],
    parameters: Sequence[Parameter],
    frame: str,
    outputs: Sequence[str],
) -> str:
    """The text of a shader.

    Args:
        comment: lines of its head. parameters: of the user.
        frame: statements that set a float for each input of the program.
        outputs: of three rows each, NAME_0 to NAME_2 of the program.

    A state's numbers are mixed in the shader, which costs nothing where the renderer knows the state when it compiles.
    """
    writer = _Writer(program, name)
    head = [p.text() for p in parameters]
    head += [f"output {_KINDS.get(o, 'vector')} {o} = 0.0" for o in outputs]
    tables = ""
    for table, numbers in program.own_tables.items():
        values = ", ".join(plain(literal(v)) for v in numbers.reshape(-1))
        tables += f"    float {name}_{table}[{numbers.size}] = {{{values}}};\n"
    steps = urgent(writer.steps())
    body = plain("\n".join(steps if len(steps) < _STATEMENTS else _together(steps)))
    results = ""
    for o in outputs:
        rows = ", ".join(plain(writer.output(f"{o}_{k}")) for k in range(3))
        results += f"    {o} = {_KINDS.get(o, 'vector')}({rows});\n"
    parts = ",\n    ".join(head)
    mixed = "" if program.mixture is None else _mixed(program.mixture, writer)
    text = f"shader {name}(\n    {parts})\n{{\n{tables}{frame}{mixed}{body}\n{results}}}\n"
    return f"/*\n{comment_of(comment)}\n */\n{text}"


def urgent(lines: Sequence[str]) -> list[str]:
    """Lines `float tN = ...;`, those first from which the longest chain of others leads on, so that few wait for one
    another: compilers of shaders, which make no vectors of them, keep much of the order that they are given."""
    numbers = [[int(n) for n in TEMPORARY.findall(line)] for line in lines]
    ahead: defaultdict[int, int] = defaultdict(int)
    for own, *arguments in reversed(numbers):
        for n in arguments:
            ahead[n] = max(ahead[n], ahead[own] + 1)
    return [lines[k] for k in sorted(range(len(lines)), key=lambda k: -ahead[numbers[k][0]])]


def _mixed(mixture: Mixture, writer: Writer) -> str:
    """The state's features `s0` ..., and the coefficients `c0` ... that differ between tables, mixed by these."""
    state = _Writer(mixture.program, "")
    names = [state.output(name) for name in mixture.program.outputs if name != "inside"]
    text = "\n".join(f"    {line.strip()}" for line in state.steps())
    rows = np.array(writer.table, np.float64) @ mixture.transform.T
    for k, row in enumerate(rows):
        terms = (f"{literal(v)} * {name}" for v, name in zip(row, names, strict=True) if v)
        text += f"\n    float c{k} = {' + '.join(terms) or '0.0'};"
    return TEMPORARY.sub(r"s\1", plain(text)) + "\n"


def _together(lines: Sequence[str]) -> list[str]:
    """The same declarations of floats in fewer statements."""
    names = [line.strip().removeprefix("float ").removesuffix(";") for line in lines]
    parts = (names[k : k + _TOGETHER] for k in range(0, len(names), _TOGETHER))
    return ["    float " + ",\n      ".join(part) + ";" for part in parts]


def plain(text: str) -> str:
    """C's literals without the suffix."""
    return _SUFFIX.sub(r"\1", text)


def _number(value: float, kind: str) -> str:
    return str(int(value)) if kind == "int" else repr(float(value))
