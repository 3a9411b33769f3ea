"""Checks that sizes divide each other; each raises ValueError with sizes that do."""

import math

from purerl.devices.shards import Shards
from purerl.ppo.config import Config


def check_divides(
    whole_name: str, whole: int, parts_name: str, parts: int, because: str = ""
) -> None:
    """Checks that `parts` divides `whole`; the message has the nearest sizes that do."""
    if whole % parts == 0:
        return
    small = [d for d in range(1, math.isqrt(whole) + 1) if whole % d == 0]
    divisors = sorted({*small, *(whole // d for d in small)})
    nearest = sorted(sorted(divisors, key=lambda d: abs(d - parts))[:3])
    below, above = whole - whole % parts, whole - whole % parts + parts
    raise ValueError(
        f"{parts_name} = {parts} does not divide {whole_name} = {whole}; "
        f"{parts_name} could be {', '.join(map(str, nearest))}, "
        f"or {whole_name} could be {' or '.join(str(w) for w in (below, above) if w > 0)}."
        + because
    )


def check_minibatches(config: Config, recurrent: bool, size: int, name: str = "num_envs") -> None:
    """Checks that the minibatches divide a rollout of `size` environments, called `name`.

    Those of a `recurrent` network hold whole rollouts. A minibatch of one step is refused: an
    advantage less the mean of itself alone is 0, so the policy would never move.
    """
    because = " The minibatches of a recurrent network hold whole rollouts." if recurrent else ""
    if not recurrent:
        size, name = size * config.rollout_length, f"{name} * rollout_length"
    check_divides(name, size, "num_minibatches", config.num_minibatches, because)
    if config.steps_per_update == config.num_minibatches:
        least = next((d for d in range(2, math.isqrt(size) + 1) if size % d == 0), size)
        fewer = f"num_minibatches could be {size // least} or a divisor of it, or " * (size > 1)
        raise ValueError(
            f"num_minibatches = {size} leaves each minibatch one step, whose advantage is its own "
            f"mean, so the policy would never move; {fewer}raise num_envs * rollout_length."
        )


def check_shards(shards: Shards, num_envs: int) -> None:
    """Checks that the devices divide the shards, and the shards the environments."""
    alone = " With num_shards = 1 a single device is used."
    check_divides("num_shards", shards.number, "devices", shards.devices, alone)
    check_divides("num_envs", num_envs, "num_shards", shards.number)
