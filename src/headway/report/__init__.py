"""What a run looks like: figures and tables made from its files."""
