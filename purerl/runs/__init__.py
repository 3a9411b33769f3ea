"""Runs: folders on disk that say how they were made, and can be stopped and resumed exactly.

May import: core, exact, ppo, physics, devices. Read: `session.py`, which carries the command out,
`loop.py` (training), `writer.py` (what it leaves on disk), `manifest.py` (what bits depend on).
"""
