"""The environments: bodies, arenas and tasks, one readable file each."""
