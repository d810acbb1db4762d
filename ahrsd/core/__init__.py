"""The pure core: inputs in, events out. No I/O, no clock of its own."""
