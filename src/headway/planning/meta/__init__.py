"""Models made to change while they act, GrBAL's and ReBAL's, and the agent around them."""
