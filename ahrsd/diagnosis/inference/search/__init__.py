"""The search for the most probable set of components, and what a set may contain."""
