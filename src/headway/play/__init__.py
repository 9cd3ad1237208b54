"""A trained controller to watch and to disturb, live in the browser."""
