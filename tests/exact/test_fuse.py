"""What the optimisation does for a GPU, run on a CPU: scatters as gathers, loops written out."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jax.extend.core import jaxpr_as_fun

from purerl.exact import fuse
from purerl.exact.fuse import WRITTEN_OUT
from purerl.physics.interface import Physics
from tests import exact as shared, quick
from tests.exact import GPU, for_gpu, named

rewritten = functools.partial(shared.rewritten, platform=GPU)

# A ball joint, whose quaternion is put together by parts, and a hinge that its limit stops.
ARM = """
<mujoco>
  <option iterations="1" ls_iterations="5"/>
  <worldbody>
    <body>
      <joint type="ball"/>
      <geom size="0.1" contype="0"/>
      <body pos="0.3 0 0">
        <joint axis="0 1 0" limited="true" range="-10 10"/>
        <geom size="0.1" contype="0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


INDEX = np.array([2, 0, 2, 7, -9])
SCATTERS = {
    "places that meet and one that is not there": lambda x: jnp.arange(5.0).at[INDEX].set(x[:5]),
    "one clipped": lambda x: jnp.zeros(5).at[np.array([1, 9])].set(x[:2], mode="clip"),
    "none that is there": lambda x: jnp.arange(3.0).at[np.array([7])].set(x[:1], mode="drop"),
    "a column": lambda x: jnp.ones((4, 3)).at[:, 1].set(x[:4]),
    "a block": lambda x: jnp.ones((4, 3)).at[1:3, :2].set(x[:4].reshape(2, 2)),
    "a diagonal": lambda x: jnp.ones((4, 4)).at[np.arange(4), np.arange(4)].set(x[:4]),
    "all": lambda x: jnp.zeros(8).at[np.arange(8)[::-1]].set(x),
    "rows of whole numbers": lambda x: (
        jnp.zeros((3, 8), jnp.int32).at[np.array([2, 0])].set((x * 9).astype(jnp.int32))
    ),
    "in a loop": lambda x: jax.lax.fori_loop(
        0, 20, lambda i, c: c.at[np.array([0, 3])].set(c[np.array([3, 0])] + i), x
    ),
}


@pytest.mark.parametrize("name", SCATTERS)
def test_what_is_put_at_known_places_is_gathered(name):
    function = SCATTERS[name]
    x = jax.random.uniform(jax.random.key(0), (2, 8))
    closed = rewritten(function, x[0])
    assert named(jax.make_jaxpr(function)(x[0]), "scatter"), "nothing to show"
    assert not named(closed, "scatter")
    (got,) = jax.vmap(jaxpr_as_fun(closed))(x)
    want = jnp.stack([function(row) for row in x])
    assert got.dtype == want.dtype
    np.testing.assert_array_equal(got, want)


@pytest.mark.parametrize(
    "function",
    [
        lambda x: x.at[np.array([1, 3])].apply(jnp.sin),
        lambda x: x.at[np.array([1, 1])].multiply(2, unique_indices=True),
    ],
)
def test_what_is_computed_in_its_place_stays(function):
    x = jnp.arange(1.0, 9.0)
    (got,) = jaxpr_as_fun(rewritten(function, x))(x)
    np.testing.assert_array_equal(got, function(x))


def test_what_is_put_at_places_known_only_later_stays():
    closed = rewritten(lambda x, i: x.at[i].set(7.0), jnp.zeros(3), jnp.arange(2))
    assert named(closed, "scatter")
    np.testing.assert_array_equal(jaxpr_as_fun(closed)(jnp.zeros(3), jnp.arange(2))[0], [7, 7, 0])


@pytest.mark.parametrize("length", [2, WRITTEN_OUT, WRITTEN_OUT + 3])
def test_only_the_innermost_of_loops_is_written_out(length):
    def inner(x):
        return jax.lax.scan(lambda c, y: (c * y + 1.0, c), x[0], x[:length])

    def nested(x):
        return jax.lax.scan(lambda c, _: (inner(c * x)[1].sum(), c), x[0], None, 5)

    x = jax.random.uniform(jax.random.key(0), (2, 8))
    closed = rewritten(nested, x[0])
    assert [eqn.params["unroll"] for eqn in named(closed, "scan")] == [1, min(length, WRITTEN_OUT)]
    for got, want in zip(jax.vmap(jaxpr_as_fun(closed))(x), jax.vmap(nested)(x), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-6)


