"""A traced function as one kernel: see README.md. Read: `compiling.py`, then `values.py`."""
