"""Programs in shading languages: one writer, and for each language the texts in which it differs from GLSL.

The contract is that of the C header. The results of a ray are a structure NAME_ray where that is a language's habit,
else arguments. Tables of the caller are textures of one float a texel, a cell a line, or buffers.

Open Shading Language differs more (`write_osl`): a shader calls no functions of other files, has no structs, and its
literals have no suffix. What it reads from the renderer is text of the caller.
"""

import re
import textwrap
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np

from neurolens.base.errors import InputError
from neurolens.graph.c import NOTHING, Extras, Signature, Writer, comment_of, literal, part
from neurolens.graph.program import Argument, Mixture, Program, Step

_CAUTION = (
    "Results mean something where status is 0. A language that may ignore NaN cannot promise the status of one: rays "
    "handed in must be numbers."
)


class Glsl(Writer):
    """GLSL; the other languages replace some of its texts.

    Attributes:
        about: a line for the comment at the top. head: what follows it, or the key of a text in `parts.shading`. cell:
            a further head, where the caller's tables are looked up.
        given, out: the declaration of an argument and of a result. table_of: that of a caller's table.
        ray: whether the results are a structure. field: the declaration of one in it. variable: that of a structure to
            fill.
        whole, truth: the words for integers and truths. let_whole: the word before a new integer's name. to_whole: a
            float made an integer. band: the argument `band`, kept below a number.
        number: a constant. array: an array of numbers, after the word `constant` or `local`. row: an array in a
            structure.
        within: whether arrays may stand only within functions. loops: whether a state is made in loops over an array,
            which compilers of some languages copy for each ray; else by statements.
        own_table: whether a camera's file holds the outline of the pupil. For an array of 43,000 constants shader
            compilers take minutes: there the caller brings it.
    """

    about = "For GLSL 3.30, GLSL ES 3.00 (with highp floats) and later."
    # The macro of a b + c is that of C, so that the steps of both are the same lines.
    head, cell = "#define {macro}_FMA(a, b, c) ((a) * (b) + (c))\n", ""
    texts: ClassVar = Writer.texts | {
        "sqrt": "sqrt({0})", "floor": "floor({0})", "clamp": "max(min({0}, {1}), -{1})"
    }  # fmt: skip
    # Clamped as an integer, so that an index of NaN, too, reads a cell of the table.
    lookup = "texelFetch({table}, ivec2({place}, clamp(int({index}), 0, textureSize({table}, 0).y - 1)), 0).r"
    own_lookup = "{table}[{width} * clamp(int({index}), 0, {cells} - 1) + {place}]"
    header, given, out, table_of = "{2} {0}({1})", "in {}", "out {}", "in highp sampler2D {}"
    ray, field, variable, row = False, "{};", "{};", "float {}[{}];"
    whole, truth, let_whole = "int", "bool", "int"
    to_whole, band = "int({})", "clamp(band, 0, {} - 1)"
    number, array = "const float {} = {};", "float {0}[{1}] = float[{1}]({2});"
    constant, local, within, loops, own_table = "const ", "", False, True, False

    @property
    def known(self) -> dict[str, str]:
        return {"name": self.name, "macro": self.name.upper()}

    def file(self, comment: Sequence[str], extras: Extras) -> str:
        """Write a file; arguments as in `c.write_c`."""
        about = textwrap.wrap(f"{self.about} {_CAUTION}", 110)
        return f"/*\n{comment_of([*comment, '', *about])}\n */\n{self.code(extras)}"

    def code(self, extras: Extras) -> str:
        """Write the file without its comment."""
        program, kind, s = self.program, type(self), Signature.of(self.program, self.name)
        self.place = "state.c[{}]" if s.state else f"{self.name}_table[band_first + {{}}]"
        steps = self.steps()
        arrays = {table: rows.reshape(-1) for table, rows in program.own_tables.items()}
        if self.table and not s.state:
            arrays["table"] = np.array(self.table).T.reshape(-1)
        tables = [self.listed(f"{self.name}_{table}", map(literal, v)) for table, v in arrays.items()]
        head = self.head.format(**self.known)
        text = head if not head or head.endswith("\n") else part("parts.shading", head, **self.known)
        text += part("parts.shading", self.cell, **self.known) if self.cell and s.tables else ""
        text += "\n" * bool(extras.constants)
        for key, value in extras.constants.items():
            text += self.number.format(f"{self.name}_{key}".upper(), literal(value)) + "\n"
        for key, function in extras.functions.items():
            text += f"\n{kind(function, self.name).one_number(f'{self.name}_{key}')}"
        text += "" if self.within else "".join(f"\n{table}\n" for table in tables)
        if program.mixture is not None:
            text += kind(program.mixture.program, self.name).state(program.mixture, self.table)
        return text + self._ray(s, [f"    {table}" for table in tables if self.within] + steps)

    def listed(self, name: str, texts: Iterable[str], before: str | None = None) -> str:
        """Write an array: a constant, unless another word comes `before` it."""
        values = [text.strip(" \n()") for text in texts]
        rows = ",\n    ".join(", ".join(values[i : i + 8]) for i in range(0, len(values), 8))
        word = self.constant.format(**self.known) if before is None else before
        return word + self.array.format(name, len(values), rows)

    def state(self, mixture: Mixture, table: Sequence[Sequence[float]]) -> str:
        """Write the structure of a state and the function that makes it; arguments as in `c.Writer.state_parts`."""
        parts = self.state_parts(mixture, table)
        kind, numbers, features = f"{self.name}_state", parts["rows"].split(","), parts["features"]
        fields = [self.field.format(self.declared.format("inside", self.truth)), self.row.format("c", parts["count"])]
        nodes, sums = "", []
        if self.loops:
            nodes = self.listed(f"{self.name}_nodes", numbers) + "\n\n"
            sums = [part("parts.shading", "sums", **self.known, **parts).rstrip()]
        else:
            for i in range(parts["count"]):
                row = numbers[features * i : features * (i + 1)]
                terms = (
                    f"{number.strip()} * feature[{k}]" for k, number in enumerate(row) if float(number.strip("( f)\n"))
                )
                sums.append(f"    state.c[{i}] = {' + '.join(terms) or '0.0'};")
        return part(
            "parts.shading", "state", **self.known, **parts, struct=_struct(kind, fields), nodes=nodes,
            state=self.variable.format(self.declared.format("state", kind)), sums="\n".join(sums),
            feature=self.listed("feature", parts["made"].split(", "), self.local),
        )  # fmt: skip

    def _ray(self, s: Signature, body: list[str]) -> str:
        """Write the function of a ray, and the structure of its results."""
        place, values = "ray." * self.ray, {o: self.output(o) for o in s.outputs}
        kinds = dict.fromkeys(s.outputs, self.kind)
        if s.status:
            kinds["status"], values["status"] = self.whole, self.to_whole.format(self.output("status"))
        inputs = dict.fromkeys(s.inputs, self.kind)
        body = [*body, *(f"    {place}{o} = {value};" for o, value in values.items())]
        if s.state:
            inputs["state"] = f"{s.name}_state"
            body.append(f"    if (!state.inside) {{ {place}status = 1; }}")
        elif s.bands > 1:
            inputs["band"] = self.whole
            band = self.band.format(s.bands, name=s.name)
            body.insert(0, f"    {self.let_whole} band_first = {len(self.table)} * {band};")
            body.append(f"    if (band < 0 || band >= {s.bands}) {{ {place}status = 1; }}")
        outputs = [self.declared.format(o, kind) for o, kind in kinds.items()]
        declared = [self.given.format(self.declared.format(i, kind)) for i, kind in inputs.items()]
        declared[len(s.inputs) : len(s.inputs)] = [self.table_of.format(t) for t in s.tables]
        kind, struct = "void", ""
        if self.ray:
            kind = f"{s.name}_ray"
            struct = "\n" + _struct(kind, map(self.field.format, outputs))
            body = [f"    {self.variable.format(self.declared.format('ray', kind))}", *body, "    return ray;"]
        else:
            declared += map(self.out.format, outputs)
        parameters = "\n    " + f"{self.between.rstrip()}\n    ".join(declared)
        header = self.header.format(s.name, parameters, kind, macro=s.name.upper())
        return "\n".join([f"{struct}\n{header}", "{", *body, "}\n"])


