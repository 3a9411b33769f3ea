"""The ppo room."""
