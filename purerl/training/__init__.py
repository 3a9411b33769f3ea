"""The training of a run: folders and programs prepared, then the loop that evaluates and saves.

May import: core, exact, ppo, devices, machine, checks, experiment, runs.
Read: session, loop, writer.
"""
