"""The recording linearised at a model, and the likelihood of a set of components there."""
