"""The settings of a planner: pure data, checked when made."""

from dataclasses import dataclass
from typing import Any, Literal

from purerl.core.errors import check_least

# The first sample is the plan itself, which begins as 0, and the second is 0: what a policy does.
NO_SEARCH: dict[str, Any] = {"samples": 2, "elites": 2, "horizon": 1, "knots": 2}


@dataclass(frozen=True)
class Settings:
    """How a plan is looked for; letters: N samples, H steps of the horizon, K knots."""

    planner: Literal["predictive_sampling", "mppi", "cem"] = "predictive_sampling"
    """What a plan becomes of its samples: the best one, a mean weighted by return, or the mean of
    the best few."""
    samples: int = 64
    """Plans that are tried in each iteration, N."""
    horizon: int = 50
    """Control steps that a plan looks ahead, H."""
    knots: int = 8
    """Knots of a plan's spline, K."""
    spline: Literal["zero", "linear", "cubic"] = "linear"
    """Actions between knots: the last knot's, a line, or a smooth curve."""
    noise: float = 0.3
    """Standard deviation of the knots tried around the last plan, a quarter to four times as large
    from sample to sample; actions reach from -1 to 1."""
    iterations: int = 1
    """Times that samples are drawn and the plan is improved before each action."""
    temperature: float = 0.3
    """Of mppi: how much worse a sample may be and still count, in standard deviations of the
    returns."""
    elites: int = 8
    """Of cem: how many of the best samples make the next plan."""

    def __post_init__(self) -> None:
        """Raises ValueError for a number outside its range."""
        check_least(self, ValueError, samples=2, horizon=1, knots=2, iterations=1, elites=1)
        for name in ("noise", "temperature"):
            if not 0.0 < getattr(self, name) < float("inf"):
                raise ValueError(f"{name} is {getattr(self, name)}; it must be above 0.")
        if self.planner == "cem" and self.elites > self.samples:
            raise ValueError(f"elites is {self.elites}; there are only {self.samples} samples.")
