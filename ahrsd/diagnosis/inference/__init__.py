"""One generative model of all that may be in a recording, and what the readings say of it."""
