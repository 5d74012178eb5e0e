"""Programs as C99: one self-contained header with a function for one ray and one over arrays, which vectorises."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from string import Template
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from neurolens.graph.program import Argument, Mixture, Program, Step

BLOCK = 256  # rays in a block
PART, ROWS = 56, 128  # steps of a part, and rays that it does at a time: its numbers stay in the first cache
MOST_WAITING = 512  # numbers that wait between parts; where more do, half as many rays keep them in the second cache
# What the second cache holds: those numbers, and the code, some bytes a step. A block has at least a vector of rays.
CACHE, STEP_BYTES, LEAST_ROWS = 1 << 19, 10, 16
_DOUBLE = ContextVar("_DOUBLE", default=False)  # whether literals are those of double precision


@cache
def _parts(file: str) -> dict[str, Template]:
    text = (Path(__file__).parent / file).read_text(encoding="utf-8")
    words = re.split(r"^//// (\w+).*\n", text, flags=re.MULTILINE)
    return {name: Template(body) for name, body in zip(words[1::2], words[2::2], strict=True)}


def part(file: str, key: str, /, **values: object) -> str:
    """Return a text of `parts.h` or `parts.shading`, the one below the line "//// KEY", with its ${places} filled."""
    return _parts(file)[key].substitute(values)


def comment_of(lines: Sequence[str]) -> str:
    """Return lines as one comment, between /* and */."""
    return "\n".join(f" * {line}".rstrip() for line in lines).replace("*/", "* /")


def literal(value: float) -> str:
    """Write a float32 number in nine digits, which give it back exactly; negative numbers stand in brackets."""
    text = repr(float(value)) if _DOUBLE.get() else f"{np.float32(value):.9g}"
    if "." not in text and "e" not in text:
        text += ".0"
    return f"({text}f)" if text.startswith("-") else f"{text}f"


@dataclass(frozen=True)
class Signature:
    """What a written function is called, what it takes and what it gives.

    Attributes:
        name: the function's. per_ray, per_call: names of inputs, in order.
        outputs: names of floats, in order; a status follows where the program has one.
        bands: how many wavelengths have a coefficient table; a function of several takes `band`, which counts from 0.
        tables: names of arrays [cells, columns]; behind each the function takes its number of cells, NAME_cells.
        state: names of a state's numbers, from which NAME_at makes the argument `state`.
    """

    name: str
    per_ray: tuple[str, ...]
    per_call: tuple[str, ...]
    outputs: tuple[str, ...]
    bands: int = 1
    tables: tuple[str, ...] = ()
    status: bool = True
    state: tuple[str, ...] = ()

    @staticmethod
    def of(program: Program, name: str) -> Signature:
        """Name the inputs that a program takes, in its order, and its outputs."""
        steps = [program.steps[k] for k in program.live()]
        per_ray, per_call = (
            tuple(s.name for s in steps if s.kind == "input" and s.per_call is whole) for whole in (False, True)
        )
        looked = dict.fromkeys(s.name for s in steps if s.kind == "lookup")
        tables = tuple(name for name in looked if name not in program.own_tables)
        outputs = tuple(o for o in program.outputs if o != "status")
        mixture, bands = program.mixture, program.tables
        state = () if mixture is None else tuple(s.name for s in mixture.program.steps if s.kind == "input")
        bands = bands if mixture is None else 1
        return Signature(name, per_ray, per_call, outputs, bands, tables, "status" in program.outputs, state)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Numbers of one ray, then those of the whole call."""
        return self.per_ray + self.per_call


@dataclass(frozen=True)
class Extras:
    """What a file holds besides its function, under names that begin with the function's.

    Attributes:
        constants: numbers, by name. functions: by name, programs of one output, each written as a function of its
            inputs.
    """

    constants: Mapping[str, float] = field(default_factory=dict)
    functions: Mapping[str, Program] = field(default_factory=dict)


NOTHING = Extras()


