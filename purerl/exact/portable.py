"""Programs for a CPU that call no library of linear algebra, so that every processor adds alike.

XLA calls Eigen (and in it oneDNN) for a product whose operands are transposed, and LAPACK for a
factor. They take the widest instructions that there are, and cut long sums by the sizes of the
caches. With the flags of `xla_flags.PORTABLE`, XLA computes a product of rows with columns itself.
Here all products are laid out like that. XLA would undo it, but for a barrier.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax.numpy as jnp
from jax import Array, lax
from jax.extend import core

from purerl.exact import rewriting, traces, walk

OF_LIBRARIES = {"conv_general_dilated", "ragged_dot_general"}
OF_LIBRARIES |= {"lu", "geqrf", "geqp3", "householder_product", "ormqr", "eig", "eigh", "svd"}
OF_LIBRARIES |= {"schur", "sylvester", "hessenberg", "tridiagonal", "tridiagonal_solve"}


class LibraryError(RuntimeError):
    """An operation that only a library computes; the message says which, and where it is."""


def without_libraries(f: Callable) -> Callable:
    """Returns a function with the values of `f` up to rounding, that calls no such library.

    It raises LibraryError when it is traced, if `f` computes what this module does not know.
    """
    return rewriting.traced_anew(f, rewritten)


def rewritten(closed: core.ClosedJaxpr) -> core.ClosedJaxpr:
    """Returns a trace that calls no library of linear algebra."""
    for name, place in _beyond(closed):
        raise LibraryError(
            f"A library computes {name}, traced at {place}, and its bits follow the processor."
        )
    return walk.rewrite_trace(closed, [walk.Rule(_wants, _replace)])


def _beyond(
    closed: core.ClosedJaxpr, around: str = "", reached: bool = True
) -> Iterator[tuple[str, str]]:
    """Yields what stays with a library, in operations too that no rule goes into, and its place."""
    for eqn in closed.jaxpr.eqns:
        name, place = eqn.primitive.name, traces.source(eqn)
        place = around if around and "/jax/_src/" in place else place
        if name in OF_LIBRARIES or (name in REPLACED and not (reached and _wants(eqn))):
            yield name, place
        for sub in traces.sub_jaxprs(eqn):
            yield from _beyond(sub, place, reached and (name in traces.CALLS or name in walk.LOOPS))


def product(params: dict, left: Array, right: Array) -> Array:
    """Computes a `dot_general` as [..., m, k] by [..., k, n], of whatever axes it has."""
    (left_sums, right_sums), (left_batch, right_batch) = params["dimension_numbers"]
    rows = [i for i in range(left.ndim) if i not in {*left_sums, *left_batch}]
    columns = [i for i in range(right.ndim) if i not in {*right_sums, *right_batch}]
    batch = [left.shape[i] for i in left_batch]
    m, n = ([x.shape[i] for i in axes] for x, axes in ((left, rows), (right, columns)))
    k = math.prod(left.shape[i] for i in left_sums)
    left = lax.transpose(left, (*left_batch, *rows, *left_sums))
    right = lax.transpose(right, (*right_batch, *right_sums, *columns))
    left = lax.reshape(left, (*batch, math.prod(m), k))
    right = lax.reshape(right, (*batch, k, math.prod(n)))
    b = len(batch)
    axes = ((b + 1,), (b,)), (tuple(range(b)),) * 2
    left, right = lax.optimization_barrier((left, right))
    plain: Any = lax.dot_general_p.bind(left, right, **params | {"dimension_numbers": axes})
    plain = lax.optimization_barrier(plain)
    if jnp.issubdtype(plain.dtype, jnp.floating):
        # As it is: but where its transpose is wanted, XLA would compute that by Eigen.
        bits = jnp.finfo(plain.dtype)
        plain = lax.reduce_precision(plain, bits.nexp, bits.nmant)
    return lax.reshape(plain, (*batch, *m, *n))


def factor(params: dict, matrix: Array) -> Array:
    """Computes a `cholesky` [..., n, n] of the lower half: column k, then what is left without it.

    NaN from the first pivot on that is not positive.
    """
    number = jnp.arange(matrix.shape[-1])

    def step(k: Array, a: Array) -> Array:
        column = lax.dynamic_index_in_dim(a, k, a.ndim - 1, keepdims=False)
        pivot = lax.dynamic_index_in_dim(column, k, column.ndim - 1)
        column = column / jnp.where(pivot > 0.0, jnp.sqrt(pivot), jnp.nan)
        rest = a - jnp.where(number > k, column, 0.0)[..., None, :] * column[..., :, None]
        return jnp.where(number == k, column[..., None], jnp.where(number > k, rest, a))

    return jnp.tril(lax.fori_loop(0, len(number), step, matrix))


def solution(params: dict, matrix: Array, sides: Array) -> Array:
    """Computes a `triangular_solve`: [..., n, n] and [..., n, m], or [..., m, n] from the right."""
    lower = params["lower"]
    if not params["left_side"]:
        sides = jnp.swapaxes(sides, -1, -2)
    if params["transpose_a"] == params["left_side"]:
        matrix, lower = jnp.swapaxes(matrix, -1, -2), not lower
    size = matrix.shape[-1]
    number = jnp.arange(size)[:, None]

    def step(i: Array, x: Array) -> Array:
        k = i if lower else size - 1 - i
        column = lax.dynamic_index_in_dim(matrix, k, matrix.ndim - 1)
        found = lax.dynamic_index_in_dim(x, k, x.ndim - 2)
        if not params["unit_diagonal"]:
            found = found / lax.dynamic_index_in_dim(column, k, column.ndim - 2)
        left = number > k if lower else number < k
        return jnp.where(number == k, found, jnp.where(left, x - column * found, x))

    found = lax.fori_loop(0, size, step, sides)
    return found if params["left_side"] else jnp.swapaxes(found, -1, -2)


def reflections(params: dict, matrix: Array) -> tuple[Array, Array]:
    """Computes a `qr` [..., m, n] by Householder's reflections, with the signs of LAPACK."""
    m, n = matrix.shape[-2:]
    row, eye = jnp.arange(m)[:, None], jnp.eye(m, dtype=matrix.dtype)

    def step(k: Array, both: tuple[Array, Array]) -> tuple[Array, Array]:
        q, r = both
        column = lax.dynamic_index_in_dim(r, k, r.ndim - 1)
        pivot = lax.dynamic_index_in_dim(column, k, r.ndim - 2)
        below = jnp.sum(jnp.where(row > k, column * column, 0.0), -2, keepdims=True)
        head = pivot + jnp.where(pivot < 0.0, -1.0, 1.0) * jnp.sqrt(pivot * pivot + below)
        normal = jnp.where(row > k, column, jnp.where(row == k, head, 0.0))
        # A column with nothing below is left as it is.
        scaled = normal * jnp.where(below > 0.0, 2.0 / (head * head + below), 0.0)
        r = r - scaled * jnp.sum(normal * r, -2, keepdims=True)
        across = jnp.swapaxes(normal, -1, -2)
        return q - jnp.sum(q * across, -1, keepdims=True) * jnp.swapaxes(scaled, -1, -2), r

    start = jnp.broadcast_to(eye, (*matrix.shape[:-1], m)), matrix
    q, r = lax.fori_loop(0, min(m, n), step, start)
    kept = m if params["full_matrices"] else min(m, n)
    return q[..., :kept], jnp.triu(r[..., :kept, :])


REPLACED: dict[str, Callable] = {"dot_general": product, "cholesky": factor}
REPLACED |= {"triangular_solve": solution, "qr": reflections}


def _wants(eqn: core.JaxprEqn) -> bool:
    real = not any(jnp.iscomplexobj(v.aval) for v in eqn.invars)
    return eqn.primitive.name in REPLACED and real and not eqn.params.get("pivoting")


def _replace(eqn: core.JaxprEqn, inputs: Sequence, inside: walk.Inside) -> list[Array]:
    found = REPLACED[eqn.primitive.name](eqn.params, *map(jnp.asarray, inputs))
    return list(found) if eqn.primitive.multiple_results else [found]
