"""What is told of the likeliest set: names, what is left, what is ordinary."""
