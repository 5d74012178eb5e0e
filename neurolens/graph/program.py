"""Arithmetic on one ray as a list of single assignments, from which C, GLSL and OSL are written (see `graph.scalars`).

Every step is one operation on floats, without branches. A literal holds one number for each coefficient table of the
program (one table, unless several wavelengths are fixed), so that all tables share their operations.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base.errors import InputError
from neurolens.base.status import OUTSIDE_DOMAIN

# select(a, b, x, y) is x where a <= b, else y; so NaN in a or b gives y. clamp(x, limit) is x cut to [-limit, limit];
# NaN becomes one of the two ends (not in GLSL). Its limit is a number above 0. pick(t, x, y), which only `of_the_call`
# makes, is x where t is 1, y where it is 0, bit by bit. lookup(indices ..., weights ...) is the sum of each weight
# times its group's column of a table, in the cells at the indices (`Graph.lookup`). kept(x) is x.
KINDS = {
    "neg": 1, "add": 2, "sub": 2, "mul": 2, "div": 2, "sqrt": 1, "floor": 1, "max": 2, "min": 2, "clamp": 2, "fma": 3,
    "select": 4, "pick": 3, "kept": 1,
}  # fmt: skip

# Names of the rows of inputs and outputs. Of a lens, in millimetres of the lens frame and nanometres:
RAY = ("film_x_mm", "film_y_mm", "pupil_x_mm", "pupil_y_mm")
FILM_X_Y, WAVELENGTH = RAY[:2], "wavelength_nm"
FILM_Z, STOP_RADIUS = "film_z_mm", "stop_radius_mm"  # for a whole call
SCENE_RAY = ("x_mm", "y_mm", "z_mm", "dx", "dy", "dz")
TRANSMITTANCE, STOP, STATUS = "transmittance", ("stop_x_mm", "stop_y_mm"), "status"
# Of a camera: points of the unit square, and rays in metres.
_ROWS = {
    "rays": (*RAY, WAVELENGTH),
    "film_mm": FILM_X_Y,
    "scene_ray": SCENE_RAY,
    "stop_xy_mm": STOP,
    "square": ("u", "v"),
    "pupil_mm": RAY[2:],
    "ray": ("x_m", "y_m", "z_m", "dx", "dy", "dz"),
}
# Of a ghost: light at the front, and light at the film.
ENTERING, ARRIVING = ("dx", "dy", "x_mm", "y_mm", WAVELENGTH), ("film_x_mm", "film_y_mm", "power", "worst")
_ROWS |= {"entering": ENTERING, "arriving": ARRIVING}

# tanh x = x P(x^2) / Q(x^2) on [-9.02, 9.02], beyond which float32 has 1: the rational function of these degrees of
# least relative error (2.1e-8), by reweighted least squares. Evaluated in float32 the error is at most 3.1e-7.
TANH_LIMIT = 9.02
TANH_NUMERATOR = (1.0, 0.13379719853401184, 0.0034940363839268684, 2.058350946754217e-05, 1.3319104930076264e-08)
TANH_DENOMINATOR = (1.0, 0.4671303331851959, 0.02587108127772808, 0.0003283095720689744, 7.762034215375024e-07)

T = TypeVar("T")
Literal = tuple[float, ...]
Argument = int | Literal  # the number of an earlier step, or a literal


def row_names(name: str, rows: int) -> tuple[str, ...]:
    """Return the names of the rows of an input or output of a graph."""
    if "_by_" in name:  # derivatives
        output, by = name.split("_by_")
        return tuple(f"{row}_by_{by}" for row in row_names(output, rows))
    if name in _ROWS:
        return _ROWS[name]
    return (name,) if rows == 1 else tuple(f"{name}_{k}" for k in range(rows))


class Step(NamedTuple):
    """One assignment: an operation of `KINDS`, or "input".

    Attributes:
        name: an input's, or that of the table that a lookup reads. per_call: whether an input is one number for all
            rays.
        column: of a lookup, the place in each group of columns. columns: how many a group has. indices: how many it
            takes.
    """

    kind: str
    arguments: tuple[Argument, ...]
    name: str = ""
    per_call: bool = False
    column: int = 0
    columns: int = 0
    indices: int = 1

    def at_indices(self, arguments: Sequence[T]) -> list[tuple[T, Sequence[T]]]:
        """Return each index of a lookup with its weights, from its arguments, or from values that stand for them."""
        count = (len(arguments) - self.indices) // self.indices
        starts = range(self.indices, len(arguments), count)
        return [(index, arguments[k : k + count]) for index, k in zip(arguments, starts, strict=False)]


@dataclass(frozen=True)
class Expr:
    """A value of a program, for arithmetic in Python's own notation."""

    program: Program
    argument: Argument

    @property
    def literal(self) -> Literal | None:
        return self.argument if isinstance(self.argument, tuple) else None

    def is_literal(self, value: float) -> bool:
        """Return whether this is the same number in every table."""
        return self.literal is not None and all(v == value for v in self.literal)

    def __add__(self, other: Number) -> Expr:
        return self.program.op("add", self, other)

    def __sub__(self, other: Number) -> Expr:
        return self.program.op("sub", self, other)

    def __mul__(self, other: Number) -> Expr:
        return self.program.op("mul", self, other)

    def __truediv__(self, other: Number) -> Expr:
        return self.program.op("div", self, other)

    def __neg__(self) -> Expr:
        return self.program.op("neg", self)


