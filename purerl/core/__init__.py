"""What every room shares: records and the shape alphabet, the environment protocol, random keys.

May import: nothing. Read: `purerl/core/README.md`, which says where to start.
"""