class Writer:
    """Writes steps as expressions of C; the writers of other languages replace some of the texts.

    Args:
        name: of the written function, with which the names of its helpers begin.

    Attributes:
        table: coefficients that differ between tables, in the order of their use; each is a row of one value a table.
        texts: an expression for each kind of step, from its arguments; {name} and {macro} are the function's.
        place: the expression of a coefficient in the table, from its number.
        declared: the declaration of an argument. kind: the word for a float. let: the word before a new number's name.
            between: what separates arguments.
        header: the head of a function, from its name, arguments and kind.
        lookup: the expression that reads a caller's table. own_lookup: that for a table of the program's own, if it
            differs.
    """

    texts: ClassVar[dict[str, str]] = {
        "add": "{0} + {1}",
        "sub": "{0} - {1}",
        "mul": "{0} * {1}",
        "div": "{0} / {1}",
        "neg": "-({0})",
        "sqrt": "{name}_sqrt({0})",
        "floor": "floorf({0})",
        "max": "{0} > {1} ? {0} : {1}",
        "min": "{0} < {1} ? {0} : {1}",
        "clamp": "{name}_clamp({0}, {1})",
        "select": "{0} <= {1} ? {2} : {3}",
        "pick": "{name}_pick({0}, {1}, {2})",
        "fma": "{macro}_FMA({0}, {1}, {2})",
        "kept": "{0}",
    }
    place = "c[{}]"
    declared, kind, let, between = "{1} {0}", "float", "float", ", "
    header = "{macro}_INLINE {2} {0}({1})"
    lookup = "{table}[{name}_cell({index}, {cells}) * {width} + {place}]"
    own_lookup = ""

    def __init__(self, program: Program, name: str) -> None:
        self.program, self.name, self.table = program, name, list[tuple[float, ...]]()

    def value(self, argument: Argument) -> str:
        """Write an argument: a step's name, a number, or a place in the table of coefficients."""
        if isinstance(argument, int):
            step = self.program.steps[argument]
            return step.name if step.kind == "input" else f"t{argument}"
        if all(v == argument[0] for v in argument):
            return literal(argument[0])
        if argument not in self.table:
            self.table.append(argument)
        return self.place.format(self.table.index(argument))

    def output(self, name: str) -> str:
        """Write the expression of an output."""
        return self.value(self.program.outputs[name].argument)

    def step(self, step: Step) -> str:
        """Write the expression of a step."""
        values = [self.value(a) for a in step.arguments]
        if step.kind != "lookup":
            return self.texts[step.kind].format(*values, name=self.name, macro=self.name.upper())
        text, table, cells = self.lookup, step.name, f"{step.name}_cells"
        if (own := self.program.own_tables.get(step.name)) is not None:
            text, table, cells = self.own_lookup or self.lookup, f"{self.name}_{step.name}", str(len(own))
        width = step.columns * (len(values) - step.indices) // step.indices
        known = {"table": table, "cells": cells, "width": width, "name": self.name}
        return " + ".join(
            f"{weight} * {text.format(index=index, place=place, **known)}"
            for index, weights in step.at_indices(values)
            for weight, place in zip(weights, range(step.column, width, step.columns), strict=True)
        )

    def steps(self) -> list[str]:
        """Write the steps of the program as lines."""
        steps = [(k, self.program.steps[k]) for k in self.program.live()]
        return [f"    {self.let} t{k} = {self.step(step)};" for k, step in steps if step.kind != "input"]

    def one_number(self, name: str) -> str:
        """Write a function `name` of the program's inputs that returns its one output."""
        (output,) = self.program.outputs
        header = self.function(name, (self.program.steps[k] for k in self.program.live()), self.kind)
        return "\n".join([header, "{", *self.steps(), f"    return {self.output(output)};", "}\n"])

    def function(self, name: str, steps: Iterable[Step], kind: str) -> str:
        """Write the head of a function that takes the inputs among these steps."""
        inputs = self.between.join(self.declared.format(s.name, self.kind) for s in steps if s.kind == "input")
        return self.header.format(name, inputs, kind, macro=self.name.upper())

    def state_parts(self, mixture: Mixture, table: Sequence[Sequence[float]]) -> dict[str, Any]:
        """Write the parts of the function that makes a state; `self` writes `mixture.program`.

        Args:
            table: [n, nodes] coefficients that differ between the nodes.
        """
        rows = np.array(table or [[0.0] * mixture.transform.shape[1]]) @ mixture.transform.T
        return {
            "count": len(rows),
            "features": rows.shape[1],
            "size": rows.size,
            "rows": ",\n    ".join(", ".join(literal(v) for v in row) for row in rows),
            "header": self.function(f"{self.name}_at", mixture.program.steps, f"{self.name}_state"),
            "steps": "\n".join(self.steps()),
            "made": ", ".join(self.output(name) for name in mixture.program.outputs if name != "inside"),
            "inside": self.output("inside"),
        }


