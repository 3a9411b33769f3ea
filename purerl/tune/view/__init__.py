"""The window: a page in the browser, with a body that a policy or the planner drives, live.

May import `plan`. Read: `session.py`, what is shown as pure functions; then `loop.py`, which plays
it, and `page.py`, all that touches the browser.
"""
