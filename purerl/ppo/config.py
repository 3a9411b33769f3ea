"""The hyperparameters of PPO: pure data, checked when made."""

import math
from dataclasses import dataclass
from typing import Literal

from purerl.ppo.distributions import DISTRIBUTIONS, Distribution


@dataclass(frozen=True)
class Config:
    """PPO hyperparameters; sizes in the alphabet of `types.py`."""

    num_steps: int
    """Control steps of the whole run, all environments together; never exceeded."""
    num_envs: int = 256
    """Environments that run in parallel, B."""
    rollout_length: int = 32
    """Policy steps of each environment in one update, T."""
    num_epochs: int = 4
    """Passes over each rollout."""
    num_minibatches: int = 8
    """Gradient steps in one pass."""
    episode_length: int = 1000
    """Time limit of an episode [control steps]; reaching it truncates."""
    action_repeat: int = 1
    """Control steps that each policy action is held for."""
    gamma: float = 0.99
    """Discount of one policy step."""
    gae_lambda: float = 0.95
    """Decay of the advantage trace, lambda."""
    segment_length: int = 0
    """Steps of the segments into which rollouts are cut, which minibatches hold whole, and whose
    advantages and value targets each gradient step estimates anew, from the values of then (brax's
    unroll_length); 0: estimated once an update, over whole rollouts."""
    clip: float = 0.2
    """Range of the policy ratio, 1 +- clip."""
    value_clip: float | None = None
    """Range of the value's change in scaled-reward units; none: plain squared error."""
    value_weight: float = 0.5
    """Weight of the value loss."""
    entropy_weight: float = 0.0
    """Weight of the entropy bonus."""
    max_gradient_norm: float = 1.0
    """Gradients are scaled down to this global norm."""
    learning_rate: float = 3e-4
    """Adam's step size, or where it starts."""
    schedule: Literal["constant", "linear", "adaptive_kl"] = "constant"
    """Learning rate over the run: constant, linearly to 0, or steered by the policy's KL.
    The last never lets a policy rest: `suite`'s cartpole-balance fell from 971 to 462."""
    desired_kl: float = 0.01
    """KL of one minibatch step that the adaptive schedule aims at."""
    reward_scaling: Literal["constant", "return_std"] = "constant"
    """Divide rewards by nothing, or by the running std of the discounted return."""
    reward_scale: float = 1.0
    """Factor on every reward before learning; reported returns are unscaled."""
    distribution: Literal["normal", "tanh_normal"] = "tanh_normal"
    """Family of the policy."""
    reset_pool: int = 0
    """Fresh starts drawn in each update: a multiple of num_envs, or a part of it that environments
    share (where episodes are long and starts are dear); 0: one for each environment."""

    def __post_init__(self) -> None:
        """Raises ValueError for a number outside its range or a budget below one update."""
        for name in _POSITIVE_INTEGERS:
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least 1.")
        for name in ("gamma", "gae_lambda"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be in [0, 1].")
        for name in ("learning_rate", "clip", "max_gradient_norm", "desired_kl", "reward_scale"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be above 0.")
        for name in ("value_clip", "value_weight", "entropy_weight", "segment_length"):
            value = getattr(self, name)
            if value is not None and not 0.0 <= value < math.inf:
                raise ValueError(f"{name} is {value}; it must be 0 or above, and finite.")
        _check_budget(self)
        if self.segment_length:
            check_divides(
                "rollout_length", self.rollout_length, "segment_length", self.segment_length
            )
        check_pool(self)

    @property
    def samples_per_update(self) -> int:
        """Policy steps in one update, T * B."""
        return self.num_envs * self.rollout_length

    @property
    def steps_per_update(self) -> int:
        """Control steps in one update."""
        return self.samples_per_update * self.action_repeat

    @property
    def num_updates(self) -> int:
        """Whole updates that fit into `num_steps`."""
        return self.num_steps // self.steps_per_update

    @property
    def action_distribution(self) -> Distribution:
        """The policy's family as functions."""
        return DISTRIBUTIONS[self.distribution]


_POSITIVE_INTEGERS = (
    "num_envs",
    "rollout_length",
    "num_epochs",
    "num_minibatches",
    "episode_length",
    "action_repeat",
)


def _check_budget(config: Config) -> None:
    if config.num_updates < 1:
        raise ValueError(
            f"num_steps is {config.num_steps}, less than one update of num_envs * rollout_length * "
            f"action_repeat = {config.steps_per_update}; raise num_steps or lower one of the three."
        )


def check_pool(config: Config) -> None:
    """Raises ValueError unless each environment has as many starts of its own, or shares one."""
    pool, size = config.reset_pool, config.num_envs
    if pool < 0 or (pool and pool % size and size % pool):
        raise ValueError(
            f"reset_pool is {pool}; with num_envs = {size} it must be 0, a multiple of {size} or a "
            "divisor of it."
        )


def check_divides(
    whole_name: str, whole: int, parts_name: str, parts: int, because: str = ""
) -> None:
    """Raises ValueError, with the nearest sizes that do, unless `parts` divides `whole`."""
    if whole % parts == 0:
        return
    divisors = [d for d in range(1, whole + 1) if whole % d == 0]
    nearest = sorted(sorted(divisors, key=lambda d: abs(d - parts))[:3])
    below, above = whole - whole % parts, whole - whole % parts + parts
    raise ValueError(
        f"{parts_name} = {parts} does not divide {whole_name} = {whole}; "
        f"{parts_name} could be {', '.join(map(str, nearest))}, "
        f"or {whole_name} could be {' or '.join(str(w) for w in (below, above) if w > 0)}."
        + because
    )