def _struct(name: str, fields: Iterable[str]) -> str:
    return "\n".join([f"struct {name} {{", *(f"    {field}" for field in fields), "};\n"])


class Hlsl(Glsl):
    """HLSL, from shader model 5 on."""

    about = "For HLSL of shader model 5 and later."
    head, cell = "", "hlsl_cell"
    texts: ClassVar = Glsl.texts | {"fma": "mad({0}, {1}, {2})"}
    table_of, lookup = "Texture2D {}", "{table}.Load(int3({place}, {name}_cell({table}, {index}), 0)).r"
    number, array, constant = "static const float {} = {};", "float {0}[{1}] = {{\n    {2}\n}};", "static const "
    loops = False


class Slang(Hlsl):
    """Slang, which is like HLSL, but has its tables as buffers, as every target of it can read them."""

    about, cell = "For Slang.", "slang_cell"
    table_of = "StructuredBuffer<float> {}"
    lookup = "{table}[{width} * {name}_cell({table}, {index}, {width}) + {place}]"


class Wgsl(Glsl):
    """WGSL, the language of WebGPU."""

    about, head = "For WGSL (WebGPU).", ""
    texts: ClassVar = Glsl.texts | {
        "max": "select({1}, {0}, {0} > {1})", "min": "select({1}, {0}, {0} < {1})", "fma": "fma({0}, {1}, {2})",
        "select": "select({3}, {2}, {0} <= {1})",
    }  # fmt: skip
    table_of = "{}: texture_2d<f32>"
    lookup = "textureLoad({table}, vec2({place}, clamp(i32({index}), 0, i32(textureDimensions({table}).y) - 1)), 0).r"
    own_lookup = "{table}[{width} * clamp(i32({index}), 0, {cells} - 1) + {place}]"
    declared, kind, let, header, given = "{0}: {1}", "f32", "let", "fn {0}({1}) -> {2}", "{}"
    ray, field, variable, row = True, "{},", "var {};", "{}: array<f32, {}>,"
    whole, let_whole, to_whole, loops = "i32", "let", "i32({})", False
    # Arrays are not `const`: naga would copy a constant array for every number that is read.
    number, array = "const {} = {};", "{0} = array<f32, {1}>(\n    {2}\n);"
    constant, local = "var<private> ", "var "


