"""How it acts: imagined returns, head selection, optimizers, the agent."""
