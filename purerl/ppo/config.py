"""The settings of PPO, by default the control suite's, and of its evaluation: checked data."""

from dataclasses import dataclass, field
from typing import Any, Literal

from purerl.ppo import checks


@dataclass(frozen=True)
class Config:
    """PPO hyperparameters; sizes in the alphabet of `core/records.py`."""

    num_steps: int
    """Control steps of the whole run, all environments together; never exceeded."""
    num_envs: int = 64
    """Environments that run in parallel, B."""
    rollout_length: int = 128
    """Control steps of each environment in one update, T; the action noise begins anew there."""
    num_epochs: int = 4
    """Passes over each rollout."""
    num_minibatches: int = 16
    """Gradient steps in one pass, each of 2 control steps at least."""
    episode_length: int = 1000
    """Time limit of an episode [control steps]; reaching it truncates."""
    # Where the goal is reached soon, a start is what is to be learned.
    shortest_episode: int = 32
    """Time limit of the first environment's training episodes [control steps]; the others' rise
    to `episode_length`, evenly in their logarithm. 0, or one environment: whole ones."""
    gamma: float = 0.99
    """Discount of one control step."""
    gae_lambda: float = 0.95
    """Decay of the advantage trace, lambda."""
    clip: float = 0.2
    """Range of the policy ratio, 1 +- clip."""
    # One fall of a pole that always stood undid a policy.
    advantage_clip: float = 4.0
    """Range of the normalized advantage, +- so many standard deviations; 0: no limit."""
    # A policy that has earned nothing yet follows noise.
    min_advantage_std: float = 0.01
    """Advantages are divided by their deviation, and by no less than this [scaled reward]."""
    # With white noise, three of five hanging poles never swung up.
    noise_color: float = 0.75
    """Exponent b of the action noise, whose power at frequency f is 1 / f^b: 0 white, 1 pink."""
    value_weight: float = 0.5
    """Weight of the value loss."""
    entropy_weight: float = 0.02
    """Weight of the entropy bonus, a mean over the actions where other trainers have a sum."""
    # Beyond it, a bonus only holds a hopper down.
    entropy_target: float = 0.3
    """Above this entropy there is no bonus [nats for each action]; a uniform policy has 0.69."""
    auxiliary: dict[str, float | tuple[float, float, int]] = field(default_factory=dict, hash=False)
    """Weights of the losses that the network names: a number each, or first, last, and the control
    steps of the run in which the one becomes the other, linearly."""
    max_gradient_norm: float = 1.0
    """Gradients are scaled down to this global norm."""
    learning_rate: float = 1e-3
    """Adam's step size, or where it starts."""
    schedule: Literal["constant", "linear", "adaptive_kl"] = "linear"
    """Learning rate over the run: constant, linearly to 0, or steered by the policy's KL."""
    desired_kl: float = 0.01
    """KL of one minibatch step that the adaptive schedule aims at."""
    reward_scaling: Literal["constant", "return_std"] = "return_std"
    """Divide rewards by nothing, or by the running std of the discounted return."""
    reward_scale: float = 1.0
    """Factor on every reward before learning; reported returns are unscaled."""

    def __post_init__(self) -> None:
        """Raises ValueError for a number outside its range or a budget below one update."""
        checks.check_rules(self, checks.TRAINING)
        checks.check_budget(self)

    @classmethod
    def plain(cls, num_steps: int, **settings: Any) -> "Config":
        """Returns PPO as other trainers have it: what they lack is off.

        Args:
          num_steps: control steps of the whole run.
          settings: any other field by name; one that is given is not switched off.
        """
        off: dict[str, Any] = {"shortest_episode": 0, "advantage_clip": 0.0, "noise_color": 0.0}
        off |= {"min_advantage_std": 0.0, "entropy_weight": 0.0, "entropy_target": 1.0}
        off |= {"schedule": "constant", "reward_scaling": "constant"}
        return cls(num_steps, **(off | settings))

    @property
    def steps_per_update(self) -> int:
        """Control steps in one update, T * B."""
        return self.num_envs * self.rollout_length

    @property
    def num_updates(self) -> int:
        """Whole updates that fit into `num_steps`."""
        return self.num_steps // self.steps_per_update


@dataclass(frozen=True)
class Evaluation:
    """When and how the policy is evaluated during training; never changes training by a bit."""

    num_episodes: int = 32
    """Whole episodes in each evaluation."""
    number: int = 10
    """Evaluations over the run, evenly spaced, the last one at the end; 0: none."""

    def __post_init__(self) -> None:
        """Raises ValueError for a number outside its range."""
        checks.check_rules(self, checks.EVALUATION)
