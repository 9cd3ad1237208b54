"""What an experiment or a sweep found: figure, raw numbers and table beside each other."""
