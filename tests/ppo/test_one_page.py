"""The page that shows PPO computes what PPO computes, to the last bit.

20 updates of both on the cart-pole.
"""

import functools
import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from purerl import Config, networks
from purerl.envs import cartpole_swingup
from purerl.ppo import algorithm

PAGE = Path(__file__).parents[2] / "docs" / "explanation" / "ppo_on_one_page.py"
CONFIG = Config(
    num_steps=20 * 8 * 16,
    num_envs=8,
    rollout_length=16,
    num_epochs=2,
    num_minibatches=8,
    episode_length=20,
    noise_color=0.0,
    shortest_episode=0,
    entropy_weight=0.0,
)


def load_page():
    spec = importlib.util.spec_from_file_location("ppo_on_one_page", PAGE)
    page = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(page)
    return page


def running(statistics):
    """Statistics as the page has them."""
    pairs = ((x.value, x.error) for x in (statistics.mean, statistics.variance))
    return (statistics.count.low, *pairs)


def as_on_the_page(state):
    """Returns a TrainState in the order of the page's `State`."""
    return (
        state.params,
        state.optimizer,
        running(state.normalizer),
        running(state.reward_normalizer),
        state.env_state,
        state.episode.length,
        state.episode.limit,
        state.discounted_return,
        jax.random.key_data(state.key),
        state.update,
    )


# XLA fuses operations, and rounds within a fusion as its whole needs it: two programs that compute
# the same in other words differ in their last bits. Without fusion every operation is rounded by
# itself. LLVM need not optimise what runs for a second.
OPTIONS = {"xla_disable_hlo_passes": "fusion", "xla_backend_optimization_level": 0}


@pytest.mark.slow
def test_the_page_computes_the_same_bits():
    page = load_page()
    env = cartpole_swingup.build(engine="c")
    options = networks.MlpOptions(policy_hidden=(8,), value_hidden=(8,))
    network = networks.mlp(options, jnp.zeros(5), env.action_size)

    def programs(module):
        init = functools.partial(module.init, CONFIG, env, network)
        update = functools.partial(module.update, CONFIG, env, network)
        return (jax.jit(f, compiler_options=OPTIONS) for f in (init, update))

    (init, update), (page_init, page_update) = programs(algorithm), programs(page)
    state, shown = init(jax.random.key(3)), page_init(jax.random.key(3))
    for _ in range(20):
        state, _ = update(state)
        shown = page_update(shown)
        expected = jax.tree.leaves_with_path(as_on_the_page(state))
        found = jax.tree.leaves(shown._replace(key=jax.random.key_data(shown.key)))
        for (path, x), y in zip(expected, found, strict=True):
            where = f"update {state.update}, {jax.tree_util.keystr(path)}"
            np.testing.assert_array_equal(x, y, err_msg=where)
    assert state.update == 20 and state.normalizer.count.low == 20 * 8 * 16


def test_it_is_one_page():
    text = PAGE.read_text()
    assert len(text.splitlines()) <= 200
    assert "purerl.ppo import" not in text
