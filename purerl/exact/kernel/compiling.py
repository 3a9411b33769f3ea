"""`compile_kernel`: a function as one kernel, and the check that it computes the same."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from purerl.exact import traces
from purerl.exact.kernel import compilers, launch, reading, text
from purerl.exact.kernel.reading import Missing
from purerl.exact.kernel.values import NoRuleError as NoRuleError


@dataclass(frozen=True, eq=False)
class Kernel:
    """A function that is one kernel. It can be called as the function, also under `vmap`."""

    text: text.Text
    shapes: Any  # of the results, a pytree
    inputs: tuple[Any, list]  # the arguments' pytree, and of each leaf as float32[3]

    @property
    def source(self) -> str:
        """The kernel as C++ that is also CUDA."""
        return compilers.source(self.text)

    def __call__(self, *args: Any) -> Any:
        """Calls it on arguments of the shapes for which it was compiled.

        A loop of `vmap` makes of it one launch, with a warp for each environment.
        """
        leaves, tree = jax.tree.flatten(args)
        if (given := (tree, [_words(x) for x in leaves])) != self.inputs:
            raise ValueError(f"The arguments are {given}; the kernel is for {self.inputs}.")
        kinds = [launch.DTYPES[kind] for _, kind in self.text.inputs]
        some = [jnp.asarray(x) for x in leaves if np.size(x)]
        rows = [x.astype(kind).reshape(-1) for x, kind in zip(some, kinds, strict=True)]
        found = iter(launch.run(self.text, *rows))

        def result(like: Any) -> jax.Array:
            row = next(found) if np.prod(like.shape) else jnp.zeros(0)
            return row.reshape(like.shape).astype(like.dtype)

        return jax.tree.map(result, self.shapes)


class Agreement(NamedTuple):
    """How a kernel's results differ from the function's, of the same arguments."""

    error: float  # root of the sum of squares of differences, relative to that of the results
    worst: float  # the greatest of any one environment
    off: int  # numbers that differ by more than 1e-3 of 1 + their size
    size: int  # numbers compared

    @property
    def agrees(self) -> bool:
        """Tells whether the kernel may be used: see `TOLERANCE`."""
        return self.error <= TOLERANCE and self.off <= MOST_OFF * self.size


# An ant's control step differs by 1e-5: five steps, each with its own rounding (in float32 1e-7),
# through contacts, which amplify. A wrong kernel differs by 0.1 and more, in most numbers.
TOLERANCE = 1e-3
# A contact that touches in one of two roundings alone, or a line search that takes another turn.
MOST_OFF = 0.01


class Traced(NamedTuple):
    """A function as `jax.make_jaxpr` has it: called, it is the function, and not traced again."""

    closed: core.ClosedJaxpr
    inputs: tuple[Any, list]  # the arguments' pytree, and of each leaf as float32[3]
    shapes: Any  # of the results, a pytree

    def __call__(self, *args: Any) -> Any:
        """Computes the function of arguments of those shapes, by XLA."""
        found = core.jaxpr_as_fun(self.closed)(*jax.tree.leaves(args))
        return jax.tree.unflatten(jax.tree.structure(self.shapes), found)


def compile_kernel(f: Callable, *example: Any) -> Kernel:
    """Returns a function as one kernel: on a GPU a warp for each environment, on a CPU C++.

    It is traced and written here, and compiled when it is first called. Loops that depend on data
    (MJX's Newton iterations) end for each environment by itself, where XLA's `vmap` waits for all.
    It has no derivative: take that of `f`.

    Args:
      f: a pure function of pytrees of float32, int32 and bool arrays, of one environment.
      *example: its arguments, or `jax.ShapeDtypeStruct`s of the same shapes.

    Raises:
      NoRuleError: the first equation that no kernel computes; `kernel_missing` lists them all.
    """
    return kernel_of(traced(f, *example))


def kernel_of(traced: Traced, meanwhile: Callable[[], Any] = lambda: None) -> Kernel:
    """Returns a traced function as one kernel.

    `meanwhile` is called before a text is written, which takes seconds, and not if one is kept.
    """
    return Kernel(_written(traced.closed, meanwhile), traced.shapes, traced.inputs)


def kernel_missing(f: Callable, *example: Any) -> list[Missing]:
    """Lists what of a function no kernel computes, and where it was written; nothing: all is."""
    return reading.missing(traced(f, *example).closed)


def _written(closed: core.ClosedJaxpr, meanwhile: Callable[[], Any]) -> text.Text:
    """Returns the text of a trace, which is kept: to write it takes longer than to trace it."""
    numbers = hashlib.sha256(compilers.how_texts_are_written())
    for x in map(np.asarray, traces.constants(closed)):  # a trace's words have not all of them
        numbers.update(f"{x.dtype}{x.shape}".encode() + x.tobytes())

    def make(_: str) -> bytes:
        meanwhile()
        return json.dumps(text.written(reading.read(closed))).encode()

    path = compilers.kept(str(closed), (numbers.hexdigest(),), "text.json", make)
    *found, inputs, outputs = json.loads(path.read_text())
    return text.Text(*found, *(tuple(map(tuple, x)) for x in (inputs, outputs)))


def traced(f: Callable, *example: Any) -> Traced:
    """Traces a function of pytrees."""
    leaves, tree = jax.tree.flatten(example)
    flat = lambda *leaves: f(*jax.tree.unflatten(tree, leaves))  # noqa: E731
    closed, shapes = jax.make_jaxpr(flat, return_shape=True)(*leaves)
    return Traced(closed, (tree, [_words(x) for x in leaves]), shapes)


def _words(x: Any) -> str:
    """Returns what JAX makes of an argument, as float32[3]."""
    found = jax.eval_shape(lambda x: x, x)
    return f"{found.dtype}{list(found.shape)}"


def kernel_agreement(kernel: Kernel, f: Callable, *args: Any) -> Agreement:
    """Compares a kernel with the function that it was made of.

    Args:
      kernel: made of `f`.
      f: as XLA shall compile it.
      *args: real arguments of several environments, with a leading axis.
    """
    return agreement(*(as_rows(jax.jit(jax.vmap(run))(*args)) for run in (kernel, f)))


def as_rows(results: Any) -> np.ndarray:
    """Returns results of several environments as [environments, numbers]."""
    return np.concatenate([np.reshape(x, (len(x), -1)) for x in jax.tree.leaves(results)], 1)


def agreement(found: np.ndarray, wanted: np.ndarray) -> Agreement:
    """Compares results [environments, numbers]; those that are NaN in both are equal."""
    both = np.isnan(found) & np.isnan(wanted)
    found, wanted = (np.where(both, 0.0, x).astype(np.float64) for x in (found, wanted))
    squares, sizes = ((found - wanted) ** 2).sum(1), (wanted**2).sum(1)
    tiny = np.finfo(np.float64).tiny
    off = int((~(np.abs(found - wanted) <= 1e-3 * (1 + np.abs(wanted)))).sum())
    error = float(np.sqrt(squares.sum() / max(sizes.sum(), tiny)))
    worst = float(np.sqrt((squares / np.maximum(sizes, tiny)).max(initial=0.0)))
    return Agreement(error, worst, off, found.size)
