"""Reports: what is read from finished runs, in numbers and pictures. Nothing here changes a run.

May import `core`, `ppo`, `physics` and `runs`. Start with `run_reader.py` and `comparison.py`; of
pictures with `episode_pictures.py`. An edit here does not keep a run from resuming.
"""
