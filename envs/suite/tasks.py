"""The tasks of the suite by their names, `<domain>-<task>`."""

from dataclasses import dataclass
from typing import Any, Literal

from purerl.envs.suite import (
    acrobot,
    ball_in_cup,
    cartpole,
    cheetah,
    finger,
    fish,
    hopper,
    humanoid,
    manipulator,
    pendulum,
    point_mass,
    reacher,
    swimmer,
    walker,
)
from purerl.envs.suite.base import SuiteEnv, check_task

TASKS: dict[str, tuple[Any, Any]] = {  # name -> the domain's module and its options
    "acrobot-swingup": (acrobot, acrobot.Options("swingup")),
    "acrobot-swingup_sparse": (acrobot, acrobot.Options("swingup_sparse")),
    "ball_in_cup-catch": (ball_in_cup, ball_in_cup.Options()),
    "cartpole-balance": (cartpole, cartpole.Options("balance")),
    "cartpole-balance_sparse": (cartpole, cartpole.Options("balance_sparse")),
    "cartpole-swingup": (cartpole, cartpole.Options("swingup")),
    "cartpole-swingup_sparse": (cartpole, cartpole.Options("swingup_sparse")),
    "cheetah-run": (cheetah, cheetah.Options()),
    "finger-spin": (finger, finger.Options("spin")),
    "finger-turn_easy": (finger, finger.Options("turn_easy")),
    "finger-turn_hard": (finger, finger.Options("turn_hard")),
    "fish-swim": (fish, fish.Options("swim")),
    "fish-upright": (fish, fish.Options("upright")),
    "hopper-hop": (hopper, hopper.Options("hop")),
    "hopper-stand": (hopper, hopper.Options("stand")),
    "humanoid-run": (humanoid, humanoid.Options("run")),
    "humanoid-stand": (humanoid, humanoid.Options("stand")),
    "humanoid-walk": (humanoid, humanoid.Options("walk")),
    "manipulator-bring_ball": (manipulator, manipulator.Options()),
    "pendulum-swingup": (pendulum, pendulum.Options()),
    "point_mass-easy": (point_mass, point_mass.Options()),
    "reacher-easy": (reacher, reacher.Options("easy")),
    "reacher-hard": (reacher, reacher.Options("hard")),
    "swimmer-swimmer15": (swimmer, swimmer.Options(links=15)),
    "swimmer-swimmer6": (swimmer, swimmer.Options(links=6)),
    "walker-run": (walker, walker.Options("run")),
    "walker-stand": (walker, walker.Options("stand")),
    "walker-walk": (walker, walker.Options("walk")),
}


@dataclass(frozen=True)
class Options:
    """Which task."""

    task: Literal[tuple(TASKS)] = "walker-walk"  # type: ignore[valid-type]
    """Domain and task, as dm_control names them."""

    def __post_init__(self):
        """Refuses a task that there is not."""
        check_task(self.task, tuple(TASKS))


def build(options: Options = Options(), engine: str = "auto") -> SuiteEnv:  # noqa: B008
    """Builds the task's environment on an engine of `purerl.physics.interface`."""
    module, settings = TASKS[options.task]
    return module.build(settings, engine)
