"""Acting: imagined returns, optimizers, the agent and its controller."""
