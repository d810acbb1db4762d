"""Device drivers: bytes to SI samples, registers to values; they do not know `ahrsd`."""
