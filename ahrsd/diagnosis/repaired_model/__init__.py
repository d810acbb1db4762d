"""The repaired model: as a file, and forward, into and out of readings."""