def test_a_long_round_is_not_written_out(monkeypatch):
    def loop(x):
        return jax.lax.scan(lambda c, _: (jnp.sin(c) + 1.0, None), x, None, 5)[0]

    monkeypatch.setattr(fuse, "FEW_EQUATIONS", 2)
    assert [e.params["unroll"] for e in named(rewritten(loop, 1.0), "scan")] == [1]
    monkeypatch.setattr(fuse, "FEW_EQUATIONS", 3)
    assert [e.params["unroll"] for e in named(rewritten(loop, 1.0), "scan")] == [4]


def test_a_loop_reads_rows_of_few_numbers_by_column():
    """As MJX's line search does, which adds up three numbers of each constraint in every round."""

    def search(x):
        quad = jnp.stack([x * x, x, jnp.cos(x)]).T  # [40, 3]
        square = x.reshape(5, 8)

        def body(c, _):
            return (quad * (x > c[0])[:, None]).sum(0) + square.sum(), None

        return jax.lax.scan(body, jnp.zeros(3), None, 9)[0]

    x = jax.random.normal(jax.random.key(0), (2, 40))
    closed = rewritten(search, x[0])
    (loop,) = named(closed, "scan")
    shapes = [v.aval.shape for v in loop.invars]
    assert (3, 40) in shapes and (40, 3) not in shapes and (5, 8) in shapes
    (got,) = jax.vmap(jaxpr_as_fun(closed))(x)
    np.testing.assert_allclose(got, jax.vmap(search)(x), rtol=1e-5)


@pytest.mark.slow
def test_a_physics_step_for_a_gpu_is_the_same_step():
    model = mujoco.MjModel.from_xml_string(ARM)
    p, c = (Physics(model, ("xpos", "cvel"), substeps=3, engine=engine) for engine in ("jax", "c"))
    p = for_gpu(p)
    qpos = jnp.array([[1.0, 0.0, 0.0, 0.0, 0.3], [0.6, 0.0, 0.8, 0.0, -0.1]])  # one at its limit
    qvel = jnp.array([[1.0, -2.0, 0.5, 3.0], [0.5, 1.0, 0.0, 1.0]])
    state, _ = jax.vmap(c.init)(qpos, qvel)
    ctrl = jnp.zeros((2, 0))
    traced = jax.make_jaxpr(p.step)(*jax.tree.map(lambda x: x[0], (state, ctrl)))
    plain = jax.make_jaxpr(jax.vmap(lambda s, u: p._engine.plain_step(s, u, {})))(state, ctrl)
    assert named(plain, "scatter")
    assert not named(traced, "scatter")
    assert any(eqn.params["unroll"] == WRITTEN_OUT for eqn in named(traced, "scan"))
    found = quick.jit(jax.vmap(p.step))(state, ctrl)
    wanted = quick.jit(jaxpr_as_fun(plain))(*jax.tree.leaves((state, ctrl)))
    for x, y in zip(jax.tree.leaves(found), wanted, strict=True):
        scale = max(1.0, np.abs(y).max(initial=0.0))
        np.testing.assert_allclose(x / scale, y / scale, atol=1e-6)


def test_nothing_of_it_is_done_for_a_cpu_or_unless_asked():
    def function(x):
        return jax.lax.scan(lambda c, _: (jnp.sin(c), None), x, None, 5)[0].at[0].set(1)

    def steps(closed):
        return len(named(closed, "scatter")), [e.params["unroll"] for e in named(closed, "scan")]

    x = jnp.ones(3)
    assert steps(rewritten(function, x)) == (0, [WRITTEN_OUT])
    assert steps(rewritten(function, x, platform="cpu")) == (1, [1])
    assert steps(rewritten(function, x, fuse=False)) == (1, [1])
