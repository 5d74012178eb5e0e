"""Reverse-mode differentiation of programs: from gradients by the results to gradients by the inputs.

From the gradient of a number by every result, one pass from the last step back to the first gives its gradient by every
input. Each kind of step has one rule, and a polynomial of one number or tanh has its slope at once. The whole takes
about twice the operations of the program itself, however many inputs there are; `derive` has the forward mode, which
takes fewer where inputs are few and results many. Where a step chooses, its rule follows the choice that the ray took.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

from neurolens.base.status import PASSED
from neurolens.graph.program import STATUS, Argument, Expr, Program, Step

OUTER = "outer_"  # an input: the gradient by the result of the name that follows
INNER = "by_"  # a result: the gradient by the input of the name that follows

PART = 300  # steps of a part whose numbers are made again
_DEAR = ("div", "sqrt", "lookup")  # dearer to make again than to keep
# From the gradient by a step's value, the value and the step's arguments: the gradients by the arguments (None is 0).
Rule = Callable[[Expr, Expr, Sequence[Expr]], Sequence[Expr | None]]


def _where(low: Expr, high: Expr, then: Expr | float, otherwise: Expr | float) -> Expr:
    return low.program.select(low, high, then, otherwise)


_RULES: dict[str, Rule] = {
    "neg": lambda g, y, x: [-g],
    "add": lambda g, y, x: [g, g],
    "sub": lambda g, y, x: [g, -g],
    "mul": lambda g, y, x: [g * x[1], g * x[0]],
    "div": lambda g, y, x: [None, -(g * y) * y],  # `_prepared` leaves quotients of one alone
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


class _Values:
    """The values of a program's steps, as the way back meets them.

    With a size, the steps are cut into parts of about so many, of which the way back takes the last first. Kept for it
    are numbers that cross a cut, quotients, roots, lookups and `dear` ones; it makes the rest again, part by part.
    Without a size every value waits for the way back.
    """

    def __init__(self, program: Program, dear: Collection[int], size: int) -> None:
        forward = program.live()
        self.program, self.again = program, dict[int, Expr]()
        parts = program.in_parts(size) if size else [forward]
        self.part = {k: number for number, steps in enumerate(parts) for k in steps}
        self.part |= {k: -1 for k in forward if program.steps[k].kind == "input" and not program.steps[k].per_call}
        self.order = [k for k in forward if self.part.get(k, -1) < 0] + [k for steps in parts for k in steps]
        self.last = self.now = len(parts) - 1
        self.kept = {*dear, *program.tanh_of, *(k for k in forward if program.steps[k].kind in _DEAR)}

    def back_to(self, k: int) -> None:
        """Tell that the way back has come to a step: it will not need the values of later steps again."""
        if (part := self.part.get(k, -1)) != self.now:
            self.now = part
            self.again.clear()

    def __call__(self, argument: Argument) -> Expr:
        if not isinstance(argument, int) or self.now == self.last or argument not in self.part:
            return Expr(self.program, argument)
        if argument not in self.again:
            step = self.program.steps[argument]
            if self.part[argument] < self.now or argument in self.kept:
                self.again[argument] = self.program.kept(argument, self.now)
            else:
                given = tuple(self(a).argument for a in step.arguments)
                self.again[argument] = self.program._append(step._replace(arguments=given))
        return self.again[argument]


def adjoint(program: Program, outputs: Collection[str], inputs: Collection[str], registers: int = 0) -> Program:
    """Return the program that turns gradients by results into gradients by inputs.

    It takes the inputs of the program and, for each of the results, the gradient `outer_NAME` of some number by it; it
    gives the gradient `by_NAME` of that number by each of the inputs. Where the program has a status, that is a result,
    too, and gradients of rays that do not pass are 0. Tables are constants.

    Args:
        program: one with a single coefficient table.
        outputs: names of results that the number depends on.
        inputs: names of inputs, in the order of the gradients. The gradient by a name that the program does not take is
            0.
        registers: where more numbers would wait for the way back, it makes some again (0: it never does). That takes
            more operations, and less memory than registers that overflow.

    Raises:
        ValueError: the program's coefficients follow a state or a band.
    """
    if program.tables != 1 or program.mixture is not None:
        raise ValueError("adjoint: expected a program of one table of coefficients")
    prepared = _prepared(program.with_single_cells(), inputs)
    found = _way_back(*prepared, outputs, inputs, 0)
    if registers and found.most_waiting() > registers:
        found = _way_back(*prepared, outputs, inputs, PART)
    return found


def _way_back(
    found: Program,
    slopes: Mapping[int, tuple[int, Argument]],
    outputs: Collection[str],
    inputs: Collection[str],
    size: int,
) -> Program:
    """Return the adjoint of a prepared program; its steps are made in parts of a size, or without one at once."""
    found = replace(found, steps=list(found.steps), _known=dict(found._known))
    results, gradients = found.outputs, dict[int, Expr]()
    found.outputs = results | {f"slope_{k}": Expr(found, slope) for k, (_, slope) in slopes.items()}
    moving = _moving(found, inputs)
    values = _Values(found, {n for k, (_, slope) in slopes.items() if slope in moving for n in (k, slope)}, size)

    def add(argument: Argument, part: Expr | None) -> None:
        if part is not None and isinstance(argument, int) and argument in moving:
            before = gradients.get(argument)
            gradients[argument] = part if before is None else _added(before, part)

    for name in outputs:
        add(results[name].argument, found.input(f"{OUTER}{name}"))
    for k in reversed(values.order):
        step = found.steps[k]
        values.back_to(k)
        if k in gradients and k in slopes:  # its steps would all have to wait for their gradients
            of, slope = slopes[k]
            add(of, gradients[k] * values(slope))
        elif k in gradients and k in found.tanh_of:
            y = values(k)
            add(found.tanh_of[k], gradients[k] * (found.literal(1.0) - y * y))
        elif k in gradients and step.kind in _RULES:
            given = [values(a) for a in step.arguments]
            for argument, part in zip(step.arguments, _RULES[step.kind](gradients[k], values(k), given), strict=True):
                add(argument, part)
    places = {found.steps[k].name: k for k in values.order if found.steps[k].kind == "input"}
    found.outputs, zero = {}, found.literal(0.0)
    for name in inputs:
        gradient = gradients.get(places.get(name, -1), zero)
        if STATUS in results:
            gradient = found.select(results[STATUS], float(PASSED), gradient, zero)
        found.outputs[f"{INNER}{name}"] = gradient
    found.outputs |= {name: value for name, value in results.items() if name == STATUS}
    return found.with_shared_inverses().in_order_of_need()


def _prepared(program: Program, inputs: Collection[str]) -> tuple[Program, dict[int, tuple[int, Argument]]]:
    """Return the program as `_way_back` takes it, and its steps that are a polynomial of one number.

    These are named with that number and with their slope by it, which is made beside them: its coefficients, that may
    depend on other numbers, need not wait. Quotients are products with the inverse, which has its slope at once.
    """
    moving, slopes = _moving(program, inputs), dict[int, tuple[int, Argument]]()

    def prepared(k: int, step: Step, given: Sequence[Expr]) -> Expr | None:
        if k not in moving or k in program.tanh_of:
            return None
        if step.kind == "div":
            return given[0] * given[0].program.op("div", 1.0, given[1])
        if step.kind not in ("fma", "mul") or step.arguments[2:] and step.arguments[2] in moving:
            return None
        for before, of in ((0, 1), (1, 0)):
            inner, slope, t = given[before], given[before], given[of].argument
            if step.arguments[of] not in moving or not isinstance(t, int):
                continue
            if step.arguments[before] in moving:
                known = slopes.get(inner.argument) if isinstance(inner.argument, int) else None
                if known is None or known[0] != t:
                    continue
                slope = inner.program.fma(Expr(inner.program, known[1]), given[of], inner)
            value = inner.program._append(step._replace(arguments=tuple(e.argument for e in given)))
            if isinstance(value.argument, int):
                slopes[value.argument] = t, slope.argument
            return value
        return None

    return program._rewritten(prepared), slopes


def _added(before: Expr, part: Expr) -> Expr:
    step = part.program.steps[part.argument] if isinstance(part.argument, int) else None
    if step is not None and step.kind == "neg":
        return before - Expr(part.program, step.arguments[0])
    return part.program.sum(before, part)


def _moving(program: Program, names: Collection[str]) -> set[int]:
    """Return the numbers of the steps that depend on the inputs of these names."""
    moving = set[int]()
    for k in program.live():
        step = program.steps[k]
        if step.name in names if step.kind == "input" else any(a in moving for a in step.arguments):
            moving.add(k)
    return moving
