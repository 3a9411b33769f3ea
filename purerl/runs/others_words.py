"""What other trainers call our settings: those of brax, stable-baselines3 and CleanRL."""

from collections.abc import Iterable

from purerl.core.errors import nearest

COUNTERPARTS = {
    "anneal_lr": "schedule",
    "clip_coef": "clip",
    "clip_range": "clip",
    "clipping_epsilon": "clip",
    "discounting": "gamma",
    "ent_coef": "entropy_weight",
    "entropy_cost": "entropy_weight",
    "entropy_coef": "entropy_weight",
    "max_grad_norm": "max_gradient_norm",
    "n_envs": "num_envs",
    "n_epochs": "num_epochs",
    "n_steps": "rollout_length",
    "num_timesteps": "num_steps",
    "num_updates_per_batch": "num_epochs",
    "target_kl": "desired_kl",
    "total_timesteps": "num_steps",
    "unroll_length": "rollout_length",
    "update_epochs": "num_epochs",
    "vf_coef": "value_weight",
    "vf_loss_coefficient": "value_weight",
}
PAGE = "docs/tutorials/from_other_trainers.md"


def meant(name: str, valid: Iterable[str]) -> str:
    """Returns which setting a wrong name is surely meant to be, as a question, or "".

    Another trainer's word is answered with ours and the page of both: their values may differ.

    >>> meant("--ppo.ent-coef", ["--ppo.clip", "--ppo.entropy-weight"])
    'Did you mean --ppo.entropy-weight (docs/tutorials/from_other_trainers.md)?'
    """
    valid = list(valid)
    ours = COUNTERPARTS.get(_word(name), "")
    for one in valid:
        if _word(one) == ours:
            return f"Did you mean {one} ({PAGE})?"
    near = nearest(name, valid)
    return f"Did you mean {near}?" if near else ""


def _word(name: str) -> str:
    """Returns the last part of an option's or a setting's name, as it is in Python."""
    return name.rpartition(".")[2].strip("-").replace("-", "_")
