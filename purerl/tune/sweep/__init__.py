"""Sweeps: many runs of one experiment, each with other settings, and what came of them.

Read: `spaces.py` and `points.py` (which settings), `scheduler.py` (running them, which knows
nothing of sweeps), `table.py` (what came of them).
"""
