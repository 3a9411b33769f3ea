"""Checks that `reset` and `step` become the same program whenever they are traced.

Python runs once, while JAX traces. A number that it draws or counts then stands in the program as a
constant: two calls of the program agree, and two runs do not.
"""

import hashlib
from collections.abc import Callable, Iterator
from itertools import zip_longest
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend import core

from purerl.checks.user_code import own_line
from purerl.core.env import Env, EnvError
from purerl.core.records import is_key
from purerl.exact.traces import sub_jaxprs

# With another value JAX reads none of the traces it keeps: of functions under jit, bodies of loops.
_ANEW: Callable = jax.make_user_context(default_value=None)
# Warp counts its calls in an attribute of theirs, and computes the same by each.
_COUNTED = "ffi_call"
_CURES = {
    "reset": "draw by jax.random from its key",
    "step": "draw by jax.random from a key in State.task, which reset puts there and step splits",
}


class Constant(NamedTuple):
    """The content of a number or an array."""

    text: str  # for a person
    digest: str


Line = tuple[str, tuple, tuple, tuple]  # primitive, inputs, kinds of outputs, parameters


def check_traces(env: Env) -> None:
    """Traces `reset` and `step` twice, and compares; nothing is compiled.

    Args:
      env: an environment that `check_shapes` has passed.

    Raises:
      EnvError: names which of the two differs, the line where it can be told, and the cure.
    """
    key = jax.eval_shape(lambda: jax.random.key(0))
    action = jax.ShapeDtypeStruct((env.action_size,), np.float32)
    state = jax.eval_shape(env.reset, key)
    _check("reset", env.reset, key)
    _check("step", env.step, state, action)


def _check(name: str, function: Callable, *arguments: Any) -> None:
    # The first may be of traces that JAX keeps: it takes less than a tenth of the time.
    found = difference(jax.make_jaxpr(function)(*arguments), trace_anew(function, *arguments))
    if found is not None:
        raise EnvError(
            f"{name} is another program when it is traced again: {found}. It must be a function of "
            "its arguments alone: np.random, random, time and counters run once, while it is "
            f"compiled, and give another number to every run; {_CURES[name]}."
        )


def trace_anew(function: Callable, *arguments: Any) -> core.ClosedJaxpr:
    """Traces a function, and all that it calls, anew; `arguments` need only shapes and dtypes."""
    with _ANEW(object()):
        return jax.make_jaxpr(function)(*arguments)


def difference(first: core.ClosedJaxpr, second: core.ClosedJaxpr) -> str | None:
    """Tells where two traces differ first: numbers, operations or what they are done on."""
    nothing = (None, None)
    for (a, eqn), (b, other) in zip_longest(_lines(first), _lines(second), fillvalue=nothing):
        if a != b:
            return f"{_what(a, b)}{_where(eqn or other)}"
    return None


def _what(a: Line | None, b: Line | None) -> str:
    """Names the number or array that differs, if nothing else of a line does."""
    if a and b and (a[0], len(a[1]), a[2:]) == (b[0], len(b[1]), b[2:]):
        before, after = next((x, y) for x, y in zip(a[1], b[1], strict=True) if x != y)
        if isinstance(before, Constant) and isinstance(after, Constant):
            other = after.text if after.text != before.text else "other numbers"
            return f"it has {other} where it had {before.text}"
    return "it has other operations"


def _where(eqn: core.JaxprEqn | None) -> str:
    """Returns " (FILE, line N)" of the user's code that traced an equation, or ""."""
    traceback = eqn.source_info.traceback if eqn else None
    if traceback is None:
        return ""
    return own_line(Exception().with_traceback(traceback.as_python_traceback()))


def _lines(closed: core.ClosedJaxpr) -> Iterator[tuple[Line, core.JaxprEqn | None]]:
    """Yields what is computed, equation by equation, each before those inside of it.

    A variable is known by its number, a constant by its content. What Python objects a parameter
    holds is left out, as functions are, which are others in each trace.
    """
    named: dict[Any, Any] = {}
    for v, x in zip(closed.jaxpr.constvars, closed.consts, strict=True):
        named[v] = _content(x)
    for v in closed.jaxpr.invars:
        named[v] = len(named)

    def read(atoms: Any) -> tuple:
        return tuple(_content(x.val) if isinstance(x, core.Literal) else named[x] for x in atoms)

    for eqn in closed.jaxpr.eqns:
        name, inputs, kinds = eqn.primitive.name, read(eqn.invars), (v.aval for v in eqn.outvars)
        given = () if name == _COUNTED else _plain(tuple(sorted(eqn.params.items())))
        yield (name, inputs, tuple(kinds), given), eqn
        for v in eqn.outvars:
            named[v] = len(named)
        for sub in sub_jaxprs(eqn):
            yield from _lines(sub)
    yield ("return", read(closed.jaxpr.outvars), (), ()), None


def _content(x: Any) -> Constant:
    is_typed_key = isinstance(x, jax.Array) and is_key(x)
    value = np.asarray(jax.random.key_data(x) if is_typed_key else x)
    text = str(value.item()) if value.size == 1 else f"an array {list(value.shape)}"
    return Constant(text, hashlib.sha256(value.tobytes()).hexdigest())


def _plain(x: Any) -> Any:
    """Returns the numbers, words and arrays of a parameter."""
    if isinstance(x, tuple | list):
        return tuple(map(_plain, x))
    if isinstance(x, np.ndarray | np.generic | jax.Array):
        return _content(x)
    return repr(x) if isinstance(x, int | float | str | bytes) else None
