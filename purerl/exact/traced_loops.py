"""Facts about a loop that its trace tells before it runs."""

import jax.numpy as jnp
from jax.extend import core

from purerl.exact.constants import Known
from purerl.exact.traces import equations

# A scan makes all its rounds. A loop that may make more than these most likely ends far earlier:
# MuJoCo's default is 100 iterations, and a cart-pole needs two.
MOST_ROUNDS = 16
# Rounds written out one after another on a GPU, where every round copies the carry. With the four
# rounds of its line search written out, an ant's physics was faster by 9% (H100). It matters for
# loops that `fused_loops` does not take.
WRITTEN_OUT = 4
# Equations of a round to be written out. A line search has 300; a whole physics step, 6,000 for six
# hinges, took three times as long to compile.
FEW_EQUATIONS = 1000
# XLA keeps the layout of an array that a loop reads. If a line search reads [108, 3], one thread
# adds the 108 of a column; of [3, 108] a warp does, for all columns in one kernel.
MANY_ROWS = 32
FEW_COLUMNS = 4


def has_loop(closed: core.ClosedJaxpr) -> bool:
    """Tells whether a trace has a loop at any depth."""
    return any(map(_is_loop, equations(closed)))


def _is_loop(eqn: core.JaxprEqn) -> bool:
    """Tells whether an equation is a loop; a scan whose rounds are all written out is none."""
    name, params = eqn.primitive.name, eqn.params
    return name == "while" or (name == "scan" and params["unroll"] < params["length"])


def is_written_out(eqn: core.JaxprEqn) -> bool:
    """Tells whether some rounds of a loop shall be written out: a short scan, no loop inside."""
    if eqn.primitive.name != "scan" or eqn.params["unroll"] > 1:
        return False
    body = eqn.params["jaxpr"]
    return not has_loop(body) and sum(1 for _ in equations(body)) < FEW_EQUATIONS


def is_tall(shape: tuple[int, ...]) -> bool:
    """Tells whether an array has many rows of few numbers, [n, k]."""
    return len(shape) == 2 and shape[1] <= FEW_COLUMNS and shape[0] >= MANY_ROWS


def rounds(params: dict, known: list[Known]) -> int | None:
    """Returns the greatest number of rounds of a `while` that counts to a constant, else None.

    Its condition fails when a counter reaches a literal, or earlier for other reasons; each round
    adds 1 to the counter, which starts from a known number.
    """
    n, m = params["cond_nconsts"], params["body_nconsts"]
    test, body = params["cond_jaxpr"].jaxpr, params["body_jaxpr"].jaxpr
    for counter, limit in _limits(test):
        place = test.invars.index(counter) - n if counter in test.invars else -1
        if place < 0 or known[n + m + place] is None:
            continue
        steps = [e for e in body.eqns if body.outvars[place] in e.outvars]
        if steps and steps[0].primitive.name == "add" and _is_plus_one(steps[0], body, m + place):
            return max(0, limit - int(known[n + m + place]()))
    return None


def _limits(test: core.Jaxpr) -> list[tuple[core.Var | core.Literal, int]]:
    """Returns each (variable, literal) for which variable >= literal alone makes `test` false."""
    made_by = {v: e for e in test.eqns for v in e.outvars}
    first = made_by.get(test.outvars[0])
    if first is None or first.primitive.name != "not":
        return []
    ends, found = [first.invars[0]], []
    while ends:
        eqn = None if isinstance(ends[-1], core.Literal) else made_by.get(ends[-1])
        ends.pop()
        if eqn is None:
            continue
        if eqn.primitive.name in ("or", "convert_element_type"):
            ends += eqn.invars
        elif eqn.primitive.name == "ge" and isinstance(eqn.invars[1], core.Literal):
            limit = eqn.invars[1].val
            if jnp.issubdtype(jnp.result_type(limit), jnp.integer):  # 2.5 is no number of rounds
                found.append((eqn.invars[0], int(limit)))
    return found


def _is_plus_one(eqn: core.JaxprEqn, body: core.Jaxpr, place: int) -> bool:
    number, one = eqn.invars
    return number is body.invars[place] and isinstance(one, core.Literal) and int(one.val) == 1
