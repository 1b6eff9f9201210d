"""Gradient tuning of the memory's bias and of the exploration weight on fast simulated episodes."""
