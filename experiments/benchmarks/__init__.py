"""Measurements of this library: speed, memory, start-up, every environment, gaps crossed.

They measure the insides, so they import the rooms of `purerl` and not only its front door:
`python -m purerl.experiments.benchmarks.scaling --help`.
"""
