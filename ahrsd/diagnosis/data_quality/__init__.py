"""What is wrong with a recording itself, found by counting before any fit, and put right."""
