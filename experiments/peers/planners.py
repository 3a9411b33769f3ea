"""Plans per second of this planner, of judo and of hydrax, on the same model.

    python experiments/peers/planners.py ours cartpole.xml
    python experiments/peers/planners.py judo cartpole.xml     # pip install judo-rai
    python experiments/peers/planners.py hydrax cartpole.xml   # from its repository

Predictive sampling with a linear spline of 8 knots, 64 plans of 50 physics steps before each
action, and a reward that costs nothing to compute. Each is run where it is installed: judo asks for
another MuJoCo than this project. The cart-pole that was measured is dm_control's
(dm_control/suite/cartpole.xml) without its energy flag, which MJX lacks. The figure is the median
of 100 plans.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np

SAMPLES, HORIZON, KNOTS = 64, 50, 8
WARM, TIMED = 5, 100


def ours(file: str) -> Callable[[], None]:
    """Returns a function that makes one plan by `purerl.planner`, on engine `c`."""
    import jax
    import jax.numpy as jnp
    import mujoco

    from purerl import Physics, State, planner

    physics = Physics(mujoco.MjModel.from_xml_path(file), substeps=1, engine="c")

    class Body:
        action_size, control_timestep = physics.model.nu, physics.control_timestep

        def reset(self, key):
            rest = jnp.asarray(physics.model.qpos0, jnp.float32)
            return self.state(physics.init(rest, jnp.zeros(physics.model.nv))[0])

        def step(self, state, action):
            return self.state(physics.step(state.physics, action)[0])

        def state(self, now):
            no = jnp.zeros((), bool)
            reward = -jnp.sum(jnp.square(now.qpos))
            return State(
                physics=now, observation=now.qpos, reward=reward, terminated=no, truncated=no,
                metrics={}, task=(),
            )  # fmt: skip

    env = Body()
    settings = planner.Settings(samples=SAMPLES, horizon=HORIZON, knots=KNOTS)
    guide = planner.unguided(env.action_size)
    choose = jax.jit(lambda plan, state, key: planner.plan(settings, env, guide, plan, state, key))
    state, key = jax.jit(env.reset)(jax.random.key(0)), jax.random.key(1)
    plan = planner.start(settings, env, guide)
    return lambda: jax.block_until_ready(choose(plan, state, key))


def judo(file: str) -> Callable[[], None]:
    """Returns a function that makes one plan by judo, with its own cart-pole's reward."""
    from judo.controller import Controller, ControllerConfig
    from judo.optimizers import get_registered_optimizers
    from judo.tasks.cartpole import Cartpole

    task = Cartpole(file)
    kind, settings = get_registered_optimizers()["ps"]
    chosen = kind(settings(num_rollouts=SAMPLES, num_nodes=KNOTS), task.nu)
    horizon = ControllerConfig(horizon=HORIZON * task.dt, spline_order="linear")
    return Controller(horizon, task, chosen).update_action


def hydrax(file: str) -> Callable[[], None]:
    """Returns a function that makes one plan by hydrax, with its own cart-pole's cost, in MJX."""
    import jax
    import mujoco
    from hydrax.algs import PredictiveSampling
    from hydrax.task_base import Task
    from hydrax.tasks.cart_pole import CartPole
    from mujoco import mjx

    task, model = CartPole(), mujoco.MjModel.from_xml_path(file)
    model.opt.enableflags = 0
    Task.__init__(task, model)
    chosen = PredictiveSampling(
        task, num_samples=SAMPLES, noise_level=0.3, plan_horizon=HORIZON * task.dt,
        spline_type="linear", num_knots=KNOTS,
    )  # fmt: skip
    data, parameters, choose = mjx.make_data(model), chosen.init_params(), jax.jit(chosen.optimize)
    return lambda: jax.block_until_ready(choose(data, parameters))


def main() -> None:
    """Prints the rate of one of them."""
    planners = {"ours": ours, "judo": judo, "hydrax": hydrax}
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("planner", choices=planners)
    parser.add_argument("model", help="an MJCF file of a cart-pole")
    options = parser.parse_args()
    plan, seconds = planners[options.planner](options.model), []
    for _ in range(WARM + TIMED):
        begin = time.perf_counter()
        plan()
        seconds.append(time.perf_counter() - begin)
    print(f"{options.planner}: {1 / np.median(seconds[WARM:]):.1f} plans/s")


if __name__ == "__main__":
    main()
