"""What an answer is held against, and all that is told beside its names."""
