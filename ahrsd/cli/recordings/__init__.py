"""Commands with recordings, measured or simulated: one of them, or whole archives."""
