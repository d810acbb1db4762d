"""An emulated VN-100: physics, registers, faults, and a pseudo-terminal that serves it."""
