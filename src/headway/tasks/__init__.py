"""What a model and a planner must know of each environment; JAX only, no simulator."""
