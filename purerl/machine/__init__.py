"""The machine that a command runs on: files, locks, arrays on a disk, the terminal, signals.

It knows no run and no experiment.
May import: core. Read: files, output.
"""
