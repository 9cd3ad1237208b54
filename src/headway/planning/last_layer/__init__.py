"""Heads that keep learning while they act: a Bayesian last layer for every episode."""
