"""What a run takes of the memory at least, before anything is allocated."""

import math
import os

import jax

from purerl.core.records import PyTree
from purerl.ppo.config import Config

SCALARS = 6  # of a control step: reward, value, log-probability, advantage, target, its end
# What takes memory, and what makes it smaller.
CURES = {
    "environments": "ppo.num_envs",
    "rollouts": "ppo.num_envs, ppo.rollout_length or what is observed",
    "the network and its optimizer": "the network's widths",
}


def size(tree: PyTree) -> int:
    """Returns the bytes of a tree's arrays; of abstract ones too."""
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def room() -> int:
    """Returns the bytes of memory of a device: of a GPU its own, of a CPU the machine's."""
    known = jax.local_devices()[0].memory_stats() or {}
    return known.get("bytes_limit") or of_machine()


def of_machine() -> int:
    """Returns the bytes of the machine's own memory."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def least(config: Config, abstract: PyTree, action_size: int) -> dict[str, int]:
    """Returns what a run's parts take at least [bytes], of one seed on one device."""
    number = config.num_envs
    sample = size(abstract.env_state.observation) / number + 4 * (action_size + SCALARS)
    # An update has the rollouts as they were collected, and shuffled for the minibatches.
    rollouts = 2 * math.ceil(sample * config.steps_per_update)
    learned = size((abstract.params, abstract.optimizer))
    parts = {"environments": size((abstract.env_state, abstract.episode)), "rollouts": rollouts}
    return parts | {"the network and its optimizer": learned}


def check_room(parts: dict[str, int], has: int) -> None:
    """Raises ValueError, with the size to lower, if a run's `parts` are more than memory `has`."""
    total = sum(parts.values())
    if total <= has:
        return
    most = max(parts, key=lambda name: parts[name])
    raise ValueError(
        f"The run takes at least {total / 1e9:,.1f} GB of memory, {parts[most] / 1e9:,.1f} of them "
        f"for {most}, and the device has {has / 1e9:,.1f} GB: lower {CURES[most]}."
    )
