"""brax's ant and settings on purerl's physics; needs brax installed.

python -m purerl.run experiments/peers/brax_ant.py

What came of it beside brax itself: `docs/measurements/peers.md`.
"""

from experiments.peers.brax_peer import BODIES, our_experiment

experiment = our_experiment("ant", "purerl", BODIES["ant"], 31_129_600)
