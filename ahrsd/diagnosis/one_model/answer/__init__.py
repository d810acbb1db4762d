"""What is said beside the names, and what they are held against: the answer in full."""
