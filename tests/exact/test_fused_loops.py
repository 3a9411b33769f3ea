"""Loops as one kernel, interpreted on a CPU: the same as XLA's loop."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jax.extend.core import jaxpr_as_fun

from purerl import exact
from purerl.exact import fused_loops
from purerl.exact.traces import CALLS, equations
from purerl.physics.interface import Physics
from tests import quick
from tests.exact import GPU, for_gpu, named, rewritten

N = 40


def loop(body, carry, rounds=5):
    return jax.lax.scan(lambda c, _: (body(c), None), carry, None, rounds)[0]


def search(x):
    """Sums of some rows of three numbers, a choice between three, a branch, truth carried."""
    quad = jnp.stack([x * x, x, jnp.cos(x)]).T

    def body(c):
        place, best, going = c
        sums = (quad * (x > place)[:, None]).sum(0) + jnp.array([1.0, 2.0, 3.0])
        cost = jnp.stack([sums[1], sums[0] * place, 0.0 - sums[2]])
        index = jnp.argmin(jnp.where(jnp.abs(cost) < 50.0, cost, jnp.inf))
        new = jax.lax.cond(going, lambda: place + 0.1 * cost[index], lambda: place - 0.3)
        return new, best + (cost < sums).astype(jnp.int32), (cost > 0.0).any() & (new < 1.0)

    return loop(body, (jnp.float32(0.1), jnp.zeros(3, jnp.int32), jnp.array(True)))


def carried(x):
    """A vector and rows of it are carried."""

    def body(c):
        rows, vector = c
        return rows * 0.5 + vector[None], vector - rows.sum() / N

    return loop(body, (jnp.stack([x, 2.0 * x]), x))


def replaced(x):
    """Rounds set what they carry to numbers: a vector, a number, truth."""

    def body(c):
        vector, number, truth, total = c
        total = total + number * vector.sum() / N + truth.astype(jnp.float32)
        return jnp.full(N, total), jnp.float32(2.0), jnp.array(True), total

    return loop(body, (x, x[0], x[1] > 0.0, jnp.float32(0.1)))


def not_numbers(x):
    """The first of several NaNs is the least, an index beyond the end the end's."""

    def body(c):
        some = jnp.stack([c, c * jnp.inf - c * jnp.inf, jnp.sqrt(-1.0 - c)])
        return c + jnp.argmin(some) + x.sum() * 0.0

    return loop(body, jnp.float32(0.5), 3)


def arithmetic(x):
    """All that a round may compute beside what `search` does."""

    def body(c):
        least, most = jnp.where(c < x, c, x), jnp.where(c > x, 0.0 - c, x)
        root = jnp.sqrt(jnp.square(least)) / (1.0 + jnp.abs(most))
        kept = (least <= most) & ~(root >= 1.0) | (x == c) & (x != most)
        spread = jnp.broadcast_to(c * 0.1, (N,)).sum()  # of a number that stands for all
        return jnp.where(kept, root, most).sum() / N - c * 0.5 + spread + kept.sum() / N

    return loop(body, jnp.float32(0.3))


FUNCTIONS = (search, carried, replaced, not_numbers, arithmetic)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_a_loop_is_one_kernel(function):
    x = jax.random.normal(jax.random.key(0), (3, N))
    closed = rewritten(function, x[0], platform=GPU)
    assert len(named(closed, "pallas_call")) == 1 and not named(closed, "scan")
    got, want = jax.vmap(jaxpr_as_fun(closed))(x), jax.tree.leaves(jax.vmap(function)(x))
    for ours, theirs in zip(got, want, strict=True):
        assert ours.dtype == theirs.dtype
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5)


@pytest.mark.skipif(jax.__version_info__ >= (0, 11), reason="it asks a GPU what it is")
@pytest.mark.parametrize("function", FUNCTIONS)
def test_triton_takes_it(function):
    """Interpreted, a kernel may do what it may not on a GPU."""
    traced = jax.jit(jax.vmap(exact.rewrite(function, platform="gpu"))).trace(jnp.zeros((3, N)))
    assert "triton" in traced.lower(lowering_platforms=("cuda",)).as_text()


def test_every_rule_is_in_a_loop_of_these():
    closed = [jax.make_jaxpr(function)(jnp.zeros(N)) for function in FUNCTIONS]
    seen = {eqn.primitive.name for trace in closed for eqn in equations(trace)}
    assert set(fused_loops._RULES) - set(CALLS) <= seen


