"""Environments in processes of their own, which can be given up."""
