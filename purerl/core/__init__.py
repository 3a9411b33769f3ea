"""What every room shares: records and the shape alphabet, the environment protocol, random keys.

May import: nothing. Read: records, env, parts.
"""
