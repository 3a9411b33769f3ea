"""Planning: behaviour by search in the simulation, without learning; nothing here changes a run.

May import: core, ppo, devices, runs, report. Read: `planner.py`, where `plan` chooses one action;
then `episodes.py`. An edit here does not keep a run from resuming.
"""
