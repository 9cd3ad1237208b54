"""How it is measured: methods, rollouts, learners, evaluation, training."""
