"""The optimisation: fewer and larger kernels on a GPU, with the same results up to rounding.

A GPU's kernel takes microseconds however little it computes, so each rule here makes fewer:

- small linear systems have one kernel each (`fused_solves.py`), and so have line searches
  (`fused_loops.py`);
- a scatter that puts numbers in constant places is a gather (`scatters.py`);
- short loops have some of their rounds written out, and read [n, 3] as [3, n].

On every platform, a `while` that counts to a small constant (MJX's Newton iterations) becomes a
scan that stands still once the loop would have ended. Before each round of a `while` a GPU waits
for the host, which reads the condition. Unlike a `while`, a scan has a reverse-mode derivative.
"""

import functools
from types import ModuleType

import jax.numpy as jnp
from jax import lax
from jax.extend import core

from purerl.exact import fused_loops, fused_solves, pallas_calls, walk
from purerl.exact.scatters import gathered_scatter, puts
from purerl.exact.traced_loops import MOST_ROUNDS, WRITTEN_OUT, is_tall, is_written_out, rounds
from purerl.exact.traces import with_own_derivative
from purerl.exact.walk import Rule


def rules(platform: str) -> list[Rule]:
    """Returns the rules for programs of one platform."""
    counted = Rule(_is_while, _scan_of_while)
    if platform not in pallas_calls.GPUS:
        return [counted]
    kernels = (fused_solves, fused_loops) if pallas_calls.can_run(platform) else ()
    gathers, scans = Rule(puts, _gather_of_put), Rule(_is_short_or_reads_tall, _faster_scan)
    return [*(_kernel(module, platform) for module in kernels), gathers, scans, counted]


def _kernel(module: ModuleType, platform: str) -> Rule:
    """Returns the rule that runs a module's kernel in the place of what the module wants.

    The kernels have no derivative; that of the replaced equation is taken.
    """

    def replace(eqn, inputs, known, inside):
        return with_own_derivative(eqn, functools.partial(module.compute, eqn, platform), inputs)

    return Rule(module.wanted, replace)


def _gather_of_put(eqn, inputs, known, inside) -> list | None:
    return None if known[1] is None else [gathered_scatter(eqn, inputs, known)]


def _is_short_or_reads_tall(eqn: core.JaxprEqn) -> bool:
    return is_written_out(eqn) or (eqn.primitive.name == "scan" and any(_tall_constants(eqn)))


def _tall_constants(eqn: core.JaxprEqn) -> list[bool]:
    """Tells of each input of a scan whether it is a constant to be transposed."""
    n, _ = walk.scan_sizes(eqn.params)
    return [i < n and is_tall(v.aval.shape) for i, v in enumerate(eqn.invars)]


def _faster_scan(eqn, inputs, known, inside) -> list:
    """Computes a scan with rounds written out if it is short, and tall constants transposed."""
    params, tall = eqn.params, _tall_constants(eqn)
    if is_written_out(eqn):
        params = params | {"unroll": min(WRITTEN_OUT, params["length"])}

    def turn(values):
        return [jnp.transpose(x) if t else x for x, t in zip(values, tall, strict=True)]

    def turned_inside(body, known_body, *args):
        return inside(body, known_body, *turn(args))

    return walk.scan(params, turn(inputs), known, turned_inside)


def _is_while(eqn: core.JaxprEqn) -> bool:
    return eqn.primitive.name == "while"


def _scan_of_while(eqn, inputs, known, inside) -> list | None:
    """Computes a `while` that makes few rounds at most by a scan."""
    limit = rounds(eqn.params, known)
    if limit is None or limit > MOST_ROUNDS:
        return None
    condition, body, carry = walk.while_parts(eqn.params, inputs, known, inside)

    def step_unless_done(c, _):
        going = condition(c)
        return [jnp.where(going, new, old) for new, old in zip(body(c), c, strict=True)], None

    avals = eqn.params["body_jaxpr"].out_avals
    carry = [jnp.asarray(x, aval.dtype) for x, aval in zip(carry, avals, strict=True)]
    return lax.scan(step_unless_done, carry, None, limit)[0]
