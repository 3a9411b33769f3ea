"""Checks of settings and of observations; each raises ValueError, which says the cure."""

import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from purerl.core.records import PyTree

# int32, in which updates, samples and steps of an episode are counted, ends below this.
COUNTS = 2**31
SIZE = "at least 1 and below 2**31 - 1", lambda x: 1 <= x < COUNTS - 1
ABOVE = "a number above 0, and finite", lambda x: 0.0 < x < math.inf
LEAST = "0 or above", lambda x: 0.0 <= x < math.inf
# What a setting must be, how that is told, and the names of those that must be so.
TRAINING = (
    (*SIZE, "num_envs rollout_length num_epochs num_minibatches episode_length"),
    ("at most 2**53", lambda x: x <= 2**53, "num_steps"),  # what reads metrics.jsonl has float64
    ("in [0, 1]", lambda x: 0.0 <= x <= 1.0, "gamma gae_lambda"),
    (*ABOVE, "learning_rate desired_kl clip max_gradient_norm reward_scale"),
    (*LEAST, "value_weight entropy_weight advantage_clip min_advantage_std shortest_episode"),
    ("in [0, 2]", lambda x: 0.0 <= x <= 2.0, "noise_color"),
    ("finite", math.isfinite, "entropy_target"),
)
EVALUATION = ((*SIZE, "num_episodes"), ("at least 0", lambda x: x >= 0, "number"))


def check_rules(settings: Any, rules: tuple) -> None:
    """Checks every setting by itself; raises ValueError for the first that breaks its rule.

    Args:
      settings: a dataclass.
      rules: a row each: the rule in words, whether a number keeps it, and the settings it is for.
    """
    for rule, holds, names in rules:
        for name in names.split():
            value = getattr(settings, name)
            # A comparison with NaN is False, so NaN breaks every rule.
            if isinstance(value, str) or not holds(value):
                raise ValueError(f"{name} is {value!r}; it must be {rule}.")


def check_budget(config: Any) -> None:
    """Checks that the run has an update, and that int32 counts its samples and its updates."""
    size = f"num_envs * rollout_length = {config.steps_per_update}"
    if config.steps_per_update >= COUNTS:
        raise ValueError(f"{size} must be below 2**31; lower one of the two.")
    if not 1 <= config.num_updates < COUNTS:
        wrong, cure = "less than one update", "raise num_steps or lower"
        if config.num_updates:
            wrong, cure = "2**31 updates or more", "lower num_steps or raise"
        raise ValueError(f"num_steps is {config.num_steps}, {wrong} of {size}; {cure} one of them.")


def check_observation(observation: "PyTree") -> None:
    """Checks that an observation is an array [O], or a flat dict of such."""
    entries = observation if isinstance(observation, dict) else {"policy": observation}
    if "policy" not in entries:
        raise ValueError(
            f"The observation is a dict of {', '.join(sorted(entries))}; the entry that the policy "
            "may read must be called policy (the value function reads all)."
        )
    for name, entry in entries.items():
        if getattr(entry, "ndim", None) != 1:
            shape, kind = getattr(entry, "shape", None), type(entry).__name__
            what = f"a {kind}" if shape is None else f"of shape {shape}"
            raise ValueError(
                f"The observation's part {name} is {what}; this network takes arrays [O]: flatten "
                "it, take eyes.mlp for pictures, or write one (experiments/custom_network.py)."
            )
