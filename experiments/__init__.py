"""One file an experiment: what you copy to start your own."""
