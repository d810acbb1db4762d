"""The engine of rules: effects named one after the other, each by tests of its own."""
