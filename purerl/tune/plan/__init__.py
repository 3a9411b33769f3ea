"""Planning: behaviour by search in the simulation, without learning; nothing here changes a run.

Read: `planner.py`, where `plan` chooses one action; then `episodes.py`.
"""
