"""Power cuts and faults of the disk, made to order.

`shim.c` sees a process's calls; `disk.py` knows what a power cut leaves of them; `commands.py` runs
commands under both, fast; `verdicts.py` says whether a run has come through.
"""
