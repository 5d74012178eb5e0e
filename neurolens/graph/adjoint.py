"""Reverse-mode differentiation of programs: from gradients by the results to gradients by the inputs.

From the gradient of a number by every result, one pass from the last step back to the first gives its gradient by every
input. Each kind of step has one rule, and a series or tanh has its slope at once. The whole takes about twice the
operations of the program itself, however many inputs there are; `derive` has the forward mode, which takes fewer where
inputs are few and results many. Where a step chooses, its rule follows the choice that the ray took.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

from neurolens.base.status import PASSED
from neurolens.graph.program import STATUS, Argument, Expr, Program

OUTER = "outer_"  # an input: the gradient by the result of the name that follows
INNER = "by_"  # a result: the gradient by the input of the name that follows

# From the gradient by a step's value, the value and the step's arguments: the gradients by the arguments (None is 0).
Rule = Callable[[Expr, Expr, Sequence[Expr]], Sequence[Expr | None]]


def _where(low: Expr, high: Expr, then: Expr | float, otherwise: Expr | float) -> Expr:
    return low.program.select(low, high, then, otherwise)


def _divided(outer: Expr, value: Expr, given: Sequence[Expr]) -> Sequence[Expr]:
    share = outer / given[1]
    return share, -(share * value)


_RULES: dict[str, Rule] = {
    "neg": lambda g, y, x: [-g],
    "add": lambda g, y, x: [g, g],
    "sub": lambda g, y, x: [g, -g],
    "mul": lambda g, y, x: [g * x[1], g * x[0]],
    "div": _divided,
    # 0 at the root of 0, which film points on the axis meet: their radius has no slope there, and the rule gives
    # infinity.
    "sqrt": lambda g, y, x: [_where(y, y.program.literal(0.0), 0.0, g * 0.5 / y)],
    "floor": lambda g, y, x: [None],
    "max": lambda g, y, x: [_where(x[0], x[1], 0.0, g), _where(x[0], x[1], g, 0.0)],
    "min": lambda g, y, x: [_where(x[1], x[0], 0.0, g), _where(x[1], x[0], g, 0.0)],
    "clamp": lambda g, y, x: [_where(x[1] * x[1], x[0] * x[0], 0.0, g), None],
    "fma": lambda g, y, x: [g * x[1], g * x[0], g],
    "select": lambda g, y, x: [None, None, _where(x[0], x[1], g, 0.0), _where(x[0], x[1], 0.0, g)],
}


def adjoint(program: Program, outputs: Collection[str], inputs: Collection[str]) -> Program:
    """Return the program that turns gradients by results into gradients by inputs.

    It takes the inputs of the program and, for each of the results, the gradient `outer_NAME` of some number by it; it
    gives the gradient `by_NAME` of that number by each of the inputs. Where the program has a status, that is a result,
    too, and gradients of rays that do not pass are 0. Tables are constants.

    Args:
        program: one with a single coefficient table.
        outputs: names of results that the number depends on.
        inputs: names of inputs, in the order of the gradients. The gradient by a name that the program does not take is
            0.

    Raises:
        ValueError: the program's coefficients follow a state or a band.
    """
    if program.tables != 1 or program.mixture is not None:
        raise ValueError("adjoint: expected a program of one table of coefficients")
    found = program.with_single_cells()
    forward, results = found.live(), found.outputs
    moving, gradients = _moving(found, inputs), dict[int, Expr]()

    def add(argument: Argument, part: Expr | None) -> None:
        if part is not None and isinstance(argument, int) and argument in moving:
            before = gradients.get(argument)
            gradients[argument] = part if before is None else _added(before, part)

    for name in outputs:
        add(results[name].argument, found.input(f"{OUTER}{name}"))
    for k in reversed(forward):
        step = found.steps[k]
        if k in gradients and k in found.functions:  # its steps would all have to wait for their gradients
            of, series = found.functions[k]
            add(of, gradients[k] * _slope(Expr(found, k), Expr(found, of), series))
        elif k in gradients and step.kind in _RULES:
            given = [Expr(found, a) for a in step.arguments]
            for argument, part in zip(
                step.arguments, _RULES[step.kind](gradients[k], Expr(found, k), given), strict=True
            ):
                add(argument, part)
    found.outputs, zero = {}, found.literal(0.0)
    places = {found.steps[k].name: k for k in forward if found.steps[k].kind == "input"}
    for name in inputs:
        gradient = gradients.get(places.get(name, -1), zero)
        if STATUS in results:
            gradient = found.select(results[STATUS], float(PASSED), gradient, zero)
        found.outputs[f"{INNER}{name}"] = gradient
    found.outputs |= {name: value for name, value in results.items() if name == STATUS}
    return found.with_shared_inverses().in_order_of_need()


def _added(before: Expr, part: Expr) -> Expr:
    step = part.program.steps[part.argument] if isinstance(part.argument, int) else None
    if step is not None and step.kind == "neg":
        return before - Expr(part.program, step.arguments[0])
    return part.program.sum(before, part)


def _slope(value: Expr, of: Expr, series: Sequence[float]) -> Expr:
    """Return the slope of a series with these coefficients, or of tanh, by what it is a function of."""
    if not series:
        return value.program.expr(1.0) - value * value
    return value.program.horner(of, [power * c for power, c in enumerate(series)][1:] or [0.0])


def _moving(program: Program, names: Collection[str]) -> set[int]:
    """Return the numbers of the steps that depend on the inputs of these names."""
    moving = set[int]()
    for k in program.live():
        step = program.steps[k]
        if step.name in names if step.kind == "input" else any(a in moving for a in step.arguments):
            moving.add(k)
    return moving
