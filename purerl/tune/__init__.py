"""Tuning: which behaviour a reward makes best, and which settings train best. No run is changed.

May import: core, ppo, devices, machine, checks, experiment, runs, report.
Read: `plan/planner.py`, behaviour by search in the simulation, without learning; `view/session.py`,
the window, in which a policy or the planner drives the body live; `sweep/scheduler.py`, which
carries out many runs.
"""
