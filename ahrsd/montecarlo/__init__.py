"""Accuracy of the methods over simulated runs, against truth and the Cramér-Rao bound."""