REGISTERS = 220  # numbers that a thread of CUDA holds, of 255; some registers have addresses


class Cuda(Glsl):
    """CUDA, and C++ for the host."""

    about = "For CUDA, and C++ on the host. Never compile it with --use_fast_math or -ffast-math."
    head = "cuda_head"
    texts: ClassVar = Glsl.texts | {
        "sqrt": "sqrtf({0})", "floor": "floorf({0})", "clamp": "fmaxf(fminf({0}, {1}), -{1})",
        "fma": "fmaf({0}, {1}, {2})",
    }  # fmt: skip
    table_of, lookup, own_lookup = "const float *{0}, int {0}_cells", Writer.lookup, Writer.lookup
    header, given, ray, own_table = "{macro}_DEVICE {2} {0}({1})", "{}", True, True
    band, to_whole = "{name}_cell(float(band), {})", "int({})"
    number, array, constant = "#define {} {}", "float {0}[{1}] = {{\n    {2}\n}};", "{macro}_TABLE "
    places: Mapping[Argument, str]

    def steps(self) -> list[str]:
        """Write the steps as lines. What is kept goes to memory: compilers would hold on to what is made again."""
        steps = self.program.steps
        kept = dict.fromkeys(steps[k].arguments[0] for k in self.program.live() if steps[k].kind == "kept")
        self.places = {k: f"kept[{row}]" for row, k in enumerate(kept)}
        stores = {self.value(k): f"    {place} = {self.value(k)};" for k, place in self.places.items()}
        lines = [f"    volatile float kept[{len(kept)}];"] * bool(kept)
        lines += [stores[self.value(k)] for k in kept if isinstance(k, int) and steps[k].kind == "input"]
        return lines + [text for line in super().steps() for text in (line, stores.get(line.split()[1])) if text]

    def step(self, step: Step) -> str:
        """Write the expression of a step."""
        return self.places[step.arguments[0]] if step.kind == "kept" else super().step(step)

    def kernel(self) -> str:
        """Write `code` and a kernel of arrays, NAME_rays(in, call, tables ..., out, n).

        `in` has the inputs of a ray, as rows of n numbers. `call` has those of the whole call. A table is two
        arguments, its numbers and its cells. `out` gets the results as rows; the last is the status, as a number. On
        the host it is a loop.
        """
        s = Signature.of(self.program, self.name)
        rows = [f"in[{k} * rows + i]" for k in range(len(s.per_ray))]
        given = [*rows, *(f"call[{k}]" for k in range(len(s.per_call)))]
        tables = [f"{table}, {table}_cells" for table in s.tables]
        results = [*s.outputs, *["status"] * s.status]
        return self.code(NOTHING) + part(
            "parts.shading", "cuda_rays", **self.known, given=", ".join([*given, *tables]),
            tables="".join(f"{self.table_of.format(table)}, " for table in s.tables),
            results="\n".join(f"    out[{k} * rows + i] = float(ray.{o});" for k, o in enumerate(results)),
            same=", ".join([*("in", "call"), *tables, "out", "rows", "i"]),
        )  # fmt: skip


class Vex(Glsl):
    """VEX of Houdini, which has no constants outside functions."""

    about, head = "For VEX. Houdini did not compile this: it is written after the reference of VEX.", ""
    texts: ClassVar = Glsl.texts | {"fma": "{0} * {1} + {2}"}
    table_of, given, out, between = "float {}[]", "{}", "export {}", "; "
    lookup = "{table}[{width} * clamp(int({index}), 0, len({table}) / {width} - 1) + {place}]"
    number, array, constant, within = "#define {} {}", "float {0}[] = {{\n    {2}\n}};", "", True

    def code(self, extras: Extras) -> str:
        """Write the file without its comment; literals of VEX have no suffix."""
        if self.program.mixture is not None:
            expected = "one state (--zoom), or another language"
            raise InputError("export", "to", "vex (of a range of zoom or focus)", expected)
        return plain(super().code(extras))


