"""Loops that count to a constant become scans with the same results; others stay as they are."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from purerl import exact
from purerl.exact.traces import equations, has_loop
from tests import quick
from tests.exact import rewritten

LIMIT = 5


def newton(x, start=0, limit=LIMIT, step=1):
    """Square roots by Newton's method, until the last change is small or the count is reached."""

    def going(c):
        count, _, change = c
        return ~((count >= limit) | (change < 0.01))

    def body(c):
        count, y, _ = c
        new = 0.5 * (y + x / y)
        return count + step, new, jnp.abs(new - y)

    return jax.lax.while_loop(going, body, (start, x, 1e3))


def primitives(closed):
    """Returns the names of all primitives of a trace, at any depth."""
    return {eqn.primitive.name for eqn in equations(closed)}


def test_a_counted_loop_becomes_a_scan_that_stops_where_the_loop_did():
    x = jnp.array([1.0, 2.0, 50.0, 1e6])  # done at once, early, late, and cut off by the count
    closed = rewritten(newton, x[0])
    assert "while" not in primitives(closed) and "scan" in primitives(closed)
    got = jax.vmap(jax.extend.core.jaxpr_as_fun(closed))(x)
    want = jax.vmap(newton)(x)
    assert np.unique(want[0]).size > 2 and want[0].max() == LIMIT
    for a, b in zip(got, want, strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_vmapped_loop_is_rewritten_to_the_same_bits():
    """Each lane has a counter of its own, which stands still when the lane is over."""
    x = jnp.array([1.0, 2.0, 50.0, 1e6])
    alone, together = jax.vmap(exact.rewrite(newton))(x), exact.rewrite(jax.vmap(newton))(x)
    assert np.unique(together[0]).size > 2
    for a, b, c in zip(alone, together, jax.vmap(newton)(x), strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(b, c)


BALL = """<mujoco><option iterations="10"/><worldbody><geom type="plane" size="1 1 1"/>
<body pos="0 0 0.1"><freejoint/><geom size="0.1"/></body></worldbody></mujoco>"""


@pytest.mark.slow
def test_a_vmapped_step_of_mjx_is_rewritten():
    model = mjx.put_model(mujoco.MjModel.from_xml_string(BALL), impl="jax")
    data = mjx.make_data(model, impl="jax")
    batch = jax.vmap(lambda z: data.replace(qpos=data.qpos.at[2].add(z)))(jnp.array([0.0, -0.01]))
    step = functools.partial(mjx.step, model)
    alone, together = (
        quick.jit(f)(batch).qvel
        for f in (jax.vmap(exact.rewrite(step)), exact.rewrite(jax.vmap(step)))
    )
    assert abs(alone[0] - alone[1]).max() > 0.01
    np.testing.assert_allclose(alone, together, rtol=1e-5, atol=1e-6)


def test_only_the_optimisation_makes_scans_of_loops():
    assert "while" in primitives(rewritten(newton, 2.0, fuse=False))


def test_the_count_may_begin_anywhere_that_is_known():
    closed = rewritten(lambda x: newton(x, start=3), jnp.float32(1e6))
    assert "while" not in primitives(closed)
    assert int(jax.extend.core.jaxpr_as_fun(closed)(jnp.float32(1e6))[0]) == LIMIT


@pytest.mark.parametrize(
    "loop",
    [
        lambda x: newton(x, step=2),  # a count of rounds that is not its number
        lambda x: newton(x, start=x.astype(jnp.int32)),  # from an unknown number on
        lambda x: newton(x, limit=x.astype(jnp.int32)),
        lambda x: newton(x, limit=100),  # which it does not reach: a scan would
        lambda x: jax.lax.while_loop(lambda y: ~(y >= 5.0), lambda y: y * 2 + 1, x),
        # A limit between two numbers, and one that is none.
        lambda x: newton(x, start=0.0, limit=LIMIT - 0.5, step=1.0),
        lambda x: newton(x, start=0.0, limit=jnp.inf, step=1.0),
    ],
)
def test_other_loops_stay(loop):
    closed = rewritten(loop, jnp.float32(3.0))
    assert "while" in primitives(closed)
    got = jax.extend.core.jaxpr_as_fun(closed)(jnp.float32(3.0))
    for a, b in zip(got, jax.tree.leaves(loop(jnp.float32(3.0))), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("unroll, loops", [(1, True), (3, True), (4, False)])
def test_rounds_that_are_all_written_out_are_no_loop(unroll, loops):
    def inside(x):
        scan = jax.lax.scan(lambda c, _: (c * x, c), x, None, 4, unroll=unroll)
        return jax.jit(lambda y: y[0])(scan)

    assert has_loop(jax.make_jaxpr(inside)(1.0)) == loops
