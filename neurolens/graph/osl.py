"""Programs as Open Shading Language: one camera shader of Blender's Cycles.

A shader calls no functions of others, has no structs and no literals with a suffix. What it reads of the renderer is
text of the caller; everything between these numbers and the outputs is the program.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from neurolens.graph.c import Writer, literal, steps_of
from neurolens.graph.program import Mixture, Program, Step

_LOOKUP = "{table}[{width} * clamp(int({index}), 0, {cells} - 1) + {place}]"
TEMPORARY = re.compile(r"\bt(\d+)\b")
_SUFFIX = re.compile(r"(\d\.?(?:e[+-]\d+)?)f\b")
_STATEMENTS, _TOGETHER = 9000, 64  # the compiler of OSL takes 10,000; numbers that a statement of more declares
_KINDS = {"position": "point", "throughput": "color"}


@dataclass(frozen=True)
class Parameter:
    """A number that the user of a shader turns.

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
        told = [f'string label = "{self.label}"', f'string help = "{self.help}"']
        if self.widget:
            told.append(f'string widget = "{self.widget}"')
        else:
            told += [f"{kind} {key} = {_number(value, kind)}" for key, value in (("min", self.low), ("max", self.high))]
        told += [f'string options = "{self.options}"'] * bool(self.options)
        return f"{kind} {self.name} = {_number(self.default, kind)}\n        [[ {', '.join(told)} ]]"


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
    lines = "\n".join(f" * {line}".rstrip() for line in comment).replace("*/", "* /")
    writer = _Writer(program, "sqrt", place="c{}", lookup=_LOOKUP, name=name)
    head = [f"{p.text()}" for p in parameters]
    head += [f"output {_KINDS.get(o, 'vector')} {o} = 0.0" for o in outputs]
    tables = ""
    for table, numbers in program.own_tables.items():
        values = ", ".join(_plain(literal(v)) for v in numbers.reshape(-1))
        tables += f"    float {name}_{table}[{numbers.size}] = {{{values}}};\n"
    steps = urgent(steps_of(writer))
    body = _plain("\n".join(steps if len(steps) < _STATEMENTS else _together(steps)))
    results = ""
    for o in outputs:
        rows = (_plain(writer.value(program.outputs[f"{o}_{k}"].argument)) for k in range(3))
        results += f"    {o} = {_KINDS.get(o, 'vector')}({', '.join(rows)});\n"
    parts = ",\n    ".join(head)
    mixed = "" if program.mixture is None else _mixed(program.mixture, writer)
    return f"/*\n{lines}\n */\nshader {name}(\n    {parts})\n{{\n{tables}{frame}{mixed}{body}\n{results}}}\n"


def urgent(lines: Sequence[str]) -> list[str]:
    """Lines `float tN = ...;`, first those from which the longest chain of others leads on, so that few wait for one
    another: compilers of shaders, which make no vectors of them, keep much of the order they are given."""
    numbers = [[int(n) for n in TEMPORARY.findall(line)] for line in lines]
    ahead: defaultdict[int, int] = defaultdict(int)
    for own, *given in reversed(numbers):
        for n in given:
            ahead[n] = max(ahead[n], ahead[own] + 1)
    return [lines[k] for k in sorted(range(len(lines)), key=lambda k: -ahead[numbers[k][0]])]


def _mixed(mixture: Mixture, writer: Writer) -> str:
    """The state's features `s0` ..., and of them the coefficients `c0` ... that differ between tables."""
    made = _Writer(mixture.program, "sqrt")
    names = [made.value(e.argument) for key, e in mixture.program.outputs.items() if key != "inside"]
    text = "\n".join(f"    {line.strip()}" for line in steps_of(made))
    rows = np.array(writer.table, np.float64) @ mixture.transform.T
    for k, row in enumerate(rows):
        terms = (f"{literal(v)} * {name}" for v, name in zip(row, names, strict=True) if v)
        text += f"\n    float c{k} = {' + '.join(terms) or '0.0'};"
    return TEMPORARY.sub(r"s\1", _plain(text)) + "\n"


class _Writer(Writer):
    """Choices as functions: otherwise they are branches, which cost a tenth of a whole camera."""

    def step(self, step: Step) -> str:
        if step.kind in ("max", "min"):
            return "{}({}, {})".format(step.kind, *(self.value(a) for a in step.arguments))
        if step.kind == "select":
            low, high, then, otherwise = (self.value(a) for a in step.arguments)
            return f"select({otherwise}, {then}, {low} <= {high})"
        return super().step(step)


def _together(lines: Sequence[str]) -> list[str]:
    """The same declarations of floats in fewer statements."""
    names = [line.strip().removeprefix("float ").removesuffix(";") for line in lines]
    parts = (names[k : k + _TOGETHER] for k in range(0, len(names), _TOGETHER))
    return ["    float " + ",\n      ".join(part) + ";" for part in parts]


def _plain(text: str) -> str:
    """C's literals without the suffix."""
    return _SUFFIX.sub(r"\1", text)


def _number(value: float, kind: str) -> str:
    return str(int(value)) if kind == "int" else repr(float(value))
