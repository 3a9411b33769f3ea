"""What is trained: an experiment's file, its settings, the objects that they build, its source.

May import: core, ppo, physics, devices, machine, checks. Read: definition, loading, objects.
"""
