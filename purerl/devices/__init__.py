"""Where and how the algorithm runs: compiled programs, and shards over several devices and hosts.

What the algorithm needs of a machine is written here. May import: core, exact, ppo.
Read: programs, compilation; then shards, slices and multi_device for more than one device.
"""
