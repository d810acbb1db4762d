"""The configuration file: its keys, how it is read, and what the core takes from it."""
