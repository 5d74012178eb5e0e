"""Programs as GLSL: one function with the contract of the C header."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from neurolens.graph.c import NOTHING, Extras, Signature, Writer, literal, one_number, part, state_parts, steps_of
from neurolens.graph.program import Program

# Tables of the caller are textures of one float a texel, a cell a line; NaN is less than nothing in no language.
_LOOKUP = "texelFetch({table}, ivec2({place}, clamp(int({index}), 0, textureSize({table}, 0).y - 1)), 0).r"
_OWN_LOOKUP = "{table}[{width} * clamp(int({index}), 0, {cells} - 1) + {place}]"


def write_glsl(program: Program, name: str, comment: Sequence[str], extras: Extras = NOTHING) -> str:
    """The text of a function; arguments as of `c.write_c`."""
    signature = Signature.of(program, name)
    lines = "\n".join(f" * {line}".rstrip() for line in comment).replace("*/", "* /")
    place = "state.c[{}]" if signature.state else f"{name}_table[band_first + {{}}]"
    fma = f"{name.upper()}_FMA"  # as in C: the steps of both are the same lines
    writer = Writer(program, "sqrt", fma, place, lookup=_LOOKUP, own_lookup=_OWN_LOOKUP, name=name)
    body = steps_of(writer)
    results = [f"    {o} = {writer.value(program.outputs[o].argument)};" for o in signature.outputs]
    status = program.outputs.get("status")
    results += [] if status is None else [f"    status = int({writer.value(status.argument)});"]
    text = part("parts.glsl", "head", comment=lines, fma=fma) + "\n" * bool(extras.constants)
    text += "".join(f"const float {name.upper()}_{k.upper()} = {literal(v)};\n" for k, v in extras.constants.items())
    for key, function in extras.functions.items():
        text += f"\n{one_number(Writer(function, 'sqrt', fma), f'{name}_{key}')}"
    constants = {table: numbers.reshape(-1) for table, numbers in program.own_tables.items()}
    if program.mixture is not None:
        parts = state_parts(program.mixture, writer.table, Writer(program.mixture.program, "sqrt", fma))
        text += part("parts.glsl", "state", name=name, **parts)
    elif writer.table:
        constants["table"] = np.array(writer.table).T.reshape(-1)
    for table, values in constants.items():
        numbers = [literal(v) for v in values]
        rows = ",\n    ".join(", ".join(numbers[i : i + 8]) for i in range(0, len(numbers), 8))
        size = len(numbers)
        text += f"\nconst float {name}_{table}[{size}] = float[{size}](\n    {rows}\n);\n"
    band = []
    if signature.state:
        band = [f"in {name}_state state"]
        results.append("    if (!state.inside) status = 1;")
    elif signature.bands > 1:
        band = ["in int band"]
        first = f"    int band_first = {len(writer.table)} * clamp(band, 0, {signature.bands - 1});"
        body = [first, *body]
        results.append(f"    if (band < 0 || band >= {signature.bands}) status = 1;")
    tables = [f"in highp sampler2D {t}" for t in signature.tables]
    arguments = [*(f"in float {i}" for i in signature.inputs), *tables, *band]
    arguments += [*(f"out float {o}" for o in signature.outputs), *["out int status"] * (status is not None)]
    parameters = ",\n    ".join(arguments)
    return text + f"\nvoid {name}(\n    {parameters})\n{{\n" + "\n".join([*body, *results]) + "\n}\n"
