"""dm_control's control suite as stateless environments, one file a domain.

The models are dm_control's own MJCF; observations (flattened in dm_control's order) and rewards
equal dm_control's to 1e-5. All episodes are 1000 control steps long, and nothing else ends them.
"""
