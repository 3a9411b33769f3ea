"""Reports: what is read from finished runs, in numbers and pictures. Nothing here changes a run.

May import: core, exact, ppo, physics, eyes, machine, experiment, runs, training.
Read: `run_reader.py` and `comparison.py`; of pictures `episode_pictures.py`.
"""