Number = Expr | float | ArrayLike


def rules_of(library: Any) -> dict[str, Callable[..., Any]]:
    """Return what each kind of step does to arrays of a library, numpy or torch; callers add their choices."""
    return {
        "neg": lambda a: -a,
        "add": lambda a, b: a + b,
        "sub": lambda a, b: a - b,
        "mul": lambda a, b: a * b,
        "div": lambda a, b: a / b,
        "sqrt": library.sqrt,
        "floor": library.floor,
        "max": lambda a, b: library.where(a > b, a, b),  # NaN gives the second, as in written sources
        "min": lambda a, b: library.where(a < b, a, b),
        "fma": lambda a, b, c: a * b + c,
        "kept": lambda a: a,
    }


_FOLDED = rules_of(np) | {
    "clamp": lambda x, limit: np.where(np.abs(x) < limit, x, np.copysign(limit, x)),
    "select": lambda a, b, x, y: np.where(a <= b, x, y),
    "pick": lambda t, x, y: np.where(t > 0, x, y),
}


@dataclass(frozen=True)
class Mixture:
    """How the numbers of a state are mixed from those of the nodes, each of which has a coefficient table.

    Attributes:
        program: from the state's own numbers to outputs `feature_0` ..., and `inside`, 1 where the state is in range.
        transform: [K, nodes]: features @ transform are the weights of the tables.
    """

    program: Program
    transform: NDArray[np.float64]

    def weights(self, inputs: Mapping[str, ArrayLike]) -> tuple[NDArray[np.float64], bool]:
        """Return the weights [nodes] of a state, and whether the state is in range."""
        features = self.program.evaluate(inputs)
        inside = bool(features.pop("inside"))
        return np.array(list(features.values()), np.float64) @ self.transform, inside


