"""The VectorNav VN-100: wire format, registers, session, serial device and emulator."""
