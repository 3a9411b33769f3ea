"""The optimisation: fewer and larger kernels on a GPU, with the same results up to rounding.

A GPU's kernel takes microseconds however little it computes, so each rule here makes fewer:

- a scatter that puts numbers in constant places is a gather (`scatters.py`);
- short loops have some of their rounds written out, and read [n, 3] as [3, n].

On every platform, a `while` that counts to a small constant (MJX's Newton iterations) becomes a
scan that stands still once the loop would have ended. Before each round of a `while` a GPU waits
for the host, which reads the condition. Unlike a `while`, a scan has a reverse-mode derivative.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import jax.numpy as jnp
from jax import lax
from jax.extend import core

from purerl.exact import constants, walk
from purerl.exact.scatters import gathered_scatter, puts
from purerl.exact.traces import equations, has_loop
from purerl.exact.walk import Inside, Rule

# A scan makes all its rounds. A loop that may make more than these most likely ends far earlier:
# MuJoCo's default is 100 iterations, and a cart-pole needs two.
MOST_ROUNDS = 16
# Rounds written out one after another on a GPU, where every round copies the carry. With the four
# rounds of its line search written out, an ant's physics was faster by 9% (H100).
WRITTEN_OUT = 4
# Equations of a round to be written out. A line search has 300; a whole physics step, 6,000 for six
# hinges, took three times as long to compile.
FEW_EQUATIONS = 1000
# XLA keeps the layout of an array that a loop reads. If a line search reads [108, 3], one thread
# adds the 108 of a column; of [3, 108] a warp does, for all columns in one kernel.
MANY_ROWS = 32
FEW_COLUMNS = 4


def rules(platform: str) -> list[Rule]:
    """Returns the rules for programs of one platform."""
    counted = Rule(lambda eqn: eqn.primitive.name == "while", _scan_of_while)
    if platform != "gpu":
        return [counted]
    return [Rule(puts, gathered_scatter), Rule(_is_short_or_reads_tall, _faster_scan), counted]


# --- scans ---


def _is_short_or_reads_tall(eqn: core.JaxprEqn) -> bool:
    return eqn.primitive.name == "scan" and (_is_written_out(eqn) or any(_tall_constants(eqn)))


def _is_written_out(eqn: core.JaxprEqn) -> bool:
    """Tells whether some rounds of a scan shall be written out: short ones, without a loop."""
    body, unroll = eqn.params["jaxpr"], eqn.params["unroll"]
    few = unroll == 1 and sum(1 for _ in equations(body)) < FEW_EQUATIONS
    return few and not has_loop(body)


def _tall_constants(eqn: core.JaxprEqn) -> list[bool]:
    """Tells of each constant of a scan whether it has many rows of few numbers, [n, k]."""
    shapes = [v.aval.shape for v in eqn.invars[: walk.scan_sizes(eqn.params)[0]]]
    return [len(s) == 2 and s[0] >= MANY_ROWS and s[1] <= FEW_COLUMNS for s in shapes]


def _faster_scan(eqn: core.JaxprEqn, inputs: Sequence, inside: Inside) -> list:
    """Computes a scan with rounds written out if it is short, and tall constants transposed."""
    params, tall = eqn.params, _tall_constants(eqn)
    if _is_written_out(eqn):
        params = params | {"unroll": min(WRITTEN_OUT, params["length"])}

    def turn(values: Sequence) -> list:
        consts = (x.T if is_tall else x for x, is_tall in zip(values, tall, strict=False))
        return [*consts, *values[len(tall) :]]

    return walk.scan(params, turn(inputs), lambda body, *args: inside(body, *turn(args)))


# --- loops that count to a constant ---


def _scan_of_while(eqn: core.JaxprEqn, inputs: Sequence, inside: Inside) -> list | None:
    """Computes a `while` that makes few rounds at most by a scan."""
    limit = _rounds(eqn.params, inputs)
    if limit is None or limit > MOST_ROUNDS:
        return None
    condition, body, carry = walk.while_parts(eqn.params, inputs, inside)

    def step_unless_done(c, _):
        going = condition(c)
        return [jnp.where(going, new, old) for new, old in zip(body(c), c, strict=True)], None

    avals = eqn.params["body_jaxpr"].out_avals
    carry = [jnp.asarray(x, aval.dtype) for x, aval in zip(carry, avals, strict=True)]
    return lax.scan(step_unless_done, carry, None, limit)[0]


def _rounds(params: dict, inputs: Sequence) -> int | None:
    """Returns the greatest number of rounds of a `while` that counts to a constant, else None.

    Its condition fails when a counter reaches a literal, or earlier for other reasons; each round
    adds 1 to the counter, which starts from a known number.
    """
    if params["cond_jaxpr"].out_avals[0].shape:
        return None  # of a vmapped loop each lane has a counter: `walk` runs it until all are over
    n, m = params["cond_nconsts"], params["body_nconsts"]
    test, body = params["cond_jaxpr"].jaxpr, params["body_jaxpr"].jaxpr
    starts, counters = inputs[n + m :], body.invars[m:]
    made_by = {v: e for e in body.eqns for v in e.outvars}
    for atom, limit in _limits(test):
        place = test.invars.index(atom) - n if atom in test.invars else -1
        if place < 0 or not constants.is_known(starts[place]):
            continue
        step = made_by.get(body.outvars[place])
        if step and step.primitive.name == "add" and step.invars[0] is counters[place]:
            one = step.invars[1]
            if isinstance(one, core.Literal) and int(one.val) == 1:
                return max(0, limit - int(starts[place]))
    return None


def _limits(test: core.Jaxpr) -> Iterator[tuple[Any, int]]:
    """Yields each (variable, literal) for which variable >= literal alone makes `test` false."""
    made_by = {v: e for e in test.eqns for v in e.outvars}
    first = made_by.get(test.outvars[0])
    ends = [first.invars[0]] if first and first.primitive.name == "not" else []
    while ends:
        end = ends.pop()
        eqn = None if isinstance(end, core.Literal) else made_by.get(end)
        if eqn and eqn.primitive.name in ("or", "convert_element_type"):
            ends += eqn.invars
        elif eqn and eqn.primitive.name == "ge" and isinstance(eqn.invars[1], core.Literal):
            limit = eqn.invars[1].val
            if jnp.issubdtype(jnp.result_type(limit), jnp.integer):  # 2.5 is no number of rounds
                yield eqn.invars[0], int(limit)
