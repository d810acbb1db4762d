"""Where, when and under which conditions readings and model differ."""
