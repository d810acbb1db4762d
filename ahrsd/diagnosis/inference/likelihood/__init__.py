"""The recording linearised at a model, and how likely a set of components is there."""
