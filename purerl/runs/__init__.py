"""Runs: folders on disk that say how they were made, and can be stopped and resumed exactly.

May import every room but `report`. Start with `session.py`, which carries the command out, then
`loop.py` (training), `writer.py` (what it leaves on disk) and `manifest.py` (what bits depend on).
`files.py`, `checkpoint_folder.py` and `command_errors.py` need no JAX.
"""
