"""The components of a model: effects, Gaussian processes, the remainder of real recordings."""
