"""The library of effects: equation, parameters, signature, columns and exact simulation of each."""
