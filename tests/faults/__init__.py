"""Power cuts and faults of the disk, made to order: `shim.c` sees a process's calls, `disk.py`
knows what a power cut leaves of them, `processes.py` runs commands under both."""
