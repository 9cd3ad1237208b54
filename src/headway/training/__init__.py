"""Training: collect, fit, evaluate, and the run directory that keeps it."""
