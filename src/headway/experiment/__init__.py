"""How it is measured: methods, rollouts, evaluation, run directories, training."""
