"""Golden digests: what short runs end with, bit for bit, and how that is computed anew.

python -m tests.golden            # compute them, compare them with digests.json
python -m tests.golden --write    # put them there: after a change of bits that CHANGELOG names

The runs are `--portable`: every x86-64 processor of the last ten years has these bits.
"""
