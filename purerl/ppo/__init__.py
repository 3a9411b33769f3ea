"""The algorithm: proximal policy optimisation, as pure functions that read like the paper.

It knows nothing of the machine: what runs where comes in through `core/parts.py`.
May import: core. Read: `purerl/ppo/README.md`, which says where to start.
"""
