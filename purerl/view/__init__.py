"""The window: a page in the browser in which a policy drives the body, live. Runs are only read.

May import: core, ppo, physics, devices, runs, report. Read: `session.py`, what is shown as pure
functions; then `loop.py`, which plays it, and `page.py`, all that touches the browser. An edit here
does not keep a run from resuming.
"""
