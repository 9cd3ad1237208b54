"""Dynamics models: networks, losses, fitting, and beliefs while acting."""
