"""What brax, stable-baselines3, CleanRL, acme and rsl_rl call our settings."""

from collections.abc import Iterable

from purerl.core.errors import nearest

BONUS = "times the number of actions"
# Their word -> ours, and how its value becomes ours where it is not the same.
COUNTERPARTS = {
    "anneal_lr": ("schedule", "linear if true"),
    "batch_size": ("num_minibatches", "num_envs * rollout_length / batch_size"),
    "clip_coef": ("clip", ""),
    "clip_param": ("clip", ""),
    "clip_range": ("clip", ""),
    "clipping_epsilon": ("clip", ""),
    "discount": ("gamma", ""),
    "discounting": ("gamma", ""),
    "ent_coef": ("entropy_weight", BONUS),
    "entropy_coef": ("entropy_weight", BONUS),
    "entropy_cost": ("entropy_weight", BONUS),
    "lam": ("gae_lambda", ""),
    "max_grad_norm": ("max_gradient_norm", ""),
    "minibatch_size": ("num_minibatches", "num_envs * rollout_length / minibatch_size"),
    "n_envs": ("num_envs", ""),
    "n_epochs": ("num_epochs", ""),
    "n_steps": ("rollout_length", ""),
    "num_evals": ("number", "less 1 if it is brax's"),
    "num_steps_per_env": ("rollout_length", ""),
    "num_timesteps": ("num_steps", ""),
    "num_updates_per_batch": ("num_epochs", ""),
    "ppo_clipping_epsilon": ("clip", ""),
    "total_timesteps": ("num_steps", ""),
    "update_epochs": ("num_epochs", ""),
    "value_loss_coef": ("value_weight", "times 2"),
    "vf_coef": ("value_weight", "times 2 if it is stable-baselines3's"),
    "vf_loss_coefficient": ("value_weight", ""),
}
PAGE = "docs/tutorials/from_other_trainers.md"


def suggest(name: str, valid: Iterable[str]) -> str:
    """Returns which setting a wrong name is surely meant to be, as a question, or "".

    Another trainer's word is answered with ours, how to convert its value, and the page of both.

    >>> suggest("--ppo.n-envs", ["--ppo.clip", "--ppo.num-envs"])
    'Did you mean --ppo.num-envs (docs/tutorials/from_other_trainers.md)?'
    """
    valid = list(valid)
    ours, conversion = COUNTERPARTS.get(_word(name), ("", ""))
    for one in valid:
        if _word(one) == ours:
            return f"Did you mean {one} ({f'{conversion}; ' if conversion else ''}{PAGE})?"
    counts = (one for one in valid if _word(one) == f"num_{_word(name)}")  # seeds, of num_seeds
    near = next(counts, "") or nearest(name, valid)
    return f"Did you mean {near}?" if near else ""


def _word(name: str) -> str:
    """Returns the last part of an option's or a setting's name, as it is in Python."""
    return name.rpartition(".")[2].strip("-").replace("-", "_")
