"""Faults in the simulated world, one by one: what is injected, what must notice it, and how far it may go."""
