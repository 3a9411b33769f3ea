"""The table of gaps crossed says what the episodes were."""

import numpy as np

from purerl.experiments.benchmarks.gaps_crossed import report


def test_a_row_has_shares_quantiles_and_speed():
    result = {
        "gaps_crossed_count": np.array([0.0, 1.0, 5.0, 10.0]),
        "episode_length": np.array([20.0, 500.0, 499.0, 499.0]),
        "forward_velocity": np.array([0.0, 1.0, 1.0, 2.0]),
    }
    shares = "75% | 50% | 25%"
    quantiles = "0 | 0 | 1 | 3 | 6 | 8 | 10"
    assert report("trained", result, 500) == f"| trained | 4.0 | {shares} | {quantiles} | 1.00 |"