@dataclass
class Program:
    """Steps in order, and the named results.

    Attributes:
        tables: how many coefficient tables there are, the length of every literal.
        mixture: mixes the tables by a state; without it `band` chooses one. Numbers that differ between tables that are
            mixed may be folded into sums alone.
        own_tables: numbers [cells, columns] that lookups read and that no caller gives, by name.
        tanh_of: steps that are tanh of another, and that step: `adjoint` has their slope at once.
    """

    tables: int = 1
    steps: list[Step] = field(default_factory=list)
    outputs: dict[str, Expr] = field(default_factory=dict)
    mixture: Mixture | None = None
    own_tables: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    tanh_of: dict[int, int] = field(default_factory=dict)
    _known: dict[Step, int] = field(default_factory=dict)

    def input(self, name: str, per_call: bool = False) -> Expr:
        return self._append(Step("input", (), name, per_call))

    def lookup(self, table: str, columns: int, column: int, indices: Sequence[Expr], weights: Sequence[Expr]) -> Expr:
        """Append a lookup: the weighted sum, over indices and groups, of one column of each group of `columns`."""
        arguments = tuple(e.argument for e in (*indices, *weights))
        return self._append(Step("lookup", arguments, table, column=column, columns=columns, indices=len(indices)))

    def kept(self, argument: int, part: int) -> Expr:
        """Append a step's number as a part of the way back finds it (`adjoint`), where writers keep it in memory."""
        return self._append(Step("kept", (argument,), column=part))

    def literal(self, value: ArrayLike) -> Expr:
        """Return a number, or one for each table.

        Raises:
            InputError: a number that float32 cannot hold.
        """
        array = np.broadcast_to(np.asarray(value, dtype=np.float64), (self.tables,))
        with np.errstate(over="ignore"):
            if not np.isfinite(array.astype(np.float32)).all():
                raise InputError("export", "weights", "(NaN or infinity)", "finite numbers, in float32 too")
        return Expr(self, tuple(float(v) for v in array))

    def expr(self, value: Number) -> Expr:
        return value if isinstance(value, Expr) else self.literal(value)

    def op(self, kind: str, *values: Number) -> Expr:
        """Append an operation, unless a simpler one does. Equal steps are shared, and literals folded in float64."""
        arguments = [self.expr(v) for v in values]
        if kind == "clamp" and (arguments[1].literal is None or min(arguments[1].literal) <= 0):
            raise ValueError("clamp: expected a limit that is a number above 0")
        simple = self._simplified(kind, arguments)
        return simple if simple is not None else self._append(Step(kind, tuple(e.argument for e in arguments)))

    def fma(self, a: Number, b: Number, c: Number) -> Expr:
        """Return a b + c."""
        return self.op("fma", a, b, c)

    def sum(self, a: Expr, b: Expr) -> Expr:
        """Add two values, in one operation where one of them is a product."""
        for term, other in ((a, b), (b, a)):
            step = self.steps[term.argument] if isinstance(term.argument, int) else None
            if step is not None and step.kind == "mul":
                left, right = (Expr(self, x) for x in step.arguments)
                return self.fma(left, right, other)
        return a + b

    def tanh(self, value: Expr) -> Expr:
        """Return tanh by additions, multiplications and one division, which every compiler vectorises."""
        x = self.op("clamp", value, TANH_LIMIT)
        t = x * x
        found = x * self.horner(t, TANH_NUMERATOR) / self.horner(t, TANH_DENOMINATOR)
        if isinstance(found.argument, int) and isinstance(value.argument, int):
            self.tanh_of[found.argument] = value.argument
        return found

    def select(self, a: Number, b: Number, then: Number, otherwise: Number) -> Expr:
        """Return `then` where a <= b, else `otherwise`, which NaN chooses too."""
        return self.op("select", a, b, then, otherwise)

    def horner(self, t: Expr, coefficients: Sequence[Number]) -> Expr:
        """Return a polynomial in t, lowest coefficient first."""
        terms = [self.expr(c) for c in coefficients]
        value = terms[-1]
        for c in reversed(terms[:-1]):
            value = self.fma(value, t, c)
        return value

    def _append(self, step: Step) -> Expr:
        if step not in self._known:
            self._known[step] = len(self.steps)
            self.steps.append(step)
        return Expr(self, self._known[step])

    def _simplified(self, kind: str, given: list[Expr]) -> Expr | None:
        if all(e.literal is not None for e in given):
            return self.literal(_FOLDED[kind](*(np.array(e.literal) for e in given)))
        if kind == "select" and given[0].literal is not None and given[1].literal is not None:
            chosen = {bool(low <= high) for low, high in zip(given[0].literal, given[1].literal, strict=True)}
            if len(chosen) == 1:
                return given[2 if chosen.pop() else 3]
        if kind == "select" and given[2].argument == given[3].argument:
            return given[2]
        if kind == "fma":
            a, b, c = given
            if c.is_literal(0):
                return self.op("mul", a, b)
            if a.is_literal(0) or b.is_literal(0):
                return c
            if a.is_literal(1) or b.is_literal(1):
                return self.op("add", b if a.is_literal(1) else a, c)
        elif kind == "mul":
            for one, other in (given, reversed(given)):
                if one.is_literal(0):
                    return one
                if one.is_literal(1):
                    return other
        elif kind in ("add", "sub") and given[1].is_literal(0):
            return given[0]
        elif kind == "add" and given[0].is_literal(0):
            return given[1]
        return None

    def live(self) -> list[int]:
        """Return the numbers of the steps that any output needs, in order."""
        wanted = bytearray(len(self.steps))
        for e in self.outputs.values():
            if isinstance(e.argument, int):
                wanted[e.argument] = True
        for k in range(len(self.steps) - 1, -1, -1):
            if wanted[k]:
                for a in self.steps[k].arguments:
                    if isinstance(a, int):
                        wanted[a] = True
        return [k for k, is_wanted in enumerate(wanted) if is_wanted]

    def in_order_of_need(self) -> Program:
        """Return the same program with every product right before the first sum that uses it, so that few values wait.

        Sums (fma) keep their order: if one row of a matrix product followed the other, all products would wait at once.
        """
        order: dict[int, None] = {}
        live = self.live()
        for k in [k for k in live if self.steps[k].kind == "fma"] + live:
            stack = [k]
            while stack:
                missing = [a for a in self.steps[stack[-1]].arguments if isinstance(a, int) and a not in order]
                if missing:
                    stack += missing[::-1]
                else:
                    order[stack.pop()] = None
        return self._rewritten(order=order)

    def with_shorter_sums(self, parts: int = 3, least: int = 8) -> Program:
        """Return the program with long sums in parts: a sum that is added up in turn keeps a core waiting.

        Only rounding differs. A sum is long if it has `least` products or more.
        """
        totals: dict[int, list[Expr]] = {}
        sums = self._sums(least)

        def shorter(k: int, step: Step, given: Sequence[Expr]) -> Expr | None:
            if k not in sums:
                return None
            (last, number), (a, b, before) = sums[k], given
            total = totals.setdefault(last, [])
            if number == 0:
                total.append(a.program.fma(a, b, before))
            elif number < parts:
                total.append(a * b)
            else:
                total[number % parts] = a.program.fma(a, b, total[number % parts])
            return reduce(Expr.__add__, total) if k == last else total[-1]

        return self._rewritten(shorter)

    def with_shared_inverses(self) -> Program:
        """Return the program with one division where several numbers are divided by the same; only rounding differs."""
        live = [self.steps[k] for k in self.live()]
        uses = Counter(step.arguments[1] for step in live if step.kind == "div")

        def shared(k: int, step: Step, given: Sequence[Expr]) -> Expr | None:
            if step.kind != "div" or uses[step.arguments[1]] < 2 or not isinstance(step.arguments[1], int):
                return None  # one over a number that differs between tables could not be mixed
            return given[0] * given[1].program.op("div", 1.0, given[1])

        return self._rewritten(shared)

    def with_single_cells(self) -> Program:
        """Return the program with each lookup as a sum of lookups of one number each; only rounding differs."""

        def single(k: int, step: Step, given: Sequence[Expr]) -> Expr | None:
            if step.kind != "lookup":
                return None
            total, found = None, given[0].program
            for index, weights in step.at_indices(given):
                for group, weight in enumerate(weights):
                    width, column = step.columns * len(weights), step.column + group * step.columns
                    number = found.lookup(step.name, width, column, [index], [found.literal(1.0)])
                    total = weight * number if total is None else found.sum(total, weight * number)
            return total

        return self._rewritten(single)

    def most_waiting(self) -> int:
        """Return how many numbers wait for later steps, at the step where these are most."""
        live = self.live()
        last = {a: k for k in live for a in self.steps[k].arguments}
        ends, waiting = Counter(last[k] for k in live if k in last), [0]
        for k in live:
            waiting.append(waiting[-1] + (k in last) - ends[k])
        return max(waiting)

    def waits(self) -> bool:
        """Return whether a core that works on ray after ray, or vector after vector, mostly waits for results.

        It is counted for a core that does two operations a cycle, and has a result after 4 cycles, a quotient or a root
        after 12. The core looks 144 operations ahead, a number that was chosen by measuring exact lenses and models.
        """
        ready, live = dict[int, int](), self.live()
        for k in live:
            takes = 12 if self.steps[k].kind in ("div", "sqrt") else 4
            ready[k] = takes + max((ready[a] for a in self.steps[k].arguments if isinstance(a, int)), default=0)
        return 2 * max(ready.values(), default=0) > len(live) + 144

    def in_parts(self, size: int) -> list[list[int]]:
        """Return the steps that differ between rays, in runs of about `size`.

        Choices come as soon as they can be made, because everything that a late choice needs would wait for it.
        """
        same, place = self.same_for_all(), dict[int, int]()
        for k in self.live():
            needed = [place[a] for a in self.steps[k].arguments if isinstance(a, int)]
            place[k] = max(needed) if needed and self.steps[k].kind in ("select", "max", "min") else k
        rays = [k for k in place if k not in same and self.steps[k].kind != "input"]
        order = sorted(rays, key=lambda k: (place[k], k))
        return [run.tolist() for run in np.array_split(order, max(1, round(len(order) / size)))]

    def _rewritten(
        self, rule: Callable[[int, Step, Sequence[Expr]], Expr | None] | None = None, order: Iterable[int] = ()
    ) -> Program:
        """Return the same program with its live steps in another order, or with other steps in place of some.

        Args:
            rule: takes a step's number, the step and its new arguments, and returns what replaces it; None keeps the
                step.
        """
        found, place = Program(self.tables, mixture=self.mixture, own_tables=self.own_tables), dict[int, Expr]()

        def moved(argument: Argument) -> Expr:
            return place[argument] if isinstance(argument, int) else Expr(found, argument)

        for k in order or self.live():
            step, given = self.steps[k], [moved(a) for a in self.steps[k].arguments]
            other = rule(k, step, given) if rule else None
            place[k] = other or found._append(step._replace(arguments=tuple([e.argument for e in given])))
        found.outputs = {name: moved(e.argument) for name, e in self.outputs.items()}
        for k, a in self.tanh_of.items():
            value, of = (place[n].argument if n in place else None for n in (k, a))
            if isinstance(value, int) and isinstance(of, int):
                found.tanh_of[value] = of
        return found

    def _sums(self, least: int) -> dict[int, tuple[int, int]]:
        """Find sums of at least `least` products, each of which only the next step uses.

        Returns, for each of their steps, the last step of its sum, and how many steps of the sum come before it.
        """
        live = self.live()
        uses = Counter(a for k in live for a in self.steps[k].arguments)
        uses.update(e.argument for e in self.outputs.values())
        sums: dict[int, list[int]] = {}
        for k in (k for k in live if self.steps[k].kind == "fma"):
            *factors, before = self.steps[k].arguments
            alone = isinstance(before, int) and before in sums and uses[before] == 1 and before not in factors
            sums[k] = [*(sums.pop(before) if alone and isinstance(before, int) else []), k]
        long = (steps for steps in sums.values() if len(steps) >= least)
        return {k: (steps[-1], number) for steps in long for number, k in enumerate(steps)}

    def around_lookups(self) -> tuple[Program, list[Step], Program]:
        """Split a program at its lookups: the steps that they need, the lookups, and the steps after them.

        The first program has outputs `index_0` ..., `weight_0` ..., and each `step_K` that the last program takes. The
        last takes the result of a lookup as `column_C`.

        Raises:
            ValueError: there are no lookups, or they read more than columns of one table at the same indices.
        """
        lookups = [self.steps[k] for k in self.live() if self.steps[k].kind == "lookup"]
        if len({(s.name, s.arguments) for s in lookups}) != 1:
            raise ValueError("lookups: expected columns of one table at the same indices")
        arguments, count = [Expr(self, a) for a in lookups[0].arguments], lookups[0].indices
        before = replace(self, outputs={f"index_{i}": index for i, index in enumerate(arguments[:count])})
        before.outputs |= {f"weight_{g}": w for g, w in enumerate(arguments[count:])}
        early = set(before.live())

        def after(k: int, step: Step, given: Sequence[Expr]) -> Expr | None:
            if step.kind == "lookup":
                return given[0].program.input(f"column_{step.column}")
            return given[0].program.input(f"step_{k}") if k in early and step.kind != "input" else None

        last = self._rewritten(after)
        names = [step.name for step in map(last.steps.__getitem__, last.live()) if step.name.startswith("step_")]
        before.outputs |= {name: Expr(self, int(name.removeprefix("step_"))) for name in names}
        return before, lookups, last

    def same_for_all(self) -> set[int]:
        """Return the live steps that are the same for all rays of a call."""
        same = set[int]()
        for k in self.live():
            step = self.steps[k]
            ready = all(a in same for a in step.arguments if isinstance(a, int))
            if step.per_call if step.kind == "input" else step.kind != "lookup" and ready:
                same.add(k)
        return same

    def of_the_call(self) -> tuple[Program, Program]:
        """Split off the steps that are the same for all rays of a call: their outputs `once_K` are inputs of the rest.

        Compilers do not vectorise loops whose choices follow a value that stays the same: such choices become `pick`.
        """
        same = self.same_for_all()

        def of_call(arguments: Iterable[Argument]) -> bool:
            return all(not isinstance(a, int) or a in same for a in arguments)

        once = replace(self, steps=list(self.steps), outputs={}, _known=dict(self._known))

        def varying(k: int, step: Step, given: Sequence[Expr]) -> Expr | None:
            if step.kind == "input":
                return None
            if k in same:
                return given[0].program.input(f"once_{k}", per_call=True)
            if step.kind != "select" or not of_call(step.arguments[:2]):
                return None
            low, high = (Expr(once, a) for a in step.arguments[:2])
            truth = given[0].program.input(f"once_{once.select(low, high, 1.0, 0.0).argument}", per_call=True)
            return truth.program.op("pick", truth, *given[2:])

        rest = self._rewritten(varying)
        names = [step.name for step in map(rest.steps.__getitem__, rest.live()) if step.name.startswith("once_")]
        once.outputs = {name: Expr(once, int(name.removeprefix("once_"))) for name in names}
        return once, rest

    def count(self) -> dict[str, int]:
        """Return the number of operations of each kind."""
        kinds = [self.steps[k].kind for k in self.live()]
        return {kind: kinds.count(kind) for kind in sorted(set(kinds) - {"input"})}

    def evaluate(self, inputs: Mapping[str, ArrayLike], table: int = 0) -> dict[str, NDArray[np.float32]]:
        """Compute the results in float32, step by step as written sources do (fma rounds once).

        Args:
            inputs: rows [N] by their names, tables [cells, columns] and, for a mixture, the numbers of the state.
        """
        found: dict[int, NDArray[np.float32]] = {}
        weights, inside = (None, True) if self.mixture is None else self.mixture.weights(inputs)

        def value(argument: Argument) -> NDArray[np.float32]:
            if not isinstance(argument, tuple):
                return found[argument]
            # equal in all tables, so that mixing must not round it
            if weights is None or all(v == argument[0] for v in argument):
                return np.asarray(np.float32(argument[table]))
            return np.asarray(np.float32(weights @ argument))

        with np.errstate(all="ignore"):
            for k in self.live():
                step = self.steps[k]
                if step.kind == "input":
                    found[k] = np.asarray(inputs[step.name], dtype=np.float32)
                    continue
                given = [value(a) for a in step.arguments]
                if step.kind == "lookup":
                    cells = self.own_tables.get(step.name, inputs.get(step.name))
                    groups = np.asarray(cells, np.float32)[:, step.column :: step.columns].T
                    found[k] = sum(
                        w * group.take(np.asarray(index).astype(np.intp), mode="clip")
                        for index, weights in step.at_indices(given)
                        for w, group in zip(weights, groups, strict=True)
                    )
                    continue
                if step.kind == "fma":  # the product is exact in float64
                    given = [g.astype(np.float64) for g in given]
                found[k] = np.asarray(_FOLDED[step.kind](*given), dtype=np.float32)
        results = {name: value(e.argument) for name, e in self.outputs.items()}
        if not inside:
            results[STATUS] = np.full_like(results[STATUS], OUTSIDE_DOMAIN)
        return results
