"""From a trace to the values of a kernel: loops, branches and calls; `rules.py` has the rest."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend import core

from purerl.exact import constants, traces, walk
from purerl.exact.kernel import values
from purerl.exact.kernel.builder import Builder
from purerl.exact.kernel.rules import RULES
from purerl.exact.kernel.values import Block, Const, Held, Map, NoRuleError, Value
from purerl.exact.kernel.zeros import Zeros

MUCH = 256  # numbers: of so many in all, what only a next round reads is computed only for one
# Of a loop's carry, by its place, what follows: an operation like a map, of places and constants.
Following = dict[int, tuple[Map, list[Any]]]


class Program(NamedTuple):
    """A function of held values: what a kernel reads, and the values that it returns."""

    block: Block
    inputs: list[Held]
    outputs: list[Value]
    zeros: Zeros


class Missing(NamedTuple):
    """What no kernel can compute, and where it was written."""

    primitive: str
    why: str  # "" if there is no rule at all
    source: str  # file and line that traced it


def read(closed: core.ClosedJaxpr) -> Program:
    """Returns a trace as values; NoRuleError at the first equation that no kernel can compute."""

    def refuse(found: Missing) -> None:
        of = f" of {found.why}" if found.why else ""
        raise NoRuleError(f"No kernel computes {found.primitive}{of}, traced at {found.source}.")

    return _read(closed, refuse)


def missing(closed: core.ClosedJaxpr) -> list[Missing]:
    """Lists the equations of a trace that no kernel can compute, at any depth."""
    found: dict[Missing, None] = {}
    _read(closed, lambda one: found.update({one: None}))
    return list(found)


def _read(closed: core.ClosedJaxpr, refuse: Callable[[Missing], None]) -> Program:
    reader = _Reader(refuse)
    inputs = [reader.argument(v.aval) for v in closed.jaxpr.invars]
    return Program(reader.build.top, inputs, reader.run(closed, *inputs), reader.build.zeros)


class _Reader:
    """Reads one trace; `refuse` is told what has no rule, and raises or not."""

    def __init__(self, refuse: Callable[[Missing], None]):
        self.build, self.refuse = Builder(), refuse
        self.caller = ""  # the line that called the function of JAX which is read
        self.used: set[Any] = set()  # variables that an equation or a result reads

    def argument(self, aval: Any) -> Held:
        """Returns what an argument of the trace is in the kernel."""
        try:
            return self.build.held(aval.shape, aval.dtype)
        except NoRuleError as error:
            self.refuse(Missing("an argument", str(error), "its caller"))
            return self._unknown(aval)

    def _constant(self, array: Any, dtype: Any = None) -> Value:
        try:
            return self.build.const(array, dtype)
        except NoRuleError as error:
            self.refuse(Missing("a constant", str(error), self.caller or "the function itself"))
            return self.build.held(np.shape(array), np.int32)

    def run(self, closed: core.ClosedJaxpr, *args: Value) -> list[Value]:
        """Returns a trace's results."""
        self.used |= traces.read_in(closed)
        return traces.evaluate(closed, self._equation, self._constant, *args)

    def _equation(self, eqn: core.JaxprEqn, *args: Value) -> list[Value]:
        name = eqn.primitive.name
        if name in traces.CALLS:
            caller, self.caller = self.caller, self._source(eqn)
            results = self.run(traces.sub_jaxprs(eqn)[0], *args)
            self.caller = caller
            return results
        try:
            if name in _CONTROL:
                return _CONTROL[name](self, eqn, *args)
            if name in RULES:
                found = RULES[name](self.build, eqn, *args)
                return found if isinstance(found, list) else [found]
            if all(isinstance(x, Const) for x in args):
                with jax.ensure_compile_time_eval(), constants.on_cpu():
                    arrays = [jax.device_put(x.array) for x in args]
                    results = traces.bind_equation(eqn, *arrays)
                return [self.build.const(x) for x in results]
            why = ""
        except NoRuleError as error:
            why = str(error)
        self.refuse(Missing(name, why, self._source(eqn)))
        return [self._unknown(v.aval) for v in eqn.outvars]

    def _source(self, eqn: core.JaxprEqn) -> str:
        source = traces.source(eqn)
        return self.caller or source if "/jax/_src/" in source else source

    def _unknown(self, aval: Any) -> Held:
        """Returns what stands for a result that has no rule, while all of these are listed."""
        kinds = {"b": np.bool_, "f": np.float32}
        return self.build.held(aval.shape, kinds.get(getattr(aval.dtype, "kind", ""), np.int32))

    def _round(self, role: str, carry: Sequence[Held], run: Callable[..., list]) -> tuple:
        """Returns a block that runs something on the carry, and its results."""
        with self.build.inside(role) as block:
            return block, run(*(Held(x.shape, x.kind, block, x) for x in carry))

    def _carry(self, starts: Sequence[Value]) -> list[Held]:
        return [Held(x.shape, x.kind, self.build.blocks[-1]) for x in starts]


