"""PPO on MuJoCo MJX: readable in an afternoon, reproducible to the last bit."""

__version__ = "0.1.0"
