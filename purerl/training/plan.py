"""What a run does when: its updates, evaluations, checkpoints and lines, rounded once."""

from typing import NamedTuple

from purerl.ppo.config import Config, Evaluation

DEFAULT_LINES = 500  # in metrics.jsonl, about


class Plan(NamedTuple):
    """A run's sizes, rounded once and up front."""

    updates: int
    steps_per_update: int
    log_every: int  # updates between two lines of metrics.jsonl
    evaluations: tuple[int, ...]  # after these updates
    checkpoints: tuple[int, ...]  # after these updates; the last one always

    @property
    def steps(self) -> int:
        """Control steps of the whole run."""
        return self.updates * self.steps_per_update


def make_plan(config: Config, evaluation: Evaluation, checkpoints: int, log_every: int) -> Plan:
    """Rounds a run to whole updates, and what happens between them to whole chunks.

    Args:
      config: for the budget; the plan never takes more than `config.num_steps` steps.
      evaluation: for the number of evaluations.
      checkpoints: how many, evenly spaced; at least the last is always taken.
      log_every: updates in a chunk; 0 chooses one with about `DEFAULT_LINES` chunks.
    """
    updates = config.num_updates
    log_every = min(log_every or max(1, updates // DEFAULT_LINES), updates)
    return Plan(
        updates=updates,
        steps_per_update=config.steps_per_update,
        log_every=log_every,
        evaluations=evenly(evaluation.number, updates, log_every),
        checkpoints=evenly(max(checkpoints, 1), updates, log_every),
    )


def evenly(number: int, updates: int, every: int) -> tuple[int, ...]:
    """Spreads `number` events over the run, each at the end of a chunk, the last at the run's."""
    chunks = [-(-updates * i // (number * every)) for i in range(1, number + 1)]
    return tuple(sorted({min(chunk * every, updates) for chunk in chunks}))
