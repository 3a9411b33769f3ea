"""Scatters as gathers: the places are those of XLA, and terms are added in the order of updates."""

from typing import NamedTuple

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st
from jax import lax

from purerl.exact import scatters
from tests.exact import named, rewritten

few = hypothesis.settings(max_examples=40, deadline=None, derandomize=True)
MODES = [lax.GatherScatterMode.CLIP, lax.GatherScatterMode.FILL_OR_DROP]


class Case(NamedTuple):
    """A scatter of random shapes: operand, indices, updates and dimension numbers."""

    operand: np.ndarray
    indices: np.ndarray
    updates: np.ndarray
    numbers: lax.ScatterDimensionNumbers
    mode: lax.GatherScatterMode

    def by(self, scatter, operand, updates):
        return scatter(operand, self.indices, updates, self.numbers, mode=self.mode)


@st.composite
def cases(draw):
    """Each axis is a batch axis, or inserted (a window of 1 that is left out), or kept."""
    kinds = draw(st.permutations(draw(st.lists(st.sampled_from("bik"), min_size=1, max_size=3))))
    shape = [draw(st.integers(1, 4)) for _ in kinds]
    batching = [i for i, kind in enumerate(kinds) if kind == "b"]
    inserted = [i for i, kind in enumerate(kinds) if kind == "i"]
    kept = [i for i, kind in enumerate(kinds) if kind == "k"]
    more = [draw(st.integers(0, 3)) for _ in range(draw(st.integers(0, 2)))]
    batch = [shape[i] for i in batching] + more
    may_be_indexed = inserted + [i for i in kept if draw(st.booleans())]
    indexed = draw(st.permutations(may_be_indexed))
    windows = [draw(st.integers(1, shape[i])) for i in kept]
    rank = len(batch) + len(windows)
    window_axes = sorted(draw(st.permutations(range(rank)))[: len(windows)])
    updates = np.zeros(rank, int)
    updates[window_axes] = windows
    updates[[i for i in range(rank) if i not in window_axes]] = batch
    numbers = lax.ScatterDimensionNumbers(
        update_window_dims=tuple(window_axes),
        inserted_window_dims=tuple(inserted),
        scatter_dims_to_operand_dims=tuple(indexed),
        operand_batching_dims=tuple(batching),
        scatter_indices_batching_dims=tuple(range(len(batching))),
    )
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    return Case(
        operand=rng.integers(-9, 9, shape).astype(np.float32),
        indices=rng.integers(-1, 5, (*batch, len(indexed))).astype(
            np.int32
        ),  # some beyond the ends
        updates=rng.integers(-9, 9, updates).astype(np.float32),
        numbers=numbers,
        mode=draw(st.sampled_from(MODES)),
    )


@few
@hypothesis.given(cases())
def test_sums_are_those_of_xla(case):
    """Of whole numbers, whose sums are exact in any order."""

    def add(operand, updates):
        return case.by(lax.scatter_add, operand, updates)

    closed = rewritten(add, case.operand, case.updates)
    assert "scatter" not in str(closed)
    (found,) = jax.core.eval_jaxpr(closed.jaxpr, closed.consts, case.operand, case.updates)
    np.testing.assert_array_equal(found, add(case.operand, case.updates))


@few
@hypothesis.given(cases())
def test_of_puts_that_meet_the_last_is_kept(case):
    def put(operand, updates):
        return case.by(lax.scatter, operand, updates)

    closed = rewritten(put, case.operand, case.updates, platform="gpu")
    assert "scatter" not in str(closed)
    (found,) = jax.core.eval_jaxpr(closed.jaxpr, closed.consts, case.operand, case.updates)
    np.testing.assert_array_equal(found, put(case.operand, case.updates))  # on a CPU XLA's, too


@few
@hypothesis.given(st.integers(1, scatters._FEW_TERMS), st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_few_terms_are_added_one_after_another(turns, size, seed):
    """In the order of the updates, to what stands there, bit for bit."""
    rng = np.random.default_rng(seed)
    index = np.repeat(np.arange(size), turns)
    rng.shuffle(index)
    operand = rng.normal(size=size).astype(np.float32)
    updates = 10.0 ** rng.integers(-4, 5, index.size) * rng.normal(size=index.size)
    updates = updates.astype(np.float32)
    closed = rewritten(lambda x, u: x.at[index].add(u), operand, updates)
    (found,) = jax.core.eval_jaxpr(closed.jaxpr, closed.consts, operand, updates)
    slowly = operand.copy()
    for place, update in zip(index, updates, strict=True):
        slowly[place] = np.float32(slowly[place] + update)
    np.testing.assert_array_equal(found, slowly)


@pytest.mark.parametrize("number", [scatters._FEW_TERMS + 1, 50])
def test_many_terms_are_one_reduction_in_the_order_of_updates(number):
    """What meets at a place is one column, whose rows are in the order of the updates."""
    index = np.arange(2 * number) % 2
    updates = jnp.asarray(np.random.default_rng(0).normal(size=2 * number), jnp.float32)
    closed = rewritten(lambda u: jnp.zeros(2).at[index].add(u), updates)
    assert len(named(closed, "reduce_sum")) == 1
    (found,) = jax.core.eval_jaxpr(closed.jaxpr, closed.consts, updates)
    np.testing.assert_array_equal(found, updates.reshape(number, 2).sum(0))