LANGUAGES = {"glsl": Glsl, "slang": Slang, "hlsl": Hlsl, "wgsl": Wgsl, "cuda": Cuda, "vex": Vex}


def write_shading(
    language: type[Glsl], program: Program, name: str, comment: Sequence[str], extras: Extras = NOTHING
) -> str:
    """Write a program as a file of a language; arguments as in `c.write_c`.

    Raises:
        InputError: the program has many states, and the language is VEX.
    """
    return language(program, name).file(comment, extras)


write_glsl = partial(write_shading, Glsl)


# ---- Open Shading Language: one camera shader of Blender's Cycles ----

TEMPORARY = re.compile(r"\bt(\d+)\b")
_SUFFIX = re.compile(r"(\d\.?(?:e[+-]\d+)?)f\b")
# OSL's compiler takes 10,000 statements; beyond ours, one statement declares so many numbers
_STATEMENTS, _TOGETHER = 9000, 64
_KINDS = {"position": "point", "throughput": "color"}


@dataclass(frozen=True)
class Parameter:
    """A number that the user of a shader sets.

    Attributes:
        name, label, help: what code and users call it, and what it does. default: where it is an int, so is the
            parameter.
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
        """Write its declaration."""
        kind = "int" if isinstance(self.default, int) else "float"
        metadata = [f'string label = "{self.label}"', f'string help = "{self.help}"']
        if self.widget:
            metadata.append(f'string widget = "{self.widget}"')
        else:
            metadata += [f"{kind} {k} = {_number(value, kind)}" for k, value in (("min", self.low), ("max", self.high))]
        metadata += [f'string options = "{self.options}"'] * bool(self.options)
        return f"{kind} {self.name} = {_number(self.default, kind)}\n        [[ {', '.join(metadata)} ]]"


class Osl(Writer):
    """Writes choices as functions: as branches, they would cost a tenth of a whole camera."""

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
    """Write a program as a shader.

    Args:
        comment: lines of its head. parameters: those that the user sets.
        frame: statements that set a float for each input of the program.
        outputs: names of three rows each; the program has them as NAME_0 to NAME_2.

    A state's numbers are mixed in the shader, which costs nothing where the renderer knows the state when it compiles.
    """
    writer = Osl(program, name)
    head = [*(p.text() for p in parameters), *(f"output {_KINDS.get(o, 'vector')} {o} = 0.0" for o in outputs)]
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
    """Sort lines `float tN = ...;` so that those come first on which the longest chain of others depends.

    So few lines wait for one another. Compilers of shaders make no vectors of them and keep much of the given order.
    """
    numbers = [[int(n) for n in TEMPORARY.findall(line)] for line in lines]
    ahead: defaultdict[int, int] = defaultdict(int)
    for own, *arguments in reversed(numbers):
        for n in arguments:
            ahead[n] = max(ahead[n], ahead[own] + 1)
    return [lines[k] for k in sorted(range(len(lines)), key=lambda k: -ahead[numbers[k][0]])]


def _mixed(mixture: Mixture, writer: Osl) -> str:
    """Write the features `s0` ... of the state, and the coefficients `c0` ... that differ between tables."""
    state = Osl(mixture.program, "")
    names = [state.output(name) for name in mixture.program.outputs if name != "inside"]
    text = "\n".join(f"    {line.strip()}" for line in state.steps())
    rows = np.array(writer.table, np.float64) @ mixture.transform.T
    for k, row in enumerate(rows):
        terms = (f"{literal(v)} * {name}" for v, name in zip(row, names, strict=True) if v)
        text += f"\n    float c{k} = {' + '.join(terms) or '0.0'};"
    return TEMPORARY.sub(r"s\1", plain(text)) + "\n"


def _together(lines: Sequence[str]) -> list[str]:
    """Write the same declarations of floats in fewer statements."""
    names = [line.strip().removeprefix("float ").removesuffix(";") for line in lines]
    parts = (names[k : k + _TOGETHER] for k in range(0, len(names), _TOGETHER))
    return ["    float " + ",\n      ".join(part) + ";" for part in parts]


def plain(text: str) -> str:
    """Return C's literals without their suffix."""
    return _SUFFIX.sub(r"\1", text)


def _number(value: float, kind: str) -> str:
    return str(int(value)) if kind == "int" else repr(float(value))
