"""The answer in the contract's form, what it is held against, and its words."""
