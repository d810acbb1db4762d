"""The answer in the form of the contract, its checks, and its text."""
