"""A run's folder, written and read back: what describes the run, its checkpoints and metrics.

May import: core, exact, ppo, devices, machine, checks, experiment.
Read: folder, resume, checkpoint.
"""
