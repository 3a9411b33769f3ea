"""What every format of an exported policy shares: what it is of, and a check of its actions."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from purerl.core.records import PyTree
from purerl.report.episode_arrays import record
from purerl.runs.loaded_run import Run

EPISODES = 8  # that an exported policy is compared on


class Recorded(NamedTuple):
    """Whole episodes of a run's own policy, as `python -m purerl.record` has them."""

    observation: PyTree  # [N, T, O], or a dict of such
    action: np.ndarray  # [N, T, A]
    length: np.ndarray  # [N] steps; what comes after them is no part of an episode

    def compare(self, policy: Callable[[Any], np.ndarray]) -> str:
        """Returns the line that tells how near another policy comes to these actions."""
        return (
            f"Largest difference from the run's own actions: {self.difference(policy):.1e}, over "
            f"{self.length.sum():,} observations of {len(self.length)} episodes."
        )

    def difference(self, policy: Callable[[Any], np.ndarray]) -> float:
        """Returns the largest absolute difference of `policy` over all steps of all episodes.

        Args:
          policy: float32 observations of N environments, leaves [N, O], to actions [N, A]; called
            once a step, from the beginning of N episodes.
        """
        largest = 0.0
        for t in range(self.action.shape[1]):
            action = policy(jax.tree.map(lambda x, t=t: x[:, t], self.observation))
            gap = np.abs(np.asarray(action, float) - self.action[:, t])[t < self.length]
            # NaN is no small difference.
            largest = max(largest, float(np.nan_to_num(gap, nan=np.inf).max(initial=0.0)))
        return largest


def record_episodes(run: Run, seed: int) -> Recorded:
    """Plays whole episodes of a run's policy."""
    arrays = record(run.restored.setup, run.state, seed, EPISODES)
    prefix = "observation/"
    parts = {k.removeprefix(prefix): x for k, x in arrays.items() if k.startswith(prefix)}
    return Recorded(parts or arrays["observation"], arrays["action"], arrays["length"])


def control_range(run: Run) -> np.ndarray | None:
    """Returns what actions -1 and 1 are for each actuator, [A, 2], as `lookup.scale_action` does.

    None where the environment has no model of as many limited actuators as actions.
    """
    model = getattr(getattr(run.env, "physics", None), "model", None)
    if model is None or model.nu != run.env.action_size or not model.actuator_ctrllimited.all():
        return None
    return np.asarray(model.actuator_ctrlrange, np.float32)


def origin(run: Run) -> dict[str, Any]:
    """Returns which policy it is: of what experiment, after how many steps, of what digest."""
    name = run.restored.source.name
    return {"experiment": name, "update": run.update, "steps": run.steps, "digest": run.digest}
