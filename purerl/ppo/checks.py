"""Checks of settings and of observations; each raises ValueError, which says the cure."""

import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from purerl.core.records import PyTree

# What a setting must be, how that is told, and the names of those that must be so.
TRAINING = (
    ("at least 1", lambda x: x >= 1, "num_envs rollout_length num_epochs num_minibatches"),
    ("at least 1", lambda x: x >= 1, "episode_length"),
    ("in [0, 1]", lambda x: 0.0 <= x <= 1.0, "gamma gae_lambda"),
    ("above 0", lambda x: x > 0.0, "learning_rate clip max_gradient_norm desired_kl reward_scale"),
    ("0 or above, and finite", lambda x: 0.0 <= x < math.inf, "value_weight entropy_weight"),
    ("0 or above", lambda x: x >= 0, "segment_length"),
)
EVALUATION = (
    ("at least 1", lambda x: x >= 1, "num_episodes"),
    ("at least 0", lambda x: x >= 0, "number"),
)


def check_rules(settings: Any, rules: tuple) -> None:
    """Checks every setting by itself."""
    for rule, holds, names in rules:
        for name in names.split():
            if not holds(getattr(settings, name)):
                raise ValueError(f"{name} is {getattr(settings, name)}; it must be {rule}.")


def check_budget(config: Any) -> None:
    """Checks that the run has at least one update."""
    if config.num_updates < 1:
        raise ValueError(
            f"num_steps is {config.num_steps}, less than one update of num_envs * rollout_length = "
            f"{config.steps_per_update}; raise num_steps or lower one of the two."
        )


def check_observation(observation: "PyTree") -> None:
    """Checks that an observation is an array [O], or a flat dict of such."""
    parts = observation if isinstance(observation, dict) else {"policy": observation}
    if "policy" not in parts:
        raise ValueError(
            f"The observation is a dict of {', '.join(sorted(parts))}; the entry that the policy "
            "may read must be called policy (the value function reads all)."
        )
    for name, part in parts.items():
        if getattr(part, "ndim", None) != 1:
            what = (
                f"of shape {part.shape}" if hasattr(part, "shape") else f"a {type(part).__name__}"
            )
            raise ValueError(
                f"The observation's part {name} is {what}; this network takes arrays [O]: flatten "
                "it, or write a network of your own (experiments/custom_network.py)."
            )
