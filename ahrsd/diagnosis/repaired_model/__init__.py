"""The repaired model: as a file, and as a forward model that adds or removes effects."""
