"""What is learned: networks, losses, fitting."""
