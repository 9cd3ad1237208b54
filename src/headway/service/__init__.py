"""A trained controller leaves the house: exported, served, shared."""