class PartWriter(Writer):
    """Writes a program as functions of few steps on a block of rays; numbers for later functions wait in rows.

    In one loop over whole rays a core mostly waits: each surface needs the ray from the one before, and the next ray's
    steps are farther off than a core looks ahead. In loops of few steps it works on several rays at a time.
    """

    def __init__(self, program: Program, signature: Signature, macro: str) -> None:
        super().__init__(program, signature.name)
        self.signature, self.macro, self.same = signature, macro, program.same_for_all()
        self.here, self.row = set[int](), dict[int, int]()  # the steps of this part; the rows in which numbers wait

    def value(self, argument: Argument) -> str:
        if not isinstance(argument, int) or argument in self.same or argument in self.here:
            return super().value(argument)
        return f"waiting[{self.row[argument]}][i]" if argument in self.row else f"{super().value(argument)}[i]"

    def functions(self) -> tuple[str, str]:
        """Write the functions of the parts, and the loop that calls them."""
        parts, free, rows = self.program.in_parts(PART), list[int](), 0
        last = {a: n for n, steps in enumerate(parts) for k in steps for a in self.program.steps[k].arguments}
        outputs, written = dict(self.program.outputs), list[tuple[str, str]]()
        for number, steps in enumerate(parts):
            self.here = set(steps)
            lines = [f"const float t{k} = {self.step(self.program.steps[k])};" for k in steps]
            # What no part makes is an input or a number, which the last part hands on.
            made = [o for o, e in outputs.items() if e.argument in self.here or number == len(parts) - 1]
            lines += [f"{o}[i] = {'(int)' * (o == 'status')}{self.value(outputs.pop(o).argument)};" for o in made]
            free += [row for k, row in self.row.items() if last[k] == number]
            for k in (k for k in steps if last.get(k, -1) > number):
                self.row[k] = free.pop() if free else (rows := rows + 1) - 1
                lines.append(f"waiting[{self.row[k]}][i] = t{k};")
            written.append(self._function(number, lines, made))
        calls = "\n".join(call for _, call in written)
        loop = part("parts.h", "in_parts", macro=self.macro, rows=max(1, rows), calls=calls)
        fitting = max(0, CACHE - STEP_BYTES * sum(map(len, parts))) // (4 * max(1, rows))
        most = min(ROWS if rows <= MOST_WAITING else ROWS // 2, 1 << fitting.bit_length() >> 1)
        block = f"#define {self.macro}_ROWS {max(LEAST_ROWS, most)}\n"
        return block + "".join(text for text, _ in written), loop

    def _function(self, number: int, lines: Sequence[str], made: Sequence[str]) -> tuple[str, str]:
        """Write the function of one part, and its call."""
        s, pointer, before = self.signature, f"*{self.macro}_RESTRICT", list[str]()
        for k in sorted(self.same, reverse=True):  # each comes after what it is made of
            if self.program.steps[k].kind != "input" and re.search(rf"\bt{k}\b", " ".join([*before, *lines])):
                before.insert(0, f"    const float t{k} = {self.step(self.program.steps[k])};\n")
        words = set(re.findall(r"\w+", " ".join([*before, *lines])))
        rays, numbers = ([i for i in names if i in words] for names in (s.per_ray, s.per_call))
        arguments = [
            "size_t number",
            f"float ({pointer} waiting)[{self.macro}_ROWS]",
            *(f"const float {pointer} {i}" for i in rays),
            *(f"float {i}" for i in numbers),
            *(f"{'int' if o == 'status' else 'float'} {pointer} {o}" for o in made),
        ]
        text = part(
            "parts.h", "part",
            name=self.name, macro=self.macro, part=number, arguments=",\n    ".join(arguments),
            before="".join(before), lines="\n".join(f"        {line}" for line in lines),
        )  # fmt: skip
        given = ", ".join(["number", "waiting", *(f"{i} + at" for i in rays), *numbers, *(f"{o} + at" for o in made)])
        return text, f"        {self.name}_part_{number}({given});"


def write_c(program: Program, name: str, comment: Sequence[str], extras: Extras = NOTHING) -> str:
    """Write a program as the text of a C header.

    Args:
        name: the function's, an identifier.
        comment: lines about the model, for the head of the file.
        extras: what else the header holds.
    """
    signature = Signature.of(program, name)
    macro, mixture, writer = name.upper(), program.mixture, Writer(program, name)
    text = part("parts.h", "head", comment=comment_of(comment), name=name, guard=f"{macro}_H", macro=macro)
    live = [program.steps[k] for k in program.live()]
    others = [*extras.functions.values(), *([] if mixture is None else [mixture.program])]
    kinds = {step.kind for step in live} | {p.steps[k].kind for p in others for k in p.live()}
    for kind in ("sqrt", "clamp", "pick", "floor", "lookup"):
        text += part("parts.h", kind, name=name, macro=macro) if kind in kinds else ""
    for table in dict.fromkeys(step.name for step in live if step.kind == "lookup"):
        if table in program.own_tables:
            text += _numbers(f"{name}_{table}", program.own_tables[table])
    text += "\n" * bool(extras.constants)
    text += "".join(f"#define {macro}_{key.upper()} {literal(v)}\n" for key, v in extras.constants.items())
    for key, function in extras.functions.items():
        text += f"\n{Writer(function, name).one_number(f'{name}_{key}')}"
    body = writer.steps()
    results = [f"    ray.{o} = {writer.output(o)};" for o in signature.outputs]
    if signature.status:
        results.append(f"    ray.status = (int){writer.output('status')};")
    if mixture is not None:
        parts = Writer(mixture.program, name).state_parts(mixture, writer.table)
        text += part("parts.h", "state", name=name, macro=macro, **parts)
        body.insert(0, "    const float *const c = state->c;")
    elif writer.table:
        rows = ",\n".join("    {" + ", ".join(literal(v) for v in row) + "}" for row in np.array(writer.table).T)
        text += f"\nstatic const float {name}_table[{program.tables}][{len(writer.table)}] = {{\n{rows}}};\n"
        body.insert(0, f"    const float *const c = {name}_table[band];")
    in_parts = program.waits() and signature.bands == 1 and not signature.state and "lookup" not in kinds
    runs = PartWriter(program, signature, macro).functions() if in_parts else None
    return text + _functions(signature, macro, body, results, runs)


_IN_DOUBLE = {
    r"\bfloat\b": "double", r"\bunsigned\b": "unsigned long long", r"\b(\d[\d.]*(?:e[+-]?\d+)?)f\b": r"\1",
    r"\b(floor|__builtin_fma|__builtin_sqrt)f\b": r"\1", "0x80000000u": "0x8000000000000000u",
    "0x7fffffffu": "0x7fffffffffffffffu", "0x5f375a86u": "0x5fe6eb50c7b537a9u",
}  # fmt: skip


def write_double(program: Program, name: str, comment: Sequence[str], extras: Extras = NOTHING) -> str:
    """Write what `write_c` writes, in double precision; absorption keeps the precision of single."""
    token = _DOUBLE.set(True)
    try:
        text = write_c(program, name, comment, extras)
    finally:
        _DOUBLE.reset(token)
    return in_double(text)


def in_double(text: str) -> str:
    """Replace float by double in C text."""
    for pattern, new in _IN_DOUBLE.items():
        text = re.sub(pattern, new, text)
    return text


def _numbers(name: str, rows: NDArray[np.float64]) -> str:
    """Write a table as one array."""
    lines = ",\n".join(", ".join(literal(v) for v in row) for row in rows)
    return f"\nstatic const float {name}[{rows.size}] = {{\n{lines}}};\n"


def _functions(s: Signature, macro: str, body: list[str], results: list[str], parts: tuple[str, str] | None) -> str:
    """Write the struct of results, the function of one ray, and the one over arrays, which may run in parts."""
    pointer, band, guard, chosen = f"*{macro}_RESTRICT", list[str](), list[str](), list[str]()
    if s.state:
        band, chosen = [f"const {s.name}_state {pointer} state"], ["state"]
        results = [*results, "    if (!state->inside) ray.status = 1;"]
    elif s.bands > 1:
        band, chosen = ["int band"], ["band"]
        guard = [f"    const int known = band >= 0 && band < {s.bands};", "    if (!known) band = 0;"]
        results = [*results, "    if (!known) ray.status = 1;"]
    outputs = (*s.outputs, *["status"] * s.status)
    kinds = {o: "int" if o == "status" else "float" for o in outputs}
    tables = [f"const float {pointer} {t}, int {t}_cells" for t in s.tables]
    per_call = [*(f"float {i}" for i in s.per_call), *tables, *band]
    one = ",\n    ".join([*(f"float {i}" for i in s.per_ray), *per_call])
    rows = [f"const float {pointer} {i}" for i in s.per_ray]
    many = ",\n    ".join(["size_t count", *rows, *per_call, *(f"{kinds[o]} {pointer} {o}" for o in outputs)])
    values = [*(f"{i}[i]" for i in s.per_ray), *s.per_call, *(f"{t}, {t}_cells" for t in s.tables), *chosen]
    stores = "\n".join(f"        {o}[i] = ray.{o};" for o in outputs)
    each = part("parts.h", "each_ray", name=s.name, values=", ".join(values), stores=stores)
    return part(
        "parts.h", "functions",
        name=s.name, macro=macro, one=one, many=many, parts=parts[0] if parts else "",
        fields="\n".join(f"    {kinds[o]} {o};" for o in outputs),
        unused="".join(f"    (void){i};\n" for i in s.inputs),
        body="\n".join([*guard, *body, *results]), loop=parts[1] if parts else each,
    )  # fmt: skip


def padded_columns(columns: int) -> int:
    """Return the number of columns of a table, rounded up to whole vector registers of 8 floats."""
    return -(-columns // 8) * 8


def write_blocks(program: Program, name: str) -> str:
    """Write a program with lookups as a function of arrays: three loops over blocks of rays that fit the first cache.

    Compilers vectorise the loops before and after the lookups; the lookups themselves they vectorise slowly or not at
    all. NAME(count, per_ray, per_call, table, cells, outputs, status) takes pointers in the order of the signature.
    Groups of the table's columns are padded to `padded_columns`. A table of the program's own is NAME_table, with
    NAME_table_cells cells.
    """
    if not any(program.steps[k].kind == "lookup" for k in program.live()):
        return _block_of_rays(program, name)
    once, rest = program.of_the_call()
    before, lookups, after = rest.around_lookups()
    parts = ((program, ""), (once, "_once"), (before, "_before"), (after, "_after"))
    whole, same, first, last = (Signature.of(p, f"{name}{part}") for p, part in parts)
    step = lookups[0]
    columns, weights = step.columns, len(step.arguments) - step.indices
    groups, own = weights // step.indices, program.own_tables.get(step.name)
    made = [*first.outputs, *(f"column_{c}" for c in range(columns))]
    places = {
        **{row: f"in[{k}] + at" for k, row in enumerate(whole.per_ray)},
        **{number: f"call[{k}]" for k, number in enumerate(whole.per_call)},
        **{number: f"once.{number}" for number in same.outputs},
        **{row: f"made[{k}]" for k, row in enumerate(made)},
    }
    width = padded_columns(columns)
    cells = [
        f"const float *const cell_{k} = table + {width * groups} * "
        f"{name}_cell(made[{made.index(f'index_{k}')}][i], cells);"
        for k in range(step.indices)
    ]
    terms = (
        f"made[{made.index(f'weight_{g}')}][i] * cell_{g // groups}[{width * (g % groups)} + c]" for g in range(weights)
    )
    call = f"const {same.name}_ray once = {same.name}({', '.join(places[n] for n in same.inputs)});"
    loops = part(
        "parts.h", "blocks",
        name=name, known=call * bool(same.outputs), block=BLOCK, made=len(made), columns=columns, width=width,
        cells="\n            ".join(cells), total=" + ".join(terms), looked=made.index("column_0"),
        first=", ".join(places[row] for row in (*first.inputs, *first.outputs)),
        last=", ".join(places[row] for row in last.inputs),
        out="".join(f", out[{k}] + at" for k in range(len(whole.outputs))),
    )  # fmt: skip
    text = write_c(once, same.name, ["Of the call."]) if same.outputs else ""
    text += write_c(before, first.name, ["Before the lookups."]) + write_c(after, last.name, ["After them."])
    if own is not None:
        padded = np.pad(own.reshape(len(own), groups, columns), ((0, 0), (0, 0), (0, width - columns)))
        text += f"enum {{ {name}_table_cells = {len(own)} }};\n"
        text += _numbers(f"{name}_table", padded.reshape(len(own), -1))
    return text + part("parts.h", "lookup", name=name, macro=last.name.upper()) + loops


def _block_of_rays(program: Program, name: str) -> str:
    """Write the function of `write_blocks` for a program without lookups, which takes no table."""
    once, rest = program.of_the_call()
    parts = ((program, ""), (once, "_once"), (rest, "_each"))
    whole, same, each = (Signature.of(p, f"{name}{part}") for p, part in parts)
    places = {
        **{row: f"in[{k}]" for k, row in enumerate(whole.per_ray)},
        **{number: f"call[{k}]" for k, number in enumerate(whole.per_call)},
    }
    known = f"const {same.name}_ray once = {same.name}({', '.join(places[n] for n in same.inputs)});"
    places |= {number: f"once.{number}" for number in same.outputs}
    given = [*(places[row] for row in each.inputs), *(f"out[{k}]" for k in range(len(each.outputs))), "status"]
    text = write_c(once, same.name, ["Of the call."]) if same.outputs else ""
    text += write_c(rest, each.name, ["Arrays of rays."])
    return text + part("parts.h", "one_block", name=name, known=known * bool(same.outputs), given=", ".join(given))