def _while(reader: _Reader, eqn: core.JaxprEqn, *args: Value) -> list[Value]:
    p = eqn.params
    if p["cond_jaxpr"].out_avals[0].shape:
        raise NoRuleError("a vmapped loop")
    n, m = p["cond_nconsts"], p["body_nconsts"]
    starts, goes_on = list(args[n + m :]), partial(reader.run, p["cond_jaxpr"], *args[:n])
    read = traces.read_in(p["cond_jaxpr"])
    tested = [x in read for x in p["cond_jaxpr"].jaxpr.invars[n:]]
    wanted = [x in reader.used or y for x, y in zip(eqn.outvars, tested, strict=True)]
    once = partial(_a_round, reader, p["body_jaxpr"], wanted, goes_on, args[n : n + m])

    step = _loop(reader, {}, starts, goes_on, once)
    if follow := _following(reader.build, starts, step.results):
        step = _loop(reader, follow, starts, goes_on, once)
    return _whole(reader.build, follow, reader.build.step(step))


def _loop(
    reader: _Reader, follow: Following, starts: Sequence[Value], goes_on: Any, once: Any
) -> values.Loop:
    """Reads a loop, which does not carry what follows from the rest of its carry."""
    own = [i for i in range(len(starts)) if i not in follow]
    reads, here = [starts[i] for i in own], reader.build.blocks[-1]
    carry, whole = reader._carry(reads), partial(_whole, reader.build, follow)
    test, (going,) = reader._round("while", carry, lambda *x: goes_on(*whole(x)))
    body, results = reader._round("while", carry, lambda *x: once(*whole(x)))
    return values.Loop(here, reads, carry, body, [results[i] for i in own], None, test, going)


def _following(build: Builder, starts: Sequence[Value], results: Sequence[Value]) -> Following:
    """Returns what of a loop's carry is always the same operation on the rest of it.

    MJX carries which constraints are active beside the distances of which that is the sign.
    """
    place, found, needed = {id(x): i for i, x in enumerate(results)}, Following(), set[int]()
    for i, x in enumerate(results):
        if not isinstance(x, Map) or x.param is not None or x.size < MUCH or i in needed:
            continue
        args = [y if isinstance(y, Const) else place.get(id(y), -1) for y in x.args]
        if any(y in found or y == -1 for y in args):
            continue
        begun = [starts[y] if isinstance(y, int) else y for y in args]
        if build.map(x.op, *begun, kind=x.kind) is starts[i]:
            found[i] = x, args
            needed |= {y for y in args if isinstance(y, int)}
    return found


def _whole(build: Builder, follow: Following, own: Sequence[Value]) -> list[Value]:
    """Returns a loop's whole carry: what it carries, and what follows from that."""
    rest, places = iter(own), range(len(own) + len(follow))
    known = {i: next(rest) for i in places if i not in follow}
    for i, (like, args) in follow.items():
        known[i] = build.map(like.op, *(known.get(y, y) for y in args), kind=like.kind)
    return [known[i] for i in places]


