"""A run read back from its folder: its policy, its metrics, its evaluation."""

import functools
from dataclasses import dataclass, fields
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

from purerl.core.errors import UserError
from purerl.experiment import loading, options
from purerl.runs.folder import METRICS, check_is_run
from purerl.runs.metrics_file import deviation, read_metrics

if TYPE_CHECKING:
    from purerl.core.env import Env
    from purerl.core.records import Network, TrainState
    from purerl.experiment.definition import Experiment
    from purerl.ppo.config import Config
    from purerl.runs import restored_run
    from purerl.runs.policy import Policy


def load(
    folder: Path | str, checkpoint: str = "latest", engine: str = "", trust: bool = False
) -> "Run":
    """Reads a run back from its folder alone; nothing in it is changed.

    The run's experiment.py is executed when something but `metrics()` is first asked for: if it is
    known on this machine, as of a run trained here, or with `trust` (docs/reference/trust.md).

    Args:
      folder: the run's folder, such as "runs/ant_run/seed1", or the name of a policy that comes
        with purerl, such as "ant_gaps".
      checkpoint: "latest", "best" (highest evaluation return), or an update's number.
      engine: a physics engine, where it should not be the run's own.
      trust: the code in the folder may be executed, though this machine does not know it.

    Raises:
      UserError: the folder holds no run.

    >>> run = load(folder)
    >>> observation = np.zeros(5)
    >>> run.policy(observation).shape
    (1,)
    >>> run.metrics()["update"][-1]
    2
    """
    folder = loading.shipped(str(folder)) or Path(folder)
    check_is_run(folder)
    return Run(folder, str(checkpoint), engine, trust)


class Figures(TypedDict):
    """One metric over N episodes."""

    mean: float
    std: float
    min: float
    max: float
    values: list[float]


class Evaluated(TypedDict):
    """What `Run.evaluate` returns: what was evaluated, and the figures."""

    run: str
    update: int
    steps: int
    digest: str
    engine: str
    seed: int
    policy: str
    episodes: int
    metrics: dict[str, Figures]


@dataclass(frozen=True)
class Run:
    """A run read back; what it holds is built when it is first asked for."""

    folder: Path
    checkpoint: str = "latest"
    engine: str = ""  # "": the run's own
    trust: bool = False

    def __post_init__(self) -> None:
        """Keeps the folder's whole path: the process may change its own."""
        object.__setattr__(self, "folder", Path(self.folder).absolute())

    def __getstate__(self) -> dict[str, Any]:
        """Pickles where the run is, and which checkpoint was read; not what was built of it."""
        state = {field.name: getattr(self, field.name) for field in fields(self)}
        return state | ({"checkpoint": str(self.update)} if "restored" in vars(self) else {})

    @functools.cached_property
    def restored(self) -> "restored_run.RestoredRun":
        """The experiment rebuilt, and the checkpoint."""
        from purerl.devices.compilation import set_up_jax
        from purerl.machine.output import show
        from purerl.runs.restored_run import restore

        set_up_jax(cache=True)
        # The code that a shipped policy comes with is its own, though it has changed since.
        say = (lambda line: None) if loading.is_shipped(self.folder) else show
        return restore(self.folder, self.checkpoint, say, self.engine, self.trust)

    @functools.cached_property
    def policy(self) -> "Policy":
        """The policy, at the start of an episode."""
        from purerl.runs.policy import Policy

        return Policy(self.env, self.network, self.state, self)

    @property
    def experiment(self) -> "Experiment":
        """With the run's settings."""
        return self.restored.experiment

    @property
    def config(self) -> "Config":
        """The settings of PPO."""
        return self.restored.setup.config

    @property
    def env(self) -> "Env":
        """One environment."""
        return self.restored.setup.env

    @property
    def network(self) -> "Network":
        """The network's functions."""
        return self.restored.setup.network

    @property
    def state(self) -> "TrainState":
        """The checkpoint's, without environments, episodes and optimizer."""
        return self.restored.saved.state

    @property
    def update(self) -> int:
        """Updates done."""
        return self.restored.saved.meta["update"]

    @property
    def steps(self) -> int:
        """Control steps taken, all environments together."""
        return self.restored.saved.meta["steps"]

    @property
    def digest(self) -> str:
        """The sha256 of the whole state that was saved."""
        return self.restored.saved.meta["digest"]

    def metrics(self) -> dict[str, list[Any]]:
        """Returns metrics.jsonl as columns, None where a line lacks one; JAX is not needed.

        `pandas.DataFrame(run.metrics())` makes a table of them.
        """
        check_is_run(self.folder)
        lines = read_metrics(self.folder / METRICS)
        names = dict.fromkeys(name for line in lines for name in line)
        return {name: [line.get(name) for line in lines] for name in names}

    def evaluate(self, episodes: int = 100, seed: int = 0, stochastic: bool = False) -> Evaluated:
        """Evaluates on whole episodes in fresh environments, as `python -m purerl.evaluate` does.

        Args:
          episodes: N, each in an environment of its own.
          seed: of the episodes; it never meets a seed of training.
          stochastic: sample actions instead of taking the distribution's centre.

        Returns:
          "metrics": name -> {"mean", "std", "min", "max", "values" [N]}, "episode_return" among
          them, and what was evaluated: "run", "update", "steps", "digest", "engine", ...
        """
        import jax
        import numpy as np

        from purerl.core.keys import Purpose, derive
        from purerl.ppo.evaluation import evaluate_policy

        options.check_seed(seed)
        if not isinstance(episodes, Integral) or episodes < 1:
            raise UserError(f"episodes is {episodes!r}; it must be a whole number, at least 1.")
        config, env, network, engine = self.restored.setup
        place, here = self.folder, Path.cwd()

        def judge(state: Any, key: Any) -> dict[str, Any]:
            length = config.episode_length
            return evaluate_policy(env, network, state, key, episodes, length, not stochastic)

        def summarize(values: Any) -> Figures:
            x = np.asarray(values, float)
            mean, std, least, most = map(float, (x.mean(), deviation(x), x.min(), x.max()))
            return {"mean": mean, "std": std, "min": least, "max": most, "values": x.tolist()}

        key = derive(jax.random.key(seed), Purpose.EVALUATION)
        found = jax.device_get(jax.jit(judge)(self.state, key))
        return {
            "run": str(place.relative_to(here) if here in place.parents else place),
            "update": self.update,
            "steps": self.steps,
            "digest": self.digest,
            "engine": engine,
            "seed": seed,
            "policy": "stochastic" if stochastic else "deterministic",
            "episodes": episodes,
            "metrics": {name: summarize(values) for name, values in sorted(found.items())},
        }