LOOPS = {
    "two long axes": lambda x: loop(lambda c: c + (x[:, None] * x).sum(), 0.0),
    "long axes of two sizes": lambda x: loop(lambda c: c + x.sum() + x[: N // 2].sum(), 0.0),
    "none": lambda x: loop(lambda c: c + x[0], 0.0),
    "too long": lambda x: loop(lambda c: c + jnp.tile(x, 20).sum(), 0.0),
    "no rule": lambda x: loop(lambda c: c + jnp.sort(x).sum(), 0.0),
    "a long constant of a function inside": lambda x: loop(
        lambda c: c + jax.jit(lambda y: (y * np.arange(float(N))).sum())(x) / N**2, 0.0
    ),
    "many numbers in a row": lambda x: loop(
        lambda c: c * 0.5 + (jnp.stack([c] * 5) * x[:5]).sum(), 0.0
    ),
    "an axis without entries": lambda x: loop(lambda c: c + (x[:0] * c).sum() + x.sum(), 0.0),
    "three to choose from": lambda x: loop(
        lambda c: jax.lax.select_n((c > 0.0).astype(jnp.int32), c + 1.0, c - x.sum(), c), 0.0
    ),
    "other numbers": lambda x: loop(
        lambda c: c + (x > 0.0).astype(jnp.int16).sum(dtype=jnp.int16), jnp.int16(1)
    ),
    "the greater of two": lambda x: loop(lambda c: jnp.maximum(c, x.sum()), 0.0),
    "along the long axis": lambda x: loop(lambda c: c + jnp.argmin(x * c), 0.0),
    "what each round reads": lambda x: jax.lax.scan(lambda c, y: (c + x.sum(), y), 0.0, x)[0],
    "what each round writes": lambda x: jax.lax.scan(lambda c, _: (c + x.sum(), c), 0.0, None, 3),
}


@pytest.mark.parametrize("name", LOOPS)
def test_other_loops_stay(name):
    x = jax.random.normal(jax.random.key(0), (N,))
    closed = rewritten(LOOPS[name], x, platform=GPU)
    assert not named(closed, "pallas_call") and len(named(closed, "scan")) == 1
    got, want = jaxpr_as_fun(closed)(x), jax.tree.leaves(LOOPS[name](x))
    for ours, theirs in zip(got, want, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5)


# Two balls on a floor, one of them slides: 8 rows of contacts.
BALLS = """
<mujoco>
  <option iterations="2" ls_iterations="5" cone="CONE"/>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body pos="0 0 0.09"><freejoint/><geom size="0.1"/></body>
    <body pos="1 0 0.095"><freejoint/><geom size="0.1"/></body>
  </worldbody>
</mujoco>
"""


def physics_of_balls(cone):
    """Returns their physics for a GPU, states and controls of two, and its trace's kernels."""
    model = mujoco.MjModel.from_xml_string(BALLS.replace("CONE", cone))
    p, c = (Physics(model, ("xpos",), substeps=2, engine=engine) for engine in ("jax", "c"))
    p = for_gpu(p)
    qpos = jnp.array(model.qpos0)[None].repeat(2, 0)
    qvel = jax.random.normal(jax.random.key(0), (2, model.nv))
    state, ctrl = jax.vmap(c.init)(qpos, qvel)[0], jnp.zeros((2, 0))
    traced = jax.make_jaxpr(p.step)(*jax.tree.map(lambda x: x[0], (state, ctrl)))
    return p, (state, ctrl), named(traced, "pallas_call")


def is_search(eqn):
    return len(eqn.outvars) > 8  # so much it carries, no other kernel writes


@pytest.mark.slow
def test_the_line_search_of_a_physics_step_is_one_kernel():
    p, args, kernels = physics_of_balls("pyramidal")
    assert any(map(is_search, kernels))
    plain = jax.make_jaxpr(jax.vmap(lambda s, u: p._engine.plain_step(s, u, {})))(*args)
    found = quick.jit(jax.vmap(p.step))(*args)
    wanted = quick.jit(jaxpr_as_fun(plain))(*jax.tree.leaves(args))
    for x, y in zip(jax.tree.leaves(found), wanted, strict=True):
        scale = max(1.0, np.abs(y).max(initial=0.0))
        np.testing.assert_allclose(x / scale, y / scale, atol=1e-5)


def test_one_with_elliptic_cones_gathers_and_stays():
    _, _, kernels = physics_of_balls("elliptic")
    assert kernels and not any(map(is_search, kernels))