def _a_round(
    reader: _Reader, body: core.ClosedJaxpr, wanted: Any, goes_on: Any, consts: Any, *carry: Value
) -> list[Value]:
    """A round of a loop. What only a next round reads, it computes only if there is one.

    So the Hessian of Newton's last iteration, and its factor, are not computed.

    Args:
      reader: of the loop.
      body: its trace.
      wanted: of each carried value, whether the test reads it, or what comes after the loop.
      goes_on: the test, of what is carried.
      consts: what the body reads beside the carry.
      *carry: at the beginning of the round.
    """
    early, late = traces.split(body, wanted)
    build, off = reader.build, [x in late.jaxpr.outvars for x in body.jaxpr.outvars]
    if sum(math.prod(v.aval.shape) for x in late.jaxpr.eqns for v in x.outvars) < MUCH:
        return reader.run(body, *consts, *carry)
    found = iter(reader.run(early, *consts, *carry))
    after = [old if x else next(found) for x, old in zip(off, carry, strict=True)]
    (going,) = goes_on(*after)
    with build.inside("branch") as last:
        pass
    with build.inside("branch") as another:
        later = reader.run(late, *consts, *carry, *found)
    old = [x for x, put in zip(carry, off, strict=True) if put]
    writes = [Held(x.shape, x.kind, build.blocks[-1]) for x in old]
    which = build.map("convert_element_type", going, kind="i")
    step = values.Choice(build.blocks[-1], [which], writes, [last, another], [old, later])
    chosen = iter(build.step(step))
    return [next(chosen) if x else y for x, y in zip(off, after, strict=True)]


def _scan(reader: _Reader, eqn: core.JaxprEqn, *args: Value) -> list[Value]:
    p = eqn.params
    n, m = walk.scan_sizes(p)
    if len(args) > n + m or len(eqn.outvars) > m:
        return _written_out(reader, p, args, n, m)
    carry = reader._carry(args[n:])
    body, results = reader._round("scan", carry, partial(reader.run, p["jaxpr"], *args[:n]))
    step = values.Loop(reader.build.blocks[-1], list(args[n:]), carry, body, results, p["length"])
    return list(reader.build.step(step))


def _written_out(reader: _Reader, p: dict, args: Sequence[Value], n: int, m: int) -> list[Value]:
    """A scan that reads or writes a row in each round: all rounds, one after another."""
    build, rounds = reader.build, range(p["length"])
    carry, rows = list(args[n : n + m]), []
    for number in reversed(rounds) if p["reverse"] else rounds:
        xs = [build.take(x, x.places[number]) for x in args[n + m :]]
        results = reader.run(p["jaxpr"], *args[:n], *carry, *xs)
        carry = results[:m]
        rows.append(results[m:])
    ordered = zip(*(rows[::-1] if p["reverse"] else rows), strict=True)
    return [*carry, *(build.rows(np.stack, row, 0) for row in ordered)]


def _cond(reader: _Reader, eqn: core.JaxprEqn, which: Value, *args: Value) -> list[Value]:
    branches = eqn.params["branches"]
    if isinstance(which, Const):
        number = min(max(int(which.array), 0), len(branches) - 1)
        return reader.run(branches[number], *args)
    blocks, results = [], []
    for branch in branches:
        with reader.build.inside("branch") as block:
            results.append(reader.run(branch, *args))
        blocks.append(block)
    writes = [reader.build.held(v.aval.shape, v.aval.dtype) for v in eqn.outvars]
    chosen = reader.build.map("convert_element_type", which, kind="i")
    step = values.Choice(reader.build.blocks[-1], [chosen], writes, blocks, results)
    return list(reader.build.step(step))


_CONTROL: dict[str, Callable[..., list[Value]]] = {"cond": _cond, "scan": _scan, "while": _while}
