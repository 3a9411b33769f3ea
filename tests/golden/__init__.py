"""Golden digests: what short runs end with, bit for bit, and how that is computed anew.

python -m tests.golden            # compute them, compare them with digests.json
python -m tests.golden --write    # put them there: after a change of bits that CHANGELOG names

XLA computes with one thread and with AVX2, which every x86-64 processor of the last ten years has.
"""
