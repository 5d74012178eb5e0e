"""Derivatives of programs: forward-mode differentiation, step by step.

What values and derivatives have in common is done once (Griewank and Walther, "Evaluating Derivatives", 2008,
chapter 3).
"""

from __future__ import annotations

from collections.abc import Sequence

from neurolens.graph.program import Argument, Expr, Program, Step, derivative


def with_derivatives(program: Program, outputs: Sequence[str], inputs: Sequence[str]) -> Program:
    """The program with an output `derivative(output, input)` for every pair besides its own.

    Every derivative stands right behind its value, while that is at hand. At a choice (select, max, min) the
    derivative is that of what was chosen.
    """
    found = Program(program.tables)
    place: dict[int, Expr] = {}  # of the steps of `program`
    moves: dict[str, dict[int, Expr]] = {name: {} for name in inputs}  # their derivatives, where there are any

    def value(argument: Argument) -> Expr:
        return place[argument] if isinstance(argument, int) else found.literal(argument)

    for k in program.live():
        step = program.steps[k]
        given = [value(a) for a in step.arguments]
        place[k] = found.op(step.kind, *given) if step.kind != "input" else found.input(step.name)
        for name, known in moves.items():
            slope = _slope(program, k, step, place[k], given, known, name)
            if not slope.is_literal(0):
                known[k] = slope
    found.outputs = {name: value(e.argument) for name, e in program.outputs.items()}
    for name, known in moves.items():
        for output in outputs:
            argument = program.outputs[output].argument
            moved = known.get(argument) if isinstance(argument, int) else None
            found.outputs[derivative(output, name)] = found.literal(0.0) if moved is None else moved
    return found


def _slope(
    program: Program, k: int, step: Step, value: Expr, given: list[Expr], known: dict[int, Expr], name: str
) -> Expr:
    """Derivative of one step by an input, from the derivatives known of the steps that it takes."""
    new = value.program
    zero = new.literal(0.0)

    def of(argument: Argument) -> Expr:
        return known.get(argument, zero) if isinstance(argument, int) else zero

    if step.kind == "input":
        return new.literal(float(step.name == name))
    if k in program.tanhs:
        inner = of(program.tanhs[k])
        return zero if inner.is_literal(0) else inner * new.fma(-value, value, 1.0)
    moves = [of(a) for a in step.arguments]
    return zero if all(m.is_literal(0) for m in moves) else _RULES[step.kind](new, value, given, moves)


def _product(program: Program, a: Expr, b: Expr, da: Expr, db: Expr, rest: Expr) -> Expr:
    return program.fma(da, b, program.fma(a, db, rest))


_RULES = {
    "neg": lambda p, y, v, d: -d[0],
    "add": lambda p, y, v, d: d[0] + d[1],
    "sub": lambda p, y, v, d: d[0] - d[1],
    "mul": lambda p, y, v, d: _product(p, v[0], v[1], d[0], d[1], p.literal(0.0)),
    # One reciprocal serves all directions.
    "div": lambda p, y, v, d: (d[0] - y * d[1]) * (p.literal(1.0) / v[1]),
    "sqrt": lambda p, y, v, d: d[0] * (p.literal(0.5) / y),
    "max": lambda p, y, v, d: p.select(v[0], v[1], d[1], d[0]),
    "min": lambda p, y, v, d: p.select(v[0], v[1], d[0], d[1]),
    "clamp": lambda p, y, v, d: p.select(v[0], v[1], p.select(-v[1], v[0], d[0], 0.0), 0.0),
    "fma": lambda p, y, v, d: _product(p, v[0], v[1], d[0], d[1], d[2]),
    "select": lambda p, y, v, d: p.select(v[0], v[1], d[2], d[3]),
}
