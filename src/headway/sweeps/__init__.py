"""Many runs: the paper's experiments by name, what is missing of them, and running that."""
