"""Programs as GLSL: one function with the contract of the C header."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from neurolens.graph.c import NOTHING, Extras, Signature, Writer, comment_of, literal, part
from neurolens.graph.program import Program


class _Writer(Writer):
    # The macro of a b + c is that of C, so that the steps of both are the same lines.
    texts: ClassVar = Writer.texts | {
        "sqrt": "sqrt({0})", "floor": "floor({0})", "clamp": "max(min({0}, {1}), -{1})"
    }  # fmt: skip
    # Tables of the caller are textures of one float a texel, a cell a line; NaN is less than nothing in no language.
    lookup = "texelFetch({table}, ivec2({place}, clamp(int({index}), 0, textureSize({table}, 0).y - 1)), 0).r"
    own_lookup = "{table}[{width} * clamp(int({index}), 0, {cells} - 1) + {place}]"


def write_glsl(program: Program, name: str, comment: Sequence[str], extras: Extras = NOTHING) -> str:
    """The text of a function; arguments as in `c.write_c`."""
    signature, mixture, writer = Signature.of(program, name), program.mixture, _Writer(program, name)
    writer.place = "state.c[{}]" if signature.state else f"{name}_table[band_first + {{}}]"
    body = writer.steps()
    results = [f"    {o} = {writer.output(o)};" for o in signature.outputs]
    results += [f"    status = int({writer.output('status')});"] if signature.status else []
    text = part("parts.glsl", "head", comment=comment_of(comment), fma=f"{name.upper()}_FMA")
    text += "\n" * bool(extras.constants)
    text += "".join(f"const float {name.upper()}_{k.upper()} = {literal(v)};\n" for k, v in extras.constants.items())
    for key, function in extras.functions.items():
        text += f"\n{_Writer(function, name).one_number(f'{name}_{key}')}"
    constants = {table: numbers.reshape(-1) for table, numbers in program.own_tables.items()}
    if mixture is not None:
        parts = _Writer(mixture.program, name).state_parts(mixture, writer.table)
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
        body = [f"    int band_first = {len(writer.table)} * clamp(band, 0, {signature.bands - 1});", *body]
        results.append(f"    if (band < 0 || band >= {signature.bands}) status = 1;")
    arguments = [*(f"in float {i}" for i in signature.inputs), *(f"in highp sampler2D {t}" for t in signature.tables)]
    arguments += [*band, *(f"out float {o}" for o in signature.outputs), *["out int status"] * signature.status]
    parameters = ",\n    ".join(arguments)
    return text + f"\nvoid {name}(\n    {parameters})\n{{\n" + "\n".join([*body, *results]) + "\n}\n"
