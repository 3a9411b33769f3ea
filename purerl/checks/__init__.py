"""What can be known of an environment and a network before they are trained, a line each.

May import: core, exact, physics, machine. Read: check_env, examine_env.
"""
