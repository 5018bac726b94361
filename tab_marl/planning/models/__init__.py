"""Adversary models: where the adversary may be and what it may do next, as each planner believes it."""
