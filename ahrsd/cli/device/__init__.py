"""Commands with a device on a port, real or emulated: capture, demo, emulate, registers, run."""
