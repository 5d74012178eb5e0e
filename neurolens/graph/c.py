"""Programs as C99: one self-contained header with a function for one ray and one over arrays, which vectorises."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.graph.program import Argument, Mixture, Program, Step


@cache
def _parts(file: str) -> dict[str, Template]:
    text = (Path(__file__).parent / file).read_text(encoding="utf-8")
    words = re.split(r"^//// (\w+).*\n", text, flags=re.MULTILINE)
    return {name: Template(body) for name, body in zip(words[1::2], words[2::2], strict=True)}


def part(file: str, key: str, /, **values: object) -> str:
    """A text of `parts.h` or `parts.glsl`, which the line "//// KEY" precedes, with its ${places} filled."""
    return _parts(file)[key].substitute(values)


@dataclass(frozen=True)
class Signature:
    """Names of a written function.

    Attributes:
        name: of the function. per_ray, per_call: inputs, in order.
        outputs: floats in order; then comes status, where the program has one.
        bands: wavelengths of the coefficient tables; a function of several takes `band`, a number from 0.
        state: names of the numbers of a state, of which NAME_at makes the argument `state`.
        tables: each is an array [cells, columns], which its number of cells follows, NAME_cells.
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
        """The inputs that a program names, in its order, and its outputs."""
        steps = [program.steps[k] for k in program.live()]
        per_ray, per_call = (
            tuple(s.name for s in steps if s.kind == "input" and s.per_call is whole) for whole in (False, True)
        )
        looked = dict.fromkeys(s.name for s in steps if s.kind == "lookup")
        tables = tuple(name for name in looked if name not in program.own_tables)
        outputs = tuple(o for o in program.outputs if o != "status")
        mixture, bands = program.mixture, program.tables
        state = () if mixture is None else tuple(s.name for s in mixture.program.steps if s.kind == "input")
        given = bands if mixture is None else 1
        return Signature(name, per_ray, per_call, outputs, given, tables, "status" in program.outputs, state)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Numbers of one ray, then those of the whole call."""
        return self.per_ray + self.per_call


@dataclass(frozen=True)
class Extras:
    """What stands beside the function of a file, under names that begin with the function's.

    Attributes:
        constants: numbers, by name. functions: of numbers that give one, by name: programs of one output.
    """

    constants: Mapping[str, float] = field(default_factory=dict)
    functions: Mapping[str, Program] = field(default_factory=dict)


NOTHING = Extras()


def write_c(program: Program, name: str, comment: Sequence[str], extras: Extras = NOTHING) -> str:
    """The text of a header.

    Args:
        name: of the function, an identifier.
        comment: lines on the model, for its head.
        extras: what else the header holds.
    """
    signature = Signature.of(program, name)
    macro = name.upper()
    lines = "\n".join(f" * {line}".rstrip() for line in comment).replace("*/", "* /")
    text = part("parts.h", "head", comment=lines, name=name, guard=f"{macro}_H", macro=macro)
    live = program.live()
    kinds = [p.steps[k].kind for p in (program, *extras.functions.values()) for k in p.live()]
    for kind in ("sqrt", "clamp", "pick", "floor", "lookup"):
        text += part("parts.h", kind, name=name, macro=macro) if kind in kinds else ""
    for table in dict.fromkeys(program.steps[k].name for k in live if program.steps[k].kind == "lookup"):
        if table in program.own_tables:
            text += _numbers(f"{name}_{table}", program.own_tables[table])
    text += "\n" * bool(extras.constants)
    text += "".join(f"#define {macro}_{key.upper()} {literal(v)}\n" for key, v in extras.constants.items())
    for key, function in extras.functions.items():
        own = Writer(function, f"{name}_sqrt", f"{macro}_FMA")
        text += f"\n{macro}_INLINE {one_number(own, f'{name}_{key}')}"
    lookup = f"{{table}}[{name}_cell({{index}}, {{cells}}) * {{width}} + {{place}}]"
    writer = Writer(
        program, f"{name}_sqrt", f"{macro}_FMA", clamp=f"{name}_clamp", floor="floorf", lookup=lookup, name=name
    )
    body = steps_of(writer)
    results = [f"    ray.{o} = {writer.value(program.outputs[o].argument)};" for o in signature.outputs]
    if "status" in program.outputs:
        results.append(f"    ray.status = (int){writer.value(program.outputs['status'].argument)};")
    if program.mixture is not None:
        own = Writer(program.mixture.program, "sqrtf", f"{macro}_FMA")
        parts = state_parts(program.mixture, writer.table, own)
        text += part("parts.h", "state", name=name, macro=macro, **parts)
        body.insert(0, "    const float *const c = state->c;")
    elif writer.table:
        rows = ",\n".join("    {" + ", ".join(literal(v) for v in row) + "}" for row in np.array(writer.table).T)
        text += f"\nstatic const float {name}_table[{program.tables}][{len(writer.table)}] = {{\n{rows}}};\n"
        body.insert(0, f"    const float *const c = {name}_table[band];")
    return text + _functions(signature, macro, body, results)


def _numbers(name: str, rows: NDArray[np.float64]) -> str:
    """A table as one array."""
    lines = ",\n".join(", ".join(literal(v) for v in row) for row in rows)
    return f"\nstatic const float {name}[{rows.size}] = {{\n{lines}}};\n"


def one_number(writer: Writer, name: str) -> str:
    """A function of the inputs of a program that gives its one output."""
    program = writer.program
    arguments = ", ".join(f"float {program.steps[k].name}" for k in program.live() if _input(program, k))
    (found,) = program.outputs.values()
    lines = steps_of(writer)
    return "\n".join([f"float {name}({arguments})", "{", *lines, f"    return {writer.value(found.argument)};", "}\n"])


def steps_of(writer: Writer) -> list[str]:
    """The steps of a program as lines."""
    steps = [(k, writer.program.steps[k]) for k in writer.program.live() if not _input(writer.program, k)]
    return [f"    float t{k} = {writer.step(step)};" for k, step in steps]


def state_parts(mixture: Mixture, table: Sequence[Sequence[float]], writer: Writer) -> dict[str, Any]:
    """What the function of a state is written of: numbers [n, nodes] and, by a writer of its program, its features."""
    rows = np.array(table or [[0.0] * mixture.transform.shape[1]]) @ mixture.transform.T
    program = mixture.program
    return {
        "count": len(rows),
        "features": rows.shape[1],
        "size": rows.size,
        "rows": ",\n    ".join(", ".join(literal(v) for v in row) for row in rows),
        "arguments": ", ".join(f"float {step.name}" for step in program.steps if step.kind == "input"),
        "steps": "\n".join(steps_of(writer)),
        "made": ", ".join(writer.value(e.argument) for key, e in program.outputs.items() if key != "inside"),
        "inside": writer.value(program.outputs["inside"].argument),
    }


def _input(program: Program, k: int) -> bool:
    return program.steps[k].kind == "input"


def _functions(s: Signature, macro: str, body: list[str], results: list[str]) -> str:
    fields = "\n".join([*(f"    float {o};" for o in s.outputs), *["    int status;"] * s.status])
    band, guard, chosen = [], [], []
    if s.state:
        band, chosen = [f"const {s.name}_state *{macro}_RESTRICT state"], ["state"]
        results = [*results, "    if (!state->inside) ray.status = 1;"]
    elif s.bands > 1:
        band, chosen = ["int band"], ["band"]
        guard = [f"    const int known = band >= 0 && band < {s.bands};", "    if (!known) band = 0;"]
        results = [*results, "    if (!known) ray.status = 1;"]
    tables = [f"const float *{macro}_RESTRICT {t}, int {t}_cells" for t in s.tables]
    one = ",\n    ".join([*(f"float {i}" for i in s.inputs), *tables, *band])
    many = ",\n    ".join(
        [
            "size_t count",
            *(f"const float *{macro}_RESTRICT {i}" for i in s.per_ray),
            *(f"float {i}" for i in s.per_call),
            *tables,
            *band,
            *(f"float *{macro}_RESTRICT {o}" for o in s.outputs),
            *[f"int *{macro}_RESTRICT status"] * s.status,
        ]
    )
    known = [*s.per_call, *(f"{t}, {t}_cells" for t in s.tables), *chosen]
    given = ", ".join([*(f"{i}[i]" for i in s.per_ray), *known])
    stores = "\n".join(f"        {o}[i] = ray.{o};" for o in (*s.outputs, *["status"] * s.status))
    unused = "".join(f"    (void){i};\n" for i in s.inputs)
    return (
        f"\ntypedef struct {{\n{fields}\n}} {s.name}_ray;\n"
        f"\n{macro}_INLINE {s.name}_ray {s.name}(\n    {one})\n{{\n{unused}    {s.name}_ray ray;\n"
        + "\n".join([*guard, *body, *results])
        + "\n    return ray;\n}\n"
        f"\n{macro}_UNUSED static inline void {s.name}_rays(\n    {many})\n{{\n"
        "    for (size_t i = 0; i < count; i++) {\n"
        f"        const {s.name}_ray ray = {s.name}({given});\n{stores}\n    }}\n}}\n\n#endif\n"
    )


def padded_columns(columns: int) -> int:
    """How many floats a group of columns of a table takes in compiled code: whole registers."""
    return -(-columns // 8) * 8


def write_blocks(program: Program, name: str) -> str:
    """A function of arrays for a program with lookups, in three loops on what fits the first cache.

    Compilers make vectors of the loops before and after the lookups; of lookups themselves they make none, or slow
    ones. NAME(count, per_ray, per_call, table, cells, outputs, status) takes pointers in the order of the signature;
    groups of the table's columns are padded to `padded_columns`. A table of the program's own is NAME_table, of
    NAME_table_cells.
    """
    once, rest = program.of_the_call()
    before, lookups, after = rest.around_lookups()
    parts = ((program, ""), (once, "_once"), (before, "_before"), (after, "_after"))
    whole, same, first, last = (Signature.of(p, f"{name}{part}") for p, part in parts)
    step = lookups[0]
    columns, weights = step.columns, len(step.arguments) - step.indices
    groups, own = weights // step.indices, program.own_tables.get(step.name)
    made = [*first.outputs, *(f"column_{c}" for c in range(columns))]
    places = {row: f"in[{k}] + at" for k, row in enumerate(whole.per_ray)}
    places |= {number: f"call[{k}]" for k, number in enumerate(whole.per_call)}
    places |= {number: f"once.{number}" for number in same.outputs}
    places |= {row: f"made[{k}]" for k, row in enumerate(made)}
    width = padded_columns(columns)
    row = width * groups
    cells = [
        f"const float *const cell_{k} = table + {row} * {name}_cell(made[{made.index(f'index_{k}')}][i], cells);"
        for k in range(step.indices)
    ]
    terms = (
        f"made[{made.index(f'weight_{g}')}][i] * cell_{g // groups}[{width * (g % groups)} + c]" for g in range(weights)
    )
    loops = part(
        "parts.h",
        "blocks",
        name=name,
        known=f"const {same.name}_ray once = {same.name}({', '.join(places[n] for n in same.inputs)});"
        * bool(same.outputs),
        block=BLOCK,
        made=len(made),
        columns=columns,
        width=width,
        cells="\n            ".join(cells),
        total=" + ".join(terms),
        first=", ".join(places[row] for row in (*first.inputs, *first.outputs)),
        last=", ".join(places[row] for row in last.inputs),
        out="".join(f", out[{k}] + at" for k in range(len(whole.outputs))),
        looked=made.index("column_0"),
    )
    text = write_c(once, same.name, ["Of the call."]) if same.outputs else ""
    text += write_c(before, first.name, ["Before the lookups."]) + write_c(after, last.name, ["After them."])
    if own is not None:
        padded = np.pad(own.reshape(len(own), groups, columns), ((0, 0), (0, 0), (0, width - columns)))
        text += f"enum {{ {name}_table_cells = {len(own)} }};\n"
        text += _numbers(f"{name}_table", padded.reshape(len(own), -1))
    return text + part("parts.h", "lookup", name=name, macro=last.name.upper()) + loops


BLOCK = 256  # rays


class Writer:
    """Steps as expressions of C, and of GLSL, which has the same ones.

    Args:
        sqrt, fma, clamp, floor: functions of those; without one its operations are written.
        place: of the table's coefficient {}. lookup: of a column of a table of the caller, or where own_lookup says
            none, of the program, whose name starts with `name`.

    Attributes:
        table: coefficients that differ between tables, each a row of one value a table, in the order of their use.
    """

    def __init__(
        self,
        program: Program,
        sqrt: str,
        fma: str = "",
        place: str = "c[{}]",
        clamp: str = "",
        floor: str = "floor",
        lookup: str = "",
        own_lookup: str = "",
        name: str = "",
    ) -> None:
        self.program, self.sqrt, self.fma, self.place, self.clamp = program, sqrt, fma, place, clamp
        self.floor, self.lookup, self.own_lookup, self.name = floor, lookup, own_lookup or lookup, name
        self.table: list[tuple[float, ...]] = []

    def value(self, argument: Argument) -> str:
        """A step's name, a number, or a place in the table of coefficients."""
        if isinstance(argument, int):
            step = self.program.steps[argument]
            return step.name if step.kind == "input" else f"t{argument}"
        if all(v == argument[0] for v in argument):
            return literal(argument[0])
        if argument not in self.table:
            self.table.append(argument)
        return self.place.format(self.table.index(argument))

    def step(self, step: Step) -> str:
        given = [self.value(a) for a in step.arguments]
        if step.kind in _INFIX:
            return f"{given[0]} {_INFIX[step.kind]} {given[1]}"
        if step.kind == "select":
            return "{} <= {} ? {} : {}".format(*given)
        if step.kind in ("max", "min"):
            a, b = given
            return f"{a} {'>' if step.kind == 'max' else '<'} {b} ? {a} : {b}"
        if step.kind == "clamp":
            x, limit = given
            return f"{self.clamp}({x}, {limit})" if self.clamp else f"max(min({x}, {limit}), -{limit})"
        if step.kind == "pick":
            return f"{self.name}_pick({', '.join(given)})"
        if step.kind == "neg":
            return f"-({given[0]})"
        if step.kind == "lookup":
            own = self.program.own_tables.get(step.name)
            form, table, cells = self.lookup, step.name, f"{step.name}_cells"
            if own is not None:
                form, table, cells = self.own_lookup, f"{self.name}_{step.name}", str(len(own))
            width = step.columns * (len(given) - step.indices) // step.indices
            return " + ".join(
                f"{weight} * {form.format(table=table, cells=cells, index=index, width=width, place=place)}"
                for index, weights in step.at_indices(given)
                for weight, place in zip(weights, range(step.column, width, step.columns), strict=True)
            )
        if step.kind in ("sqrt", "floor"):
            return f"{getattr(self, step.kind)}({given[0]})"
        return f"{self.fma}({', '.join(given)})" if self.fma else "{} * {} + {}".format(*given)


_INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/"}


def literal(value: float) -> str:
    """A float32 number in nine digits, which give it back exactly; negative ones in brackets."""
    text = f"{np.float32(value):.9g}"
    if "." not in text and "e" not in text:
        text += ".0"
    return f"({text}f)" if text.startswith("-") else f"{text}f"
