"""What brax, stable-baselines3, CleanRL, acme and rsl_rl call our settings."""

from collections.abc import Iterable

from purerl.core.errors import nearest

# Our word -> theirs.
THEIRS = {
    "clip": "clip_coef clip_param clip_range clipping_epsilon ppo_clipping_epsilon",
    "entropy_weight": "ent_coef entropy_coef entropy_cost",
    "gae_lambda": "lam",
    "gamma": "discount discounting",
    "max_gradient_norm": "max_grad_norm",
    "num_envs": "n_envs",
    "num_epochs": "n_epochs num_updates_per_batch update_epochs",
    "num_minibatches": "batch_size minibatch_size",
    "num_steps": "num_timesteps total_timesteps",
    "number": "num_evals",
    "rollout_length": "n_steps num_steps_per_env",
    "schedule": "anneal_lr",
    "value_weight": "value_loss_coef vf_coef vf_loss_coefficient",
}
# How a value of theirs becomes ours, where it is not the same.
CONVERSIONS = dict.fromkeys(THEIRS["entropy_weight"].split(), "times the number of actions") | {
    "anneal_lr": "linear if true",
    "batch_size": "num_envs * rollout_length / batch_size",
    "minibatch_size": "num_envs * rollout_length / minibatch_size",
    "num_evals": "less 1 if it is brax's",
    "value_loss_coef": "times 2",
    "vf_coef": "times 2 if it is stable-baselines3's",
}
OURS = {word: ours for ours, words in THEIRS.items() for word in words.split()}
PAGE = "docs/tutorials/from_other_trainers.md"


def suggest(name: str, valid: Iterable[str]) -> str:
    """Returns which setting a wrong name is surely meant to be, as a question, or "".

    Another trainer's word is answered with ours, how to convert its value, and the page of both.

    >>> suggest("--ppo.n-envs", ["--ppo.clip", "--ppo.num-envs"])
    'Did you mean --ppo.num-envs (docs/tutorials/from_other_trainers.md)?'
    """
    valid = list(valid)
    conversion = CONVERSIONS.get(_word(name), "")
    for one in valid:
        if _word(one) == OURS.get(_word(name)):
            return f"Did you mean {one} ({f'{conversion}; ' if conversion else ''}{PAGE})?"
    counts = (one for one in valid if _word(one) == f"num_{_word(name)}")  # seeds, of num_seeds
    near = next(counts, "") or nearest(name, valid)
    return f"Did you mean {near}?" if near else ""


def _word(name: str) -> str:
    """Returns the last part of an option's or a setting's name, as it is in Python."""
    return name.rpartition(".")[2].strip("-").replace("-", "_")
