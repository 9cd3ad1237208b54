"""One page that compares runs: methods against environments, over seeds."""
