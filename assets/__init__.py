"""MJCF that this project wrote itself."""
