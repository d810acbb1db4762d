"""The decision on the most probable set: findings, what is unexplained, what is ordinary."""
