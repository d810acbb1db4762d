"""The likeliest set of components, and what may be put into one."""
