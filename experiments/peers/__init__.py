"""Other trainers beside this one, on the same bodies: stable-baselines3 (`sb3`) and brax.

They need the `peers` extra, and import the rooms of `purerl` and not only its front door.
`brax_ant` and `gymnasium_ant` are experiments:
`python -m purerl.run experiments/peers/gymnasium_ant.py`. What was measured:
`lab/README.md`.
"""
